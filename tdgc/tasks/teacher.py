"""A scripted expert, which the high policy imitates first.

It knows what the high policy has to infer from its cues: where the robot is on the tile, how fast
it moves, and the heights of the tile. From these it reads obstacles, trenches and slopes
(``tdgc.tasks.survey``) and is told nothing else, so it leads on any terrain, a family or a user's
map. Its styles were found with the shipped low policy (docs/experiments.md); how fast to walk, step
and leap is found anew for each low policy (``tdgc.tasks.manners``). Leaps over trenches show why
imitation comes first: they take pronk at nearly full speed with steps timed to a few centimetres,
which exploration that starts from a trot does not find.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tdgc.config import CommandRanges, RobotConfig, TeacherConfig
from tdgc.sim.commands import INDEX, VELOCITIES, CommandDecoder, default_command
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array, to_goal, wrap_angle
from tdgc.sim.tile import CELL, TILE_SAMPLES, TILE_SIZE, TileField
from tdgc.tasks.leaps import (
    BEYOND,
    FREQUENCIES,
    HEADING_GAIN,
    LENGTHS,
    SPEED,
    Landing,
    LeapPlan,
    Motion,
    leap_command,
    leaping,
    speed_up,
    steer_leap,
)
from tdgc.tasks.planning import LOOK, between
from tdgc.tasks.survey import GRID, survey


@dataclass(frozen=True)
class Style:
    """How to walk in trot, or to leap in pronk; the gait is not part of it.

    Attributes:
        speed: m/s, forward.
        frequency: Hz.
        swing_height, stance_width, body_height: m.
        duration: duty factor.
        pitch: rad, nose down positive.
        uphill: m/s; times the sine of a lateral slope, the uphill velocity that counters sliding.
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


_USUAL = TeacherConfig()
# Values other than Walk These Ways' defaults are from docs/experiments.md.
#: Style on steps and bumps; speed and frequency depend on the low policy, see ``Skill``.
UNEVEN = Style(
    _USUAL.walk_speed,
    frequency=_USUAL.step_frequency,
    swing_height=0.24,
    stance_width=0.32,
    body_height=0.05,
    duration=0.55,
    pitch=-0.07,
)
#: Style on lateral slopes.
SLOPING = Style(0.6, frequency=3.5, swing_height=0.14, uphill=0.45)
#: Style of leaps, in pronk, see ``tdgc.tasks.leaps``.
LEAPING = Style(SPEED, stance_width=0.3, body_height=0.02, pitch=-0.1)


@dataclass(frozen=True)
class Skill:
    """What the teacher has to know of the low policy that it commands.

    Attributes:
        landing: where its feet land in leaps; None for a policy that cannot leap, which walks over
            trenches.
        manner: how fast it walks, steps and leaps best.
    """

    landing: Landing | None = None
    manner: TeacherConfig = _USUAL

    @property
    def uneven(self) -> Style:
        """Style on steps and bumps, and wherever there is no reason for another."""
        manner = self.manner
        return replace(UNEVEN, speed=manner.walk_speed, frequency=manner.step_frequency)

    @property
    def among_obstacles(self) -> Style:
        """Style among obstacles: a sixth slower, 0.5 m/s in the usual manner."""
        return replace(self.uneven, speed=5.0 * self.manner.walk_speed / 6.0)


#: m before a trench at which leaps begin, since the probes, which reach 1.2 m, show it there.
SIGHT = 1.15

# s after which a speed that was seen counts for half in the estimate, chosen by hand: speeds
# oscillate within a gait cycle.
_HALF_LIFE = 0.1
_RAYS = np.linspace(-np.pi, np.pi, 24, endpoint=False)  # directions that are compared, 15 degrees
# rad, least angle between two ways whose mean would lead into the obstacle; chosen by hand.
_APART = 0.9
#: Commands in which the two ways around an obstacle differ.
WAY = [INDEX[name] for name in VELOCITIES]


_DISTANCE_GAIN = 1.0  # 1/s, by hand: a robot slows down where it could arrive within a second


def toward(
    distance: Array,
    error: Array,
    top_speed: Array | float,
    turns: tuple[float, float] = CommandRanges().yaw_rate,
) -> tuple[Array, Array]:
    """Forward speed in m/s and yaw rate in rad/s towards a point, (M,) each.

    The speed is proportional to the distance, up to ``top_speed``, and falls with the cosine of the
    heading error to 0 when the robot faces away; the yaw rate is proportional to that error.

    Args:
        distance, error: (M,) m to the point, and (M,) rad, its bearing relative to the heading.
        top_speed: m/s, (M,) or a scalar.
        turns: rad/s, lowest and highest yaw rate.
    """
    speed = np.minimum(top_speed, _DISTANCE_GAIN * distance)
    turn = np.clip(HEADING_GAIN * error, *turns)
    return speed * np.maximum(np.cos(error), 0.0), turn


class Teacher:
    """Commands M robots, each on a tile of its own.

    Args:
        field: M tiles.
        ranges: ranges of the commands that it may give.
        robot: configuration of the robots; a gait may begin faster than commanded.
        skill: what it has to know of the low policy.

    Attributes:
        speed: (M,) m/s forward, an estimate from how leaps speed up and from the speeds seen.
        price: (M, FREQUENCIES, LENGTHS) for the last ``commands``, how much more than the best
            choice each step frequency with each stance length would have cost; 0 for robots that
            do not leap.
        other: (M, 15) the last ``commands``, but along the second way around an obstacle; the same
            commands where there is no second way.
        dearer: (M,) m, how much longer the second way is, including the cost of being near
            obstacles.
    """

    def __init__(
        self, field: TileField, ranges: CommandRanges, robot: RobotConfig, skill: Skill
    ) -> None:
        m = field.count
        self._field, self._ranges, self._landing = field, ranges, skill.landing
        self._origin = field.origin(np.arange(m))
        commands = np.array([style.command() for style in (skill.uneven, SLOPING, LEAPING)])
        # The ranges may be narrower than the styles use.
        self._uneven, self._sloping, self._leap = CommandDecoder(ranges).nearest(commands)
        self.speed = np.zeros(m)
        self.price = np.zeros((m, FREQUENCIES, LENGTHS))
        self.other = np.zeros((m, len(default_command())))
        self.dearer = np.zeros(m)
        self._slope = np.zeros((m, TILE_SAMPLES, field.heights.shape[1]))
        self._costs: dict[int, Array] = {}  # of travelling, on tiles with obstacles
        self._walk_speed, self._wanted_speed = skill.manner.walk_speed, skill.manner.leap_speed
        self._careful = skill.among_obstacles.speed
        self._plan = LeapPlan(m, ranges, robot, speed=self._wanted_speed)
        self._leap_speed = min(self._wanted_speed, ranges.vx[1])
        self._start = np.full(m, np.inf)  # m, x where a robot starts to leap
        self._end = np.full(m, -np.inf)  # m, x where a robot stops leaping

    def begin(self, index: NDArray[np.integer], goal: Array) -> None:
        """Plan leaps and ways around obstacles on the tiles of the robots ``index`` (n,).

        Args:
            index: the robots.
            goal: (M, 2) m in the world.
        """
        field, n = self._field, TILE_SAMPLES
        self.speed[index] = 0.0
        self._start[index], self._end[index] = np.inf, -np.inf
        for i in index.tolist():
            heights = field.heights[i * n : (i + 1) * n]
            found = survey(heights, field.crop, goal[i] - self._origin[i])
            self._slope[i] = found.slope
            self._costs.pop(i, None)
            if found.cost is not None:
                self._costs[i] = found.cost
            if self._landing is not None and len(found.trenches):
                self._plan.look(i, found.trenches, self._landing.spread)
                self._start[i] = found.trenches[0, 0] - SIGHT
                self._end[i] = found.trenches[-1, 1] + BEYOND

    def watch(self, loco: Locomotion, seconds: float) -> None:
        """Update the speed estimates; to be called once per decision of ``seconds``."""
        _, faster = speed_up(self.speed, self._leap_speed, seconds)
        self.speed = np.where(leaping(loco.clock), faster, self.speed)
        seen = 1.0 - 0.5 ** (seconds / _HALF_LIFE)
        self.speed += seen * (loco.world.state.heading_vel[:, 0] - self.speed)

    def commands(self, loco: Locomotion, goal: Array) -> Array:
        """Commands (M, 15) for the coming decision; ``goal`` (M, 2) m in the world."""
        state = loco.world.state
        distance, bearing = to_goal(state, goal)
        local = state.position[:, :2] - self._origin
        second = bearing.copy()
        self.dearer[:] = 0.0
        detour = np.zeros(len(distance), dtype=bool)
        for i, cost in self._costs.items():
            detour[i] = True
            if distance[i] > LOOK:
                at = local[i], bearing[i]
                bearing[i], second[i], self.dearer[i] = _ways(cost, self._field.crop, *at)
        slope = self._slope_at(local)
        sloping = slope != 0.0
        command = np.where(sloping[:, None], self._sloping, self._uneven)
        top_speed = np.where(sloping, SLOPING.speed, self._walk_speed)
        top_speed[detour] = self._careful
        climb = SLOPING.uphill * np.sin(np.arctan(slope))
        self.other = command.copy()
        for way, toward_bearing in ((command, bearing), (self.other, second)):
            way[:, WAY] = self._walk(state.yaw, distance, toward_bearing, top_speed, detour, climb)
        self.price[:] = 0.0
        rows = np.flatnonzero((local[:, 0] >= self._start) & (local[:, 0] < self._end))
        if rows.size and self._landing is not None:
            leaps = np.tile(self._leap, (len(rows), 1))
            ways = bearing[rows], state.yaw[rows]
            steer_leap(leaps, *ways, self._ranges, self._wanted_speed)
            commanded = np.full(len(rows), self._leap_speed)
            motion = Motion.of(loco, rows, local[rows, 0], self.speed[rows], commanded)
            lesson = self._plan.lesson(rows, motion, self._landing)
            leap_command(leaps, lesson.frequency, lesson.length, self._ranges)
            command[rows], self.price[rows] = leaps, lesson.price
            self.other[rows], self.dearer[rows] = leaps, 0.0
        return command

    def _slope_at(self, local: Array) -> Array:
        """Tangents of the slopes at (M, 2) m in the tiles' frames, (M,)."""
        m, n, width = self._slope.shape
        at = np.round((local - [0.0, self._field.crop]) / CELL).astype(int)
        i, j = np.clip(at, 0, [n - 1, width - 1]).T
        return self._slope[np.arange(m), i, j]

    def _walk(
        self,
        yaw: Array,
        distance: Array,
        bearing: Array,
        top_speed: Array,
        detour: NDArray[np.bool_],
        climb: Array,
    ) -> Array:
        """Velocities ``WAY`` (M, 3) towards points.

        Args:
            yaw: (M,) rad.
            distance, bearing: (M,) m and rad, of the points.
            top_speed: (M,) m/s.
            detour: (M,) robots that walk around obstacles: they may move in any direction, also
                backward, off one that they lean on.
            climb: (M,) m/s to the tile's left, against sliding down a slope.
        """
        error = wrap_angle(bearing - yaw)
        speed, turn = toward(distance, error, top_speed, turns=self._ranges.yaw_rate)
        any_way = np.where(detour, np.minimum(top_speed, distance), 0.0)
        speed = np.where(detour, any_way * np.cos(error), speed)
        vx = np.clip(speed + climb * np.sin(yaw), *self._ranges.vx)
        vy = np.clip(any_way * np.sin(error) + climb * np.cos(yaw), *self._ranges.vy)
        return np.column_stack([vx, vy, turn])


def _ways(cost: Array, left: float, at: Array, ahead: float) -> tuple[float, float, float]:
    """Cheapest and second cheapest direction in rad from ``at`` (2,) m, and the difference in cost.

    The difference is in m. The second direction is a local minimum of the travel cost, below the
    cost at ``at`` and more than ``_APART`` from the first; without one, the first is returned
    twice. Near ties go to the direction closest to ``ahead``.
    """

    def to_go(x: Array | float, y: Array | float) -> Array:
        cells = np.column_stack([x, y - left]) / GRID
        return between(cost, np.clip(cells, 0.0, np.array(cost.shape) - 1.001))

    x, y = at[0] + LOOK * np.cos(_RAYS), at[1] + LOOK * np.sin(_RAYS)
    value = to_go(x, y) + 0.01 * np.abs(wrap_angle(_RAYS - ahead))
    outside = (x < 0.0) | (x > TILE_SIZE)
    if not outside.all():  # nothing is left to compare for a robot that has left its tile
        value[outside] = np.inf
    first = value.argmin()
    least = (value <= np.roll(value, 1)) & (value <= np.roll(value, -1)) & (value < to_go(*at))
    apart = np.abs(wrap_angle(_RAYS - _RAYS[first])) > _APART
    second = min(np.flatnonzero(least & apart), key=value.item, default=first)
    return float(_RAYS[first]), float(_RAYS[second]), float(value[second] - value[first])
