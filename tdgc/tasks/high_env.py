"""The decision-level MDP (paper Sec. IV-B, IV-C) around a frozen low policy.

``NavigationTask`` is the MDP for M robots at once, each on a tile of its own whose level the
curriculum sets; ``NavigationEnv`` is its Gymnasium face for one.
"""

import dataclasses
import functools
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from tdgc import policies
from tdgc.config import (
    CommandRanges,
    ConfigError,
    HighLevelConfig,
    HighRewardConfig,
    LowLevelConfig,
    recorded,
)
from tdgc.policies import Mirror, Policy
from tdgc.sim.commands import (
    CONTINUOUS,
    INDEX,
    NUM_ACTIONS,
    SIDEWAYS,
    CommandDecoder,
    default_command,
    gait_index,
)
from tdgc.sim.gaits import GAITS
from tdgc.sim.locomotion import SPEED_SCALE, Locomotion
from tdgc.sim.observation import ARROW, JOINTS, LEGS, Flip, Term, in_place, mirror, observe, width
from tdgc.sim.robot import NUM_JOINTS, Array, wrap_angle
from tdgc.sim.sensors import Noise
from tdgc.sim.terrain import FAMILIES, draw_start_goal
from tdgc.state import State, copies, fill
from tdgc.tasks import rewards
from tdgc.tasks.approach import Approach
from tdgc.tasks.curriculum import Curriculum
from tdgc.tasks.executor import Executor
from tdgc.tasks.leaps import FREQUENCIES, Landing
from tdgc.tasks.probes import NUM_PROBES, PROBE_RANGE, PROBE_SWAP, PROBES, HeightProbes
from tdgc.tasks.pushes import Pushes
from tdgc.tasks.rules import REACHED, has_failed, outcome
from tdgc.tasks.task_env import TaskEnv
from tdgc.tasks.teacher import Teacher
from tdgc.tasks.tiles import TrainingTiles, shallow

#: Where the shipped policies are.
PRETRAINED = Path(__file__).resolve().parents[1] / "pretrained"

GOAL_SCALE = 1.0 / 8.0  # 1/m: distances as shares of the tile's length
#: Width of what a teacher adds to an observation.
GUIDANCE = NUM_ACTIONS + FREQUENCIES

#: The semantic cue: one-hot over the families, and one place for "unknown".
SEMANTIC = (*FAMILIES, "unknown")


class Seen(NamedTuple):
    """What o^H of M robots is read from.

    Attributes:
        loco: the robots.
        goal: (M, 2) m in the world.
        time_share: (M,) t / T_max.
        last_action: (M, 13), normalised.
        families: (M,) index into ``SEMANTIC``.
        probes: (M, 32) m, as ``HeightProbes.read`` or ``height_probes`` gives them.
        late: (M,) how many decisions ago those were measured.
        closing: (M,) m/s, how fast the goal came nearer since the last decision.
    """

    loco: Locomotion
    goal: Array
    time_share: Array
    last_action: Array
    families: NDArray[np.int64]
    probes: Array
    late: NDArray[Any]
    closing: Array


def _goal(seen: Seen) -> Array:
    state = seen.loco.world.state
    offset = seen.goal - state.position[:, :2]
    bearing = wrap_angle(np.arctan2(offset[:, 1], offset[:, 0]) - state.yaw)
    distance = np.linalg.norm(offset, axis=1)
    return np.stack([GOAL_SCALE * distance, np.cos(bearing), np.sin(bearing)], axis=1)


def _joint_error(seen: Seen) -> Array:
    return seen.loco.world.state.q - seen.loco.joint_offset - seen.loco.nominal


_FLIP_ACTION = in_place(*(-1.0 if name in SIDEWAYS else 1.0 for name in (*CONTINUOUS, "gait")))
_LAYOUT: tuple[Term[Seen], ...] = (
    Term("goal", 3, _goal, mirror=in_place(1.0, 1.0, -1.0)),
    Term("time_left", 1, lambda s: 1.0 - s.time_share[:, None]),
    Term("gravity", 3, lambda s: s.loco.world.state.gravity, mirror=ARROW),
    Term("joint_error", 12, _joint_error, mirror=JOINTS),
    Term("joint_speed", 12, lambda s: s.loco.world.state.qd, SPEED_SCALE, mirror=JOINTS),
    Term("last_action", 13, lambda s: s.last_action, mirror=_FLIP_ACTION),
    Term("clock", 4, lambda s: s.loco.clock.signal(), mirror=LEGS),
)
_COSINE: Term[Seen] = Term("clock_cosine", 4, lambda s: s.loco.clock.cosine(), mirror=LEGS)
_PROBES = Flip(PROBE_SWAP, (1.0,) * NUM_PROBES)
_AGE: Term[Seen] = Term("probe_age", 1, lambda s: s.late[:, None].astype(np.float64))
_CLOSING: Term[Seen] = Term("closing_speed", 1, lambda s: s.closing[:, None])
_CUES: dict[str, Term[Seen]] = {
    "semantic": Term("family", len(SEMANTIC), lambda s: np.eye(len(SEMANTIC))[s.families]),
    "geometric": Term("probes", NUM_PROBES, lambda s: s.probes, 1.0 / PROBE_RANGE, mirror=_PROBES),
}


def high_layout(config: HighLevelConfig) -> tuple[Term[Seen], ...]:
    """The terms of the high policy's observation o^H, in order."""
    clock = (_COSINE,) if config.clock == "both" else ()
    cues = [term for cue, term in _CUES.items() if config.cues in ("both", cue)]
    age = (_AGE,) if config.probe_age and config.cues in ("both", "geometric") else ()
    closing = (_CLOSING,) if config.closing_speed else ()
    return (*_LAYOUT, *clock, *cues, *age, *closing)


def high_spaces(
    config: HighLevelConfig, taught: bool = False
) -> tuple[gym.spaces.Box, gym.spaces.Box]:
    """Observations, with the teacher's guidance if there is one, and actions of the high policy."""
    size = width(high_layout(config)) + taught * GUIDANCE
    limit = config.action_limit
    seen = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
    return seen, gym.spaces.Box(-limit, limit, (NUM_ACTIONS,), np.float32)


def high_mirror(config: HighLevelConfig) -> Mirror:
    """Left-right mirror of the high policy's observations and actions.

    Raises:
        ConfigError: probes or bounds to one side that are not those to the other.
    """
    if config.probes != "lines":
        raise ConfigError(
            f"probes that are {config.probes} are not the same on both sides, as a symmetric "
            "policy needs them; ppo.mirror=false does without symmetry"
        )
    for name in SIDEWAYS:
        low, high = getattr(config.commands or CommandRanges(), name)
        if low != -high:
            raise ConfigError(
                f"commands.{name} must be the same to both sides for a symmetric policy, not "
                f"{[low, high]}; ppo.mirror=false does without symmetry"
            )
    return Mirror(*mirror(high_layout(config)), *_FLIP_ACTION)


def command_share(commands: Array, decoder: CommandDecoder) -> Array:
    """Commands (..., 15) as shares of the decoder's ranges, so that differences have one scale."""
    span = np.where(decoder.high > decoder.low, decoder.high - decoder.low, 1)
    return np.asarray((commands - decoder.low) / span)


def high_step(
    loco: Locomotion,
    goal: Array,
    time_share: Array | float,
    actions: Array,
    shares: Array,
    force: Array,
    config: HighRewardConfig,
) -> rewards.HighStep:
    """What the reward terms look at, after a decision was carried out.

    Args:
        loco: the robots.
        goal: (M, 2) m in the world.
        time_share: (M,) or one for all, t / T_max.
        actions: (2, M, 13) of this decision and the one before, normalised.
        shares: (3, M, 15) ``command_share`` of this decision and the two before.
        force: (M, 5) N, largest since the decision: the trunk, and each leg above the foot.
        config: weights and constants.
    """
    state = loco.world.state
    offset = goal - state.position[:, :2]
    x, y = state.position[:, 0], state.position[:, 1]
    return rewards.HighStep(
        distance=np.linalg.norm(offset, axis=1),
        heading_error=np.arctan2(offset[:, 1], offset[:, 0]) - state.yaw,
        time_share=np.broadcast_to(time_share, x.shape),
        lin_vel=state.lin_vel,
        ang_vel=state.ang_vel,
        joint_speed=state.qd,
        base_height=state.position[:, 2] - loco.world.support_height(x, y),
        standing_height=loco.robot.base_height,
        actions=actions,
        commands=shares,
        contact_forces=force,
        config=config,
    )


#: What a high policy decides, beside the gait, when its ``behaviour`` is "velocities".
VELOCITIES = ("vx", "vy", "yaw_rate")


def at_default(ranges: CommandRanges) -> CommandRanges:
    """Bounds that leave only the velocities free: the others at their defaults, or at the bound
    next to it."""
    default, pinned = default_command(), {}
    for name in CONTINUOUS:
        if name not in VELOCITIES:
            value = float(np.clip(default[INDEX[name]], *getattr(ranges, name)))
            pinned[name] = value, value
    return dataclasses.replace(ranges, **pinned)


def paired(high: HighLevelConfig, low: LowLevelConfig) -> HighLevelConfig:
    """The MDP of a high policy on a low policy: with the decoder's bounds, the low policy's if it
    has none.

    Raises:
        ConfigError: bounds that the low policy was not trained on; names the command and both.
    """
    ranges = high.commands or low.commands
    if high.behaviour == "velocities":
        ranges = at_default(ranges)
    for f in dataclasses.fields(low.commands):
        asked, trained = getattr(ranges, f.name), getattr(low.commands, f.name)
        if asked[0] < trained[0] or asked[1] > trained[1]:
            raise ConfigError(
                f"commands.{f.name} asks for {list(asked)}, but the low policy was trained on "
                f"{list(trained)}"
            )
    return dataclasses.replace(high, commands=ranges)


def load_low(low: str | Path | Policy) -> tuple[Policy, LowLevelConfig]:
    """A low policy, given itself or by its path, and the MDP it was trained on.

    Raises:
        ValueError: a file that cannot be used, or a policy that is no low policy.
    """
    name, low = low, low if isinstance(low, Policy) else policies.load(low)
    if low.kind != "mlp" or low.action_dim != NUM_JOINTS or "config" not in low.meta:
        raise ConfigError(f"{name}: not a low policy of this package")
    return low, recorded(LowLevelConfig, low.meta["config"], name)


class NavigationTask:
    """The high policy's MDP of M robots.

    An action is (M, 13) in [-a_max, a_max]; it is decoded and held for ``decimation`` control
    steps of the frozen low policy. An episode fails when the trunk is low, hits something hard, or
    the robot leaves its tile; it is truncated after 20 s, or 2 s after the goal was reached.

    Args:
        config: the MDP's configuration.
        low: the low policy, or its path; a task that is made on another machine needs the
            policy itself.
        num_robots: M.
        seed: of everything random here.
        training: draw disturbances and let the curriculum move levels.
        visual: keep what pictures of the ground need.
        taught: a teacher's guidance follows the observation, see ``tdgc.learn.imitation``: its
            actions, and the prices of step frequencies from the least to the greatest action, see
            ``Teacher.price``.
        led: decisions of each robot over which the share of the episodes that the teacher drives
            falls from all to none.
        landing: of the low policy, for the teacher.
    """

    def __init__(
        self,
        config: HighLevelConfig,
        low: str | Path | Policy,
        num_robots: int,
        seed: int,
        training: bool = True,
        visual: bool = False,
        taught: bool = False,
        led: float = 0.0,
        landing: Landing | None = None,
    ) -> None:
        self.low, self.low_config = load_low(low)
        self.config = config = paired(config, self.low_config)
        self._visual = visual
        self.num_robots = m = num_robots
        self.training = training
        self.decoder = CommandDecoder(config.commands, config.action_limit, config.gaits)
        self.rng = np.random.default_rng(seed)
        self.step_seconds = config.decimation * self.low_config.physics.control_dt
        self.horizon = round(config.episode_seconds / self.step_seconds)
        self._hold = round(config.hold_seconds / self.step_seconds)
        self.family = np.arange(m) % len(config.families)
        first = np.arange(m) // len(config.families) % config.first_levels + config.first_level
        if config.curriculum == "hardest":
            first[:] = config.levels - 1
        self.curriculum = Curriculum(m, config.window, config.threshold, config.levels, first)
        alter = None
        if training and config.shallowest_trench is not None:
            alter = functools.partial(shallow, shallowest=config.shallowest_trench)
        self.tiles = TrainingTiles([config.families[f] for f in self.family], seed, alter)
        self.field = self.tiles.field
        self._build_robots()
        self._origin = self.field.origin(np.arange(m), 0)
        self.goal = np.zeros((m, 2))
        self.elapsed = np.zeros(m, dtype=np.int64)
        self._reached_at = np.full(m, -1)
        self._next_push = np.zeros(m)
        disturbed = config.randomisation, self.rng, self.step_seconds
        self._pushes = Pushes(*disturbed, self._next_push)
        self._actions = np.zeros((2, m, NUM_ACTIONS))
        self._commands = np.zeros((3, m, 15))
        self.stats: dict[str, float] = {}
        families = [config.families[f] for f in self.family]
        ranges = config.commands or CommandRanges()
        told = self.family_index != SEMANTIC.index("unknown")
        self.teacher = Teacher(self.field, families, ranges, landing, told) if taught else None
        self._lead, self._decisions = led, np.zeros(1, dtype=np.int64)
        self._led = np.zeros(m, dtype=bool)
        self._taught = np.zeros((m, NUM_ACTIONS))
        self.observation_space, self.action_space = high_spaces(config, taught)

    def _build_robots(self) -> None:
        self.tiles.draw(np.arange(self.num_robots), self.curriculum.levels)
        c, m = self.low_config, self.num_robots
        noise = Noise(self.config.randomisation, self.rng) if self.training else None
        self.locomotion = Locomotion(m, c.robot, c.physics, self.field, c.gyro, self._visual)
        self._executor = Executor(self.locomotion, self.low, noise)
        self._probes = HeightProbes(self.locomotion, PROBES[self.config.probes], noise)
        self._approach = Approach(self.locomotion, self.step_seconds)

    # ------------------------------------------------------------------ episodes

    def reset(self, index: NDArray[np.integer]) -> None:
        """Start new episodes for the robots ``index`` (n,)."""
        n, rng = len(index), self.rng
        if self.training and self.config.curriculum == "uniform":
            self.curriculum.levels[index] = rng.integers(self.config.levels, size=n)
        changed = self.tiles.begin(index, self.curriculum.levels)
        if changed.size:
            self.locomotion.world.upload_terrain(changed)
        starts, goals = draw_start_goal(rng, (n,))
        self.goal[index] = goals + self._origin[index]
        self.elapsed[index] = 0
        self._reached_at[index] = -1
        if self.training:
            width = self._width()[index]
            self.locomotion.randomise(index, self.config.randomisation, rng, width)
            self._pushes.schedule(index, self.elapsed)
        self._actions[:, index] = 0.0
        middle = self.decoder.decode(np.zeros(NUM_ACTIONS))
        self._commands[:, index] = command_share(middle, self.decoder)
        self.locomotion.place(
            index, starts[:, :2] + self._origin[index], starts[:, 2], rng.uniform(size=n)
        )
        self._probes.begin(index)
        self._approach.begin(index, self.goal)
        if self.teacher is not None:
            self.teacher.begin(index, self.goal)
            share = 1.0 - self._decisions[0] / self._lead if self._lead else 0.0
            self._led[index] = rng.uniform(size=n) < share

    def _width(self) -> Array:
        """How wide each robot's disturbances are: they grow with its level."""
        return self.curriculum.levels / max(self.config.levels - 1, 1)

    def restart(self) -> None:
        """End every episode, draw new tiles and build the world anew (see ``LowLevelTask``)."""
        self.locomotion.world.close()
        self._build_robots()
        self.reset(np.arange(self.num_robots))

    def step(
        self, actions: NDArray[np.floating]
    ) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """One decision: (M, 13) -> reward, terminated, truncated, (M,) each.

        The order is the paper's: physics and low policy, terminations and reaching, reward; the
        caller resets afterwards.

        Raises:
            ValueError: a value that is not finite.
        """
        loco, c = self.locomotion, self.config
        actions = np.where(self._led[:, None], self._taught, actions)
        self._decisions += 1
        self._actions = np.stack([self.decoder.normalise(actions), self._actions[0]])
        commands = self.decoder.decode(actions)
        share = command_share(commands, self.decoder)
        self._commands = np.concatenate([share[None], self._commands[:-1]])
        failed = np.zeros(self.num_robots, dtype=bool)
        force = np.zeros((self.num_robots, 5))
        reached = self._reached_at >= 0
        for _ in range(c.decimation):
            self._executor.step(commands)
            ended = outcome(loco.world, self.goal)
            failed |= has_failed(ended)
            reached |= (ended == REACHED) & ~failed
            state = loco.world.state
            now = np.column_stack([state.trunk_force, state.leg_force])
            np.maximum(force, now, out=force)
        self._probes.measure()
        self._approach.measure(self.goal)
        if self.teacher is not None:
            self.teacher.watch(loco, self.step_seconds)
        self.elapsed += 1
        self._reached_at[reached & (self._reached_at < 0)] = self.elapsed[
            reached & (self._reached_at < 0)
        ]
        seen = high_step(
            loco,
            self.goal,
            self.elapsed / self.horizon,
            self._actions,
            self._commands,
            force,
            c.rewards,
        )
        terms = rewards.high_terms(seen, self.step_seconds)
        reward = np.sum(list(terms.values()), axis=0)
        held = reached & (self.elapsed - self._reached_at >= self._hold)
        truncated = ~failed & (held | (self.elapsed >= self.horizon))
        done = np.flatnonzero(failed | truncated)
        self._count(terms, reward, commands, done, reached)
        if self.training:
            own = done[~self._led[done]]  # the teacher's episodes say nothing of the policy
            if own.size and c.curriculum == "performance":
                self.curriculum.push(own, reached[own])
            self._pushes.push(loco.world, self.elapsed, self._width())
        return reward, failed, truncated

    def observe(self) -> NDArray[np.float32]:
        """o^H, (M, n), and with a teacher its guidance, (M, ``GUIDANCE``)."""
        seen = observe(
            high_layout(self.config),
            Seen(
                self.locomotion,
                self.goal,
                self.elapsed / self.horizon,
                self._actions[0],
                self.family_index,
                self._probes.read(),
                self._probes.late,
                self._approach.speed,
            ),
        )
        if self.teacher is None:
            return seen
        commands = self.teacher.commands(self.locomotion, self.goal)
        self._taught = self.decoder.encode(self.decoder.nearest(commands))
        parts = (seen, self._taught, self.teacher.price)
        return np.concatenate(parts, axis=1, dtype=np.float32)

    @property
    def reached(self) -> NDArray[np.bool_]:
        """Whether each robot has reached its goal in this episode, (M,)."""
        return self._reached_at >= 0

    @property
    def family_index(self) -> NDArray[np.int64]:
        """Index into ``SEMANTIC`` of the family that each robot is told, (M,)."""
        names = [self.config.families[f] for f in self.family]
        told = np.array([SEMANTIC.index(n) if n in SEMANTIC else len(FAMILIES) for n in names])
        if self.training:  # the last robots of each family are not told
            each = self.num_robots / len(self.config.families)
            place = np.arange(self.num_robots) // len(self.config.families)
            told[place >= each * (1.0 - self.config.unknown_share)] = len(FAMILIES)
        return told

    # ------------------------------------------------------------------ statistics, resume

    def _count(
        self,
        terms: dict[str, Array],
        reward: Array,
        commands: Array,
        done: NDArray[np.integer],
        reached: NDArray[np.bool_],
    ) -> None:
        stats = self.stats

        def add(key: str, value: float) -> None:
            stats[key] = stats.get(key, 0.0) + float(value)

        add("steps", self.num_robots)
        add("reward", reward.sum())
        for name, value in terms.items():
            add(f"term/{name}", value.sum())
        gait = gait_index(commands)
        for col, family in enumerate(self.config.families):
            mine = self.family == col
            ended = done[mine[done] & ~self._led[done]]
            add(f"family/{family}/count", mine.sum())
            add(f"family/{family}/level", self.curriculum.levels[mine].sum())
            add(f"family/{family}/episodes", ended.size)
            add(f"family/{family}/reached", reached[ended].sum())
            for g, name in enumerate(GAITS):
                add(f"family/{family}/{name}", (gait[mine] == g).sum())

    def take_stats(self) -> dict[str, float]:
        """The sums since the last call."""
        stats, self.stats = self.stats, {}
        stats["bullet_seconds"] = self.locomotion.world.bullet_seconds
        return stats

    def forget(self) -> None:
        """Let what follows depend on ``state_dict`` alone, see ``World.forget``."""
        self.locomotion.world.forget()

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """Of the episodes under way."""
        taught = {} if self.teacher is None else {"speed": self.teacher.speed}
        return taught | {
            "goal": self.goal,
            "elapsed": self.elapsed,
            "reached_at": self._reached_at,
            "next_push": self._next_push,
            "actions": self._actions,
            "commands": self._commands,
            "led": self._led,
            "probes": self._probes.measured,
            "late": self._probes.late,
            "goal_distance": self._approach.distance,
            "closing_speed": self._approach.speed,
            "taught": self._taught,
        }

    def state_dict(self) -> State:
        """The curriculum and the robots' ``episodes`` under way, as copies."""
        return {
            "rng": self.rng.bit_generator.state,
            "tiles_drawn": self.tiles.drawn,
            "decisions": self._decisions.copy(),
            "curriculum": self.curriculum.state_dict(),
            "episodes": {
                **copies(self._arrays()),
                "locomotion": self.locomotion.state_dict(),
                "tiles": self.tiles.state_dict(),
            },
        }

    def load_state_dict(self, state: State) -> None:
        """Go on from a ``state_dict``, as a ``forget`` there would have gone on; from one without
        ``episodes`` with new ones, from one without a ``curriculum`` with the levels there are.

        Raises:
            ValueError: a state of other robots.
        """
        self.rng.bit_generator.state = state["rng"]
        if "curriculum" in state:
            self.curriculum.load_state_dict(state["curriculum"])
        self.tiles.drawn = int(state["tiles_drawn"])
        self._decisions[:] = state["decisions"]
        if "episodes" not in state:
            self.restart()
            return
        episodes = state["episodes"]
        fill(self._arrays(), episodes)
        self.tiles.load_state_dict(episodes["tiles"])
        self.locomotion.world.upload_terrain()
        self.locomotion.load_state_dict(episodes["locomotion"])
        if self.teacher is not None:
            self.teacher.begin(np.arange(self.num_robots), self.goal)
            self.teacher.speed[:] = episodes["speed"]

    def close(self) -> None:
        """Disconnect from Bullet."""
        self.locomotion.world.close()


class NavigationEnv(TaskEnv):
    """``NavigationTask`` for one robot, id ``tdgc/Navigation-v0``.

    Observations are those of ``high_layout``, (92,) by default; actions are (13,) in [-1, 1]: the
    continuous commands in the order of ``tdgc.sim.commands.CONTINUOUS``, then the gait. A step is a
    decision, 0.1 s.

    Args:
        config: the MDP; the default one if None.
        low: the frozen low policy's file.
        render_mode: None or rgb_array.

    Raises:
        ValueError: a low policy that cannot be used, or a configuration that does not fit it.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  as in gymnasium

    def __init__(
        self,
        config: HighLevelConfig | None = None,
        low: str | Path = PRETRAINED / "low",
        render_mode: str | None = None,
    ) -> None:
        self.config = config or HighLevelConfig()
        super().__init__(
            lambda seed, visual: NavigationTask(self.config, low, 1, seed, visual=visual),
            render_mode,
        )


def summarise(sums: dict[str, float]) -> dict[str, float]:
    """Sums of ``NavigationTask.take_stats`` over all workers -> values to log."""
    steps = max(sums.get("steps", 0.0), 1.0)
    values = {"reward/total": sums.get("reward", 0.0) / steps}
    for key, value in sums.items():
        if key.startswith("term/"):
            values[f"reward/{key[5:]}"] = value / steps
    counts = [k for k in sums if k.startswith("family/") and k.endswith("/count")]
    families = [k.removeprefix("family/").removesuffix("/count") for k in counts]
    for family in families:
        count = max(sums[f"family/{family}/count"], 1.0)
        values[f"level/{family}"] = sums[f"family/{family}/level"] / count
        episodes = sums[f"family/{family}/episodes"]
        if episodes:
            values[f"success/{family}"] = sums[f"family/{family}/reached"] / episodes
        for gait in GAITS:
            values[f"gait/{family}_{gait}"] = sums[f"family/{family}/{gait}"] / count
    return values
