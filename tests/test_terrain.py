"""Terrain tiles against the numbers of Sec. III-A and TDGC-Bench."""

import math
from dataclasses import FrozenInstanceError

import numpy as np
import pytest

from tdgc.sim.families import (
    ALL_FAMILIES,
    FAMILIES,
    PILLAR_DIAMETER,
    difficulty_parameter,
    draw_cylinders,
)
from tdgc.sim.terrain import EVAL_STREAM, TRAIN_STREAM, file_label, make_tile, tile_rng
from tdgc.sim.tile import HEIGHT_RANGE, WHOLE_ZONE, Section, Tile, TileField, draw_start_goal

DIFFICULTIES = [level / 10 for level in range(13)]
MIDDLE = 80  # sample at x = 4 m or y = 4 m


def tile(family: str, difficulty: float, seed: int = 0) -> Tile:
    return make_tile(family, difficulty, np.random.default_rng(seed))


@pytest.mark.parametrize(
    ("family", "at_0", "at_1", "at_12"),
    [
        ("rough", 0.01, 0.10, 0.118),
        ("pillar", 4, 24, 28),
        ("stair", 0.03, 0.15, 0.174),
        ("gap", 0.05, 0.30, 0.35),
        ("tilt", 0.0, 0.45, 0.54),
        ("clutter", 0.02, 0.15, 0.176),
    ],
)
def test_difficulty_parameter_is_affine(family, at_0, at_1, at_12):
    assert difficulty_parameter(family, 0) == at_0
    assert difficulty_parameter(family, 1) == pytest.approx(at_1, abs=1e-12)
    assert difficulty_parameter(family, 0.5) == pytest.approx((at_0 + at_1) / 2, abs=1e-12)
    assert difficulty_parameter(family, 1.2) == pytest.approx(at_12, abs=1e-12)


# What every tile shares


@pytest.mark.parametrize("family", ALL_FAMILIES)
@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_every_tile_is_flat_on_its_platforms_and_within_range(family, difficulty):
    for seed in range(3):
        made = tile(family, difficulty, seed)
        assert made.heights.shape == made.support.shape == (161, 161)
        assert made.heights.dtype == made.support.dtype == np.float32
        assert made.cell == 0.05 and made.family == family and made.difficulty == difficulty
        for surface in (made.heights, made.support):
            assert (surface[:26] == 0).all()  # x <= 1.25
            assert (surface[135:] == 0).all()  # x >= 6.75
            low, high = HEIGHT_RANGE
            assert low < surface.min() and surface.max() < high


def test_only_trenches_and_pillars_are_not_ground():
    for family in ("rough", "stair", "tilt"):
        made = tile(family, 1)
        np.testing.assert_array_equal(made.support, made.heights)
    for family in ("pillar", "gap"):
        made = tile(family, 1)
        assert made.heights.any() and not made.support.any()


def test_start_and_goal_fill_their_ranges():
    start, goal = draw_start_goal(np.random.default_rng(0), (10_000,))
    assert start.shape == (10_000, 3) and goal.shape == (10_000, 2)
    assert (start[:, 0] == 0.75).all() and (goal[:, 0] == 7.25).all()
    for drawn, low, high in [(start[:, 1], 3, 5), (start[:, 2], -0.5, 0.5), (goal[:, 1], 3, 5)]:
        assert low <= drawn.min() < low + 0.01 and high - 0.01 < drawn.max() <= high
    made = tile("rough", 0)
    assert made.start.shape == (3,) and made.goal.shape == (2,)
    assert made.start[0] == 0.75 and made.goal[0] == 7.25


@pytest.mark.parametrize("family", ALL_FAMILIES)
def test_same_seed_same_tile(family):
    one, same, other = tile(family, 0.7, 1), tile(family, 0.7, 1), tile(family, 0.7, 2)
    for name in ("heights", "support", "start", "goal"):
        np.testing.assert_array_equal(getattr(one, name), getattr(same, name))
    assert one.parts == same.parts
    assert (one.start != other.start).any()


@pytest.mark.parametrize("family", FAMILIES)
def test_layouts_differ_within_a_level_and_from_level_to_level(family):
    made = [tile(family, 1, seed).heights for seed in range(8)]
    different = {heights.tobytes() for heights in made}
    assert len(different) == (2 if family == "tilt" else 8)  # a slope falls left or right
    levels = {tile(family, level / 10, 3).heights.tobytes() for level in range(11)}
    assert len(levels) == 11


def test_a_tile_of_a_height_map(tmp_path):
    """In the zone it has the file's heights times the difficulty, blended in over 25 cm."""
    x = np.arange(161) / 20
    heights = 0.5 + 0.1 * x[:, None] - 0.05 * x
    name = str(tmp_path / "ramp.npy")
    np.save(name, heights)
    made = tile(name, 0.4)
    assert made.family == name and made.parts == (name,)
    np.testing.assert_allclose(made.heights[30:131], 0.4 * heights[30:131], atol=1e-6)
    np.testing.assert_allclose(made.heights[28], 0.4 * 0.6 * heights[28], atol=1e-6)  # 0.15 / 0.25
    assert (made.heights[:26] == 0.0).all() and (made.heights[135:] == 0.0).all()
    np.testing.assert_array_equal(made.support, made.heights)
    starts = [make_tile(f, 1.0, tile_rng(0, f, 10, 0)).start[1] for f in (name, "rough")]
    assert starts[0] != starts[1]
    assert make_tile(name, 1.0, tile_rng(0, name, 10, 0)).start[1] == starts[0]
    assert file_label("maps/my hills.npy") == "maps-my-hills.npy"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot be read as a NumPy file"),
        (b"no array", "cannot be read as a NumPy file"),
        (b"PK\x03\x04, half a zip", "cannot be read as a NumPy file"),
        (b"\x93NUMPY\x01\x00\x06\x00{'a(\n\n", "cannot be read as a NumPy file"),
        (np.zeros((161, 160)), r"must hold finite heights in m, an array \(161, 161\)$"),
        (np.full((161, 161), np.nan), "must hold finite heights"),
        (np.zeros((161, 161), dtype=bool), "must hold finite heights"),
        (np.array([{}], dtype=object), "cannot be read as a NumPy file: .*allow_pickle"),
        (np.full((161, 161), -128, dtype=np.int8), r"must stay within 2\.08333 m"),
        (np.full((161, 161), -2.1), r"must stay within 2\.08333 m of the platforms' height$"),
    ],
    ids=["none", "text", "zip", "header", "shape", "nan", "bool", "pickle", "int8", "deep"],
)
def test_a_height_map_that_cannot_be_used(content, message, tmp_path):
    path = tmp_path / "map.npy"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        np.save(path, content, allow_pickle=True)
    with pytest.raises(ValueError, match=message) as caught:
        tile(str(path), 1.0)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_a_tile_is_frozen():
    with pytest.raises(FrozenInstanceError):
        tile("rough", 0).family = "stair"


@pytest.mark.parametrize("difficulty", [-0.01, 1.21, math.nan, math.inf, -math.inf])
def test_bad_difficulty_names_the_range(difficulty):
    with pytest.raises(ValueError, match=r"difficulty must lie in \[0, 1\.2\], got"):
        tile("rough", difficulty)
    with pytest.raises(ValueError, match=r"difficulty must lie in"):
        difficulty_parameter("rough", difficulty)


def test_bad_family_names_the_families():
    with pytest.raises(ValueError, match=r"'stairs'; choose from rough, .*, ditches, FILE\.npy$"):
        tile("stairs", 0.5)
    with pytest.raises(
        ValueError, match=r"'mixed' has no parameter; choose from rough, .*, clutter$"
    ):
        difficulty_parameter("mixed", 0.5)


# Family by family


@pytest.mark.parametrize(("difficulty", "amplitude"), [(0, 0.01), (0.5, 0.055), (1, 0.10)])
def test_rough_is_zero_mean_and_reaches_its_amplitude(difficulty, amplitude):
    for seed in range(5):
        heights = tile("rough", difficulty, seed).heights
        zone = heights[30:131].astype(float)
        assert abs(zone.mean()) < 1e-6
        assert np.abs(zone).max() == pytest.approx(amplitude, rel=1e-6)
        assert np.abs(heights).max() <= np.float32(amplitude)
        assert zone.std() > 0.2 * amplitude  # noise, not one peak


def test_rough_is_bilinear_on_a_lattice_of_five_spacings():
    """Second differences along x vanish except at evenly spaced nodes, and all spacings occur."""
    found = set()
    for seed in range(40):
        zone = tile("rough", 1, seed).heights[30:131].astype(float)
        bends = np.abs(np.diff(zone, 2, axis=0)).max(axis=1) > 1e-6  # at samples 31 to 129
        spacings = set(np.diff(np.flatnonzero(bends)))
        found.add(min(spacings))
        assert spacings <= {min(spacings)}  # evenly spaced nodes
    assert found == {2, 3, 4, 5, 6}  # cells: 0.1 to 0.3 m


def test_rough_blends_in_and_out_linearly():
    blended = tile("rough", 1).heights
    weights = np.abs(blended).max(axis=1) / 0.10
    for near, far in [(25, 135), (26, 134), (27, 133), (28, 132), (29, 131)]:
        limit = (near - 25) / 5
        assert weights[near] <= limit + 1e-6 and weights[far] <= limit + 1e-6
        assert (limit == 0) or (weights[near] > limit / 3 and weights[far] > limit / 3)


@pytest.mark.parametrize(
    ("difficulty", "count"), [(0, 4), (0.5, 14), (1, 24), (1.1, 26), (1.2, 28)]
)
def test_pillar_count_and_height(difficulty, count):
    heights = tile("pillar", difficulty).heights
    assert set(np.unique(heights)) == {np.float32(0), np.float32(0.8)}
    assert (heights[:31] == 0).all() and (heights[130:] == 0).all()
    assert count_blobs(heights > 0) == count


def test_pillars_keep_clear_and_inside():
    for seed in range(40):
        x, y, d = draw_cylinders(WHOLE_ZONE, 28, PILLAR_DIAMETER, np.random.default_rng(seed)).T
        assert len(x) == 28
        assert d.min() >= 0.2 and d.max() <= 0.4 and np.ptp(d) > 0.1
        assert (x - d / 2).min() >= 1.5 and (x + d / 2).max() <= 6.5
        assert (y - d / 2).min() >= 0 and (y + d / 2).max() <= 8
        way = np.hypot(x[:, None] - x, y[:, None] - y) - (d[:, None] + d) / 2
        assert way[~np.eye(28, dtype=bool)].min() >= 0.6


def test_pillars_that_cannot_fit_raise():
    narrow = Section(1.5, 1.5, 2.0, 2.0)
    with pytest.raises(RuntimeError, match=r"no room for 28 cylinders"):
        draw_cylinders(narrow, 28, PILLAR_DIAMETER, np.random.default_rng(0))


@pytest.mark.parametrize(("difficulty", "step"), [(0, 0.02), (0.5, 0.085), (1, 0.15)])
def test_clutter_has_low_steps_and_things_to_walk_around(difficulty, step):
    kinds = set()
    for seed in range(60):
        made = tile("clutter", difficulty, seed)
        ground = made.support.astype(float)
        rises = np.concatenate([np.diff(ground, axis=0).ravel(), np.diff(ground, axis=1).ravel()])
        assert np.abs(rises).max() <= step + 0.05 * 3.0 * step + 1e-6  # plus the slope of a cell
        x, y, d = made.features.pillars.T
        obstacle = made.heights != made.support
        assert set(np.unique(made.heights[obstacle])) <= {np.float32(0.8), np.float32(-0.6)}
        ix, iy = np.nonzero(obstacle)
        away = np.hypot(0.05 * ix[:, None] - x, 0.05 * iy[:, None] - y) - d / 2
        assert (away.min(axis=1) <= 1e-9).all() if ix.size else len(x) == 0
        kinds.update(np.unique(made.heights[obstacle]).tolist() or ["none"])
    assert kinds == {"none", *np.float32([0.8, -0.6]).tolist()}  # posts and walls; pits


def test_ways_through_clutter_are_as_wide_as_between_pillars():
    for seed in range(40):
        x, y, d = tile("clutter", 1, seed).features.pillars.T
        away = np.hypot(x[:, None] - x, y[:, None] - y) - (d[:, None] + d) / 2
        joined = away < 0.0  # neighbours in a wall
        for _ in range(12):
            joined = (joined.astype(int) @ joined) > 0
        assert away[~joined].min(initial=np.inf) >= 0.6 - 1e-9


def test_ditches_are_trenches_before_or_behind_clutter():
    orders, obstacles, starts = [], 0, []
    for seed in range(40):
        made = tile("ditches", 1, seed)
        lips, x = made.features.trenches, made.features.pillars[:, 0]
        middle = lips.mean(axis=1)
        assert 1 <= len(lips) <= 4 and (np.diff(middle) >= 0.75 - 0.05).all()
        for lip in lips:  # across the whole tile
            inside = made.heights[round(lip.mean() / 0.05)]
            assert (inside == np.float32(-0.6)).all()
        behind = made.parts == ("clutter", "gap")
        assert behind or made.parts == ("gap", "clutter")
        if behind:
            assert (x < lips[0, 0]).all() and lips[-1, 1] <= 6.5 - 0.3 + 0.25
        else:
            assert (x > lips[-1, 1]).all() and lips[0, 0] >= 1.5 + 0.3 - 0.25
        orders.append(behind)
        obstacles += len(x)
        starts.append(lips[0, 0])
    assert 10 <= sum(orders) <= 30 and obstacles > 40
    assert min(starts) < 2.0 and max(starts) > 4.0


@pytest.mark.parametrize(("difficulty", "step"), [(0, 0.03), (0.5, 0.09), (1, 0.15), (1.2, 0.174)])
def test_stairs(difficulty, step):
    counts = set()
    for seed in range(60):
        made = tile("stair", difficulty, seed)
        assert (made.heights == made.heights[:, :1]).all()  # the same across the tile
        rise = np.diff(made.heights[:, 0].astype(float))
        up, down = np.flatnonzero(rise > 1e-6), np.flatnonzero(rise < -1e-6)  # one cell each
        np.testing.assert_allclose(rise[up], step, atol=1e-6)
        np.testing.assert_allclose(rise[down], -step, atol=1e-6)
        assert len(up) == len(down) >= 5 and up[-1] < down[0]
        assert 30 <= up[0] and down[-1] <= 129  # in the zone
        treads = np.concatenate([np.diff(up), np.diff(down)])
        assert set(treads) <= {5, 6, 7, 8} and len(set(treads)) > 1
        assert down[0] - up[-1] - 1 >= 6  # level cells between: 0.3 m
        # There is no room for another step on each side.
        assert down[-1] - up[0] + 1 + 10 > 100 - 16 and len(up) <= 10
        risers = made.features.risers
        np.testing.assert_allclose(risers[:, 0], 0.05 * (np.concatenate([up, down]) + 0.5))
        np.testing.assert_allclose(risers[:, 1], np.repeat([step, -step], len(up)))
        counts.add(len(up))
    assert counts >= {7, 8}


@pytest.mark.parametrize("level", range(13))
def test_gap_trenches(level):
    width = difficulty_parameter("gap", level / 10)
    cells, counts, places = [], set(), []
    for seed in range(100):
        made = tile("gap", level / 10, seed)
        assert (made.heights == made.heights[:, :1]).all()  # across the whole tile
        profile = made.heights[:, 0]
        assert set(np.unique(profile)) == {np.float32(-0.6), np.float32(0)}
        fall, rise = np.flatnonzero(np.diff(profile) < 0), np.flatnonzero(np.diff(profile) > 0)
        np.testing.assert_allclose(made.features.trenches, 0.05 * np.stack([fall, rise + 1], 1))
        centres = made.features.trenches.mean(axis=1)
        assert 3 <= len(centres) <= 5 and np.diff(centres).min() >= 0.75 - 1e-9
        assert centres.min() >= 1.8 - 1e-9 and centres.max() <= 6.2 + 1e-9
        cells += list(rise - fall)  # width at half depth
        counts.add(len(centres))
        places += list(centres)
    assert set(cells) <= {math.floor(width / 0.05 + 1e-9), math.ceil(width / 0.05 - 1e-9)}
    assert 0.05 * np.mean(cells) == pytest.approx(width, abs=0.005)
    assert counts == {3, 4, 5} and min(places) < 1.9 and max(places) > 6.1


def test_tilt_slopes_to_either_side_and_blends_over_half_a_metre():
    assert not tile("tilt", 0).heights.any()
    sides = []
    for seed in range(40):
        made = tile("tilt", 1, seed)
        side = np.sign(made.heights[80, 160])
        sides.append(side)
        assert made.features.slope == pytest.approx(0.45 * side)
        heights, slope = side * made.heights, math.tan(0.45)
        for ix in (35, 60, 80, 125):  # x = 1.75 ... 6.25
            assert heights[ix, 0] == pytest.approx(-4 * slope, abs=1e-6)
            assert heights[ix, 80] == 0
            assert heights[ix, 160] == pytest.approx(4 * slope, abs=1e-6)
        ramp = np.arange(11) / 10 * slope  # at y = 5, x = 1.25 ... 1.75
        np.testing.assert_allclose(heights[25:36, 100], ramp, atol=1e-6)
        np.testing.assert_allclose(heights[125:136, 100], ramp[::-1], atol=1e-6)
    assert 10 <= sides.count(1.0) <= 30 and len(set(sides)) == 2


def test_pillars_are_where_the_tile_says():
    made = tile("pillar", 1)
    x, y, diameter = made.features.pillars.T
    grid = np.arange(161) * 0.05
    away = np.hypot(grid[:, None, None] - x, grid[None, :, None] - y) - diameter / 2
    np.testing.assert_array_equal(made.heights > 0, (away <= 1e-12).any(axis=-1))


@pytest.mark.parametrize(("family", "difficulty"), [("pillar", 1), ("tilt", 0.5), ("mixed", 0.8)])
def test_a_mirrored_tile_has_left_and_right_exchanged(family, difficulty):
    made = tile(family, difficulty)
    turned = made.mirrored()
    np.testing.assert_array_equal(turned.heights, made.heights[:, ::-1])
    np.testing.assert_array_equal(turned.support, made.support[:, ::-1])
    assert turned.start == pytest.approx([0.75, 8 - made.start[1], -made.start[2]])
    assert turned.goal == pytest.approx([7.25, 8 - made.goal[1]])
    assert turned.features.slope == -made.features.slope
    np.testing.assert_array_equal(turned.features.trenches, made.features.trenches)
    x, y, diameter = turned.features.pillars.T  # they match the heights
    grid = np.arange(161) * 0.05
    away = np.hypot(grid[:, None, None] - x, grid[None, :, None] - y) - diameter / 2
    if family == "pillar":
        np.testing.assert_array_equal(turned.heights > 0, (away <= 1e-12).any(axis=-1))
    twice = turned.mirrored()
    assert twice.start == pytest.approx(made.start) and twice.heights is not turned.heights
    np.testing.assert_allclose(twice.features.pillars, made.features.pillars)


# Mixed


def family_of(half: np.ndarray) -> str:
    """Identify the family from the heights of half a zone at d = 0.8."""
    if half.min() == np.float32(-0.6):
        return "gap"
    if (half == half[:, :1]).all():
        return "stair"
    if half.max() == np.float32(0.8) and half.min() == 0:
        return "pillar"
    return "tilt" if half.max() > 1 else "rough"


def test_mixed_is_two_different_families_half_a_zone_each():
    pairs = set()
    for seed in range(120):
        made = tile("mixed", 0.8, seed)
        halves = made.heights[30:81], made.heights[80:131]
        assert made.parts == tuple(family_of(half) for half in halves)
        assert (made.heights[MIDDLE] == 0).all()  # level where they meet
        pairs.add(made.parts)
    assert pairs == {(a, b) for a in FAMILIES for b in FAMILIES if a != b}  # all 20


def mixed_half(family: str, difficulty: float) -> np.ndarray:
    """Heights of the first half of the first tile that has ``family`` there."""
    seeds = (s for s in range(1000) if tile("mixed", difficulty, s).parts[0] == family)
    return tile("mixed", difficulty, next(seeds)).heights[:81]


def test_mixed_halves_have_the_same_parameters():
    rough_half = mixed_half("rough", 1)[30:76].astype(float)  # up to where it blends out
    assert np.abs(rough_half).max() == pytest.approx(0.10, rel=1e-6)
    assert abs(rough_half.mean()) < 1e-6
    assert count_blobs(mixed_half("pillar", 1) > 0) == 12  # half the zone, half of 24
    stair_half = mixed_half("stair", 1)[:, 0]
    rise = np.diff(stair_half)
    assert 3 <= (rise > 0).sum() == (rise < 0).sum() <= 5
    np.testing.assert_allclose(rise[rise > 0], 0.15, atol=1e-6)
    gap_half = mixed_half("gap", 1)[:, 0]
    assert (np.diff(gap_half) < 0).sum() == 2
    tilt_half = np.abs(mixed_half("tilt", 1)[:, 100])
    np.testing.assert_allclose(tilt_half[35:71], math.tan(0.45), atol=1e-6)
    np.testing.assert_allclose(
        tilt_half[70:], np.arange(10, -1, -1) / 10 * math.tan(0.45), atol=1e-6
    )


def test_mixed_has_the_features_of_both_halves():
    for seed in range(60):
        made = tile("mixed", 1, seed)
        for part, (low, high) in zip(made.parts, ((1.5, 4.0), (4.0, 6.5)), strict=True):
            found = made.features
            if part == "gap":
                assert len(found.trenches) == 2
                assert low < found.trenches.min() and found.trenches.max() < high
            elif part == "stair":
                assert low < found.risers[:, 0].min() and found.risers[:, 0].max() < high
            elif part == "pillar":
                assert len(found.pillars) == 12
                assert low < found.pillars[:, 0].min() and found.pillars[:, 0].max() < high
            elif part == "tilt":
                assert abs(found.slope) == pytest.approx(0.45)


def test_mixed_support_drops_only_trenches_and_pillars():
    for seed in range(60):
        made = tile("mixed", 1, seed)
        for part, half in zip(made.parts, (slice(None, 81), slice(80, None)), strict=True):
            ground = 0 if part in ("gap", "pillar") else made.heights[half]
            assert (made.support[half] == ground).all()


# Seeds


def test_streams_and_tiles_have_their_own_seeds():
    keys = [
        (seed, family, level, index, stream)
        for seed in (0, 1)
        for family in ("rough", "gap")
        for level in (0, 10)
        for index in (0, 1)
        for stream in (TRAIN_STREAM, EVAL_STREAM)
    ]
    assert len({tile_rng(*key).random() for key in keys}) == len(keys)
    assert tile_rng(7, "rough", 3, 5).random() == tile_rng(7, "rough", 3, 5, TRAIN_STREAM).random()


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_seeds_must_be_one_word(seed):
    with pytest.raises(ValueError, match=r"must lie in \[0, 2\*\*32\)"):
        tile_rng(seed, "rough", 0, 0)


# The grid


@pytest.fixture(scope="module")
def grid() -> TileField:
    """Three tiles, 1 m of which is cut off on both sides."""
    field = TileField(3, crop=1.0)
    for k, tile in enumerate(tiles()):
        field.place(k, tile)
    return field


def tiles() -> list[Tile]:
    kinds = ("stair", 2), ("rough", 7), ("gap", 5)
    return [make_tile(name, level / 10, tile_rng(3, name, level, 0)) for name, level in kinds]


def test_a_field_holds_its_tiles_one_behind_the_other(grid):
    assert grid.count == 3 and grid.heights.shape == grid.support.shape == (483, 121)
    assert grid.heights.dtype == np.float32 and grid.heights.flags.c_contiguous
    for k, made in enumerate(tiles()):
        where = slice(161 * k, 161 * (k + 1))
        np.testing.assert_array_equal(grid.heights[where], made.heights[:, 20:141])
        np.testing.assert_array_equal(grid.support[where], made.support[:, 20:141])
        np.testing.assert_array_equal(grid.starts[k], made.start)
        np.testing.assert_array_equal(grid.goals[k], made.goal)
        np.testing.assert_array_equal(grid.features[k].trenches, made.features.trenches)
        np.testing.assert_allclose(grid.origin(k), [8.05 * k, -1.0])


def test_a_field_of_tiles_cannot_change():
    field = TileField.of(*tiles())
    np.testing.assert_array_equal(field.heights[161:322], tiles()[1].heights)
    with pytest.raises(ValueError, match="read-only"):
        field.place(0, tiles()[1])


def test_origin_takes_arrays(grid):
    np.testing.assert_allclose(grid.origin([0, 2]), [[0, -1], [16.1, -1]])


def test_on_tile(grid):
    x = 8.05 + np.array([-0.01, 0.01, 7.99, 8.01, 4.0, 4.0, 4.0])
    y = np.array([3.0, 3.0, 3.0, 3.0, -0.01, 0.01, 6.01])
    expected = [False, True, True, False, False, True, False]
    assert grid.on_tile(1, x, y).tolist() == expected
    np.testing.assert_array_equal(grid.on_tile([1, 0], 12.0, 3.0), [True, False])


def test_a_tile_takes_anothers_place_in_the_same_buffers():
    field = TileField(2)
    heights, support = field.heights, field.support
    tiles = [make_tile("rough", 0.3, tile_rng(1, "rough", 3, index)) for index in (0, 1)]
    for tile in tiles:
        field.place(1, tile)
    assert field.heights is heights and field.support is support
    np.testing.assert_array_equal(heights[161:], tiles[1].heights)
    assert (heights[:161] == 0.0).all()


def test_tiles_of_training_and_evaluation_differ():
    train, held_out = (
        make_tile("rough", 0.5, tile_rng(0, "rough", 5, 0, stream))
        for stream in (TRAIN_STREAM, EVAL_STREAM)
    )
    assert (train.heights[30:131] != held_out.heights[30:131]).mean() > 0.9


def test_height_at_follows_bullets_triangles():
    grid = TileField(1)
    # One cell with corners a = [4, 6], b = [5, 6], c = [4, 7], e = [5, 7]; its diagonal is b-c.
    a, b, c, e = 0.1, 0.3, -0.2, 0.7
    grid.heights[4:6, 6:8] = [[a, c], [b, e]]
    grid.support[4:6, 6:8] = 1
    x, y = 4 * 0.05, 6 * 0.05
    u, v = (
        np.array([0.0, 1.0, 0.0, 1.0, 0.2, 0.5, 0.8]),
        np.array([0.0, 0.0, 1.0, 1.0, 0.4, 0.5, 0.6]),
    )
    expected = [
        *(a, b, c, e),
        a + 0.2 * (b - a) + 0.4 * (c - a),  # triangle a, b, c
        (b + c) / 2,  # on the diagonal
        e + 0.2 * (c - e) + 0.4 * (b - e),  # triangle e, c, b
    ]
    np.testing.assert_allclose(grid.height_at(x + 0.05 * u, y + 0.05 * v), expected, atol=1e-6)
    np.testing.assert_allclose(grid.support_at(x + 0.05 * u, y + 0.05 * v), 1, atol=1e-6)
    assert grid.height_at(x + 0.01, y + 0.02) == pytest.approx(expected[4], abs=1e-6)
    assert grid.height_at(np.full((5, 2), x), np.full((5, 2), y)).shape == (5, 2)


def test_there_is_no_height_where_a_robot_that_blew_up_is(grid):
    nan = math.nan
    found = grid.height_at(np.array([nan, 1.0, nan, 1.0]), np.array([nan, nan, 1.0, 1.0]))
    assert np.isnan(found).tolist() == [True, True, True, False]


def test_height_at_hits_every_sample_and_clamps_outside(grid):
    ix, iy = np.meshgrid(np.arange(483), np.arange(121), indexing="ij")
    np.testing.assert_allclose(grid.height_at(ix * 0.05, iy * 0.05), grid.heights, atol=1e-6)
    grid = TileField(1)
    grid.heights[0, 0], grid.heights[-1, -1], grid.heights[80, -1] = 1, 2, 3
    assert grid.height_at(-5.0, -5.0) == pytest.approx(1)
    assert grid.height_at(99.0, 99.0) == pytest.approx(2)
    assert grid.height_at(4.0, 99.0) == pytest.approx(3)


def count_blobs(mask: np.ndarray) -> int:
    """Number of 4-connected regions."""
    left, blobs = {tuple(i) for i in np.argwhere(mask)}, 0
    while left:
        blobs, edge = blobs + 1, [left.pop()]
        while edge:
            i, j = edge.pop()
            near = {(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)} & left
            left -= near
            edge += near
    return blobs
