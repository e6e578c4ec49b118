"""How many cores this process may use, and how many workers that makes.

The learner waits while its workers collect and they wait while it learns, so there are as many
workers as cores. A step of a worker has fixed costs in numpy, which few robots do not pay for.
"""

import argparse
import math
import os
from pathlib import Path
from typing import Literal

#: A step costs a worker about 2 ms beside what each robot takes, 0.7 ms: with ten a fifth of it.
MIN_ROBOTS = 10

Workers = int | Literal["auto"]


def workers_flag(text: str) -> Workers:
    """The value of ``--workers``: a number or auto.

    Raises:
        argparse.ArgumentTypeError: neither.
    """
    if text == "auto":
        return "auto"
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is neither a number nor auto") from None


def auto_workers(robots: int, cores: int) -> int:
    """A worker a core, but none with fewer than ``MIN_ROBOTS`` robots unless it is alone."""
    return max(1, min(cores, robots // MIN_ROBOTS))


def usable_cores(system: Path = Path("/")) -> int:
    """Cores that this process may use: those it is bound to, within its control groups' quotas.

    Args:
        system: where ``proc`` and ``sys`` are.
    """
    bound = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return max(1, math.floor(min(bound or 1, _quota(system))))


def _quota(system: Path) -> float:
    """The least number of cores' worth of time that a control group of this process is given.

    A container's engine or a batch system sets it, on the process's group or one above.
    """
    try:
        lines = (system / "proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:  # no Linux
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
    """Quota over period of one group, both in us; infinite where it has none or is not seen."""
    try:
        words = " ".join((folder / name).read_text(encoding="utf-8") for name in files).split()
        quota, period = (float(word) for word in words)
    except (OSError, ValueError):  # "max" is no number
        return math.inf
    return quota / period if quota > 0 else math.inf  # version 1 has -1 for none
