"""The low policy's MDP (paper Sec. IV-A): follow commands in gait, on increasingly hard terrain.

``LowLevelTask`` is the MDP for M robots at once; ``LowLevelEnv`` wraps it as a Gymnasium
environment with one robot.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tdgc.config import LowLevelConfig
from tdgc.parallel.group import TaskGroup
from tdgc.parallel.worker import Task
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.commands import INDEX, gait_index
from tdgc.sim.gaits import GAITS, gait_embedding
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.observation import observe
from tdgc.sim.robot import Array
from tdgc.sim.sensors import Noise
from tdgc.sim.tile import TILE_SIZE, draw_start_goal
from tdgc.state import State, copies, fill
from tdgc.tasks.command_draw import PRONK, CommandDraw
from tdgc.tasks.crossings import Crossings
from tdgc.tasks.episodes import Episodes
from tdgc.tasks.ground import measure_ground
from tdgc.tasks.leaps import Landing
from tdgc.tasks.low_observation import CRITIC_LAYOUT, CriticSources, low_spaces
from tdgc.tasks.low_rewards import LowStep, low_terms, total
from tdgc.tasks.pushes import Pushes
from tdgc.tasks.rules import COLLIDED, FELL, LEFT_TILE, episode_steps, outcome
from tdgc.tasks.statistics import Sums, by_gait
from tdgc.tasks.task_env import TaskEnv
from tdgc.tasks.tiles import FLAT, TrainingTiles, check_tiles

_PLANE_SPACING = 5.0  # m between robots on the plane, so that few boxes overlap in the broad phase


class LowLevelTask:
    """The low policy's MDP for M robots.

    Observation rows are [actor part | critic part], see ``tdgc.tasks.low_observation``. Actions are
    (M, 12) in [-a_max, a_max]. An episode ends in failure when the trunk is less than 0.15 m above
    the support surface or hits something with more than 40 N. It is truncated after
    ``episode_seconds``, when the robot leaves its tile, or when it has crossed it.

    Args:
        config: the MDP's configuration.
        num_robots: M.
        seed: seed of everything random in the task.
        training: draw noise, pushes and randomised dynamics, and let levels and command ranges
            change.
        visual: keep what rendering needs.
        first: number of the first robot among those of the run; families are dealt by number.

    Attributes:
        level: (M,) level of each robot's tile.
        commands: draws commands, from velocity ranges that grow.
        crossings: steers robots over their tiles.
        episodes: per-robot state that persists from step to step.
        ground: the ground under the robots after the last step or reset.
    """

    def __init__(
        self,
        config: LowLevelConfig,
        num_robots: int,
        seed: int,
        training: bool = True,
        visual: bool = False,
        first: int = 0,
    ) -> None:
        self.config, self._visual = config, visual
        self.num_robots = m = num_robots
        self.training = training
        self.rng = np.random.default_rng(seed)
        self.horizon = episode_steps(config.episode_seconds, config.physics.control_dt)
        self._command_steps = round(config.command_seconds / config.physics.control_dt)
        self.level = self.rng.integers(0, min(config.first_levels, config.levels), m)
        self.column = (first + np.arange(m)) % len(config.families)
        on_tiles = config.terrain == "tiles"
        families = [config.families[c] if on_tiles else FLAT for c in self.column]
        shallowest = config.crossing.shallowest_trench
        self.tiles = TrainingTiles(families, seed, shallowest) if on_tiles else None
        self.field = None if self.tiles is None else self.tiles.field
        # Longest gait cycle in control steps; tilts are kept for one step more, to interpolate.
        cycle = 1.0 / (config.commands.frequency[0] * config.physics.control_dt)
        self.episodes = Episodes(m, math.ceil(cycle) + 1)
        self.commands = CommandDraw(config, self.rng, training)
        self.crossings = Crossings(config, families, self.episodes, self.rng)
        self.pushes = Pushes(
            config.randomisation, self.rng, config.physics.control_dt, self.episodes.next_push
        )
        self._noise = Noise(config.randomisation, self.rng) if training else None
        self._build()
        self.stats = Sums()
        self.observation_space, self.action_space = low_spaces(config)

    def _build(self) -> None:
        """Draw all tiles and build the world."""
        c, everyone = self.config, np.arange(self.num_robots)
        if self.tiles is not None:
            self.tiles.draw(everyone, self.level)
            self.crossings.look(self.tiles.field, everyone)
        self.world = BulletWorld(self.num_robots, c.robot, c.physics, self.field, self._visual)
        self.locomotion = Locomotion(self.world, c)
        self.ground = measure_ground(self.locomotion)

    # ------------------------------------------------------------------ episodes

    def reset(self, index: NDArray[np.integer]) -> None:
        """Start new episodes for the robots ``index`` (n,)."""
        self.episodes.reset(index)
        xy, yaw = self._draw_places(index)
        if self.training:
            self.locomotion.randomise(index, self.config.randomisation, self.rng)
            self.pushes.schedule(index, self.episodes.elapsed)
        self._draw_commands(index)
        # Start near the commanded heading, so that the first command needs no turn on the spot.
        yaw = yaw + np.where(self.episodes.crossing[index], self.episodes.facing[index], 0.0)
        self.locomotion.place(index, xy, yaw, self.rng.uniform(size=len(index)))
        self.ground = measure_ground(self.locomotion)
        self.crossings.steer(self.locomotion, self.ground, index)

    def _draw_places(self, index: NDArray[np.integer]) -> tuple[Array, Array]:
        """Draw where the robots ``index`` (n,) start, (n, 2) m, and their yaw, (n,) rad."""
        n, rng = len(index), self.rng
        if self.tiles is None:
            xy = np.stack([index % 10, index // 10], axis=1) * _PLANE_SPACING
            return xy, rng.uniform(-np.pi, np.pi, n)
        changed = self.tiles.begin(index, self.level)
        if changed.size:
            self.world.upload_terrain(changed)
            self.crossings.look(self.tiles.field, changed)
        origin = self.tiles.field.origin(index)
        start, goal = draw_start_goal(rng, (n,))
        # Free commands lead anywhere, so robots on flat tiles start in the middle.
        start[self.crossings.flat[index], :2] = 0.5 * TILE_SIZE
        self.crossings.begin(index, origin, goal + origin)
        return start[:, :2] + origin, start[:, 2]

    def _draw_commands(self, index: NDArray[np.integer]) -> None:
        """Draw new commands for the robots ``index`` (n,), free or for crossing their tiles."""
        bounds = self.commands.bounds(len(index))
        self.crossings.narrow(index, self.level, *bounds)
        free = ~self.episodes.crossing[index]
        gait, values, again = self.commands.draw(*bounds, free)
        self.episodes.retried[index] = again
        self.crossings.draw(index, gait, values, self.commands.share[PRONK])
        command = np.concatenate([values, gait_embedding(gait)], axis=1)
        self.locomotion.command[index] = command

    def restart(self) -> None:
        """End every episode, redraw the terrain and rebuild the world from scratch, as at the start
        of a run."""
        self.world.close()
        self._build()
        self.commands.scores[:] = 0.0
        everyone, e = np.arange(self.num_robots), self.episodes
        self.reset(everyone)
        # Spread the ends of the new episodes over time.
        e.elapsed[:] = e.began[:] = self.rng.integers(0, self.horizon, self.num_robots)
        self.pushes.schedule(everyone, e.elapsed)

    def step(
        self, actions: NDArray[np.floating]
    ) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """Run one control step: (M, 12) -> reward, terminated, truncated, (M,) each."""
        loco, c, e = self.locomotion, self.config, self.episodes
        speed, clock = loco.world.state.qd.copy(), loco.clock.clock.copy()
        loco.act(np.asarray(actions, dtype=np.float64))
        e.elapsed += 1
        self.crossings.learn_landing(loco, clock)
        self.ground = measure_ground(loco)
        terms = low_terms(self._low_step(speed), c.rewards)
        reward = total(terms, c.rewards, c.physics.control_dt, self._penalty())
        ended = outcome(loco.world)
        terminated = np.isin(ended, (FELL, COLLIDED))
        over = (e.elapsed >= self.horizon) | (ended == LEFT_TILE) | e.reached
        truncated = ~terminated & over
        self._count(terms, reward, terminated)
        e.tilts[:] = np.roll(e.tilts, 1, axis=1)
        e.tilts[:, 0] = loco.world.state.gravity[:, :2]
        e.was_contact[:] = loco.world.state.touching
        if self.training:
            # A failed retry is not remembered again: retried until they succeed, a few hopeless
            # commands would soon be the only ones left.
            self.commands.remember(loco.command[terminated & ~e.crossing & ~e.retried])
            x = loco.world.state.position[:, 0] - e.origin[:, 0]
            tried = terminated | (e.elapsed - e.began >= self.horizon)
            self.level = self.crossings.move(self.level, x, terminated | truncated, tried)
        self._change_commands()
        if self.training:
            self.pushes.push(loco.world, e.elapsed, np.ones(self.num_robots))
        return reward, terminated, truncated

    def _change_commands(self) -> None:
        """Draw the commands that are due, and steer crossings."""
        if self._command_steps:
            elapsed = self.episodes.elapsed
            due = np.flatnonzero((elapsed % self._command_steps == 0) & (elapsed > 0))
            if due.size:
                self._draw_commands(due)
        everyone = np.arange(self.num_robots)
        self.crossings.steer(self.locomotion, self.ground, everyone)

    @property
    def reached(self) -> NDArray[np.bool_]:
        """Whether each robot has crossed its tile in this episode, (M,)."""
        return self.episodes.reached

    # ------------------------------------------------------------------ reward, observation

    def _low_step(self, speed_before: Array) -> LowStep:
        loco, c = self.locomotion, self.config
        command = loco.executed()
        return LowStep(
            state=loco.world.state,
            command=command,
            phases=loco.clock.phases,
            contact=loco.clock.contact,
            swing=loco.swing(),
            base_height=self.ground.base,
            foot_height=self.ground.feet,
            standing_height=c.robot.base_height,
            stance=c.robot.stance,
            targets=loco.targets,
            actions=loco.actions,
            acceleration=(loco.world.state.qd - speed_before) / c.physics.control_dt,
            last_tilt=self._last_tilt(command[:, INDEX["frequency"]]),
            was_contact=self.episodes.was_contact,
            config=c.rewards,
        )

    def _last_tilt(self, frequency: Array) -> Array:
        """Tilt one cycle of ``frequency`` (M,) Hz ago, (M, 2), interpolated between steps."""
        tilts = self.episodes.tilts
        # ``tilts`` starts at the previous step.
        ago = 1.0 / (frequency * self.config.physics.control_dt) - 1.0
        newer = np.clip(np.floor(ago).astype(int), 0, tilts.shape[1] - 2)
        rows, older = np.arange(len(tilts)), (ago - newer)[:, None]
        return (1.0 - older) * tilts[rows, newer] + older * tilts[rows, newer + 1]

    def _penalty(self) -> Array:
        """Share of the penalties that counts for each robot, (M,): ``terrain_penalty`` on terrain;
        on flat ground from 1 to ``walking_penalty`` as the gait's velocity ranges grow."""
        c = self.config.rewards
        share = 1.0 + (c.walking_penalty - 1.0) * self.commands.grown()
        mine = share[gait_index(self.locomotion.command)]
        return np.where(self.crossings.flat, mine, c.terrain_penalty)

    def observe(self) -> NDArray[np.float32]:
        """Observations (M, n): the actor's part, noisy in training, then the critic's."""
        actor = self.locomotion.observe(self._noise)
        critic = observe(CRITIC_LAYOUT, CriticSources(self.locomotion, self.ground))
        return np.concatenate([actor, critic], axis=1)

    # ------------------------------------------------------------------ statistics, resume

    def _count(self, terms: dict[str, Array], reward: Array, terminated: NDArray[np.bool_]) -> None:
        """Add this step to ``stats``; see ``statistics.summarise_low`` for what is logged."""
        add = self.stats.add
        self.stats.add_rewards(terms, reward)
        add("minutes", self.num_robots * self.config.physics.control_dt / 60.0)
        add("falls", terminated.sum())
        sums = by_gait(self.locomotion, terms)
        for key in ("steps", "lin", "yaw", "match"):
            for gait, value in zip(GAITS, sums[key], strict=True):
                add(f"gait/{gait}/{key}", value)
        self.commands.judge(sums, self.num_robots)
        if self.field is not None:
            for column, family in enumerate(self.config.families):
                if family != FLAT:
                    mine = self.column == column
                    add(f"level/{family}/count", mine.sum())
                    add(f"level/{family}/level", self.level[mine].sum())

    def take_stats(self) -> dict[str, float]:
        """Return and restart the sums; command shares, landing and Bullet's time are not reset."""
        stats, self.stats = self.stats, Sums()
        for gait, share in zip(GAITS, self.commands.share, strict=True):
            stats[f"share/{gait}"] = self.num_robots * float(share)
        stats["robots"] = float(self.num_robots)
        if self.crossings.leapers.any():
            landing = self.crossings.landing
            stats |= {
                "leapers": 1.0, "landing/front": landing.front, "landing/spread": landing.spread
            }  # fmt: skip
        stats["bullet_seconds"] = self.world.bullet_seconds
        return stats

    def forget(self) -> None:
        """Make what follows depend on ``state_dict`` alone, see ``World.forget``."""
        self.world.forget()

    def _learned(self) -> dict[str, NDArray[Any]]:
        return {
            "level": self.level, "command_share": self.commands.share, "falls": self.commands.falls
        }  # fmt: skip

    def _under_way(self) -> dict[str, NDArray[Any]]:
        own = {"gait_scores": self.commands.scores, "spread": self.crossings.spread}
        return self.episodes.arrays() | own

    def state_dict(self) -> State:
        """Levels, command curriculum, landing, generator and ``episodes`` under way, as copies."""
        landing = self.crossings.landing
        return {
            "rng": self.rng.bit_generator.state,
            "landing": [landing.front, landing.spread],
            "tiles_drawn": 0 if self.tiles is None else self.tiles.drawn,
            **copies(self._learned()),
            "episodes": {
                **copies(self._under_way()),
                "locomotion": self.locomotion.state_dict(),
                "tiles": {} if self.tiles is None else self.tiles.state_dict(),
            },
        }

    def load_state_dict(self, state: State) -> None:
        """Resume from a ``state_dict``, exactly as the saved task continues after ``forget``.

        Without ``episodes`` in the state, new ones begin.

        Raises:
            ValueError: the state does not fit these robots.
        """
        self.rng.bit_generator.state = state["rng"]
        self.crossings.landing = Landing(*state["landing"])
        fill(self._learned(), state)
        if self.tiles is not None:
            self.tiles.drawn = int(state["tiles_drawn"])
        if "episodes" not in state:
            self.restart()
            return
        episodes = state["episodes"]
        fill(self._under_way(), episodes)
        if self.tiles is not None:
            self.tiles.load_state_dict(episodes["tiles"])
            self.crossings.plan(self.tiles.field, np.arange(self.num_robots))
            self.world.upload_terrain()
        self.locomotion.load_state_dict(episodes["locomotion"])
        self.ground = measure_ground(self.locomotion)

    def close(self) -> None:
        """Disconnect from Bullet."""
        self.world.close()


def make_task(
    config: tuple[LowLevelConfig, LowLevelConfig],
    share: float,
    robots: int,
    seed: int,
    *,
    first: int = 0,
) -> Task:
    """Make a worker's task: a ``share`` of the run's robots act in the first MDP, the rest (at
    least one in the run) in the second; ``first`` of the run's robots are in earlier workers."""
    before = math.floor(share * first)
    here = math.floor(share * (first + robots)) - before
    numbers, firsts = (here, robots - here), (before, first - before)
    if not all(numbers):
        only = int(not here)
        return LowLevelTask(config[only], robots, seed, first=firsts[only])
    seeds = np.random.SeedSequence(seed).generate_state(2).tolist()
    return TaskGroup(
        [
            LowLevelTask(mdp, number, own, first=place)
            for mdp, number, own, place in zip(config, numbers, seeds, firsts, strict=True)
        ]
    )


class LowLevelEnv(TaskEnv):
    """``LowLevelTask`` with one robot, id ``tdgc/LowLevel-v0``.

    Observations are what the actor sees (``tdgc.sim.locomotion.actor_layout``), followed by what
    only the critic sees (``CRITIC_LAYOUT``), (90 + 40,) by default. Actions are (12,) in [-4, 4]:
    offsets of the joint targets from q0 (``Locomotion.pose``), in units of ``action_scale``, for
    hips times ``hip_scale``. A step is one control step, 0.02 s. On tiles the seed chooses the
    family: its place among the configured ones is the seed modulo their number.

    Args:
        config: the MDP's configuration; the default one, on a plane, if None.
        render_mode: None or rgb_array.
    """

    def __init__(
        self, config: LowLevelConfig | None = None, render_mode: str | None = None
    ) -> None:
        self.config = config or LowLevelConfig()
        check_tiles(self.config.families, self.config.levels)
        super().__init__(
            lambda seed, visual: LowLevelTask(
                self.config, 1, seed, visual=visual, first=seed % len(self.config.families)
            ),
            render_mode,
        )
