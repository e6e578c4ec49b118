"""The geometric cue: heights of the ground around the robot, exact or as a sensor has them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array
from tdgc.sim.sensors import Noise

PROBE_RANGE = 0.5  # m, deeper and higher looks the same

#: 32 points (x ahead, y to the left) in m in the heading frame, from a hind foot to three strides
#: ahead, staggered over four lines: an edge across the way is found to 5 cm, and a pillar on it,
#: 20 cm wide at least, meets a probe.
PROBES: Array = np.array([(0.05 * i - 0.25, (0.1, -0.3, 0.3, -0.1)[i % 4]) for i in range(32)])


def height_probes(loco: Locomotion) -> Array:
    """Ground under ``PROBES`` against where a standing robot's ground would be, (M, 32) m."""
    state = loco.world.state
    c, s = np.cos(state.yaw)[:, None], np.sin(state.yaw)[:, None]
    x = state.position[:, :1] + c * PROBES[:, 0] - s * PROBES[:, 1]
    y = state.position[:, 1:2] + s * PROBES[:, 0] + c * PROBES[:, 1]
    standing = state.position[:, 2:3] - loco.robot.base_height
    return np.clip(loco.world.ground_height(x, y) - standing, -PROBE_RANGE, PROBE_RANGE)


class HeightProbes:
    """What M robots read from their probes, decision by decision.

    With noise each height is off by up to ``noise_probes`` m, and a share ``probe_delay`` of the
    robots, drawn for each episode, reads what was measured a decision ago.

    Args:
        loco: the robots.
        noise: of the sensor; None for an exact one.

    Attributes:
        measured: (2, M, 32) m, at this decision and at the one before.
        late: (M,) which robots read a decision late.
    """

    def __init__(self, loco: Locomotion, noise: Noise | None) -> None:
        self._loco, self._noise = loco, noise
        self.measured = np.zeros((2, loco.num_robots, len(PROBES)))
        self.late = np.zeros(loco.num_robots, dtype=bool)

    def begin(self, index: NDArray[np.integer]) -> None:
        """Episodes of the robots ``index`` (n,) begin: nothing was measured before."""
        if self._noise is not None:
            late = self._noise.draws.uniform(0.0, 1.0, (len(index),))
            config = self._noise.config
            self.late[index] = late < config.scale * config.probe_delay
        self.measured[:, index] = self._measure(index)

    def measure(self) -> None:
        """Look at the ground for the coming decision."""
        now = self._measure(np.arange(len(self.late)))
        self.measured = np.stack([now, self.measured[0]])

    def read(self) -> Array:
        """Heights as ``height_probes`` gives them, (M, 32) m, with the sensor's errors."""
        return np.where(self.late[:, None], self.measured[1], self.measured[0])

    def _measure(self, index: NDArray[np.integer]) -> Array:
        heights = height_probes(self._loco)[index]
        if self._noise is not None:
            width = self._noise.config.noise_probes
            heights = heights + self._noise.draw(width, heights.shape)
        return np.clip(heights, -PROBE_RANGE, PROBE_RANGE)
