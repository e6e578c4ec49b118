"""What the low policy's networks observe; the critic also sees the true state and the ground."""

from typing import TYPE_CHECKING, NamedTuple

import gymnasium as gym
import numpy as np

from tdgc.config import LowLevelConfig
from tdgc.sim.locomotion import GYRO_SCALE, Locomotion, actor_layout
from tdgc.sim.observation import (
    JOINT_FLIP,
    LEG_FLIP,
    RATE_FLIP,
    VECTOR_FLIP,
    Flip,
    Term,
    mirror,
    width,
)
from tdgc.sim.robot import NUM_JOINTS, Array
from tdgc.tasks.ground import GROUND_PROBES, Ground

if TYPE_CHECKING:
    from tdgc.policies import Mirror


class CriticSources(NamedTuple):
    """The sources of the critic's own terms."""

    loco: Locomotion
    ground: Ground


def _dynamics(seen: CriticSources) -> Array:
    """The randomised dynamics, (M, 6), each scaled to be of order one."""
    loco, world = seen.loco, seen.loco.world
    return np.stack(
        [
            world.friction,
            world.payload / 3.0,
            5.0 * (world.strength[:, 0] - 1.0),
            loco.delay / 0.03,
            100.0 * world.armature,
            5.0 * world.joint_friction[:, 0],
        ],
        axis=1,
    )


_PROBE_SWAP = tuple(3 * (i // 3) + 2 - i % 3 for i in range(len(GROUND_PROBES)))
_PROBES = Flip(_PROBE_SWAP, (1.0,) * len(GROUND_PROBES))
#: The critic's own part of the observation, which the actor never sees. The scales of velocities
#: and terrain are those of Walk These Ways; the other heights are scaled to be of order one.
CRITIC_LAYOUT: tuple[Term[CriticSources], ...] = (
    Term("velocity", 3, lambda s: s.loco.world.state.heading_vel, 2.0, mirror=VECTOR_FLIP),
    Term(
        "angular_velocity", 3, lambda s: s.loco.world.state.body_rate, GYRO_SCALE, mirror=RATE_FLIP
    ),
    Term("base_height", 1, lambda s: (s.ground.base - s.loco.robot.base_height)[:, None], 10.0),
    Term("foot_height", 4, lambda s: s.ground.feet, 10.0, mirror=LEG_FLIP),
    Term("foot_contact", 4, lambda s: s.loco.world.state.touching, mirror=LEG_FLIP),
    Term("desired_contact", 4, lambda s: s.loco.clock.contact, mirror=LEG_FLIP),
    Term("dynamics", 6, _dynamics),
    Term("terrain", 15, lambda s: np.clip(s.ground.probes, -0.5, 0.5), 5.0, mirror=_PROBES),
)


def low_spaces(config: LowLevelConfig) -> tuple[gym.spaces.Box, gym.spaces.Box]:
    """Observation space, [actor part | critic part], and action space of the low policy."""
    size = width(actor_layout(config.robot, config.gyro)) + width(CRITIC_LAYOUT)
    limit = config.robot.action_limit
    seen = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
    return seen, gym.spaces.Box(-limit, limit, (NUM_JOINTS,), np.float32)


def low_mirror(config: LowLevelConfig) -> "Mirror":
    """Left-right mirror of the low policy's observations and actions."""
    from tdgc.policies import Mirror  # here, so that the low policy's workers need no PyTorch

    return Mirror(*mirror((*actor_layout(config.robot, config.gyro), *CRITIC_LAYOUT)), *JOINT_FLIP)
