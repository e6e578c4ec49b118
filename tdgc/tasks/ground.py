"""The ground under M robots, for the low policy's rewards, critic and crossings."""

from dataclasses import dataclass

import numpy as np

from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array, to_world

#: Where the ground is probed: 5 x 3 points (x ahead, y to the left) in m in the heading frame, from
#: the tail to one step ahead.
GROUND_PROBES = np.array([(x, y) for x in (-0.3, -0.1, 0.1, 0.3, 0.5) for y in (0.15, 0.0, -0.15)])


@dataclass(frozen=True, eq=False)
class Ground:
    """Heights in m of M robots above the ground, and of the ground around them.

    On the support surface trenches are filled, so a foot that swings over a trench does not count
    as half a metre too high.

    Attributes:
        base: (M,) trunk above the support surface under the hips.
        feet: (M, 4) foot centres above the support surface.
        probes: (M, 15) ground at ``GROUND_PROBES``, relative to the ground of a robot that stands
            with its trunk at the same height.
    """

    base: Array
    feet: Array
    probes: Array

    def slope(self) -> Array:
        """Slope of the ground along each heading, uphill positive, (M,) rad."""
        x = GROUND_PROBES[:, 0]
        arm = x - x.mean()
        return np.arctan(self.probes @ arm / (arm @ arm))


def measure_ground(loco: Locomotion) -> Ground:
    """Measure the ground under the robots in their current state."""
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
