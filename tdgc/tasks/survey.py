"""What the teacher reads from the heights of a tile: obstacles, trenches and slopes.

It reads heights alone, of any terrain: neither a tile's family nor its list of features.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from tdgc.sim.robot import Array
from tdgc.sim.tile import CELL, TILE_SIZE, Y_SPREAD
from tdgc.tasks.planning import RADIUS, cost_to_go, price_near

Mask = NDArray[np.bool_]

#: m, lowest step between neighbouring samples that is an obstacle, up or down. The highest risers
#: of the benchmark have 0.17 m (Stair, level 12).
STEP = 0.2
# m, lowest step that is avoided where the way around it is not much longer. On a map of boxes of 5
# to 30 cm the teacher reached 5 of 30 goals when it climbed all steps up to ``STEP``.
_LOW_STEP = 0.1
# Cost per metre beside such a step (1 in the open), and m that count as beside it: half a stance
# and a little. With these the teacher reached all of the same 30 goals.
_STEP_PRICE, _BESIDE = 6.0, 0.25
#: m, widest trench to leap over, from lip to lip: strides are up to ``leaps.LONGEST``, 0.48 m.
WIDEST = 0.45
_WIDE = 0.55  # m from an obstacle, chosen by hand: beyond this it adds no cost
# m from the middle of the tile to both sides: starts and goals lie within ``Y_SPREAD``, and the
# rest is about the reach of an obstacle. What is outside is not in the way.
_CORRIDOR = Y_SPREAD + 0.6
_COARSE = 2
#: m, spacing of travel costs: every second sample.
GRID = _COARSE * CELL
# Tangent of the least slope that counts, chosen by hand; and m: times the slope, the most by which
# the ground within 0.5 m may deviate from its mean. On Tilt it deviates by up to 0.2 m times the
# slope, on Rough by at least 0.8 m.
_LEAST_SLOPE, _UNEVEN = 0.04, 0.3
# Samples to both sides over which unevenness and slopes are measured, chosen by hand.
_NEAR, _FAR = 5, 10
# Samples along x: robots use the style for slopes from as far away as they can see one, unless
# there are steps within that distance.
_AHEAD = 25
_SLOPING_ON = {"mode": "reflect", "reflect_type": "odd"}  # ground beyond the tile keeps its slope


@dataclass(frozen=True, eq=False)
class Survey:
    """A tile as the teacher knows it, in the tile's frame.

    Attributes:
        trenches: (k, 2) m, x of the lips of each trench to be leapt over, from start to goal.
        cost: (81, m) m, cost of travelling to the goal from every second sample, see
            ``travel_cost``; None if nothing has to be walked around.
        slope: (161, n) tangent of the lateral slope within 1.25 m along x, positive where the
            ground rises to the left; 0 where there is none that matters.
    """

    trenches: Array
    cost: Array | None
    slope: Array


def survey(heights: NDArray[np.floating], left: float, goal: Array) -> Survey:
    """Survey a tile.

    Args:
        heights: (161, n) m.
        left: m, y of the first column in the tile's frame.
        goal: (2,) m in the tile's frame.
    """
    surface: Array = np.asarray(heights, dtype=np.float64)
    y = left + CELL * np.arange(surface.shape[1])
    corridor = corridor_at(y)
    trenches, ground = find_trenches(surface, corridor)
    low = _steps(ground, _LOW_STEP)
    high = _steps(ground, STEP, across=np.ones_like(corridor))
    avoided = _steps(ground, _LOW_STEP, across=corridor)
    cost = None
    if (high | avoided)[:, corridor].any():
        beside = clearance(avoided) < _BESIDE
        # Feet must not leave the ground that is known, either.
        border = np.minimum(y - y[0], y[-1] - y)[::_COARSE]
        price = price_near(np.minimum(clearance(high), border + RADIUS - _BESIDE), _WIDE)
        cost = travel_cost(np.maximum(price, np.where(beside, _STEP_PRICE, 1.0)), left, goal)
    return Survey(trenches, cost, lateral_slope(ground, low))


def corridor_at(y: NDArray[np.floating]) -> Mask:
    """Whether columns at ``y`` (n,) m are those that a robot has to pass, (n,)."""
    return np.abs(y - TILE_SIZE / 2) < _CORRIDOR + 0.5 * CELL


def find_trenches(heights: Array, corridor: Mask) -> tuple[Array, Array]:
    """Trenches that have to be leapt over, and the ground with these filled.

    A trench runs across the whole corridor, is deeper than ``STEP`` and no wider than ``WIDEST``.
    It may run slightly askew; its lips are then the outermost.

    Args:
        heights: (161, n) m.
        corridor: (n,) the columns that a robot has to pass.

    Returns:
        The lips (k, 2) m, and heights (161, n) m.
    """
    filled = _close(heights, round(WIDEST / CELL))
    deep = filled - heights > STEP
    edge = np.diff(np.concatenate([[0], deep[:, corridor].any(axis=1), [0]]).astype(int))
    lips, ground = [], heights.copy()
    for first, last in zip(np.flatnonzero(edge == 1), np.flatnonzero(edge == -1), strict=True):
        across = deep[first:last, corridor].any(axis=0).all()
        if across and CELL * (last - first + 1) < WIDEST + 0.5 * CELL:
            lips.append((CELL * (first - 1), CELL * last))
            rows = slice(first, last)
            ground[rows] = np.where(deep[rows], filled[rows], heights[rows])
    return np.array(lips, dtype=np.float64).reshape(-1, 2), ground


def _steps(heights: Array, least: float, across: Mask | None = None) -> Mask:
    """Samples (161, n) beside a step of more than ``least`` m, without steps along x that span all
    columns of ``across`` (n,): there is no way around those."""
    ahead = np.abs(np.diff(heights, axis=0)) > least
    aside = np.abs(np.diff(heights, axis=1)) > least
    if across is not None:
        ahead[ahead[:, across].all(axis=1)] = False
    beside = np.zeros(heights.shape, dtype=bool)
    beside[:-1] |= ahead
    beside[1:] |= ahead
    beside[:, :-1] |= aside
    beside[:, 1:] |= aside
    return beside


def clearance(steps: Mask) -> Array:
    """Distance in m from every second sample to the middle of the nearest step, (81, m), right to
    half a sample up to ``_WIDE``; ``steps`` (161, n) are the samples beside steps."""
    reach = 1 + round(_WIDE / CELL)
    far = 4.0 * reach**2
    square = np.where(steps, 0.0, far)
    for axis in (0, 1):
        near = _windows(square, axis, reach, constant_values=far)
        square = (near + np.arange(-reach, reach + 1) ** 2).min(axis=-1)
    return CELL * (np.sqrt(square[::_COARSE, ::_COARSE]) + 0.5)


def travel_cost(price: Array, left: float, goal: Array) -> Array:
    """Least cost in m of travelling to the goal from each cell of a grid, (n, m).

    Args:
        price: (n, m) cost per metre; 1 in the open.
        left: m, y of the first column.
        goal: (2,) m.
    """
    cost = np.full(price.shape, np.inf)
    at = np.clip(np.round((goal - [0.0, left]) / GRID).astype(int), 0, np.array(cost.shape) - 1)
    cost[tuple(at)] = 0.0
    return cost_to_go(cost, GRID * price)


def lateral_slope(heights: Array, steps: Mask) -> Array:
    """Tangent of the lateral slope, (161, n), see ``Survey``; ``steps`` (161, n) are the samples
    beside steps, near which no slope is looked for ahead."""
    uneven = np.abs(heights - _mean(_mean(heights, 0, _NEAR), 1, _NEAR))
    for axis in (0, 1):
        uneven = _windows(uneven, axis, _FAR, mode="edge").max(axis=-1)
    wide = _windows(heights, 1, _FAR, **_SLOPING_ON)
    slope = _mean((wide[..., -1] - wide[..., 0]) / (2 * _FAR * CELL), 0, _FAR)
    steep = np.abs(slope)
    slope[(steep < _LEAST_SLOPE) | (uneven > _UNEVEN * steep)] = 0.0
    near = _windows(slope, 0, _AHEAD, mode="edge")
    low, high = near.min(axis=-1), near.max(axis=-1)
    stepping = _windows(steps, 0, _AHEAD, mode="edge").any(axis=-1)
    return np.where(stepping, slope, np.where(high > -low, high, low))


def _windows(grid: NDArray[Any], axis: int, n: int, **beyond: Any) -> NDArray[Any]:
    """The ``n`` samples to both sides of each sample along an axis, and itself, (..., 2 n + 1);
    ``beyond`` says what lies beyond the ends of the grid."""
    sides = [(0, 0), (0, 0)]
    sides[axis] = (n, n)
    return sliding_window_view(np.pad(grid, sides, **beyond), 2 * n + 1, axis)


def _mean(grid: Array, axis: int, n: int) -> Array:
    """Mean over the ``n`` samples to both sides along an axis."""
    return _windows(grid, axis, n, **_SLOPING_ON).mean(axis=-1)


def _close(grid: Array, n: int) -> Array:
    """The grid with its dips along x filled where they are narrower, from lip to lip, than ``n``
    samples; ``n`` is odd."""
    wide = _windows(grid, 0, n // 2, mode="edge").max(axis=-1)
    return _windows(wide, 0, n // 2, mode="edge").min(axis=-1)
