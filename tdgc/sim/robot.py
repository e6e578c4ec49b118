"""The robot in plain numpy: nominal pose, joint PD, leg kinematics and state.

A ``World`` fills a ``RobotState`` from its simulator and calls ``pd_torque`` for joint torques.
Arrays have a leading axis of M robots. Legs are in the order of ``tdgc.sim.gaits.FEET``.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tdgc.config import ConfigError, RobotConfig
from tdgc.sim.commands import INDEX, default_command
from tdgc.sim.gaits import swing_profile
from tdgc.sim.geometry import FRONT, SIDE, Geometry, read_geometry
from tdgc.sim.urdf import JOINTS

Array = NDArray[np.float64]

NUM_JOINTS = len(JOINTS)

GRAVITY = 9.81  # m/s^2
# m relative to the hips, chosen by hand: no commanded pose folds a leg further.
HIGHEST_FOOT = -0.1


def nominal_pose(config: RobotConfig) -> Array:
    """Nominal joint angles, q0 of the paper, (12,) rad."""
    front, rear = config.nominal_thigh
    thigh = np.where(FRONT > 0, front, rear)
    return np.stack([config.nominal_hip * SIDE, thigh, np.full(4, config.nominal_calf)], 1).ravel()


def nominal_feet(config: RobotConfig, geometry: Geometry) -> Array:
    """Feet of the nominal pose in the trunk's frame, (4, 3) m."""
    return foot_kinematics(geometry, nominal_pose(config)[None], np.zeros((1, NUM_JOINTS)))[0][0]


def nominal_height(config: RobotConfig, geometry: Geometry) -> float:
    """Height of the trunk above the soles in the nominal pose, m."""
    return float(geometry.foot_radius - nominal_feet(config, geometry)[:, 2].min())


def check_nominal_pose(config: RobotConfig, geometry: Geometry) -> None:
    """Check that the robot's joints can take the nominal pose.

    Raises:
        ConfigError: an angle outside its joint's limits; the message names the setting and both.
    """
    for name, angle, (low, high) in zip(
        JOINTS, nominal_pose(config).tolist(), geometry.joint_limits.tolist(), strict=True
    ):
        if not low <= angle <= high:
            raise ConfigError(
                f"robot.nominal_{name.split('_')[1]} puts {name} at {angle:g} rad; "
                f"{config.urdf} allows {low:g} to {high:g}"
            )


def _between_thighs(geometry: Geometry) -> Array:
    """Distances between front and rear and between left and right thigh joints, (2,) m."""
    length, width = np.ptp(geometry.hips, axis=0)
    return np.array([length, width + 2.0 * geometry.abduction])


def _rounded(value: float, places: int) -> float:
    """A positive value rounded to ``places`` after the point, but to no less than two digits."""
    return round(value, max(places, 1 - math.floor(math.log10(value))))


def _nominal_legs(own: Geometry) -> tuple[tuple[float, float], float]:
    """``nominal_thigh`` and ``nominal_calf`` with which the feet are where the shipped robot's are
    below the thigh joints, scaled with the legs' length; the calf stays within its limits."""
    upright = replace(RobotConfig(), nominal_hip=0.0)
    shipped = read_geometry(upright)
    feet = nominal_feet(upright, shipped)
    feet[:, :2] -= shipped.hips
    feet *= (own.thigh + own.calf) / (shipped.thigh + shipped.calf)
    feet[:, 0] += own.hips[:, 0]
    feet[:, 1] = own.hips[:, 1] + own.abduction * SIDE
    limits = own.joint_limits.reshape(4, 3, 2)  # of one leg, the strictest of the four
    inside = np.stack([limits[..., 0].max(axis=0), limits[..., 1].min(axis=0)], axis=1)
    inside += np.multiply(upright.joint_margin or 0.0, [1.0, -1.0])
    angles = leg_angles(replace(own, joint_limits=np.tile(inside, (4, 1))), feet[None])
    front, _, rear, _ = angles.reshape(4, 3).round(2).tolist()
    return (front[1], rear[1]), front[2]


def fitted(config: RobotConfig) -> dict[str, Any]:
    """Settings for the robot whose URDF ``config`` names, by field: motor limits from the URDF, and
    the shipped robot's settings scaled to its size and mass.

    In the nominal pose, unless ``config`` has another than the default, the feet are below the
    thigh joints as the shipped robot's are. ``base_height`` is the same share of that pose's
    height, ``stance`` of the distances between the thigh joints. ``kp`` scales with the weight's
    torque about the joints, m g l, and ``kd`` with m l^1.5, which keeps the damping ratio.
    """
    ours, own = RobotConfig(), read_geometry(config)
    shipped = read_geometry(ours)
    mass = sum(own.masses.values()) / sum(shipped.masses.values())
    length = (own.thigh + own.calf) / (shipped.thigh + shipped.calf)
    thigh, calf = config.nominal_thigh, config.nominal_calf
    if (thigh, calf) == (ours.nominal_thigh, ours.nominal_calf):
        thigh, calf = _nominal_legs(own)
    posed = replace(config, nominal_thigh=thigh, nominal_calf=calf)
    height = nominal_height(posed, own) / nominal_height(ours, shipped)
    stance = np.multiply(ours.stance, _between_thighs(own) / _between_thighs(shipped))
    found: dict[str, Any] = {
        "nominal_thigh": thigh,
        "nominal_calf": calf,
        "base_height": round(height * ours.base_height, 2),
        "stance": tuple(stance.round(2).tolist()),
        "kp": _rounded(mass * length * ours.kp, 1),
        "kd": _rounded(mass * length**1.5 * ours.kd, 2),
    }
    for name, limits in zip(("torque_limit", "speed_limit"), own.motor_limits, strict=True):
        known = np.isfinite(limits)
        if known.any():
            found[name] = tuple(np.where(known, limits, getattr(ours, name)).tolist())
    return found


def _stance(config: RobotConfig, geometry: Geometry, change: Array) -> Array:
    """Nominal feet, moved apart as the commands differ from their defaults, by ``change`` (M, 15):
    (M, 4, 3) m."""
    feet = np.tile(nominal_feet(config, geometry), (len(change), 1, 1))
    feet[..., 0] += 0.5 * change[:, INDEX["stance_length"], None] * FRONT
    feet[..., 1] += 0.5 * change[:, INDEX["stance_width"], None] * SIDE
    return feet


def commanded_pose(config: RobotConfig, geometry: Geometry, command: Array, swing: Array) -> Array:
    """q0(c, phi): the nominal pose adapted to the commands, (M, 15), (M, 4) -> (M, 12) rad.

    The feet are under a level trunk at the commanded height. From their nominal places they move
    apart by as much as stance width and length exceed their defaults. They rise along ``swing``,
    the profile of ``gaits.swing_profile``, by the amount that the commanded swing height exceeds
    its default. At default commands this is the paper's q0. With the paper's q0 throughout, a
    policy hardly learned to follow these commands, but it did learn pitch and roll
    (docs/experiments.md). The pose is the offset of the actions, not a constraint: a foot out of
    reach gets the nearest angles within the calf's limits, and no foot is higher than
    ``HIGHEST_FOOT``.
    """
    change = command - default_command()
    feet = _stance(config, geometry, change)
    feet[..., 2] -= change[:, INDEX["body_height"], None]
    feet[..., 2] += change[:, INDEX["swing_height"], None] * swing
    feet[..., 2] = np.minimum(feet[..., 2], HIGHEST_FOOT)
    return leg_angles(geometry, feet)


def foot_travel(command: Array, phases: Array, rest: Array) -> Array:
    """Displacement of the feet from their positions at ``rest`` by Raibert's rule: (M, 15), (M, 4),
    (M, 4, 2) m -> (M, 4, 2) m in the heading frame.

    A foot leads by half of the ground's travel during a stance at touch-down, trails by as much at
    lift-off and returns during swing.
    """
    lead = np.abs(1.0 - 2.0 * phases) - 0.5
    stance_time = command[:, INDEX["duration"]] / command[:, INDEX["frequency"]]
    turn = command[:, INDEX["yaw_rate"], None]
    ground_x = command[:, INDEX["vx"], None] - turn * rest[..., 1]
    ground_y = command[:, INDEX["vy"], None] + turn * rest[..., 0]
    travel = np.stack([ground_x, ground_y], axis=-1) * stance_time[:, None, None]
    return lead[..., None] * travel


def walking_pose(
    config: RobotConfig,
    geometry: Geometry,
    command: Array,
    phases: Array,
    ahead: Array,
    grown: Array,
) -> Array:
    """q0(c, phi) of a robot that walks as commanded, (M, 12) rad.

    The lowest feet are under a trunk at the commanded height, pitch and roll. The others stay as
    much higher as in the nominal pose: the rear ones of the shipped robot 9 mm. The feet are as far
    apart as in ``commanded_pose``, move between Raibert's footholds and rise to the commanded
    height in swing. On top of that, the joints are offset by the position error that the joint
    control needs to carry the load of the stance feet (``stance_load``). The pose is the offset of
    the actions, not a constraint, see ``commanded_pose``.

    Args:
        config: the robot's settings.
        geometry: the robot's geometry.
        command: (M, 15), commands as carried out.
        phases: (M, 4) phases of the feet, for the load.
        ahead: (M, 4) the phases later by the joints' lag, for the feet's positions.
        grown: (M,) share of swing height and travel, which ramps up as a gait begins.
    """
    change = command - default_command()
    feet = _stance(config, geometry, change)
    feet[..., :2] += grown[:, None, None] * foot_travel(command, ahead, feet[..., :2])
    # The unloaded nominal pose is higher than the robot stands.
    lift = nominal_height(config, geometry) - config.base_height
    feet[..., 2] += lift - change[:, INDEX["body_height"], None]
    feet[..., 2] += (grown * command[:, INDEX["swing_height"]])[:, None] * swing_profile(ahead)
    pitch, roll = command[:, INDEX["pitch"], None], command[:, INDEX["roll"], None]
    x, y, z = np.moveaxis(feet, -1, 0)
    x, z = np.cos(pitch) * x - np.sin(pitch) * z, np.sin(pitch) * x + np.cos(pitch) * z
    y, z = np.cos(roll) * y + np.sin(roll) * z, np.cos(roll) * z - np.sin(roll) * y
    q = leg_angles(geometry, np.stack([x, y, np.minimum(z, HIGHEST_FOOT)], axis=-1))
    load = stance_load(geometry, command, phases)
    return q - load_torque(geometry, q, load) / config.kp


def stance_load(geometry: Geometry, command: Array, phases: Array) -> Array:
    """Vertical force on each foot that carries the robot, (M, 15), (M, 4) -> (M, 4) N.

    Half a sine over the stance, scaled such that the feet together carry the robot's weight on
    average over a cycle.
    """
    weight = GRAVITY * sum(geometry.masses.values())
    peak = 0.5 * np.pi * weight / (4.0 * command[:, INDEX["duration"], None])
    return peak * np.maximum(np.sin(2.0 * np.pi * phases), 0.0)


def load_torque(geometry: Geometry, q: Array, load: Array) -> Array:
    """Joint torques, (M, 12) N m, from a vertical ``load`` (M, 4) N on the feet at joint angles
    ``q`` (M, 12) rad: the last row of each foot's Jacobian times its load."""
    hip, thigh, calf = np.moveaxis(q.reshape(-1, 4, 3), -1, 0)
    x_thigh, x_calf = geometry.thigh * np.sin(thigh), geometry.calf * np.sin(thigh + calf)
    down = -geometry.thigh * np.cos(thigh) - geometry.calf * np.cos(thigh + calf)
    y = geometry.abduction * SIDE * np.cos(hip) - down * np.sin(hip)
    row = np.stack([y, (x_thigh + x_calf) * np.cos(hip), x_calf * np.cos(hip)], axis=-1)
    return (load[..., None] * row).reshape(-1, NUM_JOINTS)


def action_scale(config: RobotConfig) -> Array:
    """alpha of the paper, (12,) rad per unit action: hips move less than thighs and calves."""
    return config.action_scale * np.tile([config.hip_scale, 1.0, 1.0], 4)


def joint_targets(config: RobotConfig, geometry: Geometry, pose: Array, actions: Array) -> Array:
    """q* = q0 + alpha clip(a, -a_max, a_max): two (M, 12) -> (M, 12) rad (Sec. IV-A).

    Targets stay ``joint_margin`` away from the joint limits, as a motor driver would ensure.
    """
    clipped = np.clip(actions, -config.action_limit, config.action_limit)
    return np.clip(pose + action_scale(config) * clipped, *target_limits(config, geometry))


def target_limits(config: RobotConfig, geometry: Geometry) -> tuple[Array, Array]:
    """Lowest and highest joint targets, (12,) rad each; infinite if ``joint_margin`` is None."""
    if config.joint_margin is None:
        return np.full(NUM_JOINTS, -np.inf), np.full(NUM_JOINTS, np.inf)
    low, high = geometry.joint_limits.T
    return low + config.joint_margin, high - config.joint_margin


# rad/s from which dry friction is full, chosen by hand; a jump at 0 would chatter.
FRICTION_SPEED = 1.0


def pd_torque(
    error: Array, speed: Array, strength: Array, config: RobotConfig, friction: Array | float = 0.0
) -> Array:
    """Joint torques of the PD law within the motor limits, minus the joints' dry friction.

    Args:
        error: (M, 12) target minus angle, rad.
        speed: (M, 12) joint speed, rad/s.
        strength: (M, 1) or (M, 12) motor strength, a factor on gains and torque limits.
        config: gains and limits.
        friction: (M, 1) N m, dry friction in each joint.

    Returns:
        (M, 12) N m. A motor at its speed limit applies no torque that would drive it faster.
    """
    limit = np.array(4 * config.torque_limit) * strength
    torque = strength * (config.kp * error - config.kd * speed)
    np.minimum(torque, limit, out=torque)  # np.clip takes twice as long on small arrays
    np.maximum(torque, -limit, out=torque)
    fast = np.abs(speed) >= np.array(4 * config.speed_limit)
    if fast.any():
        torque[fast & (torque * speed > 0.0)] = 0.0
    if np.any(friction):
        torque -= friction * np.clip(speed / FRICTION_SPEED, -1.0, 1.0)
    return torque


def foot_kinematics(geometry: Geometry, q: Array, qd: Array) -> tuple[Array, Array]:
    """Foot centres and their velocities in the trunk's frame: two (M, 12) -> two (M, 4, 3)."""
    angle, rate = q.reshape(-1, 4, 3), qd.reshape(-1, 4, 3)
    hip, thigh, knee = angle[..., 0], angle[..., 1], angle[..., 1] + angle[..., 2]
    hip_d, thigh_d, knee_d = rate[..., 0], rate[..., 1], rate[..., 1] + rate[..., 2]
    st, ct = geometry.thigh * np.sin(thigh), geometry.thigh * np.cos(thigh)
    sk, ck = geometry.calf * np.sin(knee), geometry.calf * np.cos(knee)
    x, down = -st - sk, -ct - ck
    x_d, down_d = -ct * thigh_d - ck * knee_d, st * thigh_d + sk * knee_d
    sh, ch = np.sin(hip), np.cos(hip)
    out = geometry.abduction * SIDE
    y, z = out * ch - down * sh, out * sh + down * ch
    position = np.stack([x + geometry.hips[:, 0], y + geometry.hips[:, 1], z], axis=-1)
    velocity = np.stack([x_d, -z * hip_d - down_d * sh, y * hip_d + down_d * ch], axis=-1)
    return position, velocity


def leg_angles(geometry: Geometry, feet: Array) -> Array:
    """Joint angles for given foot centres, the inverse of ``foot_kinematics``.

    Args:
        geometry: the robot's geometry.
        feet: (M, 4, 3) m in the trunk's frame, below the hips.

    Returns:
        (M, 12) rad, each calf within its limits: a leg that cannot reach its foot points at it.
    """
    upper, lower = geometry.thigh, geometry.calf
    x, y, z = np.moveaxis(feet - np.pad(geometry.hips, ((0, 0), (0, 1))), -1, 0)
    out = geometry.abduction * SIDE
    down = np.sqrt(np.maximum(y * y + z * z - out * out, 0.0))  # below the thigh joint, hip at 0
    hip = wrap_angle(np.arctan2(z, y) - np.arctan2(-down, out))
    square = x * x + down * down
    bend = (square - upper * upper - lower * lower) / (2.0 * upper * lower)
    calf = np.clip(-np.arccos(np.clip(bend, -1.0, 1.0)), *geometry.joint_limits[2::3].T)
    lean = np.arctan2(lower * np.sin(calf), upper + lower * np.cos(calf))
    thigh = np.arctan2(-x, down) - lean
    return np.stack([hip, thigh, calf], axis=-1).reshape(len(feet), NUM_JOINTS)


def rotation_matrix(quaternion: Array) -> Array:
    """Body-to-world rotation matrices of quaternions (x, y, z, w): (M, 4) -> (M, 3, 3)."""
    x, y, z, w = quaternion.T
    matrix = np.empty((3, 3, len(quaternion)))  # filled faster than nine rows are joined
    matrix[0, 0], matrix[1, 1] = 1 - 2 * (y * y + z * z), 1 - 2 * (x * x + z * z)
    matrix[2, 2] = 1 - 2 * (x * x + y * y)
    for i, j, one, other in ((0, 1, x * y, z * w), (2, 0, x * z, y * w), (1, 2, y * z, x * w)):
        matrix[i, j], matrix[j, i] = 2 * (one - other), 2 * (one + other)
    return matrix.transpose(2, 0, 1)


def quaternion_product(one: Array, other: Array) -> Array:
    """Rotate by ``other`` and then by ``one``: two quaternions (..., 4) -> (..., 4)."""
    (ax, ay, az, aw), (bx, by, bz, bw) = np.moveaxis(one, -1, 0), np.moveaxis(other, -1, 0)
    return np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )


def to_goal(state: "RobotState", goal: Array) -> tuple[Array, Array]:
    """Horizontal distance from the trunks to ``goal`` (M, 2) m, (M,) m, and its direction in the
    world, (M,) rad."""
    offset = goal - state.position[:, :2]
    return np.linalg.norm(offset, axis=1), np.arctan2(offset[:, 1], offset[:, 0])


def to_world(xy: Array, yaw: Array, points: Array) -> tuple[Array, Array]:
    """World x and y, (M, n) m each, of ``points`` (n, 2) or (M, n, 2) m in the heading frames of M
    robots at ``xy`` (M, 2) m and ``yaw`` (M,) rad."""
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x = xy[:, :1] + c * points[..., 0] - s * points[..., 1]
    y = xy[:, 1:2] + s * points[..., 0] + c * points[..., 1]
    return x, y


def yaw_quaternion(yaw: Array) -> Array:
    """Quaternions (M, 4) of upright bodies with heading ``yaw`` (M,) rad."""
    zero = np.zeros_like(yaw)
    return np.stack([zero, zero, np.sin(0.5 * yaw), np.cos(0.5 * yaw)], axis=-1)


def wrap_angle(angle: Array) -> Array:
    """Wrap angles to [-pi, pi)."""
    return np.mod(angle + np.pi, 2.0 * np.pi) - np.pi


CONTACT_FORCE = 1.0  # N: a foot that presses harder is in contact, as in legged_gym


@dataclass
class RobotState:
    """State of M robots as simulated after a control step, and quantities derived from it.

    Attributes:
        geometry: the robots' geometry.
        position, quaternion: trunk in the world, (M, 3) m and (M, 4).
        lin_vel, ang_vel: trunk in the world, (M, 3) m/s and rad/s.
        q, qd, torque: joints, (M, 12) rad, rad/s and N m (torque of the last physics step; in
            Bullet less the dry friction, which MuJoCo applies by itself).
        foot_force: normal contact force on each foot in the last physics step, (M, 4) N.
        leg_force: the same on each leg above the foot (hip, thigh and calf), (M, 4) N.
        trunk_force: largest normal force on the trunk in the control step, (M,) N; in Bullet read
            once per joint control.
        rotor_excess: torques on joints and trunk that are given back in the next joint control,
            (M, 15) N m, see ``tdgc.sim.rotors``; 0 in MuJoCo.
    """

    geometry: Geometry
    position: Array
    quaternion: Array
    lin_vel: Array
    ang_vel: Array
    q: Array
    qd: Array
    torque: Array
    foot_force: Array
    leg_force: Array
    trunk_force: Array
    rotor_excess: Array
    rotation: Array = field(init=False)
    yaw: Array = field(init=False)
    gravity: Array = field(init=False)
    heading_vel: Array = field(init=False)
    foot_body: Array = field(init=False)
    foot_position: Array = field(init=False)
    foot_velocity: Array = field(init=False)

    @classmethod
    def zeros(cls, geometry: Geometry, num_robots: int) -> "RobotState":
        """A state of ``num_robots`` upright robots at the origin."""
        m = num_robots
        rows = [(m, n) for n in (3, 4, 3, 3, 12, 12, 12, 4, 4)]  # of the fields up to ``leg_force``
        shapes = [*rows, (m,), (m, NUM_JOINTS + 3)]
        state = cls(geometry, *(np.zeros(shape) for shape in shapes))
        state.quaternion[:, 3] = 1.0
        state.derive()
        return state

    @property
    def body_rate(self) -> Array:
        """Angular velocity in the body frame, as a gyro measures it, (M, 3) rad/s."""
        return np.einsum("mji,mj->mi", self.rotation, self.ang_vel)

    @property
    def touching(self) -> NDArray[np.bool_]:
        """Whether each foot is in contact, (M, 4)."""
        return self.foot_force > CONTACT_FORCE

    @property
    def power(self) -> Array:
        """Sum of the absolute mechanical power of the joints, (M,) W: braking recovers nothing."""
        return np.abs(self.torque * self.qd).sum(axis=1)

    def derive(self) -> None:
        """Compute the fields that follow from the simulated ones.

        ``gravity`` (M, 3) is the unit vector of gravity in the body frame, g^b of the paper.
        ``heading_vel`` (M, 3) m/s is the velocity (forward, left, up) in the heading frame, which
        is rotated by yaw alone. ``foot_body``, ``foot_position`` and ``foot_velocity`` (M, 4, 3)
        are the foot centres in the body frame and in the world, and their velocities in the world.
        """
        self.rotation = rotation_matrix(self.quaternion)
        self.yaw = np.arctan2(self.rotation[:, 1, 0], self.rotation[:, 0, 0])
        self.gravity = -self.rotation[:, 2, :]
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        vx, vy, vz = self.lin_vel.T
        self.heading_vel = np.stack([c * vx + s * vy, c * vy - s * vx, vz], axis=-1)
        self.foot_body, foot_vel = foot_kinematics(self.geometry, self.q, self.qd)
        turned = self.rotation[:, None]
        arm = (turned @ self.foot_body[..., None])[..., 0]
        self.foot_position = self.position[:, None] + arm
        self.foot_velocity = (
            self.lin_vel[:, None]
            + np.cross(self.ang_vel[:, None], arm)
            + (turned @ foot_vel[..., None])[..., 0]
        )
