"""How many cores this process may use, and how many workers to start on them.

The learner waits while its workers collect, and they wait while it learns, so there can be as many
workers as cores. Each worker step has a fixed cost in numpy, too much for only a few robots.
"""

import argparse
import math
import os
from pathlib import Path
from typing import Literal

#: A worker's step takes about 2 ms plus 0.7 ms per robot: with ten, the 2 ms are about a fifth.
MIN_ROBOTS = 10

Workers = int | Literal["auto"]


def workers_flag(text: str) -> Workers:
    """Parse the value of ``--workers``: a number or ``auto``.

    Raises:
        argparse.ArgumentTypeError: it is neither.
    """
    if text == "auto":
        return "auto"
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is neither a number nor auto") from None


def auto_workers(robots: int, cores: int) -> int:
    """One worker per core, each with at least ``MIN_ROBOTS`` robots unless it is the only one."""
    return max(1, min(cores, robots // MIN_ROBOTS))


def usable_cores(system: Path = Path("/")) -> int:
    """Number of cores this process may use: its CPU affinity, limited by control group quotas.

    Args:
        system: folder that contains ``proc`` and ``sys``.
    """
    bound = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return max(1, math.floor(min(bound or 1, _quota(system))))


def _quota(system: Path) -> float:
    """The smallest CPU quota among the control groups of this process, in cores.

    A container engine or a batch system sets it, on the process's own group or on a parent.
    """
    try:
        lines = (system / "proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:  # not Linux
        return math.inf
    least = math.inf
    files: tuple[str, ...]
    for line in lines:  # hierarchy:controllers:path
        _, controllers, path = line.split(":", 2)
        if controllers == "":  # version 2
            root, files = system / "sys/fs/cgroup", ("cpu.max",)
        elif "cpu" in controllers.split(","):  # version 1
            root, files = system / "sys/fs/cgroup/cpu", ("cpu.cfs_quota_us", "cpu.cfs_period_us")
        else:
            continue
        group = root / path.strip("/")
        for folder in (group, *group.parents):
            least = min(least, _read_quota(folder, files))
            if folder == root:
                break
    return least


def _read_quota(folder: Path, files: tuple[str, ...]) -> float:
    """Quota over period of one group, both in us; infinite if it has no quota or is not visible."""
    try:
        words = " ".join((folder / name).read_text(encoding="utf-8") for name in files).split()
        quota, period = (float(word) for word in words)
    except (OSError, ValueError):  # "max" is not a number
        return math.inf
    return quota / period if quota > 0 else math.inf  # version 1 writes -1 for no quota
