"""A scripted law on the high policy's cues, to separate what learning adds from what the cues give.

``CuesLaw`` stands in for the high policy. It gets the same observation o^H and nothing else, except
the benchmark's constants (where starts and goals lie along a tile), and how fast the low policy
walks, steps and leaps best and where it lands.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from tdgc.benchmark.memory import Obstacles, Profile, Reckoning
from tdgc.config import HighLevelConfig, LowLevelConfig
from tdgc.sim.commands import INDEX, CommandDecoder, default_command, gait_index
from tdgc.sim.gaits import raw_phase
from tdgc.sim.observation import columns
from tdgc.sim.robot import Array, wrap_angle
from tdgc.sim.tile import GOAL_X, ZONE
from tdgc.tasks.command_draw import PRONK
from tdgc.tasks.high_observation import GOAL_SCALE, SEMANTIC, high_layout
from tdgc.tasks.leaps import (
    BEYOND,
    STRIDE_COMMANDS,
    Landing,
    LeapPlan,
    Motion,
    leap_command,
    steer_leap,
)
from tdgc.tasks.probes import PROBE_RANGE, PROBES
from tdgc.tasks.teacher import LEAPING, SLOPING, Skill, Style, toward

#: How to walk where the family is unknown: a compromise, chosen by hand, for rough ground, stairs
#: and slopes, with any low policy.
UNKNOWN = Style(0.6, frequency=3.2, swing_height=0.2, stance_width=0.33, uphill=0.45)

# m, clearance that a foothold should keep from a lip, whose position is known to about 5 cm. Of 20
# Gap tiles on each of levels 5, 7 and 9, the robots crossed 14, 10 and 7 with the teacher's 5 cm,
# 19, 14 and 12 with 8 cm, and 17, 20 and 15 with 12 cm.
_CLEAR = 0.12
# m, height relative to the surrounding ground below which a probe is in a trench: half way down the
# walls. With this, 54 of 100 robots crossed level 10; 26 did when trenches were planned from lip to
# lip.
_DEEP = -0.3
_TALL = 0.35  # m above the surrounding ground: a pillar, provided that there are no stairs
_GROUND = 0.3  # m, a probe further than this from the standing height does not see that ground
_WIDEST = 0.35  # m, assumed width of a trench whose end is out of sight: lip to lip at level 10


class Memory:
    """What the law remembers about M robots.

    Attributes:
        told: (M,) family names, from the semantic cue.
        where, profile, obstacles: see ``tdgc.benchmark.memory``.
        places: (2, M, 32, 2) m, probe positions on both tracks at the previous decision.
        gap, pillar: (M,) whether there are trenches, or pillars: told by the cue or seen.
        unknown: (M,) whether the cue reports the family as unknown.
        slope: (M,) rad, slope of the ground across the heading; positive if it rises to the left.
        x: (2, M) m, position along the tile on both tracks at the previous decision.
        clock, leapt: (M,) gait clock at the previous decision, and cycles since a leap began.
        plan: the plan of landings.
        planned: the lips (k, 2) m that each robot's plan was made for.
        command: (M, 15) commands of the last decision.
    """

    def __init__(self, plan: LeapPlan, told: list[str], distance: Array, bearing: Array) -> None:
        m = len(told)
        self.told = told
        self.where = Reckoning(distance, bearing)
        self.profile, self.obstacles = Profile(m), Obstacles(m)
        self.places: Array | None = None
        self.gap = np.array([name == "gap" for name in told])
        self.pillar = np.array([name == "pillar" for name in told])
        self.unknown = np.array([name == "unknown" for name in told])
        self.slope = np.zeros(m)
        self.x = self.where.position[..., 0]
        self.clock, self.leapt = np.zeros(m), np.zeros(m)
        self.plan = plan
        self.planned = [np.full((1, 2), np.nan)] * m
        self.command = np.tile(default_command(), (m, 1))


class CuesLaw:
    """A hand-written high policy: o^H -> actions, with a ``Memory`` as its state.

    Args:
        low: the low policy's MDP.
        skill: of the low policy.
        config: the MDP of the decisions.
    """

    def __init__(self, low: LowLevelConfig, skill: Skill, config: HighLevelConfig) -> None:
        self._landing, self._ranges, self._robot = skill.landing, low.commands, low.robot
        self._leap_speed = skill.manner.leap_speed
        self._styles = {  # how to walk on each family with this low policy
            "rough": skill.uneven,
            "pillar": skill.among_obstacles,
            "stair": skill.uneven,
            "gap": dataclasses.replace(LEAPING, speed=self._leap_speed),
            "tilt": SLOPING,
        }
        self._dt = config.decimation * low.physics.control_dt
        self._points = PROBES[config.probes]
        self._ahead = self._points[:, 1] == 0.0
        self._columns = columns(high_layout(config))
        self._decoder = CommandDecoder(low.commands, config.action_limit)

    def predict(
        self, obs: NDArray[np.floating], state: Memory | None = None
    ) -> tuple[Array, Memory]:
        """Return actions (M, 13) for o^H (M, size), and the memory for the next decision."""
        rows = np.asarray(obs, dtype=np.float64)
        cue = {name: rows[:, place] for name, place in self._columns.items()}
        distance = cue["goal"][:, 0] / GOAL_SCALE
        bearing = np.arctan2(cue["goal"][:, 2], cue["goal"][:, 1])
        if state is None:
            told = [SEMANTIC[k] for k in cue["family"].argmax(axis=1)]
            plan = LeapPlan(len(told), self._ranges, self._robot, _CLEAR, self._leap_speed)
            state = Memory(plan, told, distance, bearing)
        else:
            velocity = state.command[:, [INDEX["vx"], INDEX["vy"]]]
            state.where.move(distance, bearing, velocity, self._dt)
        self._look(state, cue)
        before, state.command = state.command, self._walk(state, distance, bearing)
        if self._landing is not None:
            self._leap(state, cue, bearing, before, self._landing)
        # The styles may exceed the command ranges that the low policy was trained on.
        state.command = self._decoder.nearest(state.command)
        return self._decoder.encode(state.command), state

    def _look(self, memory: Memory, cue: dict[str, Array]) -> None:
        """Update the memory with what the probes show."""
        probes = PROBE_RANGE * cue["probes"]
        # The trunk bobs, so heights are taken relative to the surrounding ground, the median of
        # the probes near the standing height.
        level = np.where(np.abs(probes) < _GROUND, probes, np.nan)
        level[np.isnan(level).all(axis=1)] = 0.0
        ground = np.nanmedian(level, axis=1)
        height = probes - ground[:, None]
        aside = self._points[:, 1]
        memory.slope = np.arctan(height @ aside / np.sum(aside**2))
        line = height[:, self._ahead]
        jump = line[:, 2:] - line[:, :-2]  # over 10 to 15 cm, one stair step at most
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
        """Return commands (M, 15) to the goal, around pillars, in the style of the family."""
        chosen = [self._styles.get(name, UNKNOWN) for name in memory.told]
        command = np.array([style.command() for style in chosen])
        fast = np.array([style.speed for style in chosen])
        fast[memory.pillar] = self._styles["pillar"].speed
        error, goal = bearing.copy(), np.array([GOAL_X, 0.0])
        for i in np.flatnonzero(memory.pillar).tolist():
            heading, at = memory.where.heading[0, i], memory.where.position[0, i]
            way = memory.obstacles.direction(i, at, goal, heading + bearing[i])
            error[i] = wrap_angle(way - heading)
        speed, turn = toward(distance, error, fast, turns=self._ranges.yaw_rate)
        command[:, INDEX["vx"]], command[:, INDEX["yaw_rate"]] = speed, turn
        uphill = np.array([style.uphill for style in chosen]) * np.sin(memory.slope)
        command[:, INDEX["vy"]] = np.clip(uphill, *self._ranges.vy)
        return command

    def _leap(
        self, memory: Memory, cue: dict[str, Array], bearing: Array, before: Array, landing: Landing
    ) -> None:
        """Replace the commands of robots that have trenches ahead by those of leaps.

        ``before`` (M, 15) are the commands of the previous decision.
        """
        track = memory.profile.track()
        tracks = np.maximum(track, 0).tolist()
        chosen = tracks, np.arange(len(tracks))
        along = memory.where.position[..., 0]
        speed, memory.x = ((along - memory.x) / self._dt)[chosen], along
        heading, x = memory.where.heading[chosen], along[chosen]
        # Use the mean heading of the two tracks until they can be told apart.
        heading = np.where(track < 0, memory.where.heading.mean(axis=0), heading)
        # In trot and pronk the right front foot's raw phase is the gait clock.
        phase = np.arctan2(cue["clock"][:, 1], cue["clock_cosine"][:, 1])
        clock = raw_phase(np.mod(phase / (2.0 * np.pi), 1.0), before[:, INDEX["duration"]])
        went, memory.clock = np.mod(clock - memory.clock, 1.0), clock
        leapt = gait_index(before) == PRONK
        memory.leapt = np.where(leapt, memory.leapt + went, 0.0)
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
            ways = heading[rows] + bearing[rows], heading[rows]
            steer_leap(leaps, *ways, self._ranges, self._leap_speed)
            commanded = np.full(len(rows), min(self._leap_speed, self._ranges.vx[1]))
            stride = before[rows][:, STRIDE_COMMANDS].T
            cycles = memory.leapt[rows]
            motion = Motion(x[rows], speed[rows], commanded, clock[rows], cycles, *stride)
            leap_command(leaps, *memory.plan.steps(rows, motion, landing), self._ranges)
            memory.command[rows] = leaps
