"""Workers on more than one machine, as Ray actors and tasks (the extra ``cluster``).

Ray must already run on each machine, see docs/cluster.md. This process joins the cluster, and Ray
decides which machine runs a worker or a batch of episodes. No other module of the package uses Ray,
and it is only imported when a cluster is requested.
"""

import copy
import hashlib
import itertools
import logging
import os
import re
import signal
import socket
import time
import urllib.parse
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tdgc.errors import InputError, WorkerError, require
from tdgc.parallel.jobs import Job, Result
from tdgc.parallel.worker import BLAS_THREADS, Arrays, Beginning, Worker, keep_memory
from tdgc.state import copies

_REACH_SECONDS = 5.0  # limit for connecting to the cluster's address
_JOIN_SECONDS = 120.0  # limit for every node to start Python and import this package
_RERUNS = 3  # of a job whose node was lost
# Restarts of a worker that was lost before its first answer, and the pause before each: for some
# seconds Ray still sends workers to a node that is gone.
_RESTARTS, _PAUSE_SECONDS = 10, 1.0

#: Help text of the flag ``--cluster``.
CLUSTER_HELP = (
    "simulate on this Ray cluster: host:port, or auto for the one in RAY_ADDRESS, or else the one "
    "on this machine"
)


class ClusterError(InputError):
    """The cluster cannot be used; the message is one line."""


def connect(address: str) -> int:
    """Join a running cluster, unless this process has joined one already.

    Args:
        address: ``host:port``; or ``auto`` for the cluster named by the environment variable
            ``RAY_ADDRESS`` or, if that is not set, the one running on this machine.

    Returns:
        Number of CPUs of the cluster.

    Raises:
        InputError: Ray is not installed.
        ClusterError: no cluster answers, or a node cannot be used.
    """
    require("--cluster", ("ray",), "cluster")
    import ray

    if not ray.is_initialized():
        _join(address)
        try:
            _check_nodes()
        except ClusterError:
            ray.shutdown()
            raise
    return int(ray.cluster_resources().get("CPU", 0))


def check_workers(workers: int, cpus: int) -> None:
    """Check that the cluster has a CPU for each worker; without one a worker would wait for ever.

    Raises:
        ClusterError: there are too few CPUs.
    """
    if workers > cpus:
        raise ClusterError(f"the cluster's {cpus} CPUs are too few for {workers} workers")


def _join(address: str) -> None:
    import ray

    before = signal.getsignal(signal.SIGTERM)
    try:
        named = os.environ.get("RAY_ADDRESS", "auto") if address == "auto" else address
        if named != "auto":  # Ray itself would wait many minutes for a cluster that is gone.
            place = urllib.parse.urlsplit(f"//{named}")
            socket.create_connection((place.hostname, place.port or 0), _REACH_SECONDS).close()
        ray.init(
            address=address,
            runtime_env={"env_vars": dict.fromkeys(BLAS_THREADS, "1")},  # see one_blas_thread
            log_to_driver=False,
            logging_level=logging.WARNING,
        )
    except (OSError, ValueError):
        raise ClusterError(
            f"--cluster {address}: no cluster of Ray answers; allowed: host:port, or auto for the "
            "one that RAY_ADDRESS names or that runs on this machine"
        ) from None
    except (RuntimeError, ray.exceptions.RayError) as error:  # RayError: a missing token
        reason = " ".join(str(error).split())
        raise ClusterError(f"--cluster {address}: cannot be joined: {reason}") from error
    finally:
        signal.signal(signal.SIGTERM, before)  # Ray has replaced the handler


def _check_nodes() -> None:
    """Check that every node has the same code of this package and the same ``urdf/`` beside it.

    Raises:
        ClusterError: a node has other files, lacks the package, or does not answer.
    """
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    def sums() -> dict[str, str]:  # nested, hence pickled by value, for nodes without this function
        import tdgc

        root = Path(tdgc.__file__).resolve().parents[1]
        return {
            path.relative_to(root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
            for pattern in ("tdgc/**/*.py", "urdf/**/*.urdf")
            for path in root.glob(pattern)
        }

    here, asked = sums(), []
    for node in ray.nodes():
        if node["Alive"]:
            there = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
            ask = ray.remote(sums).options(num_cpus=0, max_retries=0, scheduling_strategy=there)
            asked.append((node["NodeManagerAddress"], ask.remote()))
    for name, answer in asked:
        try:
            found = ray.get(answer, timeout=_JOIN_SECONDS)
        except ImportError:
            raise ClusterError(f"tdgc is not installed on node {name}") from None
        except ray.exceptions.RayError as error:
            raise ClusterError(f"node {name} gives no answer ({type(error).__name__})") from error
        if found != here:
            other, *more = sorted({path for path, _ in found.items() ^ here.items()})
            rest = f" and {len(more)} more" if more else ""
            raise ClusterError(f"node {name} differs from this machine in {other}{rest}")


# ---------------------------------------------------------------------------- workers


class _Actor:
    """A worker on some node; each method returns (answer, arrays it changed, pid, address)."""

    def start(self, views: dict[str, NDArray[Any]], beginning: Beginning) -> tuple[Any, ...]:
        self._views = copies(views)
        self._worker = Worker(self._views, beginning)
        return self._reply(self._worker.task.state_dict(), "obs")

    def answer(self, word: str, argument: Any) -> tuple[Any, ...]:
        if word != "step":
            return self._reply(self._worker.answer(word, argument), "obs")
        self._views["actions"][:] = argument
        self._worker.answer(word)
        return self._reply(None, "obs", "rewards", "terminated", "truncated")

    def _reply(self, answer: Any, *changed: str) -> tuple[Any, ...]:
        import ray

        arrays = {name: self._views[name] for name in changed}
        if "terminated" in arrays:
            arrays["last_obs"] = self._views["last_obs"][_ended(arrays)]  # few rows, so few bytes
        return answer, arrays, os.getpid(), ray.util.get_node_ip_address()


def _ended(views: dict[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Which robots' episodes ended in the step, (M,)."""
    return np.asarray((views["terminated"] | views["truncated"]) != 0)


class ActorLink:
    """A worker in a Ray actor, on whichever node has a free CPU; arguments as in ``MakeLink``.

    Each message carries the arrays of all of the worker's robots. Ray's own restarts are off: a
    lost worker raises ``WorkerError``, so that the owner of the link can start another one. Only a
    worker lost before its first answer is restarted here.
    """

    def __init__(self, worker: int, arrays: Arrays, beginning: Beginning) -> None:
        self._worker, self._beginning = worker, beginning
        self._views = arrays.views(beginning.rows)
        self._pid, self._place = 0, "no node yet"
        self._restarts = 0
        self._begin()

    def _begin(self) -> None:
        import ray

        self._actor = (
            ray.remote(_Actor)
            .options(num_cpus=1, max_restarts=0, scheduling_strategy="SPREAD")
            .remote()
        )
        self._reply = self._actor.start.remote(self._views, self._beginning)

    @property
    def pid(self) -> int:
        assert self._pid, "a worker has a process from its first answer on"
        return self._pid

    def send(self, word: str, argument: Any = None) -> None:
        if word == "step":
            argument = self._views["actions"]
        self._reply = self._actor.answer.remote(word, argument)

    def receive(self, timeout: float) -> Any:
        import ray

        name = f"worker {self._worker}"
        try:
            answer, arrays, self._pid, address = ray.get(self._reply, timeout=timeout)
        except ray.exceptions.GetTimeoutError:
            raise WorkerError(f"{name} gave no answer for {timeout:g} s") from None
        except ray.exceptions.RayTaskError as error:
            plain = re.sub(r"\x1b\[\d+m", "", str(error))  # without colours
            raise WorkerError(f"{name} failed:\n{plain}") from None
        except ray.exceptions.RayError as error:
            if not self._pid and self._restarts < _RESTARTS:
                self._restarts += 1
                time.sleep(_PAUSE_SECONDS)
                self._begin()
                return self.receive(timeout)
            kind = type(error).__name__
            raise WorkerError(f"{name} was lost with {self._place} ({kind})") from None
        self._place = f"process {self._pid} on {address}"
        if "last_obs" in arrays:
            self._views["last_obs"][_ended(arrays)] = arrays.pop("last_obs")
        for key, array in arrays.items():
            self._views[key][:] = array
        return copy.deepcopy(answer)  # what Ray returns is read-only

    def end(self, timeout: float) -> None:
        import ray

        ray.wait([self._reply], timeout=timeout)
        ray.kill(self._actor)


# ---------------------------------------------------------------------------- jobs


def _run(work: Callable[[Job], Result], job: Job) -> Result:
    keep_memory()
    return work(job)


def run_jobs(work: Callable[[Job], Result], jobs: Sequence[Job], workers: int) -> Iterator[Result]:
    """Yield the results of ``work`` on each job, in order, using at most ``workers`` CPUs.

    A job whose node is lost is repeated on another one.

    Raises:
        WorkerError: a job was lost too often.
    """
    import ray

    run = ray.remote(_run).options(num_cpus=1, max_retries=_RERUNS, scheduling_strategy="SPREAD")
    shared = ray.put(work)
    rest = iter(enumerate(jobs))
    running: dict[Any, int] = {}  # future answer -> number of its job
    done: dict[int, Result] = {}
    for wanted in range(len(jobs)):
        while wanted not in done:
            for number, job in itertools.islice(rest, workers - len(running)):
                running[run.remote(shared, job)] = number
            (answer,), _ = ray.wait(list(running))
            try:
                done[running.pop(answer)] = ray.get(answer)
            except ray.exceptions.RayTaskError as error:
                raise error.cause from error  # the job's own
            except ray.exceptions.RayError as error:
                kind = type(error).__name__
                raise WorkerError(f"a job was lost {_RERUNS + 1} times ({kind})") from error
        yield done.pop(wanted)
