"""The geometric cue: heights of the ground around the robot, exact or as a sensor has them."""

import numpy as np
from numpy.typing import NDArray

from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array, to_world
from tdgc.sim.sensors import Noise

PROBE_RANGE = 0.5  # m, deeper and higher looks the same

_AHEAD = [(0.1 + 0.05 * i, 0.0) for i in range(20)]
_FURTHER = _AHEAD[:14] + [(0.825 + 0.075 * i, 0.0) for i in range(6)]
_ASIDE = [(0.2 * i - 0.1, side * (0.2, 0.4)[i % 2]) for i in range(6) for side in (1.0, -1.0)]
#: Where the probes are: 32 points (x ahead, y to the left) in m in the heading frame. Those of
#: ``graded`` are the same on both sides. Ahead of the feet an edge across the way is found to 5 cm,
#: where a leap is timed, and to 7.5 cm further on, up to 1.2 m: a robot that leaps needs that much
#: to get into its stride (docs/experiments.md). No pillar, 20 cm wide at least, slips between lines
#: 20 cm apart as they sweep over the ground, beside the trunk, too: who leans on one has to know
#: where it is. Earlier policies looked along ``lines`` of 5 cm, and the first along ``staggered``.
PROBES: dict[str, Array] = {
    "graded": np.array(_FURTHER + _ASIDE),
    "lines": np.array(_AHEAD + _ASIDE),
    "staggered": np.array([(0.05 * i - 0.25, (0.1, -0.3, 0.3, -0.1)[i % 4]) for i in range(32)]),
}
NUM_PROBES = 32
#: Which of ``graded``, or of ``lines``, is each one's mirror image.
PROBE_SWAP = (*range(20), *(20 + i + (1, -1)[i % 2] for i in range(12)))


def height_probes(loco: Locomotion, points: Array) -> Array:
    """Ground under the robots' ``points`` (n, 2) m, one of ``PROBES``, against where a standing
    robot's ground would be, (M, n) m."""
    state = loco.world.state
    x, y = to_world(state.position[:, :2], state.yaw, points)
    standing = state.position[:, 2:3] - loco.robot.base_height
    return np.clip(loco.world.ground_height(x, y) - standing, -PROBE_RANGE, PROBE_RANGE)


class HeightProbes:
    """What M robots read from their probes, decision by decision.

    With noise each height is off by up to ``noise_probes`` m, and a share ``probe_delay`` of the
    robots, drawn for each episode, reads what was measured a decision ago.

    Args:
        loco: the robots.
        points: (32, 2) m, one of ``PROBES``.
        noise: of the sensor; None for an exact one.

    Attributes:
        measured: (2, M, 32) m, at this decision and at the one before.
        late: (M,) which robots read a decision late. They are told so: a scan carries the time at
            which it was taken.
    """

    def __init__(self, loco: Locomotion, points: Array, noise: Noise | None) -> None:
        self._loco, self._points, self._noise = loco, points, noise
        self.measured = np.zeros((2, loco.num_robots, NUM_PROBES))
        self.late = np.zeros(loco.num_robots, dtype=bool)

    def begin(self, index: NDArray[np.integer]) -> None:
        """Episodes of the robots ``index`` (n,) begin: they stood there a decision ago, too."""
        if self._noise is not None:
            late = self._noise.draws.uniform(0.0, 1.0, (len(index),))
            config = self._noise.config
            self.late[index] = late < config.scale * config.probe_delay
        for when in (1, 0):
            self.measured[when, index] = self._measure(index)

    def measure(self) -> None:
        """Look at the ground for the coming decision."""
        now = self._measure(np.arange(len(self.late)))
        self.measured = np.stack([now, self.measured[0]])

    def read(self) -> Array:
        """Heights as ``height_probes`` gives them, (M, 32) m, with the sensor's errors."""
        return np.where(self.late[:, None], self.measured[1], self.measured[0])

    def _measure(self, index: NDArray[np.integer]) -> Array:
        heights = height_probes(self._loco, self._points)[index]
        if self._noise is not None:
            width = self._noise.config.noise_probes
            heights = heights + self._noise.draw(width, heights.shape)
        return np.clip(heights, -PROBE_RANGE, PROBE_RANGE)
