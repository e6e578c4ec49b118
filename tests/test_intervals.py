"""Intervals of rates and paired differences, with one seed and with several per tile."""

from __future__ import annotations

import numpy as np
import pytest

from tdgc.benchmark.intervals import difference, paired_interval, rates, wilson_interval


def test_wilson_interval_is_the_textbook_one() -> None:
    # Wilson's interval of 8 in 10 at 95 %: 0.4902 to 0.9433 (e.g. Newcombe 1998, method 3).
    low, high = wilson_interval(8, 10)
    assert low == pytest.approx(0.4902, abs=5e-5) and high == pytest.approx(0.9433, abs=5e-5)
    assert wilson_interval(0, 20)[0] == 0.0 and wilson_interval(20, 20)[1] == 1.0
    with pytest.raises(ValueError, match=r"0 <= reached <= n"):
        wilson_interval(3, 2)


def test_paired_interval_is_newcombes() -> None:
    # Airway hyper-responsiveness of 21 patients before and after a transplantation, worked out by
    # Fagerland, Lydersen and Laake (2014): -0.286, from -0.507 to -0.026.
    low, high = paired_interval(1, 1, 7, 12)
    assert (low, high) == pytest.approx((-0.507, -0.026), abs=5e-4)
    # Swapping the sides changes the sign; bounds stay within [-1, 1].
    assert paired_interval(1, 7, 1, 12) == pytest.approx((-high, -low))
    assert paired_interval(0, 20, 0, 0) == pytest.approx((0.7721, 1.0), abs=5e-5)
    low, high = paired_interval(100, 0, 0, 0)
    assert low == pytest.approx(-high) and 0.03 < high < 0.06


def test_paired_interval_covers_the_truth() -> None:
    """Draw 2,000 tables of 100 tiles with correlated success rates of 0.95 and 0.9.

    Of their intervals, 94 to 98 % contain the true difference, 0.05.
    """
    rng = np.random.default_rng(0)
    tables = rng.multinomial(100, [0.88, 0.07, 0.02, 0.03], 2000)
    inside = [low <= 0.05 <= high for low, high in (paired_interval(*map(int, t)) for t in tables)]
    assert 0.94 <= np.mean(inside) <= 0.98


def drawn(seeds: int, spread: float, n: int = 200) -> np.ndarray:
    """Outcomes (seeds, n) on tiles that each have their own success rate, 0.7 on average.

    The larger ``spread``, the more the tiles differ.
    """
    rng = np.random.default_rng(0)
    chance = rng.beta(0.7 / spread, 0.3 / spread, n)
    return np.asarray(rng.random((seeds, n)) < chance)


def width(found: dict[str, float]) -> float:
    return found["ci_high"] - found["ci_low"]


def together(first: np.ndarray, second: np.ndarray) -> dict[str, float]:
    return difference(np.stack([first, second], axis=-1))


def test_of_one_seed_the_intervals_are_wilsons_and_newcombes() -> None:
    found = rates([True] * 8 + [False] * 2)
    assert (found["n"], found["reached"], found["rate"]) == (10, 8, 0.8)
    assert (found["ci_low"], found["ci_high"]) == wilson_interval(8, 10)
    pairs = [(True, True)] + [(True, False)] + [(False, True)] * 7 + [(False, False)] * 12
    found = difference(pairs)
    assert (found["n"], found["gained"], found["lost"]) == (21, 1, 7)
    assert found["difference"] == pytest.approx(-6 / 21)
    assert (found["ci_low"], found["ci_high"]) == paired_interval(1, 1, 7, 12)


def test_a_tile_counts_once_however_many_seeds_are_on_it() -> None:
    """Repeating the outcomes on 100 tiles for more seeds leaves the widths as they are, to 2 %."""
    script, whole = drawn(2, spread=1.0, n=100)
    once = together(script, whole)
    twice = together(np.tile(script, (2, 1)), np.tile(whole, (2, 1)))
    assert twice["difference"] == once["difference"]
    assert [twice[key] for key in ("n", "gained", "lost")] == [
        2 * once[key] for key in ("n", "gained", "lost")
    ]
    assert width(twice) == pytest.approx(width(once), rel=0.02)
    good = rates(np.tile(whole, (3, 1)))
    assert (good["n"], good["reached"]) == (300, 3 * whole.sum())
    assert width(good) == pytest.approx(width(rates(whole)), rel=0.02)


@pytest.mark.parametrize("spread", [0.05, 1.0, 4.0])
def test_intervals_are_as_wide_as_tiles_drawn_anew_make_them(spread: float) -> None:
    """They match a bootstrap over the tiles to 8 %, whether tiles decide little or everything."""
    good, rng = drawn(3, spread), np.random.default_rng(1)
    script = np.tile(drawn(1, spread), (3, 1))
    for found, values in (
        (rates(good), good.astype(float)),
        (together(script, good), script.astype(float) - good),
    ):
        again = rng.choice(values.mean(axis=0), (4000, 200)).mean(axis=1)
        low, high = np.quantile(again, [0.025, 0.975])
        assert width(found) == pytest.approx(high - low, rel=0.08)


def test_an_interval_without_failures_has_a_width() -> None:
    perfect = np.ones((2, 50), dtype=bool)
    assert rates(perfect)["ci_low"] < 0.97
    assert width(together(perfect, perfect)) > 0.0
