"""Cores that a process may use, within control group quotas, and the workers for them."""

import argparse
import os
from pathlib import Path

import pytest

from tdgc.parallel.cores import auto_workers, usable_cores, workers_flag


@pytest.mark.parametrize(
    ("robots", "cores", "workers"),
    [(120, 2, 2), (120, 64, 12), (100, 8, 8), (19, 8, 1), (20, 8, 2), (4, 8, 1), (1, 1, 1)],
)
def test_auto_workers(robots: int, cores: int, workers: int) -> None:
    assert auto_workers(robots, cores) == workers


def test_workers_flag() -> None:
    assert workers_flag("auto") == "auto" and workers_flag("12") == 12
    with pytest.raises(argparse.ArgumentTypeError, match=r"^'all' is neither a number nor auto$"):
        workers_flag("all")


#: Name -> files (path -> content), and how many cores of 16 the process may use.
SYSTEMS: dict[str, tuple[dict[str, str], int]] = {
    "no control groups": ({}, 16),
    "version 2, no quota": (
        {"proc/self/cgroup": "0::/job\n", "sys/fs/cgroup/job/cpu.max": "max 100000\n"},
        16,
    ),
    "version 2, its own quota": (
        {"proc/self/cgroup": "0::/job\n", "sys/fs/cgroup/job/cpu.max": "450000 100000\n"},
        4,
    ),
    "version 2, the quota of a group above": (
        {
            "proc/self/cgroup": "0::/user/job\n",
            "sys/fs/cgroup/user/job/cpu.max": "max 100000\n",
            "sys/fs/cgroup/user/cpu.max": "300000 100000\n",
        },
        3,
    ),
    "version 2, a container that sees itself as the root": (
        {"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": "50000 100000\n"},
        1,
    ),
    "version 1": (
        {
            "proc/self/cgroup": "5:memory:/job\n4:cpu,cpuacct:/job\n0::/\n",
            "sys/fs/cgroup/cpu/job/cpu.cfs_quota_us": "200000\n",
            "sys/fs/cgroup/cpu/job/cpu.cfs_period_us": "100000\n",
            "sys/fs/cgroup/cpu/cpu.cfs_quota_us": "-1\n",
            "sys/fs/cgroup/cpu/cpu.cfs_period_us": "100000\n",
        },
        2,
    ),
    "version 1, a group that is not seen": ({"proc/self/cgroup": "4:cpu,cpuacct:/away\n"}, 16),
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_usable_cores(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)), raising=False)
    files, cores = SYSTEMS[name]
    for path, text in files.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text, encoding="utf-8")
    assert usable_cores(tmp_path) == cores


def test_cores_that_the_process_is_bound_to(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3}, raising=False)
    assert usable_cores() == 1
