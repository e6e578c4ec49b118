"""A worker: some robots of a task in a process of their own, and the connection to it.

A worker answers one request at a time, each a single word. Actions, observations, rewards and flags
are in shared memory that is freed with its processes; the pipes carry the words and an occasional
state. The worker itself resets robots that blow up.

Nothing here imports PyTorch or Stable-Baselines3, and neither does the low policy's task: they
would add 150 MB to each worker.
"""

import contextlib
import ctypes
import math
import multiprocessing as mp
import os
import pickle
import signal
import sys
import threading
import traceback
import types
from collections.abc import Callable, Iterator
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawArray
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from tdgc.errors import WorkerError
from tdgc.state import State

#: Observations are scaled to order one; a robot with larger ones has blown up. For the low policy
#: the limit is 50 m/s, 400 rad/s or 10 m above the ground.
SANE_OBSERVATION = 100.0
#: Likewise for rewards, which are of order one at the default weights; with the largest weights
#: (``tdgc.config.settings.Weight``) all but those for contact forces come to a few ten thousand.
SANE_REWARD = 1e5


class Task(Protocol):
    """An MDP of M robots, such as ``tdgc.tasks.low_env.LowLevelTask``.

    ``state_dict()["rng"]`` is the state of its random generators and ``["episodes"]`` that of the
    episodes under way; a task that loads a state without ``episodes`` begins new ones. ``forget``
    leaves the state unchanged and makes what follows depend on nothing else.
    """

    num_robots: int

    def reset(self, index: NDArray[np.integer]) -> None: ...

    def step(
        self, actions: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]: ...

    def observe(self) -> NDArray[np.float32]: ...

    def restart(self) -> None: ...

    def forget(self) -> None: ...

    def take_stats(self) -> dict[str, float]: ...

    def state_dict(self) -> State: ...

    def load_state_dict(self, state: State) -> None: ...

    def close(self) -> None: ...


class MakeTask(Protocol):
    """Makes a worker's task; ``first`` is the number of its first robot among those of the run."""

    def __call__(self, robots: int, seed: int, *, first: int) -> Task: ...


class Link(Protocol):
    """A worker as seen by the learner.

    Attributes:
        pid: its process id, on the machine where it runs.
    """

    @property
    def pid(self) -> int: ...

    def send(self, word: str, argument: Any = None) -> None:
        """Send a request, see ``Worker.answer``. A dead worker is only noticed by ``receive``."""

    def receive(self, timeout: float) -> Any:
        """The worker's next answer, within ``timeout`` s; the first one, unrequested, is its state.

        Raises:
            WorkerError: the worker died, hung or raised; it accepts no further requests.
        """

    def end(self, timeout: float) -> None:
        """End the worker, by force if it is still running after ``timeout`` s."""


# ---------------------------------------------------------------------------- the worker


class Arrays:
    """The arrays of some robots, in memory shared with every process they are passed to."""

    def __init__(self, num: int, obs_dim: int, action_dim: int) -> None:
        self._raw = {  # name -> memory, shape
            "actions": (RawArray("f", num * action_dim), (num, action_dim)),
            "obs": (RawArray("f", num * obs_dim), (num, obs_dim)),
            "last_obs": (RawArray("f", num * obs_dim), (num, obs_dim)),
            "rewards": (RawArray("f", num), (num,)),
            "terminated": (RawArray("b", num), (num,)),
            "truncated": (RawArray("b", num), (num,)),
        }

    def views(self, rows: slice = slice(None)) -> dict[str, NDArray[Any]]:
        """Views of ``rows``: actions, obs, last_obs (of ended episodes), rewards, the two flags."""
        return {
            name: np.asarray(raw).reshape(shape)[rows] for name, (raw, shape) in self._raw.items()
        }


class Beginning(NamedTuple):
    """What a worker starts from.

    Attributes:
        make_task: picklable, called where the worker runs.
        rows: the worker's robots among those of the run.
        seed: of its task.
        state: of a failed worker that this one replaces; all but its ``rng`` is used.
    """

    make_task: MakeTask
    rows: slice
    seed: int
    state: State | None = None


# (its number, the arrays of all robots, what it starts from) -> worker
MakeLink = Callable[[int, Arrays, Beginning], Link]


def are_sane(obs: NDArray[np.floating], reward: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which robots have not blown up, (M,), by their observations (M, n) and rewards (M,)."""
    within = (np.abs(obs) <= SANE_OBSERVATION).all(axis=1)  # false for NaN, too
    return np.asarray(within & (np.abs(reward) <= SANE_REWARD))


def _step(task: Task, views: dict[str, NDArray[Any]]) -> int:
    """Step a worker's robots, reset those whose episodes ended, and return how many blew up.

    A robot that blew up gets no reward and is truncated, with its observation before the step as
    the last one.

    Raises:
        FloatingPointError: observations are not finite even after a reset.
    """
    reward, terminated, truncated = task.step(views["actions"])
    obs = task.observe()
    blown = ~are_sane(obs, reward)
    # A NaN in one robot corrupts Bullet's broad phase permanently: the other robots of its client
    # fall through the ground. So the worlds are rebuilt, which ends every episode in them.
    poisoned = not (np.isfinite(obs).all() and np.isfinite(reward).all())
    obs[blown], reward[blown] = views["obs"][blown], 0.0
    terminated &= ~blown
    truncated |= blown | (poisoned & ~terminated)
    done = np.flatnonzero(terminated | truncated)
    if done.size:
        views["last_obs"][done] = obs[done]
        if poisoned:
            task.take_stats()  # its sums are not finite either
            task.restart()
        else:
            task.reset(done)
        obs[done] = task.observe()[done]
        if not np.isfinite(obs).all():
            raise FloatingPointError("observations are not finite after a reset")
    views["obs"][:] = obs
    views["rewards"][:] = reward
    views["terminated"][:] = terminated
    views["truncated"][:] = truncated
    return int(blown.sum())


def _load(task: Task, views: dict[str, NDArray[Any]], state: State) -> None:
    """Continue from a worker's state, including the last observations, which may be noisy."""
    task.load_state_dict(state)
    views["obs"][:] = state["obs"] if "obs" in state else task.observe()


class Worker:
    """Some robots of a task with the arrays ``views``, their own rows only."""

    def __init__(self, views: dict[str, NDArray[Any]], beginning: Beginning) -> None:
        make_task, rows, seed, state = beginning
        self.task, self._views = make_task(rows.stop - rows.start, seed, first=rows.start), views
        if state is not None:
            _load(self.task, views, {**state, "rng": self.task.state_dict()["rng"]})
        self._blow_ups = 0

    def answer(self, word: str, argument: Any = None) -> Any:
        """Serve one request: step, restart, forget, load, state or stats."""
        answer: Any = None
        if word == "step":
            self._blow_ups += _step(self.task, self._views)
        elif word == "restart":
            self.task.restart()
            self._views["obs"][:] = self.task.observe()
        elif word == "forget":
            self.task.forget()
        elif word == "load":
            try:
                _load(self.task, self._views, argument)
            except (ValueError, KeyError, TypeError) as error:  # of another configuration
                answer = str(error)
        elif word == "state":
            answer = {**self.task.state_dict(), "obs": self._views["obs"].copy()}
        elif word == "stats":
            own = {"memory_mb": memory_mb(os.getpid()), "blow_ups": float(self._blow_ups)}
            answer = {**self.task.take_stats(), **own}
            self._blow_ups = 0
        return answer


def memory_mb(pid: int) -> float:
    """Memory of a process in MB, counting only its share of shared pages (proportional set size).

    NaN where ``/proc/PID/smaps_rollup`` is missing, as on any system but Linux.
    """
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except FileNotFoundError:
        return math.nan
    return sum(int(line.split()[1]) / 1024.0 for line in lines if line.startswith("Pss:"))


# ---------------------------------------------------------------------------- its process


def end_with_parent() -> None:
    """Make this process end when its parent does, whatever it is doing."""
    parent = mp.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _serve(pipe: Connection, arrays: Arrays, beginning: Beginning) -> None:
    """Run a worker: send its state, then answer one request at a time until ``close``."""
    end_with_parent()
    worker: Worker | None = None
    try:
        worker = Worker(arrays.views(beginning.rows), beginning)
        pipe.send(worker.task.state_dict())
        while True:
            word, argument = pipe.recv()
            if word == "close":
                return
            pipe.send(worker.answer(word, argument))
    except (EOFError, BrokenPipeError):
        pass  # the parent is gone
    except Exception:
        with contextlib.suppress(OSError):
            pipe.send(WorkerError(traceback.format_exc()))
    finally:
        if worker is not None:
            worker.task.close()


@contextlib.contextmanager
def signals_left_to_parent() -> Iterator[None]:
    """Block, in processes started in this context, the signals that a terminal or a batch system
    sends to all processes.

    The processes inherit the block, so it already holds while they import their modules. Signals to
    this process are handled at the end of the context.
    """
    resource_tracker.ensure_running()  # with the first process it would unblock the signals
    blocked = signal.SIGINT, signal.SIGTERM
    before = signal.pthread_sigmask(signal.SIG_BLOCK, blocked)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


#: Variables that set the number of threads of a linear algebra call, whichever library makes it.
BLAS_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """Give processes started in this context one thread per linear algebra call.

    The workers already occupy the cores, and threads that wait for each other on a busy core make a
    matrix product of this size forty times slower.
    """
    before = {name: os.environ.get(name) for name in BLAS_THREADS}
    os.environ.update(dict.fromkeys(BLAS_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # of glibc's malloc.h


def keep_memory() -> None:
    """Make this process keep the memory that it frees, if the C library is glibc.

    A batch's tiles take hundreds of MB. Requesting them anew from the system, page by page, took
    four fifths of the time to build a world.
    """
    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallopt"):
        libc.mallopt(_M_MMAP_MAX, 0)  # allocate from the heap only, never by mmap
        libc.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)  # never return the top of the heap


@contextlib.contextmanager
def _without_script(needed: Any) -> Iterator[None]:
    """Keep processes started in this context from importing the running script.

    They would import everything it imports. The script is left in place if it defines ``needed``.
    """
    script = sys.modules["__main__"]
    if b"__main__" not in pickle.dumps(needed):
        sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script


class ProcessLink:
    """A worker in a process on this machine; arguments as in ``MakeLink``."""

    def __init__(self, worker: int, arrays: Arrays, beginning: Beginning) -> None:
        context = mp.get_context("spawn")
        self._worker = worker
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve,
            args=(theirs, arrays, beginning),
            daemon=True,
            name=f"tdgc-worker-{worker}",
        )
        try:
            with one_blas_thread(), signals_left_to_parent(), _without_script(beginning.make_task):
                self._process.start()
        except BaseException:  # such as a signal that was held back
            if self._process.pid is not None:
                self.end(0.0)
            raise
        finally:
            theirs.close()

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    def send(self, word: str, argument: Any = None) -> None:
        with contextlib.suppress(OSError):
            self._pipe.send((word, argument))

    def receive(self, timeout: float) -> Any:
        try:
            # In two halves: if Ctrl-Z outlasts the first, the worker has the second to answer.
            if not self._pipe.poll(timeout / 2) and not self._pipe.poll(timeout / 2):
                raise WorkerError(f"worker {self._worker} gave no answer for {timeout:g} s")
            answer = self._pipe.recv()
        except (EOFError, OSError):
            self._process.join(timeout=5.0)  # the pipe closes a moment before the process ends
            code = self._process.exitcode
            raise WorkerError(f"worker {self._worker} died (exit code {code})") from None
        if isinstance(answer, WorkerError):
            raise WorkerError(f"worker {self._worker} failed:\n{answer}")
        return answer

    def end(self, timeout: float) -> None:
        self._process.join(timeout)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._pipe.close()
