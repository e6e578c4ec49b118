"""The execution-level MDP (paper Sec. IV-A): follow commands, in gait, on rising terrain.

``LowLevelTask`` is the MDP for M robots at once; ``LowLevelEnv`` is its Gymnasium face for one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from tdgc.config import LowLevelConfig
from tdgc.parallel.group import TaskGroup
from tdgc.parallel.worker import Task
from tdgc.sim.commands import CONTINUOUS, INDEX, gait_index
from tdgc.sim.gaits import GAITS, gait_embedding
from tdgc.sim.locomotion import MIRRORS, Locomotion, action_mirror, mirror_map
from tdgc.sim.robot import NUM_JOINTS, Array, wrap_angle
from tdgc.sim.sensors import Noise
from tdgc.sim.terrain import (
    MAX_LEVEL,
    TILE_SIZE,
    TRENCH_DEPTH,
    Tile,
    draw_start_goal,
)
from tdgc.state import State, copies, fill
from tdgc.tasks import rewards
from tdgc.tasks.leaps import SPEED, SWING_HEIGHT, Landing, LeapPlan
from tdgc.tasks.rules import GOAL_RADIUS, is_fallen
from tdgc.tasks.tiles import FLAT, TrainingTiles

# Terrain that the critic sees: 5 x 3 points in the heading frame, from the tail to a step ahead.
_PROBES = np.array([(x, y) for x in (-0.3, -0.1, 0.1, 0.3, 0.5) for y in (0.15, 0.0, -0.15)])
_PROBE_SWAP = tuple(3 * (i // 3) + 2 - i % 3 for i in range(len(_PROBES)))
#: The critic's own part of the observation; the actor never sees it.
CRITIC_LAYOUT = (
    ("velocity", 3),
    ("angular_velocity", 3),
    ("base_height", 1),
    ("foot_height", 4),
    ("foot_contact", 4),
    ("desired_contact", 4),
    ("dynamics", 6),
    ("terrain", len(_PROBES)),
)
_CRITIC_MIRRORS: dict[str, tuple[tuple[int, ...], tuple[float, ...]]] = {
    "velocity": ((0, 1, 2), (1.0, -1.0, 1.0)),
    "angular_velocity": ((0, 1, 2), (-1.0, 1.0, -1.0)),
    "base_height": ((0,), (1.0,)),
    "foot_height": ((1, 0, 3, 2), (1.0,) * 4),
    "foot_contact": ((1, 0, 3, 2), (1.0,) * 4),
    "desired_contact": ((1, 0, 3, 2), (1.0,) * 4),
    "dynamics": ((0, 1, 2, 3, 4, 5), (1.0,) * 6),
    "terrain": (_PROBE_SWAP, (1.0,) * len(_PROBES)),
}

# Terrain episodes: most robots cross the tile from platform to platform, as the decision level
# will ask of them, facing where they go or any other way; the rest take free commands.
_CROSSING_SHARE = 0.8
_FACING_SHARE = 0.8
_CROSSING_SPEED = (0.25, 0.8)  # m/s
# What a crossing leaves of the ranges: a foot that must clear a 13 cm step, or a trunk that bends
# away from a 0.4 rad slope, cannot follow the rest and learns nothing from it. With feet below 9 cm
# a third crossed level 0 of Gap where all did above 16 cm.
_CLEARANCE = (0.05, 0.15)  # m, added to the least swing height at difficulty 0 and 1
_BEND = 0.3  # share of the pitch and roll ranges at difficulty 1
# On stairs of 15 cm a level trunk's middle passes over an edge as low as a fall; nose up it climbs.
# So pitch follows a share of the slope under the robot, the share drawn with the commands.
_SLOPE_POINTS = _PROBES[:, 0]
_HEADING_GAIN = 1.0  # 1/s, yaw rate asked per rad of heading error

_PLANE_SPACING = 5.0  # m between robots on the plane, so that few boxes overlap in the broad phase

# Of the commands drawn, in the order of GAITS. Free: trot is what crossings are mostly made in.
# Crossing: trot climbs best, and with all gaits alike the worst one decides how far levels rise.
_FREE_GAITS = (0.2, 0.2, 0.3, 0.3)
_CROSSING_GAITS = (0.8, 0.05, 0.075, 0.075)
# Over trenches most crossings leap, their landings planned (``leaps``). Other gaits fall into
# the first trench, and with half of the crossings in them levels stayed below 2.
_TRENCH_GAITS = (0.15, 0.85, 0.0, 0.0)
_LEAP_SPEED = (0.9 * SPEED, SPEED)  # m/s
_DECISION = 5  # control steps between two decisions on a leap: as the high policy's
_LANDING_RATE = 0.002  # of a landing in what is known of them: the last 500 count
# Free commands that leap: pronk with a stride as long as the trunk, whose front and rear feet land
# on the same lines, so that a trench fits between two of them. Drawn evenly, such commands are too
# rare: of 0.86 m/s at 2 Hz the robot did 0.5. As shares of the ranges: 0.7-1 m/s at 2-2.75 Hz.
_LEAP_SHARE = 0.05
_LEAP = {"vx": (0.85, 1.0), "frequency": (0.0, 0.375)}

# Command curriculum: a gait's velocity range grows when it tracks well over an evaluation batch.
_GROWTH = 0.05
# Share of the terms' maxima: errors of about 0.26 m/s and 0.32 rad/s at the default sigmas.
_GROW_LIN, _GROW_YAW = 0.5, 0.5
# Share of feet in contact as desired: speed comes after gait. At 0.8 bound never left its first
# ranges, since its rear feet lift late, and then undershot every faster command.
_GROW_CONTACT = 0.7


def shallow(tile: Tile, level: int) -> Tile:
    """The tile with trenches that deepen with the square of the level, from 5 cm to all of 60.

    At full depth the narrowest trench catches a leg for good, and a robot that falls over the first
    one whatever it does learns nothing. Deepening evenly was too fast: trot crossed all trenches of
    5 cm and a fifth of those of 11. Only this training is softened, never an evaluation.
    """
    shallowest = 0.05  # m
    d = min(1.0, level / MAX_LEVEL)
    depth = shallowest + d * d * (TRENCH_DEPTH - shallowest)
    return dataclasses.replace(tile, heights=np.maximum(tile.heights, tile.support - depth))


class LowLevelTask:
    """The low-level MDP of M robots.

    Observation rows are [actor part | critic part]; ``actor_dim`` says where the actor's ends.
    Actions are (M, 12) in [-a_max, a_max]. An episode ends in failure when the trunk is lower than
    0.15 m above the support surface or hits something with more than 40 N, and is truncated after
    20 s, where the robot leaves its tile, or when it has crossed it.

    Args:
        config: the MDP's configuration.
        num_robots: M.
        seed: of everything random here.
        training: draw noise, pushes and randomised dynamics.
        visual: keep what pictures of the ground need.
    """

    def __init__(
        self,
        config: LowLevelConfig,
        num_robots: int,
        seed: int,
        training: bool = True,
        visual: bool = False,
    ) -> None:
        self.config, self._visual = config, visual
        self.num_robots = num_robots
        self.training = training
        self.rng = np.random.default_rng(seed)
        self.horizon = round(config.episode_seconds / config.physics.control_dt)
        self._command_steps = round(config.command_seconds / config.physics.control_dt)
        bounds = np.array([getattr(config.commands, name) for name in CONTINUOUS])
        self._low, self._high = bounds.T
        #: Share of the velocity ranges in use, a gait.
        self.command_share = np.full(len(GAITS), config.command_start if training else 1.0)
        m = num_robots
        self.column = np.arange(m) % len(config.families)
        self.level = self.rng.integers(0, min(3, config.levels), m)
        families = [config.families[c] for c in self.column]
        # Those without relief have free commands and no levels.
        self._flat = np.array([family == FLAT for family in families])
        self._trenches = np.array([family == "gap" for family in families])
        self._rugged = ~self._flat if config.terrain == "tiles" else np.zeros(m, dtype=bool)
        self.tiles = None if config.terrain == "plane" else TrainingTiles(families, seed, shallow)
        self.field = None if self.tiles is None else self.tiles.field
        if self.tiles is not None:
            self.tiles.draw(np.arange(m), self.level)
        self.locomotion = self._build_locomotion()
        self.elapsed = np.zeros(m, dtype=np.int64)
        self._began = np.zeros(m, dtype=np.int64)  # elapsed at the start of the episode
        self._next_push = np.zeros(m, dtype=np.int64)
        self._crossing = np.zeros(m, dtype=bool)
        self._speed = np.zeros(m)
        self._leaping = np.zeros(m, dtype=bool)  # of crossings
        self._follow = np.zeros(m)  # share of the slope ahead that pitch follows in a crossing
        self._pitch = np.zeros(m)  # rad, what is added to it
        self._plan = LeapPlan(m, config.commands)
        self._landing = Landing()
        self._look(np.arange(m))
        self._facing = np.zeros(m)
        self._waypoint = np.zeros((m, 2))
        self._reached = np.zeros(m, dtype=bool)
        self._was_contact = np.zeros((m, 4), dtype=bool)
        self._origin = np.zeros((m, 2))
        self._gait_scores = np.zeros((len(GAITS), 4))
        self.stats: dict[str, float] = {}
        self._ground = self._measure_ground()
        layout = self.locomotion.layout
        self.actor_dim = sum(size for _, size in layout)
        self.obs_dim = self.actor_dim + sum(size for _, size in CRITIC_LAYOUT)
        self.observation_mirror = mirror_map(layout + CRITIC_LAYOUT, MIRRORS | _CRITIC_MIRRORS)
        self.action_mirror = action_mirror()
        limit = config.robot.action_limit
        self.action_space = gym.spaces.Box(-limit, limit, (NUM_JOINTS,), np.float32)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (self.obs_dim,), np.float32)

    def _build_locomotion(self) -> Locomotion:
        c = self.config
        return Locomotion(self.num_robots, c.robot, c.physics, self.field, c.gyro, self._visual)

    # ------------------------------------------------------------------ episodes

    def reset(self, index: NDArray[np.integer]) -> None:
        """Start new episodes for the robots ``index`` (n,)."""
        n, rng = len(index), self.rng
        self._finish_statistics(index)
        if self.tiles is None:
            xy = np.stack([index % 10, index // 10], axis=1) * _PLANE_SPACING
            yaw = rng.uniform(-np.pi, np.pi, n)
            self._crossing[index] = False
        else:
            changed = self.tiles.begin(index, self.level)
            if changed.size:
                self.locomotion.world.upload_terrain(changed)
                self._look(changed)
            self._origin[index] = self.tiles.field.origin(index, np.zeros_like(index))
            start, goal = draw_start_goal(rng, (n,))
            # Free commands lead anywhere, so those robots of a flat tile start in its middle.
            start[self._flat[index], :2] = 0.5 * TILE_SIZE
            xy, yaw = start[:, :2] + self._origin[index], start[:, 2]
            self._waypoint[index] = goal + self._origin[index]
            crossing = (rng.uniform(size=n) < _CROSSING_SHARE) & ~self._flat[index]
            self._crossing[index] = crossing
        self._reached[index] = False
        self.elapsed[index] = self._began[index] = 0
        self._was_contact[index] = False
        if self.training:
            self.locomotion.randomise(index, self.config.randomisation, rng)
            self._schedule_push(index)
        self._draw_commands(index)
        if self.field is not None:
            # Face so that the first command needs no turn on the spot.
            yaw = yaw + np.where(self._crossing[index], self._facing[index], 0.0)
        self.locomotion.place(index, xy, yaw, rng.uniform(size=n))
        self._ground = self._measure_ground()
        if self.field is not None:
            self._steer_crossings()

    def restart(self) -> None:
        """End every episode, redraw the terrain and build the world anew, as a run begins."""
        self.locomotion.world.close()
        if self.tiles is not None:
            self.tiles.draw(np.arange(self.num_robots), self.level)
            self._look(np.arange(self.num_robots))
        self.locomotion = self._build_locomotion()
        self._gait_scores[:] = 0.0
        self.reset(np.arange(self.num_robots))
        # Spread the ends of the coming episodes over time.
        self.elapsed[:] = self.rng.integers(0, self.horizon, self.num_robots)
        self._began[:] = self.elapsed
        self._schedule_push(np.arange(self.num_robots))

    def step(
        self, actions: NDArray[np.floating]
    ) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """One control step of all robots: (M, 12) -> reward, terminated, truncated, (M,) each."""
        loco, c = self.locomotion, self.config
        before, clock = loco.world.state.qd.copy(), loco.clock.clock.copy()
        loco.act(np.asarray(actions, dtype=np.float64))
        self.elapsed += 1
        leaping = np.flatnonzero(self._leaping)
        self._landing.learn(loco, leaping, clock[leaping], _LANDING_RATE)
        self._ground = self._measure_ground()
        terms = rewards.low_terms(self._low_step(before), c.rewards)
        reward = rewards.total(terms, c.rewards, c.physics.control_dt, self._penalty())
        terminated = is_fallen(loco.world)
        truncated = (self.elapsed >= self.horizon) | self._left_tile() | self._reached
        truncated &= ~terminated
        self._count(terms, reward, terminated)
        self._was_contact = loco.world.state.foot_force > rewards.CONTACT_FORCE
        self._update_curriculum(terminated | truncated, terminated)
        self._refresh()
        return reward, terminated, truncated

    def _penalty(self) -> Array:
        """Share of the penalties that counts for each robot, (M,): it falls as the commands of its
        gait grow, and is least on terrain."""
        c = self.config
        start = min(c.command_start, 1.0 - 1e-6)  # a task whose commands are whole from the start
        grown = (self.command_share - start) / (1.0 - start)
        share = 1.0 + (c.rewards.walking_penalty - 1.0) * grown
        mine = share[gait_index(self.locomotion.command)]
        return np.where(self._rugged, c.rewards.terrain_penalty, mine)

    def observe(self) -> NDArray[np.float32]:
        """(M, obs_dim): the actor's part, noisy in training, and the critic's."""
        noise = Noise(self.config.randomisation, self.rng) if self.training else None
        actor = self.locomotion.observe(noise)
        return np.concatenate([actor, self._critic()], axis=1).astype(np.float32)

    def _critic(self) -> Array:
        loco, state = self.locomotion, self.locomotion.world.state
        base_height, foot_height, probes = self._ground
        body_rate = np.einsum("mji,mj->mi", state.rotation, state.ang_vel)
        dynamics = [
            loco.friction,
            loco.payload / 3.0,
            5.0 * (loco.world.strength[:, 0] - 1.0),
            loco.delay / 0.03,
            100.0 * loco.armature,
            5.0 * loco.world.joint_friction[:, 0],
        ]
        return np.concatenate(
            [
                2.0 * state.heading_vel,
                0.25 * body_rate,
                10.0 * (base_height - self.config.robot.base_height)[:, None],
                10.0 * foot_height,
                state.foot_force > rewards.CONTACT_FORCE,
                loco.clock.contact,
                np.stack(dynamics, axis=1),
                5.0 * np.clip(probes, -0.5, 0.5),
            ],
            axis=1,
        )

    def _measure_ground(self) -> tuple[Array, Array, Array]:
        """Trunk (M,) and feet (M, 4) above the support surface, probes of the ground below the
        standing trunk (M, 15), in m.

        The support surface has its trenches filled: a foot on its way over one is not half a metre
        too high.
        """
        world = self.locomotion.world
        state = world.state
        c, s = np.cos(state.yaw)[:, None], np.sin(state.yaw)[:, None]
        points = np.concatenate([_PROBES, state.geometry.hips])
        x = state.position[:, :1] + c * points[:, 0] - s * points[:, 1]
        y = state.position[:, 1:2] + s * points[:, 0] + c * points[:, 1]
        n = len(_PROBES)
        probes = world.ground_height(x[:, :n], y[:, :n])
        support = world.support_height(
            np.concatenate([x[:, n:], state.foot_position[..., 0]], axis=1),
            np.concatenate([y[:, n:], state.foot_position[..., 1]], axis=1),
        )
        base = state.position[:, 2] - support[:, :4].mean(axis=1)
        feet = state.foot_position[..., 2] - support[:, 4:]
        standing = state.position[:, 2:3] - self.config.robot.base_height
        return base, feet, probes - standing

    def _low_step(self, speed_before: Array) -> rewards.LowStep:
        loco, c = self.locomotion, self.config
        base_height, foot_height, _ = self._ground
        return rewards.LowStep(
            state=loco.world.state,
            command=loco.executed(),
            phases=loco.clock.phases,
            contact=loco.clock.contact,
            swing=loco.swing(),
            base_height=base_height,
            foot_height=foot_height,
            standing_height=c.robot.base_height,
            targets=loco.targets,
            actions=loco.actions,
            acceleration=(loco.world.state.qd - speed_before) / c.physics.control_dt,
            was_contact=self._was_contact,
            sigma_lin=c.rewards.sigma_lin,
            sigma_yaw=c.rewards.sigma_yaw,
        )

    def _left_tile(self) -> NDArray[np.bool_]:
        if self.field is None:
            return np.zeros(self.num_robots, dtype=bool)
        x, y = self.locomotion.world.state.position[:, :2].T
        return ~self.field.on_tile(np.arange(self.num_robots), 0, x, y)

    # ------------------------------------------------------------------ commands and pushes

    def _draw_commands(self, index: NDArray[np.integer]) -> None:
        n, rng, command = len(index), self.rng, self.locomotion.command
        crossing, trenches = self._crossing[index], self._trenches[index]
        shares = np.where(crossing[:, None], _CROSSING_GAITS, _FREE_GAITS)
        shares[crossing & trenches] = _TRENCH_GAITS
        gait = np.sum(rng.uniform(size=(n, 1)) > np.cumsum(shares, axis=1)[:, :-1], axis=1)
        low, high = self._bounds(index)
        values = rng.uniform(low, high)
        leap = ~self._crossing[index] & (rng.uniform(size=n) < _LEAP_SHARE)
        gait[leap] = GAITS.index("pronk")
        for name, (least, most) in _LEAP.items():
            j, share = INDEX[name], rng.uniform(least, most, int(leap.sum()))
            values[leap, j] = low[leap, j] + share * (high - low)[leap, j]
        values[:, :3] *= self.command_share[gait][:, None]
        # A tenth stands: stepping on the spot is asked for at every goal.
        values[rng.uniform(size=n) < 0.1, :3] = 0.0
        leaps = crossing & trenches & (gait == GAITS.index("pronk"))
        swing = INDEX["swing_height"]
        values[leaps, swing] = rng.uniform(self._low[swing], SWING_HEIGHT, int(leaps.sum()))
        command[index] = np.concatenate([values, gait_embedding(gait)], axis=1)
        self._leaping[index] = leaps
        self._follow[index] = np.where(leaps, 0.0, rng.uniform(size=n))
        self._pitch[index] = values[:, INDEX["pitch"]]
        slow, fast = rng.uniform(*_CROSSING_SPEED, n), rng.uniform(*_LEAP_SPEED, n)
        self._speed[index] = np.where(leaps, fast, slow)
        free = rng.uniform(-np.pi, np.pi, n)
        ahead = leaps | (rng.uniform(size=n) < _FACING_SHARE)
        self._facing[index] = np.where(ahead, 0.0, free)

    def _bounds(self, index: NDArray[np.integer]) -> tuple[Array, Array]:
        """Lower and upper bounds (n, 12) of the commands drawn for the robots ``index``."""
        crossing = self._crossing[index]
        d = np.where(crossing, self.level[index] / MAX_LEVEL, 0.0)
        low, high = np.tile(self._low, (len(index), 1)), np.tile(self._high, (len(index), 1))
        swing, height = INDEX["swing_height"], INDEX["body_height"]
        clearance = _CLEARANCE[0] + d * (_CLEARANCE[1] - _CLEARANCE[0])
        low[:, swing] = np.minimum(low[:, swing] + crossing * clearance, high[:, swing])
        low[:, height] *= 1.0 - d
        bend = [INDEX["pitch"], INDEX["roll"]]
        low[:, bend] *= (1.0 - (1.0 - _BEND) * d)[:, None]
        high[:, bend] *= (1.0 - (1.0 - _BEND) * d)[:, None]
        return low, high

    def _refresh(self) -> None:
        """Everything that changes commands between two steps: resampling, crossing, pushes."""
        if self.config.command_seconds > 0:
            due = np.flatnonzero((self.elapsed % self._command_steps == 0) & (self.elapsed > 0))
            if due.size:
                self._draw_commands(due)
        if self.field is not None:
            self._steer_crossings()
        if self.training:
            self._push()

    def _steer_crossings(self) -> None:
        """Point the velocity commands of crossing robots at their waypoint."""
        state = self.locomotion.world.state
        offset = self._waypoint - state.position[:, :2]
        self._reached |= self._crossing & (np.linalg.norm(offset, axis=1) < GOAL_RADIUS)
        bearing = np.arctan2(offset[:, 1], offset[:, 0])
        # A leap faces across the trenches, so that both feet of a pair land on one line.
        heading = np.where(self._leaping, 0.0, bearing + self._facing)
        error = wrap_angle(heading - state.yaw)
        direction = bearing - state.yaw
        velocity = self._speed[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
        over = np.abs(velocity) / self._high[:2]
        velocity /= np.maximum(over.max(axis=1, keepdims=True), 1.0)
        turn = np.clip(_HEADING_GAIN * error, self._low[2], self._high[2])
        rows = np.flatnonzero(self._crossing)
        self.locomotion.command[rows, :2] = velocity[rows]
        self.locomotion.command[rows, 2] = turn[rows]
        j = INDEX["pitch"]
        pitch = self._pitch - self._follow * self._slope_ahead()
        self.locomotion.command[rows, j] = np.clip(pitch, self._low[j], self._high[j])[rows]
        leaping = np.flatnonzero(self._leaping & (self.elapsed % _DECISION == 0))
        if leaping.size:
            frequency, length = self._plan.steps(
                leaping,
                (state.position[:, 0] - self._origin[:, 0])[leaping],
                state.heading_vel[leaping, 0],
                self.locomotion.clock.clock[leaping],
                self._landing,
            )
            self.locomotion.command[leaping, INDEX["frequency"]] = frequency
            self.locomotion.command[leaping, INDEX["stance_length"]] = length

    def _slope_ahead(self) -> Array:
        """Angle of the ground under the robots along their headings, uphill positive, (M,) rad."""
        arm = _SLOPE_POINTS - _SLOPE_POINTS.mean()
        return np.arctan(self._ground[2] @ arm / (arm @ arm))

    def _look(self, index: NDArray[np.integer]) -> None:
        """Plan the leaps of the robots ``index`` (n,) over the trenches of their tiles."""
        if self.field is None:
            return
        for i in index[self._trenches[index]]:
            trenches = self.field.features[int(i), 0].trenches
            self._plan.look(int(i), trenches, self._landing.spread)

    def _schedule_push(self, index: NDArray[np.integer]) -> None:
        seconds = self.rng.uniform(*self.config.randomisation.push_interval, len(index))
        steps = np.maximum(1, seconds / self.config.physics.control_dt)
        self._next_push[index] = self.elapsed[index] + steps.astype(int)

    def _push(self) -> None:
        index = np.flatnonzero(self.elapsed >= self._next_push)
        if not index.size:
            return
        r = self.config.randomisation
        angle = self.rng.uniform(-np.pi, np.pi, index.size)
        speed = r.scale * r.push_speed * self.rng.uniform(size=index.size)
        velocity = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
        self.locomotion.world.push(index, speed[:, None] * velocity)
        self._schedule_push(index)

    @property
    def reached(self) -> NDArray[np.bool_]:
        """Whether each robot has crossed its tile in this episode, (M,)."""
        return self._reached

    # ------------------------------------------------------------------ curriculum, statistics

    def _update_curriculum(self, done: NDArray[np.bool_], failed: NDArray[np.bool_]) -> None:
        """Move robots that end an episode between levels, as legged_gym does.

        Up when the tile was crossed; down when less than half of it was, unless only a part of an
        episode was given; a robot that crosses the last level starts over at a random one.
        """
        if self.field is None or not self.training:
            return
        top = self.config.levels - 1
        crossed = done & self._crossing & self._reached
        local = self.locomotion.world.state.position[:, 0] - self._origin[:, 0]
        short = done & self._crossing & ~self._reached & (local < 0.5 * TILE_SIZE)
        short &= failed | (self.elapsed - self._began >= self.horizon)
        self.level = np.where(crossed, self.level + 1, np.where(short, self.level - 1, self.level))
        solved = self.level > top
        self.level[solved] = self.rng.integers(0, top + 1, int(solved.sum()))
        self.level = np.clip(self.level, 0, top)

    def _count(self, terms: dict[str, Array], reward: Array, terminated: NDArray[np.bool_]) -> None:
        """Add this step to ``stats`` (sums; ``tdgc.learn.run`` divides and logs them)."""
        loco, stats = self.locomotion, self.stats

        def add(key: str, value: float) -> None:
            stats[key] = stats.get(key, 0.0) + float(value)

        add("steps", self.num_robots)
        add("falls", terminated.sum())
        add("reward", reward.sum())
        for name, value in terms.items():
            add(f"term/{name}", value.sum())
        state = loco.world.state
        wanted = loco.clock.contact > 0.5
        nothing = np.zeros(self.num_robots)  # of a term that is switched off
        samples = np.stack(
            [
                np.ones(self.num_robots),
                np.sum((state.heading_vel[:, :2] - loco.command[:, :2]) ** 2, axis=1),
                (state.ang_vel[:, 2] - loco.command[:, INDEX["yaw_rate"]]) ** 2,
                np.mean((state.foot_force > rewards.CONTACT_FORCE) == wanted, axis=1),
                terms.get("track_lin_vel", nothing),
                terms.get("track_yaw_rate", nothing),
            ]
        )
        by_gait = samples @ np.eye(len(GAITS))[gait_index(loco.command)]
        for g, name in enumerate(GAITS):
            for key, value in zip(("steps", "lin", "yaw", "match"), by_gait[:, g], strict=False):
                add(f"gait/{name}/{key}", value)
        self._gait_scores += by_gait[[0, 4, 5, 3]].T
        self._grow_commands()
        if self.field is not None:
            for col, family in enumerate(self.config.families):
                if family == FLAT:
                    continue
                mine = self.column == col
                add(f"level/{family}/count", mine.sum())
                add(f"level/{family}/level", self.level[mine].sum())

    def _grow_commands(self) -> None:
        """Widen the velocity range of a gait that tracked well over its last samples."""
        samples = 200 * self.num_robots / len(GAITS)  # about 4 s of every robot
        weights = self.config.rewards
        for g in np.flatnonzero(self._gait_scores[:, 0] >= samples):
            count, lin, yaw, match = self._gait_scores[g]
            good = lin / count > _GROW_LIN * weights.track_lin_vel
            good &= yaw / count > _GROW_YAW * weights.track_yaw_rate
            good &= match / count > _GROW_CONTACT
            if good and self.training:
                self.command_share[g] = min(1.0, self.command_share[g] + _GROWTH)
            self._gait_scores[g] = 0.0

    def _finish_statistics(self, index: NDArray[np.integer]) -> None:
        self.stats["episodes"] = self.stats.get("episodes", 0.0) + len(index)

    def take_stats(self) -> dict[str, float]:
        """The sums since the last call."""
        stats, self.stats = self.stats, {}
        for g, name in enumerate(GAITS):
            stats[f"share/{name}"] = self.num_robots * float(self.command_share[g])
        stats["robots"] = float(self.num_robots)
        if self._trenches.any():
            stats["leapers"] = 1.0
            stats["landing/front"] = self._landing.front
            stats["landing/spread"] = self._landing.spread
        stats["bullet_seconds"] = self.locomotion.world.bullet_seconds
        return stats

    # ------------------------------------------------------------------ resume

    def forget(self) -> None:
        """Let what follows depend on ``state_dict`` alone, see ``World.forget``."""
        self.locomotion.world.forget()

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """Of the episodes under way."""
        return {
            "elapsed": self.elapsed,
            "began": self._began,
            "next_push": self._next_push,
            "crossing": self._crossing,
            "speed": self._speed,
            "leaping": self._leaping,
            "follow": self._follow,
            "pitch": self._pitch,
            "facing": self._facing,
            "waypoint": self._waypoint,
            "reached": self._reached,
            "was_contact": self._was_contact,
            "origin": self._origin,
            "gait_scores": self._gait_scores,
        }

    def state_dict(self) -> State:
        """What was learned of the robots, and their ``episodes`` under way, as copies."""
        return {
            "rng": self.rng.bit_generator.state,
            "landing": [self._landing.front, self._landing.spread],
            "tiles_drawn": 0 if self.tiles is None else self.tiles.drawn,
            **copies({"level": self.level, "command_share": self.command_share}),
            "episodes": {
                **copies(self._arrays()),
                "locomotion": self.locomotion.state_dict(),
                "tiles": {} if self.tiles is None else self.tiles.state_dict(),
            },
        }

    def load_state_dict(self, state: State) -> None:
        """Go on from a ``state_dict``, as a ``forget`` there would have gone on; from one without
        ``episodes`` with new ones.

        Raises:
            ValueError: a state of other robots.
        """
        self.rng.bit_generator.state = state["rng"]
        self._landing = Landing(*state["landing"])
        fill({"level": self.level, "command_share": self.command_share}, state)
        if self.tiles is not None:
            self.tiles.drawn = int(state["tiles_drawn"])
        if "episodes" not in state:
            self.restart()
            return
        episodes = state["episodes"]
        fill(self._arrays(), episodes)
        if self.tiles is not None:
            self.tiles.load_state_dict(episodes["tiles"])
            self._look(np.arange(self.num_robots))
            self.locomotion.world.upload_terrain()
        self.locomotion.load_state_dict(episodes["locomotion"])
        self._ground = self._measure_ground()

    def close(self) -> None:
        """Disconnect from Bullet."""
        self.locomotion.world.close()


def make_task(
    config: tuple[LowLevelConfig, LowLevelConfig],
    share: float,
    robots: int,
    seed: int,
) -> Task:
    """The robots of a worker: a share of them in the first MDP, the others in the second."""
    first = round(share * robots)
    if not first:
        return LowLevelTask(config[1], robots, seed)
    seeds = np.random.SeedSequence(seed).generate_state(2)
    return TaskGroup(
        [
            LowLevelTask(mdp, number, int(own))
            for mdp, number, own in zip(config, (first, robots - first), seeds, strict=True)
        ]
    )


class TaskEnv(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One robot of a task as a Gymnasium environment.

    Args:
        make_task: (seed, whether pictures are wanted) -> the task of one robot. A reset with a seed
            makes it anew, so that all that follows is repeatable.
        render_mode: None, or rgb_array for pictures of 640 x 400.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012  as in gymnasium

    def __init__(self, make_task: Callable[[int, bool], Any], render_mode: str | None) -> None:
        self.render_mode = render_mode
        self._make_task = make_task
        self.task = make_task(0, render_mode is not None)
        self.action_space = self.task.action_space
        self.observation_space = self.task.observation_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.task.close()
            self.task = self._make_task(seed, self.render_mode is not None)
        self.task.reset(np.arange(1))
        return self.task.observe()[0], {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        reward, terminated, truncated = self.task.step(np.asarray(action)[None])
        info = {"is_success": bool(self.task.reached[0])}
        obs = self.task.observe()[0]
        return obs, float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> NDArray[np.uint8] | None:
        if self.render_mode is None:
            return None
        picture: NDArray[np.uint8] = self.task.locomotion.world.picture(0)
        return picture

    def close(self) -> None:
        self.task.close()


class LowLevelEnv(TaskEnv):
    """``LowLevelTask`` for one robot, id ``tdgc/LowLevel-v0``."""

    def __init__(
        self, config: LowLevelConfig | None = None, render_mode: str | None = None
    ) -> None:
        self.config = config or LowLevelConfig()
        super().__init__(
            lambda seed, visual: LowLevelTask(self.config, 1, seed, visual=visual), render_mode
        )


def summarise(sums: dict[str, float]) -> dict[str, float]:
    """Sums of ``LowLevelTask.take_stats`` over all workers -> values to log."""
    steps = max(sums.get("steps", 0.0), 1.0)
    values = {"reward/total": sums.get("reward", 0.0) / steps}
    values["falls_per_minute"] = sums.get("falls", 0.0) / (steps * 0.02 / 60.0)
    for key, value in sums.items():
        if key.startswith("term/"):
            values[f"reward/{key[5:]}"] = value / steps
        elif key.startswith("share/"):
            values[f"command_share/{key[6:]}"] = value / sums["robots"]
        elif key.startswith("landing/"):
            values[key] = value / sums["leapers"]
    for gait in GAITS:
        n = max(sums.get(f"gait/{gait}/steps", 0.0), 1.0)
        values[f"tracking/{gait}_velocity_rmse"] = (sums.get(f"gait/{gait}/lin", 0.0) / n) ** 0.5
        values[f"tracking/{gait}_yaw_rate_rmse"] = (sums.get(f"gait/{gait}/yaw", 0.0) / n) ** 0.5
        values[f"tracking/{gait}_contact_match"] = sums.get(f"gait/{gait}/match", 0.0) / n
    counts = [k for k in sums if k.startswith("level/") and k.endswith("/count")]
    families = [k.removeprefix("level/").removesuffix("/count") for k in counts]
    for family in families:
        count = max(sums[f"level/{family}/count"], 1.0)
        values[f"level/{family}"] = sums[f"level/{family}/level"] / count
    return values
