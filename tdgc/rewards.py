"""Reward terms: one pure function each, on arrays of M robots, and the tables that weigh them.

Low level (Sec. IV-A): the terms of Walk These Ways that the paper names or needs. A term returns
the raw quantity, (M,); its sign and weight come from ``LowRewardConfig``. ``total`` combines them
as Walk These Ways does, so that good gait multiplies what tracking earns:

    R = dt * (sum of positive terms) * exp(sum of negative terms)
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from tdgc.commands import INDEX
from tdgc.config import LowRewardConfig
from tdgc.robot import FOOT_RADIUS, HIPS_XY, JOINT_LIMITS, Array, RobotState

CONTACT_FORCE = 1.0  # N: a foot that presses harder is in contact
_SOFT_LIMIT = 0.9  # share of a joint's range that costs nothing (Walk These Ways)
_FORCE_SCALE = 100.0  # N^2, swing contact force (Walk These Ways)
_SPEED_SCALE = 10.0  # m^2/s^2, stance foot speed (Walk These Ways)
_LEG_FORCE = 0.1  # N, a leg contact that counts (Walk These Ways)


@dataclass
class LowStep:
    """All that the low-level terms look at, one control step of M robots.

    Attributes:
        state: the robots after the step.
        command: (M, 15).
        phases: (M, 4) warped foot phases; contact: (M, 4) desired contact C; swing: (M, 4)
            triangle of the swing.
        base_height: (M,) m, trunk above the ground under it.
        foot_height: (M, 4) m, foot centre above the ground under it.
        standing_height: m, to which the body height command is added.
        targets: (3, M, 12) rad, joint targets of this step and the two before.
        actions: (2, M, 12), this action and the one before.
        acceleration: (M, 12) rad/s^2 of the joints over the step.
        was_contact: (M, 4) bool, contact at the step before.
        sigma_lin, sigma_yaw: scales of the tracking terms.
    """

    state: RobotState
    command: Array
    phases: Array
    contact: Array
    swing: Array
    base_height: Array
    foot_height: Array
    standing_height: float
    targets: Array
    actions: Array
    acceleration: Array
    was_contact: Array
    sigma_lin: float
    sigma_yaw: float

    def cmd(self, name: str) -> Array:
        """One command by name, (M,)."""
        return np.asarray(self.command[:, INDEX[name]])


def _square_sum(x: Array) -> Array:
    return np.asarray(np.einsum("...i,...i->...", x, x))


def track_lin_vel(s: LowStep) -> Array:
    """r_lin = exp(-|v_xy - v_xy^cmd|^2 / sigma_lin), velocities in the heading frame."""
    return np.exp(-_square_sum(s.state.heading_vel[:, :2] - s.command[:, :2]) / s.sigma_lin)


def track_yaw_rate(s: LowStep) -> Array:
    """r_yaw = exp(-(omega_z - omega_z^cmd)^2 / sigma_yaw)."""
    return np.exp(-((s.state.ang_vel[:, 2] - s.cmd("yaw_rate")) ** 2) / s.sigma_yaw)


def body_height(s: LowStep) -> Array:
    """Squared error of the trunk's height above ground, m^2."""
    return (s.base_height - s.standing_height - s.cmd("body_height")) ** 2


def commanded_gravity(pitch: Array, roll: Array) -> Array:
    """Unit gravity in a body pitched (nose down +) and rolled (left up +): (M,) -> (M, 3)."""
    return np.stack(
        [np.sin(pitch), -np.cos(pitch) * np.sin(roll), -np.cos(pitch) * np.cos(roll)], axis=-1
    )


def orientation(s: LowStep) -> Array:
    """Squared xy error of the projected gravity against commanded pitch and roll."""
    wanted = commanded_gravity(s.cmd("pitch"), s.cmd("roll"))
    return _square_sum((s.state.gravity - wanted)[:, :2])


def raibert_targets(command: Array, phases: Array) -> Array:
    """Footholds of Raibert's rule in the heading frame: (M, 15), (M, 4) -> (M, 4, 2) m.

    Under the commanded stance rectangle, led by how far the ground moves under the foot in half
    a stance: +1/2 at touch-down, -1/2 at lift-off, back to +1/2 through the swing.
    """
    half = 0.5 * np.stack(
        [command[:, INDEX["stance_length"]], command[:, INDEX["stance_width"]]], axis=-1
    )
    rest = half[:, None, :] * np.sign(HIPS_XY)
    lead = np.abs(1.0 - 2.0 * phases) - 0.5
    stance_time = command[:, INDEX["duration"]] / command[:, INDEX["frequency"]]
    turn = command[:, INDEX["yaw_rate"], None]
    ground_x = command[:, INDEX["vx"], None] - turn * rest[..., 1]
    ground_y = command[:, INDEX["vy"], None] + turn * rest[..., 0]
    travel = np.stack([ground_x, ground_y], axis=-1) * stance_time[:, None, None]
    return np.asarray(rest + lead[..., None] * travel)


def raibert_foothold(s: LowStep) -> Array:
    """Squared distance of the feet from Raibert's footholds, summed, m^2."""
    arm = s.state.foot_position[..., :2] - s.state.position[:, None, :2]
    c, d = np.cos(s.state.yaw)[:, None], np.sin(s.state.yaw)[:, None]
    feet = np.stack(
        [c * arm[..., 0] + d * arm[..., 1], c * arm[..., 1] - d * arm[..., 0]], axis=-1
    )
    error = feet - raibert_targets(s.command, s.phases)
    return np.asarray(np.einsum("mfi,mfi->m", error, error))


def swing_height(s: LowStep) -> Array:
    """Squared error of the feet's height against the swing triangle, weighed by 1 - C, m^2."""
    wanted = s.cmd("swing_height")[:, None] * s.swing + FOOT_RADIUS
    return np.sum((s.foot_height - wanted) ** 2 * (1.0 - s.contact), axis=1)


def swing_contact_force(s: LowStep) -> Array:
    """Contact in swing: mean of (1 - C)(1 - exp(-F^2 / 100 N^2))."""
    return np.mean(
        (1.0 - s.contact) * (1.0 - np.exp(-(s.state.foot_force**2) / _FORCE_SCALE)), axis=1
    )


def stance_foot_speed(s: LowStep) -> Array:
    """Motion in stance: mean of C (1 - exp(-|v_foot|^2 / 10 m^2/s^2))."""
    speed2 = _square_sum(s.state.foot_velocity)
    return np.mean(s.contact * (1.0 - np.exp(-speed2 / _SPEED_SCALE)), axis=1)


def target_rate(s: LowStep) -> Array:
    """First difference of the joint targets, squared, rad^2 (smoothness 1)."""
    return _square_sum(s.targets[0] - s.targets[1])


def target_acceleration(s: LowStep) -> Array:
    """Second difference of the joint targets, squared, rad^2 (smoothness 2)."""
    return _square_sum(s.targets[0] - 2.0 * s.targets[1] + s.targets[2])


def action_rate(s: LowStep) -> Array:
    """First difference of the raw actions, squared."""
    return _square_sum(s.actions[0] - s.actions[1])


def foot_slip(s: LowStep) -> Array:
    """Squared horizontal speed of feet in contact now or a step ago, summed, m^2/s^2."""
    touching = (s.state.foot_force > CONTACT_FORCE) | s.was_contact
    return np.sum(touching * _square_sum(s.state.foot_velocity[..., :2]), axis=1)


def leg_collision(s: LowStep) -> Array:
    """Number of legs that touch the ground above the foot."""
    return np.sum(s.state.leg_force > _LEG_FORCE, axis=1).astype(np.float64)


def joint_limits(s: LowStep) -> Array:
    """How far joints are beyond 0.9 of their range, summed, rad."""
    middle = JOINT_LIMITS.mean(axis=1)
    half = 0.5 * _SOFT_LIMIT * (JOINT_LIMITS[:, 1] - JOINT_LIMITS[:, 0])
    return np.sum(np.maximum(np.abs(s.state.q - middle) - half, 0.0), axis=1)


def vertical_velocity(s: LowStep) -> Array:
    """Squared vertical velocity of the trunk, m^2/s^2."""
    return np.asarray(s.state.lin_vel[:, 2] ** 2)


def tilt_rate(s: LowStep) -> Array:
    """Squared roll and pitch rate of the trunk, rad^2/s^2."""
    body = np.einsum("mji,mj->mi", s.state.rotation, s.state.ang_vel)
    return _square_sum(body[:, :2])


def joint_torques(s: LowStep) -> Array:
    """Squared joint torques, summed, N^2 m^2."""
    return _square_sum(s.state.torque)


def joint_speeds(s: LowStep) -> Array:
    """Squared joint speeds, summed, rad^2/s^2."""
    return _square_sum(s.state.qd)


def joint_accelerations(s: LowStep) -> Array:
    """Squared joint accelerations, summed, rad^2/s^4."""
    return _square_sum(s.acceleration)


def power(s: LowStep) -> Array:
    """Mechanical power spent, at the commanded price: power_weight * sum |torque * speed|."""
    return s.cmd("power_weight") * np.sum(np.abs(s.state.torque * s.state.qd), axis=1)


#: Terms of the low level by name; the weights are the fields of ``LowRewardConfig``.
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
        joint_torques,
        joint_speeds,
        joint_accelerations,
        power,
    )
}
_SIGMAS = {"sigma_lin", "sigma_yaw"}
if set(LOW_TERMS) != {f.name for f in dataclasses.fields(LowRewardConfig)} - _SIGMAS:
    raise TypeError("LOW_TERMS and LowRewardConfig name different terms")


def low_terms(step: LowStep, weights: LowRewardConfig) -> dict[str, Array]:
    """Weighted value of every enabled term, (M,) each; a weight of 0 switches a term off."""
    return {
        name: weight * term(step)
        for name, term in LOW_TERMS.items()
        if (weight := getattr(weights, name)) != 0.0
    }


def total(terms: Mapping[str, Array], weights: LowRewardConfig, dt: float) -> Array:
    """R = dt (sum of positive terms) exp(sum of negative terms), (M,).

    A term's group follows from the sign of its weight.
    """
    positive: Array | float = 0.0
    negative: Array | float = 0.0
    for name, value in terms.items():
        if getattr(weights, name) > 0.0:
            positive = positive + value
        else:
            negative = negative + value
    return np.asarray(dt * positive * np.exp(negative))
