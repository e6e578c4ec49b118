"""Training tiles: when new ones are drawn, and that their numbers suffice to redraw them."""

import numpy as np
import pytest

from tdgc.sim.terrain import make_tile, tile_rng
from tdgc.tasks.tiles import FLAT, TrainingTiles, check_tiles, left_out

FAMILIES = ("stair", FLAT, "rough")
ALL = np.arange(3)
LEVELS = np.array([4, 5, 6])


def heights(tiles: TrainingTiles, robot: int) -> np.ndarray:
    return tiles.field.heights[161 * robot : 161 * (robot + 1)].copy()


def test_each_robot_has_a_tile_of_its_own() -> None:
    tiles = TrainingTiles(FAMILIES, seed=9)
    tiles.draw(ALL, LEVELS)
    for number, robot in enumerate((0, 2)):
        family, level = FAMILIES[robot], int(LEVELS[robot])
        tile = make_tile(family, level / 10, tile_rng(9, family, level, number))
        np.testing.assert_array_equal(heights(tiles, robot), tile.heights[:, 40:121])
    assert (heights(tiles, 1) == 0.0).all() and tiles.drawn == 2


def test_trenches_may_be_shallower_on_low_levels() -> None:
    for shallowest, depths in ((None, (0.6, 0.6)), (0.04, (0.18, 0.6))):  # 0.04 + 0.25 * 0.56
        tiles = TrainingTiles(("gap", "gap"), 9, shallowest)
        tiles.draw(np.array([0, 1]), np.array([5, 10]))
        assert [-heights(tiles, robot).min() for robot in (0, 1)] == pytest.approx(depths)


def test_a_tile_serves_five_episodes_of_a_level() -> None:
    tiles = TrainingTiles(FAMILIES, seed=0)
    tiles.draw(ALL, LEVELS)
    first = [heights(tiles, robot) for robot in ALL]
    assert [tiles.begin(ALL, LEVELS).tolist() for _ in range(5)] == [[]] * 5
    assert tiles.begin(np.array([1, 2]), LEVELS).tolist() == [2]  # flat tiles are not redrawn
    assert tiles.begin(np.array([2]), LEVELS).tolist() == []
    higher = LEVELS + [1, 1, 0]
    assert tiles.begin(ALL, higher).tolist() == [0]
    assert tiles.level[[0, 2]].tolist() == [5, 6] and tiles.number[[0, 2]].tolist() == [3, 2]
    changed = [(heights(tiles, robot) != first[robot]).any() for robot in ALL]
    assert changed == [True, False, True] and tiles.drawn == 4
    # After five episodes the robot gets another tile of the same level.
    seen = [tiles.begin(np.array([0]), higher).tolist() for _ in range(5)]
    assert seen == [[]] * 4 + [[0]] and tiles.number[0] == 4 and tiles.episodes[0] == 1


def test_numbers_are_enough_to_draw_the_tiles_again() -> None:
    tiles = TrainingTiles(FAMILIES, seed=3)
    tiles.draw(ALL, LEVELS)
    for _ in range(7):
        tiles.begin(np.array([0, 2]), LEVELS)
    state = tiles.state_dict()
    other = TrainingTiles(FAMILIES, seed=3)
    other.draw(ALL, LEVELS + 1)
    other.load_state_dict(state)
    np.testing.assert_array_equal(other.field.heights, tiles.field.heights)
    np.testing.assert_array_equal(other.field.support, tiles.field.support)
    for a, b in ((tiles, other), (other, tiles)):
        assert a.begin(np.array([2]), LEVELS).tolist() == []
        assert (a.state_dict()["number"] == b.state_dict()["number"]).all()


def test_with_few_robots_families_are_left_out() -> None:
    families = ("stair", "stair", "gap", "tilt")
    assert [left_out(families, n) for n in (2, 3, 4)] == [["gap", "tilt"], ["tilt"], []]


def test_mixed_is_kept_for_evaluation() -> None:
    check_tiles(("stair", "gap"), 11)
    with pytest.raises(ValueError, match="must not name 'mixed', which is kept for evaluation"):
        check_tiles(("stair", "mixed"), 11)


@pytest.mark.parametrize("levels", [0, 12])
def test_the_number_of_levels_is_limited(levels: int) -> None:
    check_tiles(("stair",), 1)
    with pytest.raises(ValueError, match=f"must be from 1 to 11, not {levels}"):
        check_tiles(("stair",), levels)
