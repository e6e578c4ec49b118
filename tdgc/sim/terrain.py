"""Terrain tiles (Sec. III-A), in plain numpy.

A tile is a height field h(x, y) of 8 m x 8 m; x is the direction of travel. Its layout along x is

    0      1.25   1.5                                     6.5   6.75      8 m
    | start | band |             challenge zone            | band | goal |

and one number, the difficulty d, scales one geometric parameter per family (Eq. 1). The parameter
is exact; the layout is drawn for each tile from its own generator. Ranges and shapes are those of
TDGC-Bench 2. A tile lists its features (trenches, risers, pillars, slope), for the low policy's
training, the diagnosis, and to test what reads them from the heights. All lengths are in m, all
angles in rad. Arrays are indexed [ix, iy]; sample [ix, iy] lies at (ix * CELL, iy * CELL).
"""

import dataclasses
import functools
import math
import re
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tdgc.errors import InputError

FloatArray = NDArray[np.float64]
HeightArray = NDArray[np.float32]

#: Edition of TDGC-Bench that these tiles belong to; it draws a layout for every tile.
EDITION = 2

# Families and levels: Sec. III-A. Mixed and the levels above 10 are for evaluation only.
FAMILIES = ("rough", "pillar", "stair", "gap", "tilt")
#: Training families outside the benchmark: many kinds of ground without a name of their own, and
#: the same with trenches before or behind it.
CLUTTER, DITCHES = "clutter", "ditches"
UNNAMED = (CLUTTER, DITCHES)
ALL_FAMILIES = (*FAMILIES, "mixed", *UNNAMED)
#: A family name with this ending is the path of a user's height map, see ``height_map``.
MAP_ENDING = ".npy"
MAX_LEVEL = 10  # the hardest level of the curriculum, d = 1
OOD_LEVELS = (11, 12)  # out of distribution, d = 1.1 and 1.2
MAX_DIFFICULTY = OOD_LEVELS[-1] / MAX_LEVEL

# The tile (TDGC-Bench, "Tile").
TILE_SIZE = 8.0  # m, in x and y; the paper's W
CELL = 0.05  # m, grid resolution
TILE_SAMPLES = round(TILE_SIZE / CELL) + 1  # 161 per side: both edges carry samples
START_END = 1.25  # m, the start platform is x in [0, 1.25], at h = 0
GOAL_BEGIN = 6.75  # m, the goal platform is x in [6.75, 8], at h = 0
ZONE = (1.5, 6.5)  # m, the challenge zone in x
BAND = 0.25  # m, transition band between platform and zone
TILT_BAND = 0.5  # m, Tilt's wider band, half of it inside the zone
START_X, GOAL_X = 0.75, 7.25  # m
Y_SPREAD = 1.0  # m, start and goal: y uniform in W/2 +- 1
YAW_SPREAD = 0.5  # rad, start: yaw uniform in +- 0.5

# p_min and p_max of Eq. (1), at d = 0 and d = 1 (TDGC-Bench, table of families).
PARAMETER_RANGES: dict[str, tuple[float, float]] = {
    "rough": (0.01, 0.10),  # amplitude A, m
    "pillar": (4.0, 24.0),  # number of cylinders in a whole zone
    "stair": (0.03, 0.15),  # step height h_s, m
    "gap": (0.05, 0.30),  # mean gap width w, m
    "tilt": (0.0, 0.45),  # lateral slope angle theta, rad
    CLUTTER: (0.02, 0.15),  # greatest step height, m; at d = 1 that of Stair
}

# Ranges that layouts are drawn from, the same at every difficulty (same table).
LATTICES = (0.1, 0.15, 0.2, 0.25, 0.3)  # m, spacing of the Rough noise
TREAD_CELLS = (5, 8)  # cells, shortest and longest tread: 0.25-0.40 m
LANDING_CELLS = 6  # cells, shortest landing between up and down: 0.30 m
TRENCHES = (3, 5)  # least and greatest number in a whole zone
TRENCH_SPACING = 0.75  # m, minimum distance between two centres
TRENCH_MARGIN = 0.3  # m, minimum distance of a centre from the ends of the zone
TRENCH_DEPTH = 0.6  # m
PILLAR_DIAMETER = (0.2, 0.4)  # m
PILLAR_HEIGHT = 0.8  # m
PILLAR_CLEARANCE = 0.6  # m, minimum free space between any two

# Clutter is our own addition. Its ranges cover what robots of this size may meet; obstacles leave
# as much free space as pillars.
WAVES = 3  # number of plane waves that make up its hills
WAVE_LENGTH = (1.0, 3.0)  # m
WAVE_SLOPE = 3.0  # 1/m, steepest slope per step height: a slope of 0.45 at d = 1
PAVING = (0.2, 0.5)  # m, side lengths of its paving stones
SLABS = 60  # greatest number of slabs and bars
SLAB_SIDE = (0.1, 1.0)  # m
OBSTACLE_DIAMETER = (0.2, 0.6)  # m, of posts and pits
OBSTACLES = (4, 14)  # least and greatest number of posts or pits
WALL_LENGTH = (0.4, 1.2)  # m
WALLS = (2, 6)  # least and greatest number
WALL_THICKNESS = 0.2  # m

# Ditches are, too. Even the shortest part has room for two trenches, or for four of Stair's
# risers.
SHORTEST_PART = 1.5  # m

# Bullet keeps the height range of a field's first upload, so it is fixed to what any tile can need:
# Tilt at level 12 reaches W/2 tan(0.54 rad) = 2.40 m up and down, all other families less.
HEIGHT_RANGE = (-2.5, 2.5)  # m

# First entry of every tile's seed. It differs between the streams, so that no training tile is ever
# an evaluation tile, whatever the seeds. Any two different values would do.
TRAIN_STREAM = 1
EVAL_STREAM = 2

_X = np.arange(TILE_SAMPLES) / round(1 / CELL)  # m; i / 20 rounds correctly, i * 0.05 may not
_PLANE: FloatArray = np.stack(np.meshgrid(_X, _X, indexing="ij"))  # (2, 161, 161) m, x and y
_TURN = (0.0, 2.0 * math.pi)  # rad


class Section(NamedTuple):
    """A stretch of the tile along x that one family fills, in m.

    The family's features lie in [begin, end]. Families that change every sample blend in from h = 0
    at ``low`` and out to h = 0 at ``high``; for the whole zone these include the transition bands.
    """

    low: float
    begin: float
    end: float
    high: float


WHOLE_ZONE = Section(START_END, *ZONE, GOAL_BEGIN)


def halves(meet: float) -> tuple[Section, Section]:
    """Split the zone at x = ``meet`` m, where both parts are level with the platforms."""
    begin, end = ZONE
    return Section(START_END, begin, meet, meet), Section(meet, meet, end, GOAL_BEGIN)


@dataclass(frozen=True, eq=False)
class Features:
    """Features of a tile, in the tile's frame; trenches and risers in order from start to goal.

    Attributes:
        trenches: (k, 2) m, x of both lips of each trench, where its walls meet the ground.
        risers: (k, 2) m, x of the middle of each riser, and how far the ground rises there
            (negative going down).
        pillars: (k, 3) m, x and y of the axis of each cylinder, and its diameter. In Clutter they
            represent all obstacles that must be walked around.
        slope: rad, lateral; positive where the ground rises to the left.
    """

    trenches: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    risers: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    pillars: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    slope: float = 0.0

    def __add__(self, other: "Features") -> "Features":
        """Combine two stretches of one tile; at most one of them has a slope."""
        return Features(
            np.vstack([self.trenches, other.trenches]),
            np.vstack([self.risers, other.risers]),
            np.vstack([self.pillars, other.pillars]),
            self.slope or other.slope,
        )


@dataclass(frozen=True, eq=False)
class Tile:
    """One terrain tile in its own frame: sample [0, 0] at (0, 0).

    Attributes:
        heights: (161, 161) m, the collision surface h(x, y).
        support: (161, 161) m, the surface that the fall rule measures from: ``heights`` with
            trenches filled and pillars removed.
        start: (3,), x, y in m and yaw in rad.
        goal: (2,) m, x and y.
        family: one of ``ALL_FAMILIES``, or the path of a height map.
        difficulty: d.
        parts: the families along x: ``(family,)``, or the two parts of Mixed or Ditches.
        features: its trenches, risers, pillars and slope.
        cell: m, grid resolution.
    """

    heights: HeightArray
    support: HeightArray
    start: FloatArray
    goal: FloatArray
    family: str
    difficulty: float
    parts: tuple[str, ...]
    features: Features = field(default_factory=Features)
    cell: float = CELL

    def mirrored(self) -> "Tile":
        """The same tile with left and right exchanged."""
        found, turned = self.features, np.array([1.0, -1.0, -1.0])
        pillars = found.pillars.copy()
        pillars[:, 1] = TILE_SIZE - pillars[:, 1]
        return dataclasses.replace(
            self,
            heights=self.heights[:, ::-1],
            support=self.support[:, ::-1],
            start=np.array([0.0, TILE_SIZE, 0.0]) + turned * self.start,
            goal=np.array([0.0, TILE_SIZE]) + turned[:2] * self.goal,
            features=dataclasses.replace(found, pillars=pillars, slope=-found.slope),
        )


def difficulty_parameter(family: str, difficulty: float) -> float:
    """Geometric parameter p(d) = p_min + d (p_max - p_min) of a family (Eq. 1).

    Mixed and Ditches have no parameter: each of their parts uses that of its family.

    Raises:
        ValueError: a family without a parameter, or a difficulty outside [0, 1.2].
    """
    if family not in PARAMETER_RANGES:
        allowed = ", ".join(PARAMETER_RANGES)
        raise ValueError(f"{family!r} has no parameter; choose from {allowed}")
    _check_difficulty(difficulty)
    p_min, p_max = PARAMETER_RANGES[family]
    return p_min + difficulty * (p_max - p_min)


def draw_start_goal(
    rng: np.random.Generator, shape: tuple[int, ...] = ()
) -> tuple[FloatArray, FloatArray]:
    """Draw starts (*shape, 3), x, y and yaw, and goals (*shape, 2), x and y, in a tile's frame."""
    start, goal = np.empty((*shape, 3)), np.empty((*shape, 2))
    start[..., 0], goal[..., 0] = START_X, GOAL_X
    start[..., 1] = TILE_SIZE / 2 + rng.uniform(-Y_SPREAD, Y_SPREAD, shape)
    start[..., 2] = rng.uniform(-YAW_SPREAD, YAW_SPREAD, shape)
    goal[..., 1] = TILE_SIZE / 2 + rng.uniform(-Y_SPREAD, Y_SPREAD, shape)
    return start, goal


def make_tile(family: str, difficulty: float, rng: np.random.Generator) -> Tile:
    """Generate one tile.

    Args:
        family: one of ``ALL_FAMILIES``, or the path of a height map, whose heights are multiplied
            by d.
        difficulty: d in [0, 1.2], level / 10; the curriculum ends at 1.
        rng: the only source of randomness: the same state gives the same tile.

    Raises:
        ValueError: an unknown family, an unusable height map, or a difficulty outside [0, 1.2].
    """
    check_family(family)
    _check_difficulty(difficulty)
    start, goal = draw_start_goal(rng)
    parts: tuple[str, ...] = (family,)
    sections: tuple[Section, ...] = (WHOLE_ZONE,)
    if family == "mixed":
        first, second = rng.choice(len(FAMILIES), size=2, replace=False)
        parts, sections = (FAMILIES[first], FAMILIES[second]), halves(sum(ZONE) / 2)
    elif family == DITCHES:
        parts = (CLUTTER, "gap") if rng.uniform() < 0.5 else ("gap", CLUTTER)
        begin, end = ZONE
        sections = halves(rng.uniform(begin + SHORTEST_PART, end - SHORTEST_PART))

    heights = np.zeros((TILE_SAMPLES, TILE_SAMPLES))
    support = np.zeros((TILE_SAMPLES, TILE_SAMPLES))
    features = Features()
    for part, section in zip(parts, sections, strict=True):
        if is_map(part):
            relief = Relief(difficulty * _blend(section, BAND)[:, None] * height_map(part))
        else:
            relief = _SURFACES[part](section, difficulty_parameter(part, difficulty), rng)
        heights += relief.heights
        support += relief.heights if relief.support is None else relief.support
        features += relief.features
    return Tile(
        heights.astype(np.float32),
        support.astype(np.float32),
        start,
        goal,
        family,
        float(difficulty),
        parts,
        features,
    )


class Relief(NamedTuple):
    """What a family adds to the flat tile within its section; a tile is the sum of its sections.

    Attributes:
        heights: m, broadcastable to (161, 161) and zero outside the section.
        features: the features in ``heights``.
        support: m, of the same shape, the surface that the fall rule measures from; ``heights`` if
            None.
    """

    heights: FloatArray
    features: Features = Features()
    support: FloatArray | None = None


_NO_GROUND = np.zeros((1, 1))  # support of families that only stand on or cut into the flat base


# One function per family: (section, p(d), rng) -> Relief.


def rough(section: Section, amplitude: float, rng: np.random.Generator) -> Relief:
    """h = A n(x, y): bilinear uniform noise, zero-mean with max |n| = 1 where fully blended in."""
    lattice = LATTICES[rng.integers(len(LATTICES))]
    nodes = math.ceil(TILE_SIZE / lattice) + 1
    # Hat functions of the lattice at every sample: hat @ nodes @ hat.T interpolates bilinearly.
    hat = np.maximum(0.0, 1.0 - np.abs(_X[:, None] / lattice - np.arange(nodes)))
    noise = hat @ rng.uniform(-1.0, 1.0, (nodes, nodes)) @ hat.T
    blend = _blend(section, BAND)
    core = blend == 1.0
    noise -= noise[core].mean()
    noise /= np.abs(noise[core]).max()
    # The noise may exceed 1 in the bands, where it is not fully blended in.
    return Relief(amplitude * blend[:, None] * np.clip(noise, -1.0, 1.0))


def pillar(section: Section, count: float, rng: np.random.Generator) -> Relief:
    """Cylinders on a flat base; a section gets its share of the whole zone's ``count``.

    Samples within a cylinder's radius are raised, so its wall slopes outwards over one cell.
    """
    pillars = draw_cylinders(section, round(count * _share(section)), PILLAR_DIAMETER, rng)
    relief = np.where(_within(pillars), PILLAR_HEIGHT, 0.0)
    return Relief(relief, Features(pillars=pillars), _NO_GROUND)


def _within(circles: FloatArray) -> NDArray[np.bool_]:
    """Mask (161, 161) of the samples within any of the circles (k, 3) m: x, y and diameter."""
    covered = np.zeros((TILE_SAMPLES, TILE_SAMPLES), dtype=bool)
    for cx, cy, d in circles:
        covered |= (_X[:, None] - cx) ** 2 + (_X - cy) ** 2 <= (d / 2) ** 2
    return covered


def stair(section: Section, step_height: float, rng: np.random.Generator) -> Relief:
    """As many steps up, and down again, as fit into the section, with a landing in between.

    A riser climbs over a single cell, the steepest that a grid allows. The length of the tread
    behind it is drawn from ``TREAD_CELLS`` and includes the riser's cell. The remaining room is
    split at random between the ground before the first riser, the landing and the ground behind the
    last riser.
    """
    cells = _sample(section.end) - _sample(section.begin)
    low, high = TREAD_CELLS
    up, down = rng.integers(low, high + 1, (2, cells // low))  # more than fit
    # Each flight of n risers has n - 1 treads between them and one more cell for the last riser.
    length = 2 + np.cumsum(np.concatenate([[0], up + down])) + LANDING_CELLS
    steps = int(np.searchsorted(length, cells, side="right"))
    spare = cells - length[steps - 1]
    before, behind = np.sort(rng.integers(0, spare + 1, 2))
    first = _sample(section.begin) + before + np.concatenate([[0], np.cumsum(up[: steps - 1])])
    last = _sample(section.end) - (spare - behind) - 1
    back = last - np.concatenate([[0], np.cumsum(down[: steps - 1])])
    rise = np.zeros(TILE_SAMPLES)
    rise[first + 1], rise[back + 1] = step_height, -step_height
    middle = (np.concatenate([first, back[::-1]]) + 0.5) * CELL
    risers = np.column_stack([middle, np.repeat([step_height, -step_height], steps)])
    # Counting in steps makes the ground behind the stair exactly level.
    heights = step_height * np.cumsum(np.sign(rise))[:, None]
    return Relief(heights, Features(risers=risers))


def gap(section: Section, width: float, rng: np.random.Generator) -> Relief:
    """Trenches across the whole tile, at random with centres at least ``TRENCH_SPACING`` apart.

    Each lowers the floor or the ceiling of w / cell samples, at random so that the mean width is w.
    Since the walls slope over one cell on either side, a trench of n samples is n - 1, n and n + 1
    cells wide at its bottom, at half its depth and at its top.
    """
    share = _share(section)
    count = round(share * rng.integers(TRENCHES[0], TRENCHES[1] + 1))
    cells = round(width / CELL, 6)
    lowered = math.floor(cells) + (rng.uniform(size=count) < cells % 1.0)
    # Snapping to the grid moves centres by less than a cell towards +x, so one cell is reserved.
    spacing = TRENCH_SPACING + CELL
    room = section.end - section.begin - 2.0 * TRENCH_MARGIN - CELL - (count - 1) * spacing
    free = np.sort(rng.uniform(0.0, room, count))
    centres = section.begin + TRENCH_MARGIN + free + spacing * np.arange(count)
    first = np.ceil(centres / CELL - 0.5 * (lowered - 1)).astype(int)
    relief = np.zeros(TILE_SAMPLES)
    for sample, n in zip(first, lowered, strict=True):
        relief[sample : sample + n] = -TRENCH_DEPTH
    trenches = CELL * np.column_stack([first - 1, first + lowered])
    return Relief(relief[:, None], Features(trenches=trenches), _NO_GROUND)


def tilt(section: Section, angle: float, rng: np.random.Generator) -> Relief:
    """h = +-(y - W/2) tan(theta), either sign with equal probability, blended in and out."""
    slope = float(rng.choice([-1.0, 1.0])) * angle
    relief = _blend(section, TILT_BAND)[:, None] * (_X - TILE_SIZE / 2) * math.tan(slope)
    return Relief(relief, Features(slope=slope))


def clutter(section: Section, step: float, rng: np.random.Generator) -> Relief:
    """Flat ground, hills or paving, with slabs to step on and posts, pits or walls to walk around.

    No step is higher than ``step``, except on hills, whose slope adds to it. The kinds of ground
    and of obstacles are drawn for each tile, so that tiles differ widely. A section gets its share
    of the slabs and obstacles of a whole zone.
    """
    kind = rng.choice(["flat", "hills", "paving"])
    if kind == "paving":
        ground = _paving(step, rng)
    else:
        ground = _hills(WAVE_SLOPE * step, rng) if kind == "hills" else np.zeros_like(_PLANE[0])
    ground *= _blend(section, BAND)[:, None]
    inside = (section.begin <= _X) & (section.end >= _X)
    if kind != "paving":  # slabs would add to the steps between its stones
        ground = np.where(inside[:, None], _with_slabs(ground, section, step, rng), ground)
    obstacles = str(rng.choice(["none", "posts", "pits", "walls"]))
    circles = np.empty((0, 3))
    if obstacles == "walls":
        count = round(_share(section) * rng.integers(WALLS[0], WALLS[1] + 1))
        circles = _walls(draw_cylinders(section, count, WALL_LENGTH, rng), rng)
    elif obstacles != "none":
        count = round(_share(section) * rng.integers(OBSTACLES[0], OBSTACLES[1] + 1))
        circles = draw_cylinders(section, count, OBSTACLE_DIAMETER, rng)
    level = -TRENCH_DEPTH if obstacles == "pits" else PILLAR_HEIGHT
    heights = np.where(_within(circles), level, ground)
    return Relief(heights, Features(pillars=circles), ground)


def _hills(slope: float, rng: np.random.Generator) -> FloatArray:
    """Sum of plane waves in random directions, nowhere steeper than ``slope``, (161, 161) m."""
    heights = np.zeros_like(_PLANE[0])
    low, high = np.array([WAVE_LENGTH, _TURN, _TURN]).T
    for length, turn, phase in rng.uniform(low, high, (WAVES, 3)):
        number = 2.0 * math.pi / length
        along = _PLANE[0] * np.cos(turn) + _PLANE[1] * np.sin(turn)
        heights += slope / (WAVES * number) * np.sin(number * along + phase)
    return heights


def _paving(step: float, rng: np.random.Generator) -> FloatArray:
    """Rotated grid of equal stones, each at its own random height, (161, 161) m."""
    turn, side = rng.uniform(*_TURN), rng.uniform(*PAVING, 2)
    stones = step * rng.uniform(-0.5, 0.5, (128, 128))  # more than fit on a tile
    u, v = _turned(_PLANE - TILE_SIZE / 2, turn)
    row, col = np.floor(u / side[0]).astype(int), np.floor(v / side[1]).astype(int)
    return stones[row, col]  # negative indices wrap around


def _with_slabs(
    ground: FloatArray, section: Section, step: float, rng: np.random.Generator
) -> FloatArray:
    """Ground with slabs and bars on it, each up to ``step`` thick; they do not stack."""
    heights = ground.copy()
    for _ in range(round(_share(section) * rng.integers(SLABS + 1))):
        centre = rng.uniform([section.begin, 0.0], [section.end, TILE_SIZE])
        turn, half = rng.uniform(*_TURN), 0.5 * rng.uniform(*SLAB_SIDE, 2)
        u, v = _turned(_PLANE - centre[:, None, None], turn)
        covered = (np.abs(u) <= half[0]) & (np.abs(v) <= half[1])
        thick = step * rng.uniform(0.3, 1.0)
        heights[covered] = np.maximum(heights, ground + thick)[covered]
    return heights


def _turned(points: FloatArray, turn: float) -> tuple[FloatArray, FloatArray]:
    """Coordinates of ``points`` (2, ...) along axes rotated by ``turn`` rad."""
    x, y = points
    cosine, sine = math.cos(turn), math.sin(turn)
    return x * cosine + y * sine, y * cosine - x * sine


def _walls(placed: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Walls in random directions as rows of cylinders, (k, 3) m, from their centres and lengths
    ``placed`` (n, 3) m."""
    rows = [np.empty((0, 3))]
    for cx, cy, length in placed:
        reach = 0.5 * max(length - WALL_THICKNESS, 0.0)
        along = np.linspace(-reach, reach, 1 + math.ceil(2.0 * reach / (0.5 * WALL_THICKNESS)))
        turn = rng.uniform(*_TURN)
        x, y = cx + along * np.cos(turn), cy + along * np.sin(turn)
        rows.append(np.column_stack([x, y, np.full_like(x, WALL_THICKNESS)]))
    return np.vstack(rows)


def _share(section: Section) -> float:
    """The section's length as a share of the whole zone's."""
    return (section.end - section.begin) / (ZONE[1] - ZONE[0])


def is_map(family: str) -> bool:
    """Whether a family is the path of a user's height map."""
    return family.endswith(MAP_ENDING)


def may_have_trenches(family: str) -> bool:
    """Whether tiles of a family may have trenches."""
    return is_map(family) or family in ("gap", "mixed", DITCHES)


@functools.lru_cache
def height_map(path: str) -> FloatArray:
    """Heights (161, 161) in m from a file, as used at difficulty 1.

    Only the zone and its transition bands use them; the platforms are flat.

    Raises:
        InputError: the file is missing or does not hold such heights.
    """
    try:
        heights = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"terrain '{path}' cannot be read as a NumPy file: {error}") from error
    shape = (TILE_SAMPLES, TILE_SAMPLES)
    real = isinstance(heights, np.ndarray) and heights.dtype.kind in "fiu"
    if not real or heights.shape != shape or not np.isfinite(heights).all():
        raise InputError(f"terrain '{path}' must hold finite heights in m, an array {shape}")
    limit = HEIGHT_RANGE[1] / MAX_DIFFICULTY
    heights = heights.astype(np.float64)
    if np.abs(heights).max() > limit:
        raise InputError(f"terrain '{path}' must stay within {limit:g} m of the platforms' height")
    return heights


def family_number(family: str) -> int:
    """Number of a family, below 2**32, as part of its tiles' seeds; maps go by their heights."""
    if is_map(family):
        return zlib.crc32(height_map(family).tobytes()) | 2**31  # above those of ALL_FAMILIES
    return ALL_FAMILIES.index(family)


def file_label(family: str) -> str:
    """A family's name in a form that is safe in file names."""
    return re.sub(r"[^\w.-]", "-", family)


def draw_cylinders(
    section: Section, count: int, diameters: tuple[float, float], rng: np.random.Generator
) -> FloatArray:
    """Draw centres and diameters (count, 3) in m of cylinders that keep their clearance.

    Cylinders are placed one by one at random free positions. If there is none, all start over: even
    the 28 of level 12 take up at most 40 % of the room, and random placement jams near 55 %.

    Raises:
        RuntimeError: no room for so many.
    """
    restarts, candidates = 100, 256  # ample: one tile in 25 restarts at level 12, fewer below
    for _ in range(restarts):
        placed = np.empty((0, 3))
        for d in rng.uniform(*diameters, count):
            x = rng.uniform(section.begin + d / 2, section.end - d / 2, candidates)
            y = rng.uniform(d / 2, TILE_SIZE - d / 2, candidates)
            distance = np.hypot(x[:, None] - placed[:, 0], y[:, None] - placed[:, 1])
            free = (distance >= (d + placed[:, 2]) / 2 + PILLAR_CLEARANCE).all(axis=1)
            if not free.any():
                break
            pick = free.argmax()
            placed = np.vstack([placed, (x[pick], y[pick], d)])
        else:
            return placed
    raise RuntimeError(
        f"no room for {count} cylinders between x = {section.begin} and {section.end}"
    )


_SURFACES: dict[str, Callable[[Section, float, np.random.Generator], Relief]] = {
    "rough": rough,
    "pillar": pillar,
    "stair": stair,
    "gap": gap,
    "tilt": tilt,
    CLUTTER: clutter,
}


def tile_rng(
    seed: int, family: str, level: int, index: int, stream: int = TRAIN_STREAM
) -> np.random.Generator:
    """Generator for tile number ``index`` of a family and level, unique to this tile and stream.

    Raises:
        ValueError: an unknown family, or a number outside [0, 2**32).
    """
    check_family(family)
    entropy = (stream, int(seed), family_number(family), int(level), int(index))
    # A number of more than 32 bits would take two words, so that different entropies could collide.
    if not all(0 <= number < 2**32 for number in entropy):
        raise ValueError(f"stream, seed, level and index must lie in [0, 2**32), got {entropy}")
    return np.random.default_rng(np.random.SeedSequence(entropy))


class TileField:
    """A row of tiles along x in one height field.

    Tiles share no samples, so they repeat every 8.05 m. The world frame has sample [0, 0] at
    (0, 0); a tile's frame is the world frame shifted by ``origin``.

    Attributes:
        count: number of tiles.
        crop: m, cut off each tile on both sides in y. Training uses a narrower field because
            Bullet's 600 bytes per sample dominate memory use.
        heights, support: (161 count, n) m, see ``Tile``; n is 161 less the cropped samples.
            ``place`` overwrites them in place.
        starts, goals: (count, 3) and (count, 2), start (x, y, yaw) and goal (x, y) of each tile, in
            its frame.
        features: of each tile, in its frame; empty until one is placed.

    Raises:
        ValueError: a crop that leaves no room for starts and goals.
    """

    def __init__(self, count: int, crop: float = 0.0) -> None:
        if not 0.0 <= crop < TILE_SIZE / 2 - Y_SPREAD:
            raise ValueError(f"crop must lie in [0, {TILE_SIZE / 2 - Y_SPREAD}) m, got {crop}")
        self.count, self._cut = count, round(crop / CELL)
        self.crop = self._cut * CELL
        self.heights: HeightArray = np.zeros(
            (count * TILE_SAMPLES, TILE_SAMPLES - 2 * self._cut), np.float32
        )
        self.support: HeightArray = np.zeros_like(self.heights)
        self.starts, self.goals = np.zeros((count, 3)), np.zeros((count, 2))
        self.features = [Features()] * count

    @classmethod
    def of(cls, *tiles: Tile) -> "TileField":
        """A field of these tiles; its heights are read-only, which makes worlds faster."""
        field = cls(len(tiles))
        for k, tile in enumerate(tiles):
            field.place(k, tile)
        field.heights.setflags(write=False)
        return field

    def place(self, k: int, tile: Tile) -> None:
        """Copy a tile to place ``k`` of the field."""
        rows = slice(k * TILE_SAMPLES, (k + 1) * TILE_SAMPLES)
        columns = slice(self._cut, TILE_SAMPLES - self._cut)
        self.heights[rows] = tile.heights[:, columns]
        self.support[rows] = tile.support[:, columns]
        self.starts[k], self.goals[k] = tile.start, tile.goal
        self.features[k] = tile.features

    def origin(self, k: ArrayLike) -> FloatArray:
        """World xy (..., 2) in m of the origins of the frames of the tiles ``k`` (...)."""
        x = TILE_SAMPLES * CELL * np.asarray(k)
        return np.stack([x, np.full_like(x, -self.crop)], axis=-1)

    def on_tile(self, k: ArrayLike, x: ArrayLike, y: ArrayLike) -> NDArray[np.bool_]:
        """Whether world points lie on the tiles ``k``, without the crop; all broadcast."""
        local = np.stack(np.broadcast_arrays(x, y), axis=-1) - self.origin(k)
        low = np.array([0.0, self.crop])
        return np.asarray(((local >= low) & (local <= TILE_SIZE - low)).all(axis=-1))

    def height_at(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Height in m of the collision surface at world points, clamped to the field's border."""
        return interpolate(self.heights, x, y)

    def support_at(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """As ``height_at``, for the support surface of the fall rule."""
        return interpolate(self.support, x, y)


def interpolate(surface: HeightArray, x: ArrayLike, y: ArrayLike) -> FloatArray:
    """Height in m at points (x, y) of any shape, exactly as on Bullet's triangles.

    Bullet splits each cell along the diagonal from [ix + 1, iy] to [ix, iy + 1] (its default,
    measured with rays and with contacts). Both ends of the diagonal contribute everywhere; the
    third corner is [ix, iy] on one side of it and [ix + 1, iy + 1] on the other. Points outside get
    the height of the nearest border; the height at NaN is NaN.
    """
    nx, ny = surface.shape
    flat = surface.reshape(-1)
    u = np.clip(np.asarray(x) / CELL, 0.0, nx - 1)
    v = np.clip(np.asarray(y) / CELL, 0.0, ny - 1)
    ix = np.minimum(np.nan_to_num(u).astype(np.intp), nx - 2)  # NaN where the simulation diverged
    iy = np.minimum(np.nan_to_num(v).astype(np.intp), ny - 2)
    u, v = u - ix, v - iy
    corner = ix * ny + iy
    past = u + v - 1.0  # positive past the diagonal
    third = flat[corner + (past > 0.0) * (ny + 1)]
    heights: FloatArray = (
        np.abs(past) * third
        + np.minimum(u, 1.0 - v) * flat[corner + ny]
        + np.minimum(v, 1.0 - u) * flat[corner + 1]
    )
    return heights


def _blend(section: Section, band: float) -> FloatArray:
    """Weights (161,) along x: 0 outside the section, 1 inside, linear over ``band`` at its ends."""
    return np.clip(np.minimum(_X - section.low, section.high - _X) / band, 0.0, 1.0)


def _sample(x: float) -> int:
    """Index of the sample at ``x`` m."""
    return round(x / CELL)


def check_family(family: str, beside: Sequence[str] = ()) -> None:
    """Check that tiles of a family can be made; the names in ``beside`` are allowed as well.

    Raises:
        ValueError: an unknown name, or an unusable height map.
    """
    if is_map(family):
        height_map(family)
    elif family not in (*ALL_FAMILIES, *beside):
        allowed = ", ".join((*beside, *ALL_FAMILIES, f"FILE{MAP_ENDING}"))
        raise ValueError(f"unknown terrain family {family!r}; choose from {allowed}")


def _check_difficulty(difficulty: float) -> None:
    if not 0.0 <= difficulty <= MAX_DIFFICULTY:  # also false for nan
        raise ValueError(f"difficulty must lie in [0, {MAX_DIFFICULTY}], got {difficulty}")
