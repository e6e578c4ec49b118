"""Many robots in a few workers behind Stable-Baselines3's VecEnv; failed workers are replaced."""

import atexit
import itertools
from collections import deque
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from tdgc.errors import WorkerError, in_one_line
from tdgc.parallel.worker import Arrays, Beginning, Link, MakeLink, MakeTask, ProcessLink
from tdgc.state import State, copies

#: A run stops at this many worker faults within this many steps. A fault in the code recurs at
#: once or in every episode, and the low policy's episodes last 1000 steps; a fault of the machine
#: does not. Workers that fail together count once, because a lost machine takes all of its workers
#: with it.
FAULTS, FAULT_STEPS = 3, 1000
# Limit for starting a worker: ten times what imports and the worlds of 60 robots took on a core
# shared by ten processes.
_START_SECONDS = 600.0


@dataclass(frozen=True)
class Fault:
    """A worker's failure, after which a new worker took its place.

    Attributes:
        worker: its number.
        reason: how it failed, with the worker's traceback if there is one.
        restarts: how often this worker has been restarted so far.
        seed: of the new worker's task, see ``worker_seed``.
    """

    worker: int
    reason: str
    restarts: int
    seed: int

    def __str__(self) -> str:
        return (
            f"{in_one_line(self.reason)}; restarted with seed {self.seed} (restart {self.restarts})"
        )


def worker_seed(seed: int, worker: int, restarts: int = 0) -> int:
    """Seed of one worker's task, below 2**32; it differs after each restart."""
    return int(np.random.SeedSequence([seed, worker, restarts]).generate_state(1)[0])


def without_episodes(state: State) -> State:
    """A worker's state without the episodes under way."""
    under_way = ("episodes", "obs", "returns", "lengths")
    return {key: value for key, value in state.items() if key not in under_way}


class TaskVecEnv(VecEnv):
    """``num_envs`` robots of a task, spread over ``workers`` workers.

    Robots whose episodes ended are reset within ``step``; ``infos`` holds their last observation
    and whether they were truncated, as SB3 expects.

    With ``recover``, a worker that dies, hangs or raises is restarted with a new seed and with what
    its robots had learned when its state was last queried (see ``state_dicts``). The episodes of
    its robots are truncated, with no reward for the step. ``FAULTS`` faults within ``FAULT_STEPS``
    steps are raised all the same.

    Args:
        make_task: picklable, called in each worker.
        num_envs: total number of robots.
        workers: their number; the robots are distributed evenly.
        seed: each worker's seed is derived from it.
        spaces: observation and action space of the task.
        recover: restart workers that fail; otherwise the first fault is raised.
        timeout: s without an answer after which a worker counts as hung. The slowest request is
            building the worlds of 60 robots on terrain: 3 s on one core.
        link: starts a worker; by default a process on this machine.

    Attributes:
        faults: failures recovered from so far; whoever reports them removes them from the list.

    Raises:
        ValueError: fewer robots than workers, no worker, or a timeout that is not positive.
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
        link: MakeLink = ProcessLink,
    ) -> None:
        if not 1 <= workers <= num_envs:
            raise ValueError(f"workers must be 1 to the {num_envs} robots, not {workers}")
        if not timeout > 0.0:
            raise ValueError(f"the workers' timeout must be above 0 s, not {timeout:g}")
        super().__init__(num_envs, *spaces)
        self.timeout = timeout
        self.faults: list[Fault] = []
        self._make_task, self._seed, self._recover = make_task, seed, recover
        self._link = link
        self._arrays = Arrays(num_envs, spaces[0].shape[0], spaces[1].shape[0])
        self._views = self._arrays.views()
        bounds = np.linspace(0, num_envs, workers + 1).astype(int).tolist()
        self._rows = [slice(*ends) for ends in itertools.pairwise(bounds)]
        self._restarts = [0] * workers
        self._broken: dict[int, WorkerError] = {}  # failed, not yet replaced
        self._steps = 0
        self._fault_steps = deque([-FAULT_STEPS] * FAULTS, maxlen=FAULTS)  # of the last faults
        self._links: list[Link] = []
        atexit.register(self.close)  # otherwise the interpreter waits for the workers at exit
        for k in range(workers):
            self._links.append(self._start(k))
        # The first answer of a worker is its state; the last known states are kept.
        states = [self._receive(k, _START_SECONDS) for k in range(workers)]
        if self._broken:
            self.close()
            raise self._broken[min(self._broken)]
        self._states: list[State] = [without_episodes(state) for state in states]
        self._returns = np.zeros(num_envs)
        self._lengths = np.zeros(num_envs, dtype=np.int64)

    # ------------------------------------------------------------------ the workers

    def _start(self, worker: int, state: State | None = None) -> Link:
        seed = worker_seed(self._seed, worker, self._restarts[worker])
        rows = self._rows[worker]
        return self._link(worker, self._arrays, Beginning(self._make_task, rows, seed, state))

    def _replace(self, worker: int, restarts: int, state: State | None = None) -> None:
        """Replace a worker; the caller must wait for the new one's first answer."""
        self._links[worker].end(0.0)
        self._broken.pop(worker, None)
        self._restarts[worker] = restarts
        try:
            self._links[worker] = self._start(worker, state)
        except OSError as error:  # as when memory or processes run out
            self._broken[worker] = WorkerError(f"worker {worker} did not start: {error.strerror}")

    @property
    def worker_pids(self) -> list[int]:
        """Process ids of the workers."""
        return [link.pid for link in self._links]

    def _send(self, word: str) -> None:
        for link in self._links:
            link.send(word)

    def _receive(self, worker: int, timeout: float) -> Any:
        """A worker's answer, or its ``WorkerError``, which is kept until the worker is replaced."""
        if worker not in self._broken:
            try:
                return self._links[worker].receive(timeout)
            except WorkerError as error:
                self._broken[worker] = error
        return self._broken[worker]

    def _receive_all(self) -> list[Any]:
        """Every worker's answer, or its ``WorkerError``.

        Raises:
            WorkerError: one failed, and ``recover`` is off.
        """
        answers = [self._receive(k, self.timeout) for k in range(len(self._links))]
        if self._broken and not self._recover:
            raise self._broken[min(self._broken)]
        return answers

    def _ask(self, word: str) -> list[Any]:
        self._send(word)
        return self._receive_all()

    def _mend(self) -> None:
        """Restart the broken workers; their robots get new observations.

        Raises:
            WorkerError: there were too many faults.
        """
        while self._broken:
            broken = sorted(self._broken.items())
            self._fault_steps.append(self._steps)
            if self._steps - self._fault_steps[0] < FAULT_STEPS:
                raise WorkerError(
                    f"{FAULTS} faults of workers within {FAULT_STEPS} steps; "
                    f"the last one: {broken[-1][1]}"
                )
            for worker, fault in broken:
                restarts = self._restarts[worker] + 1
                self._replace(worker, restarts, self._states[worker])
                seed = worker_seed(self._seed, worker, restarts)
                self.faults.append(Fault(worker, str(fault), restarts, seed))
            for worker, _ in broken:
                self._receive(worker, _START_SECONDS)

    # ------------------------------------------------------------------ SB3's interface

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
        """Make what follows depend on ``state_dicts`` alone, see ``Task``."""
        self._ask("forget")

    def step_async(self, actions: NDArray[np.floating]) -> None:
        self._views["actions"][:] = actions
        self._send("step")

    def step_wait(self) -> Any:
        self._receive_all()
        self._steps += 1
        views, fatal = self._views, None
        if self._broken:
            seen, lost = views["obs"].copy(), np.zeros(self.num_envs, dtype=bool)
            for worker in self._broken:
                lost[self._rows[worker]] = True
            try:
                self._mend()
            except WorkerError as error:  # the step still counts: a checkpoint follows
                fatal = error
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
        if fatal is not None:
            raise fatal
        return views["obs"].copy(), views["rewards"].copy(), done, infos

    def stats(self) -> list[dict[str, float]]:
        """Each worker's sums since the last call (``Task.take_stats``), memory and ``blow_ups``.

        Those of a broken worker are lost.
        """
        return [sums for sums in self._ask("stats") if not isinstance(sums, WorkerError)]

    def state_dicts(self) -> list[State]:
        """Each worker's state, with its robots' last observations and its ``restarts``.

        An environment that loads them continues as this one does after ``forget``, bit for bit. For
        a broken worker it is the last known state, without the episodes under way.
        """
        states = []
        for k, state in enumerate(self._ask("state")):
            if isinstance(state, WorkerError):
                state = self._states[k]
            else:
                self._states[k] = without_episodes(state)
                rows = self._rows[k]
                state |= copies({"returns": self._returns[rows], "lengths": self._lengths[rows]})
            states.append({**state, "restarts": self._restarts[k]})
        return states

    def load_state_dicts(self, states: list[State]) -> None:
        """Continue from the workers' states; where one lacks its episodes, new ones begin.

        Raises:
            ValueError: the states are of another number of workers or robots, or of another
                configuration.
            WorkerError: a worker failed.
        """
        if len(states) != len(self._links):
            raise ValueError(f"states of {len(states)} workers do not fit {len(self._links)}")
        for rows, state in zip(self._rows, states, strict=True):
            robots = rows.stop - rows.start
            returns = state.get("returns", np.zeros(robots))
            if len(returns) != robots:
                raise ValueError(f"a state of {len(returns)} robots does not fit {robots}")
            self._returns[rows] = returns
            self._lengths[rows] = state.get("lengths", 0)
        for k, state in enumerate(states):
            restarts = state.get("restarts", 0)
            if restarts != self._restarts[k]:  # its seed differs
                self._replace(k, restarts)
                self._receive(k, _START_SECONDS)
            self._links[k].send("load", state)
        misfits = self._receive_all()
        if self._broken:
            raise self._broken[min(self._broken)]
        for misfit in filter(None, misfits):
            raise ValueError(f"the state does not fit the configuration: {misfit}")
        self._states = [without_episodes(state) for state in states]

    def close(self) -> None:
        """Stop the workers: the broken ones by force, others by force only after 5 s."""
        atexit.unregister(self.close)
        self._send("close")
        for k, link in enumerate(self._links):
            link.end(timeout=0.0 if k in self._broken else 5.0)

    # SB3 requires these of every VecEnv, but a batched world has no individual environments.
    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        value = None if attr_name == "render_mode" else getattr(self, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError("robots of a batched world have no attributes of their own")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        raise NotImplementedError("robots of a batched world have no methods of their own")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]
