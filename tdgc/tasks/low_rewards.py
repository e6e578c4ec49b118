"""The low policy's reward terms (Sec. IV-A), each a pure function on arrays of M robots.

They are the terms of Walk These Ways that the paper names or needs. A term returns the raw
quantity, (M,); its sign and weight come from ``LowRewardConfig``. ``total`` combines them as Walk
These Ways does, so that a good gait multiplies the tracking reward:

    R = dt * (sum of positive terms) * exp(sum of negative terms)
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from tdgc.config import LowRewardConfig
from tdgc.sim.commands import INDEX, default_command
from tdgc.sim.geometry import FRONT, SIDE
from tdgc.sim.robot import Array, RobotState, foot_travel

_STANCE = [INDEX["stance_length"], INDEX["stance_width"]]


@dataclass
class LowStep:
    """Inputs of the low policy's terms for one control step of M robots.

    Attributes:
        state: the robots after the step.
        command: (M, 15).
        phases: (M, 4) warped foot phases; contact: (M, 4) desired contact C; swing: (M, 4)
            profile of the swing.
        base_height: (M,) m, trunk above the support surface under the hips.
        foot_height: (M, 4) m, foot centre above the support surface under it.
        standing_height: m, to which the body height command is added.
        stance: (2,) m, length and width between the footholds at the default commands.
        targets: (3 or more, M, 12) rad, joint targets of this step and the two before.
        actions: (2, M, 12), this action and the one before.
        acceleration: (M, 12) rad/s^2 of the joints over the step.
        last_tilt: (M, 2) x and y of gravity in the trunk's frame one gait cycle ago.
        was_contact: (M, 4) bool, contact at the previous step.
        config: the constants.
    """

    state: RobotState
    command: Array
    phases: Array
    contact: Array
    swing: Array
    base_height: Array
    foot_height: Array
    standing_height: float
    stance: tuple[float, float]
    targets: Array
    actions: Array
    acceleration: Array
    last_tilt: Array
    was_contact: Array
    config: LowRewardConfig

    def cmd(self, name: str) -> Array:
        """One command by name, (M,)."""
        return self.command[:, INDEX[name]]


def square_sum(x: Array) -> Array:
    """Sum of squares along the last axis, (..., n) -> (...)."""
    return np.einsum("...i,...i->...", x, x)


def track_lin_vel(s: LowStep) -> Array:
    """r_lin = exp(-|v_xy - v_xy^cmd|^2 / sigma_lin), velocities in the heading frame."""
    error = square_sum(s.state.heading_vel[:, :2] - s.command[:, :2])
    return np.exp(-error / s.config.sigma_lin)


def track_yaw_rate(s: LowStep) -> Array:
    """r_yaw = exp(-(omega_z - omega_z^cmd)^2 / sigma_yaw)."""
    error = (s.state.ang_vel[:, 2] - s.cmd("yaw_rate")) ** 2
    return np.exp(-error / s.config.sigma_yaw)


def body_height(s: LowStep) -> Array:
    """Squared error of the trunk's height above ground, m^2."""
    return (s.base_height - s.standing_height - s.cmd("body_height")) ** 2


def commanded_gravity(pitch: Array, roll: Array) -> Array:
    """Unit gravity in a body with pitch (nose down +) and roll (left up +): (M,) -> (M, 3)."""
    return np.stack(
        [np.sin(pitch), -np.cos(pitch) * np.sin(roll), -np.cos(pitch) * np.cos(roll)], axis=-1
    )


def orientation(s: LowStep) -> Array:
    """Squared xy error of the projected gravity against the commanded pitch and roll."""
    wanted = commanded_gravity(s.cmd("pitch"), s.cmd("roll"))
    return square_sum((s.state.gravity - wanted)[:, :2])


def raibert_targets(
    command: Array, phases: Array, stance: tuple[float, float], centre: float
) -> Array:
    """Footholds of Raibert's rule in the heading frame: (M, 15), (M, 4) -> (M, 4, 2) m.

    They are the corners of the commanded stance rectangle, shifted by ``robot.foot_travel``. Its
    middle is ``centre`` m ahead of the trunk's, like that of the hips. Its length and width are
    those of the robot at the default commands, ``stance`` (2,) m, plus the commands' differences
    from their defaults.
    """
    rectangle = command[:, _STANCE] + (np.array(stance) - default_command()[_STANCE])
    rest = 0.5 * rectangle[:, None, :] * np.stack([FRONT, SIDE], axis=1)
    rest[..., 0] += centre
    return rest + foot_travel(command, phases, rest)


def raibert_foothold(s: LowStep) -> Array:
    """Squared distance of the feet from Raibert's footholds, summed, m^2."""
    arm = s.state.foot_position[..., :2] - s.state.position[:, None, :2]
    c, d = np.cos(s.state.yaw)[:, None], np.sin(s.state.yaw)[:, None]
    feet = np.stack([c * arm[..., 0] + d * arm[..., 1], c * arm[..., 1] - d * arm[..., 0]], axis=-1)
    centre = float(s.state.geometry.hips[:, 0].mean())
    error = feet - raibert_targets(s.command, s.phases, s.stance, centre)
    return np.einsum("mfi,mfi->m", error, error)


def swing_height(s: LowStep) -> Array:
    """Squared error of the feet's height against the swing profile, weighted by 1 - C, m^2."""
    wanted = s.cmd("swing_height")[:, None] * s.swing + s.state.geometry.foot_radius
    return np.sum((s.foot_height - wanted) ** 2 * (1.0 - s.contact), axis=1)


def swing_contact_force(s: LowStep) -> Array:
    """Contact in swing: mean of (1 - C)(1 - exp(-F^2 / swing_force_scale))."""
    pressed = 1.0 - np.exp(-(s.state.foot_force**2) / s.config.swing_force_scale)
    return np.mean((1.0 - s.contact) * pressed, axis=1)


def stance_foot_speed(s: LowStep) -> Array:
    """Motion in stance: mean of C (1 - exp(-|v_foot|^2 / stance_speed_scale))."""
    speed2 = square_sum(s.state.foot_velocity)
    return np.mean(s.contact * (1.0 - np.exp(-speed2 / s.config.stance_speed_scale)), axis=1)


def target_rate(s: LowStep) -> Array:
    """First difference of the joint targets, squared, rad^2 (smoothness 1)."""
    return square_sum(s.targets[0] - s.targets[1])


def target_acceleration(s: LowStep) -> Array:
    """Second difference of the joint targets, squared, rad^2 (smoothness 2)."""
    return square_sum(s.targets[0] - 2.0 * s.targets[1] + s.targets[2])


def action_rate(s: LowStep) -> Array:
    """First difference of the raw actions, squared."""
    return square_sum(s.actions[0] - s.actions[1])


def foot_slip(s: LowStep) -> Array:
    """Squared horizontal speed of feet in contact now or a step ago, summed, m^2/s^2."""
    touching = np.logical_or(s.state.touching, s.was_contact)
    return np.sum(touching * square_sum(s.state.foot_velocity[..., :2]), axis=1)


def leg_collision(s: LowStep) -> Array:
    """Number of legs in contact above the foot."""
    return np.sum(s.state.leg_force > s.config.leg_force, axis=1).astype(np.float64)


def joint_limits(s: LowStep) -> Array:
    """How far joints are outside the middle ``soft_limit`` of their range, summed, rad."""
    limits = s.state.geometry.joint_limits
    middle = limits.mean(axis=1)
    half = 0.5 * s.config.soft_limit * (limits[:, 1] - limits[:, 0])
    return np.sum(np.maximum(np.abs(s.state.q - middle) - half, 0.0), axis=1)


def vertical_velocity(s: LowStep) -> Array:
    """Squared vertical velocity of the trunk, m^2/s^2."""
    return s.state.lin_vel[:, 2] ** 2


def tilt_rate(s: LowStep) -> Array:
    """Squared roll and pitch rate of the trunk, rad^2/s^2."""
    return square_sum(s.state.body_rate[:, :2])


def nodding(s: LowStep) -> Array:
    """Squared change, over one gait cycle, of the xy of unit gravity in the trunk's frame."""
    return square_sum(s.state.gravity[:, :2] - s.last_tilt)


def joint_torques(s: LowStep) -> Array:
    """Squared joint torques, summed, N^2 m^2."""
    return square_sum(s.state.torque)


def joint_speeds(s: LowStep) -> Array:
    """Squared joint speeds, summed, rad^2/s^2."""
    return square_sum(s.state.qd)


def joint_accelerations(s: LowStep) -> Array:
    """Squared joint accelerations, summed, rad^2/s^4."""
    return square_sum(s.acceleration)


def power(s: LowStep) -> Array:
    """Mechanical power at the commanded price: power_weight * sum |torque * speed|."""
    return s.cmd("power_weight") * s.state.power


#: Terms of the low policy by name; the weights are the fields of ``LowRewardConfig``.
LOW_TERMS: dict[str, Callable[[LowStep], Array]] = {
    f.__name__: f
    for f in (
        track_lin_vel,
        track_yaw_rate,
        body_height,
        orientation,
        raibert_foothold,
        swing_height,
        swing_contact_force,
        stance_foot_speed,
        target_rate,
        target_acceleration,
        action_rate,
        foot_slip,
        leg_collision,
        joint_limits,
        vertical_velocity,
        tilt_rate,
        nodding,
        joint_torques,
        joint_speeds,
        joint_accelerations,
        power,
    )
}
_CONSTANTS = {
    "sigma_lin", "sigma_yaw", "swing_force_scale", "stance_speed_scale", "leg_force", "soft_limit",
    "walking_penalty", "terrain_penalty",
}  # fmt: skip
if set(LOW_TERMS) != {f.name for f in dataclasses.fields(LowRewardConfig)} - _CONSTANTS:
    raise TypeError("LOW_TERMS and LowRewardConfig name different terms")


def low_terms(step: LowStep, weights: LowRewardConfig) -> dict[str, Array]:
    """Weighted value of every enabled term, (M,) each; a weight of 0 switches a term off."""
    return {
        name: weight * term(step)
        for name, term in LOW_TERMS.items()
        if (weight := getattr(weights, name)) != 0.0
    }


def total(
    terms: Mapping[str, Array], weights: LowRewardConfig, dt: float, penalty: Array | float = 1.0
) -> Array:
    """R = dt (sum of positive terms) exp(penalty (sum of negative terms)), (M,).

    The sign of its weight decides a term's group. ``penalty``, (M,) or a scalar, is the share of
    the negative terms that counts.
    """
    positive = sum(value for name, value in terms.items() if getattr(weights, name) > 0.0)
    negative = sum(value for name, value in terms.items() if not getattr(weights, name) > 0.0)
    return np.asarray(dt * positive * np.exp(penalty * negative))
