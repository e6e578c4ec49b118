"""Crossings: training episodes that lead across a tile, as the high policy will ask for.

A crossing robot is steered from the start platform to a waypoint on the goal platform, facing the
way it goes or any other direction. Its pitch follows the slope to a random degree, and over
trenches most robots leap. Levels rise with successful crossings.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tdgc.config import LowLevelConfig
from tdgc.sim.commands import INDEX, command_bounds
from tdgc.sim.families import MAX_LEVEL
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array, to_goal, wrap_angle
from tdgc.sim.tile import TILE_SIZE, TileField
from tdgc.tasks.command_draw import PRONK
from tdgc.tasks.episodes import Episodes
from tdgc.tasks.ground import Ground
from tdgc.tasks.leaps import (
    DURATION,
    SPEED,
    STRIDE,
    STRIDE_COMMANDS,
    SWING_HEIGHT,
    Landing,
    LeapPlan,
    Motion,
)
from tdgc.tasks.rules import GOAL_RADIUS
from tdgc.tasks.tiles import FLAT

Ints = NDArray[np.int64]
_YAW_RATE, _PITCH = INDEX["yaw_rate"], INDEX["pitch"]
# m from a lip, further than leaps need: what is learned here is to land where commanded.
_CLEAR = 0.08


def within(velocity: Array, low: Array, high: Array) -> Array:
    """Velocities (M, 2) scaled down to their bounds (2,) with their directions kept; a component
    whose bound is zero is dropped instead of stopping the whole motion."""
    bound = np.where(velocity < 0.0, -low, high)
    free = bound > 0.0
    over = np.where(free, np.abs(velocity) / np.where(free, bound, 1.0), 0.0)
    return np.where(free, velocity, 0.0) / np.maximum(over.max(axis=1), 1.0)[:, None]


class Crossings:
    """Steers M robots over their tiles.

    Args:
        config: the MDP.
        families: (M,) names of the tiles' families; on flat tiles no robot crosses.
        episodes: the robots' episodes, changed in place.
        rng: source of all random draws.

    Attributes:
        flat: (M,) robots on flat tiles.
        leapers: (M,) robots on tiles with trenches, which they leap over.
        landing: that of the current low policy, learned from its leaps.
        spread: (M,) m, ``landing.spread`` as it was when each robot's leaps were planned.
    """

    def __init__(
        self,
        config: LowLevelConfig,
        families: Sequence[str],
        episodes: Episodes,
        rng: np.random.Generator,
    ) -> None:
        self._config, self._episodes, self._rng = config.crossing, episodes, rng
        self._levels = config.levels
        self._low, self._high = command_bounds(config.commands).T
        self.flat = np.array([family == FLAT for family in families])
        self.leapers = np.zeros(len(families), dtype=bool)
        self._plan = LeapPlan(len(families), config.commands, config.robot, _CLEAR)
        self.landing = Landing()
        self.spread = np.zeros(len(families))

    def look(self, field: TileField, index: NDArray[np.integer]) -> None:
        """Plan the leaps of the robots ``index`` (n,) over the trenches of their new tiles."""
        self.spread[index] = self.landing.spread
        self.plan(field, index)

    def plan(self, field: TileField, index: NDArray[np.integer]) -> None:
        """Plan the leaps of the robots ``index`` (n,) with the ``spread`` stored by ``look``."""
        for i in index.tolist():
            trenches = field.features[i].trenches
            self.leapers[i] = len(trenches) > 0
            if self.leapers[i]:
                self._plan.look(i, trenches, float(self.spread[i]))

    # ------------------------------------------------------------------ what is drawn

    def begin(self, index: NDArray[np.integer], origin: Array, goal: Array) -> None:
        """Draw which of the robots ``index`` (n,) cross in their new episodes.

        Args:
            index: robots whose episodes begin.
            origin, goal: (n, 2) m in the world, the tiles' origins and the goals on them.
        """
        e = self._episodes
        e.origin[index], e.waypoint[index] = origin, goal
        drawn = self._rng.uniform(size=len(index)) < self._config.share
        e.crossing[index] = drawn & ~self.flat[index]

    def narrow(
        self, index: NDArray[np.integer], levels: Ints, gaits: Array, low: Array, high: Array
    ) -> None:
        """Narrow ``CommandDraw.bounds`` in place for those of the robots ``index`` (n,) that cross.

        The higher a robot's level in ``levels`` (M,), the narrower its bounds: a foot that must
        clear a 15 cm step, or a trunk that bends away from a 0.4 rad slope, cannot follow the other
        commands and learns nothing from them.
        """
        c, crossing = self._config, self._episodes.crossing[index]
        gaits[crossing] = c.gaits
        gaits[crossing & self.leapers[index]] = c.trench_gaits
        d = np.where(crossing, levels[index] / MAX_LEVEL, 0.0)
        swing, height, bend = INDEX["swing_height"], INDEX["body_height"], [_PITCH, INDEX["roll"]]
        clearance = c.clearance[0] + d * (c.clearance[1] - c.clearance[0])
        low[:, swing] = np.minimum(low[:, swing] + crossing * clearance, high[:, swing])
        low[:, height] *= 1.0 - d
        low[:, bend] *= (1.0 - (1.0 - c.bend) * d)[:, None]
        high[:, bend] *= (1.0 - (1.0 - c.bend) * d)[:, None]
        for j in (height, *bend):  # ranges without 0 narrow to their end that is nearest to it
            low[:, j] = np.clip(low[:, j], self._low[j], self._high[j])
            high[:, j] = np.clip(high[:, j], self._low[j], self._high[j])

    def draw(self, index: NDArray[np.integer], gait: Ints, values: Array, grown: float) -> None:
        """Draw how the robots ``index`` (n,) cross, given their gaits (n,) and continuous commands
        (n, 12).

        For leaps, swing height, duty factor, frequency and stance length are overwritten in place,
        and the speed is multiplied by ``grown``, the share of the velocity ranges that pronk has
        reached.
        """
        n, rng, c, e = len(index), self._rng, self._config, self._episodes
        leaps = e.crossing[index] & self.leapers[index] & (gait == PRONK)
        swing = INDEX["swing_height"]
        low = self._low[swing]
        highest = np.clip(SWING_HEIGHT, low, self._high[swing])
        values[leaps, swing] = rng.uniform(low, highest, int(leaps.sum()))
        for j, usual in (
            (INDEX["duration"], DURATION),  # the duty factor that landings are planned for
            *zip(STRIDE_COMMANDS, (SPEED / STRIDE, STRIDE), strict=True),  # until a plan is made
        ):
            values[leaps, j] = np.clip(usual, self._low[j], self._high[j])
        e.leaping[index] = leaps
        e.follow[index] = np.where(leaps, 0.0, rng.uniform(size=n))
        e.pitch[index] = values[:, _PITCH]
        slow, fast = rng.uniform(*c.speed, n), rng.uniform(*c.leap_speed, n)
        e.speed[index] = np.where(leaps, grown * fast, slow)
        anywhere = rng.uniform(-np.pi, np.pi, n)
        ahead = leaps | (rng.uniform(size=n) < c.facing)
        e.facing[index] = np.where(ahead, 0.0, anywhere)

    # ------------------------------------------------------------------ step by step

    def steer(self, loco: Locomotion, ground: Ground, index: NDArray[np.integer]) -> None:
        """Point the commands of those of the robots ``index`` (n,) that cross at their waypoints,
        and record arrivals."""
        e, state, command = self._episodes, loco.world.state, loco.command
        rows = index[e.crossing[index]]
        if not rows.size:
            return
        distance, bearing = to_goal(state, e.waypoint)
        e.reached |= e.crossing & (distance < GOAL_RADIUS)
        direction = bearing - state.yaw
        velocity = e.speed[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
        velocity = within(velocity, self._low[:2], self._high[:2])
        # A leap faces across the trenches, so that both feet of a pair land on one line.
        heading = np.where(e.leaping, 0.0, bearing + e.facing)
        turn = self._config.heading_gain * wrap_angle(heading - state.yaw)
        pitch = e.pitch - e.follow * ground.slope()
        command[rows, :2] = velocity[rows]
        for j, wanted in ((_YAW_RATE, turn), (_PITCH, pitch)):
            command[rows, j] = np.clip(wanted, self._low[j], self._high[j])[rows]
        self._time_leaps(loco, rows)

    def _time_leaps(self, loco: Locomotion, crossing: NDArray[np.integer]) -> None:
        e, state = self._episodes, loco.world.state
        due = e.leaping & (e.elapsed % self._config.leap_decimation == 0)
        rows = crossing[due[crossing]]
        if rows.size:
            x = (state.position[:, 0] - e.origin[:, 0])[rows]
            motion = Motion.of(loco, rows, x, state.heading_vel[rows, 0], e.speed[rows])
            strides = self._plan.steps(rows, motion, self.landing)
            loco.command[np.ix_(rows, STRIDE_COMMANDS)] = np.column_stack(strides)

    def learn_landing(self, loco: Locomotion, clock: Array) -> None:
        """Learn where feet land from the leaps of a step; ``clock`` (M,) is from before it."""
        rows = np.flatnonzero(self._episodes.leaping)
        self.landing.learn(loco, rows, clock[rows], self._config.landing_rate)

    def move(
        self, levels: Ints, x: Array, ended: NDArray[np.bool_], tried: NDArray[np.bool_]
    ) -> Ints:
        """Levels (M,) after a step, moved as legged_gym does.

        A robot moves up when it has crossed its tile, and down when it got less far than the share
        ``demotion`` of the tile; one that crosses the last level continues on a random one.

        Args:
            levels: (M,) levels before the step.
            x: (M,) m, the robots' positions along their tiles.
            ended: (M,) robots whose episodes end with this step.
            tried: (M,) those of them that fell or used the full time of an episode.
        """
        e, c = self._episodes, self._config
        crossed = ended & e.crossing & e.reached
        short = tried & e.crossing & ~e.reached & (x < c.demotion * TILE_SIZE)
        levels = levels + crossed - short
        solved = levels >= self._levels
        levels[solved] = self._rng.integers(0, self._levels, int(solved.sum()))
        return np.maximum(levels, 0)
