"""The robot's kinematics against Bullet, its poses and motors; its URDF against its comments."""

import dataclasses
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from typing import Any

import numpy as np
import pybullet
import pytest

from tdgc.config import RobotConfig
from tdgc.sim.commands import INDEX, default_command
from tdgc.sim.gaits import FEET, GAIT_TABLE, foot_phases, swing_profile
from tdgc.sim.geometry import read_geometry
from tdgc.sim.robot import (
    HIGHEST_FOOT,
    Array,
    RobotState,
    commanded_pose,
    foot_kinematics,
    joint_targets,
    leg_angles,
    load_torque,
    nominal_height,
    nominal_pose,
    pd_torque,
    quaternion_product,
    rotation_matrix,
    stance_load,
    to_world,
    walking_pose,
    wrap_angle,
    yaw_quaternion,
)
from tdgc.sim.urdf import JOINTS, urdf_path

CONFIG = RobotConfig()
URDF, GEOMETRY = urdf_path(CONFIG), read_geometry(CONFIG)
# Dimensions of the shipped robot in m; test_geometry checks that its URDF is read as these.
HIP_X, HIP_Y, ABDUCTION, THIGH, CALF, FOOT_RADIUS = 0.183, 0.047, 0.08, 0.213, 0.213, 0.022


def quaternion(roll: float, pitch: float, yaw: float) -> Array:
    """Quaternion (1, 4), computed by Bullet."""
    return np.array([pybullet.getQuaternionFromEuler([roll, pitch, yaw])])


# ------------------------------------------------------------------ kinematics, against Bullet


class Body:
    """The robot in a Bullet client of its own."""

    def __init__(self) -> None:
        self.client = pybullet.connect(pybullet.DIRECT)
        self.body = pybullet.loadURDF(str(URDF), physicsClientId=self.client)
        links = range(pybullet.getNumJoints(self.body, self.client))
        info = [pybullet.getJointInfo(self.body, j, self.client) for j in links]
        self.joints = {entry[1].decode(): entry[0] for entry in info}

    def set(self, state: RobotState) -> None:
        """Set pose, joints and velocities to those of the first robot of ``state``."""
        body, where = self.body, {"physicsClientId": self.client}
        pose = state.position[0].tolist(), state.quaternion[0].tolist()
        pybullet.resetBasePositionAndOrientation(body, *pose, **where)
        speed = state.lin_vel[0].tolist(), state.ang_vel[0].tolist()
        pybullet.resetBaseVelocity(body, *speed, **where)
        for name, q, qd in zip(JOINTS, state.q[0], state.qd[0], strict=True):
            pybullet.resetJointState(body, self.joints[name], q, qd, **where)

    def foot(self, leg: str) -> tuple[Array, Array]:
        """Position and velocity of a foot's centre in the world."""
        link: Any = pybullet.getLinkState(
            self.body, self.joints[f"{leg}_calf_joint"], computeLinkVelocity=1,
            computeForwardKinematics=1, physicsClientId=self.client,
        )  # fmt: skip
        turned = np.array(pybullet.getMatrixFromQuaternion(link[5])).reshape(3, 3)
        position = np.array(link[4]) + turned @ [0.0, 0.0, -CALF]
        return position, np.array(link[6]) + np.cross(link[7], position - np.array(link[0]))


@pytest.fixture(scope="module")
def body() -> Iterator[Body]:
    made = Body()
    yield made
    pybullet.disconnect(made.client)


def random_state(seed: int) -> RobotState:
    rng = np.random.default_rng(seed)
    state = RobotState.zeros(GEOMETRY, 1)
    state.position[0] = rng.uniform(-2.0, 2.0, 3)
    state.quaternion = quaternion(*rng.uniform(-1.5, 1.5, 3))
    state.lin_vel, state.ang_vel = rng.uniform(-2, 2, (1, 3)), rng.uniform(-5, 5, (1, 3))
    state.q = rng.uniform(*GEOMETRY.joint_limits.T)[None]
    state.qd = rng.uniform(-15.0, 15.0, (1, 12))
    state.derive()
    return state


@pytest.mark.parametrize("seed", range(5))
def test_foot_positions_and_velocities_are_bullets(body: Body, seed: int) -> None:
    state = random_state(seed)
    body.set(state)
    for k, leg in enumerate(FEET):
        position, velocity = body.foot(leg)
        np.testing.assert_allclose(state.foot_position[0, k], position, atol=1e-9)
        np.testing.assert_allclose(state.foot_velocity[0, k], velocity, atol=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_rotation_yaw_and_gravity_are_bullets(seed: int) -> None:
    state = random_state(seed)
    matrix = pybullet.getMatrixFromQuaternion(state.quaternion[0].tolist())
    turned = np.array(matrix).reshape(3, 3)
    np.testing.assert_allclose(state.rotation[0], turned, atol=1e-12)
    np.testing.assert_allclose(state.gravity[0], turned.T @ [0.0, 0.0, -1.0], atol=1e-12)
    yaw = pybullet.getEulerFromQuaternion(state.quaternion[0].tolist())[2]
    assert state.yaw[0] == pytest.approx(yaw, abs=1e-9)


def test_foot_velocity_is_the_derivative_of_the_position() -> None:
    rng = np.random.default_rng(3)
    q, qd, step = rng.uniform(-1, 1, (6, 12)), rng.uniform(-10, 10, (6, 12)), 1e-6
    ahead, _ = foot_kinematics(GEOMETRY, q + step * qd, qd)
    behind, _ = foot_kinematics(GEOMETRY, q - step * qd, qd)
    _, velocity = foot_kinematics(GEOMETRY, q, qd)
    np.testing.assert_allclose(velocity, (ahead - behind) / (2 * step), atol=1e-7)


def test_legs_straight_down() -> None:
    feet, velocity = foot_kinematics(GEOMETRY, np.zeros((1, 12)), np.zeros((1, 12)))
    expected = [[0.183, 0.127, -0.426], [0.183, -0.127, -0.426],
                [-0.183, 0.127, -0.426], [-0.183, -0.127, -0.426]]  # fmt: skip
    np.testing.assert_allclose(feet[0], expected, atol=1e-12)
    assert (velocity == 0.0).all()


def test_signs_of_the_joints() -> None:
    """A positive thigh angle moves the foot back, a positive hip angle moves every foot left."""
    thigh, hip = np.zeros((1, 12)), np.zeros((1, 12))
    thigh[0, 1::3], hip[0, 0::3] = 0.3, 0.3
    feet, _ = foot_kinematics(GEOMETRY, thigh, np.zeros((1, 12)))
    np.testing.assert_allclose(
        feet[0, :, 0], GEOMETRY.hips[:, 0] - 0.426 * math.sin(0.3), atol=1e-12
    )
    feet, _ = foot_kinematics(GEOMETRY, hip, np.zeros((1, 12)))
    out = np.array([1.0, -1.0, 1.0, -1.0]) * 0.08 * math.cos(0.3) + 0.426 * math.sin(0.3)
    np.testing.assert_allclose(feet[0, :, 1], GEOMETRY.hips[:, 1] + out, atol=1e-12)


def test_state_in_the_heading_frame() -> None:
    """For a robot facing +y with its nose down, +y is forward and +x is to the right."""
    state = RobotState.zeros(GEOMETRY, 1)
    state.quaternion = quaternion(0.0, 0.2, math.pi / 2)
    state.lin_vel[0] = [0.3, 1.0, -0.2]
    state.derive()
    np.testing.assert_allclose(state.heading_vel[0], [1.0, -0.3, -0.2], atol=1e-12)
    np.testing.assert_allclose(state.gravity[0], [math.sin(0.2), 0.0, -math.cos(0.2)], atol=1e-12)
    assert state.yaw[0] == pytest.approx(math.pi / 2, abs=1e-12)


def test_zero_state_stands_upright_at_the_origin() -> None:
    state = RobotState.zeros(GEOMETRY, 2)
    assert state.gravity.tolist() == [[0.0, 0.0, -1.0]] * 2
    assert state.foot_position.shape == (2, 4, 3) and state.trunk_force.shape == (2,)
    np.testing.assert_allclose(state.foot_position[1, 3], [-0.183, -0.127, -0.426], atol=1e-12)


def test_yaw_quaternion_and_wrap_angle() -> None:
    yaw = np.array([0.0, 0.5, -3.0])
    made = rotation_matrix(yaw_quaternion(yaw))
    np.testing.assert_allclose(np.arctan2(made[:, 1, 0], made[:, 0, 0]), yaw, atol=1e-12)
    np.testing.assert_allclose(made[:, 2, 2], 1.0, atol=1e-12)
    angles = np.array([0.0, math.pi, -math.pi, 3.5, -3.5, 7.0])
    expected = [0.0, -math.pi, -math.pi, 3.5 - 2 * math.pi, 2 * math.pi - 3.5, 7 - 2 * math.pi]
    np.testing.assert_allclose(wrap_angle(angles), expected, atol=1e-12)


# ------------------------------------------------------------------ joints


def test_quaternion_product_turns_by_the_second_first() -> None:
    one, other = quaternion(0.3, -0.5, 1.0), quaternion(-1.2, 0.4, 0.2)
    both = rotation_matrix(quaternion_product(one, other))
    np.testing.assert_allclose(both, rotation_matrix(one) @ rotation_matrix(other), atol=1e-12)


def test_joint_order() -> None:
    assert JOINTS[:4] == ("FL_hip_joint", "FL_thigh_joint", "FL_calf_joint", "FR_hip_joint")
    assert len(JOINTS) == 12 and JOINTS[-1] == "RR_calf_joint"


def test_nominal_pose() -> None:
    assert nominal_pose(CONFIG).tolist() == [
        0.1, 0.8, -1.5, -0.1, 0.8, -1.5, 0.1, 1.0, -1.5, -0.1, 1.0, -1.5
    ]  # fmt: skip
    pose = nominal_pose(RobotConfig(nominal_hip=0.0, nominal_thigh=(1.0, 0.7), nominal_calf=-1.2))
    assert pose.reshape(4, 3)[:, 1].tolist() == [1.0, 1.0, 0.7, 0.7]
    assert pose.reshape(4, 3)[:, [0, 2]].tolist() == [[0.0, -1.2]] * 4


def test_nominal_pose_stands_at_about_the_stated_height() -> None:
    feet, _ = foot_kinematics(GEOMETRY, nominal_pose(CONFIG)[None], np.zeros((1, 12)))
    height = FOOT_RADIUS - feet[0, :, 2]
    np.testing.assert_allclose(height, CONFIG.base_height, atol=0.035)


def test_joint_targets_scale_and_clip() -> None:
    actions = np.zeros((3, 12))
    actions[1], actions[2] = 2.0, -100.0
    pose = np.tile(nominal_pose(CONFIG), (3, 1))
    free = dataclasses.replace(CONFIG, joint_margin=None)
    moved = joint_targets(free, GEOMETRY, pose, actions) - pose
    assert (moved[0] == 0.0).all()
    np.testing.assert_allclose(moved[1], np.tile([0.25, 0.5, 0.5], 4), atol=1e-12)
    np.testing.assert_allclose(moved[2], np.tile([-0.5, -1.0, -1.0], 4), atol=1e-12)


def test_joint_targets_keep_from_the_limits() -> None:
    """The calf's target of -1.5 + 4 x 0.25 rad stops 0.02 rad short of its limit of -0.89 rad."""
    pose, actions = nominal_pose(CONFIG)[None], np.full((1, 12), 4.0)
    targets = joint_targets(CONFIG, GEOMETRY, pose, actions)[0].reshape(4, 3)
    np.testing.assert_allclose(targets[:, 2], -0.89 - 0.02)
    np.testing.assert_allclose(targets[:, 1], [1.8, 1.8, 2.0, 2.0])  # within its limits
    free = dataclasses.replace(CONFIG, joint_margin=None)
    assert joint_targets(free, GEOMETRY, pose, actions)[0, 2] == pytest.approx(-0.5)


def commands(n: int, **changed: float) -> Array:
    """Default commands (n, 15), except for those named."""
    command = np.tile(default_command(), (n, 1))
    for name, value in changed.items():
        command[:, INDEX[name]] = value
    return command


def test_leg_angles_invert_the_kinematics() -> None:
    rng = np.random.default_rng(0)
    q = nominal_pose(CONFIG) + rng.uniform(-0.5, 0.5, (200, 12))
    feet, _ = foot_kinematics(GEOMETRY, q, np.zeros_like(q))
    np.testing.assert_allclose(leg_angles(GEOMETRY, feet), q, atol=1e-12)


def test_leg_angles_point_at_feet_out_of_reach() -> None:
    side = np.sign(GEOMETRY.hips[:, 1])
    under = np.column_stack(
        [GEOMETRY.hips[:, 0], GEOMETRY.hips[:, 1] + ABDUCTION * side, np.full(4, -0.6)]
    )
    angles = leg_angles(GEOMETRY, under[None])
    np.testing.assert_allclose(angles.reshape(4, 3)[:, 2], -0.89)
    reached, _ = foot_kinematics(GEOMETRY, angles, np.zeros((1, 12)))
    length = math.sqrt(THIGH**2 + CALF**2 + 2.0 * THIGH * CALF * math.cos(0.89))
    under[:, 2] = -length
    np.testing.assert_allclose(reached[0], under, atol=1e-12)


def test_commanded_pose_is_the_papers_at_default_commands() -> None:
    swing = np.random.default_rng(0).uniform(size=(5, 4))
    pose = commanded_pose(CONFIG, GEOMETRY, commands(5, vx=0.7, pitch=0.2, frequency=2.0), swing)
    np.testing.assert_allclose(pose, np.tile(nominal_pose(CONFIG), (5, 1)), atol=1e-12)


def test_commanded_pose_puts_feet_where_commands_say() -> None:
    rest, _ = foot_kinematics(GEOMETRY, nominal_pose(CONFIG)[None], np.zeros((1, 12)))
    swing = np.array([[1.0, 0.0, 0.5, 0.0]])
    command = commands(
        1, body_height=-0.05, stance_width=0.31, stance_length=0.40, swing_height=0.18
    )
    pose = commanded_pose(CONFIG, GEOMETRY, command, swing)
    feet, _ = foot_kinematics(GEOMETRY, pose, np.zeros((1, 12)))
    moved = (feet - rest)[0]
    np.testing.assert_allclose(moved[:, 0], [0.01, 0.01, -0.01, -0.01], atol=1e-9)
    np.testing.assert_allclose(moved[:, 1], [0.03, -0.03, 0.03, -0.03], atol=1e-9)
    np.testing.assert_allclose(moved[:, 2], [0.15, 0.05, 0.10, 0.05], atol=1e-9)


def test_commanded_pose_folds_no_leg_further_than_its_limit() -> None:
    command = commands(1, body_height=-0.1, swing_height=0.20)
    pose = commanded_pose(CONFIG, GEOMETRY, command, np.ones((1, 4)))
    feet, _ = foot_kinematics(GEOMETRY, pose, np.zeros((1, 12)))
    np.testing.assert_allclose(feet[0, :, 2], HIGHEST_FOOT, atol=1e-9)


def phases_of(rng: np.random.Generator, m: int) -> Array:
    return rng.uniform(size=(m, 4))


def test_walking_pose_puts_feet_where_commands_say() -> None:
    """Unloaded and halfway through its ramp: half of Raibert's travel, half of the swing height."""
    stiff = dataclasses.replace(CONFIG, kp=1e12)
    rng = np.random.default_rng(0)
    ahead = phases_of(rng, 6)
    command = commands(
        6, vx=0.5, vy=-0.2, yaw_rate=0.6, frequency=3.0, stance_width=0.3, swing_height=0.12
    )
    half = np.full(6, 0.5)  # of swing height and travel, as halfway through the first cycle
    pose = walking_pose(stiff, GEOMETRY, command, phases_of(rng, 6), ahead, half)
    feet, _ = foot_kinematics(GEOMETRY, pose, np.zeros((6, 12)))
    rest, _ = foot_kinematics(GEOMETRY, nominal_pose(CONFIG)[None], np.zeros((1, 12)))
    wider = 0.5 * (0.3 - default_command()[INDEX["stance_width"]])
    rest = rest + [[[0.0, wider, 0.0], [0.0, -wider, 0.0]] * 2]
    moved = feet - rest
    # The trunk is at 0.30 m, where the unloaded nominal pose would stand at 0.324 m.
    lift = nominal_height(CONFIG, GEOMETRY) - 0.30
    assert lift == pytest.approx(0.0238, abs=1e-4)
    np.testing.assert_allclose(moved[..., 2], lift + 0.06 * swing_profile(ahead), atol=1e-9)
    lead = 0.5 * (np.abs(1.0 - 2.0 * ahead) - 0.5) / 6.0  # s, half the lead of a stance of 1/6 s
    np.testing.assert_allclose(moved[..., 0], lead * (0.5 - 0.6 * rest[..., 1]), atol=1e-9)
    np.testing.assert_allclose(moved[..., 1], lead * (-0.2 + 0.6 * rest[..., 0]), atol=1e-9)


def test_walking_pose_turns_feet_about_the_trunk() -> None:
    """With the trunk rotated as commanded, the feet are where they are under a level trunk."""
    stiff, stance = dataclasses.replace(CONFIG, kp=1e12), np.full((2, 4), 0.25)
    command = commands(2)
    command[1, INDEX["pitch"]], command[1, INDEX["roll"]] = 0.25, -0.15
    pose = walking_pose(stiff, GEOMETRY, command, stance, stance, np.ones(2))
    feet, _ = foot_kinematics(GEOMETRY, pose, np.zeros((2, 12)))
    turned = rotation_matrix(quaternion(-0.15, 0.25, 0.0))[0] @ feet[1].T
    np.testing.assert_allclose(turned.T, feet[0], atol=1e-9)


def test_load_torque_does_the_work_of_the_load() -> None:
    rng = np.random.default_rng(1)
    q, qd = rng.normal(0.0, 0.7, (50, 12)), rng.normal(0.0, 3.0, (50, 12))
    load = rng.uniform(0.0, 80.0, (50, 4))
    _, velocity = foot_kinematics(GEOMETRY, q, qd)
    power = np.sum(load_torque(GEOMETRY, q, load) * qd, axis=1)
    np.testing.assert_allclose(power, np.sum(load * velocity[..., 2], axis=1), atol=1e-9)


@pytest.mark.parametrize("gait", range(4))
def test_stance_loads_carry_the_robot_over_a_cycle(gait: int) -> None:
    clock = (np.arange(1000) + 0.5) / 1000
    command = commands(1000, duration=0.42)
    command[:, 12:] = GAIT_TABLE[gait]
    phases = foot_phases(clock, command[:, 12:], command[:, INDEX["duration"]])
    load = stance_load(GEOMETRY, command, phases)
    assert (load[phases > 0.5] == 0.0).all()
    weight = 9.81 * sum(GEOMETRY.masses.values())
    np.testing.assert_allclose(load.mean(axis=0), weight / 4.0, rtol=1e-4)


def torque(error: float, speed: float, strength: float = 1.0) -> list[float]:
    """Torques of hip, thigh and calf, after checking that all legs agree."""
    shape = (2, 12)
    made = pd_torque(
        np.full(shape, error), np.full(shape, speed), np.full((2, 1), strength), CONFIG
    )
    legs = made.reshape(-1, 3)
    assert (legs == legs[0]).all()
    return legs[0].tolist()


def test_pd_law() -> None:
    np.testing.assert_allclose(torque(0.5, 1.0), [9.4, 9.4, 9.4], atol=1e-12)  # 20 / 2 - 0.6
    np.testing.assert_allclose(torque(-0.5, -1.0), [-9.4, -9.4, -9.4], atol=1e-12)
    np.testing.assert_allclose(torque(0.5, 1.0, 0.85), [7.99, 7.99, 7.99], atol=1e-12)


def test_torque_limits() -> None:
    np.testing.assert_allclose(torque(1.5, 0.0), [23.7, 23.7, 30.0], atol=1e-12)
    np.testing.assert_allclose(torque(-3.0, 0.0), [-23.7, -23.7, -35.5], atol=1e-12)
    np.testing.assert_allclose(torque(3.0, 0.0, 0.85), [20.145, 20.145, 30.175], atol=1e-12)


def test_a_joint_at_its_speed_limit_is_not_driven_faster() -> None:
    np.testing.assert_allclose(torque(1.5, 19.9), [18.06, 18.06, 18.06], atol=1e-12)
    np.testing.assert_allclose(torque(1.5, 20.0), [18.0, 18.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(torque(-2.0, -30.0), [0.0, 0.0, 0.0], atol=1e-12)
    # Braking is allowed at any speed.
    np.testing.assert_allclose(torque(0.0, 30.0), [-18.0, -18.0, -18.0], atol=1e-12)
    np.testing.assert_allclose(torque(0.0, -40.0), [23.7, 23.7, 24.0], atol=1e-12)


def test_strength_is_per_robot() -> None:
    made = pd_torque(np.full((2, 12), 0.5), np.zeros((2, 12)), np.array([[1.0], [0.5]]), CONFIG)
    assert made[0].tolist() == [10.0] * 12 and made[1].tolist() == [5.0] * 12


# ------------------------------------------------------------------ the URDF

ROOT = ElementTree.parse(URDF).getroot()
LINKS = {link.attrib["name"]: link for link in ROOT.findall("link")}


def find(element: ElementTree.Element, path: str) -> dict[str, str]:
    found = element.find(path)
    assert found is not None, path
    return found.attrib


def numbers(text: str) -> list[float]:
    return [float(word) for word in re.findall(r"-?\d+(?:\.\d+)?", text)]


def test_links_and_mass() -> None:
    legs = {f"{leg}_{part}" for leg in FEET for part in ("hip", "thigh", "calf")}
    assert set(LINKS) == {"trunk", *legs}
    mass = {name: float(find(link, "inertial/mass")["value"]) for name, link in LINKS.items()}
    assert mass["trunk"] == 5.6
    assert 12.0 <= sum(mass.values()) <= 13.0
    assert sum(mass.values()) == pytest.approx(12.6, abs=1e-9)


def box(mass: float, x: float, y: float, z: float) -> Array:
    return mass / 12 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])


def cylinder(mass: float, radius: float, length: float, axis: int) -> Array:
    inertia = np.full(3, mass * (3 * radius**2 + length**2) / 12)
    inertia[axis] = mass * radius**2 / 2
    return inertia


@pytest.mark.parametrize("name", LINKS)
def test_inertia_is_that_of_the_primitive_named_beside_it(name: str) -> None:
    text = URDF.read_text(encoding="utf-8")
    comment = re.search(rf'<!-- ([^>]*?) -->\s*<link name="{name}"', text)
    assert comment is not None
    stated = numbers(comment.group(1))
    mass = float(find(LINKS[name], "inertial/mass")["value"])
    centre = np.array(numbers(find(LINKS[name], "inertial/origin")["xyz"]))
    kind = name.split("_")[-1]
    if kind in ("trunk", "thigh"):
        expected = box(mass, *stated)
    elif kind == "hip":
        expected = cylinder(mass, *stated, axis=1)
    else:
        radius, length, shin, foot_radius, foot = stated
        assert shin + foot == pytest.approx(mass, abs=1e-12)
        middle = (shin * -length / 2 + foot * -CALF) / mass
        np.testing.assert_allclose(centre, [0.0, 0.0, middle], atol=1e-9)
        across = np.array([1.0, 1.0, 0.0])
        expected = cylinder(shin, radius, length, axis=2) + np.full(3, 0.4 * foot * foot_radius**2)
        expected += across * shin * (-length / 2 - middle) ** 2
        expected += across * foot * (-CALF - middle) ** 2
    inertia = find(LINKS[name], "inertial/inertia")
    given = [float(inertia[key]) for key in ("ixx", "iyy", "izz")]
    np.testing.assert_allclose(given, expected, atol=5.1e-7)
    assert [float(inertia[key]) for key in ("ixy", "ixz", "iyz")] == [0.0, 0.0, 0.0]


def test_only_primitives_and_no_meshes() -> None:
    shapes = {shape.tag for shape in ROOT.iterfind(".//geometry/*")}
    assert shapes == {"box", "cylinder", "sphere"}
    collisions = {shape.tag for shape in ROOT.iterfind(".//collision/geometry/*")}
    assert collisions == {"box", "sphere"}
    for leg in FEET:
        calf = LINKS[f"{leg}_calf"].findall("collision")
        foot = [c for c in calf if numbers(find(c, "origin")["xyz"]) == [0.0, 0.0, -CALF]]
        assert [float(find(c, "geometry/sphere")["radius"]) for c in foot] == [FOOT_RADIUS]


def test_joint_limits_effort_and_speed() -> None:
    joints = {joint.attrib["name"]: joint for joint in ROOT.findall("joint")}
    assert set(joints) == set(JOINTS)
    for i, name in enumerate(JOINTS):
        limit = {key: float(value) for key, value in find(joints[name], "limit").items()}
        assert [limit["lower"], limit["upper"]] == GEOMETRY.joint_limits[i].tolist()
        assert limit["effort"] == CONFIG.torque_limit[i % 3]
        assert limit["velocity"] == CONFIG.speed_limit[i % 3]
        low, high = GEOMETRY.joint_limits[i]
        assert low < nominal_pose(CONFIG)[i] < high


def test_joint_origins_and_axes() -> None:
    joints = {joint.attrib["name"]: joint for joint in ROOT.findall("joint")}
    for leg in FEET:
        front, left = 1 if leg[0] == "F" else -1, 1 if leg[1] == "L" else -1
        expected = {
            "hip": ([front * HIP_X, left * HIP_Y, 0.0], [1.0, 0.0, 0.0]),
            "thigh": ([0.0, left * ABDUCTION, 0.0], [0.0, 1.0, 0.0]),
            "calf": ([0.0, 0.0, -THIGH], [0.0, 1.0, 0.0]),
        }
        for part, (origin, axis) in expected.items():
            joint = joints[f"{leg}_{part}_joint"]
            assert numbers(find(joint, "origin")["xyz"]) == origin
            assert numbers(find(joint, "axis")["xyz"]) == axis


def test_left_and_right_are_mirror_images() -> None:
    for front in "FR":
        for part in ("hip", "thigh", "calf"):
            left, right = (LINKS[f"{front}{side}_{part}"] for side in "LR")
            for tag in ("mass", "inertia"):
                assert find(left, f"inertial/{tag}") == find(right, f"inertial/{tag}")
            for one, other in zip(left.iter("origin"), right.iter("origin"), strict=True):
                x, y, z = numbers(one.attrib["xyz"])
                assert numbers(other.attrib["xyz"]) == [x, -y, z]


def test_points_of_heading_frames_in_the_world() -> None:
    """For a robot facing +y, ahead is +y and left is -x."""
    xy, yaw = np.array([[1.0, 2.0], [3.0, 0.0]]), np.array([0.5 * math.pi, math.pi])
    x, y = to_world(xy, yaw, np.array([[0.3, 0.0], [0.0, 0.1]]))
    np.testing.assert_allclose(x, [[1.0, 0.9], [2.7, 3.0]])
    np.testing.assert_allclose(y, [[2.3, 2.0], [0.0, -0.1]], atol=1e-12)
