"""The geometric cue: ground heights around the robot, exact or with a sensor's errors."""

import numpy as np
from numpy.typing import NDArray

from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array, to_world
from tdgc.sim.sensors import Noise

PROBE_RANGE = 0.5  # m, heights are clipped to this either way

_AHEAD = [(0.1 + 0.05 * i, 0.0) for i in range(20)]
_FURTHER = _AHEAD[:14] + [(0.825 + 0.075 * i, 0.0) for i in range(6)]
_ASIDE = [(0.2 * i - 0.1, side * (0.2, 0.4)[i % 2]) for i in range(6) for side in (1.0, -1.0)]
#: Layouts of the probes: 32 points (x ahead, y to the left) in m in the heading frame. ``graded``
#: is symmetric left to right. Straight ahead it locates an edge across the way to within 5 cm near
#: the robot, where leaps are timed, and to within 7.5 cm further on, up to 1.2 m: a leaping robot
#: needs that distance to get into its stride (docs/experiments.md). Its lines of probes are 20 cm
#: apart, so that no pillar, at least 20 cm wide, slips between them as they sweep over the ground.
#: They extend beside the trunk, too: a robot that leans on a pillar has to know where it is.
#: ``lines``, every 5 cm straight ahead, and ``staggered`` are for policies trained with them.
PROBES: dict[str, Array] = {
    "graded": np.array(_FURTHER + _ASIDE),
    "lines": np.array(_AHEAD + _ASIDE),
    "staggered": np.array([(0.05 * i - 0.25, (0.1, -0.3, 0.3, -0.1)[i % 4]) for i in range(32)]),
}
NUM_PROBES = 32
#: Index of each probe's left-right mirror image, in ``graded`` and in ``lines``.
PROBE_SWAP = (*range(20), *(20 + i + (1, -1)[i % 2] for i in range(12)))


def height_probes(loco: Locomotion, points: Array) -> Array:
    """Heights of the ground at ``points`` (n, 2) m, one of ``PROBES``, relative to the ground of a
    robot that stands with its trunk at the same height, (M, n) m."""
    state = loco.world.state
    x, y = to_world(state.position[:, :2], state.yaw, points)
    standing = state.position[:, 2:3] - loco.robot.base_height
    return np.clip(loco.world.ground_height(x, y) - standing, -PROBE_RANGE, PROBE_RANGE)


class HeightProbes:
    """Probe readings of M robots, updated at each decision.

    With noise, each height is off by up to ``noise_probes`` m, and a share ``probe_delay`` of the
    robots, drawn for each episode, reads the measurements of the decision before; ``scale``
    multiplies both.

    Args:
        loco: the robots.
        points: (32, 2) m, one of ``PROBES``.
        noise: sensor noise; None for an exact sensor.

    Attributes:
        measured: (2, M, 32) m, at this decision and at the one before.
        late: (M,) whether a robot reads one decision late. The policy may observe this, because a
            real scan carries the time at which it was taken.
    """

    def __init__(self, loco: Locomotion, points: Array, noise: Noise | None) -> None:
        self._loco, self._points, self._noise = loco, points, noise
        self.measured = np.zeros((2, loco.num_robots, NUM_PROBES))
        self.late = np.zeros(loco.num_robots, dtype=bool)

    def begin(self, index: NDArray[np.integer]) -> None:
        """Start new episodes for the robots ``index`` (n,), as if they had stood there before."""
        if self._noise is not None:
            late = self._noise.draws.uniform(0.0, 1.0, (len(index),))
            config = self._noise.config
            self.late[index] = late < config.scale * config.probe_delay
        for when in (1, 0):
            self.measured[when, index] = self._measure(index)

    def measure(self) -> None:
        """Measure the ground for the coming decision."""
        now = self._measure(np.arange(len(self.late)))
        self.measured = np.stack([now, self.measured[0]])

    def read(self) -> Array:
        """Heights as in ``height_probes``, (M, 32) m, with the sensor's noise and delay."""
        return np.where(self.late[:, None], self.measured[1], self.measured[0])

    def _measure(self, index: NDArray[np.integer]) -> Array:
        heights = height_probes(self._loco, self._points)[index]
        if self._noise is not None:
            width = self._noise.config.noise_probes
            heights = heights + self._noise.draw(width, heights.shape)
        return np.clip(heights, -PROBE_RANGE, PROBE_RANGE)
