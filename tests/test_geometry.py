"""What is read from the URDFs of the shipped and other robots; which URDFs are refused, and why."""

import dataclasses
import re
import shutil
from pathlib import Path

import numpy as np
import pybullet
import pybullet_data
import pytest
import torch as th

import evaluate
import train_low
from tdgc.config import ConfigError, LowLevelConfig, PhysicsConfig, RobotConfig
from tdgc.deploy import graphs
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.commands import INDEX, default_command
from tdgc.sim.gaits import PhaseClock, foot_phases, swing_profile
from tdgc.sim.geometry import FRONT, SIDE, read_geometry
from tdgc.sim.robot import (
    check_nominal_pose,
    commanded_pose,
    fitted,
    foot_kinematics,
    leg_angles,
    nominal_pose,
    rotation_matrix,
    walking_pose,
)
from tdgc.sim.urdf import JOINTS, merged_file, read_urdf, urdf_path
from tdgc.tasks import low_rewards as rewards
from tdgc.tasks.low_env import LowLevelTask
from tdgc.tasks.pairing import PRETRAINED

SHIPPED = urdf_path(RobotConfig()).read_text(encoding="utf-8")
STILL, UPRIGHT = np.zeros((1, 12)), np.array([[0.0, 0.0, 0.0, 1.0]])


def larger(text: str) -> str:
    """The shipped URDF with longer legs, wider hips, larger feet, a heavier trunk, other limits."""
    for old, new in (
        ('xyz="0 0 -0.213"', 'xyz="0 0 -0.25"'),  # calf joints, knees and feet
        ('<origin xyz="0.183 ', '<origin xyz="0.22 '),
        ('<origin xyz="-0.183 ', '<origin xyz="-0.2 '),
        (' 0.047 0"', ' 0.06 0"'),
        (' -0.047 0"', ' -0.06 0"'),
        ('<origin xyz="0 0.08 0"', '<origin xyz="0 0.09 0"'),
        ('<origin xyz="0 -0.08 0"', '<origin xyz="0 -0.09 0"'),
        ('<mass value="5.6"/>', '<mass value="8.4"/>'),
        ('radius="0.022"', 'radius="0.03"'),
        ('lower="-2.82"', 'lower="-2.6"'),
    ):
        assert old in text
        text = text.replace(old, new)
    # Both front hips turn outwards by 0.9 and inwards by 0.7 rad, so their limits are mirrored.
    limits = 'lower="{}" upper="{}" effort="23.7" velocity="30"'
    for leg, low, high in (("FL", -0.7, 0.9), ("FR", -0.9, 0.7)):
        before, joint, after = text.partition(f'<joint name="{leg}_hip_joint"')
        text = (
            before + joint + after.replace(limits.format(-0.86, 0.86), limits.format(low, high), 1)
        )
    return text


@pytest.fixture
def robot(tmp_path: Path) -> RobotConfig:
    """The larger robot, with gains and a base height that suit it."""
    path = tmp_path / "larger.urdf"
    path.write_text(larger(SHIPPED), encoding="utf-8")
    return RobotConfig(urdf=str(path), kp=40.0, kd=1.0, base_height=0.35)


@pytest.fixture
def a1(tmp_path: Path) -> RobotConfig:
    """PyBullet's Unitree A1 with our joint names.

    Its feet and its IMU are links on fixed joints. The trunk's centre of mass is not at the origin
    of its frame, and its principal axes are rotated in it.
    """
    text = (Path(pybullet_data.getDataPath()) / "a1" / "a1.urdf").read_text(encoding="utf-8")
    text = re.sub("<visual>.*?</visual>", "", text, flags=re.DOTALL)  # without its meshes
    for part, ours in (("upper", "thigh"), ("lower", "calf")):
        text = text.replace(f"{part}_joint", f"{ours}_joint")
    path = tmp_path / "a1.urdf"
    path.write_text(text, encoding="utf-8")
    return RobotConfig(urdf=str(path), kp=40.0, kd=1.0, base_height=0.29)


def changed(folder: Path, *changes: tuple[str, str]) -> RobotConfig:
    """The shipped robot with each (old, new) of ``changes`` replaced everywhere in its URDF."""
    text, path = SHIPPED, folder / "changed.urdf"
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text, encoding="utf-8")
    return RobotConfig(urdf=str(path))


# ------------------------------------------------------------------ settings that fit a robot


def test_the_shipped_robots_settings_fit_itself() -> None:
    ours = RobotConfig()
    assert fitted(ours) == {name: getattr(ours, name) for name in fitted(ours)}


def test_settings_for_another_robot(a1: RobotConfig, robot: RobotConfig) -> None:
    """The A1: 12.458 kg to our 12.6, legs of 0.4 m to our 0.426, motor limits from its URDF."""
    found = fitted(a1)
    assert found == {
        "nominal_thigh": (0.8, 1.0), "nominal_calf": -1.5,
        "base_height": 0.28, "stance": (0.38, 0.26), "kp": 18.6, "kd": 0.54,
        "torque_limit": (20.0, 55.0, 55.0), "speed_limit": (52.4, 28.6, 28.6),
    }  # fmt: skip
    assert fitted(robot)["stance"] == (0.44, 0.3)
    assert fitted(robot)["kp"] == pytest.approx(20.0 * 15.4 / 12.6 * 0.5 / 0.426, abs=0.05)


def sagittal_feet(config: RobotConfig) -> np.ndarray:
    """Feet of the nominal pose ahead of and above the thigh joints, front and rear, (2, 2) m."""
    geometry = read_geometry(config)
    thigh, calf = np.array(config.nominal_thigh), config.nominal_calf
    ahead = -geometry.thigh * np.sin(thigh) - geometry.calf * np.sin(thigh + calf)
    up = -geometry.thigh * np.cos(thigh) - geometry.calf * np.cos(thigh + calf)
    return np.stack([ahead, up], axis=1)


def test_the_nominal_pose_fits_the_legs(tmp_path: Path) -> None:
    """With calves of 0.26 m instead of 0.213, feet are where ours are but 11 % further away."""
    foot = 'name="rubber"/></visual>\n    <collision><origin xyz="0 0 -0.{}"'
    long = changed(tmp_path, (foot.format(213), foot.format(26)))
    assert read_geometry(long).calf == pytest.approx(0.26)
    found = fitted(long)
    fits = dataclasses.replace(
        long, nominal_thigh=found["nominal_thigh"], nominal_calf=found["nominal_calf"]
    )
    expected = sagittal_feet(RobotConfig()) * (0.213 + 0.26) / 0.426
    np.testing.assert_allclose(sagittal_feet(fits), expected, atol=0.004)
    assert np.abs(sagittal_feet(long) - expected).max() > 0.02  # with our angles
    # Whoever has set another pose keeps it, and the height is that of this pose.
    own = fitted(dataclasses.replace(long, nominal_calf=-1.2))
    assert own["nominal_calf"] == -1.2 and own["base_height"] > found["base_height"]


def test_the_nominal_pose_keeps_the_calf_within_its_limits(tmp_path: Path) -> None:
    stiff = changed(tmp_path, ('upper="-0.89"', 'upper="-1.8"'))
    found = fitted(stiff)
    assert found["nominal_calf"] == pytest.approx(-1.82)
    # The feet stay on the same ray from the thigh joints.
    fits = dataclasses.replace(
        stiff, nominal_thigh=found["nominal_thigh"], nominal_calf=found["nominal_calf"]
    )
    rays = [np.arctan2(*sagittal_feet(config).T) for config in (RobotConfig(), fits)]
    np.testing.assert_allclose(rays[0], rays[1], atol=0.006)
    check_nominal_pose(fits, read_geometry(fits))


def test_the_gains_of_a_light_robot_are_not_rounded_to_zero(tmp_path: Path) -> None:
    masses = {f'mass value="{m}"': f'mass value="{m / 300:.6f}"' for m in (0.2, 0.6, 0.95, 5.6)}
    found = fitted(changed(tmp_path, *masses.items()))
    assert found["kp"] == pytest.approx(20.0 / 300, rel=0.01)
    assert found["kd"] == pytest.approx(0.6 / 300, rel=0.01)


def test_a_urdf_that_says_nothing_of_its_motors(tmp_path: Path) -> None:
    hips_and_thighs, calves = (' effort="23.7" velocity="30"', ""), (' effort="35.5"', "")
    silent = changed(tmp_path, hips_and_thighs, calves, (' velocity="20"', ""))
    posture = {"nominal_thigh", "nominal_calf", "base_height", "stance"}
    assert set(fitted(silent)) == posture | {"kp", "kd"}
    # What it says of some joints counts; the others have the shipped robot's limits.
    partly = changed(tmp_path, hips_and_thighs, (' effort="35.5"', ' effort="80"'))
    assert fitted(partly)["torque_limit"] == (23.7, 23.7, 80.0)
    assert fitted(partly)["speed_limit"] == (30.0, 30.0, 20.0)
    with pytest.raises(ConfigError, match=r"limit effort must be at least 0, not -1$"):
        fitted(changed(tmp_path, ('effort="35.5"', 'effort="-1"')))


# ------------------------------------------------------------------ what is read


def test_the_shipped_robot() -> None:
    geometry = read_geometry(RobotConfig())
    hips = [[0.183, 0.047], [0.183, -0.047], [-0.183, 0.047], [-0.183, -0.047]]
    assert geometry.hips.tolist() == hips
    assert (geometry.abduction, geometry.thigh, geometry.calf) == (0.08, 0.213, 0.213)
    assert (geometry.foot_radius, geometry.trunk_mass) == (0.022, 5.6)
    limits = [[-0.86, 0.86], [-0.69, 4.5], [-2.82, -0.89]] * 4
    assert geometry.joint_limits.tolist() == limits


def test_another_robot(robot: RobotConfig) -> None:
    geometry = read_geometry(robot)
    assert geometry.hips.tolist() == [[0.22, 0.06], [0.22, -0.06], [-0.2, 0.06], [-0.2, -0.06]]
    assert (geometry.abduction, geometry.thigh, geometry.calf) == (0.09, 0.25, 0.25)
    assert (geometry.foot_radius, geometry.trunk_mass) == (0.03, 8.4)
    assert geometry.joint_limits[::3].tolist() == [
        [-0.7, 0.9], [-0.9, 0.7], [-0.86, 0.86], [-0.86, 0.86]
    ]  # fmt: skip
    assert geometry.joint_limits[2::3].tolist() == [[-2.6, -0.89]] * 4


def test_a_robot_with_fixed_links(a1: RobotConfig) -> None:
    geometry = read_geometry(a1)
    assert geometry.hips.tolist() == read_geometry(RobotConfig()).hips.tolist()
    assert (geometry.abduction, geometry.thigh, geometry.calf) == (0.08505, 0.2, 0.2)
    assert (geometry.foot_radius, geometry.trunk_mass) == (0.02, 4.714)  # including an IMU of 1 g
    assert geometry.joint_limits[1].tolist() == [-1.0471975512, 4.18879020479]


def test_a_foot_on_links_that_are_turned(tmp_path: Path) -> None:
    """A foot on two fixed links is found where it is in the calf's frame, 22 cm down.

    The shin is 10 cm down the calf, rotated in roll, pitch and yaw; the foot on it is another 12 cm
    down in the calf's frame.
    """
    quaternion = pybullet.getQuaternionFromEuler([0.3, 0.2, 0.1])
    turned = np.reshape(pybullet.getMatrixFromQuaternion(quaternion), (3, 3))
    down = " ".join(map(str, turned.T @ [0.0, 0.0, -0.12]))
    foot = '<collision><origin xyz="0 0 -0.213" rpy="0 0 0"/><geometry><sphere radius="0.022"/>'
    foot += "</geometry></collision>"
    assert foot in SHIPPED  # of the feet, and of the knees too
    inertia = '<inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" iyz="0"/>'
    link = f'<inertial><mass value="0.01"/>{inertia}</inertial>'
    text = SHIPPED.replace(foot, "")
    for leg in ("FL", "FR", "RL", "RR"):
        text = text.replace(
            "</robot>",
            f'<joint name="{leg}_a" type="fixed"><parent link="{leg}_calf"/><child link="{leg}_s"/>'
            '<origin xyz="0 0 -0.1" rpy="0.3 0.2 0.1"/></joint>'
            f'<link name="{leg}_s">{link}</link>'
            f'<joint name="{leg}_b" type="fixed"><parent link="{leg}_s"/><child link="{leg}_f"/>'
            f'<origin xyz="{down}"/></joint>'
            f'<link name="{leg}_f">{link}<collision><geometry><sphere radius="0.025"/></geometry>'
            "</collision></link></robot>",
        )
    path = tmp_path / "shins.urdf"
    path.write_text(text, encoding="utf-8")
    geometry = read_geometry(RobotConfig(urdf=str(path)))
    assert geometry.calf == pytest.approx(0.22, abs=1e-9)
    assert geometry.foot_radius == 0.025


def test_legs_and_their_sides() -> None:
    assert JOINTS[:4] == ("FL_hip_joint", "FL_thigh_joint", "FL_calf_joint", "FR_hip_joint")
    assert FRONT.tolist() == [1.0, 1.0, -1.0, -1.0] and SIDE.tolist() == [1.0, -1.0, 1.0, -1.0]


def test_names_of_links_and_order_do_not_matter(tmp_path: Path) -> None:
    path = tmp_path / "renamed.urdf"
    text = re.sub(r'"trunk"', '"body"', SHIPPED).replace('_calf"', '_shank"')
    legs = re.findall(r'  <joint name=.*?(?=\n  <joint name="\w\w_hip|\n</robot>)', text, re.DOTALL)
    assert len(legs) == 4
    head, tail = text[: text.index(legs[0])], "\n</robot>\n"
    path.write_text(head + "\n".join(reversed(legs)) + tail, encoding="utf-8")
    geometry = read_geometry(RobotConfig(urdf=str(path)))
    assert geometry.hips.tolist() == read_geometry(RobotConfig()).hips.tolist()


# ------------------------------------------------------------------ another robot in all modules


def feet_by_bullet(world: BulletWorld) -> np.ndarray:
    """Foot positions of robot 0, from Bullet's poses of its calves, (4, 3) m."""
    body, client = world._bodies[0], world._client_of[0]
    feet = []
    for k in range(4):
        link = client.getLinkState(body, world._joints[3 * k + 2], 0, 1)
        down = [0.0, 0.0, -world.state.geometry.calf]
        feet.append(np.array(link[4]) + rotation_matrix(np.array([link[5]]))[0] @ down)
    return np.array(feet)


@pytest.mark.parametrize("which", ["robot", "a1"])
def test_kinematics_of_another_robot_are_bullets(
    which: str, request: pytest.FixtureRequest
) -> None:
    """Foot positions agree with Bullet's in any attitude, before and after a step."""
    config = request.getfixturevalue(which)
    world, rng = BulletWorld(1, config, PhysicsConfig()), np.random.default_rng(0)
    nothing = np.zeros(1), np.zeros((1, 12))
    try:
        for _ in range(5):
            quaternion = np.array([pybullet.getQuaternionFromEuler(rng.uniform(-1.5, 1.5, 3))])
            q = rng.uniform(*world.state.geometry.joint_limits.T)[None]
            world.reset_robots([0], rng.uniform(4.0, 5.0, (1, 3)), quaternion, q)
            np.testing.assert_allclose(world.state.foot_position[0], feet_by_bullet(world), 0, 1e-6)
            world.step(q[None], *nothing)
            np.testing.assert_allclose(world.state.foot_position[0], feet_by_bullet(world), 0, 1e-6)
    finally:
        world.close()


def test_trunk_that_turns_about_its_frame(tmp_path: Path) -> None:
    """The frame rests; the centre of mass, 2 cm ahead, moves left at 2 rad/s x 2 cm = 0.04 m/s."""
    trunk = '<origin xyz="0 0 0" rpy="0 0 0"/>\n      <mass value="5.6"/>'
    config = changed(tmp_path, (trunk, trunk.replace("0 0 0", "0.02 0 0", 1)))
    world = BulletWorld(1, config, PhysicsConfig())
    state, client, body = world.state, world._client_of[0], world._bodies[0]
    world.reset_robots([0], np.array([[1.0, 2.0, 3.0]]), UPRIGHT, nominal_pose(config)[None])
    state.ang_vel[0, 2] = 2.0
    world.push([0], np.zeros((1, 3)))
    centre, _ = client.getBasePositionAndOrientation(body)
    velocity, _ = client.getBaseVelocity(body)
    world._read_trunks(np.arange(1))
    world.close()
    np.testing.assert_allclose(centre, [1.02, 2.0, 3.0], atol=1e-12)
    np.testing.assert_allclose(velocity, [0.0, 0.04, 0.0], atol=1e-12)
    np.testing.assert_allclose(state.position, [[1.0, 2.0, 3.0]], atol=1e-12)
    np.testing.assert_allclose(state.lin_vel, 0.0, atol=1e-12)


def test_trunk_with_turned_inertia(a1: RobotConfig) -> None:
    """Pose and velocities are read back as set, though the principal axes differ from the frame."""
    world = BulletWorld(1, a1, PhysicsConfig())
    state, client, body = world.state, world._client_of[0], world._bodies[0]
    quaternion = np.array([pybullet.getQuaternionFromEuler([0.3, -0.5, 1.0])])
    world.reset_robots([0], np.array([[1.0, 2.0, 3.0]]), quaternion, nominal_pose(a1)[None])
    state.ang_vel[:], state.lin_vel[:] = [1.0, -2.0, 0.5], [0.3, 0.2, 0.1]
    world.push([0], np.zeros((1, 3)))
    put = [x.copy() for x in (state.position, state.quaternion, state.lin_vel, state.ang_vel)]
    _, axes = client.getBasePositionAndOrientation(body)
    world._read_trunks(np.arange(1))
    world.close()
    assert np.abs(np.array(axes) - quaternion[0]).max() > 1e-3
    read = state.position, state.quaternion, state.lin_vel, state.ang_vel
    for one, other in zip(read, put, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)


def test_a_robot_with_fixed_links_stands_on_its_feet(a1: RobotConfig) -> None:
    """Its feet carry all its weight, including that of the fixed feet and shoulders."""
    a1 = dataclasses.replace(a1, commanded_gait=False)
    task = LowLevelTask(LowLevelConfig(robot=a1), 1, seed=0, training=False)
    task.reset(np.arange(1))
    for _ in range(100):
        task.locomotion.command[:] = default_command()
        _, terminated, _ = task.step(np.zeros((1, 12)))
        assert not terminated.any()
    state = task.locomotion.world.state
    task.locomotion.world.close()
    assert state.position[0, 2] == pytest.approx(0.29, abs=0.01)
    assert state.foot_force.sum() == pytest.approx(12.458 * 9.81, rel=0.02)
    assert (state.leg_force == 0.0).all() and (state.trunk_force == 0.0).all()


def test_what_is_fixed_to_the_trunk_is_its_own(tmp_path: Path) -> None:
    """A keel 30 cm below the trunk carries the robot, and its contact counts as the trunk's."""
    keel = (
        '<joint name="keel" type="fixed"><parent link="trunk"/><child link="keel"/></joint>'
        '<link name="keel"><inertial><mass value="0.1"/><inertia ixx="1e-3" iyy="1e-3" izz="1e-3" '
        'ixy="0" ixz="0" iyz="0"/></inertial><collision>'
        '<origin xyz="0 0 -0.3"/><geometry><sphere radius="0.1"/></geometry></collision></link>'
    )
    config = changed(tmp_path, ("</robot>", f"{keel}</robot>"))
    world = BulletWorld(1, config, PhysicsConfig())
    pose = nominal_pose(config)[None]
    world.reset_robots([0], np.array([[0.0, 0.0, 0.41]]), UPRIGHT, pose)
    for _ in range(10):
        world.step(pose[None], np.zeros(1), np.zeros((1, 12)))
    state = world.state
    world.close()
    assert state.trunk_force[0] > 100.0
    assert (state.leg_force == 0.0).all() and (state.foot_force == 0.0).all()


TURNED = (
    '<joint name="mast" type="fixed"><parent link="FL_thigh"/><child link="mast"/>'
    '<origin xyz="0.03 -0.05 -0.1" rpy="0.4 -0.3 1.2"/></joint><link name="mast"><inertial>'
    '<origin xyz="0.01 0.02 0.04" rpy="0.5 0.1 -0.7"/><mass value="0.8"/>'
    '<inertia ixx="4e-3" iyy="3e-3" izz="2e-3" ixy="5e-4" ixz="-3e-4" iyz="2e-4"/></inertial>'
    '<collision><origin xyz="0.1 0 0" rpy="0 0.6 0.2"/><geometry><box size="0.3 0.1 0.02"/>'
    "</geometry></collision></link></robot>"
)


def by_itself(urdf: Path) -> tuple[np.ndarray, np.ndarray]:
    """What Bullet makes of a URDF without this package.

    Returns:
        The joint angles and the pose of the FL hip over 0.2 s of random torques in mid-air, without
        gravity, (80, 19); and the hit fractions of 400 rays from above, (400,), 1 for a miss.
    """
    client, rng = pybullet.connect(pybullet.DIRECT), np.random.default_rng(0)
    whole = pybullet.URDF_USE_INERTIA_FROM_FILE
    body = pybullet.loadURDF(str(urdf), [0, 0, 1], flags=whole, physicsClientId=client)
    links = range(pybullet.getNumJoints(body, client))
    named = {pybullet.getJointInfo(body, k, client)[1].decode(): k for k in links}
    joints = [named[name] for name in JOINTS]
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 20), np.linspace(-0.3, 0.3, 20))
    above, below = (np.stack([x, y, np.full_like(x, z)], -1).reshape(-1, 3) for z in (2.0, 0.0))
    pybullet.performCollisionDetection(client)  # shapes have no bounds without it
    hits = pybullet.rayTestBatch(above.tolist(), below.tolist(), physicsClientId=client)
    for k in (-1, *links):
        pybullet.setCollisionFilterGroupMask(body, k, 0, 0, client)
        pybullet.changeDynamics(
            body, k, linearDamping=0, angularDamping=0, jointDamping=0, physicsClientId=client
        )
    pybullet.setJointMotorControlArray(
        body, joints, pybullet.VELOCITY_CONTROL, forces=[0.0] * 12, physicsClientId=client
    )
    pybullet.setTimeStep(1 / 400, client)
    path = []
    for _ in range(80):
        torque = rng.uniform(-3.0, 3.0, 12).tolist()
        pybullet.setJointMotorControlArray(
            body, joints, pybullet.TORQUE_CONTROL, forces=torque, physicsClientId=client
        )
        pybullet.stepSimulation(client)
        angles = [state[0] for state in pybullet.getJointStates(body, joints, client)]
        hip = pybullet.getLinkState(body, joints[0], 0, 1, client)
        path.append([*angles, *hip[4], *hip[5]])
    pybullet.disconnect(client)
    return np.array(path), np.array([hit[2] for hit in hits])


@pytest.mark.parametrize("which", ["a1", "turned"])
def test_what_is_fixed_moves_with_its_carrier(
    which: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """Merged links move and stop rays as in Bullet, which simulates each as a separate body."""
    config = changed(tmp_path, ("</robot>", TURNED)) if which == "turned" else None
    config = config or request.getfixturevalue("a1")
    with merged_file(read_urdf(config)) as merged:
        assert merged.read_text(encoding="utf-8").count("<link ") == 13
        (one, seen), (other, seen_too) = by_itself(urdf_path(config)), by_itself(merged)
    assert not merged.exists()
    assert np.ptp(one, axis=0).max() > 0.3 and (seen < 1.0).sum() > 50
    np.testing.assert_allclose(other, one, atol=1e-5)
    np.testing.assert_allclose(seen_too, seen, atol=1e-9)


def test_nothing_fixed_nothing_written() -> None:
    with merged_file(read_urdf(RobotConfig())) as merged:
        assert merged == urdf_path(RobotConfig())


def test_meshes_are_found_from_elsewhere(tmp_path: Path) -> None:
    """They may be relative to the URDF or its package; other names stay, for Bullet to report."""
    (tmp_path / "dog" / "urdf").mkdir(parents=True)
    (tmp_path / "dog" / "hull.stl").touch()
    (tmp_path / "dog" / "urdf" / "mast.stl").touch()
    names = ("mast.stl", "../hull.stl", "package://dog/hull.stl", "hull.stl", "package://dog/x.stl")
    shapes = "".join(
        f'<visual><geometry><mesh filename="{name}"/></geometry></visual>' for name in names
    )
    path = tmp_path / "dog" / "urdf" / "dog.urdf"
    path.write_text(
        SHIPPED.replace("</robot>", TURNED.replace("<collision>", shapes + "<collision>"))
    )
    with merged_file(read_urdf(RobotConfig(urdf=str(path)))) as merged:
        found = re.findall('mesh filename="(.*?)"', merged.read_text())
    assert [Path(name).is_file() for name in found] == [True, True, True, False, False]
    assert found[3:] == ["hull.stl", "package://dog/x.stl"]


def test_rotor_inertia_is_about_the_joint_in_any_inertial_frame(tmp_path: Path) -> None:
    """Legs whose inertial frames are turned by 90 degrees swing as before."""
    level = '<origin xyz="0 0 -0.133125" rpy="0 0 0"/>\n      <mass value="0.2"/>'
    turned = changed(tmp_path, (level, level.replace('rpy="0 0 0"', 'rpy="0 0 1.5707963"')))
    swung = []
    for config in (RobotConfig(), turned):
        world = BulletWorld(1, config, PhysicsConfig())
        world.reset_robots([0], np.array([[0.0, 0.0, 2.0]]), UPRIGHT, nominal_pose(config)[None])
        world.armature[0] = 0.02
        world.apply_dynamics([0])
        for _ in range(3):
            world.step(nominal_pose(config)[None, None] + 0.3, np.zeros(1), np.zeros((1, 12)))
        swung.append(world.state.q[0])
        world.close()
    np.testing.assert_allclose(swung[1], swung[0], atol=1e-5)


def test_nominal_pose_beyond_the_joint_limits(tmp_path: Path) -> None:
    config = changed(tmp_path, ('lower="-2.82" upper="-0.89"', 'lower="-1.2" upper="-0.89"'))
    said = r"robot\.nominal_calf puts FL_calf_joint at -1\.5 rad; .*urdf allows -1\.2 to -0\.89$"
    with pytest.raises(ConfigError, match=said):
        BulletWorld(1, config, PhysicsConfig())
    BulletWorld(1, dataclasses.replace(config, nominal_calf=-1.0), PhysicsConfig()).close()


def test_leg_angles_of_another_robot(robot: RobotConfig) -> None:
    geometry, rng = read_geometry(robot), np.random.default_rng(1)
    q = nominal_pose(robot) + rng.uniform(-0.4, 0.4, (200, 12))
    feet, _ = foot_kinematics(geometry, q, np.zeros_like(q))
    np.testing.assert_allclose(leg_angles(geometry, feet), q, atol=1e-12)
    # With the same angles, the shipped robot's feet would be elsewhere.
    shipped, _ = foot_kinematics(read_geometry(RobotConfig()), q, np.zeros_like(q))
    assert np.abs(feet - shipped).min(axis=0).max() > 0.03


def test_payload_is_on_top_of_its_own_trunk(robot: RobotConfig) -> None:
    world = BulletWorld(1, robot, PhysicsConfig())
    world.payload[0] = 2.1
    world.apply_dynamics([0])
    mass, _, inertia, *_ = world._client_of[0].getDynamicsInfo(world._bodies[0], -1)
    world.close()
    assert mass == pytest.approx(10.5)
    np.testing.assert_allclose(inertia, np.array([0.016147, 0.068159, 0.073013]) * 1.25, rtol=1e-6)


def test_another_robot_stands_at_the_commanded_height(robot: RobotConfig) -> None:
    """With zero actions it stands on its feet at its base height, or 3 cm lower if commanded to."""
    robot = dataclasses.replace(robot, commanded_gait=False)
    task = LowLevelTask(LowLevelConfig(robot=robot), 2, seed=0, training=False)
    task.reset(np.arange(2))
    state = task.locomotion.world.state
    np.testing.assert_allclose(state.foot_position[..., 2].min(axis=1), 0.03, atol=1e-12)
    command = np.tile(default_command(), (2, 1))
    command[1, INDEX["body_height"]] = -0.03
    for _ in range(100):
        task.locomotion.command[:] = command
        _, terminated, _ = task.step(np.zeros((2, 12)))
        assert not terminated.any()
    task.locomotion.world.close()
    np.testing.assert_allclose(state.position[:, 2], [0.35, 0.32], atol=0.01)
    np.testing.assert_allclose(state.foot_position[..., 2], 0.03, atol=3e-3)
    assert state.foot_force.sum(axis=1) == pytest.approx([15.4 * 9.81] * 2, rel=0.02)
    assert (state.leg_force == 0.0).all()


def test_commanded_and_exported_pose_of_another_robot(robot: RobotConfig) -> None:
    geometry, rng = read_geometry(robot), np.random.default_rng(2)
    command = np.tile(default_command(), (20, 1))
    for name, low, high in (
        ("body_height", -0.03, 0.03), ("stance_width", 0.2, 0.35), ("stance_length", 0.33, 0.43)
    ):  # fmt: skip
        command[:, INDEX[name]] = rng.uniform(low, high, 20)
    clock = PhaseClock(20)
    clock.reset(np.arange(20), rng.uniform(size=20))
    clock.update(command[:, 12:], command[:, INDEX["duration"]])
    pose = commanded_pose(robot, geometry, command, swing_profile(clock.phases))
    feet, _ = foot_kinematics(geometry, pose, np.zeros_like(pose))
    rest, _ = foot_kinematics(geometry, nominal_pose(robot)[None], STILL)
    moved = np.broadcast_to(-command[:, INDEX["body_height"], None], (20, 4))
    np.testing.assert_allclose((feet - rest)[..., 2], moved, atol=1e-9)
    frequency, duty = command[:, INDEX["frequency"]], command[:, INDEX["duration"]]
    now, ahead = (
        foot_phases((clock.clock + time * frequency) % 1.0, command[:, 12:], duty)
        for time in (0.01, 0.01 + robot.kd / robot.kp)
    )
    walking = walking_pose(robot, geometry, command, now, ahead, np.ones(20))
    assert np.abs(walking - pose).max() > 0.1  # footholds, and 15 kg on stiffer joints
    for gait, wanted in ((False, pose), (True, walking)):
        graph = graphs.Pose(dataclasses.replace(robot, commanded_gait=gait), 0.02)
        for k in range(20):
            told = graphs.by_command(th.from_numpy(command[k]))
            times = clock.clock[k] + graph.ahead * told["frequency"]
            found = graph(graphs.foot_phases(times, told), th.ones(()), told)
            np.testing.assert_allclose(found.numpy(), wanted[k], atol=1e-6)


def test_the_graph_bends_a_leg_whose_calf_is_longer_than_its_thigh(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With the foot near the hip, the calf leans by more than a right angle."""
    shipped = read_geometry(RobotConfig())
    limits = np.tile([-2.9, 2.9], (12, 1))
    long = dataclasses.replace(shipped, thigh=0.15, calf=0.25, joint_limits=limits)
    monkeypatch.setattr(graphs, "read_geometry", lambda robot: long)
    graph, rng = graphs.Pose(RobotConfig(), 0.02), np.random.default_rng(0)
    offset = np.stack([rng.uniform(-0.1, 0.1, 4), 0.08 * np.array([1, -1, 1, -1])], axis=1)
    for height in (-0.11, -0.2, -0.3):
        feet = np.column_stack([long.hips + offset, np.full(4, height)])
        place = [th.from_numpy(part)[None] for part in (*offset.T, np.full(4, height))]
        found = th.cat(graph._angles(*place)).T.flatten()
        np.testing.assert_allclose(found.numpy(), leg_angles(long, feet[None])[0], atol=1e-6)


def test_rewards_know_another_robots_limits(robot: RobotConfig) -> None:
    """A knee at its limit of -2.6 rad is 0.0855 rad beyond the middle 0.9 of -2.6..-0.89 rad."""
    task = LowLevelTask(LowLevelConfig(robot=robot), 1, seed=0)
    q = nominal_pose(robot)
    q[2] = -2.6
    task.locomotion.world.reset_robots([0], np.array([[0.0, 0.0, 1.0]]), UPRIGHT, q[None])
    step = task._low_step(np.zeros((1, 12)))
    task.locomotion.world.close()
    np.testing.assert_allclose(rewards.joint_limits(step), [0.05 * (2.6 - 0.89)], atol=1e-12)
    swing = dataclasses.replace(step, contact=np.zeros((1, 4)), swing=np.zeros((1, 4)))
    on_ground = dataclasses.replace(swing, foot_height=np.full((1, 4), 0.03))
    assert rewards.swing_height(on_ground).tolist() == [0.0]


# ------------------------------------------------------------------ what is refused


def test_a_urdf_that_is_not_there() -> None:
    with pytest.raises(ConfigError, match=r"^robot\.urdf: no file 'urdf/centipede\.urdf' here"):
        read_geometry(RobotConfig(urdf="urdf/centipede.urdf"))


def test_a_urdf_that_is_not_the_repositorys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file of the same name in the working folder would silently replace the shipped robot."""
    own = tmp_path / RobotConfig().urdf
    own.parent.mkdir()
    own.write_text(SHIPPED, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert urdf_path(RobotConfig()) == own
    own.write_text(SHIPPED.replace("23.7", "33.5"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"'urdf/quadruped\.urdf' here is not the repository's"):
        urdf_path(RobotConfig())
    assert urdf_path(RobotConfig(urdf=str(own))) == own


def test_a_urdf_elsewhere(tmp_path: Path) -> None:
    copy = tmp_path / "copy.urdf"
    copy.write_text(SHIPPED, encoding="utf-8")
    assert urdf_path(RobotConfig(urdf=str(copy))) == copy


FL_HIP = '<origin xyz="0.183 0.047 0" rpy="0 0 0"/>'
FIXED = '<joint name="imu_joint" type="fixed"><parent link="trunk"/><child link="imu"/></joint>'
DIFFERS = "legs must be equal, mirrored left to right"

#: Text in the shipped URDF, its replacement everywhere, and how the message continues after the
#: file's name.
REFUSED = [
    ("</robot>", "", r"not an XML file: no element found"),
    ("<robot ", "<!DOCTYPE robot><robot ", r"a URDF has no document type \(<!DOCTYPE>\)"),
    ("RR_thigh_joint", "RR_knee_joint", r"lacks the joints RR_thigh_joint"),
    ("</robot>", f"{FIXED}</robot>", r"joint 'imu_joint': its child must be a link of its own"),
    (
        "</robot>",
        f"{FIXED}<link name='imu'/></robot>",
        r"link 'imu': inertial/mass value must be a",
    ),
    (
        "</robot>",
        FIXED.replace("fixed", "continuous") + "</robot>",
        r"has the joint 'imu_joint' beside the twelve of its legs",
    ),
    ("</robot>", "<link name='imu'/></robot>", r"link 'imu': belongs to no leg and is not fixed"),
    (
        "</robot>",
        re.sub("<inertia .*?/>", "", TURNED),
        r"link 'mast': inertial/inertia ixx must be a number",
    ),
    (
        'iyy="0.000635"',
        'iyy="-0.000635"',
        r"link 'FL_hip': its principal moments of inertia must be positive and none above",
    ),
    ('izz="0.073013"', 'izz="0.1"', r"link 'trunk': .* not 0\.016147, 0\.068159, 0\.1$"),
    ("</robot>", "<link name='FL_hip'/></robot>", r"two of its links have one name"),
    ('<link name="RR_calf">', '<link name="RR_shin">', r".*link 'RR_calf', which is missing"),
    ("revolute", "fixed", r"joint 'FL_hip_joint': must be revolute about the axis 1 0 0"),
    ('<parent link="FL_hip"/>', '<parent link="FR_hip"/>', r"joint 'FL_thigh_joint': its parent"),
    ("revolute", "continuous", r"joint 'FL_hip_joint': must be revolute about the axis 1 0 0"),
    ('<axis xyz="1 0 0"/>', '<axis xyz="-1 0 0"/>', r"joint 'FL_hip_joint': .* axis 1 0 0"),
    ('<axis xyz="0 1 0"/>', '<axis xyz="0 0 1"/>', r"joint 'FL_thigh_joint': .* axis 0 1 0"),
    (FL_HIP, FL_HIP.replace("0.047 0", "0.047 0.1"), r"joint 'FL_hip_joint': .* x y 0, x > 0 in"),
    (FL_HIP, FL_HIP.replace("0.183", "-0.183"), r"joint 'FL_hip_joint': its origin must be x y 0"),
    (FL_HIP, FL_HIP.replace("0.183", "0.2"), rf"the origin of FR_hip_joint .* FL.*: {DIFFERS}"),
    (FL_HIP, FL_HIP.replace('rpy="0', 'rpy="0.1'), r"joint 'FL_hip_joint': .* turned, rpy 0 0 0"),
    (FL_HIP, FL_HIP.replace("0.183", "nan"), r"joint 'FL_hip_joint': origin xyz must be 3 numbers"),
    ('"0 -0.08 0"', '"0 -0.09 0"', rf"the origin of FR_thigh_joint .* FL_thigh_joint: {DIFFERS}"),
    ('"0 -0.08 0"', '"0.01 -0.08 0"', r"joint 'FR_thigh_joint': its origin must be 0 y 0"),
    ('lower="-2.82"', 'lower="0.1"', r"joint 'FL_calf_joint': its limits must be lower < upper"),
    ('lower="-2.82" upper="-0.89"', 'lower="0.89" upper="2.82"', r".*: a knee bends to negative"),
    ('lower="-0.86"', 'lower="-0.5"', rf"the limits of FR_hip_joint .* FL_hip_joint: {DIFFERS}"),
    ('lower="-0.86"', "", r"joint 'FL_hip_joint': limit lower must be a number, not ''"),
    (
        '<sphere radius="0.022"/>',
        '<box size="1 1 1"/>',
        r"link 'FL_calf': its lowest collision shape",
    ),
    ("collision", "collided", r"link 'FL_calf': its lowest collision shape must be its foot"),
    ('<sphere radius="0.022"/>', "<sphere/>", r".*geometry/sphere radius must be a"),
    (
        '0 -0.213" rpy="0 0 0"/><geometry><sphere',
        '0.01 -0.213" rpy="0 0 0"/><geometry><sphere',
        r"link 'FL_calf': the foot must be at 0 0 z",
    ),
    ('<mass value="5.6"/>', '<mass value="0"/>', r"link 'trunk': its mass must be positive, not 0"),
    ('<mass value="0.95"/>', "", r"link 'FL_thigh': inertial/mass value must be a number"),
]


@pytest.mark.parametrize(("old", "new", "message"), REFUSED)
def test_a_urdf_that_does_not_fit(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "other.urdf"
    assert old in SHIPPED
    path.write_text(SHIPPED.replace(old, new), encoding="utf-8")
    with pytest.raises(ConfigError, match=rf"^{re.escape(str(path))}: {message}") as caught:
        read_geometry(RobotConfig(urdf=str(path)))
    assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match=message):
        BulletWorld(1, RobotConfig(urdf=str(path)), PhysicsConfig())


def test_one_leg_with_another_foot(tmp_path: Path) -> None:
    before, leg, after = SHIPPED.partition('<link name="RR_calf">')
    path = tmp_path / "other.urdf"
    path.write_text(before + leg + after.replace('"0.022"', '"0.03"'), encoding="utf-8")
    with pytest.raises(
        ConfigError, match=rf": the foot of RR does not fit the foot of FL: {DIFFERS}"
    ):
        read_geometry(RobotConfig(urdf=str(path)))


@pytest.mark.parametrize(
    "content", [b"", b"\xff\xfe<robot/>", b"<robot>\x00</robot>", b"\x00" * 50]
)
def test_a_file_that_is_no_urdf(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "noise.urdf"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"noise\.urdf: (not an XML file|not UTF-8 text)"):
        read_geometry(RobotConfig(urdf=str(path)))


def test_a_urdf_that_bullet_cannot_load(tmp_path: Path) -> None:
    path = tmp_path / "mesh.urdf"
    box, mesh = '<box size="0.42 0.15 0.11"/>', '<mesh filename="nothing.stl"/>'
    path.write_text(SHIPPED.replace(box, mesh), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"mesh\.urdf: Bullet cannot load it, see above$"):
        BulletWorld(1, RobotConfig(urdf=str(path)), PhysicsConfig())


def test_scripts_refuse_it_in_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A robot to train, the robot of a trained policy, and one that only Bullet cannot load."""
    path, results = tmp_path / "other.urdf", tmp_path / "results" / "diagnosis.csv"
    low = tmp_path / "low.json"
    text = (PRETRAINED / "low.json").read_text(encoding="utf-8")
    low.write_text(text.replace("urdf/quadruped.urdf", str(path)), encoding="utf-8")
    shutil.copy(PRETRAINED / "low.safetensors", tmp_path)
    results.parent.mkdir()
    results.touch()
    train = ["--out", str(tmp_path / "run"), "--workers", "1", "--set", f"env.robot.urdf={path}"]
    table = ["--policies", "gp", "--episodes", "1", "--levels", "6", "--families", "tilt"]
    table += ["--low", str(low.with_suffix("")), "--out", str(results.parent), "--workers", "1"]
    path.write_text(SHIPPED.replace("RR_hip_joint", "RR_hip"), encoding="utf-8")
    for name, main, arguments in (
        ("train_low.py", train_low.main, train),
        ("evaluate.py", evaluate.main, table),
        ("evaluate.py", evaluate.main, ["--tracking", *table[8:]]),
    ):
        assert main(arguments) == 2
        assert capfd.readouterr().err == f"{name}: {path}: lacks the joints RR_hip_joint\n"
    assert results.exists()
    path.write_text(SHIPPED.replace('<box size="0.42 0.15 0.11"/>', "<box/>"), encoding="utf-8")
    for name, main, arguments in (
        ("train_low.py", train_low.main, train),
        ("evaluate.py", evaluate.main, table),
    ):
        assert main(arguments) == 2
        said = f"{name}: {path}: Bullet cannot load it, see above"
        assert capfd.readouterr().err.splitlines()[-1] == said
    assert results.exists()
