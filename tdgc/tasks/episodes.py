"""Per-robot state that persists from step to step of an episode in the low policy's MDP."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


class Episodes:
    """Arrays with one row per robot, zeroed when an episode begins; checkpoints store them by name.

    Args:
        num_robots: M.
        memory: number of control steps for which tilts are kept.
    """

    def __init__(self, num_robots: int, memory: int) -> None:
        m = num_robots
        self.elapsed = np.zeros(m, dtype=np.int64)  # control steps
        self.began = np.zeros(m, dtype=np.int64)  # ``elapsed`` at the start of the episode
        self.next_push = np.zeros(m, dtype=np.int64)  # ``elapsed`` at the next push
        self.was_contact = np.zeros((m, 4), dtype=bool)  # foot contact at the previous step
        # x and y of gravity in the trunk's frame, newest first; before the episode: upright.
        self.tilts = np.zeros((m, memory, 2))
        self.origin = np.zeros((m, 2))  # m in the world, origin of the tile
        self.crossing = np.zeros(m, dtype=bool)  # crosses its tile; otherwise its commands are free
        self.retried = np.zeros(m, dtype=bool)  # its command is one that a robot fell at
        # For crossings only:
        self.waypoint = np.zeros((m, 2))  # m in the world
        self.reached = np.zeros(m, dtype=bool)
        self.speed = np.zeros(m)  # m/s
        self.facing = np.zeros(m)  # rad, heading relative to the bearing of the waypoint
        self.pitch = np.zeros(m)  # rad, nose down
        self.follow = np.zeros(m)  # share of the ground's slope that the pitch follows
        self.leaping = np.zeros(m, dtype=bool)  # leaps over trenches

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All arrays by name, not copied."""
        return vars(self)

    def reset(self, index: NDArray[np.integer]) -> None:
        """Start new episodes for the robots ``index`` (n,)."""
        for array in self.arrays().values():
            array[index] = 0
