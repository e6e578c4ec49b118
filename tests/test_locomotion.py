"""``Locomotion``: the low policy's observation, its frames and signs, acting, and the mirror."""

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
import pybullet
import pytest

from tdgc.config import LowLevelConfig, PhysicsConfig, RandomisationConfig, RobotConfig
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.commands import INDEX, observed_command
from tdgc.sim.gaits import GAITS, foot_phases, gait_embedding
from tdgc.sim.locomotion import GYRO_SCALE, SPEED_SCALE, Locomotion, actor_layout
from tdgc.sim.observation import JOINT_FLIP, Flip, columns, width
from tdgc.sim.robot import Array, nominal_pose, target_limits, walking_pose
from tdgc.sim.sensors import Noise
from tdgc.sim.terrain import make_tile
from tdgc.sim.tile import TILE_SIZE, Tile
from tdgc.tasks.ground import measure_ground
from tdgc.tasks.low_env import LowLevelTask
from tdgc.tasks.low_observation import CRITIC_LAYOUT, low_mirror

ROBOT, PHYSICS = RobotConfig(), PhysicsConfig(substeps=4)
NOMINAL = nominal_pose(ROBOT)


#: The solver takes one side before the other; the order does not matter once it has converged.
CONVERGED = PhysicsConfig(solver_iterations=300)


ACTOR = columns(actor_layout(ROBOT, gyro=True))


def standing(num: int = 1, gyro: bool = False, physics: PhysicsConfig = PHYSICS) -> Locomotion:
    config = LowLevelConfig(robot=ROBOT, physics=physics, gyro=gyro)
    loco = Locomotion(BulletWorld(num, ROBOT, physics), config)
    index = np.arange(num)
    loco.place(index, np.zeros((num, 2)), np.zeros(num), np.zeros(num))
    return loco


@pytest.fixture
def loco() -> Iterator[Locomotion]:
    """Two standing robots, with a gyro."""
    made = standing(2, gyro=True)
    yield made
    made.world.close()


def quaternion(roll: float, pitch: float, yaw: float) -> Array:
    return np.array(pybullet.getQuaternionFromEuler([roll, pitch, yaw]))


# ------------------------------------------------------------------ observation


def test_layout() -> None:
    assert [f"{term.name} {term.size}" for term in actor_layout(ROBOT, gyro=True)] == [
        "gravity 3", "joint_error 12", "pose 12", "joint_speed 12", "last_action 12",
        "action_before 12", "command 15", "clock 4", "clock_cosine 4", "gait 1", "gyro 3",
    ]  # fmt: skip
    assert actor_layout(ROBOT, gyro=False) == actor_layout(ROBOT, gyro=True)[:-1]
    assert width(actor_layout(ROBOT, gyro=False)) == 87
    papers = actor_layout(dataclasses.replace(ROBOT, commanded_gait=False), gyro=False)
    assert width(papers) == 71 and not {"pose", "clock_cosine"} & {term.name for term in papers}
    assert list(ACTOR.values())[-3:] == [slice(82, 86), slice(86, 87), slice(87, 90)]
    without = standing()
    assert without.layout == actor_layout(ROBOT, gyro=False)
    assert without.observe().shape == (1, 87)
    assert without.observe().dtype == np.float32
    without.world.close()


def test_observation_of_a_robot_that_stands(loco: Locomotion) -> None:
    seen = loco.observe()
    assert seen.shape == (2, 90)
    assert loco.layout == actor_layout(ROBOT, gyro=True)
    expected = np.zeros(90)
    expected[2] = -1.0
    expected[ACTOR["pose"]] = (loco.pose() - NOMINAL)[0]
    expected[ACTOR["joint_error"]] = -expected[ACTOR["pose"]]
    expected[ACTOR["clock_cosine"]] = [-1.0, 1.0, 1.0, -1.0]
    expected[ACTOR["command"]] = observed_command(loco.executed()[0])
    np.testing.assert_allclose(seen, np.stack([expected] * 2), atol=1e-7)


def test_gravity_is_in_the_body_frame(loco: Locomotion) -> None:
    """Nose down turns gravity forward, left side up turns it right; heading has no effect."""
    state = loco.world.state
    state.quaternion[0] = quaternion(0.0, 0.3, 2.0)
    state.quaternion[1] = quaternion(0.2, 0.0, -1.0)
    state.derive()
    seen = loco.observe()[:, ACTOR["gravity"]]
    assert seen[0, 0] > 0.0
    np.testing.assert_allclose(seen[0], [math.sin(0.3), 0.0, -math.cos(0.3)], atol=1e-6)
    np.testing.assert_allclose(seen[1], [0.0, -math.sin(0.2), -math.cos(0.2)], atol=1e-6)


def test_a_robot_put_nose_down_in_bullet_has_gravity_ahead() -> None:
    made = standing()
    position = np.array([[0.0, 0.0, 1.0]])
    made.world.reset_robots([0], position, quaternion(0.0, 0.4, 0.0)[None], NOMINAL[None])
    nose = made.world.state.position[0] + made.world.state.rotation[0] @ [0.2, 0.0, 0.0]
    assert nose[2] == pytest.approx(1.0 - 0.2 * math.sin(0.4), abs=1e-9)
    made.act(np.zeros((1, 12)))  # in free fall
    assert made.observe()[0, 0] == pytest.approx(math.sin(0.4), abs=0.02)
    made.world.close()


def test_joints_actions_and_gyro(loco: Locomotion) -> None:
    state = loco.world.state
    state.q[1] = NOMINAL + np.arange(12) / 10
    state.qd[1] = np.arange(12)
    loco.joint_offset[1] = 0.02
    state.quaternion[1] = quaternion(math.pi / 2, 0.0, 0.0)
    state.ang_vel[1] = [0.4, 0.8, 1.2]
    state.derive()
    loco.actions[0, 1], loco.actions[1, 1] = 0.5, -0.25
    seen = loco.observe()[1]
    error = NOMINAL + np.arange(12) / 10 - 0.02 - loco.pose()[1]
    np.testing.assert_allclose(seen[ACTOR["joint_error"]], error, atol=1e-6)
    np.testing.assert_allclose(seen[ACTOR["joint_speed"]], np.arange(12) * SPEED_SCALE, atol=1e-6)
    assert SPEED_SCALE == 0.05
    assert seen[ACTOR["last_action"]].tolist() == [0.5] * 12
    assert seen[ACTOR["action_before"]].tolist() == [-0.25] * 12
    # Rolled by a quarter turn, the world's z is the body's y and the world's y its -z.
    np.testing.assert_allclose(seen[ACTOR["gyro"]], [0.1, 0.3, -0.2], atol=1e-6)


def test_command_clock_and_gait(loco: Locomotion) -> None:
    loco.clock.reset(np.arange(2), np.array([0.1, 0.25]))
    loco.command[:, 12:] = gait_embedding([3, 2])
    loco.command[1, INDEX["vx"]] = 0.7
    seen = loco.observe()
    sine = math.sin(0.2 * math.pi)
    np.testing.assert_allclose(seen[0, ACTOR["clock"]], [-sine, -sine, sine, sine], atol=1e-6)
    np.testing.assert_allclose(seen[1, ACTOR["clock"]], [-1.0, 1.0, -1.0, 1.0], atol=1e-6)
    cosine = math.cos(0.2 * math.pi)
    wanted = [-cosine, -cosine, cosine, cosine]
    np.testing.assert_allclose(seen[0, ACTOR["clock_cosine"]], wanted, atol=1e-6)
    np.testing.assert_allclose(seen[1, ACTOR["clock_cosine"]], 0.0, atol=1e-6)
    np.testing.assert_allclose(seen[:, ACTOR["gait"]], [[1.0], [2.0 / 3.0]], atol=1e-6)
    wanted = observed_command(loco.executed())
    np.testing.assert_allclose(seen[:, ACTOR["command"]], wanted, atol=1e-6)


def test_noise_is_on_measured_parts_only_and_within_its_width(loco: Locomotion) -> None:
    quiet = loco.observe()
    noise = RandomisationConfig(noise_gravity=0.05, noise_joint_angle=0.01, noise_joint_speed=1.5)
    rng = np.random.default_rng(0)
    error = np.array([loco.observe(Noise(noise, rng)) - quiet for _ in range(200)])
    widths = {
        "gravity": 0.05,
        "joint_error": 0.01,
        "joint_speed": 1.5 * SPEED_SCALE,
        "gyro": 0.1 * GYRO_SCALE,
    }
    for name, where in ACTOR.items():
        largest = np.abs(error[..., where]).max(axis=(0, 1))
        width = widths.get(name, 0.0)
        assert (largest <= width + 1e-6).all(), name
        assert (largest >= 0.9 * width).all(), name
        assert abs(error[..., where].mean()) <= 0.05 * width, name
    off = dataclasses.replace(noise, scale=0.0)
    assert (loco.observe(Noise(off, rng)) == quiet).all()
    assert (loco.observe() == quiet).all()


# ------------------------------------------------------------------ acting


def test_act_clips_and_keeps_histories(loco: Locomotion) -> None:
    first, second = np.full((2, 12), 1.0), np.full((2, 12), -9.0)
    poses = [np.tile(NOMINAL, (2, 1))]
    for action in (first, second):
        poses.insert(0, loco.pose().copy())
        loco.act(action)
    assert (loco.actions[0] == -ROBOT.action_limit).all() and (loco.actions[1] == 1.0).all()
    scale = np.tile([0.125, 0.25, 0.25], 4)
    limits = target_limits(ROBOT, loco.world.state.geometry)
    for age, action in enumerate([-4.0, 1.0, 0.0]):
        expected = np.clip(poses[age] + action * scale, *limits)
        np.testing.assert_allclose(loco.targets[age], expected, atol=1e-12)
    # The first step runs at 3.5 Hz; the second is 0.07 of two cycles on the way to 3 Hz.
    ran = 0.02 * 3.5 + 0.02 * (3.0 + 0.965 * 0.5)
    assert loco.clock.clock.tolist() == pytest.approx([ran, ran])


def test_a_gait_begins_no_slower_than_its_start(loco: Locomotion) -> None:
    """A gait slows from 3.5 Hz to its command in two cycles, for the clock and the observation."""
    loco.command[:, INDEX["frequency"]] = [2.0, 3.8]
    loco.observe()
    for cycles, expected in ((0.0, 3.5), (0.5, 3.125), (1.0, 2.75), (2.0, 2.0), (9.0, 2.0)):
        loco.clock.cycles[:] = cycles
        assert loco.executed()[:, INDEX["frequency"]].tolist() == [expected, 3.8]
        seen = loco.observe()[:, ACTOR["command"]]
        np.testing.assert_allclose(seen, observed_command(loco.executed()), atol=1e-6)
    others = np.arange(15) != INDEX["frequency"]
    assert (loco.executed()[:, others] == loco.command[:, others]).all()
    loco.clock.cycles[:] = 1.0
    before = loco.clock.clock.copy()
    loco.act(np.zeros((2, 12)))
    assert loco.clock.clock - before == pytest.approx([0.02 * 2.75, 0.02 * 3.8])
    loco.command[0, 12:] = gait_embedding(GAITS.index("pronk"))  # a new gait starts over
    loco.observe()
    assert loco.executed()[:, INDEX["frequency"]].tolist() == [3.5, 3.8]


def test_the_pose_is_never_stale(loco: Locomotion) -> None:
    """After its inputs change, in place or by a step, the pose equals one computed afresh."""

    def fresh() -> Array:
        geometry, command = loco.world.state.geometry, loco.executed()
        frequency, duty = command[:, INDEX["frequency"]], command[:, INDEX["duration"]]
        # The middle of the coming step, and later by the lag of the joints, kd / kp = 0.6 / 20 s.
        now, ahead = (
            foot_phases((loco.clock.clock + time * frequency) % 1.0, command[:, 12:], duty)
            for time in (0.01, 0.01 + 0.03)
        )
        grown = np.minimum(loco.clock.cycles, 1.0)
        return walking_pose(ROBOT, geometry, command, now, ahead, grown)

    loco.clock.reset(np.arange(2), np.array([0.1, 0.35]))
    loco.observe()
    loco.clock.cycles[:] = [0.4, 7.0]
    seen, earlier = [], loco.state_dict()
    for change in (
        lambda: None,
        lambda: loco.command.__setitem__((1, INDEX["swing_height"]), 0.2),
        lambda: loco.command.__setitem__((0, INDEX["body_height"]), -0.03),
        lambda: loco.clock.reset(np.array([1]), 0.6),
        lambda: loco.clock.cycles.__setitem__(1, 0.5),
        lambda: loco.act(np.zeros((2, 12))),
        lambda: loco.load_state_dict(earlier),
    ):
        change()
        error = loco.world.state.q - loco.observe()[:, ACTOR["joint_error"]]
        np.testing.assert_allclose(error, fresh(), atol=1e-6)
        assert (loco.pose() == fresh()).all()
        seen.append(loco.pose().tobytes())
    assert len(set(seen)) == 6 and seen[0] == seen[-1]
    with pytest.raises(ValueError, match="read-only"):
        loco.pose()[0] = 0.0


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_action_that_is_not_finite(loco: Locomotion, value: float) -> None:
    actions = np.zeros((2, 12))
    actions[1, 5] = value
    before = loco.observe()
    with pytest.raises(ValueError, match=r"^an action must be finite; it has NaN or infinite"):
        loco.act(actions)
    assert (loco.observe() == before).all()


def test_place_stands_robots_on_the_ground_and_forgets(loco: Locomotion) -> None:
    for _ in range(3):
        loco.act(np.ones((2, 12)))
    other = loco.observe()[0]
    loco.place(np.array([1]), np.array([[3.0, -2.0]]), np.array([1.2]), np.array([0.75]))
    state = loco.world.state
    np.testing.assert_allclose(state.foot_position[1, :, 2].min(), 0.022, atol=1e-12)
    np.testing.assert_allclose(state.position[1, :2], [3.0, -2.0], atol=1e-12)
    assert state.yaw[1] == pytest.approx(1.2)
    assert (state.q[1] == NOMINAL).all() and (state.qd[1] == 0.0).all()
    assert (state.lin_vel[1] == 0.0).all() and (state.foot_force[1] == 0.0).all()
    assert (loco.actions[:, 1] == 0.0).all() and (loco.targets[:, 1] == NOMINAL).all()
    assert loco.clock.clock[1] == 0.75
    assert (loco.observe()[0] == other).all()
    assert (loco.actions[:, 0] == 1.0).all()


def draw_ten_times(
    loco: Locomotion, config: RandomisationConfig, rng: np.random.Generator
) -> list[Array]:
    """Draw ten times; return friction, payload, strength, latency and joint offset of each draw."""
    draws, world = [], loco.world
    for _ in range(10):
        loco.randomise(np.arange(loco.num_robots), config, rng)
        values = (world.friction, world.payload, world.strength, loco.delay, loco.joint_offset)
        draws.append([value.copy() for value in values])
    return [np.array(values) for values in zip(*draws, strict=True)]


def test_randomise_draws_within_bounds_and_tells_bullet() -> None:
    made = standing(11)
    config, rng = RandomisationConfig(), np.random.default_rng(0)
    draws = draw_ten_times(made, config, rng)
    bounds = (config.friction, config.payload, config.motor_strength, config.latency)
    for drawn, (low, high) in zip(draws, (*bounds, config.joint_offset), strict=True):
        width = high - low
        assert drawn.min() >= low and drawn.max() <= high
        assert drawn.min() < low + 0.1 * width and drawn.max() > high - 0.1 * width
    for i in (0, 10):  # one robot of each client
        world = made.world
        client, body = world._client_of[i], world._bodies[i]
        trunk, calf = (client.getDynamicsInfo(body, link) for link in (-1, 2))
        assert trunk[0] == pytest.approx(5.6 + world.payload[i], abs=1e-6)
        assert trunk[1] == pytest.approx(world.friction[i], abs=1e-6)
        assert calf[1] == pytest.approx(world.friction[i], abs=1e-6)
        assert calf[0] == pytest.approx(0.2, abs=1e-9)
    made.world.close()


def test_randomise_with_scale_zero_and_width_zero_is_nominal() -> None:
    made = standing(4)
    rng = np.random.default_rng(0)
    made.randomise(np.array([1]), RandomisationConfig(scale=0.0), rng)
    made.randomise(np.array([2, 3]), RandomisationConfig(), rng, np.array([0.0, 1.0]))
    assert made.world.friction[:3].tolist() == pytest.approx([0.8, 0.8, 0.8])
    assert made.world.payload[:3].tolist() == made.delay[:3].tolist() == [0.0, 0.0, 0.0]
    assert made.world.strength[:3, 0].tolist() == [1.0, 1.0, 1.0]
    assert (made.joint_offset[:3] == 0.0).all()
    assert made.world.payload[3] != 0.0 and made.joint_offset[3].std() > 0.0
    made.world.close()


def test_randomise_in_part_shrinks_ranges_about_the_nominal_value() -> None:
    made = standing(11)
    half = RandomisationConfig(scale=0.5, friction=(0.4, 1.2), payload=(-1.0, 3.0))
    friction, payload, *_ = draw_ten_times(made, half, np.random.default_rng(1))
    assert 0.6 <= friction.min() < 0.65 and 0.95 < friction.max() <= 1.0
    assert -0.5 <= payload.min() < -0.3 and 1.3 < payload.max() <= 1.5
    made.world.close()


# ------------------------------------------------------------------ the mirror


def mirrored(seen: Array, flip: Flip) -> Array:
    return np.asarray(np.array(flip.sign) * seen[..., flip.source])


MIRROR = low_mirror(LowLevelConfig())
ALL = Flip(MIRROR.obs_index, MIRROR.obs_sign)


def test_mirroring_twice_is_nothing() -> None:
    assert Flip(MIRROR.action_index, MIRROR.action_sign) == JOINT_FLIP
    for flip, size in ((ALL, 130), (JOINT_FLIP, 12)):
        x = np.random.default_rng(0).normal(size=(3, size))
        assert mirrored(x, flip).shape == x.shape
        assert (mirrored(mirrored(x, flip), flip) == x).all()
        assert not (mirrored(x, flip) == x).all()


def test_action_mirror_swaps_legs_and_flips_hips() -> None:
    x = np.arange(1.0, 13.0)
    assert mirrored(x, JOINT_FLIP).tolist() == [
        -4.0, 5.0, 6.0, -1.0, 2.0, 3.0, -10.0, 11.0, 12.0, -7.0, 8.0, 9.0
    ]  # fmt: skip
    np.testing.assert_allclose(mirrored(NOMINAL, JOINT_FLIP), NOMINAL, atol=0)


def mirror_commands(loco: Locomotion, rng: np.random.Generator, gait: int) -> None:
    """Set random commands for robot 0, their mirror image for robot 1, and matching clocks.

    In gaits whose left and right legs are half a cycle apart, swapping sides is the same as
    shifting the clock by half a cycle.
    """
    config = LowLevelConfig().commands
    bounds = np.array(dataclasses.astuple(config))
    loco.command[0, :12] = rng.uniform(bounds[:, 0], bounds[:, 1])
    loco.command[0, 12:] = gait_embedding(gait)
    loco.command[1] = loco.command[0]
    loco.command[1, [INDEX["vy"], INDEX["yaw_rate"], INDEX["roll"]]] *= -1.0
    clock = rng.uniform()
    loco.clock.reset(np.arange(2), np.array([clock, clock + 0.5 * (gait in (0, 2))]) % 1.0)


@pytest.mark.parametrize("gait", range(4))
def test_a_mirrored_robot_sees_a_mirrored_world(gait: int) -> None:
    """A robot's mirror image in Bullet has mirrored observations, including the critic's part.

    It keeps them, and equal rewards, over 40 steps of random actions.
    """
    config = LowLevelConfig(gyro=True, command_seconds=0.0, physics=CONVERGED)
    task = LowLevelTask(config, 2, seed=0, training=False)
    loco, rng = task.locomotion, np.random.default_rng(gait)
    mirror_commands(loco, rng, gait)
    yaw = rng.uniform(-1.0, 1.0)
    xy = np.array([[0.3, 0.4], [0.3, -0.4]])
    loco.place(np.arange(2), xy, np.array([yaw, -yaw]), loco.clock.clock.copy())
    offset = rng.uniform(-0.02, 0.02, 12)
    loco.joint_offset[:] = [offset, mirrored(offset, JOINT_FLIP)]
    loco.world.push([0, 1], np.array([[0.2, 0.3, 0.0], [0.2, -0.3, 0.0]]))
    rewards = []
    for _ in range(40):
        action = rng.normal(0.0, 1.0, 12)
        reward, _, _ = task.step(np.stack([action, mirrored(action, JOINT_FLIP)]))
        rewards.append(reward)
        first, second = task.observe()
        np.testing.assert_allclose(second, mirrored(first, ALL), atol=5e-6)
    np.testing.assert_allclose(np.array(rewards)[:, 1], np.array(rewards)[:, 0], atol=1e-7)
    state = loco.world.state
    moved = state.position[0] - [0.3, 0.4, 0.0]
    assert np.linalg.norm(moved[:2]) > 0.005 and abs(state.gravity[0, 1]) > 0.002
    np.testing.assert_allclose(state.position[1] * [1, -1, 1], state.position[0], atol=2e-6)
    task.close()


def slanted_stairs() -> tuple[Tile, Tile]:
    """Stairs on a lateral slope, level in no direction, and their image about the centre line.

    Every cell is planar, so it does not matter along which diagonal Bullet divides it.
    """
    tile = make_tile("stair", 0.3, np.random.default_rng(0))
    y = np.linspace(-0.5, 0.5, tile.heights.shape[1]) * TILE_SIZE
    heights = (tile.heights + 0.2 * y).astype(np.float32)
    one = dataclasses.replace(tile, heights=heights, support=heights.copy())
    back = heights[:, ::-1].copy()
    return one, dataclasses.replace(one, heights=back, support=back.copy())


def test_the_critic_sees_a_mirrored_terrain() -> None:
    """On mirrored stairs, a robot in the mirrored state has the mirrored observation.

    The first robot acts at random on stairs; the second is set to its mirror image at each step.
    """
    config = LowLevelConfig(terrain="tiles", families=("stair",), command_seconds=0.0)
    task = LowLevelTask(config, 2, seed=0, training=False)
    assert task.field is not None
    for row, tile in enumerate(slanted_stairs()):
        task.field.place(row, tile)
    loco, state = task.locomotion, task.locomotion.world.state
    loco.world.upload_terrain()
    loco.world.friction[:], loco.world.payload[:], loco.delay[:] = 0.6, 1.5, 0.012
    rng = np.random.default_rng(6)
    mirror_commands(loco, rng, gait=0)
    origin = task.field.origin(np.arange(2))
    pitch, middle = origin[1, 0], origin[0, 1] + TILE_SIZE / 2
    xy = np.array([[2.35, middle + 0.3], [2.35 + pitch, middle - 0.3]])
    loco.place(np.arange(2), xy, np.array([0.4, -0.4]), loco.clock.clock.copy())
    for _ in range(20):
        loco.act(np.tile(rng.normal(0.0, 0.5, 12), (2, 1)))
        loco.actions[:, 1] = mirrored(loco.actions[:, 0], JOINT_FLIP)
        state.position[1] = state.position[0] * [1, -1, 1] + [pitch, 2 * middle, 0.0]
        state.quaternion[1] = state.quaternion[0] * [-1, 1, -1, 1]
        state.lin_vel[1] = state.lin_vel[0] * [1, -1, 1]
        state.ang_vel[1] = state.ang_vel[0] * [-1, 1, -1]
        for joints in (state.q, state.qd):
            joints[1] = mirrored(joints[0], JOINT_FLIP)
        state.foot_force[1] = state.foot_force[0, [1, 0, 3, 2]]
        state.derive()
        task.ground = measure_ground(task.locomotion)
        first, second = task.observe()
        np.testing.assert_allclose(second, mirrored(first, ALL), atol=1e-4)
    critic, where = first, columns((*loco.layout, *CRITIC_LAYOUT))
    # The compared observation varies from left to right and along x.
    probes = critic[where["terrain"]].reshape(5, 3)
    assert np.abs(probes[:, 0] - probes[:, 2]).max() > 0.04 and np.ptp(probes[:, 1]) > 0.2
    assert np.ptp(critic[where["foot_height"]]) > 0.005
    dynamics = critic[where["dynamics"]].tolist()
    assert dynamics == pytest.approx([0.6, 0.5, 0.0, 0.4, 0.0, 0.0])
    task.close()


def test_latency_is_kept_at_a_faster_control_rate() -> None:
    """30 ms are three control steps at 100 Hz, longer than the history at 50 Hz."""
    physics = PhysicsConfig(control_dt=0.01, substeps=4)
    config = LowLevelConfig(physics=physics)
    loco = Locomotion(BulletWorld(1, config.robot, physics), config)
    assert loco.targets.shape == (5, 1, 12)
    loco.place(np.arange(1), np.zeros((1, 2)), np.zeros(1), np.zeros(1))
    loco.delay[:] = 0.03
    targets = []
    for action in (1.0, 0.0, 0.0, 0.0):
        loco.act(np.full((1, 12), action))
        targets.append(loco.world._wanted(loco.targets, loco.delay, loco.joint_offset)[0, 0])
    loco.world.close()
    moved = [np.abs(target - loco.nominal).max() > 0.1 for target in targets]
    assert moved == [False, False, False, True]


def test_phases_follow_the_clock_of_a_placed_robot() -> None:
    """``place`` updates the phases, so the high policy's first observation shows the new clock."""
    loco = Locomotion(BulletWorld(2, RobotConfig(), PhysicsConfig()), LowLevelConfig())
    loco.place(np.arange(2), np.array([[0.0, 0.0], [5.0, 0.0]]), np.zeros(2), np.array([0.1, 0.35]))
    # Trot with a duty factor of one half: FL and RR half a cycle ahead of FR and RL.
    np.testing.assert_allclose(
        loco.clock.phases, [[0.6, 0.1, 0.1, 0.6], [0.85, 0.35, 0.35, 0.85]], atol=1e-12
    )
    loco.world.close()


@pytest.mark.parametrize(
    ("walks", "lowest", "highest"), [(True, 0.025, 0.10), (False, -1e-4, 0.015)]
)
def test_feet_rise_without_a_policy_only_where_the_pose_carries_the_robot(
    walks: bool, lowest: float, highest: float
) -> None:
    """With zero actions, feet rise by 2.5 cm or more only if q0 walks.

    The command is a trot at 2.5 Hz with a swing height of 8 cm; its first cycle is not counted.
    """
    robot = dataclasses.replace(ROBOT, commanded_gait=walks)
    made = Locomotion(BulletWorld(1, robot, PHYSICS), LowLevelConfig(robot=robot, physics=PHYSICS))
    made.place(np.arange(1), np.zeros((1, 2)), np.zeros(1), np.zeros(1))
    made.command[:, INDEX["frequency"]] = 2.5
    risen = []
    for _ in range(56):
        made.act(np.zeros((1, 12)))
        risen.append(
            made.world.state.foot_position[0, :, 2] - made.world.state.geometry.foot_radius
        )
    made.world.close()
    apex = np.max(risen[16:], axis=0)
    assert (apex >= lowest).all() and (apex <= highest).all()


def test_armature_and_joint_friction_are_drawn() -> None:
    made, config = standing(40), RandomisationConfig()
    made.randomise(np.arange(40), config, np.random.default_rng(0))
    for drawn, (low, high) in (
        (made.world.armature, config.armature),
        (made.world.joint_friction[:, 0], config.joint_friction),
    ):
        width = high - low
        assert low <= drawn.min() < low + 0.1 * width
        assert high >= drawn.max() > high - 0.1 * width
    made.world.close()
