"""Several tasks in one worker, combined into one task.

Some robots can then be on a plane, where a control step costs less than half as much, and others
on terrain.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tdgc.parallel.worker import Task
from tdgc.state import State


class TaskGroup:
    """Several tasks as one ``tdgc.parallel.worker.Task``, their robots in the order of the tasks.

    Args:
        tasks: all with the same observation space and action space.
    """

    def __init__(self, tasks: Sequence[Task]) -> None:
        self.tasks = list(tasks)
        bounds = [0, *itertools.accumulate(task.num_robots for task in tasks)]
        self.num_robots = bounds[-1]
        self._rows = [slice(*ends) for ends in itertools.pairwise(bounds)]

    def reset(self, index: NDArray[np.integer]) -> None:
        """Start new episodes for the robots ``index`` (n,)."""
        for task, rows in zip(self.tasks, self._rows, strict=True):
            mine = index[(index >= rows.start) & (index < rows.stop)] - rows.start
            if mine.size:
                task.reset(mine)

    def step(
        self, actions: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
        """Step all robots: (M, n) -> reward, terminated, truncated, (M,) each."""
        steps = [t.step(actions[rows]) for t, rows in zip(self.tasks, self._rows, strict=True)]
        reward, terminated, truncated = (
            np.concatenate(parts) for parts in zip(*steps, strict=True)
        )
        return reward, terminated, truncated

    def observe(self) -> NDArray[np.float32]:
        """Observations of all robots, (M, n)."""
        return np.concatenate([task.observe() for task in self.tasks])

    def restart(self) -> None:
        """End every episode and rebuild the worlds."""
        for task in self.tasks:
            task.restart()

    def forget(self) -> None:
        """Make what follows depend on ``state_dict`` alone."""
        for task in self.tasks:
            task.forget()

    def take_stats(self) -> dict[str, float]:
        """Statistics, summed over the tasks."""
        stats: dict[str, float] = {}
        for task in self.tasks:
            for key, value in task.take_stats().items():
                stats[key] = stats.get(key, 0.0) + value
        return stats

    def state_dict(self) -> State:
        """State of all tasks: random generators, episodes and the rest, each as a list."""
        states = [task.state_dict() for task in self.tasks]
        return {
            "rng": [state.pop("rng") for state in states],
            "episodes": [state.pop("episodes") for state in states],
            "tasks": states,
        }

    def load_state_dict(self, state: State) -> None:
        """Continue from a ``state_dict``; without ``episodes`` in it, new ones begin.

        Raises:
            ValueError: the state has another number of tasks.
        """
        if len(state["tasks"]) != len(self.tasks):
            raise ValueError(f"a state of {len(state['tasks'])} tasks, not {len(self.tasks)}")
        for k, task in enumerate(self.tasks):
            own = {**state["tasks"][k], "rng": state["rng"][k]}
            if "episodes" in state:
                own["episodes"] = state["episodes"][k]
            task.load_state_dict(own)

    def close(self) -> None:
        """Disconnect from Bullet."""
        for task in self.tasks:
            task.close()
