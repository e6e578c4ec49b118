"""The critic's own part of the low policy's observation; the actor never sees it."""

from __future__ import annotations

import numpy as np

from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array
from tdgc.tasks.ground import GROUND_PROBES, Ground
from tdgc.tasks.rewards import CONTACT_FORCE

_PROBE_SWAP = tuple(3 * (i // 3) + 2 - i % 3 for i in range(len(GROUND_PROBES)))
CRITIC_LAYOUT = (
    ("velocity", 3),
    ("angular_velocity", 3),
    ("base_height", 1),
    ("foot_height", 4),
    ("foot_contact", 4),
    ("desired_contact", 4),
    ("dynamics", 6),
    ("terrain", len(GROUND_PROBES)),
)
CRITIC_MIRRORS: dict[str, tuple[tuple[int, ...], tuple[float, ...]]] = {
    "velocity": ((0, 1, 2), (1.0, -1.0, 1.0)),
    "angular_velocity": ((0, 1, 2), (-1.0, 1.0, -1.0)),
    "base_height": ((0,), (1.0,)),
    "foot_height": ((1, 0, 3, 2), (1.0,) * 4),
    "foot_contact": ((1, 0, 3, 2), (1.0,) * 4),
    "desired_contact": ((1, 0, 3, 2), (1.0,) * 4),
    "dynamics": ((0, 1, 2, 3, 4, 5), (1.0,) * 6),
    "terrain": (_PROBE_SWAP, (1.0,) * len(GROUND_PROBES)),
}


def observe_critic(loco: Locomotion, ground: Ground) -> Array:
    state = loco.world.state
    body_rate = np.einsum("mji,mj->mi", state.rotation, state.ang_vel)
    dynamics = [
        loco.friction,
        loco.payload / 3.0,
        5.0 * (loco.world.strength[:, 0] - 1.0),
        loco.delay / 0.03,
        100.0 * loco.armature,
        5.0 * loco.world.joint_friction[:, 0],
    ]
    return np.concatenate(
        [
            2.0 * state.heading_vel,
            0.25 * body_rate,
            10.0 * (ground.base - loco.robot.base_height)[:, None],
            10.0 * ground.feet,
            state.foot_force > CONTACT_FORCE,
            loco.clock.contact,
            np.stack(dynamics, axis=1),
            5.0 * np.clip(ground.probes, -0.5, 0.5),
        ],
        axis=1,
    )
