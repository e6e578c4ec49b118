"""The terrain families (Sec. III-A): one function each, (section, p(d), rng) -> Relief.

The difficulty d scales one geometric parameter per family (Eq. 1). The parameter is exact; the
layout is drawn for each tile from its own generator. Ranges and shapes are those of TDGC-Bench 2.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tdgc.sim.tile import CELL, TILE_SAMPLES, TILE_SIZE, ZONE, Features, FloatArray, Section

# Families and levels: Sec. III-A. Mixed and the levels above 10 are for evaluation only.
FAMILIES = ("rough", "pillar", "stair", "gap", "tilt")
#: Training families outside the benchmark: many kinds of ground without a name of their own, and
#: the same with trenches before or behind it.
CLUTTER, DITCHES = "clutter", "ditches"
UNNAMED = (CLUTTER, DITCHES)
ALL_FAMILIES = (*FAMILIES, "mixed", *UNNAMED)
MAX_LEVEL = 10  # the hardest level of the curriculum, d = 1
OOD_LEVELS = (11, 12)  # out of distribution, d = 1.1 and 1.2
MAX_DIFFICULTY = OOD_LEVELS[-1] / MAX_LEVEL

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

BAND = 0.25  # m, transition band between platform and zone
TILT_BAND = 0.5  # m, Tilt's wider band, half of it inside the zone

_X = np.arange(TILE_SAMPLES) / round(1 / CELL)  # m; i / 20 rounds correctly, i * 0.05 may not
_PLANE: FloatArray = np.stack(np.meshgrid(_X, _X, indexing="ij"))  # (2, 161, 161) m, x and y
_TURN = (0.0, 2.0 * math.pi)  # rad


def difficulty_parameter(family: str, difficulty: float) -> float:
    """Geometric parameter p(d) = p_min + d (p_max - p_min) of a family (Eq. 1).

    Mixed and Ditches have no parameter: each of their parts uses that of its family.

    Raises:
        ValueError: a family without a parameter, or a difficulty outside [0, 1.2].
    """
    if family not in PARAMETER_RANGES:
        allowed = ", ".join(PARAMETER_RANGES)
        raise ValueError(f"{family!r} has no parameter; choose from {allowed}")
    check_difficulty(difficulty)
    p_min, p_max = PARAMETER_RANGES[family]
    return p_min + difficulty * (p_max - p_min)


def check_difficulty(difficulty: float) -> None:
    """Raise ValueError for a difficulty outside [0, 1.2]."""
    if not 0.0 <= difficulty <= MAX_DIFFICULTY:  # also false for nan
        raise ValueError(f"difficulty must lie in [0, {MAX_DIFFICULTY}], got {difficulty}")


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


def rough(section: Section, amplitude: float, rng: np.random.Generator) -> Relief:
    """h = A n(x, y): bilinear uniform noise, zero-mean with max |n| = 1 where fully blended in."""
    lattice = LATTICES[rng.integers(len(LATTICES))]
    nodes = math.ceil(TILE_SIZE / lattice) + 1
    # Hat functions of the lattice at every sample: hat @ nodes @ hat.T interpolates bilinearly.
    hat = np.maximum(0.0, 1.0 - np.abs(_X[:, None] / lattice - np.arange(nodes)))
    noise = hat @ rng.uniform(-1.0, 1.0, (nodes, nodes)) @ hat.T
    blend = blend_in(section, BAND)
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

    Each lowers floor(w / cell) or ceil(w / cell) samples, at random so that the mean width is w.
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
    relief = blend_in(section, TILT_BAND)[:, None] * (_X - TILE_SIZE / 2) * math.tan(slope)
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
    ground *= blend_in(section, BAND)[:, None]
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


def blend_in(section: Section, band: float) -> FloatArray:
    """Weights (161,) along x: 0 outside the section, 1 inside, linear over ``band`` at its ends."""
    return np.clip(np.minimum(_X - section.low, section.high - _X) / band, 0.0, 1.0)


def _sample(x: float) -> int:
    """Index of the sample at ``x`` m."""
    return round(x / CELL)


SURFACES: dict[str, Callable[[Section, float, np.random.Generator], Relief]] = {
    "rough": rough,
    "pillar": pillar,
    "stair": stair,
    "gap": gap,
    "tilt": tilt,
    CLUTTER: clutter,
}
