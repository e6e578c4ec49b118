"""Many robots in a few worker processes behind Stable-Baselines3's VecEnv.

Each worker holds one task of some robots. Actions, observations, rewards and flags live in shared
memory that dies with its processes; the pipes carry single words and now and then a state. Robots
that blow up are reset where they are simulated, and a worker that fails can be started anew.
"""

from __future__ import annotations

import atexit
import contextlib
import itertools
import multiprocessing as mp
import os
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawArray
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from tdgc.state import State, copies

#: Observations and rewards are scaled to be of order one; beyond this a robot has blown up. For the
#: low level it means 50 m/s, 400 rad/s or 10 m above the ground.
SANE = 100.0
#: Faults of workers within so many steps that stop a run. A fault of the code comes back at once
#: or in every episode, and the low level's last 1000 steps; one of the machine does not.
FAULTS, FAULT_STEPS = 3, 1000
# s to start in: ten times what imports and 60 robots' worlds took on a core shared by ten.
_START_SECONDS = 600.0


class Task(Protocol):
    """An MDP of M robots, as ``tdgc.low_env.LowLevelTask`` is one.

    ``state_dict()["rng"]`` is the state of all that is random in it and ``["episodes"]`` that of
    the episodes under way; a task that loads a state without them begins new ones. ``forget``
    changes nothing of the state, and makes what follows depend on nothing else.
    """

    num_robots: int
    actor_dim: int
    observation_space: gym.spaces.Box[Any]
    action_space: gym.spaces.Box[Any]

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


MakeTask = Callable[[int, int], Task]  # (number of robots, seed) -> task


class WorkerError(RuntimeError):
    """A worker died, hung or raised; the message carries its own traceback if it has one."""


@dataclass(frozen=True)
class Fault:
    """A fault that was mended by a new worker.

    Attributes:
        worker: its number.
        reason: how it failed, with its own traceback if it has one.
        restarts: how often this worker has been started anew by now.
        seed: of the new worker's task, see ``worker_seed``.
    """

    worker: int
    reason: str
    restarts: int
    seed: int

    def __str__(self) -> str:
        lines = self.reason.splitlines()
        reason = " ".join(dict.fromkeys((lines[0], lines[-1])))
        return f"{reason}; started anew with seed {self.seed} (restart {self.restarts})"


def worker_seed(seed: int, worker: int, restarts: int = 0) -> int:
    """Seed of one worker's task, below 2**32; another one after each restart."""
    return int(np.random.SeedSequence([seed, worker, restarts]).generate_state(1)[0])


class _Shared:
    """The arrays of all robots, in memory shared with the workers."""

    def __init__(self, num: int, obs_dim: int, action_dim: int) -> None:
        self._shape = (num, obs_dim, action_dim)
        self._raw = {
            "actions": RawArray("f", num * action_dim),
            "obs": RawArray("f", num * obs_dim),
            "last_obs": RawArray("f", num * obs_dim),
            "rewards": RawArray("f", num),
            "terminated": RawArray("b", num),
            "truncated": RawArray("b", num),
        }

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Views by name: actions, obs, last_obs (of episodes that ended), rewards, flags."""
        num, obs_dim, action_dim = self._shape
        width = {"actions": action_dim, "obs": obs_dim, "last_obs": obs_dim}
        views: dict[str, NDArray[Any]] = {}
        for name, raw in self._raw.items():
            dtype = np.float32 if name in (*width, "rewards") else np.int8
            flat: NDArray[Any] = np.frombuffer(raw, dtype=dtype)
            views[name] = flat.reshape(num, width[name]) if name in width else flat
        return views


def _step(task: Task, views: dict[str, NDArray[Any]]) -> int:
    """One step of a worker's robots; those whose episode ended are reset.

    A robot that blew up gets no reward and is truncated, with its observation before the step as
    the last one. Returns how many did.

    Raises:
        FloatingPointError: the task is not finite even after a reset.
    """
    reward, terminated, truncated = task.step(views["actions"])
    obs = task.observe()
    blown = ~((np.abs(obs) <= SANE).all(axis=1) & (np.abs(reward) <= SANE))
    # A robot with a NaN leaves Bullet's broad phase in disorder for good: the others of its client
    # fall through the ground. So the worlds are built anew, which ends every episode in them.
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
    """Go on from a worker's state; what was seen last is part of it, for it may be noisy."""
    task.load_state_dict(state)
    views["obs"][:] = state["obs"] if "obs" in state else task.observe()


def _lasting(state: State) -> State:
    """A worker's state without the episodes under way."""
    under_way = ("episodes", "obs", "returns", "lengths")
    return {key: value for key, value in state.items() if key not in under_way}


def _end_with_parent() -> None:
    """End this process when its parent has, whatever it is busy with."""
    parent = mp.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _work(
    pipe: Connection,
    make_task: MakeTask,
    rows: slice,
    seed: int,
    shared: _Shared,
    state: State | None = None,
) -> None:
    """A worker's life: tell its state, then answer one word at a time until told to close.

    With the ``state`` of a worker that failed it takes over all but the randomness.
    """
    # What a terminal or a batch system sends to all processes is the parent's to answer.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    task: Task | None = None
    try:
        views = {name: view[rows] for name, view in shared.arrays().items()}
        task = make_task(rows.stop - rows.start, seed)
        if state is not None:
            _load(task, views, {**state, "rng": task.state_dict()["rng"]})
        busy, blow_ups = 0.0, 0
        pipe.send(task.state_dict())
        while True:
            word, argument = pipe.recv()
            started = time.perf_counter()
            answer: Any = None
            if word == "step":
                blow_ups += _step(task, views)
            elif word == "restart":
                task.restart()
                views["obs"][:] = task.observe()
            elif word == "forget":
                task.forget()
            elif word == "load":
                _load(task, views, argument)
            elif word == "state":
                answer = {**task.state_dict(), "obs": views["obs"].copy()}
            elif word == "stats":
                answer = {**task.take_stats(), "busy_seconds": busy, "blow_ups": float(blow_ups)}
                blow_ups = 0
            elif word == "close":
                pipe.send(None)
                return
            busy += time.perf_counter() - started
            pipe.send(answer)
    except (EOFError, BrokenPipeError):
        pass  # the parent is gone
    except Exception:
        with contextlib.suppress(OSError):
            pipe.send(WorkerError(traceback.format_exc()))
    finally:
        if task is not None:
            task.close()


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """Processes started within get one thread a linear algebra call.

    Workers share the cores already, and threads that wait for each other on a busy core make a
    matrix product of this size forty times slower.
    """
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


class TaskVecEnv(VecEnv):
    """``num_envs`` robots of a task, spread over ``workers`` processes.

    Robots whose episode ended are reset within ``step``; ``infos`` holds their last observation
    and whether they were truncated, as SB3 expects.

    With ``recover`` a worker that dies, hangs or raises is started anew with a seed of its own and
    what its robots had learned when its state was last asked for (see ``state_dicts``); their
    episodes end, truncated, with no reward for the step. ``FAULTS`` faults within ``FAULT_STEPS``
    steps are raised all the same.

    Args:
        make_task: picklable, called in each worker as ``make_task(robots, seed)``.
        num_envs: robots altogether.
        workers: processes; the robots are shared out evenly.
        seed: from which each worker's seed is drawn.
        spaces: observation and action space of the task.
        recover: start workers that fail anew; otherwise the first fault is raised.
        timeout: s without an answer after which a worker counts as hung. Of all that is asked,
            building the worlds of 60 robots on terrain takes longest: 3 s of a core.

    Attributes:
        faults: those mended so far; whoever tells of them takes them out.

    Raises:
        ValueError: fewer robots than workers, no worker, or no timeout.
        WorkerError: a worker failed while starting.
    """

    def __init__(
        self,
        make_task: MakeTask,
        num_envs: int,
        workers: int,
        seed: int,
        spaces: tuple[gym.spaces.Box, gym.spaces.Box],
        recover: bool = False,
        timeout: float = 300.0,
    ) -> None:
        if not 1 <= workers <= num_envs:
            raise ValueError(f"workers must be 1 to the {num_envs} robots, not {workers}")
        if not timeout > 0.0:
            raise ValueError(f"the workers' timeout must be above 0 s, not {timeout:g}")
        super().__init__(num_envs, *spaces)
        self.timeout = timeout
        self.faults: list[Fault] = []
        self._make_task, self._seed, self._recover = make_task, seed, recover
        self._shared = _Shared(num_envs, spaces[0].shape[0], spaces[1].shape[0])
        self._views = self._shared.arrays()
        bounds = np.linspace(0, num_envs, workers + 1).astype(int).tolist()
        self._rows = [slice(*ends) for ends in itertools.pairwise(bounds)]
        self._restarts = [0] * workers
        self._broken: dict[int, WorkerError] = {}  # workers that failed and were not mended yet
        self._steps = 0
        self._fault_steps = deque([-FAULT_STEPS] * FAULTS, maxlen=FAULTS)  # the last faults' steps
        self._pipes: list[Connection] = []
        self._processes: list[Any] = []
        atexit.register(self.close)  # or the interpreter would wait for the workers at its end
        for k in range(workers):
            pipe, process = self._start(k)
            self._pipes.append(pipe)
            self._processes.append(process)
        # The last known ones; a worker begins by telling its own.
        states = [self._receive(k, _START_SECONDS) for k in range(workers)]
        if self._broken:
            self.close()
            raise self._broken[min(self._broken)]
        self._states: list[State] = [_lasting(state) for state in states]
        self._returns = np.zeros(num_envs)
        self._lengths = np.zeros(num_envs, dtype=np.int64)

    # ------------------------------------------------------------------ the workers

    def _start(self, worker: int, state: State | None = None) -> tuple[Connection, Any]:
        context = mp.get_context("spawn")
        ours, theirs = context.Pipe()
        seed = worker_seed(self._seed, worker, self._restarts[worker])
        process = context.Process(
            target=_work,
            args=(theirs, self._make_task, self._rows[worker], seed, self._shared, state),
            daemon=True,
            name=f"tdgc-worker-{worker}",
        )
        with one_blas_thread():
            process.start()
        theirs.close()
        return ours, process

    def _replace(self, worker: int, restarts: int, state: State | None = None) -> None:
        """Put a new process in a worker's place; it has to be waited for."""
        self._processes[worker].kill()
        self._processes[worker].join()
        self._pipes[worker].close()
        self._broken.pop(worker, None)
        self._restarts[worker] = restarts
        self._pipes[worker], self._processes[worker] = self._start(worker, state)

    @property
    def worker_pids(self) -> list[int]:
        """Process numbers of the workers."""
        return [process.pid for process in self._processes]

    def _send(self, worker: int, word: str, argument: Any = None) -> None:
        with contextlib.suppress(OSError):  # that it is gone is seen when its answer is wanted
            self._pipes[worker].send((word, argument))

    def _receive(self, worker: int, timeout: float) -> Any:
        """A worker's answer; or the ``WorkerError``, which stays until the worker is replaced."""
        if worker in self._broken:
            return self._broken[worker]
        try:
            if not self._pipes[worker].poll(timeout):
                fault = WorkerError(f"worker {worker} gave no answer for {timeout:g} s")
            elif isinstance(answer := self._pipes[worker].recv(), WorkerError):
                fault = WorkerError(f"worker {worker} failed:\n{answer}")
            else:
                return answer
        except (EOFError, OSError):
            process = self._processes[worker]
            process.join(timeout=5.0)  # its pipe closes a moment before it ends
            fault = WorkerError(f"worker {worker} died (exit code {process.exitcode})")
        self._broken[worker] = fault
        return fault

    def _receive_all(self) -> list[Any]:
        """Every worker's answer, or its ``WorkerError``.

        Raises:
            WorkerError: one failed, and no worker is to be started anew.
        """
        answers = [self._receive(k, self.timeout) for k in range(len(self._pipes))]
        if self._broken and not self._recover:
            raise self._broken[min(self._broken)]
        return answers

    def _ask(self, word: str) -> list[Any]:
        for k in range(len(self._pipes)):
            self._send(k, word)
        return self._receive_all()

    def _mend(self) -> NDArray[np.bool_]:
        """Start the broken workers anew; their robots have new observations.

        Returns:
            (num_envs,) the robots concerned.

        Raises:
            WorkerError: there were too many faults.
        """
        concerned = np.zeros(self.num_envs, dtype=bool)
        while self._broken:
            worker, fault = next(iter(self._broken.items()))
            self._fault_steps.append(self._steps)
            if self._steps - self._fault_steps[0] < FAULT_STEPS:
                raise WorkerError(
                    f"{FAULTS} faults of workers within {FAULT_STEPS} steps; the last one: {fault}"
                )
            restarts = self._restarts[worker] + 1
            self._replace(worker, restarts, self._states[worker])
            seed = worker_seed(self._seed, worker, restarts)
            self.faults.append(Fault(worker, str(fault), restarts, seed))
            self._receive(worker, _START_SECONDS)
            concerned[self._rows[worker]] = True
        return concerned

    # ------------------------------------------------------------------ as SB3 wants it

    def reset(self) -> NDArray[np.float32]:
        """End all episodes, rebuild the worlds and return the first observations."""
        self._ask("restart")
        self._mend()
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return self.seen()

    def seen(self) -> NDArray[np.float32]:
        """The last observations, (num_envs, n)."""
        return self._views["obs"].copy()

    def starts(self) -> NDArray[np.bool_]:
        """Whether the last observation is the first of its episode, (num_envs,)."""
        return self._lengths == 0

    def forget(self) -> None:
        """Let what follows depend on ``state_dicts`` alone, see ``Task``."""
        self._ask("forget")

    def step_async(self, actions: NDArray[np.floating]) -> None:
        self._views["actions"][:] = actions
        for k in range(len(self._pipes)):
            self._send(k, "step")

    def step_wait(self) -> Any:
        self._receive_all()
        self._steps += 1
        views = self._views
        if self._broken:
            seen = views["obs"].copy()
            lost = self._mend()
            views["last_obs"][lost] = seen[lost]
            views["rewards"][lost] = 0.0
            views["terminated"][lost], views["truncated"][lost] = False, True
        self._returns += views["rewards"]
        self._lengths += 1
        terminated = views["terminated"].astype(bool)
        done = terminated | views["truncated"].astype(bool)
        infos: list[dict[str, Any]] = [{}] * self.num_envs
        for i in np.flatnonzero(done):
            infos[i] = {
                "terminal_observation": views["last_obs"][i].copy(),
                "TimeLimit.truncated": not terminated[i],
                "episode": {"r": float(self._returns[i]), "l": int(self._lengths[i])},
            }
        self._returns[done] = 0.0
        self._lengths[done] = 0
        return views["obs"].copy(), views["rewards"].copy(), done, infos

    def stats(self) -> list[dict[str, float]]:
        """Each worker's sums since the last call, see ``Task.take_stats``, and ``blow_ups``.

        A broken worker's are lost.
        """
        return [sums for sums in self._ask("stats") if not isinstance(sums, WorkerError)]

    def state_dicts(self) -> list[State]:
        """Each worker's state, with what its robots saw last and its ``restarts``.

        Who loads it goes on as this does after ``forget``, bit for bit. A broken worker's is its
        last known one, without the episodes under way.
        """
        states = []
        for k, state in enumerate(self._ask("state")):
            if isinstance(state, WorkerError):
                state = self._states[k]
            else:
                self._states[k] = _lasting(state)
                rows = self._rows[k]
                state |= copies({"returns": self._returns[rows], "lengths": self._lengths[rows]})
            states.append({**state, "restarts": self._restarts[k]})
        return states

    def load_state_dicts(self, states: list[State]) -> None:
        """Go on from the workers' states; episodes that are missing in one begin anew.

        Raises:
            ValueError: states of another number of workers or robots.
            WorkerError: a worker failed.
        """
        if len(states) != len(self._pipes):
            raise ValueError(f"states of {len(states)} workers do not fit {len(self._pipes)}")
        for rows, state in zip(self._rows, states, strict=True):
            robots = rows.stop - rows.start
            returns = state.get("returns", np.zeros(robots))
            if len(returns) != robots:
                raise ValueError(f"a state of {len(returns)} robots does not fit {robots}")
            self._returns[rows] = returns
            self._lengths[rows] = state.get("lengths", 0)
        for k, state in enumerate(states):
            restarts = state.get("restarts", 0)
            if restarts != self._restarts[k]:  # its seed is another one
                self._replace(k, restarts)
                self._receive(k, _START_SECONDS)
            self._send(k, "load", state)
        self._receive_all()
        if self._broken:
            raise self._broken[min(self._broken)]
        self._states = [_lasting(state) for state in states]

    def close(self) -> None:
        """Stop the workers, gently and then not."""
        atexit.unregister(self.close)
        for k in range(len(self._pipes)):
            self._send(k, "close")
        for k, process in enumerate(self._processes):
            process.join(timeout=0.0 if k in self._broken else 5.0)
            if process.is_alive():
                process.kill()
                process.join()
        for pipe in self._pipes:
            pipe.close()

    # What SB3 asks of every VecEnv and a batched world has no single environment to answer for.
    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        value = None if attr_name == "render_mode" else getattr(self, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError("robots of a batched world have no attributes of their own")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        raise NotImplementedError("robots of a batched world have no methods of their own")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]
