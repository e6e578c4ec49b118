"""Figures are drawn from result files, also for rates of 0 and 1; headings relative to travel."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib.image
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure

from tdgc.benchmark.evaluation import Episode, tile_of
from tdgc.benchmark.results import write_results
from tdgc.show import plots
from tdgc.sim.robot import Array

FAMILIES = ("rough", "gap")


def straight(start: Array, way: Array, heading: float, seconds: float) -> Array:
    """Poses (n, 3) every 0.2 s at constant velocity ``way`` (2,) m/s and ``heading`` rad."""
    times = np.append(np.arange(0.0, seconds, 0.2), seconds)
    return np.column_stack([start[:2] + times[:, None] * way, np.full(len(times), heading)])


def write(folder: Path, conditions: Sequence[str] = ("nominal",), heading: float = 0.0) -> Path:
    """Write results of ten robots per cell: all of ``tdgc`` arrive, all of ``gp`` fall.

    ``tdgc`` uses one gait per family, ``gp`` trots.
    """
    episodes = []
    for condition in conditions:
        for policy, outcome in (("tdgc", "reached"), ("gp", "fell")):
            for g, family in enumerate(FAMILIES):
                for level in (6, 7):
                    for k in range(10):
                        tile = tile_of(0, family, level, k)
                        way = (tile.goal - tile.start[:2]) / 10.0
                        shares = np.eye(4)[g if policy == "tdgc" else 0]
                        episodes.append(
                            Episode(
                                policy, condition, family, level, k, 0, outcome, 9.5, 6.0, 500.0,
                                tuple(shares), tile.goal, straight(tile.start, way, heading, 9.5),
                            )
                        )  # fmt: skip
    write_results(folder, episodes)
    return folder


def picture(path: Path) -> Array:
    """Pixels of a figure, (height, width, 3), which must not be blank."""
    pixels = matplotlib.image.imread(path)[..., :3]
    assert pixels.shape[0] > 200 and np.ptp(pixels) == 1.0
    return pixels


def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures drawn from now on, which are collected instead of written."""
    figures: list[Figure] = []

    def keep(figure: Figure, out: Path) -> None:
        figures.append(figure)
        plt.close(figure)  # pyplot forgets it, it can still be looked at

    monkeypatch.setattr(plots, "_save", keep)
    return figures


def share_of(pixels: Array, colour: str) -> float:
    """Share of all pixels that have nearly this colour."""
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    return float((np.abs(pixels - wanted) < 0.02).all(axis=-1).mean())


def test_success_figure_with_rates_of_none_and_all(tmp_path: Path) -> None:
    write(tmp_path)
    plots.success_by_level(tmp_path / "summary.json", tmp_path / "one.png")
    one = picture(tmp_path / "one.png")
    assert one.shape[1] > one.shape[0]
    write(tmp_path, ["nominal", "mixed", "pushes"])
    plots.success_by_level(tmp_path / "summary.json", tmp_path / "three.png")
    three = picture(tmp_path / "three.png")
    assert three.shape[0] > 2.5 * one.shape[0] - 200  # one row of panels per condition


def test_success_figure_shows_the_rates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path)
    table = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    wanted = {"tdgc": [[90.0, 80.0], [70.0, 60.0]], "gp": [[50.0, 40.0], [30.0, 20.0]]}
    for policy, families in wanted.items():
        for family, shares in zip(FAMILIES, families, strict=True):
            for level, share in zip("67", shares, strict=True):
                table[policy]["nominal"][family][level]["rate"] = share / 100.0
    (tmp_path / "summary.json").write_text(json.dumps(table), encoding="utf-8")
    figures = drawn(monkeypatch)
    plots.success_by_level(tmp_path / "summary.json", tmp_path / "one.png")
    assert len(figures[0].axes) == len(FAMILIES)
    for k, axis in enumerate(figures[0].axes):
        found = {c.get_label(): c.lines[0].get_xydata() for c in axis.containers}
        assert axis.get_title() == FAMILIES[k]
        assert {policy: way[:, 1].tolist() for policy, way in found.items()} == {
            policy: pytest.approx(families[k]) for policy, families in wanted.items()
        }
        assert all(np.round(way[:, 0]).tolist() == [6.0, 7.0] for way in found.values())


def test_gait_figure_is_half_and_half(tmp_path: Path) -> None:
    """``tdgc`` only trots in one family and only pronks in the other; ``gp`` only trots."""
    plots.gait_shares(write(tmp_path), tmp_path / "gaits.png")
    pixels = picture(tmp_path / "gaits.png")
    trot, pronk, pace, bound = (share_of(pixels, c) for c in plots.GAIT_COLOURS)
    # Trot has three bars, pronk one; the legend, the only place of the others, shows all equally.
    assert (trot - pace) / (pronk - pace) == pytest.approx(3.0, abs=0.1)
    assert 0.0 < bound < 0.1 * pronk


def test_heading_to_travel() -> None:
    north = np.array([0.0, 0.5])
    for nose, expected in ((np.pi / 2, 0.0), (0.0, -np.pi / 2), (np.pi, np.pi / 2)):
        angles = plots.heading_to_travel(straight(np.zeros(2), north, nose, 2.05))
        assert angles == pytest.approx(np.full(10, expected))  # the last, short step is left out
    backwards = plots.heading_to_travel(straight(np.zeros(2), north, -np.pi / 2, 1.0))
    assert np.abs(backwards) == pytest.approx(np.full(4, np.pi))
    assert plots.heading_to_travel(straight(np.zeros(2), 0.19 * north, 0.0, 2.0)).size == 0
    # Turning left along a circle, facing ahead, across the wrap at pi.
    angle = np.linspace(0.0, 2.0, 21)
    circle = np.column_stack([np.cos(angle), np.sin(angle), angle + np.pi / 2])
    circle[:, 2] = np.mod(circle[:, 2] + np.pi, 2 * np.pi) - np.pi
    assert plots.heading_to_travel(circle) == pytest.approx(np.zeros(19), abs=1e-9)


def test_heading_figure_turns_with_the_robots(tmp_path: Path) -> None:
    """Robots that walk forwards fill the area above the centres, backwards that below."""
    centroids = []
    for name, heading in (("ahead", 0.0), ("back", np.pi)):
        (tmp_path / name).mkdir()
        write(tmp_path / name, heading=heading)
        plots.headings(tmp_path / name, tmp_path / "headings.png")
        pixels = picture(tmp_path / "headings.png")
        rows = np.flatnonzero((pixels[..., 2] - pixels[..., 0] > 0.3).any(axis=1))  # tdgc's blue
        centroids.append(rows.mean() / len(pixels))
    assert centroids[1] - centroids[0] > 0.1


def test_figures_of_a_single_episode_hold_their_captions(tmp_path: Path) -> None:
    """Nothing touches the left and right edges, where too long a line would be cut off."""
    tile = tile_of(0, "gap", 6, 0)
    track = straight(tile.start, np.array([0.5, 0.0]), 0.0, 9.5)
    where = ("gp", "nominal", "gap", 6, 0, 0)
    only = Episode(*where, "fell", 9.5, 4.7, 500.0, (1.0, 0.0, 0.0, 0.0), tile.goal, track)
    write_results(tmp_path, [only])
    for draw in (plots.headings, plots.trajectories):
        draw(tmp_path, tmp_path / "figure.png")
        pixels = picture(tmp_path / "figure.png")
        assert (pixels[:, :2] == 1.0).all() and (pixels[:, -2:] == 1.0).all(), draw.__name__


def test_heading_figure_of_robots_that_stand(tmp_path: Path) -> None:
    tile = tile_of(0, "gap", 6, 0)
    track = straight(tile.start, np.zeros(2), 0.0, 1.0)
    where = ("gp", "nominal", "gap", 6, 0, 0)
    still = Episode(*where, "timeout", 1.0, 0.0, 9.0, (1.0, 0.0, 0.0, 0.0), tile.goal, track)
    write_results(tmp_path, [still])
    plots.headings(tmp_path, tmp_path / "headings.png")
    picture(tmp_path / "headings.png")


def test_trajectory_figure_has_a_row_a_family_on_its_hardest_level(tmp_path: Path) -> None:
    plots.trajectories(write(tmp_path), tmp_path / "trajectories.png")
    pixels = picture(tmp_path / "trajectories.png")
    assert pixels.shape[1] > 2 * pixels.shape[0]  # two rows, each with three tiles per policy
    width = pixels.shape[1]
    left, right = pixels[:, : int(0.45 * width)], pixels[:, int(0.52 * width) :]
    blue, orange = plots.POLICY_COLOURS["tdgc"], plots.POLICY_COLOURS["gp"]
    assert share_of(left, blue) > 0.002 > 0.0 == share_of(left, orange)
    assert share_of(right, orange) > 0.002 > 0.0 == share_of(right, blue)


@pytest.mark.parametrize("draw", [plots.gait_shares, plots.headings, plots.trajectories])
def test_figures_of_another_condition_say_so(
    draw: Callable[[Path, Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They show only the first condition, and name it unless it is nominal."""
    figures = drawn(monkeypatch)
    for conditions in (["nominal", "pushes"], ["pushes", "nominal"]):
        draw(write(tmp_path, conditions), tmp_path / "figure.png")
    assert [figure.get_suptitle() for figure in figures] == ["", "condition pushes"]


def test_training_figure_skips_what_a_phase_does_not_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plane = {"steps": 100_000, "reward/total": 0.001, "tracking/trot_contact_match": 0.5}
    tiles = {"steps": 200_000, "reward/total": 0.002, "level/stair": 1.5}
    log = tmp_path / "log.jsonl"
    log.write_text(f"{json.dumps(plane)}\n{json.dumps(tiles)}\n", encoding="utf-8")
    plots.training_curve(log, tmp_path / "training.png")
    assert matplotlib.image.imread(tmp_path / "training.png").shape[2] == 4
    figures = drawn(monkeypatch)
    plots.training_curve(log, tmp_path / "training.png")
    lines = [[line.get_xydata().tolist() for line in axis.lines] for axis in figures[0].axes]
    assert lines == [[[[0.1, 0.001], [0.2, 0.002]]], [], [], [[[0.1, 0.5]]], [], [[[0.2, 1.5]]]]


def test_decision_figure_marks_the_end_of_imitation(tmp_path: Path) -> None:
    """The mark is a dotted line in each of the four panels, in a grey that nothing else has."""
    taught = {"steps": 100_000, "reward/total": 0.1, "level/gap": 1.0, "success/gap": 0.2}
    own = {"steps": 300_000, "reward/total": 0.2, "level/gap": 2.0, "success/gap": 0.4}

    def grey(first: dict[str, float]) -> float:
        log = tmp_path / "log.jsonl"
        log.write_text(f"{json.dumps(first)}\n{json.dumps(own)}\n", encoding="utf-8")
        plots.decision_curve(log, tmp_path / "training.png")
        return share_of(picture(tmp_path / "training.png"), "#808080")

    assert grey({**taught, "train/imitation_loss": 1.0}) > grey(taught) + 2e-4


def test_ablation_figure_has_a_bar_per_variant_as_long_as_its_rate(tmp_path: Path) -> None:
    """One variant reaches half of the goals, one all of them, and one is still to come."""
    rows: list[dict[str, object]] = [
        {"name": "full", "what": "all", "n": 50, "rate": 0.5, "ci_low": 0.37, "ci_high": 0.63,
         "seeds": {"1": 0.4, "2": 0.6}},
        {"name": "trot", "what": "one", "n": 25, "rate": 1.0, "ci_low": 0.87, "ci_high": 1.0,
         "seeds": {"1": 1.0}},
        {"name": "gp", "what": "script", "errors": {}},
    ]  # fmt: skip
    shares = []
    for some in (rows[:1], rows[1:2], rows):
        (tmp_path / "ablation.json").write_text(json.dumps({"rows": some}))
        plots.ablation(tmp_path / "ablation.json", tmp_path / "ablation.png")
        pixels = matplotlib.image.imread(tmp_path / "ablation.png")[..., :3]
        bar = np.abs(pixels - np.array([0.4, 0.668, 0.82])) < 0.02  # tdgc's blue with alpha 0.6
        widest = bar.all(axis=-1).sum(axis=1)
        shares.append(widest.max() / pixels.shape[1])
        assert len(pixels) == 120 * (1.0 + 0.3 * len([row for row in some if "n" in row]))
    assert shares[0] < 0.65 * shares[1] and shares[2] > 0.5


@pytest.mark.parametrize(
    ("names", "lines"), [(["full", "trot"], [50.0]), (["trot", "full"], [80.0]), (["trot"], [])]
)
def test_ablation_figure_has_its_line_at_full(
    names: list[str], lines: list[float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The line is drawn wherever ``full`` is in the table; without it there is none."""
    figures, cell = drawn(monkeypatch), {"what": "it", "n": 50, "seeds": {"1": 0.5}}
    rates = [{"rate": r, "ci_low": r - 0.1, "ci_high": r + 0.1} for r in (0.5, 0.8)]
    rows = [{"name": name} | cell | some for name, some in zip(names, rates, strict=False)]
    (tmp_path / "ablation.json").write_text(json.dumps({"rows": rows}))
    plots.ablation(tmp_path / "ablation.json", tmp_path / "ablation.png")
    dotted = [line for line in figures[0].axes[0].lines if line.get_linestyle() == ":"]
    assert [float(line.get_xdata()[0]) for line in dotted] == pytest.approx(lines)
