"""What M robots carry from step to step of their episodes in the low policy's MDP."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


class Episodes:
    """Arrays with a row per robot, all zero where an episode begins; checkpoints hold them by
    name.

    Args:
        num_robots: M.
        memory: control steps that tilts are remembered for.
    """

    def __init__(self, num_robots: int, memory: int) -> None:
        m = num_robots
        self.elapsed = np.zeros(m, dtype=np.int64)  # control steps
        self.began = np.zeros(m, dtype=np.int64)  # ``elapsed`` at the first step
        self.next_push = np.zeros(m, dtype=np.int64)  # ``elapsed`` at the next push
        self.was_contact = np.zeros((m, 4), dtype=bool)  # of the feet, at the last step
        # x and y of gravity in the trunk's frame, newest first; before an episode it stood upright.
        self.tilts = np.zeros((m, memory, 2))
        self.origin = np.zeros((m, 2))  # m in the world, corner of the tile
        self.crossing = np.zeros(m, dtype=bool)  # the others have free commands
        self.retried = np.zeros(m, dtype=bool)  # those that another robot fell at
        # Of a crossing:
        self.waypoint = np.zeros((m, 2))  # m in the world
        self.reached = np.zeros(m, dtype=bool)
        self.speed = np.zeros(m)  # m/s
        self.facing = np.zeros(m)  # rad, heading against the bearing of the waypoint
        self.pitch = np.zeros(m)  # rad, nose down
        self.follow = np.zeros(m)  # share of the slope under the robot that pitch follows besides
        self.leaping = np.zeros(m, dtype=bool)  # over trenches

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All of them by name, in place."""
        return vars(self)

    def reset(self, index: NDArray[np.integer]) -> None:
        """Episodes of the robots ``index`` (n,) begin."""
        for array in self.arrays().values():
            array[index] = 0
