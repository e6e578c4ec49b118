"""How fast robots close in on their goals, from one decision to the next."""

import numpy as np
from numpy.typing import NDArray

from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array, to_goal


class Approach:
    """Closing speeds of M robots, from their distances to the goal at successive decisions.

    Args:
        loco: the robots.
        seconds: time between two decisions, s.

    Attributes:
        distance: (M,) m to the goal at the latest decision.
        speed: (M,) m/s towards the goal since the decision before; 0 at the start of an episode.
    """

    def __init__(self, loco: Locomotion, seconds: float) -> None:
        self._loco, self._seconds = loco, seconds
        self.distance, self.speed = np.zeros((2, loco.num_robots))

    def begin(self, index: NDArray[np.integer], goal: Array) -> None:
        """Start new episodes for the robots ``index`` (n,); ``goal`` (M, 2) m in the world."""
        self.distance[index], self.speed[index] = self._measure(goal)[index], 0.0

    def measure(self, goal: Array) -> None:
        """Update distances and speeds, once per decision."""
        now = self._measure(goal)
        self.speed[:], self.distance[:] = (self.distance - now) / self._seconds, now

    def _measure(self, goal: Array) -> Array:
        return to_goal(self._loco.world.state, goal)[0]
