"""Stand-ins. Worker processes of tests import this file, so it imports little."""

import contextlib
import os
import resource
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from tdgc.parallel.worker import Arrays, Beginning, Worker
from tdgc.sim.robot import Array
from tdgc.state import State

# Actions by which a robot makes its task fail.
RAISE, DIE, HANG, NAN_SEEN, NAN_EARNED, INFINITE, FAR = range(2, 9)


class Fragile:
    """A task whose robots observe their number, the level, their steps and a random number.

    It has no memory beyond its state, so ``forget`` only counts its calls. The level rises
    with each step of the task and stands for what a task learns, such as a curriculum. The random
    number is drawn at each restart. A robot's reward is its action.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)
    action_space = gym.spaces.Box(-9.0, 9.0, (1,), np.float32)

    def __init__(self, robots: int, seed: int, first: int = 0) -> None:
        self.num_robots = robots
        self.rng = np.random.default_rng(seed)
        self.level, self.restarts, self.forgot = 0, 0, 0
        self.restart()

    def reset(self, index: Any) -> None:
        self.steps[index] = 0
        self.action[index] = 0.0

    def step(self, actions: Any) -> tuple[Array, Any, Any]:
        self.action = actions[:, 0].astype(np.float64)
        if (self.action == RAISE).any():
            raise ValueError("the ground is gone")
        if (self.action == DIE).any():
            os.kill(os.getpid(), signal.SIGKILL)
        if (self.action == HANG).any():
            time.sleep(1e6)
        self.steps += 1
        self.level += 1
        reward = self.action.copy()
        reward[self.action == NAN_EARNED] = np.nan
        terminated = (self.action == NAN_SEEN) | (self.action == FAR)
        return reward, terminated, np.zeros(self.num_robots, dtype=bool)

    def observe(self) -> Any:
        ones = np.ones(self.num_robots)
        parts = [np.arange(self.num_robots), self.level * ones, self.steps, self.drawn * ones]
        obs = np.stack(parts, axis=1).astype(np.float32)
        for action, value in ((NAN_SEEN, np.nan), (INFINITE, -np.inf), (FAR, 1e6)):
            obs[self.action == action, 2] = value
        return obs

    def restart(self) -> None:
        self.restarts += 1
        self.drawn = self.rng.uniform()
        self.steps = np.zeros(self.num_robots)
        self.action = np.zeros(self.num_robots)

    def take_stats(self) -> dict[str, float]:
        return {"restarts": float(self.restarts), "forgot": float(self.forgot)}

    def forget(self) -> None:
        self.forgot += 1

    def state_dict(self) -> State:
        episodes = {"steps": self.steps.copy(), "drawn": self.drawn}
        return {"rng": self.rng.bit_generator.state, "level": self.level, "episodes": episodes}

    def load_state_dict(self, state: State) -> None:
        self.rng.bit_generator.state = state["rng"]
        self.level = state["level"]
        if "episodes" not in state:
            self.restart()
            return
        self.steps = state["episodes"]["steps"].copy()
        self.drawn = state["episodes"]["drawn"]

    def close(self) -> None:
        pass


class Counter:
    """A task in which robot i ends every i + 2 steps: terminated if i is even, else truncated.

    A robot observes its number, the steps of its episode, and its last reward, which is the sum of
    its actions.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, robots: int, seed: int, fails: str = "", first: int = 0) -> None:
        if fails == "start":
            raise RuntimeError("no robot to be had")
        self.num_robots, self.seed, self.fails = robots, seed, fails
        self.steps = np.zeros(robots)
        self.sums = np.zeros(robots)
        self.worlds = 0
        self.rng = np.random.default_rng(seed)

    def reset(self, index: Any) -> None:
        self.steps[index] = self.sums[index] = 0.0

    def step(self, actions: Any) -> tuple[Array, Any, Any]:
        if self.fails == "step" and actions[0, 0] == 1.0:
            raise ValueError("the ground is gone")
        self.steps += 1
        self.sums = actions.sum(axis=1, dtype=np.float64)
        number = np.arange(self.num_robots)
        done = self.steps >= number + 2
        return self.sums.copy(), done & (number % 2 == 0), done & (number % 2 == 1)

    def observe(self) -> Any:
        number = np.arange(self.num_robots)
        return np.stack([number, self.steps, self.sums], axis=1).astype(np.float32)

    def restart(self) -> None:
        self.worlds += 1
        self.reset(np.arange(self.num_robots))

    def take_stats(self) -> dict[str, float]:
        return {"robots": float(self.num_robots), "worlds": float(self.worlds)}

    def forget(self) -> None:
        pass

    def state_dict(self) -> State:
        rng, episodes = self.rng.bit_generator.state, {"steps": self.steps.copy()}
        return {"seed": self.seed, "worlds": self.worlds, "rng": rng, "episodes": episodes}

    def load_state_dict(self, state: State) -> None:
        self.worlds = state["worlds"]
        if "episodes" in state:
            self.steps = state["episodes"]["steps"].copy()
        else:
            self.restart()

    def close(self) -> None:
        pass


def make_counter(robots: int, seed: int, first: int = 0) -> Counter:
    return Counter(robots, seed)


def make_failing(where: str, robots: int, seed: int, first: int = 0) -> Counter:
    return Counter(robots, seed, fails=where)


class InlineLink:
    """A worker in this process, as ``ProcessLink`` without a process, which takes seconds to import
    PyTorch. What a task raises is raised here."""

    pid = os.getpid()

    def __init__(self, worker: int, arrays: Arrays, beginning: Beginning) -> None:
        self._worker = Worker(arrays.views(beginning.rows), beginning)
        self._answer: Any = self._worker.task.state_dict()

    def send(self, word: str, argument: Any = None) -> None:
        if word != "close":
            self._answer = self._worker.answer(word, argument)

    def receive(self, timeout: float) -> Any:
        return self._answer

    def end(self, timeout: float) -> None:
        self._worker.task.close()


def double(number: int) -> int:
    if number < 0:
        raise ValueError("a negative number")
    return 2 * number


def die(number: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def no_task(config: Any, robots: int, seed: int, first: int) -> Any:
    raise RuntimeError(f"no robots today, not even {robots}")


def in_this_process(work: Callable[[Any], Any], jobs: Sequence[Any], workers: int) -> Iterator[Any]:
    """As ``run_jobs``, without processes, which take seconds to import PyTorch."""
    return map(work, jobs)


@contextlib.contextmanager
def no_file_larger_than(size: int) -> Iterator[None]:
    """Make writes beyond ``size`` bytes of a file fail, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
