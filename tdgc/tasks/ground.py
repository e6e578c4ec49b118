"""The ground under M robots, as the low policy's rewards, critic and crossings see it."""

from dataclasses import dataclass

import numpy as np

from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array, to_world

#: Where the ground is probed: 5 x 3 points (x ahead, y to the left) in m in the heading frame, from
#: the tail to a step ahead.
GROUND_PROBES = np.array([(x, y) for x in (-0.3, -0.1, 0.1, 0.3, 0.5) for y in (0.15, 0.0, -0.15)])


@dataclass(frozen=True, eq=False)
class Ground:
    """Heights in m. The support surface has its trenches filled: a foot on its way over one is not
    half a metre too high.

    Attributes:
        base: (M,) trunk above the support surface under the hips.
        feet: (M, 4) foot centres above the support surface.
        probes: (M, 15) ground at ``GROUND_PROBES`` against where a standing robot's would be.
    """

    base: Array
    feet: Array
    probes: Array

    def slope(self) -> Array:
        """Angle of the ground along the headings, uphill positive, (M,) rad."""
        x = GROUND_PROBES[:, 0]
        arm = x - x.mean()
        return np.arctan(self.probes @ arm / (arm @ arm))


def measure_ground(loco: Locomotion) -> Ground:
    """The ground under the robots as they are now."""
    world, state = loco.world, loco.world.state
    points = np.concatenate([GROUND_PROBES, state.geometry.hips])
    x, y = to_world(state.position[:, :2], state.yaw, points)
    n = len(GROUND_PROBES)
    support = world.support_height(
        np.concatenate([x[:, n:], state.foot_position[..., 0]], axis=1),
        np.concatenate([y[:, n:], state.foot_position[..., 1]], axis=1),
    )
    standing = state.position[:, 2:3] - loco.robot.base_height
    return Ground(
        base=state.position[:, 2] - support[:, :4].mean(axis=1),
        feet=state.foot_position[..., 2] - support[:, 4:],
        probes=world.ground_height(x[:, :n], y[:, :n]) - standing,
    )
