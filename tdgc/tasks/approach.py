"""How fast robots come nearer to their goals, from one decision to the next."""

import numpy as np
from numpy.typing import NDArray

from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array


class Approach:
    """The closing speeds of M robots: what two readings of the goal say of the trunk's speed.

    Args:
        loco: the robots.
        seconds: between two decisions.

    Attributes:
        distance: (M,) m from the goal at the last decision.
        speed: (M,) m/s since the decision before it; 0 at the first one of an episode.
    """

    def __init__(self, loco: Locomotion, seconds: float) -> None:
        self._loco, self._seconds = loco, seconds
        self.distance, self.speed = np.zeros((2, loco.num_robots))

    def begin(self, index: NDArray[np.integer], goal: Array) -> None:
        """Start over for the robots ``index`` (n,); ``goal`` (M, 2) m in the world."""
        self.distance[index], self.speed[index] = self._measure(goal)[index], 0.0

    def measure(self, goal: Array) -> None:
        """The distance at the next decision."""
        now = self._measure(goal)
        self.speed[:], self.distance[:] = (self.distance - now) / self._seconds, now

    def _measure(self, goal: Array) -> Array:
        position = self._loco.world.state.position[:, :2]
        return np.asarray(np.linalg.norm(goal - position, axis=1))
