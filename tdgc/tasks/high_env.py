"""The decision-level MDP (paper Sec. IV-B, IV-C) around a frozen low policy.

``NavigationTask`` is the MDP for M robots at once, each on a tile of its own whose level the
curriculum sets; ``NavigationEnv`` wraps it as a Gymnasium environment with one robot.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tdgc.config import HighLevelConfig
from tdgc.policies import Policy
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.commands import NUM_ACTIONS, CommandDecoder, default_command, gait_index
from tdgc.sim.families import MAX_LEVEL
from tdgc.sim.gaits import GAITS
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array
from tdgc.sim.sensors import Noise
from tdgc.sim.tile import draw_start_goal
from tdgc.state import State, copies, fill
from tdgc.tasks.curriculum import Curriculum
from tdgc.tasks.executor import Executor
from tdgc.tasks.high_observation import GUIDANCE, HighObserver, high_spaces, semantic_index
from tdgc.tasks.high_rewards import HighReward
from tdgc.tasks.pairing import PRETRAINED, load_low, mdp_of, paired
from tdgc.tasks.pushes import Pushes
from tdgc.tasks.rules import REACHED, episode_steps, has_failed, outcome
from tdgc.tasks.statistics import Sums
from tdgc.tasks.task_env import TaskEnv
from tdgc.tasks.teacher import WAY, Skill, Teacher
from tdgc.tasks.tiles import TrainingTiles, check_tiles


class NavigationTask:
    """The high policy's MDP for M robots.

    Actions are (M, 13) in [-a_max, a_max]; they are decoded and held for ``decimation`` control
    steps of the frozen low policy. An episode fails when the trunk is too low or hits something too
    hard, or when the robot leaves its tile. It is truncated after ``episode_seconds``, or
    ``hold_seconds`` after the goal was reached.

    Args:
        config: the MDP's configuration.
        low: the frozen low policy.
        num_robots: M.
        seed: seed of everything random in the task.
        training: draw disturbances and let the curriculum change levels.
        visual: keep what rendering needs.
        taught: what a teacher has to know of the low policy, to append its guidance to the
            observation, see ``tdgc.learn.imitation``: its actions, a second way around obstacles,
            and the prices of strides. None: no teacher.
        led: number of decisions per robot over which the share of episodes that the teacher drives
            falls from all to none.
        first: number of the first robot among those of the run; families are dealt by number.
    """

    def __init__(
        self,
        config: HighLevelConfig,
        low: Policy,
        num_robots: int,
        seed: int,
        training: bool = True,
        visual: bool = False,
        taught: Skill | None = None,
        led: float = 0.0,
        first: int = 0,
    ) -> None:
        self.low, self.low_config = low, mdp_of(low)
        self.config = config = paired(config, self.low_config)
        self._visual = visual
        self.num_robots = m = num_robots
        self.training = training
        self.decoder = CommandDecoder(config.commands, config.action_limit, config.gaits)
        self.rng = np.random.default_rng(seed)
        self.step_seconds = config.decimation * self.low_config.physics.control_dt
        self.horizon = episode_steps(config.episode_seconds, self.step_seconds)
        self._hold_decisions = round(config.hold_seconds / self.step_seconds)
        rank, self.family = np.divmod(first + np.arange(m), len(config.families))
        levels = rank % config.first_levels + config.first_level
        if config.curriculum == "hardest":
            levels[:] = config.levels - 1
        self.curriculum = Curriculum(m, config.window, config.threshold, config.levels, levels)
        families = [config.families[f] for f in self.family]
        self.tiles = TrainingTiles(families, seed, config.shallowest_trench if training else None)
        self.field = self.tiles.field
        self._build_robots()
        self._origin = self.field.origin(np.arange(m))
        self.goal = np.zeros((m, 2))
        self.elapsed = np.zeros(m, dtype=np.int64)
        self._reached_at = np.full(m, -1)
        self._told = np.array([semantic_index(family) for family in families])
        # Not told its family in this episode: without the semantic cue, no robot is.
        semantic = config.cues in ("both", "semantic")
        self._unknown_share = config.unknown_share if semantic else 1.0
        self._untold = np.full(m, not semantic)
        self._next_push = np.zeros(m)
        self._pushes = Pushes(config.randomisation, self.rng, self.step_seconds, self._next_push)
        self.rewards = HighReward(config, self.decoder, m, self.step_seconds)
        self.stats = Sums()
        self.teacher = None
        if taught is not None:
            assert config.commands is not None  # ``paired`` has set them
            self.teacher = Teacher(self.field, config.commands, self.low_config.robot, taught)
        self._lead, self._decisions = led, np.zeros(1, dtype=np.int64)
        self._led = np.zeros(m, dtype=bool)
        self._taught = np.zeros((m, NUM_ACTIONS))
        self.observation_space, self.action_space = high_spaces(config, taught is not None)

    def _build_robots(self) -> None:
        self.tiles.draw(np.arange(self.num_robots), self.curriculum.levels)
        c, m = self.low_config, self.num_robots
        noise = Noise(self.config.randomisation, self.rng) if self.training else None
        self.world = BulletWorld(m, c.robot, c.physics, self.field, self._visual)
        self.locomotion = Locomotion(self.world, c)
        self._executor = Executor(self.locomotion, self.low, noise)
        self._observer = HighObserver(self.locomotion, self.config, noise)

    # ------------------------------------------------------------------ episodes

    def reset(self, index: NDArray[np.integer]) -> None:
        """Start new episodes for the robots ``index`` (n,)."""
        n, rng, levels = len(index), self.rng, self.config.levels
        if self.training and self.config.curriculum == "uniform":
            self.curriculum.levels[index] = rng.integers(levels, size=n)
        elif self.training and self.config.curriculum == "hardest":
            self.curriculum.levels[index] = levels - 1  # a resumed run may have had others
        changed = self.tiles.begin(index, self.curriculum.levels)
        if changed.size:
            self.world.upload_terrain(changed)
        starts, goals = draw_start_goal(rng, (n,))
        self.goal[index] = goals + self._origin[index]
        self.elapsed[index] = 0
        self._reached_at[index] = -1
        if self.training:
            width = self._width()[index]
            self.locomotion.randomise(index, self.config.randomisation, rng, width)
            self._pushes.schedule(index, self.elapsed)
            self._untold[index] = rng.uniform(size=n) < self._unknown_share
        self.rewards.begin(index)
        self.locomotion.command[index] = default_command()  # as in the evaluation
        self.locomotion.place(
            index, starts[:, :2] + self._origin[index], starts[:, 2], rng.uniform(size=n)
        )
        self._observer.begin(index, self.goal)
        if self.teacher is not None:
            self.teacher.begin(index, self.goal)
            share = 1.0 - self._decisions[0] / self._lead if self._lead else 0.0
            self._led[index] = rng.uniform(size=n) < share

    def _width(self) -> Array:
        """Scale of each robot's disturbances, (M,), 0 on level 0 and 1 on ``MAX_LEVEL``."""
        return self.curriculum.levels / MAX_LEVEL

    def restart(self) -> None:
        """End every episode, draw new tiles and rebuild the world from scratch."""
        self.world.close()
        self._build_robots()
        self.reset(np.arange(self.num_robots))

    def step(
        self, actions: NDArray[np.floating]
    ) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """Carry out one decision: (M, 13) -> reward, terminated, truncated, (M,) each.

        The order is the paper's: physics and low policy, terminations and goal, reward. The caller
        resets robots afterwards.

        Raises:
            ValueError: an action that is not finite.
        """
        loco, c = self.locomotion, self.config
        actions = np.where(self._led[:, None], self._taught, actions)
        self._decisions += 1
        commands = self.decoder.decode(actions)
        self.rewards.decide(commands, actions)
        failed = np.zeros(self.num_robots, dtype=bool)
        reached = self._reached_at >= 0
        for _ in range(c.decimation):
            self._executor.step(commands)
            ended = outcome(loco.world, self.goal)
            failed |= has_failed(ended)
            reached |= (ended == REACHED) & ~failed
            self.rewards.measure(loco.world.state)
        self._observer.measure(self.goal)
        if self.teacher is not None:
            self.teacher.watch(loco, self.step_seconds)
        self.elapsed += 1
        first = reached & (self._reached_at < 0)
        self._reached_at[first] = self.elapsed[first]
        terms = self.rewards.terms(loco, self.goal, self.elapsed / self.horizon)
        reward = np.sum(list(terms.values()), axis=0)
        held = reached & (self.elapsed - self._reached_at >= self._hold_decisions)
        truncated = ~failed & (held | (self.elapsed >= self.horizon))
        # Episodes that the teacher drives do not rate the policy.
        own = np.flatnonzero((failed | truncated) & ~self._led)
        self._count(terms, reward, commands, own)
        if self.training:
            if own.size and c.curriculum == "performance":
                self.curriculum.push(own, reached[own])
            self._pushes.push(loco.world, self.elapsed, self._width())
        return reward, failed, truncated

    def observe(self) -> NDArray[np.float32]:
        """o^H, (M, n), followed by the guidance if there is a teacher: (M, ``GUIDANCE``), in the
        order of ``GUIDANCE_PARTS``."""
        seen = self._observer.observe(
            self.goal, self.elapsed / self.horizon, self.rewards.actions[0], self.family_index
        )
        teacher = self.teacher
        if teacher is None:
            return seen
        guidance = np.zeros((self.num_robots, GUIDANCE))
        if np.isfinite(seen).all():  # else a robot has blown up: the worker ends all episodes
            commands = teacher.commands(self.locomotion, self.goal)
            self._taught, other = (
                self.decoder.encode(self.decoder.nearest(way)) for way in (commands, teacher.other)
            )
            aside = (other - self._taught)[:, WAY]
            price = teacher.price.reshape(self.num_robots, -1)
            guidance = np.column_stack([self._taught, aside, teacher.dearer, price])
        return np.concatenate([seen, guidance], axis=1, dtype=np.float32)

    @property
    def reached(self) -> NDArray[np.bool_]:
        """Whether each robot has reached its goal in this episode, (M,)."""
        return self._reached_at >= 0

    @property
    def family_index(self) -> NDArray[np.int64]:
        """Index into ``SEMANTIC`` of the family that each robot observes, (M,)."""
        return np.where(self._untold, semantic_index("unknown"), self._told)

    # ------------------------------------------------------------------ statistics, resume

    def _count(
        self, terms: dict[str, Array], reward: Array, commands: Array, ended: NDArray[np.integer]
    ) -> None:
        """Add a decision to ``stats``; the episodes of the robots ``ended`` rate the policy."""
        add, gait = self.stats.add, gait_index(commands)
        self.stats.add_rewards(terms, reward)
        for col, family in enumerate(self.config.families):
            mine = self.family == col
            over = ended[mine[ended]]
            add(f"family/{family}/count", mine.sum())
            add(f"family/{family}/level", self.curriculum.levels[mine].sum())
            add(f"family/{family}/episodes", over.size)
            add(f"family/{family}/reached", self.reached[over].sum())
            for g, name in enumerate(GAITS):
                add(f"family/{family}/{name}", (gait[mine] == g).sum())

    def take_stats(self) -> dict[str, float]:
        """Return and restart the sums."""
        stats, self.stats = self.stats, Sums()
        return stats

    def forget(self) -> None:
        """Make what follows depend on ``state_dict`` alone, see ``World.forget``."""
        self.world.forget()

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """State of the episodes under way, not copied."""
        taught = {} if self.teacher is None else {"speed": self.teacher.speed}
        return (
            taught
            | self._observer.arrays()
            | {
                "goal": self.goal,
                "elapsed": self.elapsed,
                "reached_at": self._reached_at,
                "next_push": self._next_push,
                "actions": self.rewards.actions,
                "commands": self.rewards.commands,
                "led": self._led,
                "untold": self._untold,
                "taught": self._taught,
            }
        )

    def state_dict(self) -> State:
        """The curriculum, the random generator and the ``episodes`` under way, as copies."""
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
        """Resume from a ``state_dict``, exactly as the saved task continues after ``forget``.

        Without ``episodes`` in the state, new ones begin; without a ``curriculum``, the current
        levels stay.

        Raises:
            ValueError: the state does not fit these robots.
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
        self.world.upload_terrain()
        self.locomotion.load_state_dict(episodes["locomotion"])
        if self.teacher is not None:
            self.teacher.begin(np.arange(self.num_robots), self.goal)
            self.teacher.speed[:] = episodes["speed"]

    def close(self) -> None:
        """Disconnect from Bullet."""
        self.world.close()


class NavigationEnv(TaskEnv):
    """``NavigationTask`` with one robot, id ``tdgc/Navigation-v0``.

    Observations are those of ``high_layout``, (92,) by default. Actions are (13,) in [-1, 1]: the
    continuous commands in the order of ``tdgc.sim.commands.CONTINUOUS``, then the gait. A step is
    one decision, 0.1 s. The seed chooses the family: its place among the configured ones is the
    seed modulo their number.

    Args:
        config: the MDP's configuration; the default one if None.
        low: file of the frozen low policy.
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
        check_tiles(self.config.families, self.config.levels)
        policy, _ = load_low(low)
        super().__init__(
            lambda seed, visual: NavigationTask(
                self.config, policy, 1, seed, visual=visual, first=seed % len(self.config.families)
            ),
            render_mode,
        )
