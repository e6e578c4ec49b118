"""Leaps: when feet land at either side of a trench; what is measured of a low level."""

import numpy as np
import pytest

from tdgc.tasks.high_env import PRETRAINED, load_low
from tdgc.tasks.leaps import LANDING, Landing, measure_landing, straddling_frequency

LOW = PRETRAINED / "low"


def frequency(
    x: float,
    clock: float,
    length: float = 0.345,
    speed: float = 1.0,
    landing: Landing = LANDING,
) -> float:
    """Of one robot, before trenches at 2.1 m and 3.35 m, with a stride of 0.4 m."""
    one = np.ones(1)
    timed = straddling_frequency(
        x * one, speed * one, clock * one, 0.4 * one, length * one, np.array([[2.1, 3.35]]), landing
    )
    return float(timed[0])


ON_TIME = 2.1 - 0.2 - 0.2  # m: the trunk when the feet land half a stride before the centre


def test_timing_puts_landings_at_either_side_of_a_trench() -> None:
    """Feet land 0.20 m ahead, all on one line."""
    assert frequency(ON_TIME, 0.0) == pytest.approx(2.5)
    assert frequency(ON_TIME + 0.1, 0.25) == pytest.approx(2.5)  # a quarter of a cycle later
    assert frequency(ON_TIME + 0.4, 0.0) == pytest.approx(2.5)  # the landing behind it
    assert frequency(ON_TIME + 1.25, 0.0) == pytest.approx(2.5)  # before the next one
    # Too far for its clock by a tenth of a stride: step sooner.
    assert frequency(ON_TIME + 0.04, 0.0) == pytest.approx(2.5 * 1.15)
    assert frequency(ON_TIME - 0.04, 0.0) == pytest.approx(2.5 * 0.85)
    # Rear feet 2 cm closer to the front ones: the middle of the two lines is 1 cm ahead.
    assert frequency(ON_TIME - 0.01, 0.0, length=0.325) == pytest.approx(2.5)


def test_timing_keeps_the_stride_at_any_speed_above_that_of_the_start() -> None:
    assert frequency(ON_TIME, 0.0, speed=1.2) == pytest.approx(3.0)
    assert frequency(ON_TIME, 0.0, speed=0.1) == pytest.approx(2.5)  # as for 1 m/s


def test_timing_knows_where_a_low_level_lands() -> None:
    """Front feet 3 cm further ahead and rear ones 2 cm further apart: lines 2 cm further on."""
    assert frequency(ON_TIME - 0.02, 0.0, landing=Landing(0.23, 0.075)) == pytest.approx(2.5)


def ahead(landing: Landing) -> float:
    """m, what of a landing the timing depends on."""
    return landing.front - 0.5 * landing.spread


def test_landing_of_the_shipped_low_level() -> None:
    """The same, to a centimetre, whatever the leaps it is measured with are timed for: its feet
    leave 3 cm at either side of the 30 cm that the widest trench has at its top."""
    low, config = load_low(LOW)
    found = measure_landing(low, config, 5)
    assert found != LANDING
    assert -0.02 < found.spread < 0.02
    for shift in (-0.03, 0.03):
        assumed = Landing(LANDING.front + shift, LANDING.spread)
        assert ahead(measure_landing(low, config, 5, assumed)) == pytest.approx(
            ahead(found), abs=0.01
        )


class Limp:
    """A low level that does nothing."""

    def predict(self, observation: np.ndarray) -> tuple[np.ndarray, None]:
        return np.zeros((len(observation), 12)), None


def test_a_low_level_that_cannot_leap_has_the_default_landing() -> None:
    _, config = load_low(LOW)
    assert measure_landing(Limp(), config, 5) == LANDING  # type: ignore[arg-type]
