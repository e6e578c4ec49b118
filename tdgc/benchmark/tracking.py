"""The low policy alone on a plane: command tracking in each gait, and how often it falls."""

import operator
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tdgc.benchmark.evaluation import CONDITIONS, benchmarked
from tdgc.config import CommandRanges
from tdgc.parallel.jobs import RunJobs, run_jobs
from tdgc.policies import Policy
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.commands import CONTINUOUS, INDEX, command_bounds
from tdgc.sim.gaits import GAITS, gait_embedding
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array
from tdgc.sim.terrain import EVAL_STREAM
from tdgc.tasks.executor import Executor
from tdgc.tasks.pairing import mdp_of
from tdgc.tasks.rules import is_fallen

# Chosen by hand; tables of different durations would not be comparable.
_TRACKING_SECONDS = 10.0  # length of a tracking episode, which has one command
_SETTLE_SECONDS = 1.0  # not scored, because robots accelerate from rest
_SWITCH_SECONDS = 2.0  # between gait changes in the fall test
# Robots in the fall test as a share of the episodes per gait, and how long each walks: with 100
# episodes, 20 minutes of walking.
_FALL_SHARE, _FALL_SECONDS = 0.6, 20.0


def draw_commands(
    rng: np.random.Generator, ranges: CommandRanges, gait: NDArray[np.integer]
) -> Array:
    """Draw commands (n, 15) with the given gaits (n,), the rest uniform over ``ranges``."""
    bounds = command_bounds(ranges)
    continuous = rng.uniform(bounds[:, 0], bounds[:, 1], (len(gait), len(CONTINUOUS)))
    return np.concatenate([continuous, gait_embedding(gait)], axis=1)


def walk_on_plane(low: Policy, m: int, seconds: float, seed: int) -> Iterator[Locomotion]:
    """Walk ``m`` nominal robots from rest for ``seconds``.

    Yields before each control step, so that the caller can set commands and inspect the state.

    Raises:
        FloatingPointError: a robot's state is not finite.
    """
    config = benchmarked(mdp_of(low), CONDITIONS["nominal"])
    loco = Locomotion(BulletWorld(m, config.robot, config.physics), config)
    executor, rows = Executor(loco, low), np.arange(m)
    rng = np.random.default_rng(seed)
    spots = 5.0 * np.stack([rows % 10, rows // 10], axis=1).astype(np.float64)
    loco.place(rows, spots, rng.uniform(-np.pi, np.pi, m), rng.uniform(size=m))
    with closing(loco.world):
        for _ in range(round(seconds / config.physics.control_dt)):
            yield loco
            executor.step(loco.command)
            if not np.isfinite(loco.world.state.position).all():
                raise FloatingPointError("a robot's state is not finite: the simulation diverged")


def track_gait(low: Policy, gait: str, episodes: int, seed: int) -> dict[str, float]:
    """Measure tracking in one gait on the plane, with commands over the full ranges.

    Returns the RMSE of the instantaneous planar velocity (heading frame) and of the yaw rate at
    every control step after the first second but the last, and the share of foot samples in which
    contact is as desired.
    """
    config, g = mdp_of(low), GAITS.index(gait)
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
            match += float(np.mean(state.touching == wanted)) * episodes
            count += episodes
        loco.command[:] = command
    return {
        "velocity_rmse": (lin / count) ** 0.5,
        "yaw_rate_rmse": (yaw / count) ** 0.5,
        "contact_match": match / count,
    }


def count_falls(low: Policy, robots: int, seed: int) -> dict[str, float]:
    """Count falls while the gait changes at random every 2 s, with commands over the full ranges.

    A fallen robot is not restarted; its time counts up to the fall.
    """
    config = mdp_of(low)
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


def tracking(
    low: Policy, episodes: int, seed: int, workers: int, run: RunJobs = run_jobs
) -> dict[str, Any]:
    """Contents of tracking.json: tracking in each gait, and falls; ``run`` executes the jobs."""
    robots = max(1, round(_FALL_SHARE * episodes))
    jobs = [partial(track_gait, low, gait, episodes, seed) for gait in GAITS]
    jobs.append(partial(count_falls, low, robots, seed))
    *gaits, falls = run(operator.call, jobs, workers)
    return {"gaits": dict(zip(GAITS, gaits, strict=True)), **falls}
