"""Sensor noise, drawn in training and in the evaluation's ``noise`` condition."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from tdgc.config import RandomisationConfig
from tdgc.sim.robot import Array


class EpisodeDraws:
    """Draws for M robots, each from a generator of its own.

    The errors of an episode thus depend on its seed alone, not on the robots simulated beside it.

    Args:
        seeds: seeds of the M generators.
    """

    def __init__(self, seeds: Iterable[Sequence[int]]) -> None:
        self._generators = [np.random.default_rng(seed) for seed in seeds]

    def uniform(self, low: float, high: float, size: tuple[int, ...]) -> Array:
        """Uniform values of shape ``size``, (M, ...)."""
        return np.stack([g.uniform(low, high, size[1:]) for g in self._generators])


@dataclass(frozen=True, eq=False)
class Noise:
    """Sensor errors: their widths, and the source they are drawn from."""

    config: RandomisationConfig
    draws: np.random.Generator | EpisodeDraws

    def draw(self, width: float, shape: tuple[int, ...]) -> Array:
        """Draw errors of shape ``shape``, (M, ...), uniform within +-``width`` times the config's
        scale."""
        return self.config.scale * width * self.draws.uniform(-1.0, 1.0, shape)
