"""Jobs shared among processes: results come in order, and a process that dies is reported."""

import functools
import multiprocessing as mp
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tdgc.errors import WorkerError
from tdgc.parallel.jobs import run_jobs


def reciprocal(number: float, last: Path) -> float:
    """1 / ``number``; that of 1 waits until that of 8 has begun, which makes the file ``last``."""
    if number == 8.0:
        last.touch()
    give_up = time.monotonic() + 60.0
    while number == 1.0 and not last.exists():
        if time.monotonic() > give_up:
            raise TimeoutError("the last job does not begin while the first is running")
        time.sleep(0.01)
    return 1.0 / number


def die(number: int) -> int:
    if number == 2:
        os._exit(9)  # as when the kernel kills a process that takes too much memory
    return number


def sleep(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


def test_results_come_in_the_order_of_the_jobs(tmp_path: Path) -> None:
    """Though the first job is still running when the last one begins."""
    job = functools.partial(reciprocal, last=tmp_path / "last")
    assert list(run_jobs(job, [1.0, 2.0, 4.0, 8.0], 2)) == [1.0, 0.5, 0.25, 0.125]


def test_what_a_job_raises_is_raised(tmp_path: Path) -> None:
    job = functools.partial(reciprocal, last=tmp_path / "last")
    with pytest.raises(ZeroDivisionError):
        list(run_jobs(job, [2.0, 0.0], 1))


def test_a_process_that_dies_is_told() -> None:
    with pytest.raises(WorkerError, match=r"^a process died, perhaps out of memory$"):
        list(run_jobs(die, range(4), 2))


def die_or_answer_late(number: int) -> bytes:
    if number == 0:
        os._exit(9)
    time.sleep(0.5)
    return bytes(10**6)  # more than a pipe holds


def test_the_others_are_not_waited_for_when_a_process_dies() -> None:
    with pytest.raises(WorkerError, match=r"^a process died"):
        list(run_jobs(die_or_answer_late, range(8), 2))
    for child in mp.active_children():
        child.join(10.0)
    assert not mp.active_children()


def test_who_wants_no_more_results_waits_for_none() -> None:
    results = run_jobs(sleep, [0.0, 1000.0], 2)
    assert next(results) == 0.0
    results.close()


STOPS = """
import time
from tdgc.parallel.jobs import run_jobs
results = run_jobs(time.sleep, [0.0, *[1000.0] * 8], 2)
next(results)
results.close()
"""


def test_jobs_that_are_given_up_leave_no_traceback() -> None:
    """Neither those under way nor those that have not begun."""
    result = subprocess.run([sys.executable, "-c", STOPS], capture_output=True, text=True)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
