"""Evaluation (TDGC-Bench): episodes on fixed tiles -> rows -> rates with Wilson intervals.

Episodes run in batches, each in a world of its own that holds one tile a robot. A batch depends on
its policy, condition and tiles alone, not on how many processes share the batches, so neither does
the table.
"""

from __future__ import annotations

import csv
import dataclasses
import functools
import json
import multiprocessing as mp
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from tdgc.benchmark.drivers import Driver
from tdgc.config import CommandRanges, LowLevelConfig, PhysicsConfig, recorded
from tdgc.parallel.worker import keep_memory, one_blas_thread
from tdgc.policies import Policy
from tdgc.sim.commands import CONTINUOUS, INDEX, gait_index
from tdgc.sim.gaits import GAITS, gait_embedding
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import NUM_JOINTS, Array, RobotState
from tdgc.sim.terrain import (
    EVAL_STREAM,
    MAX_LEVEL,
    Tile,
    TileField,
    family_number,
    file_label,
    make_tile,
    tile_rng,
)
from tdgc.tasks.low_env import FALL_HEIGHT, GOAL_RADIUS, TRUNK_FORCE, is_fallen
from tdgc.tasks.rewards import CONTACT_FORCE

HORIZON = 20.0  # s (benchmark)
OUTCOMES = ("reached", "fell", "collided", "left_tile", "timeout")
BATCH = 50  # episodes a world: enough to keep numpy busy, few enough to share out evenly
POSE_SECONDS = 0.2  # between two poses of a track: 20 cm of walking at most


@dataclass(frozen=True)
class Condition:
    """One evaluation condition (benchmark); everything is nominal unless it says otherwise.

    Attributes:
        levels, families: where the condition is run; None for those asked for.
        episodes_share: of the episodes asked for, a cell (100 nominal, 20 for the others).
    """

    levels: tuple[int, ...] | None = None
    families: tuple[str, ...] | None = None
    friction: float | None = None
    payload: float = 0.0  # kg
    push_speed: float = 0.0  # m/s, every 3 s
    motor: float = 1.0  # times torque limits and gains
    latency: float = 0.0  # s
    physics_hz: int | None = None
    episodes_share: float = 0.2


#: The conditions of the benchmark by name.
CONDITIONS: dict[str, Condition] = {
    "nominal": Condition(episodes_share=1.0),
    "levels-11-12": Condition(levels=(11, 12)),
    "mixed": Condition(families=("mixed",)),
    "friction-0.4": Condition(friction=0.4),
    "payload-3kg": Condition(payload=3.0),
    "pushes": Condition(push_speed=0.75),
    "motor-0.85": Condition(motor=0.85),
    "latency-30ms": Condition(latency=0.03),
    "physics-1000hz": Condition(physics_hz=1000),
}
PUSH_INTERVAL = 3.0  # s (benchmark's `pushes`)


@dataclass(frozen=True)
class Cell:
    """A batch of episodes: numbers ``first`` to ``first + count`` of one family and level."""

    policy: str
    condition: str
    family: str
    level: int
    first: int
    count: int


@dataclass(frozen=True, eq=False)
class EpisodeRecord:
    """What every record of an episode begins with: which one it was, and one of ``OUTCOMES``."""

    policy: str
    condition: str
    family: str
    level: int
    episode: int
    seed: int
    outcome: str

    @property
    def name(self) -> str:
        """A name for the episode's files, a different one for each of an evaluation."""
        where = f"{self.policy}_{self.condition}_{file_label(self.family)}"
        return f"{where}_{self.level:02d}_{self.episode:03d}"


@dataclass(frozen=True, eq=False)
class Episode(EpisodeRecord):
    """A row of episodes.csv, and where the robot went.

    Attributes:
        energy_j: J, mechanical: ``joint_power`` at the end of each control step, times its length.
        shares: of its time in each gait of ``GAITS``, as commanded.
        goal: (2,) m, in the tile's frame.
        track: (n, 3) x, y in m in the tile's frame and heading in rad, every ``POSE_SECONDS`` from
            the start and once more at the end.
    """

    time_s: float
    path_m: float
    energy_j: float
    shares: tuple[float, ...]
    goal: Array
    track: Array

    def row(self) -> dict[str, Any]:
        """The row, with one column a gait share."""
        beside = ("shares", "goal", "track")
        names = [f.name for f in dataclasses.fields(self) if f.name not in beside]
        row = {name: getattr(self, name) for name in names}
        row["time_s"], row["path_m"] = round(self.time_s, 2), round(self.path_m, 3)
        row["energy_j"] = round(self.energy_j, 1)
        return row | {f"share_{g}": round(x, 4) for g, x in zip(GAITS, self.shares, strict=True)}


def low_config(low: Policy) -> LowLevelConfig:
    """The MDP that a low-level policy was trained on, from its own file.

    Raises:
        ValueError: the file holds none, or one that does not fit the policy.
    """
    if "config" not in low.meta:
        raise ValueError("the low-level policy's file has no configuration")
    return recorded(LowLevelConfig, low.meta["config"], "the low level's configuration")


def physics_of(config: LowLevelConfig, condition: Condition) -> PhysicsConfig:
    """The condition's physics: its rate, at the low level's control rate."""
    physics = config.physics
    if condition.physics_hz is not None:
        substeps = round(physics.control_dt * condition.physics_hz)
        # One torque per physics step, as a motor driver at that rate has it.
        physics = dataclasses.replace(physics, substeps=substeps, hold=1)
    return physics


def push_velocities(cell: Cell, seed: int, speed: float, pushes: int) -> Array:
    """Push k of each episode, (count, pushes, 3) m/s: the same for every policy."""
    family = family_number(cell.family)
    result = np.zeros((cell.count, pushes, 3))
    for k in range(cell.count):
        entropy = (EVAL_STREAM, seed, family, cell.level, cell.first + k, 1)
        angle = np.random.default_rng(entropy).uniform(-np.pi, np.pi, pushes)
        result[k, :, 0], result[k, :, 1] = speed * np.cos(angle), speed * np.sin(angle)
    return result


def tile_of(seed: int, family: str, level: int, episode: int) -> Tile:
    """The tile of one episode, with its start and goal: the same for every policy."""
    rng = tile_rng(seed, family, level, episode, EVAL_STREAM)
    return make_tile(family, level / MAX_LEVEL, rng)


def joint_power(state: RobotState) -> Array:
    """Mechanical power that the joints give or take, (M,) W: no motor wins back what it brakes."""
    return np.asarray(np.abs(state.torque * state.qd).sum(axis=1))


class Watcher(Protocol):
    """Looks on while a batch runs; it must change nothing."""

    def begin(self, cell: Cell, loco: Locomotion, field: TileField, goal: Array) -> None:
        """The robots stand at their starts; ``goal`` (M, 2) m in the world."""

    def step(self, step: int, live: NDArray[np.intp], outcome: NDArray[np.int64]) -> None:
        """After control step number ``step`` of the robots ``live`` (n,); ``outcome`` (M,) indexes
        ``OUTCOMES`` and is -1 for those that go on."""


def run_cell(
    cell: Cell,
    low: Policy,
    driver: Driver,
    seed: int,
    watcher: Watcher | None = None,
    visual: bool = False,
) -> list[Episode]:
    """Run a batch of episodes to their ends.

    Args:
        cell: which episodes.
        low: the frozen low level.
        driver: what commands it.
        seed: of the evaluation's tiles.
        watcher: who looks on.
        visual: keep what pictures of the ground need.

    Returns:
        An episode each, in order.
    """
    config, condition = low_config(low), CONDITIONS[cell.condition]
    m = cell.count
    rows = np.arange(m)
    field = TileField((m, 1))
    for k in range(m):
        field.place(k, 0, tile_of(seed, cell.family, cell.level, cell.first + k))
    field.heights.setflags(write=False)  # for a faster world
    loco = Locomotion(m, config.robot, physics_of(config, condition), field, config.gyro, visual)
    world = loco.world
    origin = field.origin(rows, 0)
    start, goal = field.starts[:, 0], field.goals[:, 0] + origin
    friction = condition.friction if condition.friction is not None else config.physics.friction
    loco.friction[:], loco.payload[:] = friction, condition.payload
    world.strength[:] = condition.motor
    loco.delay[:] = condition.latency
    loco.apply_dynamics(rows)
    loco.place(rows, start[:, :2] + origin, start[:, 2], np.zeros(m))
    driver.begin(loco, goal, cell.family)
    if watcher is not None:
        watcher.begin(cell, loco, field, goal)

    dt = config.physics.control_dt
    horizon = round(HORIZON / dt)
    push_every, pose_every = round(PUSH_INTERVAL / dt), round(POSE_SECONDS / dt)
    pushes = push_velocities(cell, seed, condition.push_speed, horizon // push_every + 1)
    outcome = np.full(m, -1)
    steps = np.zeros(m, dtype=int)
    path = np.zeros(m)
    energy = np.zeros(m)
    shares = np.zeros((m, len(GAITS)))
    actions = np.zeros((m, NUM_JOINTS))
    poses: list[Array] = []

    def pose() -> Array:
        state = world.state
        return np.column_stack([state.position[:, :2] - origin, state.yaw])

    try:
        for step in range(horizon):
            live = np.flatnonzero(outcome < 0)
            if condition.push_speed > 0.0 and step > 0 and step % push_every == 0:
                world.push(live, pushes[live, step // push_every - 1])
            if step % pose_every == 0:
                poses.append(pose())
            before = world.state.position[:, :2].copy()
            loco.command[:] = driver.command(step)
            actions[live], _ = low.predict(loco.observe()[live])
            loco.act(actions)
            if not np.isfinite(world.state.position).all():
                # Its fellows in Bullet would fall through the ground from now on.
                raise FloatingPointError(f"{cell}: a robot's position is not finite")
            path[live] += np.linalg.norm(world.state.position[live, :2] - before[live], axis=1)
            energy[live] += dt * joint_power(world.state)[live]
            shares[live, gait_index(loco.command[live])] += 1.0
            steps[live] = step + 1
            ended = classify(loco, goal, field)
            ended[ended < 0] = -1 if step + 1 < horizon else OUTCOMES.index("timeout")
            done = live[ended[live] >= 0]
            outcome[done] = ended[done]
            if watcher is not None:
                watcher.step(step, live, outcome)
            if done.size:
                world.retire(done)  # whose rows of the state stay as they are
            if (outcome >= 0).all():
                break
    finally:
        world.close()
    poses.append(pose())
    kept = -(-steps // pose_every)  # poses taken while it was up
    return [
        Episode(
            cell.policy,
            cell.condition,
            cell.family,
            cell.level,
            cell.first + k,
            seed,
            OUTCOMES[outcome[k]],
            steps[k] * dt,
            path[k],
            energy[k],
            tuple(shares[k] / steps[k]),
            field.goals[k, 0],
            np.array([p[k] for p in (*poses[: kept[k]], poses[-1])]),
        )
        for k in range(m)
    ]


def classify(loco: Locomotion, goal: Array, field: TileField) -> NDArray[np.int64]:
    """Index into OUTCOMES of each robot's present end, -1 for none, (M,).

    Failure goes before success: a robot that falls into the goal has fallen.
    """
    state, world = loco.world.state, loco.world
    x, y = state.position[:, 0], state.position[:, 1]
    outcome = np.full(loco.num_robots, -1)
    reached = np.linalg.norm(state.position[:, :2] - goal, axis=1) < GOAL_RADIUS
    outcome[reached] = OUTCOMES.index("reached")
    inside = field.on_tile(np.arange(loco.num_robots), 0, x, y)
    outcome[~inside] = OUTCOMES.index("left_tile")
    outcome[state.trunk_force > TRUNK_FORCE] = OUTCOMES.index("collided")
    fallen = state.position[:, 2] - world.support_height(x, y) < FALL_HEIGHT
    outcome[fallen] = OUTCOMES.index("fell")
    return outcome


# ---------------------------------------------------------------------------- the whole table


def plan(
    policies: Sequence[str],
    conditions: Sequence[str],
    families: Sequence[str],
    levels: Sequence[int],
    episodes: int,
) -> list[Cell]:
    """All batches of an evaluation, in the order of the table."""
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


Job = TypeVar("Job")
Result = TypeVar("Result")


def spread(work: Callable[[Job], Result], jobs: Sequence[Job], workers: int) -> Iterator[Result]:
    """``work`` on each job, in order, on ``workers`` processes at most."""
    processes = min(workers, len(jobs))
    spawn = mp.get_context("spawn")
    with one_blas_thread(), spawn.Pool(processes, initializer=keep_memory) as pool:
        yield from pool.imap(work, jobs)


class Spread(Protocol):
    """``spread``, or what does the same elsewhere."""

    def __call__(
        self, work: Callable[[Job], Result], jobs: Sequence[Job], workers: int
    ) -> Iterator[Result]: ...


def wilson_interval(reached: int, n: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson score interval of a rate, 95 % by default (Wilson 1927)."""
    if not 0 <= reached <= n or n < 1:
        raise ValueError(f"need 0 <= reached <= n and n >= 1, not {reached} of {n}")
    rate = reached / n
    centre = (rate + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * np.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    return max(0.0, float(centre - half)), min(1.0, float(centre + half))


def success(rows: Sequence[Episode]) -> dict[str, float]:
    """How many episodes reached the goal: n, reached, rate, and its interval ci_low, ci_high."""
    n, reached = len(rows), sum(e.outcome == "reached" for e in rows)
    low, high = wilson_interval(reached, n)
    return {"n": n, "reached": reached, "rate": reached / n, "ci_low": low, "ci_high": high}


def summarise(episodes: Iterable[Episode]) -> dict[str, Any]:
    """summary.json: policy -> condition -> family -> level -> rates, and means.

    Beside the levels of a family stands ``"mean"`` over them, beside the families ``"mean"`` over
    all; cells are equally large, so these are means over cells too.
    """
    tree: dict[str, Any] = {}
    for e in episodes:
        families = tree.setdefault(e.policy, {}).setdefault(e.condition, {})
        families.setdefault(e.family, {}).setdefault(str(e.level), []).append(e)
    for conditions in tree.values():
        for families in conditions.values():
            everything: list[Episode] = []
            for levels in families.values():
                rows = [e for level in levels.values() for e in level]
                everything += rows
                for level, some in levels.items():
                    levels[level] = success(some)
                levels["mean"] = success(rows)
            families["mean"] = success(everything)
    return tree


def write_results(folder: Path, episodes: Sequence[Episode]) -> dict[str, Any]:
    """Write episodes.csv, summary.json and trajectories.npz into ``folder``; returns the summary.

    trajectories.npz holds the tracks in the order of episodes.csv: ``poses`` (N, 3), those of all
    episodes one after another, ``counts`` (E,), how many are each one's, and ``goals`` (E, 2).
    """
    with open(folder / "episodes.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(episodes[0].row()))
        writer.writeheader()
        writer.writerows(e.row() for e in episodes)
    np.savez_compressed(
        folder / "trajectories.npz",
        poses=np.concatenate([e.track for e in episodes]).astype(np.float32),
        counts=np.array([len(e.track) for e in episodes], dtype=np.int32),
        goals=np.array([e.goal for e in episodes], dtype=np.float32),
    )
    summary = summarise(episodes)
    (folder / "summary.json").write_text(json.dumps(summary, indent=2), encoding="utf-8")
    return summary


# ---------------------------------------------------------------------------- tracking

_TRACKING_SECONDS = 10.0  # an episode: one command
_SETTLE_SECONDS = 1.0  # not counted: speeding up from rest
_SWITCH_SECONDS = 2.0  # between gaits in the falls test
_FALL_SHARE, _FALL_SECONDS = 0.6, 20.0  # of the episodes: 100 a gait make 20 minutes of walking


def draw_commands(
    rng: np.random.Generator, ranges: CommandRanges, gait: NDArray[np.integer]
) -> Array:
    """Commands of robots in these gaits (n,), the others over the full ranges, (n, 15)."""
    bounds = np.array([getattr(ranges, name) for name in CONTINUOUS])
    continuous = rng.uniform(bounds[:, 0], bounds[:, 1], (len(gait), len(CONTINUOUS)))
    return np.concatenate([continuous, gait_embedding(gait)], axis=1)


def walk_on_plane(low: Policy, m: int, seconds: float, seed: int) -> Iterator[Locomotion]:
    """``m`` nominal robots that start from rest.

    Yields before each control step, so that the caller may set commands and look.
    """
    config = low_config(low)
    loco = Locomotion(m, config.robot, config.physics, None, config.gyro)
    rows = np.arange(m)
    rng = np.random.default_rng(seed)
    spots = 5.0 * np.stack([rows % 10, rows // 10], axis=1).astype(np.float64)
    loco.place(rows, spots, rng.uniform(-np.pi, np.pi, m), rng.uniform(size=m))
    try:
        for _ in range(round(seconds / config.physics.control_dt)):
            yield loco
            actions, _ = low.predict(loco.observe())
            loco.act(actions)
    finally:
        loco.world.close()


def track_gait(low: Policy, gait: str, episodes: int, seed: int) -> dict[str, float]:
    """Tracking of one gait on the plane, commands over the full ranges.

    RMSE of the instantaneous planar velocity (heading frame) and yaw rate at every control step
    after the first second, and the share of foot samples whose contact is the desired one.
    """
    config, g = low_config(low), GAITS.index(gait)
    rng = np.random.default_rng((EVAL_STREAM, seed, g))
    command = draw_commands(rng, config.commands, np.full(episodes, g))
    settle = round(_SETTLE_SECONDS / config.physics.control_dt)
    lin = yaw = match = count = 0.0
    for step, loco in enumerate(walk_on_plane(low, episodes, _TRACKING_SECONDS, seed)):
        state = loco.world.state
        if step > settle:
            lin += float(np.sum((state.heading_vel[:, :2] - command[:, :2]) ** 2))
            yaw += float(np.sum((state.ang_vel[:, 2] - command[:, INDEX["yaw_rate"]]) ** 2))
            wanted = loco.clock.contact > 0.5
            match += float(np.mean((state.foot_force > CONTACT_FORCE) == wanted)) * episodes
            count += episodes
        loco.command[:] = command
    return {
        "velocity_rmse": (lin / count) ** 0.5,
        "yaw_rate_rmse": (yaw / count) ** 0.5,
        "contact_match": match / count,
    }


def count_falls(low: Policy, robots: int, seed: int) -> dict[str, float]:
    """Falls while the gait switches at random every 2 s, commands over the full ranges.

    A robot that falls stays out, and its time counts up to the fall.
    """
    config = low_config(low)
    m, dt = robots, config.physics.control_dt
    rng = np.random.default_rng((EVAL_STREAM, seed, len(GAITS)))
    switch = round(_SWITCH_SECONDS / dt)
    command = draw_commands(rng, config.commands, np.zeros(m, dtype=np.int64))
    up = np.ones(m, dtype=bool)
    minutes = 0.0
    for step, loco in enumerate(walk_on_plane(low, m, _FALL_SECONDS, seed)):
        up &= ~is_fallen(loco.world)
        minutes += up.sum() * dt / 60.0
        if step % switch == 0:
            command[:, 12:] = gait_embedding(rng.integers(0, len(GAITS), m))
        loco.command[:] = command
    falls = int((~up).sum())
    return {"falls": falls, "minutes": minutes, "falls_per_10_min": 10.0 * falls / minutes}


def _track(job: tuple[str, int, int], low: Policy) -> dict[str, float]:
    gait, episodes, seed = job
    return track_gait(low, gait, episodes, seed) if gait else count_falls(low, episodes, seed)


def tracking(
    low: Policy, episodes: int, seed: int, workers: int, share_out: Spread = spread
) -> dict[str, Any]:
    """tracking.json: each gait's tracking and the falls; ``share_out`` is a kind of ``spread``."""
    robots = max(1, round(_FALL_SHARE * episodes))
    jobs = [(gait, episodes, seed) for gait in GAITS] + [("", robots, seed)]
    results = list(share_out(functools.partial(_track, low=low), jobs, workers))
    falls = results.pop()
    return {"gaits": dict(zip(GAITS, results, strict=True)), **falls}
