"""A scripted law on the high policy's cues, for attribution: what is due to the cues, and what to
the learning.

``CuesLaw`` stands in for the high policy: it gets the same observation o^H and nothing else, but
for the benchmark's constants (where starts and goals lie along a tile) and where the low policy
lands when it leaps.
"""

import numpy as np
from numpy.typing import NDArray

from tdgc.benchmark.memory import Obstacles, Profile, Reckoning
from tdgc.config import HighLevelConfig, LowLevelConfig
from tdgc.sim.commands import INDEX, CommandDecoder, default_command
from tdgc.sim.observation import columns
from tdgc.sim.robot import Array, wrap_angle
from tdgc.sim.terrain import GOAL_X, ZONE
from tdgc.tasks.high_observation import GOAL_SCALE, SEMANTIC, high_layout
from tdgc.tasks.leaps import BEYOND, SPEED, Landing, LeapPlan, Motion, leap_command, steer_leap
from tdgc.tasks.probes import PROBE_RANGE, PROBES
from tdgc.tasks.teacher import STYLES, Style, toward

#: How to walk where no family is told: what rough ground, stairs and slopes have in common.
UNKNOWN = Style(0.6, frequency=3.2, swing_height=0.2, stance_width=0.33, uphill=0.45)

# m from a lip, which are worth keeping where it is known to some 5 cm: of 20 tiles each of levels
# 5, 7 and 9 of Gap 14, 10, 7 were crossed with the teacher's 5 cm, 19, 14, 12 with 8, 17, 20, 15
# with 12.
_CLEAR = 0.12
# m below the ground around: a trench, half way down its walls. Planned from lip to lip 26 of 100
# robots got over level 10, like this 54.
_DEEP = -0.3
_TALL = 0.35  # m above it: a pillar, as far as no stairs are about
_GROUND = 0.3  # m, what is further from the standing height is not the ground around
_WIDEST = 0.35  # m, a trench of level 10 from lip to lip, whose end is not in sight yet


class Memory:
    """What the law remembers of M robots.

    Attributes:
        told: (M,) names of families, as the semantic cue has them.
        where, profile, obstacles: see ``tdgc.benchmark.memory``.
        places: (2, M, 32, 2) m, where the probes were a decision ago.
        gap, pillar: (M,) whether there are trenches, and pillars; told or seen.
        slope: (M,) rad of the ground across the heading; positive where it rises to the left.
        x: (M,) m along the tile, a decision ago.
        plan: of landings; ``planned`` holds the lips (k, 2) m that each robot's plan is for.
        command: (M, 15) of the last decision.
    """

    def __init__(
        self, low: LowLevelConfig, told: list[str], distance: Array, bearing: Array
    ) -> None:
        m = len(told)
        self.told = told
        self.where = Reckoning(distance, bearing)
        self.profile, self.obstacles = Profile(m), Obstacles(m)
        self.places: Array | None = None
        self.gap = np.array([name == "gap" for name in told])
        self.pillar = np.array([name == "pillar" for name in told])
        self.unknown = np.array([name == "unknown" for name in told])
        self.slope = np.zeros(m)
        self.x = self.where.position[0, :, 0]
        self.plan = LeapPlan(m, low.commands, _CLEAR)
        self.planned = [np.full((1, 2), np.nan)] * m
        self.command = np.tile(default_command(), (m, 1))


class CuesLaw:
    """A high policy by hand: o^H -> actions, with a ``Memory`` for its state.

    Args:
        low: the low policy's MDP.
        landing: of the low policy; None for one that does not leap, which walks over trenches.
        config: the MDP of the decisions.
    """

    def __init__(
        self, low: LowLevelConfig, landing: Landing | None, config: HighLevelConfig
    ) -> None:
        self._low, self._landing, self._ranges = low, landing, low.commands
        self._dt = config.decimation * low.physics.control_dt
        self._points = PROBES[config.probes]
        self._ahead = self._points[:, 1] == 0.0
        self._columns = columns(high_layout(config))
        self._decoder = CommandDecoder(low.commands, config.action_limit)

    def predict(
        self, obs: NDArray[np.floating], state: Memory | None = None
    ) -> tuple[Array, Memory]:
        """Actions (M, 13) from o^H (M, size), and what is remembered for the next decision."""
        rows = np.asarray(obs, dtype=np.float64)
        cue = {name: rows[:, place] for name, place in self._columns.items()}
        distance = cue["goal"][:, 0] / GOAL_SCALE
        bearing = np.arctan2(cue["goal"][:, 2], cue["goal"][:, 1])
        if state is None:
            told = [SEMANTIC[k] for k in cue["family"].argmax(axis=1)]
            state = Memory(self._low, told, distance, bearing)
        else:
            velocity = state.command[:, [INDEX["vx"], INDEX["vy"]]]
            state.where.move(distance, bearing, velocity, self._dt)
        self._look(state, cue)
        before, state.command = state.command, self._walk(state, distance, bearing)
        if self._landing is not None:
            self._leap(state, cue, bearing, before, self._landing)
        # A low policy may have been trained on less than the styles ask for.
        state.command = np.clip(state.command, self._decoder.low, self._decoder.high)
        return self._decoder.encode(state.command), state

    def _look(self, memory: Memory, cue: dict[str, Array]) -> None:
        """Remember what the probes show."""
        probes = PROBE_RANGE * cue["probes"]
        # The trunk bobs, so heights are against the ground around; most of it is ground.
        level = np.where(np.abs(probes) < _GROUND, probes, np.nan)
        level[np.isnan(level).all(axis=1)] = 0.0
        ground = np.nanmedian(level, axis=1)
        height = probes - ground[:, None]
        aside = self._points[:, 1]
        memory.slope = np.arctan(height @ aside / np.sum(aside**2))
        line = height[:, self._ahead]
        jump = line[:, 2:] - line[:, :-2]  # over 10 cm, where a stair has one step at most
        far = line[:, 2:]
        trench = (jump < -_TALL) & (far < -_TALL)
        pillar = (jump > _TALL) & (far > _TALL)
        memory.gap |= memory.unknown & trench.any(axis=1)
        memory.pillar |= memory.unknown & pillar.any(axis=1)
        places = memory.where.points(self._points)
        before = places if memory.places is None else memory.places
        memory.places = places
        seen = np.where(cue["probe_age"][:, :, None] > 0.5, before, places)
        memory.profile.add(seen[..., 0], (height < _DEEP) & memory.gap[:, None], self._ahead)
        for i in np.flatnonzero(memory.pillar).tolist():
            memory.obstacles.add(i, seen[0, i, height[i] > _TALL])

    def _walk(self, memory: Memory, distance: Array, bearing: Array) -> Array:
        """Commands (M, 15) to the goal, around pillars, in the style of the family."""
        styles = [STYLES.get(name, UNKNOWN) for name in memory.told]
        command = np.array([style.command() for style in styles])
        fast = np.array([style.speed for style in styles])
        fast[memory.pillar] = STYLES["pillar"].speed
        error, goal = bearing.copy(), np.array([GOAL_X, 0.0])
        for i in np.flatnonzero(memory.pillar).tolist():
            heading, at = memory.where.heading[0, i], memory.where.position[0, i]
            way = memory.obstacles.direction(i, at, goal, heading + bearing[i])
            error[i] = wrap_angle(way - heading)
        speed, turn = toward(distance, error, fast, turns=self._ranges.yaw_rate)
        command[:, INDEX["vx"]], command[:, INDEX["yaw_rate"]] = speed, turn
        uphill = np.array([style.uphill for style in styles]) * np.sin(memory.slope)
        command[:, INDEX["vy"]] = np.clip(uphill, *self._ranges.vy)
        return command

    def _leap(
        self, memory: Memory, cue: dict[str, Array], bearing: Array, before: Array, landing: Landing
    ) -> None:
        """Turn the commands of robots that have trenches before them into those of leaps.

        ``before`` (M, 15) are the commands of the decision before.
        """
        track = memory.profile.track()
        tracks = np.maximum(track, 0).tolist()
        chosen = tracks, np.arange(len(tracks))
        heading, x = memory.where.heading[chosen], memory.where.position[chosen][:, 0]
        # Half way between the tracks while they cannot be told apart.
        heading = np.where(track < 0, memory.where.heading.mean(axis=0), heading)
        speed, memory.x = (x - memory.x) / self._dt, x
        leaping = []
        for i in np.flatnonzero(memory.gap).tolist():
            lips = memory.profile.trenches(i, tracks[i], _WIDEST)
            done = memory.unknown[i] or memory.profile.seen(i, tracks[i]) > ZONE[1]
            if done and x[i] > lips.max(initial=0.0) + BEYOND:
                continue
            if not np.array_equal(lips, memory.planned[i]):
                memory.plan.look(i, lips, landing.spread)
                memory.planned[i] = lips
            leaping.append(i)
        if leaping:
            rows = np.array(leaping)
            leaps = memory.command[rows]
            steer_leap(leaps, heading[rows] + bearing[rows], heading[rows], self._ranges)
            # In trot and pronk, at a duty factor of 0.5, the clock is the right front foot's phase.
            phase = np.arctan2(cue["clock"][rows, 1], cue["clock_cosine"][rows, 1])
            clock = np.mod(phase / (2.0 * np.pi), 1.0)
            commanded = np.full(len(rows), min(SPEED, self._ranges.vx[1]))
            stride = before[rows][:, [INDEX["frequency"], INDEX["stance_length"]]].T
            motion = Motion(x[rows], speed[rows], commanded, clock, *stride)
            leap_command(leaps, *memory.plan.steps(rows, motion, landing))
            memory.command[rows] = leaps
