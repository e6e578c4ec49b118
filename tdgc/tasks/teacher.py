"""A scripted expert on each training family, which the high level first imitates.

It is told what the high level has to find out from its cues: where on the tile the robot is and how
fast, the way around the pillars, the lines of the trenches. How a family wants to be walked was
tried on training tiles (docs/experiments.md). Leaps over trenches show why imitation comes first:
pronk at nearly full speed, its steps timed to a few centimetres, is nothing that exploring from a
trot finds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tdgc.config import CommandRanges
from tdgc.sim.commands import INDEX, default_command
from tdgc.sim.gaits import GAITS, gait_embedding
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array, wrap_angle
from tdgc.sim.terrain import CELL, TILE_SAMPLES, TILE_SIZE, TRENCH_DEPTH, TileField
from tdgc.tasks.leaps import (
    LANDING,
    SPEED,
    STANCE_LENGTH,
    STRIDE,
    SWING_HEIGHT,
    Landing,
    straddling_frequency,
)


@dataclass(frozen=True)
class Style:
    """How to walk: speed in m/s, frequency in Hz, swing height, stance width and length in m."""

    speed: float
    frequency: float = 3.0
    swing_height: float = 0.08
    stance_width: float = 0.25
    stance_length: float = 0.38
    gait: str = "trot"


#: A family's style. Numbers beside the defaults of Walk These Ways are from docs/experiments.md.
STYLES = {
    "rough": Style(0.6, swing_height=0.2, stance_width=0.32),
    "pillar": Style(0.5),
    "stair": Style(0.6, swing_height=0.2, stance_width=0.35),
    "gap": Style(SPEED, swing_height=SWING_HEIGHT, stance_length=STANCE_LENGTH, gait="pronk"),
    "tilt": Style(0.6, frequency=3.5, swing_height=0.2),
}
_BEYOND = 0.5  # m behind the last trench, where leaping ends

# The way around pillars follows a field of travel costs on every second sample of the tile.
_COARSE = 2
_RADIUS = 0.28  # m: half the trunk's diagonal and a little; two pillars leave 0.6 between them
_WIDE = 0.55  # m from a pillar, where it ceases to cost
_BLOCKED, _CLOSE = 30.0, 3.0  # cost of a metre inside the radius and at it; 1 in the open
_LOOK = 0.35  # m ahead, where the robot looks for the lower cost
_RAYS = np.linspace(-np.pi, np.pi, 24, endpoint=False)


def toward(
    distance: Array,
    error: Array,
    top_speed: Array | float,
    distance_gain: float = 1.0,
    heading_gain: float = 1.5,
) -> tuple[Array, Array]:
    """Forward speed in m/s and yaw rate in rad/s towards a point, (M,) each.

    As fast as the distance asks, turning by the heading error, and slower while facing away.

    Args:
        distance, error: (M,) m and rad, of the point's bearing against the heading.
        top_speed: (M,) or one for all, m/s.
        distance_gain, heading_gain: 1/s.
    """
    speed = np.minimum(top_speed, distance_gain * distance)
    turn = np.clip(heading_gain * error, *CommandRanges().yaw_rate)
    return speed * np.maximum(np.cos(error), 0.0), turn


def trenches(heights: NDArray[np.floating]) -> Array:
    """Centres along x, (k,) m, of the trenches of one tile's heights (161, n) m."""
    low = heights[:, heights.shape[1] // 2] < -0.5 * TRENCH_DEPTH
    first = np.flatnonzero(low[1:] & ~low[:-1]) + 1
    last = np.flatnonzero(low[:-1] & ~low[1:])
    return np.asarray(0.5 * CELL * (first + last))


def travel_cost(
    heights: NDArray[np.floating], left: float, goal: Array
) -> tuple[Array, float, float]:
    """Cost of travelling to the goal from all over a tile, walls being what stands 0.5 m high.

    Args:
        heights: (161, n) m.
        left: m, y of the first column in the tile's frame.
        goal: (2,) m.

    Returns:
        The field (81, n // 2 + 1), its step in m, and ``left``.
    """
    coarse = heights[::_COARSE, ::_COARSE]
    step = _COARSE * CELL
    x, y = np.arange(coarse.shape[0]) * step, left + np.arange(coarse.shape[1]) * step
    away = np.full(coarse.shape, np.inf)
    for i, j in zip(*np.nonzero(coarse > 0.5), strict=True):
        np.minimum(away, np.hypot(x[:, None] - x[i], y[None] - y[j]), out=away)
    near = np.clip((_WIDE - away) / (_WIDE - _RADIUS), 0.0, 1.0)
    price = np.where(away < _RADIUS, _BLOCKED, 1.0 + (_CLOSE - 1.0) * near)
    cost = np.full((coarse.shape[0] + 2, coarse.shape[1] + 2), np.inf)  # a border around all
    inside = np.s_[1:-1, 1:-1]
    at = np.clip(np.round((goal - [0.0, left]) / step).astype(int), 0, np.array(coarse.shape) - 1)
    cost[at[0] + 1, at[1] + 1] = 0.0
    shifts = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0)]
    while True:
        before = cost[inside].copy()
        for a, b in shifts:
            nx, ny = coarse.shape
            neighbour = cost[1 + a : 1 + a + nx, 1 + b : 1 + b + ny]
            np.minimum(cost[inside], neighbour + np.hypot(a, b) * step * price, out=cost[inside])
        if np.array_equal(before, cost[inside]):
            return cost[inside].copy(), step, left


def check_styles(families: Sequence[str]) -> None:
    """See that there is a style for each of the families.

    Raises:
        ValueError: there is none for one of them.
    """
    for family in families:
        if family not in STYLES:
            raise ValueError(
                f"the teacher does not know {family}, only {', '.join(STYLES)}; "
                "imitation.steps=0 does without it"
            )


class Teacher:
    """Commands robots on tiles of their own.

    Args:
        field: (M, 1) tiles.
        families: of the robots, (M,) names.
        landing: of the low level that they have.

    Raises:
        ValueError: a family it has no style for.
    """

    def __init__(
        self, field: TileField, families: Sequence[str], landing: Landing = LANDING
    ) -> None:
        check_styles(families)
        m = len(families)
        self._field, self._landing = field, landing
        self._origin = field.origin(np.arange(m), 0)
        self._leaps = np.array([family == "gap" for family in families])
        self._pillars = np.array([family == "pillar" for family in families])
        styles = [STYLES[family] for family in families]
        self._command = np.tile(default_command(), (m, 1))
        for name in ("frequency", "swing_height", "stance_width", "stance_length"):
            self._command[:, INDEX[name]] = [getattr(style, name) for style in styles]
        self._speed = np.array([style.speed for style in styles])
        self._gait = np.array([GAITS.index(style.gait) for style in styles])
        self._centres = np.full((m, 1), -np.inf)
        self._fields: dict[int, tuple[Array, float, float]] = {}

    def begin(self, index: NDArray[np.integer], goal: Array) -> None:
        """Look at the tiles of the robots ``index`` (n,); ``goal`` (M, 2) m in the world."""
        heights = self._field.heights.reshape(len(self._speed), TILE_SAMPLES, -1)
        for i in index[self._leaps[index]]:
            found = trenches(heights[i])
            if found.size > self._centres.shape[1]:
                grown = np.full((len(self._speed), found.size), -np.inf)
                grown[:, : self._centres.shape[1]] = self._centres
                self._centres = grown
            self._centres[i, :] = -np.inf
            self._centres[i, : found.size] = found
        for i in index[self._pillars[index]]:
            target = goal[i] - self._origin[i]
            self._fields[int(i)] = travel_cost(heights[i], self._field.crop, target)

    def commands(self, loco: Locomotion, goal: Array) -> Array:
        """Commands (M, 15) for the coming decision; ``goal`` (M, 2) m in the world."""
        state = loco.world.state
        offset = goal - state.position[:, :2]
        distance = np.linalg.norm(offset, axis=1)
        bearing = np.arctan2(offset[:, 1], offset[:, 0])
        local = state.position[:, :2] - self._origin
        for i, field in self._fields.items():
            if distance[i] > _LOOK:
                bearing[i] = _downhill(field, local[i], bearing[i])
        error = wrap_angle(bearing - state.yaw)
        command = self._command.copy()
        speed, turn = toward(distance, error, self._speed)
        command[:, INDEX["vx"]], command[:, INDEX["yaw_rate"]] = speed, turn
        leaping = self._leaps & (local[:, 0] < self._centres.max(axis=1) + _BEYOND)
        command[:, 12:] = gait_embedding(np.where(leaping, self._gait, 0))
        rows = np.flatnonzero(leaping)
        if rows.size:
            frequency = straddling_frequency(
                local[rows, 0],
                state.heading_vel[rows, 0],
                loco.clock.clock[rows],
                np.full(rows.size, STRIDE),
                command[rows, INDEX["stance_length"]],
                self._centres[rows],
                self._landing,
            )
            command[rows, INDEX["frequency"]] = np.clip(frequency, *CommandRanges().frequency)
        return command


def _downhill(field: tuple[Array, float, float], at: Array, ahead: float) -> float:
    """Direction in rad from ``at`` (2,) m in which the travel cost falls most; near ties go to the
    one closest to ``ahead``."""
    cost, step, left = field
    x, y = at[0] + _LOOK * np.cos(_RAYS), at[1] + _LOOK * np.sin(_RAYS)
    u = np.clip(x / step, 0.0, cost.shape[0] - 1.001)
    v = np.clip((y - left) / step, 0.0, cost.shape[1] - 1.001)
    i, j = u.astype(int), v.astype(int)
    a, b = u - i, v - j
    value = (1 - a) * ((1 - b) * cost[i, j] + b * cost[i, j + 1]) + a * (
        (1 - b) * cost[i + 1, j] + b * cost[i + 1, j + 1]
    )
    value = value + 0.01 * np.abs(wrap_angle(_RAYS - ahead))
    value[(x < 0.0) | (x > TILE_SIZE)] = np.inf
    return float(_RAYS[value.argmin()])
