"""Throughput of collecting: control steps a second, Bullet's share of it, memory a robot.

    python -m tdgc.bench --out runs/bench

Robots take random actions in the low level's MDP, on a plane and on level 5 of all families, with
one worker and with all. Writes ``bench.json`` and prints a table.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import os
import sys
import time
from pathlib import Path

import numpy as np

from tdgc.config import LowLevelConfig
from tdgc.low_env import LowLevelTask
from tdgc.vec import TaskVecEnv

_SETTLE_STEPS = 20  # not timed: robots drop onto their feet


def make_task(config: LowLevelConfig, robots: int, seed: int) -> LowLevelTask:
    """A task whose robots spread over the levels, as a training's do."""
    task = LowLevelTask(config, robots, seed)
    task.level = np.arange(robots) % config.levels
    return task


def memory_mb(pids: list[int]) -> float:
    """Memory of processes in MB, shared pages counted once (proportional set size)."""
    total = 0.0
    for pid in pids:
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                total += int(line.split()[1]) / 1024.0
    return total


def measure(config: LowLevelConfig, robots: int, workers: int, seconds: float) -> dict[str, float]:
    """Collect for about ``seconds``: steps_per_s, bullet_share, mb_per_robot, mb_total.

    ``bullet_share`` is the time the workers spent inside Bullet's step over the time they spent
    collecting, waiting for actions included.
    """
    probe = LowLevelTask(dataclasses.replace(config, terrain="plane"), 1, seed=0)
    spaces = probe.observation_space, probe.action_space
    probe.close()
    env = TaskVecEnv(functools.partial(make_task, config), robots, workers, 0, spaces)
    try:
        env.reset()
        rng = np.random.default_rng(0)
        actions = rng.normal(0.0, 1.0, (64, robots, spaces[1].shape[0])).astype(np.float32)
        for k in range(_SETTLE_STEPS):
            env.step(actions[k])
        before = sum(s["bullet_seconds"] for s in env.stats())
        started, steps = time.perf_counter(), 0
        while time.perf_counter() - started < seconds:
            env.step(actions[steps % 64])
            steps += 1
        elapsed = time.perf_counter() - started
        inside = sum(s["bullet_seconds"] for s in env.stats()) - before
        megabytes = memory_mb([os.getpid(), *env.worker_pids])
    finally:
        env.close()
    return {
        "steps_per_s": steps * robots / elapsed,
        "bullet_share": inside / (elapsed * workers),
        "mb_per_robot": megabytes / robots,
        "mb_total": megabytes,
    }


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--robots", type=int, default=100)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seconds", type=float, default=10.0, help="a measurement (10)")
    parser.add_argument("--out", type=Path, default=Path("runs/bench"))
    args = parser.parse_args(arguments)
    if not 1 <= args.workers <= args.robots:
        print("tdgc.bench: --workers must be 1 to the number of robots", file=sys.stderr)
        return 2
    families = ("rough", "pillar", "stair", "gap", "tilt")
    result: dict[str, dict[str, dict[str, float]]] = {}
    print("ground   workers   steps/s   in Bullet   MB/robot   MB")
    for ground in ("plane", "terrain"):
        config = LowLevelConfig(
            terrain="plane" if ground == "plane" else "tiles", families=families
        )
        for name, workers in (("1", 1), ("all", args.workers)):
            row = measure(config, args.robots, workers, args.seconds)
            result.setdefault(ground, {})[name] = row
            print(
                f"{ground:<8}{workers:>8}{row['steps_per_s']:>10.0f}"
                f"{100 * row['bullet_share']:>10.0f} %{row['mb_per_robot']:>10.1f}"
                f"{row['mb_total']:>7.0f}",
                flush=True,
            )
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "bench.json").write_text(json.dumps(result, indent=2), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
