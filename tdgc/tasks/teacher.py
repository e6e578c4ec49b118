"""A scripted expert for each training family, which the high policy imitates first.

It is told what the high policy has to infer from its cues: the robot's position on the tile and its
speed, the way around pillars, and where the trenches are. How to walk on each family was found by
trials on training tiles (docs/experiments.md). Leaps over trenches show why imitation comes first:
they take pronk at nearly full speed with steps timed to a few centimetres, which exploration that
starts from a trot does not find.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tdgc.config import CommandRanges
from tdgc.sim.commands import CONTINUOUS, INDEX, default_command
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array, wrap_angle
from tdgc.sim.terrain import CELL, TILE_SAMPLES, TILE_SIZE, UNNAMED, TileField
from tdgc.tasks.leaps import (
    BEYOND,
    FREQUENCIES,
    LENGTHS,
    SPEED,
    Landing,
    LeapPlan,
    Motion,
    leap_command,
    speed_up,
    steer_leap,
)
from tdgc.tasks.planning import LOOK, between, cost_to_go, price_near


@dataclass(frozen=True)
class Style:
    """How to walk in trot.

    Attributes:
        speed: m/s, forward.
        frequency: Hz.
        swing_height, stance_width, body_height: m.
        duration: duty factor.
        pitch: rad, nose down positive.
        uphill: m/s, times the sine of a lateral slope: the velocity up that slope, against sliding
            down.
    """

    speed: float
    frequency: float = 3.0
    swing_height: float = 0.08
    stance_width: float = 0.25
    body_height: float = 0.0
    duration: float = 0.5
    pitch: float = 0.0
    uphill: float = 0.0

    def command(self) -> Array:
        """The style as a command to stand still, (15,)."""
        command = default_command()
        for name in (
            "frequency", "swing_height", "stance_width", "body_height", "duration", "pitch"
        ):  # fmt: skip
            command[INDEX[name]] = getattr(self, name)
        return command


#: Style on steps and bumps, and for families without a style of their own.
UNEVEN = Style(
    0.6,
    frequency=2.3,
    swing_height=0.24,
    stance_width=0.32,
    body_height=0.05,
    duration=0.55,
    pitch=-0.07,
)
#: Style of each family. Values other than Walk These Ways' defaults are from docs/experiments.md.
STYLES = {
    "rough": UNEVEN,
    # Slower, with feet and trunk as high: what looks like a pillar from afar may be a step on
    # unfamiliar ground.
    "pillar": dataclasses.replace(UNEVEN, speed=0.5),
    "stair": UNEVEN,
    # In pronk, see ``tdgc.tasks.leaps``.
    "gap": Style(SPEED, stance_width=0.3, body_height=0.02, pitch=-0.1),
    "tilt": Style(0.6, frequency=3.5, swing_height=0.14, uphill=0.45),
    **dict.fromkeys(UNNAMED, UNEVEN),
}

#: m ahead at which the probes see a trench; they reach 1.2 m.
SIGHT = 1.15

# Ways around pillars follow a field of travel costs on every second sample of the tile.
_COARSE = 2
_SEEN = 0.5  # weight of a newly seen speed in the estimate: it oscillates within a gait cycle
_WIDE = 0.55  # m from a pillar, beyond which it adds no cost
_RAYS = np.linspace(-np.pi, np.pi, 24, endpoint=False)
_APART = 0.9  # rad, least angle between two ways whose mean would lead into the obstacle
#: Commands in which the two ways around a pillar differ.
WAY = [INDEX[name] for name in ("vx", "vy", "yaw_rate")]


def toward(
    distance: Array,
    error: Array,
    top_speed: Array | float,
    distance_gain: float = 1.0,
    heading_gain: float = 1.5,
    turns: tuple[float, float] = CommandRanges().yaw_rate,
) -> tuple[Array, Array]:
    """Forward speed in m/s and yaw rate in rad/s towards a point, (M,) each.

    The speed is proportional to the distance, up to ``top_speed``, and falls with the cosine of the
    heading error to 0 when the robot faces away; the yaw rate is proportional to that error.

    Args:
        distance, error: (M,) m to the point, and (M,) rad, its bearing relative to the heading.
        top_speed: m/s, (M,) or a scalar.
        distance_gain, heading_gain: 1/s.
        turns: rad/s, lowest and highest yaw rate.
    """
    speed = np.minimum(top_speed, distance_gain * distance)
    turn = np.clip(heading_gain * error, *turns)
    return speed * np.maximum(np.cos(error), 0.0), turn


def travel_cost(pillars: Array, width: int, left: float, goal: Array) -> tuple[Array, float, float]:
    """Cost of travelling to the goal, around pillars, from every point of a tile.

    Args:
        pillars: (k, 3) m, x, y and diameter.
        width: samples across the tile.
        left: m, y of the first of these samples in the tile's frame.
        goal: (2,) m in the tile's frame.

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
    cost = np.full(away.shape, np.inf)
    at = np.clip(np.round((goal - [0.0, left]) / step).astype(int), 0, np.array(away.shape) - 1)
    cost[at[0], at[1]] = 0.0
    return cost_to_go(cost, step * price_near(away, _WIDE)), step, left


class Teacher:
    """Commands M robots, each on a tile of its own.

    Args:
        field: (M, 1) tiles.
        families: (M,) names of the tiles' families.
        ranges: command ranges that the low policy was trained on.
        landing: the low policy's; None for one that cannot leap, which walks over trenches.

    Attributes:
        speed: (M,) m/s forward, an estimate from how leaps speed up and from the speeds seen.
        price: (M, FREQUENCIES, LENGTHS) for the last ``commands``, how much more than the best
            choice each step frequency with each stance length would have cost; 0 for robots that
            do not leap.
        other: (M, 15) the last ``commands``, but along the second way around an obstacle; the same
            commands where there is no second way.
        dearer: (M,) m, how much longer the second way is, including the cost of being near pillars.
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
        self._gap = np.array([family == "gap" for family in families])
        self._detours = np.array([family in ("pillar", *UNNAMED) for family in families])
        styles = [
            UNEVEN if family == "gap" and landing is None else STYLES.get(family, UNEVEN)
            for family in families
        ]
        commands = np.array([style.command() for style in [*styles, UNEVEN, STYLES["gap"]]])
        # The low policy may have been trained on narrower ranges than the styles use.
        bounds = np.array([getattr(ranges, name) for name in CONTINUOUS])
        behaviour = commands[:, : len(CONTINUOUS)]
        np.clip(behaviour, bounds[:, 0], bounds[:, 1], out=behaviour)
        self._command, self._uneven, self._leap = commands[:-2], commands[-2], commands[-1]
        self.speed = np.zeros(m)
        self.price = np.zeros((m, FREQUENCIES, LENGTHS))
        self.other = np.zeros((m, len(default_command())))
        self.dearer = np.zeros(m)
        self._top_speed = np.array([style.speed for style in styles])
        self._uphill = np.array([style.uphill for style in styles])
        self._climb = np.zeros(m)  # m/s uphill, positive along the tile's y (left)
        self._plan = LeapPlan(m, ranges)
        self._leap_speed = min(SPEED, ranges.vx[1])
        self._start = np.full(m, -np.inf)  # m, x where a robot starts to leap
        self._end = np.full(m, -np.inf)  # m, x where a robot stops leaping
        self._fields: dict[int, tuple[Array, float, float]] = {}

    def begin(
        self, index: NDArray[np.integer], goal: Array, untold: NDArray[np.bool_] | None = None
    ) -> None:
        """Plan leaps and ways around pillars on the tiles of the robots ``index`` (n,).

        Args:
            index: the robots.
            goal: (M, 2) m in the world.
            untold: (M,) robots whose high policy is not told the family; none if None. Such a
                robot, like one on a family other than Gap, starts to leap only ``SIGHT`` m before
                the first trench, when it can see it.
        """
        width = self._field.heights.shape[1]
        self.speed[index] = 0.0
        slopes = [self._field.features[int(i), 0].slope for i in index]
        self._climb[index] = self._uphill[index] * np.sin(slopes)
        self._start[index] = self._end[index] = -np.inf
        for i in index:
            trenches = self._field.features[int(i), 0].trenches
            if self._landing is not None and len(trenches):
                self._plan.look(int(i), trenches, self._landing.spread)
                blind = not self._gap[i] or (untold is not None and untold[i])
                self._start[i] = trenches[0, 0] - SIGHT if blind else -np.inf
                self._end[i] = trenches[-1, 1] + BEYOND
        for i in index[self._detours[index]]:
            pillars, target = self._field.features[int(i), 0].pillars, goal[i] - self._origin[i]
            self._fields[int(i)] = travel_cost(pillars, width, self._field.crop, target)

    def watch(self, loco: Locomotion, seconds: float) -> None:
        """Update the speed estimates; to be called once per decision of ``seconds``."""
        _, self.speed = speed_up(self.speed, self._leap_speed, seconds)
        self.speed += _SEEN * (loco.world.state.heading_vel[:, 0] - self.speed)

    def commands(self, loco: Locomotion, goal: Array) -> Array:
        """Commands (M, 15) for the coming decision; ``goal`` (M, 2) m in the world."""
        state = loco.world.state
        offset = goal - state.position[:, :2]
        distance = np.linalg.norm(offset, axis=1)
        bearing = np.arctan2(offset[:, 1], offset[:, 0])
        local = state.position[:, :2] - self._origin
        second = bearing.copy()
        self.dearer[:] = 0.0
        for i, field in self._fields.items():
            if distance[i] > LOOK:
                bearing[i], second[i], self.dearer[i] = _ways(field, local[i], bearing[i])
        blind = local[:, 0] < self._start
        command = np.where(blind[:, None], self._uneven, self._command)
        top_speed = np.where(blind, UNEVEN.speed, self._top_speed)
        self.other = command.copy()
        for way, toward_bearing in ((command, bearing), (self.other, second)):
            way[:, WAY] = self._walk(state.yaw, distance, toward_bearing, top_speed)
        self.price[:] = 0.0
        rows = np.flatnonzero(~blind & (local[:, 0] < self._end))
        if rows.size and self._landing is not None:
            leaps = np.tile(self._leap, (len(rows), 1))
            steer_leap(leaps, bearing[rows], state.yaw[rows], self._ranges)
            commanded = np.full(len(rows), self._leap_speed)
            stride = loco.command[rows][:, [INDEX["frequency"], INDEX["stance_length"]]].T
            clock = loco.clock.clock[rows]
            motion = Motion(local[rows, 0], self.speed[rows], commanded, clock, *stride)
            lesson = self._plan.lesson(rows, motion, self._landing)
            leap_command(leaps, lesson.frequency, lesson.length)
            command[rows], self.price[rows] = leaps, lesson.price
            self.other[rows], self.dearer[rows] = leaps, 0.0
        return command

    def _walk(self, yaw: Array, distance: Array, bearing: Array, top_speed: Array) -> Array:
        """Velocities ``WAY`` (M, 3) towards points at ``distance`` m and ``bearing`` rad."""
        error = wrap_angle(bearing - yaw)
        speed, turn = toward(distance, error, top_speed, turns=self._ranges.yaw_rate)
        # Around obstacles a robot may move in any direction, also backward, off one it leans on.
        any_way = np.where(self._detours, np.minimum(top_speed, distance), 0.0)
        speed = np.where(self._detours, any_way * np.cos(error), speed)
        vx = np.clip(speed + self._climb * np.sin(yaw), *self._ranges.vx)
        vy = np.clip(any_way * np.sin(error) + self._climb * np.cos(yaw), *self._ranges.vy)
        return np.column_stack([vx, vy, turn])


def _ways(field: tuple[Array, float, float], at: Array, ahead: float) -> tuple[float, float, float]:
    """Cheapest and second cheapest direction in rad from ``at`` (2,) m, and the difference in cost.

    The difference is in m. The second direction is a local minimum of the travel cost, below the
    cost at ``at`` and more than ``_APART`` from the first; without one, the first is returned
    twice. Near ties go to the direction closest to ``ahead``.
    """
    cost, step, left = field

    def to_go(x: Array | float, y: Array | float) -> Array:
        cells = np.column_stack([x, y - left]) / step
        return between(cost, np.clip(cells, 0.0, np.array(cost.shape) - 1.001))

    x, y = at[0] + LOOK * np.cos(_RAYS), at[1] + LOOK * np.sin(_RAYS)
    value = to_go(x, y) + 0.01 * np.abs(wrap_angle(_RAYS - ahead))
    value[(x < 0.0) | (x > TILE_SIZE)] = np.inf
    first = value.argmin()
    least = (value <= np.roll(value, 1)) & (value <= np.roll(value, -1)) & (value < to_go(*at))
    apart = np.abs(wrap_angle(_RAYS - _RAYS[first])) > _APART
    second = min(np.flatnonzero(least & apart), key=value.item, default=first)
    return float(_RAYS[first]), float(_RAYS[second]), float(value[second] - value[first])
