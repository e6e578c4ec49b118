"""Evaluation (TDGC-Bench): episodes on fixed tiles, the same for every policy.

Episodes run in batches, each in its own world with one tile per robot. A batch depends only on its
policy, condition and tiles. The table therefore does not depend on how many processes share the
batches.
"""

import contextlib
import dataclasses
import itertools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tdgc.benchmark.drivers import Driver
from tdgc.config import LowLevelConfig, PhysicsConfig, RandomisationConfig
from tdgc.policies import Policy
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.commands import gait_index
from tdgc.sim.families import MAX_LEVEL
from tdgc.sim.gaits import GAITS
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array
from tdgc.sim.sensors import EpisodeDraws, Noise
from tdgc.sim.terrain import EVAL_STREAM, family_number, file_label, make_tile, tile_rng
from tdgc.sim.tile import Tile, TileField
from tdgc.sim.world import World
from tdgc.tasks.executor import Carries, Executor
from tdgc.tasks.pairing import mdp_of
from tdgc.tasks.rules import GOING, HORIZON, OUTCOMES, outcome

BATCH = 50  # episodes per world: enough to keep numpy busy, few enough to distribute evenly
POSE_SECONDS = 0.2  # s between two poses of a track, in which a robot moves 24 cm at most


@dataclass(frozen=True)
class Condition:
    """One evaluation condition of the benchmark; what it does not set is nominal.

    Attributes:
        what: what the condition changes, as text for people.
        levels, families: where the condition is run; None for the requested ones.
        episodes_share: share of the requested episodes per cell that is run (by default 100
            episodes nominal, 20 in the others).
    """

    what: str
    levels: tuple[int, ...] | None = None
    families: tuple[str, ...] | None = None
    friction: float | None = None
    payload: float = 0.0  # kg
    push_speed: float = 0.0  # m/s, every 3 s
    motor: float = 1.0  # factor on torque limits and gains
    armature: float = 0.0  # kg m^2, rotor inertia of each joint
    latency: float = 0.0  # s
    physics_hz: int | None = None
    noise: RandomisationConfig | None = None  # of the sensors; also starts the gait clock at random
    told: bool = True  # whether the semantic cue names the family; "unknown" otherwise
    mirrored: bool = False  # whether left and right of every tile are exchanged
    episodes_share: float = 0.2


PUSH_INTERVAL = 3.0  # s (benchmark's `pushes`)
_NOISE = RandomisationConfig(probe_delay=1.0)

#: The conditions of the benchmark, by name.
CONDITIONS: dict[str, Condition] = {
    "nominal": Condition("nothing", episodes_share=1.0),
    "levels-11-12": Condition("levels 11, 12", levels=(11, 12)),
    "mixed": Condition("tiles of two families, never trained on", families=("mixed",)),
    "friction-0.4": Condition("friction 0.4", friction=0.4),
    "payload-3kg": Condition("3 kg on the trunk", payload=3.0),
    "pushes": Condition(f"pushes of 0.75 m/s every {PUSH_INTERVAL:g} s", push_speed=0.75),
    "motor-0.85": Condition("0.85 times the torque limits and gains of the joints", motor=0.85),
    "armature-0.01": Condition("rotor inertia of 0.01 kg m^2 per joint", armature=0.01),
    "latency-30ms": Condition("commands reach the joints 30 ms late", latency=0.03),
    "physics-1000hz": Condition("physics and joint control at 1000 Hz", physics_hz=1000),
    "noise": Condition(
        "noise of the sensors as in training; the gait clock starts at random; height probes off "
        f"by up to {100 * _NOISE.noise_probes:g} cm and a decision late",
        noise=_NOISE,
    ),
    "no-family": Condition('the terrain family is "unknown" to the policy', told=False),
    "mirrored": Condition("left and right of every tile exchanged", mirrored=True),
}


@dataclass(frozen=True)
class Cell:
    """A batch of episodes of one family and level: ``count`` of them, from number ``first`` on."""

    policy: str
    condition: str
    family: str
    level: int
    first: int
    count: int


@dataclass(frozen=True, eq=False)
class EpisodeRecord:
    """Fields that every record of an episode begins with: its identity and outcome, one of
    ``OUTCOMES``."""

    policy: str
    condition: str
    family: str
    level: int
    episode: int
    seed: int
    outcome: str

    @property
    def identity(self) -> dict[str, Any]:
        """These fields, by name."""
        return {f.name: getattr(self, f.name) for f in dataclasses.fields(EpisodeRecord)}

    @property
    def where(self) -> str:
        """Tile and condition, as readable text."""
        return f"{self.family}, level {self.level}, {self.condition}, episode {self.episode}"

    def tile(self) -> Tile:
        """The tile of the episode."""
        return tile_of(self.seed, self.family, self.level, self.episode, self.condition)

    @property
    def name(self) -> str:
        """Name for the episode's files, unique within an evaluation."""
        where = f"{self.policy}_{self.condition}_{file_label(self.family)}"
        return f"{where}_{self.level:02d}_{self.episode:03d}"

    @property
    def strip(self) -> str:
        """Name of the picture that shows all policies on the tile."""
        suffix = "" if self.condition == "nominal" else f"_{self.condition}"
        return f"strip_{file_label(self.family)}_{self.level}{suffix}.png"


@dataclass(frozen=True, eq=False)
class Episode(EpisodeRecord):
    """A row of episodes.csv, and the path of the robot.

    Attributes:
        time_s: duration in s.
        path_m: length of the trunk's path in m.
        energy_j: mechanical energy in J: ``RobotState.power`` at the end of each control step,
            times the step's length.
        shares: share of the time in each gait of ``GAITS``, as commanded.
        goal: (2,) m in the tile's frame.
        track: (n, 3), x and y in m in the tile's frame and heading in rad, every ``POSE_SECONDS``
            from the start and once more at the end.
    """

    time_s: float
    path_m: float
    energy_j: float
    shares: tuple[float, ...]
    goal: Array
    track: Array

    def row(self) -> dict[str, Any]:
        """Return the row of episodes.csv, with one column per gait share."""
        row = self.identity
        row["time_s"], row["path_m"] = round(self.time_s, 2), round(self.path_m, 3)
        row["energy_j"] = round(self.energy_j, 1)
        return row | {f"share_{g}": round(x, 4) for g, x in zip(GAITS, self.shares, strict=True)}


def benchmarked(config: LowLevelConfig, condition: Condition) -> LowLevelConfig:
    """Return the MDP of the low policy in the benchmark's physics, at its own control rate.

    The physics is the same for every policy, whatever physics that was trained in.
    """
    physics, control_dt = PhysicsConfig(), config.physics.control_dt
    hold = physics.hold
    if condition.physics_hz is None:
        held = hold * physics.dt  # s; a shorter step where it does not divide the control's
        substeps = hold * math.ceil(control_dt / held - 1e-6)
    else:
        # Torque is updated at each physics step, as by a motor driver at that rate.
        substeps, hold = round(control_dt * condition.physics_hz), 1
    physics = dataclasses.replace(physics, control_dt=control_dt, substeps=substeps, hold=hold)
    return dataclasses.replace(config, physics=physics)


def tile_of(seed: int, family: str, level: int, episode: int, condition: str = "nominal") -> Tile:
    """Return the tile of one episode, with its start and goal; it is the same for every policy."""
    rng = tile_rng(seed, family, level, episode, EVAL_STREAM)
    tile = make_tile(family, level / MAX_LEVEL, rng)
    return tile.mirrored() if CONDITIONS[condition].mirrored else tile


# Purposes for which an episode draws random values, each from its own generator. The values only
# have to differ.
_PUSHES, _CLOCK, _SENSORS, _PROBES = 1, 2, 3, 4


def episode_draws(cell: Cell, seed: int, purpose: int) -> EpisodeDraws:
    """Return a cell's draws for a purpose: the same for every policy, in any batch."""
    where = EVAL_STREAM, seed, family_number(cell.family), cell.level
    return EpisodeDraws((*where, cell.first + k, purpose) for k in range(cell.count))


def push_velocities(cell: Cell, seed: int, speed: float, pushes: int) -> Array:
    """Velocity changes of the pushes, (count, pushes, 3) m/s, in random horizontal directions."""
    angle = episode_draws(cell, seed, _PUSHES).uniform(-np.pi, np.pi, (cell.count, pushes))
    return speed * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)


class Watcher(Protocol):
    """Observes a batch while it runs; it must not change anything."""

    def begin(self, batch: "Batch") -> None:
        """Handle the beginning, with the robots of ``batch`` at their starts."""

    def step(self, step: int, live: NDArray[np.intp]) -> None:
        """Handle the end of control step number ``step``, in which the robots ``live`` (n,) took
        part; the batch's ``steps`` and ``outcome`` include it."""


class Batch:
    """The robots of a cell, each on its tile, under the cell's condition; they are run once.

    Args:
        cell: the episodes to run.
        config: the MDP of the low policy.
        seed: seed of the evaluation's tiles.
        make_world: makes a world from the tile field; a Bullet world by default.

    Attributes:
        cell, seed: as given.
        field: M tiles.
        loco: the robots, at their starts.
        goal: (M, 2) m in the world.
        origin: (M, 2) m, origins of the tiles in the world.
        told: family that the semantic cue reports.
        sensors, probes: noise of the low policy's observations and of the height probes; None
            without noise.
        steps: (M,) control steps that each robot has taken.
        outcome: (M,) index into ``OUTCOMES``, -1 for robots whose episodes continue.
    """

    def __init__(
        self,
        cell: Cell,
        config: LowLevelConfig,
        seed: int,
        make_world: Callable[[TileField], World] | None = None,
    ) -> None:
        self.cell, self.seed = cell, seed
        self.steps, self.outcome = np.zeros(cell.count, dtype=int), np.full(cell.count, GOING)
        condition, rows = CONDITIONS[cell.condition], np.arange(cell.count)
        self.field = TileField.of(
            *(
                tile_of(seed, cell.family, cell.level, cell.first + k, cell.condition)
                for k in range(cell.count)
            )
        )
        self.told = cell.family if condition.told else "unknown"
        self.sensors = self.probes = None
        clock = np.zeros(cell.count)
        if condition.noise is not None:
            self.sensors = Noise(condition.noise, episode_draws(cell, seed, _SENSORS))
            self.probes = Noise(condition.noise, episode_draws(cell, seed, _PROBES))
            clock = episode_draws(cell, seed, _CLOCK).uniform(0.0, 1.0, (cell.count,))
        if make_world is None:
            config = benchmarked(config, condition)
            world: World = BulletWorld(cell.count, config.robot, config.physics, self.field)
        else:
            world = make_world(self.field)
        physics, loco = config.physics, Locomotion(world, config)
        self.loco, self.origin = loco, self.field.origin(rows)
        loco.delay[:] = condition.latency
        world.friction[:] = physics.friction if condition.friction is None else condition.friction
        world.payload[:], world.armature[:] = condition.payload, condition.armature
        world.strength[:] = condition.motor
        world.apply_dynamics(rows)
        start, self.goal = self.field.starts, self.field.goals + self.origin
        loco.place(rows, start[:, :2] + self.origin, start[:, 2], clock)
        self._horizon = round(HORIZON / physics.control_dt)
        self._push_every = round(PUSH_INTERVAL / physics.control_dt)
        number = self._horizon // self._push_every + 1
        self._pushes = push_velocities(cell, seed, condition.push_speed, number)

    @property
    def live(self) -> NDArray[np.intp]:
        """Indices of the robots whose episodes continue, (n,)."""
        return np.flatnonzero(self.outcome == GOING)

    def record(self, k: int) -> dict[str, Any]:
        """Robot k's fields of ``EpisodeRecord``, once its episode has ended."""
        names = ("policy", "condition", "family", "level")
        where = {name: getattr(self.cell, name) for name in names}
        ended = {"seed": self.seed, "outcome": OUTCOMES[self.outcome[k]]}
        return where | {"episode": self.cell.first + k} | ended

    def push(self, step: int, live: NDArray[np.intp]) -> None:
        """Push the robots ``live`` (n,) if a push is due before control step number ``step``."""
        number, since = divmod(step, self._push_every)
        if number and not since and self._pushes.any():
            self.loco.world.push(live, self._pushes[live, number - 1])

    def judge(self, step: int) -> None:
        """Count control step number ``step``, and end the episodes that are over after it."""
        live, time_is_up = self.live, step + 1 == self._horizon
        self.steps[live] = step + 1
        self.outcome[live] = outcome(self.loco.world, self.goal, time_is_up)[live]


class EpisodeLog:
    """Logs a batch at every control step and makes an ``Episode`` for each robot."""

    def __init__(self, batch: Batch) -> None:
        m, self._batch = batch.cell.count, batch
        self._dt = batch.loco.physics.control_dt
        self._pose_every = round(POSE_SECONDS / self._dt)
        self._path, self._energy = np.zeros(m), np.zeros(m)
        self._shares = np.zeros((m, len(GAITS)))
        self._poses = [self._pose()]
        self._position = batch.loco.world.state.position[:, :2].copy()

    def add(self, step: int) -> None:
        """Log the state of the robots after control step number ``step``, before it is judged.

        Raises:
            FloatingPointError: a robot's position is not finite. In Bullet, the other robots would
                fall through the ground from now on.
        """
        batch, state, live = self._batch, self._batch.loco.world.state, self._batch.live
        if not np.isfinite(state.position).all():
            raise FloatingPointError(f"{batch.cell}: a robot's position is not finite")
        position = state.position[:, :2].copy()
        self._path[live] += np.linalg.norm(position - self._position, axis=1)[live]
        self._position = position
        self._energy[live] += self._dt * state.power[live]
        self._shares[live, gait_index(batch.loco.command[live])] += 1.0
        if (step + 1) % self._pose_every == 0:
            self._poses.append(self._pose())

    def episodes(self) -> list[Episode]:
        """Return one episode per robot, in order, once all have ended."""
        batch, last = self._batch, self._pose()
        kept = -(-batch.steps // self._pose_every)  # number of poses before the end
        return [
            Episode(
                **batch.record(k),
                time_s=batch.steps[k] * self._dt,
                path_m=self._path[k],
                energy_j=self._energy[k],
                shares=tuple(self._shares[k] / batch.steps[k]),
                goal=batch.field.goals[k],
                track=np.array([*(pose[k] for pose in self._poses[: kept[k]]), last[k]]),
            )
            for k in range(batch.cell.count)
        ]

    def _pose(self) -> Array:
        """Return x, y in m in the tile's frame and heading in rad, (M, 3)."""
        state = self._batch.loco.world.state
        return np.column_stack([state.position[:, :2] - self._batch.origin, state.yaw])


def run_cell(
    cell: Cell, low: Policy, driver: Driver, seed: int, watchers: Sequence[Watcher] = ()
) -> list[Episode]:
    """Run a batch of episodes to their ends.

    Args:
        cell: the episodes to run.
        low: the frozen low policy.
        driver: commands the low policy.
        seed: seed of the evaluation's tiles.
        watchers: observers of the batch.

    Returns:
        One episode per robot, in order.
    """
    batch = Batch(cell, mdp_of(low), seed)
    with contextlib.closing(batch.loco.world):
        return closed_loop(driver, Executor(batch.loco, low, batch.sensors), batch, watchers)


def closed_loop(
    driver: Driver, executor: Carries, batch: Batch, watchers: Sequence[Watcher]
) -> list[Episode]:
    """Run the paper's closed loop (Sec. IV) until every episode of a batch has ended.

    The batch is new; driver and watchers begin first. Returns one episode per robot, in order.
    """
    driver.begin(batch.loco, batch.goal, batch.told, batch.probes)
    for watcher in watchers:
        watcher.begin(batch)
    log = EpisodeLog(batch)
    for step in itertools.count():
        live = batch.live
        if not live.size:
            break
        batch.push(step, live)
        # At each decision: cues -> high policy -> decoder -> commands, held until the next one.
        commands = driver.command(step)
        # At each control step: commands -> low policy -> joint targets -> physics.
        executor.step(commands, live)
        log.add(step)
        batch.judge(step)
        for watcher in watchers:
            watcher.step(step, live)
        batch.loco.world.retire(np.setdiff1d(live, batch.live))
    return log.episodes()


# ---------------------------------------------------------------------------- the whole table


def plan(
    policies: Sequence[str],
    conditions: Sequence[str],
    families: Sequence[str],
    levels: Sequence[int],
    episodes: int,
) -> list[Cell]:
    """List all batches of an evaluation, in the order of the table."""
    cells = []
    for policy in policies:
        for name in conditions:
            condition = CONDITIONS[name]
            count = max(1, round(condition.episodes_share * episodes))
            for family in condition.families or families:
                for level in condition.levels or levels:
                    for first in range(0, count, BATCH):
                        size = min(BATCH, count - first)
                        cells.append(Cell(policy, name, family, level, first, size))
    return cells


def complete(episodes: Sequence[Episode], cells: Sequence[Cell]) -> list[Episode]:
    """Keep the episodes whose combination of policy, condition, family and level is complete.

    Args:
        episodes: the episodes run so far.
        cells: all batches of the evaluation.
    """

    def where(of: Episode | Cell) -> tuple[str, str, str, int]:
        return of.policy, of.condition, of.family, of.level

    planned = Counter[tuple[str, str, str, int]]()
    for cell in cells:
        planned[where(cell)] += cell.count
    ended = Counter(map(where, episodes))
    return [e for e in episodes if ended[where(e)] == planned[where(e)]]
