"""What the teacher reads from the heights of a tile."""

from __future__ import annotations

import numpy as np
import pytest

from tdgc.sim.families import FAMILIES
from tdgc.sim.terrain import EVAL_STREAM, make_tile, tile_rng
from tdgc.sim.tile import CELL
from tdgc.tasks.survey import GRID, clearance, survey, travel_cost

GOAL = np.array([7.25, 4.0])
X, Y = np.meshgrid(np.arange(161) * CELL, np.arange(161) * CELL, indexing="ij")


def tiles(family: str, level: int, count: int = 8):
    for index in range(count):
        yield make_tile(family, level / 10, tile_rng(7, family, level, index, EVAL_STREAM))


@pytest.mark.parametrize("family", [*FAMILIES, "mixed", "clutter", "ditches"])
@pytest.mark.parametrize("level", [4, 10, 12])
def test_finds_the_trenches_that_a_tile_lists(family: str, level: int) -> None:
    for tile in tiles(family, level):
        found = survey(tile.heights, 0.0, tile.goal)
        np.testing.assert_allclose(found.trenches, tile.features.trenches)


@pytest.mark.parametrize("level", [1, 5, 10, 12])
def test_finds_slopes_and_takes_nothing_else_for_one(level: int) -> None:
    inside = np.s_[25:136, 60:101]
    for tile in tiles("tilt", level):
        slope = survey(tile.heights, 0.0, tile.goal).slope
        np.testing.assert_allclose(slope[inside], np.tan(tile.features.slope), atol=1e-3)
    for family in ("rough", "stair", "gap", "pillar"):
        for tile in tiles(family, level):
            assert (survey(tile.heights, 0.0, tile.goal).slope[inside] == 0.0).all()


@pytest.mark.parametrize("family", ["rough", "stair", "gap", "tilt"])
def test_nothing_to_walk_around_on_most_families(family: str) -> None:
    for level in (10, 11):
        for tile in tiles(family, level):
            assert survey(tile.heights, 0.0, tile.goal).cost is None
    for tile in tiles("pillar", 10):
        assert survey(tile.heights, 0.0, tile.goal).cost is not None


def test_a_cropped_tile_is_the_same() -> None:
    for tile in [*tiles("pillar", 5, 3), *tiles("mixed", 5, 3), *tiles("clutter", 5, 3)]:
        whole = survey(tile.heights, 0.0, tile.goal)
        cut = survey(tile.heights[:, 40:121], 2.0, tile.goal)
        assert (cut.cost is None) == (whole.cost is None)
        np.testing.assert_array_equal(cut.trenches, whole.trenches)
        # Away from the borders, beyond which the ground is unknown.
        np.testing.assert_allclose(cut.slope[:, 20:61], whole.slope[:, 60:101], atol=1e-6)


def test_travel_cost_in_the_open_is_the_way_of_a_king() -> None:
    cost = travel_cost(np.ones((81, 41)), 2.0, np.array([7.0, 4.0]))
    assert cost.shape == (81, 41) and GRID == 0.1
    assert cost[70, 20] == 0.0
    assert cost[10, 20] == pytest.approx(6.0)
    assert cost[60, 10] == pytest.approx(np.sqrt(2.0))  # 1 m along each axis
    assert cost[50, 10] == pytest.approx(np.sqrt(2.0) + 1.0)


def test_travel_cost_leads_around_a_wall() -> None:
    # The wall leaves only a metre free, on the right.
    wall = np.where((np.abs(X - 4.0) < 0.11) & (Y > 3.0), 0.5, 0.0)[:, 40:121]
    cost = survey(wall, 2.0, np.array([7.0, 5.0])).cost
    assert cost is not None
    straight = 6.0
    assert straight + 1.0 < cost[10, 30] < straight + 5.0  # not through it, at 30 per metre


def test_low_steps_are_dear_unless_they_cannot_be_avoided() -> None:
    crate = np.where((np.abs(X - 4.0) < 0.3) & (np.abs(Y - 4.0) < 0.3), 0.15, 0.0)
    cost = survey(crate, 0.0, GOAL).cost
    assert cost is not None
    past, before = cost[30, 46], cost[30, 40]  # 0.6 m beside the middle of it, and before it
    assert past == pytest.approx(4.25 + 0.6 * (np.sqrt(2.0) - 1.0), abs=0.3)
    assert past < before < past + 1.0  # around it: over it a metre costs 6
    low = np.where(crate > 0.0, 0.08, 0.0)
    step = np.where(X > 4.0, 0.15, 0.0)
    assert survey(low, 0.0, GOAL).cost is None and survey(step, 0.0, GOAL).cost is None


def test_the_mirror_image_is_surveyed_alike() -> None:
    for family in ("pillar", "mixed", "clutter", "ditches", "tilt"):
        for tile in tiles(family, 10, 4):
            turned = tile.mirrored()
            one, two = (survey(t.heights, 0.0, t.goal) for t in (tile, turned))
            np.testing.assert_array_equal(one.trenches, two.trenches)
            np.testing.assert_allclose(one.slope, -two.slope[:, ::-1], atol=1e-6)
            assert (one.cost is None) == (two.cost is None)


def test_clearance_is_the_distance_from_pillars() -> None:
    near, wide = 0.05, 0.5
    for tile in tiles("pillar", 5):
        steps = np.zeros((161, 161), dtype=bool)
        rise = np.abs(np.diff(tile.heights, axis=0)) > 0.2
        aside = np.abs(np.diff(tile.heights, axis=1)) > 0.2
        steps[:-1] |= rise
        steps[1:] |= rise
        steps[:, :-1] |= aside
        steps[:, 1:] |= aside
        x, y = X[::2, ::2, None], Y[::2, ::2, None]
        px, py, diameter = tile.features.pillars.T
        truth = (np.hypot(x - px, y - py) - diameter / 2).min(axis=-1)
        free = (truth > near) & (truth < wide)
        error = (clearance(steps) - truth)[free]
        assert abs(error.mean()) < 0.015 and np.abs(error).max() < 0.05


def test_a_slope_ends_before_steps() -> None:
    """Stairs directly behind a slope: 15 cm at 4.5 m."""
    slope = np.where(X < 4.0, 0.3, 0.0) * (Y - 4.0) * np.clip((4.0 - X) / 0.5, 0.0, 1.0)
    found = survey(slope + np.where(X > 4.5, 0.15, 0.0), 0.0, GOAL).slope[:, 80]
    assert found[20:55] == pytest.approx(0.3, abs=0.02)
    assert (found[80:] == 0.0).all()
    without = survey(slope, 0.0, GOAL).slope[:, 80]
    assert (without[85:95] > 0.2).all()


def test_a_wall_across_the_corridor_is_walked_around_where_there_is_room() -> None:
    wall = np.where((np.abs(X - 4.0) < 0.11) & (np.abs(Y - 4.0) < 2.1), 0.5, 0.0)
    assert survey(wall, 0.0, GOAL).cost is not None
    assert survey(wall[:, 40:121], 2.0, GOAL).cost is None  # no way around on what is left


def test_a_trench_may_run_askew() -> None:
    askew = np.abs(X - 4.0 - 0.03 * (Y - 4.0)) < 0.1
    found = survey(np.where(askew, -0.6, 0.0), 0.0, GOAL)
    (lips,) = found.trenches
    assert lips[0] <= 4.0 - 0.1 - 0.03 * 1.6 and lips[1] >= 4.0 + 0.1 + 0.03 * 1.6
    assert lips[1] - lips[0] <= 0.45 and found.cost is None
    across = np.abs(X - 4.0 - 0.3 * (Y - 4.0)) < 0.1
    assert len(survey(np.where(across, -0.6, 0.0), 0.0, GOAL).trenches) == 0


def test_what_is_too_wide_or_does_not_reach_across_is_no_trench() -> None:
    for lips in (np.abs(X - 4.0) < 0.3, (np.abs(X - 4.0) < 0.1) & (Y < 5.0)):
        found = survey(np.where(lips, -0.6, 0.0), 0.0, GOAL)
        assert len(found.trenches) == 0
    shallow = survey(np.where(np.abs(X - 4.0) < 0.1, -0.15, 0.0), 0.0, GOAL)
    assert len(shallow.trenches) == 0 and shallow.cost is None
