"""What M robots carry from step to step of their episodes in the low policy's MDP."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


class Episodes:
    """Arrays with a row per robot, all zero where an episode begins.

    Attributes:
        elapsed, began: (M,) control steps, and how many there were when the episode began.
        next_push: (M,) ``elapsed`` at the next push.
        crossing: (M,) whether a robot crosses its tile; it has free commands otherwise.
        speed: (M,) m/s of a crossing.
        leaping: (M,) whether a crossing leaps over its trenches.
        follow: (M,) share of the slope under a robot that the pitch of its crossing follows.
        pitch: (M,) rad, that is added to it.
        facing: (M,) rad, heading of a crossing against the bearing of its waypoint.
        waypoint: (M, 2) m in the world, where a crossing leads.
        reached: (M,) whether it got there.
        was_contact: (M, 4) foot contacts at the last step.
        origin: (M, 2) m in the world, corner of the tile; zero on a plane.
    """

    def __init__(self, num_robots: int) -> None:
        m = num_robots
        self.elapsed = np.zeros(m, dtype=np.int64)
        self.began = np.zeros(m, dtype=np.int64)
        self.next_push = np.zeros(m, dtype=np.int64)
        self.crossing = np.zeros(m, dtype=bool)
        self.speed = np.zeros(m)
        self.leaping = np.zeros(m, dtype=bool)
        self.follow = np.zeros(m)
        self.pitch = np.zeros(m)
        self.facing = np.zeros(m)
        self.waypoint = np.zeros((m, 2))
        self.reached = np.zeros(m, dtype=bool)
        self.was_contact = np.zeros((m, 4), dtype=bool)
        self.origin = np.zeros((m, 2))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All of them by name, in place."""
        return vars(self)

    def reset(self, index: NDArray[np.integer]) -> None:
        """Episodes of the robots ``index`` (n,) begin."""
        for array in self.arrays().values():
            array[index] = 0
