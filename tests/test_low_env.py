"""The execution-level MDP: observation, reward, episodes, commands, levels and exact resume."""

import dataclasses
import json
import math
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pybullet
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from tdgc.config import (
    CommandRanges,
    LowLevelConfig,
    PhysicsConfig,
    RandomisationConfig,
    RobotConfig,
)
from tdgc.parallel.group import TaskGroup
from tdgc.sim.commands import INDEX, command_bounds, default_command, gait_index
from tdgc.sim.gaits import GAITS, gait_embedding
from tdgc.sim.observation import columns, width
from tdgc.sim.robot import Array, nominal_pose, yaw_quaternion
from tdgc.sim.terrain import make_tile, tile_rng
from tdgc.state import State, split
from tdgc.tasks import low_env
from tdgc.tasks.command_draw import PRONK
from tdgc.tasks.crossings import Crossings, within
from tdgc.tasks.episodes import Episodes
from tdgc.tasks.ground import measure_ground
from tdgc.tasks.leaps import DURATION
from tdgc.tasks.low_env import LowLevelEnv, LowLevelTask, make_task
from tdgc.tasks.low_observation import CRITIC_LAYOUT, low_spaces
from tdgc.tasks.rules import FELL, is_fallen
from tdgc.tasks.statistics import by_gait, summarise_low
from tdgc.tasks.tiles import shallow

NOMINAL = nominal_pose(RobotConfig())
PLANE = LowLevelConfig(physics=PhysicsConfig(substeps=4, hold=1))
TILES = LowLevelConfig(terrain="tiles", physics=PhysicsConfig(substeps=4, hold=1))


def still(task: LowLevelTask) -> Array:
    return np.zeros((task.num_robots, 12))


def begin(config: LowLevelConfig, robots: int = 1, training: bool = False) -> LowLevelTask:
    task = LowLevelTask(config, robots, seed=0, training=training)
    task.reset(np.arange(robots))
    return task


def put(task: LowLevelTask, robot: int, local_xy: tuple[float, float], yaw: float = 0.0) -> None:
    """Place a robot at a point given in its tile's frame."""
    assert task.field is not None
    xy = task.field.origin([robot]) + np.array([local_xy])
    task.locomotion.place(np.array([robot]), xy, np.array([yaw]), np.zeros(1))


# ------------------------------------------------------------------ Gymnasium interface


@pytest.mark.parametrize("config", [PLANE, TILES], ids=["plane", "tiles"])
def test_both_env_checkers(config: LowLevelConfig) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*(action space|Box observation|infinity).*")
        env = gym.make("tdgc/LowLevel-v0", config=config)
        check_env(env.unwrapped)
        sb3_check_env(env.unwrapped)
        env.close()


def test_the_registered_environment() -> None:
    env = gym.make("tdgc/LowLevel-v0")
    assert isinstance(env.unwrapped, LowLevelEnv)
    assert env.unwrapped.config == LowLevelConfig()
    assert env.observation_space.shape == (130,) and env.observation_space.dtype == np.float32
    assert isinstance(env.action_space, gym.spaces.Box)
    assert env.action_space.low.tolist() == [-4.0] * 12
    assert env.action_space.high.tolist() == [4.0] * 12
    env.close()


def test_a_seed_fixes_an_episode() -> None:
    env = LowLevelEnv(PLANE)

    def episode(seed: int) -> Array:
        first, info = env.reset(seed=seed)
        assert info == {}
        return np.array([first] + [env.step(np.full(12, 0.3))[0] for _ in range(5)])

    one = episode(1)
    assert (episode(1) == one).all()
    assert (episode(2) != one).any()
    env.close()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_action_that_is_not_finite(value: float) -> None:
    env = LowLevelEnv(PLANE)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"^an action must be finite; it has NaN or infinite"):
        env.step(np.full(12, value, dtype=np.float32))
    env.close()


# ------------------------------------------------------------------ observation


def test_observation_of_actor_and_critic() -> None:
    """The spaces follow from the configuration alone; without the gyro they lose its 3 values."""
    assert width(CRITIC_LAYOUT) == 40
    without = low_spaces(dataclasses.replace(PLANE, gyro=False))[0]
    assert without.shape == (127,)
    task = LowLevelTask(PLANE, 3, seed=0)
    assert (task.observation_space, task.action_space) == low_spaces(PLANE)
    task.reset(np.arange(3))
    assert task.observe().shape == (3, 130) and task.observe().dtype == np.float32
    task.close()


def test_only_the_actor_has_noise_and_only_in_training() -> None:
    task = begin(PLANE, 2, training=True)
    first, second = task.observe(), task.observe()
    measured = np.r_[:15, 27:39, 87:90]  # gravity, joint angles and speeds, gyro
    assert (first[:, measured] != second[:, measured]).all()
    assert (np.delete(first, measured, 1) == np.delete(second, measured, 1)).all()
    task.close()
    task = begin(PLANE, 2)
    assert (task.observe() == task.observe()).all()
    task.close()


def critic(task: LowLevelTask) -> dict[str, Array]:
    rows, where = task.observe(), columns((*task.locomotion.layout, *CRITIC_LAYOUT))
    return {term.name: rows[:, where[term.name]] for term in CRITIC_LAYOUT}


def test_what_the_critic_sees_of_a_known_state() -> None:
    """The critic's terms match values worked out by hand, scaled as in ``CRITIC_LAYOUT``.

    The robot faces +y and turns left, 5 cm above its standing height. It moves forward at 0.6 m/s
    and to the left at 0.2 m/s. Two feet press with more than 1 N; it is weak and loaded.
    """
    task = begin(PLANE)
    loco, state = task.locomotion, task.locomotion.world.state
    state.position[0] = [3.0, 1.0, 0.35]
    state.quaternion[:] = yaw_quaternion(np.array([math.pi / 2]))
    state.lin_vel[0], state.ang_vel[0] = [-0.2, 0.6, 0.1], [0.0, 0.4, 0.8]
    state.q[0] = [0.0, 0.7, -1.4] * 4
    state.derive()
    state.foot_force[0] = [0.0, 0.9, 1.1, 60.0]
    loco.world.friction[:], loco.world.payload[:], loco.delay[:] = 0.5, 1.5, 0.015
    loco.world.strength[:] = 0.9
    loco.world.armature[:], loco.world.joint_friction[:] = 0.012, 0.1
    task.ground = measure_ground(task.locomotion)
    seen = critic(task)
    np.testing.assert_allclose(seen["velocity"], [[1.2, 0.4, 0.2]], atol=1e-6)
    np.testing.assert_allclose(seen["angular_velocity"], [[0.1, 0.0, 0.2]], atol=1e-6)
    np.testing.assert_allclose(seen["base_height"], [[0.5]], atol=1e-6)
    height = 0.35 - 2 * 0.213 * math.cos(0.7)
    np.testing.assert_allclose(seen["foot_height"], [[10 * height] * 4], atol=1e-5)
    assert seen["foot_contact"].tolist() == [[0.0, 0.0, 1.0, 1.0]]
    np.testing.assert_allclose(seen["dynamics"], [[0.5, 0.5, -0.5, 0.5, 1.2, 0.5]], atol=1e-6)
    np.testing.assert_allclose(seen["terrain"], [[-0.25] * 15], atol=1e-6)
    np.testing.assert_allclose(seen["desired_contact"], loco.clock.contact, atol=1e-6)
    task.close()


def test_the_critic_sees_a_step_ahead() -> None:
    """A 10 cm step 0.4 m ahead lifts the front row of probes only; facing away, it lifts none."""
    task = begin(TILES)
    assert task.field is not None
    field, n = task.field, 161
    field.heights[:] = field.support[:] = 0.0
    field.heights[round(4.0 / 0.05) + 1 : n] = 0.1
    task.locomotion.world.upload_terrain()
    for yaw, ahead in ((0.0, True), (math.pi, False)):
        put(task, 0, (3.65, 4.0), yaw)
        task.ground = measure_ground(task.locomotion)
        probes = critic(task)["terrain"].reshape(5, 3)
        lift = 0.5 if ahead else 0.0
        standing = 5 * (task.locomotion.world.state.position[0, 2] - 0.30)
        np.testing.assert_allclose(probes[:4], -standing, atol=1e-5)
        np.testing.assert_allclose(probes[4], lift - standing, atol=1e-5)
    task.close()


def test_reset_gives_a_fresh_observation() -> None:
    """The first observation after a reset shows no trace of the fall before it."""
    task = begin(PLANE)
    fresh = {k: v.copy() for k, v in critic(task).items()}
    task.locomotion.world.strength[:] = 0.0
    for _ in range(30):
        task.step(still(task))
    assert abs(critic(task)["base_height"][0, 0] - fresh["base_height"][0, 0]) > 0.5
    task.locomotion.world.strength[:] = 1.0
    task.reset(np.arange(1))
    again = critic(task)
    for name in ("velocity", "base_height", "foot_height", "foot_contact", "dynamics", "terrain"):
        np.testing.assert_allclose(again[name], fresh[name], atol=1e-5, err_msg=name)
    task.close()


# ------------------------------------------------------------------ reward


def test_reward_of_a_step_is_that_of_its_terms() -> None:
    task = begin(PLANE, 2)
    task.locomotion.command[:] = default_command()
    pose = task.locomotion.pose().copy()
    before = task.locomotion.world.state.qd.copy()
    actions = np.random.default_rng(0).normal(size=(2, 12))
    actions[:, 2::3] = -np.abs(actions[:, 2::3])  # calves bend away from their nearer limit
    reward, _, _ = task.step(actions)
    stats, weights = task.take_stats(), PLANE.rewards
    terms = {key[5:]: value for key, value in stats.items() if key.startswith("term/")}
    state = task.locomotion.world.state
    change = (state.qd - before) / 0.02
    assert np.abs(change).max() > 1.0
    expected = weights.joint_accelerations * (change**2).sum()
    assert terms["joint_accelerations"] == pytest.approx(expected)
    assert terms["action_rate"] == pytest.approx(weights.action_rate * (actions**2).sum())
    moved = pose + actions * np.tile([0.125, 0.25, 0.25], 4) - nominal_pose(PLANE.robot)
    assert terms["target_rate"] == pytest.approx(weights.target_rate * (moved**2).sum())
    assert terms["joint_torques"] == pytest.approx(weights.joint_torques * (state.torque**2).sum())
    assert stats["reward"] == pytest.approx(reward.sum())
    assert (reward > 0.0).all() and (reward < 0.07).all()
    # Statistics are sums over robots and the total is not linear in them, so check one robot. The
    # factor 0.5 is ``walking_penalty``.
    task.close()
    task = begin(PLANE)
    reward, _, _ = task.step(actions[:1])
    terms = {k[5:]: v for k, v in task.take_stats().items() if k.startswith("term/")}
    earned = terms.pop("track_lin_vel") + terms.pop("track_yaw_rate")
    assert reward[0] == pytest.approx(0.02 * earned * math.exp(0.5 * sum(terms.values())))
    task.close()


def test_statistics_of_a_run() -> None:
    task = begin(PLANE, 4)
    for _ in range(3):
        task.step(still(task))
    sums = task.take_stats()
    assert sums["steps"] == 12 and sums["falls"] == 0
    assert sum(sums[f"gait/{gait}/steps"] for gait in GAITS) == 12
    task.step(still(task))
    stats, now = task.take_stats(), by_gait(task.locomotion, {})
    assert stats["steps"] == 4  # since the last call
    for key in ("steps", "lin", "yaw", "match"):
        found = [stats[f"gait/{gait}/{key}"] for gait in GAITS]
        assert found == now[key].tolist() and sum(found) > 0.0
    values = summarise_low({**sums, "falls": 3.0})
    assert values["reward/total"] == pytest.approx(sums["reward"] / 12)
    assert values["falls_per_minute"] == pytest.approx(3 / (12 * 0.02 / 60))
    assert values["command_share/trot"] == 1.0
    for gait in GAITS:  # none walked is not tracked perfectly
        error = values.get(f"tracking/{gait}_velocity_rmse", 0.0)
        assert (error > 0.0) == (sums[f"gait/{gait}/steps"] > 0)
    walked = [sums[f"gait/{gait}/steps"] > 0 for gait in GAITS]
    assert any(walked) and not all(walked)
    task.close()


def test_sums_are_of_the_robots_in_each_gait() -> None:
    task = begin(PLANE, 3)
    loco, state = task.locomotion, task.world.state
    loco.command[:, :3] = [[0.5, 0.0, 0.0], [0.0, 0.2, 0.4], [0.0, 0.0, 0.0]]
    loco.command[:, 12:] = gait_embedding([0, 2, 2])
    state.heading_vel[:, :2] = [[0.4, 0.0], [0.3, 0.0], [0.0, 0.0]]
    state.lin_vel[:] = 9.0
    state.ang_vel[:, 2] = [0.1, 0.1, 0.0]
    state.foot_force[:] = [[5, 0, 0, 5], [5, 5, 5, 5], [0, 0, 0, 5]]
    loco.clock.contact[:] = [1.0, 0.0, 0.0, 1.0]
    sums = by_gait(loco, {"track_lin_vel": np.array([0.1, 0.2, 0.4])})
    task.close()
    for name, trot, pace in (
        ("steps", 1, 2),
        ("lin", 0.01, 0.13),
        ("yaw", 0.01, 0.09),
        ("match", 1.0, 1.25),
        ("track_lin_vel", 0.1, 0.6),
        ("track_yaw_rate", 0.0, 0.0),
    ):
        np.testing.assert_allclose(sums[name], [trot, 0.0, pace, 0.0], atol=1e-12)


def test_values_logged_are_means() -> None:
    values = summarise_low(
        {
            "steps": 100.0,
            "reward": 5.0,
            "leapers": 2.0,
            "landing/front": 0.6,
            "level/stair/count": 4.0,
            "level/stair/level": 6.0,
            "gait/pace/steps": 4.0,
            "gait/pace/lin": 1.0,
            "gait/pace/yaw": 0.36,
            "gait/pace/match": 3.0,
        }
    )
    for name, value in (
        ("reward/total", 0.05),
        ("landing/front", 0.3),
        ("level/stair", 1.5),
        ("tracking/pace_velocity_rmse", 0.5),
        ("tracking/pace_yaw_rate_rmse", 0.3),
        ("tracking/pace_contact_match", 0.75),
    ):
        assert values[name] == pytest.approx(value)


# ------------------------------------------------------------------ ends of episodes


def test_a_robot_without_strength_falls() -> None:
    task = begin(PLANE, 2)
    task.locomotion.world.strength[1] = 0.0
    ends = np.zeros(2, dtype=int)
    for k in range(1, 61):
        _, terminated, truncated = task.step(still(task))
        assert not truncated.any()
        ends = np.where((ends == 0) & terminated, k, ends)
    assert ends[0] == 0 and 5 < ends[1] < 60
    task.close()


def test_a_robot_on_its_back_has_failed() -> None:
    task = begin(PLANE)
    upside_down = np.array([pybullet.getQuaternionFromEuler([math.pi, 0.0, 0.0])])
    position = np.array([[0.0, 0.0, 0.4]])
    task.locomotion.world.reset_robots([0], position, upside_down, NOMINAL[None])
    ended = [bool(task.step(still(task))[1][0]) for _ in range(15)]
    assert ended[0] is False and ended[-1] is True
    task.close()


def test_a_robot_in_a_trench_has_failed_and_one_on_a_step_has_not() -> None:
    task = begin(dataclasses.replace(TILES, families=("gap", "stair")), 2)
    assert task.field is not None
    for row, family in enumerate(("gap", "stair")):
        task.field.place(row, make_tile(family, 1.0, np.random.default_rng(0)))
    world = task.locomotion.world
    trench = task.field.features[0].trenches[0].mean()
    risers = task.field.features[1].risers
    up, top = len(risers) // 2, 0.15 * len(risers) / 2
    stairs = 161 * 0.05 + risers[up - 1 : up + 1, 0].mean()  # the landing between the flights
    state = world.state
    state.position[:] = [[trench, 2.0, 0.14], [stairs, 2.0, top + 0.3]]
    assert world.ground_height(np.array([trench]), np.array([2.0]))[0] < -0.5
    assert world.support_height(np.array([stairs]), np.array([2.0]))[0] == pytest.approx(top)
    assert is_fallen(world).tolist() == [True, False]
    state.position[:, 2] += [0.02, -0.16]
    assert is_fallen(world).tolist() == [False, True]
    task.close()


def test_twenty_seconds_and_no_more() -> None:
    task = begin(PLANE, 2)
    assert task.horizon == 1000
    task.episodes.elapsed[:] = [998, 500]
    _, terminated, truncated = task.step(still(task))
    assert not terminated.any() and not truncated.any()
    _, terminated, truncated = task.step(still(task))
    assert not terminated.any() and truncated.tolist() == [True, False]
    task.reset(np.array([0]))
    assert task.episodes.elapsed.tolist() == [0, 502]
    task.close()


def test_a_fall_at_the_last_step_is_a_fall() -> None:
    task = begin(PLANE)
    task.locomotion.world.strength[:] = 0.0
    for _ in range(60):
        task.episodes.elapsed[:] = 998
        _, terminated, truncated = task.step(still(task))
        if terminated[0]:
            break
    task.episodes.elapsed[:] = 999
    _, terminated, truncated = task.step(still(task))
    assert terminated.tolist() == [True] and truncated.tolist() == [False]
    task.close()


@pytest.mark.parametrize("spot", [(0.01, 4.0), (7.99, 4.0), (0.75, 2.01), (0.75, 5.99)])
def test_leaving_the_tile_truncates(spot: tuple[float, float]) -> None:
    """A robot pushed over any border of its tile, 8 m long and cropped to 4 m, is truncated."""
    task = begin(dataclasses.replace(TILES, families=("stair",)), 2)
    put(task, 1, spot)
    out = np.sign(np.array(spot) - [4.0, 4.0]) * (np.abs(np.array(spot) - 4.0) > [3.9, 1.9])
    task.locomotion.world.push([1], np.array([[*(out * 1.5), 0.0]]))
    _, terminated, truncated = task.step(still(task))
    assert not terminated.any() and truncated.tolist() == [False, True]
    task.close()


# ------------------------------------------------------------------ commands and pushes


def test_commands_are_drawn_anew_at_every_interval() -> None:
    task = begin(PLANE, 3)
    task.episodes.elapsed[:] = [0, 248, 100]
    first = task.locomotion.command.copy()
    task.step(still(task))
    assert (task.locomotion.command == first).all()
    task.step(still(task))  # 250 steps, twice the interval, into the second episode
    changed = (task.locomotion.command != first).any(axis=1)
    assert changed.tolist() == [False, True, False]
    task.step(still(task))
    assert (task.locomotion.command[[0, 2]] == first[[0, 2]]).all()
    task.close()


def test_a_reset_leaves_the_other_robots_alone() -> None:
    """A reset does not affect other robots, even those whose commands were drawn in that step."""
    task = begin(PLANE, 3, training=True)
    task.episodes.elapsed[:] = [10, 249, 500]
    task.step(still(task))
    command, elapsed = task.locomotion.command.copy(), task.episodes.elapsed.copy()
    speed = task.locomotion.world.state.lin_vel.copy()
    task.reset(np.array([0]))
    assert (task.locomotion.command[1:] == command[1:]).all()
    assert (task.locomotion.command[0] != command[0]).any()
    assert (task.episodes.elapsed[1:] == elapsed[1:]).all() and task.episodes.elapsed[0] == 0
    assert (task.locomotion.world.state.lin_vel[1:] == speed[1:]).all()
    task.close()


def test_no_commands_are_drawn_when_the_interval_is_none() -> None:
    task = begin(dataclasses.replace(PLANE, command_seconds=0.0))
    first = task.locomotion.command.copy()
    for elapsed in (249, 250, 499):
        task.episodes.elapsed[:] = elapsed
        task.step(still(task))
    assert (task.locomotion.command == first).all()
    task.close()


@pytest.mark.parametrize("yaw", [0.0, 2.0, -2.5])
def test_a_crossing_robot_is_sent_to_its_waypoint(yaw: float) -> None:
    task = begin(TILES, 2)
    assert task.field is not None
    task.episodes.crossing[:] = [True, False]
    put(task, 0, (2.0, 3.5), yaw)
    free = task.locomotion.command[1].copy()
    task.episodes.speed[:], task.episodes.facing[:] = 0.5, 0.4
    origin = task.field.origin(0)
    task.episodes.waypoint[0] = origin + [7.25, 4.5]
    task.crossings.steer(task.locomotion, task.ground, np.arange(task.num_robots))
    vx, vy, turning = task.locomotion.command[0, :3]
    c, s = math.cos(yaw), math.sin(yaw)
    world = np.array([c * vx - s * vy, s * vx + c * vy])
    bearing = math.atan2(1.0, 5.25)
    np.testing.assert_allclose(
        world / np.linalg.norm(world), [math.cos(bearing), math.sin(bearing)], atol=1e-9
    )
    assert np.linalg.norm(world) == pytest.approx(0.5, abs=1e-9)
    error = (bearing + 0.4 - yaw + math.pi) % (2 * math.pi) - math.pi
    assert turning == pytest.approx(min(1.0, max(-1.0, error)), abs=1e-9)
    assert (task.locomotion.command[1] == free).all()
    task.close()


def test_crossing_velocities_keep_their_direction_within_the_ranges() -> None:
    """A crossing at 1 m/s that leads sideways is commanded at 0.6 m/s, the bound of vy."""
    task = begin(TILES)
    assert task.field is not None
    task.episodes.crossing[:], task.episodes.facing[:], task.episodes.speed[:] = True, 0.0, 1.0
    put(task, 0, (2.0, 4.0), -math.pi / 2)
    task.episodes.waypoint[0] = task.field.origin(0) + [7.25, 4.0]
    task.crossings.steer(task.locomotion, task.ground, np.arange(task.num_robots))
    np.testing.assert_allclose(task.locomotion.command[0, :3], [0.0, 0.6, 1.0], atol=1e-9)
    put(task, 0, (2.0, 4.0), -math.pi / 4)
    task.crossings.steer(task.locomotion, task.ground, np.arange(task.num_robots))
    np.testing.assert_allclose(task.locomotion.command[0, :2], [0.6, 0.6], atol=1e-9)
    task.close()


@pytest.mark.parametrize(
    ("height", "at_level_10"),
    [((-0.03, 0.05), (0.0, 0.05)), ((-0.05, -0.02), (-0.02, -0.02)), ((0.02, 0.05), (0.02, 0.05))],
)
def test_crossing_robots_do_not_crouch_on_high_levels(
    height: tuple[float, float], at_level_10: tuple[float, float]
) -> None:
    """Their body height is not lowered where the ranges allow that, and stays within them."""
    commands = CommandRanges(body_height=height, pitch=(0.1, 0.3))
    config = LowLevelConfig(families=("stair",), commands=commands)
    crossings = Crossings(config, ("stair",), Episodes(1, 1), np.random.default_rng(0))
    crossings._episodes.crossing[:] = True
    gaits, bounds = np.full((1, 4), 0.25), command_bounds(commands).T[:, None]
    low, high = bounds.copy()
    crossings.narrow(np.arange(1), np.array([10]), gaits, low, high)
    j, pitch = INDEX["body_height"], INDEX["pitch"]
    assert (low[0, j], high[0, j]) == at_level_10
    assert 0.1 == low[0, pitch] <= high[0, pitch] < 0.3


def test_an_episode_ends_with_the_crossing() -> None:
    task = begin(dataclasses.replace(TILES, families=("tilt",)))
    assert task.field is not None
    task.episodes.crossing[:] = True
    origin = task.field.origin(0)
    task.episodes.waypoint[0] = origin + [7.25, 4.4]
    put(task, 0, (6.7, 4.4))
    task.crossings.steer(task.locomotion, task.ground, np.arange(task.num_robots))
    assert not task.episodes.reached[0]
    assert not task.step(still(task))[2][0]
    put(task, 0, (6.8, 4.4))
    task.crossings.steer(task.locomotion, task.ground, np.arange(task.num_robots))
    assert task.reached[0]
    _, terminated, truncated = task.step(still(task))
    assert truncated[0] and not terminated[0]
    task.reset(np.arange(1))
    assert not task.reached[0]
    task.close()


def test_crossing_robots_face_where_they_are_asked_to() -> None:
    """Robots start at the heading commanded for their crossing, so they turn little at first."""
    task = LowLevelTask(TILES, 10, seed=3, training=False)
    task.reset(np.arange(10))
    crossing = task.episodes.crossing
    assert 0.5 < crossing.mean() <= 1.0
    turning = np.abs(task.locomotion.command[crossing, INDEX["yaw_rate"]])
    assert turning.max() < 0.85  # yaw at the start +-0.5 rad, bearing of the goal +-0.3 rad
    task.close()


class Pushes:
    """Records the pushes of a task's robots and carries them out."""

    def __init__(self, task: LowLevelTask) -> None:
        self.task, self.seen = task, []  # type: ignore[var-annotated]
        self._push = task.locomotion.world.push
        task.locomotion.world.push = self.record  # type: ignore[method-assign]

    def record(self, index: Array, velocity: Array) -> None:
        self.seen += [(int(i), int(self.task.episodes.elapsed[i]), v.copy()) for i, v in
                      zip(index, velocity, strict=True)]  # fmt: skip
        self._push(index, velocity)


def test_pushes_come_at_their_interval() -> None:
    quiet = RandomisationConfig(push_interval=(0.5, 0.5), push_speed=0.6)
    task = begin(dataclasses.replace(PLANE, randomisation=quiet), 2, training=True)
    pushes = Pushes(task)
    for _ in range(80):
        task.step(still(task))
    assert [(i, step) for i, step, _ in pushes.seen] == [
        (0, 25), (1, 25), (0, 50), (1, 50), (0, 75), (1, 75)
    ]  # fmt: skip
    velocity = np.array([v for _, _, v in pushes.seen])
    speed = np.linalg.norm(velocity, axis=1)
    assert (velocity[:, 2] == 0.0).all() and (speed <= 0.6).all() and (speed > 0.0).all()
    assert len(np.unique(velocity[:, 0])) == 6
    task.close()


def test_no_pushes_outside_training_and_none_felt_at_scale_zero() -> None:
    often = RandomisationConfig(push_interval=(0.1, 0.1))
    task = begin(dataclasses.replace(PLANE, randomisation=often))
    pushes = Pushes(task)
    for _ in range(10):
        task.step(still(task))
    assert pushes.seen == []
    task.close()
    off = dataclasses.replace(often, scale=0.0)
    task = begin(dataclasses.replace(PLANE, randomisation=off), training=True)
    pushes = Pushes(task)
    for _ in range(10):
        task.step(still(task))
    assert pushes.seen and all((v == 0.0).all() for _, _, v in pushes.seen)
    task.close()


# ------------------------------------------------------------------ levels


def test_each_robot_has_a_tile_of_its_family_and_level() -> None:
    families = ("flat", "rough", "stair", "gap", "tilt")
    task = LowLevelTask(dataclasses.replace(TILES, families=families), 6, seed=7)
    assert task.field is not None
    assert task.column.tolist() == [0, 1, 2, 3, 4, 0]
    assert (task.level >= 0).all() and (task.level < 3).all()
    for i, family in enumerate(("rough", "stair", "gap", "tilt"), start=1):
        level = int(task.level[i])
        tile = shallow(
            make_tile(family, level / 10, tile_rng(7, family, level, i - 1)), level, 0.05
        )
        crop = slice(40, 121)  # cropped by 2 m on either side
        assert (task.field.heights[161 * i : 161 * (i + 1)] == tile.heights[:, crop]).all()
    for i in (0, 5):
        assert (task.field.heights[161 * i : 161 * (i + 1)] == 0.0).all()
    task.close()


def test_a_new_level_is_a_new_tile() -> None:
    """A new level takes effect at the robot's next reset, in Bullet too.

    Level 7 of Stair has steps of 11.4 cm.
    """
    task = LowLevelTask(dataclasses.replace(TILES, families=("stair",)), 2, seed=0)
    task.level[:] = 0
    task.reset(np.arange(2))
    task.level[1] = 7
    task.reset(np.array([0]))
    assert task.field is not None
    before = task.field.heights[:161].copy()
    assert np.diff(task.field.heights[161:, 0]).max() == pytest.approx(0.03)
    task.reset(np.array([1]))
    assert (task.field.heights[:161] == before).all()
    assert np.diff(task.field.heights[161:, 0]).max() == pytest.approx(0.114)
    risers = task.field.features[1].risers
    up = len(risers) // 2
    put(task, 1, (risers[up - 1 : up + 1, 0].mean(), 4.0))
    top, standing = 0.114 * up, []
    for _ in range(25):
        task.step(still(task))
        state = task.locomotion.world.state
        x, y, z = state.foot_position[1].T
        on_top = np.isclose(task.field.height_at(x, y), top)  # not on the risers' slopes
        standing += z[on_top & (state.foot_force[1] > 1.0)].tolist()
    assert len(standing) > 10
    assert np.median(standing) == pytest.approx(top + 0.022, abs=2e-3)
    task.close()


def test_robots_of_flat_tiles_are_free_and_start_in_the_middle() -> None:
    config = dataclasses.replace(TILES, families=("flat", "tilt"))
    task = begin(config, 40, training=True)
    assert task.field is not None
    assert not task.episodes.crossing[0::2].any() and task.episodes.crossing[1::2].any()
    local = task.locomotion.world.state.position[:, :2] - task.field.origin(np.arange(40))
    np.testing.assert_allclose(local[0::2], 4.0)
    np.testing.assert_allclose(local[1::2, 0], 0.75)
    task.step(still(task))
    stats = task.take_stats()
    assert "level/tilt/count" in stats and "level/flat/count" not in stats
    task.close()


def test_penalties_fall_as_the_commands_of_a_gait_grow() -> None:
    """Each gait's share of the penalties falls from 1 to 0.5 as its velocity ranges grow."""
    task = begin(PLANE, 4)
    task.locomotion.command[:, 12:] = gait_embedding([0, 1, 2, 3])
    task.commands.share[:] = [0.4, 0.7, 0.85, 1.0]
    np.testing.assert_allclose(task._penalty(), [1.0, 0.75, 0.625, 0.5])
    task.close()


def test_penalties_count_least_on_relief() -> None:
    """The same step has 0.4 of the penalties on Tilt, flat at level 0, and 0.5 on a flat tile."""
    quiet = RandomisationConfig(scale=0.0)
    rewarded = {}
    for family in ("flat", "tilt"):
        config = dataclasses.replace(TILES, families=(family,), randomisation=quiet)
        task = LowLevelTask(config, 1, seed=0, training=False)
        task.level[:] = 0
        task.reset(np.arange(1))
        task.episodes.crossing[:] = False
        task.locomotion.command[:] = default_command()
        put(task, 0, (4.0, 4.0))
        rewarded[family] = float(task.step(still(task))[0][0])
        terms = {k[5:]: v for k, v in task.take_stats().items() if k.startswith("term/")}
        task.close()
    positive = 0.02 * sum(v for v in terms.values() if v > 0.0)
    share = math.log(rewarded["tilt"] / positive) / math.log(rewarded["flat"] / positive)
    assert share == pytest.approx(0.4 / 0.5, rel=1e-6)  # full ranges outside training


def test_leaps_grow_as_fast_as_pronk_does() -> None:
    task = begin(dataclasses.replace(TILES, families=("gap",)), 40, training=True)
    assert task.commands.share[PRONK] == 0.4  # at the start of training
    speeds = []
    for _ in range(10):
        task.reset(np.arange(40))
        speeds.append(task.episodes.speed[task.episodes.leaping])
    speed = np.concatenate(speeds)
    assert speed.size > 200 and 0.4 <= speed.min() and speed.max() <= 0.48
    task.close()


def test_robots_leap_wherever_their_tile_has_trenches() -> None:
    """Whatever its family is called: ditches have trenches too."""
    task = begin(dataclasses.replace(TILES, families=("rough", "gap", "ditches")), 12)
    trenches = np.array([len(tile.trenches) > 0 for tile in task.field.features])
    assert (trenches == (task.column > 0)).all()
    leaping = np.zeros(12, dtype=bool)
    for _ in range(10):
        task.reset(np.arange(12))
        leaping |= task.episodes.leaping
    task.close()
    assert (leaping == trenches).all()


def test_most_crossings_of_trenches_leap() -> None:
    task = begin(dataclasses.replace(TILES, families=("gap", "stair")), 40)
    gap, leaping, commands, yaw = task.column == 0, [], [], []
    for _ in range(10):
        task.reset(np.arange(40))
        episodes, command = task.episodes, task.locomotion.command
        leaps = episodes.leaping
        assert (leaps == ((gait_index(command) == 1) & episodes.crossing & gap)).all()
        assert (episodes.facing[leaps] == 0.0).all()
        leaping.append(leaps[gap & episodes.crossing])
        commands.append(command[leaps])
        yaw.append(task.locomotion.world.state.yaw[leaps])
    task.close()
    assert 0.75 < np.concatenate(leaping).mean() < 0.95
    command = np.concatenate(commands)
    # From rest, timed about as for strides of 0.39 m at 1.2 m/s, and never near the lowest 2 Hz.
    frequency = command[:, INDEX["frequency"]]
    assert frequency.min() > 2.4 and np.median(frequency) == pytest.approx(1.2 / 0.39, abs=0.2)
    assert (command[:, INDEX["duration"]] == DURATION).all()
    assert (command[:, INDEX["swing_height"]] <= 0.07).all()
    # They move sideways as needed to reach the goal, but face across the trenches.
    turn = command[:, INDEX["yaw_rate"]]
    np.testing.assert_allclose(turn, -np.concatenate(yaw), atol=1e-9)
    speed = np.hypot(*command[:, :2].T)
    assert speed.min() > 0.5 and speed.max() <= 1.2 + 1e-9


def test_a_crossing_of_a_hard_tile_asks_for_high_feet_and_a_straight_trunk() -> None:
    task = begin(dataclasses.replace(TILES, families=("stair",)), 2)
    names = ("swing_height", "body_height", "pitch", "vx")
    columns = [INDEX[name] for name in names]
    for level, bounds in (
        (0, [(0.08, 0.24), (-0.03, 0.05), (-0.3, 0.3), (-1.0, 1.2)]),
        (5, [(0.13, 0.24), (-0.015, 0.05), (-0.195, 0.195), (-1.0, 1.2)]),
        (10, [(0.18, 0.24), (0.0, 0.05), (-0.09, 0.09), (-1.0, 1.2)]),
    ):
        task.level[:], task.episodes.crossing[:] = level, [True, False]
        wide = task.commands.bounds(2)
        _, low, high = narrowed = task.commands.bounds(2)
        task.crossings.narrow(np.arange(2), task.level, *narrowed)
        np.testing.assert_allclose(low[0, columns], [b[0] for b in bounds], atol=1e-12)
        np.testing.assert_allclose(high[0, columns], [b[1] for b in bounds], atol=1e-12)
        for left, before in zip(narrowed, wide, strict=True):
            np.testing.assert_array_equal(left[1], before[1])
    task.level[:], task.episodes.crossing[:] = 10, True
    for _ in range(20):
        task._draw_commands(np.arange(2))
        assert (task.locomotion.command[:, INDEX["swing_height"]] >= 0.18).all()
    task.close()


def test_pitch_follows_the_slope_of_a_crossing() -> None:
    """On rising stairs, the commanded pitch is nose up by the drawn share of the slope."""
    config = dataclasses.replace(TILES, families=("stair",))
    task = begin(config, 2)
    assert task.field is not None
    task.level[:] = 10
    task.reset(np.arange(2))
    task.episodes.crossing[:], task.episodes.follow[:], task.episodes.pitch[:] = (
        True,
        [0.5, 0.0],
        0.05,
    )
    risers = task.field.features[0].risers
    put(task, 0, (risers[2:4, 0].mean(), 4.0))
    put(task, 1, (risers[2:4, 0].mean(), 4.0))
    task.ground = measure_ground(task.locomotion)
    slope = task.ground.slope()[0]
    assert 0.25 < slope < 0.6  # 15 cm steps on treads of 25 to 40 cm
    task.crossings.steer(task.locomotion, task.ground, np.arange(task.num_robots))
    pitch = task.locomotion.command[:, INDEX["pitch"]]
    np.testing.assert_allclose(pitch, [0.05 - 0.5 * slope, 0.05])
    task.close()


def test_trenches_are_shallow_on_easy_levels_of_training() -> None:
    rng = np.random.default_rng(0)
    for level, depth in ((0, 0.05), (4, 0.138), (10, 0.6)):
        tile = shallow(make_tile("gap", level / 10, rng), level, 0.05)
        assert tile.heights.min() == pytest.approx(-depth)
    tilt = make_tile("tilt", 1.0, rng)
    assert (shallow(tilt, 0, 0.05).heights == tilt.heights).all()


def ended(
    local_x: float, *, reached: bool = False, crossing: bool = True, level: int = 5,
    elapsed: int = 999, began: int = 0, falls: bool = False, training: bool = True,
) -> int:  # fmt: skip
    """Put a robot into the given state and return its level after one step.

    With the default ``elapsed``, this step is the last of the episode.
    """
    quiet = RandomisationConfig(scale=0.0)
    config = dataclasses.replace(TILES, families=("stair",), randomisation=quiet)
    task = LowLevelTask(config, 1, seed=0, training=training)
    assert task.field is not None
    task.field.place(0, make_tile("tilt", 0.0, np.random.default_rng(0)))
    task.locomotion.world.upload_terrain()
    task.reset(np.arange(1))
    put(task, 0, (local_x, 4.0))
    if falls:
        upside_down = np.array([[1.0, 0.0, 0.0, 0.0]])
        position = task.locomotion.world.state.position.copy()
        position[0, 2] = 0.1
        task.locomotion.world.reset_robots([0], position, upside_down, NOMINAL[None])
    task.episodes.crossing[:], task.episodes.reached[:] = crossing, reached
    task.level[:], task.episodes.elapsed[:], task.episodes.began[:] = level, elapsed, began
    _, terminated, _ = task.step(still(task))
    assert bool(terminated[0]) == falls
    level = int(task.level[0])
    task.close()
    return level


def test_promotion() -> None:
    assert ended(2.0, reached=True) == 6
    assert ended(2.0, reached=True, falls=True, elapsed=600) == 6
    assert ended(2.0, reached=True, crossing=False) == 5
    assert ended(2.0, reached=True, elapsed=500) == 6
    assert ended(2.0, reached=True, training=False) == 5


def test_demotion() -> None:
    assert ended(3.9) == 4
    assert ended(4.1) == 5  # more than half of the tile
    assert ended(3.9, elapsed=500) == 5
    assert ended(3.9, elapsed=500, falls=True) == 4
    assert ended(4.1, elapsed=500, falls=True) == 5
    assert ended(3.9, crossing=False) == 5
    assert ended(3.9, level=0) == 0


def test_half_an_episode_is_no_reason_for_demotion() -> None:
    """An episode that began late demotes a robot only if it falls, not if time runs out.

    After ``restart``, episodes begin at a random ``elapsed``; the time left may be too short.
    """
    assert ended(3.9, began=600) == 5
    assert ended(3.9, began=600, falls=True) == 4
    assert ended(2.0, began=600, reached=True) == 6


def test_beyond_the_last_level_any_level_follows() -> None:
    assert ended(2.0, reached=True, level=9) == 10
    task = begin(dataclasses.replace(TILES, families=("stair",)), 4)
    task.episodes.crossing[:] = task.episodes.reached[:] = True
    everyone, x = np.ones(4, dtype=bool), np.full(4, 7.0)
    moved = [task.crossings.move(np.full(4, 10), x, everyone, everyone) for _ in range(100)]
    assert np.unique(moved).tolist() == list(range(11))
    task.close()


def test_leaving_a_tile_early_neither_promotes_nor_demotes() -> None:
    assert ended(-0.01, elapsed=500) == 5


# ------------------------------------------------------------------ restart and resume


def live(task: LowLevelTask, steps: int) -> Array:
    """Act at random and reset as a worker does: (steps, M, n) observations, rewards and flags."""
    rng, rows = np.random.default_rng(1), []
    for _ in range(steps):
        reward, terminated, truncated = task.step(rng.normal(0.0, 1.5, (task.num_robots, 12)))
        seen = task.observe()
        done = np.flatnonzero(terminated | truncated)
        if done.size:
            task.reset(done)
            seen[done] = task.observe()[done]
        rows.append(np.column_stack([seen, reward, terminated, truncated]))
    return np.array(rows)


def flat(state: State) -> dict[str, Any]:
    """A state as JSON values: its arrays as lists, named by their place in it, and the rest."""
    arrays: dict[str, Any] = {}
    rest = split(state, "", arrays)
    return {"rest": rest, **{name: array.tolist() for name, array in arrays.items()}}


@pytest.mark.parametrize("config", [PLANE, TILES], ids=["plane", "tiles"])
def test_episodes_go_on_from_a_state(config: LowLevelConfig) -> None:
    """A state taken mid-episode, in contact and right after a push, continues bit for bit."""
    config = dataclasses.replace(config, episode_seconds=1.0)  # some end during the test
    task = LowLevelTask(config, 3, seed=5)
    task.restart()
    task.level[:] = [3, 1, 0]
    live(task, 40)
    while task.locomotion.world.state.foot_force.max() < 1.0:
        live(task, 1)
    task.commands.share[1] = 0.65
    assert (task.episodes.elapsed > task.episodes.began).any()
    task.episodes.next_push[0] = 0
    task.pushes.push(task.locomotion.world, task.episodes.elapsed, np.ones(3))
    state = task.state_dict()
    assert state["episodes"]["locomotion"]["foot_force"].max() > 1.0
    kept = flat(state)
    task.forget()
    assert flat(task.state_dict()) == kept
    expected = live(task, 60)
    assert (expected[..., -2:] == 1.0).any()
    assert flat(state) == kept  # a state is a copy

    other = LowLevelTask(config, 3, seed=5)
    for _ in range(2):  # whatever the task did before loading
        other.load_state_dict(state)
        np.testing.assert_array_equal(live(other, 60), expected)
        assert flat(other.state_dict()) == flat(task.state_dict())
    task.close()
    other.close()


def test_planned_leaps_go_on_from_a_state() -> None:
    """Leaps keep plans that are older than the landing estimate when the state is taken."""
    pronk = dataclasses.replace(TILES.crossing, share=1.0, trench_gaits=(0.0, 1.0, 0.0, 0.0))
    config = dataclasses.replace(TILES, families=("gap",), crossing=pronk)
    task, other = (LowLevelTask(config, 3, seed=5) for _ in range(2))
    task.restart()
    task.crossings.landing.spread += 0.05
    state = task.state_dict()
    assert state["episodes"]["spread"].tolist() == [0.0, 0.0, 0.0]
    task.forget()
    other.load_state_dict(state)
    still = np.zeros((3, 12))
    for _ in range(30):
        task.step(still)
        other.step(still)
        np.testing.assert_array_equal(other.locomotion.command, task.locomotion.command)
    assert (task.episodes.leaping & (task.episodes.elapsed > 5)).any()
    task.close()
    other.close()


def test_a_reset_leaves_the_commands_of_other_robots() -> None:
    """Also where their strides are due: planned twice, a stride would depend on who else fell."""
    pronk = dataclasses.replace(TILES.crossing, share=1.0, trench_gaits=(0.0, 1.0, 0.0, 0.0))
    config = dataclasses.replace(TILES, families=("gap",), crossing=pronk)
    task = LowLevelTask(config, 3, seed=5)
    task.restart()
    due = 0
    for _ in range(60):
        task.step(np.zeros((3, 12)))
        others = task.locomotion.command[1:].copy()
        elapsed = task.episodes.elapsed[1:]
        due += int((task.episodes.leaping[1:] & (elapsed % pronk.leap_decimation == 0)).sum())
        task.reset(np.array([0]))
        np.testing.assert_array_equal(task.locomotion.command[1:], others)
    assert due > 10
    task.close()


def test_falls_of_free_commands_drawn_for_the_first_time_are_remembered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Crossings are steered, so their commands are not; a failed retry would soon crowd out all."""
    task = begin(TILES, 3, training=True)
    task.episodes.crossing[:] = [False, True, False]
    task.episodes.retried[:] = [False, False, True]
    monkeypatch.setattr(low_env, "outcome", lambda world: np.full(3, FELL))
    asked = task.locomotion.command[0].copy()
    task.step(still(task))
    found = task.commands.falls[task.commands.falls[:, 0] >= 0.0]
    np.testing.assert_array_equal(found, [[gait_index(asked), *asked[:12]]])
    task.close()


def test_landings_are_told_by_the_clock_before_the_step(monkeypatch: pytest.MonkeyPatch) -> None:
    task, given = begin(TILES, 2), []
    monkeypatch.setattr(task.crossings, "learn_landing", lambda loco, clock: given.append(clock))
    before = task.locomotion.clock.clock.copy()
    task.step(still(task))
    assert (task.locomotion.clock.clock != before).all()
    np.testing.assert_array_equal(given, [before])
    task.close()


def test_trenches_under_the_hips_count_as_filled() -> None:
    """The trunk's height is above the support surface; the probes see the trench."""
    task = begin(dataclasses.replace(TILES, families=("gap",)))
    assert task.field is not None
    task.field.place(0, make_tile("gap", 1.0, np.random.default_rng(0)))
    trench = task.field.features[0].trenches[0].mean()
    loco = task.locomotion
    loco.world.state.position[:] = [[trench - loco.world.state.geometry.hips[0, 0], 2.0, 0.31]]
    loco.world.state.derive()
    ground = measure_ground(loco)
    assert ground.base[0] == pytest.approx(0.31, abs=1e-6) and ground.probes.min() < -0.5
    task.close()


def test_velocities_of_a_crossing_stay_within_their_bounds() -> None:
    low, high = np.array([-0.2, 0.0]), np.array([1.2, 0.0])
    wanted = np.array([[0.6, 0.3], [2.4, 1.0], [-0.8, -0.1], [0.0, 0.5]])
    found = within(wanted, low, high)
    np.testing.assert_allclose(found, [[0.6, 0.0], [1.2, 0.0], [-0.2, 0.0], [0.0, 0.0]])
    both = within(np.array([[0.8, 0.8]]), np.array([-1.0, -0.4]), np.array([1.0, 0.4]))
    np.testing.assert_allclose(both, [[0.4, 0.4]])  # in the same direction


def test_the_least_of_a_workers_robots_is_on_tiles() -> None:
    """With 0.99 of the robots on the plane, at least one is on tiles: of two robots, and of one."""
    for robots, groups in ((2, [1, 1]), (1, None)):
        task = make_task((PLANE, TILES), 0.99, robots, 0)
        if groups is None:
            assert isinstance(task, LowLevelTask) and task.tiles is not None
        else:
            assert isinstance(task, TaskGroup)
            assert [part.num_robots for part in task.tasks] == groups
        task.close()


def test_one_robot_that_blows_up_is_truncated_and_stands_again() -> None:
    env = LowLevelEnv(PLANE)
    before, _ = env.reset(seed=0)
    env.task.locomotion.world.strength[0] = np.nan  # of the motors
    seen, reward, terminated, truncated, _ = env.step(np.zeros(12, dtype=np.float32))
    assert (seen == before).all() and (reward, terminated, truncated) == (0.0, False, True)
    env.reset()
    for _ in range(5):
        seen, reward, terminated, truncated, _ = env.step(np.zeros(12, dtype=np.float32))
        assert np.isfinite(seen).all() and np.isfinite(reward) and not (terminated or truncated)
    env.close()


def test_environments_without_a_seed_differ() -> None:
    envs = [LowLevelEnv(PLANE) for _ in range(2)]
    first, second = (env.reset()[0] for env in envs)
    assert (first != second).any()
    for env in envs:
        env.close()


def test_families_are_dealt_to_all_robots_on_tiles() -> None:
    """Workers of 2 robots, a third of them on tiles, share three families evenly; so does one."""
    config = dataclasses.replace(TILES, families=("stair", "gap", "tilt"))
    for robots in (2, 18):
        dealt: list[str] = []
        for first in range(0, 18, robots):
            task = make_task((PLANE, config), 0.67, robots, 0, first=first)
            for part in task.tasks if isinstance(task, TaskGroup) else [task]:
                assert isinstance(part, LowLevelTask)
                dealt += () if part.tiles is None else part.tiles.families
            task.close()
        assert dealt == ["stair", "gap", "tilt"] * 2


def test_a_checkpoint_names_what_it_holds() -> None:
    """Later versions resume from a state, so names, shapes and dtypes are fixed."""
    task = begin(TILES, 3, training=True)
    state = task.state_dict()
    episodes = state.pop("episodes")
    for part in ("locomotion", "tiles"):
        assert episodes.pop(part)
    assert set(state) == {"rng", "landing", "tiles_drawn", "level", "command_share", "falls"}
    assert len(state["landing"]) == 2 and state["command_share"].shape == (4,)
    assert state["falls"].shape == (256, 13)
    held = {name: f"{array.dtype} {array.shape}" for name, array in episodes.items()}
    whole, flags, numbers = "int64 (3,)", "bool (3,)", "float64 (3,)"
    assert held == {
        "elapsed": whole, "began": whole, "next_push": whole,
        "tilts": "float64 (3, 26, 2)",
        "crossing": flags, "leaping": flags, "reached": flags, "retried": flags,
        "was_contact": "bool (3, 4)",
        "speed": numbers, "follow": numbers, "pitch": numbers, "facing": numbers, "spread": numbers,
        "waypoint": "float64 (3, 2)", "origin": "float64 (3, 2)", "gait_scores": "float64 (4, 4)",
    }  # fmt: skip
    task.close()


def test_new_episodes_begin_from_a_state_without_any() -> None:
    """A state without ``episodes``, as between phases of a run, acts like ``restart``.

    Its arrays may be lists.
    """
    task, other = (LowLevelTask(PLANE, 3, seed=5) for _ in range(2))
    task.level[:] = [3, 1, 0]
    task.commands.share[1] = 0.65
    state = task.state_dict()
    old = {
        "rng": state["rng"], "tiles_drawn": 0, "landing": state["landing"],
        "level": state["level"].tolist(), "command_share": state["command_share"].tolist(),
        "falls": state["falls"].tolist(),
    }  # fmt: skip
    other.load_state_dict(json.loads(json.dumps(old)))
    task.restart()
    assert flat(other.state_dict()) == flat(task.state_dict())
    np.testing.assert_array_equal(live(other, 3), live(task, 3))
    task.close()
    other.close()


def test_a_state_of_other_robots() -> None:
    task, other = LowLevelTask(PLANE, 2, seed=0), LowLevelTask(PLANE, 3, seed=0)
    with pytest.raises(ValueError, match=r"^'level' has shape \(2,\), not \(3,\)$"):
        other.load_state_dict(task.state_dict())
    task.close()
    other.close()


def test_restart_draws_new_tiles_at_the_present_levels() -> None:
    config = dataclasses.replace(TILES, families=("stair",))
    task = LowLevelTask(config, 2, seed=0)
    task.restart()
    assert task.field is not None
    task.level[:] = [2, 8]
    task.restart()
    rises = [np.diff(task.field.heights[161 * i : 161 * (i + 1), 0]).max() for i in (0, 1)]
    np.testing.assert_allclose(rises, [0.054, 0.126], atol=1e-6)
    task.close()


def test_restart_spreads_the_ends_of_episodes() -> None:
    task = LowLevelTask(PLANE, 20, seed=0)
    task.restart()
    assert task.episodes.elapsed.min() < 250 and task.episodes.elapsed.max() > 750
    assert (task.episodes.began == task.episodes.elapsed).all()
    assert (task.episodes.next_push > task.episodes.elapsed).all()
    task.close()


def test_seeds_differ() -> None:
    first, second = (LowLevelTask(PLANE, 2, seed=seed) for seed in (0, 1))
    for task in (first, second):
        task.restart()
    assert (first.observe() != second.observe()).any()
    first.close()
    second.close()


def test_tilt_a_gait_cycle_ago() -> None:
    """A cycle lasts 20 control steps at 2.5 Hz; at 3 Hz it lasts 16 2/3, so tilts interpolate."""
    task = LowLevelTask(LowLevelConfig(), 2, seed=0, training=False)
    try:
        steps = np.arange(1.0, 1.0 + task.episodes.tilts.shape[1])
        task.episodes.tilts[:, :, 0] = 0.01 * steps  # 0.01 per step of age
        ago = task._last_tilt(np.array([2.5, 3.0]))
        np.testing.assert_allclose(ago, [[0.20, 0.0], [0.01 * 50 / 3, 0.0]], atol=1e-12)
    finally:
        task.close()


def test_tilts_are_remembered_step_by_step() -> None:
    task = LowLevelTask(LowLevelConfig(), 1, seed=0, training=False)
    try:
        task.reset(np.arange(1))
        seen = []
        for _ in range(4):
            task.step(np.full((1, 12), 0.3))
            seen.append(task.locomotion.world.state.gravity[0, :2].copy())
        np.testing.assert_array_equal(task.episodes.tilts[0, :4], seen[::-1])
        assert not task.episodes.tilts[0, 4:].any()  # upright before the episode
        assert np.ptp(seen, axis=0).max() > 1e-4
    finally:
        task.close()


@pytest.mark.parametrize("training", [False, True])
def test_robots_are_randomised_in_training(training: bool) -> None:
    task = begin(PLANE, 8, training)
    loco, world = task.locomotion, task.locomotion.world
    for drawn in (world.friction, world.payload, loco.delay, world.strength):
        assert (np.ptp(drawn) > 0.0) == training
    task.close()


def test_what_the_terms_of_a_step_are_told() -> None:
    """On stairs, where heights above the support differ from heights above the start."""
    task = LowLevelTask(dataclasses.replace(TILES, families=("stair",)), 4, seed=0, training=False)
    task.level[:] = 9
    task.reset(np.arange(4))
    for robot in range(4):
        put(task, robot, (4.0, 4.0))
    loco, rng = task.locomotion, np.random.default_rng(0)
    for _ in range(10):
        task.step(rng.uniform(-0.3, 0.3, (4, 12)))
        told, state = task._low_step(still(task)), loco.world.state
        x, y, z = np.moveaxis(state.foot_position, -1, 0)
        above = z - loco.world.support_height(x, y)
        np.testing.assert_allclose(told.foot_height, above, atol=0.03)  # of the foot's lowest point
        np.testing.assert_array_equal(told.contact, loco.clock.contact)
        np.testing.assert_array_equal(task.episodes.was_contact, state.foot_force > 1.0)
    assert (state.position[:, 2] - told.base_height).max() > 0.1
    task.close()


def test_how_robots_cross() -> None:
    """Walking robots draw their speed, how far they pitch with the slope, and where they face."""
    task = LowLevelTask(dataclasses.replace(TILES, families=("stair",)), 60, seed=0, training=False)
    task.reset(np.arange(60))
    e, c = task.episodes, TILES.crossing
    rows = e.crossing & ~e.leaping
    assert rows.sum() > 30
    (low, high), speed = c.speed, e.speed[rows]
    assert low <= speed.min() and speed.max() <= high and np.ptp(speed) > 0.6 * (high - low)
    assert e.follow[rows].min() < 0.2 and e.follow[rows].max() > 0.8
    ahead = (e.facing[rows] == 0.0).mean()
    assert abs(ahead - c.facing) < 0.2 and 0.0 < ahead < 1.0
    task.close()
