"""Independent jobs, such as batches of episodes, shared among processes of this machine."""

import multiprocessing as mp
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol, TypeVar

from tdgc.parallel.worker import keep_memory, one_blas_thread

Job = TypeVar("Job")
Result = TypeVar("Result")


def run_jobs(work: Callable[[Job], Result], jobs: Sequence[Job], workers: int) -> Iterator[Result]:
    """``work`` on each job, in order, on ``workers`` processes at most."""
    processes = min(workers, len(jobs))
    spawn = mp.get_context("spawn")
    with one_blas_thread(), spawn.Pool(processes, initializer=keep_memory) as pool:
        yield from pool.imap(work, jobs)


class RunJobs(Protocol):
    """``run_jobs``, or what does the same elsewhere."""

    def __call__(
        self, work: Callable[[Job], Result], jobs: Sequence[Job], workers: int
    ) -> Iterator[Result]: ...
