"""The tile: an 8 m x 8 m height field h(x, y) with a start and a goal (Sec. III-A), in plain numpy.

Its layout along x, the direction of travel, is

    0      1.25   1.5                                     6.5   6.75      8 m
    | start | band |             challenge zone            | band | goal |

All lengths are in m, all angles in rad. Arrays are indexed [ix, iy]; sample [ix, iy] lies at
(ix * CELL, iy * CELL).
"""

import dataclasses
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
HeightArray = NDArray[np.float32]

# The tile (TDGC-Bench, "Tile").
TILE_SIZE = 8.0  # m, in x and y; the paper's W
CELL = 0.05  # m, grid resolution
TILE_SAMPLES = round(TILE_SIZE / CELL) + 1  # 161 per side: both edges carry samples
START_END = 1.25  # m, the start platform is x in [0, 1.25], at h = 0
GOAL_BEGIN = 6.75  # m, the goal platform is x in [6.75, 8], at h = 0
ZONE = (1.5, 6.5)  # m, the challenge zone in x
START_X, GOAL_X = 0.75, 7.25  # m
Y_SPREAD = 1.0  # m, start and goal: y uniform in W/2 +- 1
YAW_SPREAD = 0.5  # rad, start: yaw uniform in +- 0.5

# Bullet keeps the height range of a field's first upload, so it is fixed to what any tile can need:
# Tilt at level 12 reaches W/2 tan(0.54 rad) = 2.40 m up and down, all other families less.
HEIGHT_RANGE = (-2.5, 2.5)  # m


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
        """The same tile with left and right exchanged.

        Between samples the ground differs: simulators split every cell along the same diagonal.
        """
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
