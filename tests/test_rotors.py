"""Rotors in Bullet's joints: the equations, and the motion of a robot that has them."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from tdgc.config import PhysicsConfig, RobotConfig
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.geometry import read_geometry
from tdgc.sim.mujoco_world import MujocoConfig, MujocoWorld
from tdgc.sim.robot import Array, foot_kinematics, nominal_pose, yaw_quaternion
from tdgc.sim.rotors import excess_momentum, force_on_calf
from tdgc.sim.tile import TileField
from tdgc.sim.urdf import urdf_path

ROBOT = RobotConfig()
NOMINAL = nominal_pose(ROBOT)
ROTOR = 0.01  # kg m^2


def excess_energy(body_rate: Array, q: Array, qd: Array) -> float:
    """E / J of one robot, from the angular velocities of its links as vectors in the body frame."""
    energy = 0.0
    for leg in range(0, 12, 3):
        forward = np.array([1.0, 0.0, 0.0])
        leftward = np.array([0.0, np.cos(q[leg]), np.sin(q[leg])])
        rate = body_rate
        for joint, axis in zip(range(leg, leg + 3), (forward, leftward, leftward), strict=True):
            moved = rate + qd[joint] * axis
            energy += 0.5 * ((moved @ axis) ** 2 + (rate @ axis) ** 2 - qd[joint] ** 2)
            rate = moved
    return energy


def test_momentum_is_the_derivative_of_the_excess_energy() -> None:
    rng, step = np.random.default_rng(0), 1e-6
    q, qd, rate = rng.normal(size=12), rng.normal(size=12), rng.normal(size=3)

    def slope(of: str, k: int) -> float:
        at = {"q": q, "qd": qd, "body_rate": rate}
        around = [{**at, of: at[of] + sign * step * np.eye(len(at[of]))[k]} for sign in (1, -1)]
        return (excess_energy(**around[0]) - excess_energy(**around[1])) / (2.0 * step)

    (momentum,), (force,) = excess_momentum(rate[None], q[None], qd[None])
    expected = [slope("qd", k) for k in range(12)] + [slope("body_rate", k) for k in range(3)]
    np.testing.assert_allclose(momentum, expected, atol=1e-7)
    np.testing.assert_allclose(force[:12], [-slope("q", k) for k in range(12)], atol=1e-7)
    np.testing.assert_allclose(force[12:], np.cross(rate, momentum[12:]))


def bullet(
    physics: PhysicsConfig, armature: float, payload: float = 0.0, robot: RobotConfig = ROBOT
) -> BulletWorld:
    world = BulletWorld(1, robot, physics)
    world.payload[0], world.armature[0] = payload, armature
    world.apply_dynamics([0])
    return world


def flight(world: BulletWorld) -> Array:
    """Move all joints at random in the air: joint speeds and the trunk's rates, (12, 15) rad/s.

    The robot faces neither axis of the world, so that the frames of torques matter.
    """
    rng = np.random.default_rng(0)
    yaw = yaw_quaternion(np.array([2.0]))
    world.reset_robots([0], np.array([[2.0, 2.0, 3.0]]), yaw, NOMINAL[None])
    target, rates = NOMINAL, []
    for _ in range(12):
        target = target + rng.normal(0.0, 0.15, 12)
        world.step(np.tile(target, (3, 1, 1)), np.zeros(1), np.zeros((1, 12)))
        rates.append(np.concatenate([world.state.qd[0], world.state.ang_vel[0]]))
    world.close()
    return np.array(rates)


@pytest.mark.parametrize(("substeps", "joints", "trunk"), [(8, 0.2, 0.3), (64, 0.04, 0.04)])
def test_a_robot_in_the_air_moves_as_in_mujoco(substeps: int, joints: float, trunk: float) -> None:
    """The difference to MuJoCo, as a share of what rotors change there, falls with the step."""

    def mujoco(armature: float) -> Array:
        config = MujocoConfig(timestep=0.02 / substeps, armature=armature)
        physics = config.physics(0.02, 25.0 * substeps)
        return flight(MujocoWorld(ROBOT, physics, TileField(1), config))

    physics = PhysicsConfig(substeps=substeps)
    error = np.abs(flight(bullet(physics, ROTOR)) - mujoco(ROTOR)).mean(axis=0)
    effect = np.abs(mujoco(ROTOR) - mujoco(0.0)).mean(axis=0)
    assert effect[:12].mean() > 0.8 and effect[12:].mean() > 0.15
    assert error[:12].mean() < joints * effect[:12].mean()
    assert error[12:].mean() < trunk * effect[12:].mean()


def test_large_rotors_of_a_light_robot_come_to_rest() -> None:
    """Five times the inertia of real rotors, and 1 kg less on the trunk, which turns freely."""
    world = bullet(PhysicsConfig(), 0.05, payload=-1.0)
    world.reset_robots([0], np.array([[0.0, 0.0, 9.0]]), yaw_quaternion(np.zeros(1)), NOMINAL[None])
    world.state.qd[0] = np.random.default_rng(0).normal(0.0, 5.0, 12)
    world._put(0)
    for _ in range(60):
        world.step(np.tile(NOMINAL, (3, 1, 1)), np.zeros(1), np.zeros((1, 12)))
    assert np.abs(world.state.qd).max() < 0.1
    assert np.abs(world.state.q - NOMINAL).max() < 0.01
    world.close()


def test_inertia_is_added_to_a_joints_link_and_its_parent() -> None:
    """About the joint's axis; a new value replaces the last, and 0 takes the torques away too."""
    world = bullet(PhysicsConfig(), 0.0)
    client, body = world._client_of[0], world._bodies[0]

    def inertia() -> Array:
        links = [-1, *world._joints]
        return np.array([client.getDynamicsInfo(body, link)[2] for link in links])

    before = inertia()
    for armature in (0.02, ROTOR):
        world.armature[0] = armature
        world.apply_dynamics([0])
    leg = [[1.0, 1.0, 0.0], [0.0, 2.0, 0.0], [0.0, 1.0, 0.0]]
    expected = ROTOR * np.array([[4.0, 0.0, 0.0], *4 * leg])
    np.testing.assert_allclose(inertia() - before, expected, atol=1e-9)
    world.reset_robots([0], np.array([[0.0, 0.0, 2.0]]), yaw_quaternion(np.zeros(1)), NOMINAL[None])
    targets = np.tile(NOMINAL + 0.2, (3, 1, 1))
    world.step(targets, np.zeros(1), np.zeros((1, 12)))
    assert np.abs(world.state.rotor_excess).max() > 0.1
    world.armature[0] = 0.0
    world.apply_dynamics([0])
    world.step(targets, np.zeros(1), np.zeros((1, 12)))
    np.testing.assert_allclose(inertia(), before, atol=1e-9)
    assert not world.state.rotor_excess.any()
    world.close()


def test_force_on_a_calf_has_the_given_torques() -> None:
    rng, geometry = np.random.default_rng(0), read_geometry(ROBOT)
    q = NOMINAL + rng.uniform(-0.3, 0.3, 12)
    feet, _ = foot_kinematics(geometry, q[None], np.zeros((1, 12)))
    for leg in range(4):
        joints, force = slice(3 * leg, 3 * leg + 3), rng.normal(size=3)
        _, moved = foot_kinematics(geometry, np.tile(q, (3, 1)), np.eye(12)[joints])
        torque = moved[:, leg] @ force
        found = force_on_calf(geometry, leg, q[joints], feet[0, leg], torque)
        np.testing.assert_allclose(found, force)


@pytest.mark.parametrize("armature", [0.0, 0.005, ROTOR, 0.015])
def test_feet_that_hit_a_wall_stay_there(armature: float) -> None:
    """A robot whose nose points down swings its front feet into the plane, at 2.2 m/s."""
    world = bullet(PhysicsConfig(control_dt=0.005, substeps=2), armature)
    world.strength[:] = 0.0
    q, speed = NOMINAL.copy(), np.zeros(12)
    q[1:6:3], speed[1:6:3] = 0.3, -1.0  # feet ahead of the trunk, swinging forward
    geometry = world.state.geometry
    (feet,), (moving,) = foot_kinematics(geometry, q[None], speed[None])
    height = feet[0, 0] + geometry.foot_radius + 0.02
    down = np.array([[0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)]])
    world.reset_robots([0], np.array([[0.0, 0.0, height]]), down, q[None])
    world.state.qd[0] = speed * 2.2 / moving[0, 0]
    world._put(0)
    speeds = []
    for _ in range(10):
        world.step(np.tile(q, (3, 1, 1)), np.zeros(1), np.zeros((1, 12)))
        speeds.append(world.state.foot_velocity[0, :2, 2].mean())
    world.close()
    assert min(speeds) < -2.0 and max(speeds) < 0.25, speeds


def test_principal_axes_may_be_turned(tmp_path: Path) -> None:
    """Thighs whose inertia is given in a frame turned by a quarter about x move alike."""
    plain = Path(urdf_path(ROBOT)).read_text(encoding="utf-8")
    before = ('-0.05" rpy="0 0 0"/>', 'iyy="0.003683" izz="0.000163"')
    after = (f'-0.05" rpy="{np.pi / 2} 0 0"/>', 'iyy="0.000163" izz="0.003683"')
    assert [plain.count(text) for text in before] == [4, 4]
    for old, new in zip(before, after, strict=True):
        plain = plain.replace(old, new)
    (tmp_path / "turned.urdf").write_text(plain, encoding="utf-8")
    turned = dataclasses.replace(ROBOT, urdf=str(tmp_path / "turned.urdf"))
    one, other = (flight(bullet(PhysicsConfig(), ROTOR, robot=robot)) for robot in (ROBOT, turned))
    np.testing.assert_allclose(other, one, atol=1e-3)
    assert np.abs(one).max() > 5.0
