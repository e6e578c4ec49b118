"""Reward terms, each a pure function on arrays of M robots, and the tables that list them.

Low policy (Sec. IV-A): the terms of Walk These Ways that the paper names or needs. A term returns
the raw quantity, (M,); its sign and weight come from ``LowRewardConfig``. ``total`` combines them
as Walk These Ways does, so that a good gait multiplies the tracking reward:

    R = dt * (sum of positive terms) * exp(sum of negative terms)
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from tdgc.config import HighRewardConfig, LowRewardConfig
from tdgc.sim.commands import INDEX, default_command
from tdgc.sim.geometry import FRONT, SIDE
from tdgc.sim.robot import Array, RobotState, foot_travel

CONTACT_FORCE = 1.0  # N: a foot that presses harder is in contact
_SOFT_LIMIT = 0.9  # share of a joint's range without a penalty (Walk These Ways)
_FORCE_SCALE = 100.0  # N^2, swing contact force (Walk These Ways)
_SPEED_SCALE = 10.0  # m^2/s^2, stance foot speed (Walk These Ways)
_STANCE = [INDEX["stance_length"], INDEX["stance_width"]]
_LEG_FORCE = 0.1  # N, above which a leg contact counts (Walk These Ways)


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
    stance: tuple[float, float]
    targets: Array
    actions: Array
    acceleration: Array
    last_tilt: Array
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
    """Unit gravity in a body with pitch (nose down +) and roll (left up +): (M,) -> (M, 3)."""
    return np.stack(
        [np.sin(pitch), -np.cos(pitch) * np.sin(roll), -np.cos(pitch) * np.cos(roll)], axis=-1
    )


def orientation(s: LowStep) -> Array:
    """Squared xy error of the projected gravity against the commanded pitch and roll."""
    wanted = commanded_gravity(s.cmd("pitch"), s.cmd("roll"))
    return _square_sum((s.state.gravity - wanted)[:, :2])


def raibert_targets(command: Array, phases: Array, stance: tuple[float, float]) -> Array:
    """Footholds of Raibert's rule in the heading frame: (M, 15), (M, 4) -> (M, 4, 2) m.

    They are the corners of the commanded stance rectangle, shifted by ``robot.foot_travel``. Its
    length and width differ from ``stance`` (2,) m, those of the robot at the default commands, as
    the commands do from their defaults.
    """
    rectangle = command[:, _STANCE] + (np.array(stance) - default_command()[_STANCE])
    rest = 0.5 * rectangle[:, None, :] * np.stack([FRONT, SIDE], axis=1)
    return np.asarray(rest + foot_travel(command, phases, rest))


def raibert_foothold(s: LowStep) -> Array:
    """Squared distance of the feet from Raibert's footholds, summed, m^2."""
    arm = s.state.foot_position[..., :2] - s.state.position[:, None, :2]
    c, d = np.cos(s.state.yaw)[:, None], np.sin(s.state.yaw)[:, None]
    feet = np.stack([c * arm[..., 0] + d * arm[..., 1], c * arm[..., 1] - d * arm[..., 0]], axis=-1)
    error = feet - raibert_targets(s.command, s.phases, s.stance)
    return np.asarray(np.einsum("mfi,mfi->m", error, error))


def swing_height(s: LowStep) -> Array:
    """Squared error of the feet's height against the swing profile, weighted by 1 - C, m^2."""
    wanted = s.cmd("swing_height")[:, None] * s.swing + s.state.geometry.foot_radius
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
    touching = np.logical_or(s.state.foot_force > CONTACT_FORCE, s.was_contact)
    return np.sum(touching * _square_sum(s.state.foot_velocity[..., :2]), axis=1)


def leg_collision(s: LowStep) -> Array:
    """Number of legs in contact above the foot."""
    return np.sum(s.state.leg_force > _LEG_FORCE, axis=1).astype(np.float64)


def joint_limits(s: LowStep) -> Array:
    """How far joints are outside the middle 0.9 of their range, summed, rad."""
    limits = s.state.geometry.joint_limits
    middle = limits.mean(axis=1)
    half = 0.5 * _SOFT_LIMIT * (limits[:, 1] - limits[:, 0])
    return np.sum(np.maximum(np.abs(s.state.q - middle) - half, 0.0), axis=1)


def vertical_velocity(s: LowStep) -> Array:
    """Squared vertical velocity of the trunk, m^2/s^2."""
    return np.asarray(s.state.lin_vel[:, 2] ** 2)


def tilt_rate(s: LowStep) -> Array:
    """Squared roll and pitch rate of the trunk, rad^2/s^2."""
    return _square_sum(s.state.body_rate[:, :2])


def nodding(s: LowStep) -> Array:
    """Squared change, within one gait cycle, of the xy of unit gravity in the trunk's frame."""
    return _square_sum(s.state.gravity[:, :2] - s.last_tilt)


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
    """Mechanical power at the commanded price: power_weight * sum |torque * speed|."""
    return s.cmd("power_weight") * np.sum(np.abs(s.state.torque * s.state.qd), axis=1)


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
_NO_TERMS = {"sigma_lin", "sigma_yaw", "walking_penalty", "terrain_penalty"}
if set(LOW_TERMS) != {f.name for f in dataclasses.fields(LowRewardConfig)} - _NO_TERMS:
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
    positive: Array | float = 0.0
    negative: Array | float = 0.0
    for name, value in terms.items():
        if getattr(weights, name) > 0.0:
            positive = positive + value
        else:
            negative = negative + value
    return np.asarray(dt * positive * np.exp(penalty * negative))


# ---------------------------------------------------------------------------- high policy


@dataclass
class HighStep:
    """Inputs of the high policy's terms for one decision of M robots (Sec. IV-B).

    Attributes:
        distance: (M,) m to the goal, d_t, horizontal: a goal has no height here.
        heading_error: (M,) rad, psi* - psi.
        time_share: (M,) t / T_max.
        lin_vel, ang_vel: (M, 3) of the base, m/s and rad/s; joint_speed: (M, 12) rad/s.
        base_height: (M,) m above ground; standing_height: m, z*.
        actions: (2, M, 13), this action and the one before, clipped and normalised.
        commands: (3, M, 15) of this decision and the two before, each as a share of its range.
        contact_forces: (M, 5) N: the trunk, and each leg above the foot.
        config: the constants.
    """

    distance: Array
    heading_error: Array
    time_share: Array
    lin_vel: Array
    ang_vel: Array
    joint_speed: Array
    base_height: Array
    standing_height: float
    actions: Array
    commands: Array
    contact_forces: Array
    config: HighRewardConfig

    @property
    def inside(self) -> Array:
        """1[d_t < d_0], (M,)."""
        return (self.distance < self.config.goal_radius).astype(np.float64)


def goal_distance(s: HighStep) -> Array:
    """r_goal_dist = p + a (1 - e^{-b p}), p = clip(1 - d_t / R_map, 0, 1)."""
    p = np.clip(1.0 - s.distance / s.config.map_radius, 0.0, 1.0)
    return p + s.config.curve_gain * (1.0 - np.exp(-s.config.curve_rate * p))


def face(s: HighStep) -> Array:
    """r_face = cos(psi* - psi)."""
    return np.cos(s.heading_error)


def arrive(s: HighStep) -> Array:
    """r_arrive = 1[d_t < d_0] (b_0 + b_1 alpha), alpha = clip(1 - t / T_max, 0, 1)."""
    alpha = np.clip(1.0 - s.time_share, 0.0, 1.0)
    return s.inside * (s.config.arrive_base + s.config.arrive_speed * alpha)


def stable(s: HighStep) -> Array:
    """r_stable = 1[d_t < d_0] exp(-eta_t) exp(-(z - z*)^2 / sigma_z)."""
    eta = (
        np.linalg.norm(s.lin_vel, axis=1)
        + np.linalg.norm(s.ang_vel, axis=1)
        + s.config.joint_speed_weight * np.linalg.norm(s.joint_speed, axis=1)
    )
    height = (s.base_height - s.standing_height) ** 2 / s.config.height_scale
    return s.inside * np.exp(-eta) * np.exp(-height)


def high_action_rate(s: HighStep) -> Array:
    """r_action_rate = sum_j (a_t - a_{t-1})^2."""
    return _square_sum(s.actions[0] - s.actions[1])


def command_rate(s: HighStep) -> Array:
    """r_cmd_sm1: mean squared first difference of the commands."""
    return _square_sum(s.commands[0] - s.commands[1]) / s.commands.shape[-1]


def command_acceleration(s: HighStep) -> Array:
    """r_cmd_sm2: mean squared second difference of the commands."""
    second = s.commands[0] - 2.0 * s.commands[1] + s.commands[2]
    return _square_sum(second) / s.commands.shape[-1]


def contact_force(s: HighStep) -> Array:
    """r_col = sum_j max(0, |F_j| - F_th), over the trunk and the legs above the feet."""
    return np.sum(np.maximum(s.contact_forces - s.config.force_threshold, 0.0), axis=1)


def laziness(s: HighStep) -> Array:
    """r_lazy = 1[d_t > d_0] 1[|v| < v_th]."""
    slow = np.linalg.norm(s.lin_vel, axis=1) < s.config.lazy_speed
    return (1.0 - s.inside) * slow


def alive(s: HighStep) -> Array:
    """r_alive = 1."""
    return np.ones_like(s.distance)


#: Terms of the high policy by the name of their weight in ``HighRewardConfig``.
HIGH_TERMS: dict[str, Callable[[HighStep], Array]] = {
    "goal_distance": goal_distance,
    "face": face,
    "arrive": arrive,
    "stable": stable,
    "action_rate": high_action_rate,
    "command_rate": command_rate,
    "command_acceleration": command_acceleration,
    "contact_force": contact_force,
    "laziness": laziness,
    "alive": alive,
}
if not set(HIGH_TERMS) <= {f.name for f in dataclasses.fields(HighRewardConfig)}:
    raise TypeError("HIGH_TERMS names a term without a weight in HighRewardConfig")


def high_terms(step: HighStep, dt: float) -> dict[str, Array]:
    """Every enabled term times its effective weight, (M,) each.

    The effective weight is w_i dt (step-time scaling), or w_i without ``step_time_scaling``. The
    high policy's reward is the plain sum of these terms.
    """
    scale = dt if step.config.step_time_scaling else 1.0
    return {
        name: weight * scale * term(step)
        for name, term in HIGH_TERMS.items()
        if (weight := getattr(step.config, name)) != 0.0
    }
