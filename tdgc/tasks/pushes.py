"""Random pushes in training: sudden changes of a trunk's horizontal velocity."""

import numpy as np
from numpy.typing import NDArray

from tdgc.config import RandomisationConfig
from tdgc.sim.robot import Array
from tdgc.sim.world import World


class Pushes:
    """Random pushes of M robots.

    Args:
        config: strength and interval of the pushes.
        rng: source of randomness.
        step_seconds: s between two steps of the task.
        due: (M,) step of its episode at which each robot is pushed next, changed in place; an
            integer array rounds intervals down to whole steps.
    """

    def __init__(
        self,
        config: RandomisationConfig,
        rng: np.random.Generator,
        step_seconds: float,
        due: NDArray[np.integer] | Array,
    ) -> None:
        self._config, self._rng, self._step_seconds = config, rng, step_seconds
        self._due = due

    def schedule(self, index: NDArray[np.integer], elapsed: NDArray[np.integer]) -> None:
        """Draw when the robots ``index`` (n,) are pushed next; ``elapsed`` (M,) steps so far."""
        wait = self._rng.uniform(*self._config.push_interval, len(index)) / self._step_seconds
        self._due[index] = elapsed[index] + np.maximum(1.0, wait).astype(self._due.dtype)

    def push(self, world: World, elapsed: NDArray[np.integer], width: Array) -> None:
        """Push the robots that are due; ``width`` (M,) scales speeds as ``config.scale`` does."""
        index = np.flatnonzero(elapsed >= self._due)
        if not index.size:
            return
        angle = self._rng.uniform(-np.pi, np.pi, index.size)
        top = self._config.scale * self._config.push_speed * width[index]
        speed = top * self._rng.uniform(size=index.size)
        velocity = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
        world.push(index, speed[:, None] * velocity)
        self.schedule(index, elapsed)
