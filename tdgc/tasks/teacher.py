"""A scripted expert on each training family, which the high policy first imitates.

It is told what the high policy has to find out from its cues: where on the tile the robot is and
how fast, the way around the pillars, the lines of the trenches. How a family wants to be walked was
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
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array, wrap_angle
from tdgc.sim.terrain import CELL, TILE_SAMPLES, TILE_SIZE, TileField
from tdgc.tasks.leaps import SPEED, Landing, LeapPlan, leap_command


@dataclass(frozen=True)
class Style:
    """How to walk: speed in m/s, frequency in Hz, swing height and stance width in m."""

    speed: float
    frequency: float = 3.0
    swing_height: float = 0.08
    stance_width: float = 0.25


#: A family's style. Numbers beside the defaults of Walk These Ways are from docs/experiments.md.
STYLES = {
    "rough": Style(0.6, swing_height=0.2, stance_width=0.32),
    "pillar": Style(0.5),
    "stair": Style(0.6, swing_height=0.2, stance_width=0.35),
    "gap": Style(SPEED),  # in pronk, see ``tdgc.tasks.leaps``
    "tilt": Style(0.6, frequency=3.5, swing_height=0.2),
}
#: Of families that have none: straight on with high feet, as ``gp`` walks.
PLAIN = Style(0.6, swing_height=0.2)
_BEYOND = 0.5  # m behind the last trench, where leaping ends
_LEAP_TURN = 1.5  # 1/s, yaw rate per rad that a leap is off its heading; as in ``toward``

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
    turns: tuple[float, float] = CommandRanges().yaw_rate,
) -> tuple[Array, Array]:
    """Forward speed in m/s and yaw rate in rad/s towards a point, (M,) each.

    As fast as the distance asks, turning by the heading error, and slower while facing away.

    Args:
        distance, error: (M,) m and rad, of the point's bearing against the heading.
        top_speed: (M,) or one for all, m/s.
        distance_gain, heading_gain: 1/s.
        turns: rad/s, least and greatest yaw rate.
    """
    speed = np.minimum(top_speed, distance_gain * distance)
    turn = np.clip(heading_gain * error, *turns)
    return speed * np.maximum(np.cos(error), 0.0), turn


def travel_cost(pillars: Array, width: int, left: float, goal: Array) -> tuple[Array, float, float]:
    """Cost of travelling to the goal from all over a tile, around its pillars.

    Args:
        pillars: (k, 3) m, x, y and diameter.
        width: samples across the tile.
        left: m, y of the first of them in the tile's frame.
        goal: (2,) m.

    Returns:
        The field (81, width // 2 + 1), its step in m, and ``left``.
    """
    step = _COARSE * CELL
    x = np.arange(0, TILE_SAMPLES, _COARSE) * CELL
    y = left + np.arange(0, width, _COARSE) * CELL
    away = np.full((len(x), len(y)), np.inf)
    for cx, cy, diameter in pillars:
        distance = np.hypot(x[:, None] - cx, y - cy) - 0.5 * diameter
        np.minimum(away, distance, out=away)
    near = np.clip((_WIDE - away) / (_WIDE - _RADIUS), 0.0, 1.0)
    price = np.where(away < _RADIUS, _BLOCKED, 1.0 + (_CLOSE - 1.0) * near)
    cost = np.full((len(x) + 2, len(y) + 2), np.inf)  # a border around all
    inside = np.s_[1:-1, 1:-1]
    at = np.clip(np.round((goal - [0.0, left]) / step).astype(int), 0, np.array(away.shape) - 1)
    cost[at[0] + 1, at[1] + 1] = 0.0
    shifts = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0)]
    while True:
        before = cost[inside].copy()
        for a, b in shifts:
            neighbour = cost[1 + a : 1 + a + len(x), 1 + b : 1 + b + len(y)]
            np.minimum(cost[inside], neighbour + np.hypot(a, b) * step * price, out=cost[inside])
        if np.array_equal(before, cost[inside]):
            return cost[inside].copy(), step, left


class Teacher:
    """Commands robots on tiles of their own.

    Args:
        field: (M, 1) tiles.
        families: of the robots, (M,) names.
        ranges: of the commands that their low policy was trained on.
        landing: of the low policy; None for one that does not leap, which walks over trenches.
    """

    def __init__(
        self,
        field: TileField,
        families: Sequence[str],
        ranges: CommandRanges,
        landing: Landing | None,
    ) -> None:
        m = len(families)
        self._field, self._ranges, self._landing = field, ranges, landing
        self._origin = field.origin(np.arange(m), 0)
        self._leaps = np.array([family == "gap" and landing is not None for family in families])
        self._pillars = np.array([family == "pillar" for family in families])
        styles = [
            PLAIN if family == "gap" and landing is None else STYLES.get(family, PLAIN)
            for family in families
        ]
        self._command = np.tile(default_command(), (m, 1))
        for name in ("frequency", "swing_height", "stance_width"):
            self._command[:, INDEX[name]] = [getattr(style, name) for style in styles]
        self._speed = np.array([style.speed for style in styles])
        self._plan = LeapPlan(m, ranges)
        self._end = np.full(m, -np.inf)  # m, x where a robot has no more to leap over
        self._fields: dict[int, tuple[Array, float, float]] = {}

    def begin(self, index: NDArray[np.integer], goal: Array) -> None:
        """Look at the tiles of the robots ``index`` (n,); ``goal`` (M, 2) m in the world."""
        width = self._field.heights.shape[1]
        for i in index[self._leaps[index]]:
            trenches = self._field.features[int(i), 0].trenches
            assert self._landing is not None  # or nobody leaps
            self._plan.look(int(i), trenches, self._landing.spread)
            self._end[i] = trenches[-1, 1] + _BEYOND
        for i in index[self._pillars[index]]:
            pillars, target = self._field.features[int(i), 0].pillars, goal[i] - self._origin[i]
            self._fields[int(i)] = travel_cost(pillars, width, self._field.crop, target)

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
        speed, turn = toward(distance, error, self._speed, turns=self._ranges.yaw_rate)
        command[:, INDEX["vx"]], command[:, INDEX["yaw_rate"]] = speed, turn
        rows = np.flatnonzero(self._leaps & (local[:, 0] < self._end))
        if rows.size and self._landing is not None:
            # Facing across the trenches both feet of a pair land on one line; sideways to the goal.
            leaps, fast = command[rows], self._speed[rows]
            leaps[:, INDEX["vx"]] = fast * np.cos(bearing[rows])
            leaps[:, INDEX["vy"]] = np.clip(fast * np.sin(bearing[rows]), *self._ranges.vy)
            turn = np.clip(-_LEAP_TURN * state.yaw[rows], *self._ranges.yaw_rate)
            leaps[:, INDEX["yaw_rate"]] = turn
            steps = self._plan.steps(
                rows,
                local[rows, 0],
                state.heading_vel[rows, 0],
                loco.clock.clock[rows],
                self._landing,
            )
            leap_command(leaps, *steps)
            command[rows] = leaps
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
