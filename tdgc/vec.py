"""Many robots in a few worker processes behind Stable-Baselines3's VecEnv.

Each worker holds one task of some robots. Actions, observations, rewards and flags live in shared
memory that dies with its processes; the pipes carry single words and now and then a state.
"""

from __future__ import annotations

import contextlib
import multiprocessing as mp
import os
import signal
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawArray
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv


class Task(Protocol):
    """An MDP of M robots, as ``tdgc.low_env.LowLevelTask`` is one."""

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

    def take_stats(self) -> dict[str, float]: ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...

    def close(self) -> None: ...


MakeTask = Callable[[int, int], Task]  # (number of robots, seed) -> task


class WorkerError(RuntimeError):
    """A worker failed; the message carries its own traceback."""


def worker_seed(seed: int, worker: int) -> int:
    """Seed of one worker's task, below 2**32."""
    return int(np.random.SeedSequence([seed, worker]).generate_state(1)[0])


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


def _work(pipe: Connection, make_task: MakeTask, rows: slice, seed: int, shared: _Shared) -> None:
    """A worker's life: answer one word at a time until told to close or the pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's Ctrl-C is the parent's to answer
    task: Task | None = None
    try:
        views = {name: view[rows] for name, view in shared.arrays().items()}
        task = make_task(rows.stop - rows.start, seed)
        busy = 0.0
        pipe.send(None)
        while True:
            word, argument = pipe.recv()
            started = time.perf_counter()
            answer: Any = None
            if word == "step":
                reward, terminated, truncated = task.step(views["actions"])
                obs = task.observe()
                done = np.flatnonzero(terminated | truncated)
                if done.size:
                    views["last_obs"][done] = obs[done]
                    task.reset(done)
                    obs[done] = task.observe()[done]
                views["obs"][:] = obs
                views["rewards"][:] = reward
                views["terminated"][:] = terminated
                views["truncated"][:] = truncated
            elif word == "restart":
                task.restart()
                views["obs"][:] = task.observe()
            elif word == "load":
                task.load_state_dict(argument)
            elif word == "state":
                answer = task.state_dict()
            elif word == "stats":
                answer = {**task.take_stats(), "busy_seconds": busy}
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

    Args:
        make_task: picklable, called in each worker as ``make_task(robots, seed)``.
        num_envs: robots altogether.
        workers: processes; the robots are shared out evenly.
        seed: from which each worker's seed is drawn.
        spaces: observation and action space of the task.

    Raises:
        ValueError: fewer robots than workers, or no worker.
        WorkerError: a worker failed while starting.
    """

    def __init__(
        self,
        make_task: MakeTask,
        num_envs: int,
        workers: int,
        seed: int,
        spaces: tuple[gym.spaces.Box, gym.spaces.Box],
    ) -> None:
        if not 1 <= workers <= num_envs:
            raise ValueError(f"workers must be 1 to the {num_envs} robots, not {workers}")
        super().__init__(num_envs, *spaces)
        self._shared = _Shared(num_envs, spaces[0].shape[0], spaces[1].shape[0])
        self._views = self._shared.arrays()
        context = mp.get_context("spawn")
        bounds = np.linspace(0, num_envs, workers + 1).astype(int)
        self._pipes: list[Connection] = []
        self._processes = []
        for k in range(workers):
            ours, theirs = context.Pipe()
            rows = slice(int(bounds[k]), int(bounds[k + 1]))
            process = context.Process(
                target=_work,
                args=(theirs, make_task, rows, worker_seed(seed, k), self._shared),
                daemon=True,
                name=f"tdgc-worker-{k}",
            )
            with one_blas_thread():
                process.start()
            theirs.close()
            self._pipes.append(ours)
            self._processes.append(process)
        try:
            for k in range(workers):
                self._receive(k)
        except WorkerError:
            self.close()
            raise
        self._returns = np.zeros(num_envs)
        self._lengths = np.zeros(num_envs, dtype=np.int64)

    def _death(self, worker: int) -> WorkerError:
        process = self._processes[worker]
        process.join(timeout=5.0)  # its pipe closes a moment before it ends
        return WorkerError(f"worker {worker} died (exit code {process.exitcode})")

    def _send(self, worker: int, word: str, argument: Any = None) -> None:
        try:
            self._pipes[worker].send((word, argument))
        except OSError as error:
            raise self._death(worker) from error

    @property
    def worker_pids(self) -> list[int]:
        """Process numbers of the workers."""
        return [process.pid for process in self._processes if process.pid is not None]

    def _receive(self, worker: int) -> Any:
        try:
            answer = self._pipes[worker].recv()
        except (EOFError, OSError) as error:
            raise self._death(worker) from error
        if isinstance(answer, WorkerError):
            raise WorkerError(f"worker {worker} failed:\n{answer}")
        return answer

    def _ask(self, word: str, arguments: Sequence[Any] | None = None) -> list[Any]:
        for k in range(len(self._pipes)):
            self._send(k, word, None if arguments is None else arguments[k])
        return [self._receive(k) for k in range(len(self._pipes))]

    def reset(self) -> NDArray[np.float32]:
        """End all episodes, rebuild the worlds and return the first observations."""
        self._ask("restart")
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return self._views["obs"].copy()

    def step_async(self, actions: NDArray[np.floating]) -> None:
        self._views["actions"][:] = actions
        for k in range(len(self._pipes)):
            self._send(k, "step")

    def step_wait(self) -> Any:
        for k in range(len(self._pipes)):
            self._receive(k)
        views = self._views
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
        """Each worker's sums since the last call, see ``Task.take_stats``."""
        return self._ask("stats")

    def state_dicts(self) -> list[dict[str, Any]]:
        """Each worker's state, from which ``reset`` gives the same future."""
        return self._ask("state")

    def load_state_dicts(self, states: list[dict[str, Any]]) -> None:
        """Take over the workers' states; call ``reset`` afterwards.

        Raises:
            ValueError: states of another number of workers.
        """
        if len(states) != len(self._pipes):
            raise ValueError(f"states of {len(states)} workers do not fit {len(self._pipes)}")
        self._ask("load", states)

    def close(self) -> None:
        """Stop the workers, gently and then not."""
        for pipe in self._pipes:
            with contextlib.suppress(OSError):
                pipe.send(("close", None))
        for process in self._processes:
            process.join(timeout=5.0)
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
