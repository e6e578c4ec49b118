"""Independent jobs, such as batches of episodes, shared among processes on this machine."""

import multiprocessing as mp
import pickle
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol, TypeVar

from tdgc.errors import WorkerError
from tdgc.parallel.worker import (
    end_with_parent,
    keep_memory,
    one_blas_thread,
    signals_left_to_parent,
)

Job = TypeVar("Job")
Result = TypeVar("Result")


def run_jobs(work: Callable[[Job], Result], jobs: Sequence[Job], workers: int) -> Iterator[Result]:
    """Yield the results of ``work`` on each job, in order, using at most ``workers`` processes.

    Raises:
        WorkerError: a process died.
        Exception: whatever ``work`` raised.
    """
    processes, others = min(workers, len(jobs)), set(mp.active_children())
    spawn = mp.get_context("spawn")
    with one_blas_thread(), ProcessPoolExecutor(processes, spawn, _begin) as pool:
        try:
            # Tensors are pickled here, by value. Otherwise a process fetches them from this one,
            # where a traceback is printed if it is killed meanwhile.
            todo = pickle.dumps(work)
            with signals_left_to_parent():  # to submit starts the processes
                calls = deque(pool.submit(_call, todo, pickle.dumps(job)) for job in jobs)
            while calls:
                yield calls.popleft().result()
        except BaseException as error:  # the jobs under way are no longer needed
            # They are not cancelled: a broken pool prints a traceback if one is.
            pool.shutdown(wait=False)
            for process in set(mp.active_children()) - others:
                process.kill()  # it blocks SIGTERM, with which a pool ends its processes
            if isinstance(error, BrokenProcessPool):
                raise WorkerError("a process died, perhaps out of memory") from None
            raise


def _call(work: bytes, job: bytes) -> Any:
    return pickle.loads(work)(pickle.loads(job))


def _begin() -> None:
    keep_memory()
    end_with_parent()


class RunJobs(Protocol):
    """Signature of ``run_jobs`` here and in ``tdgc.parallel.cluster``."""

    def __call__(
        self, work: Callable[[Job], Result], jobs: Sequence[Job], workers: int
    ) -> Iterator[Result]: ...
