"""Every reward term of the low policy in states worked out by hand, and how terms combine."""

import dataclasses
import math

import numpy as np
import pybullet
import pytest

from tdgc.config import LowRewardConfig, RobotConfig
from tdgc.sim.commands import INDEX, default_command
from tdgc.sim.gaits import desired_contact, gait_embedding, swing_profile
from tdgc.sim.geometry import read_geometry
from tdgc.sim.robot import Array, RobotState, foot_kinematics, nominal_pose
from tdgc.tasks import low_rewards as rewards
from tdgc.tasks.low_rewards import LOW_TERMS, LowStep, low_terms, total

E = math.exp
GEOMETRY = read_geometry(RobotConfig())
CONFIG = LowRewardConfig(sigma_lin=0.25, sigma_yaw=0.25)


def low_step(**changes: object) -> LowStep:
    """Two robots that stand still and upright on straight legs, with all feet in mid-stance."""
    phases = np.full((2, 4), 0.25)
    step = LowStep(
        state=RobotState.zeros(GEOMETRY, 2),
        command=np.tile(default_command(), (2, 1)),
        phases=phases,
        contact=np.ones((2, 4)),
        swing=np.zeros((2, 4)),
        base_height=np.full(2, 0.30),
        foot_height=np.full((2, 4), GEOMETRY.foot_radius),
        standing_height=0.30,
        stance=RobotConfig().stance,
        targets=np.zeros((3, 2, 12)),
        actions=np.zeros((2, 2, 12)),
        acceleration=np.zeros((2, 12)),
        last_tilt=np.zeros((2, 2)),
        was_contact=np.zeros((2, 4), dtype=bool),
        config=CONFIG,
    )
    return dataclasses.replace(step, **changes)  # type: ignore[arg-type]


def with_constants(step: LowStep, **constants: float) -> LowStep:
    return dataclasses.replace(step, config=dataclasses.replace(step.config, **constants))


def set_command(step: LowStep, **values: float) -> LowStep:
    """Set commands of the second robot."""
    for name, value in values.items():
        step.command[1, INDEX[name]] = value
    return step


def turn(step: LowStep, roll: float, pitch: float, yaw: float) -> LowStep:
    """Set the attitude of the second robot from Bullet's Euler angles."""
    step.state.quaternion[1] = pybullet.getQuaternionFromEuler([roll, pitch, yaw])
    step.state.derive()
    return step


# ------------------------------------------------------------------ tracking


def test_tracking_a_velocity() -> None:
    step = set_command(low_step(), vx=0.5, vy=-0.2)
    # The first robot follows its command; the second is off by (0.5, -0.2): e^2 = 0.29.
    np.testing.assert_allclose(rewards.track_lin_vel(step), [1.0, E(-0.29 / 0.25)], atol=1e-12)
    wide = with_constants(step, sigma_lin=1.0)
    np.testing.assert_allclose(rewards.track_lin_vel(wide), [1.0, E(-0.29)], atol=1e-12)


def test_velocity_is_tracked_in_the_heading_frame() -> None:
    """A robot that faces +y with its nose down and moves along +y moves straight forward."""
    step = set_command(low_step(), vx=0.8)
    step.state.lin_vel[1] = [0.0, 0.8, 0.5]
    turn(step, 0.0, 0.3, math.pi / 2)
    np.testing.assert_allclose(rewards.track_lin_vel(step), [1.0, 1.0], atol=1e-12)


def test_tracking_a_yaw_rate() -> None:
    step = set_command(low_step(), yaw_rate=0.4)
    step.state.ang_vel[1] = [3.0, -2.0, 0.1]
    np.testing.assert_allclose(rewards.track_yaw_rate(step), [1.0, E(-0.09 / 0.25)], atol=1e-12)


# ------------------------------------------------------------------ body


def test_body_height() -> None:
    step = set_command(low_step(base_height=np.array([0.27, 0.27])), body_height=-0.05)
    np.testing.assert_allclose(rewards.body_height(step), [0.0009, 0.0004], atol=1e-12)


@pytest.mark.parametrize(
    ("roll", "pitch", "yaw"),
    [(0.0, 0.3, 0.0), (0.2, 0.0, 0.0), (-0.2, 0.25, 0.0), (0.15, -0.3, 2.0), (-0.1, -0.2, -1.0)],
)
def test_commanded_gravity_is_that_of_a_robot_so_turned(
    roll: float, pitch: float, yaw: float
) -> None:
    step = turn(low_step(), roll, pitch, yaw)
    wanted = rewards.commanded_gravity(np.array([pitch]), np.array([roll]))
    np.testing.assert_allclose(wanted[0], step.state.gravity[1], atol=1e-12)
    set_command(step, pitch=pitch, roll=roll)
    np.testing.assert_allclose(rewards.orientation(step), [0.0, 0.0], atol=1e-12)


def test_signs_of_pitch_and_roll() -> None:
    """Positive pitch is nose down, positive roll is left side up."""
    step = turn(low_step(), 0.0, 0.3, 0.5)
    assert (step.state.rotation[1] @ [1.0, 0.0, 0.0])[2] == pytest.approx(-math.sin(0.3))
    step = turn(low_step(), 0.2, 0.0, 0.5)
    assert (step.state.rotation[1] @ [0.0, 1.0, 0.0])[2] == pytest.approx(math.sin(0.2))
    down = rewards.commanded_gravity(np.array([0.3, 0.0]), np.array([0.0, 0.2]))
    expected = [[math.sin(0.3), 0.0, -math.cos(0.3)], [0.0, -math.sin(0.2), -math.cos(0.2)]]
    np.testing.assert_allclose(down, expected, atol=1e-12)


def test_orientation_error() -> None:
    step = set_command(low_step(), pitch=0.3, roll=0.2)
    error = math.sin(0.3) ** 2 + (math.cos(0.3) * math.sin(0.2)) ** 2
    np.testing.assert_allclose(rewards.orientation(step), [0.0, error], atol=1e-12)
    turn(step, 0.0, 0.3, 1.0)
    error = (math.cos(0.3) * math.sin(0.2)) ** 2
    np.testing.assert_allclose(rewards.orientation(step), [0.0, error], atol=1e-12)


def test_vertical_velocity_and_tilt_rate() -> None:
    step = low_step()
    step.state.lin_vel[1] = [1.0, 2.0, -0.5]
    step.state.ang_vel[1] = [0.3, -0.4, 5.0]
    np.testing.assert_allclose(rewards.vertical_velocity(step), [0.0, 0.25], atol=1e-12)
    np.testing.assert_allclose(rewards.tilt_rate(step), [0.0, 0.25], atol=1e-12)
    # First level both now and a gait cycle ago; then nose down by 0.2 rad now, up by 0.1 before.
    np.testing.assert_allclose(rewards.nodding(step), [0.0, 0.0], atol=1e-12)
    before = np.array([[0.0, 0.0], [-math.sin(0.1), 0.0]])
    nods = turn(low_step(last_tilt=before), 0.0, 0.2, 0.0)
    change = (math.sin(0.2) + math.sin(0.1)) ** 2
    np.testing.assert_allclose(rewards.nodding(nods), [0.0, change], atol=1e-12)
    # Rolled onto its right side, a turn about the world's z is one about the body's y.
    turn(step, math.pi / 2, 0.0, 0.0)
    np.testing.assert_allclose(rewards.tilt_rate(step), [0.0, 0.09 + 25.0], atol=1e-9)


# ------------------------------------------------------------------ feet


def raibert(phase: float, duration: float = 0.5, frequency: float = 2.0, **command: float) -> Array:
    """Footholds of one robot with all feet at the same phase, (4, 2) m."""
    step = set_command(low_step(), duration=duration, frequency=frequency, **command)
    return rewards.raibert_targets(step.command[1:], np.full((1, 4), phase), step.stance, 0.0)[0]


RECTANGLE = np.array([[0.19, 0.125], [0.19, -0.125], [-0.19, 0.125], [-0.19, -0.125]])


def test_raibert_rests_under_the_commanded_rectangle() -> None:
    np.testing.assert_allclose(raibert(0.0), RECTANGLE, atol=1e-12)
    np.testing.assert_allclose(raibert(0.25, vx=1.0, vy=0.5), RECTANGLE, atol=1e-12)
    wide = raibert(0.7, stance_width=0.35, stance_length=0.33)
    np.testing.assert_allclose(wide, np.sign(GEOMETRY.hips) * [0.165, 0.175], atol=1e-12)


def test_raibert_rests_at_another_robots_stance() -> None:
    """At the default commands; others move the feet as far from there as from ours."""
    command, phases = low_step().command, np.full((2, 4), 0.25)
    command[1, INDEX["stance_width"]] += 0.08
    signs = np.sign(GEOMETRY.hips)
    for centre in (0.0, -0.06):  # hips that are further behind
        made = rewards.raibert_targets(command, phases, (0.6, 0.4), centre) - [centre, 0.0]
        np.testing.assert_allclose(made, [signs * [0.3, 0.2], signs * [0.3, 0.24]], atol=1e-12)


@pytest.mark.parametrize(
    ("phase", "lead"), [(0.0, 0.5), (0.25, 0.0), (0.5, -0.5), (0.75, 0.0), (1.0, 0.5)]
)
def test_raibert_leads_at_touch_down_and_trails_at_lift_off(phase: float, lead: float) -> None:
    """A stance of 0.5 / 2 Hz at 0.8 m/s is 0.2 m of travel, half of it ahead at touch-down."""
    made = raibert(phase, vx=0.8, vy=-0.4)
    np.testing.assert_allclose(made, RECTANGLE + lead * np.array([0.2, -0.1]), atol=1e-12)


def test_raibert_travel_is_that_of_a_stance() -> None:
    made = raibert(0.0, duration=0.6, frequency=3.0, vx=1.0)
    np.testing.assert_allclose(made, RECTANGLE + [0.1, 0.0], atol=1e-12)


def test_raibert_turning_left() -> None:
    """At touch-down left feet trail and right ones lead; front feet shift left, rear ones right.

    The ground under a foot at r moves by -(omega x r): 1 rad/s for 0.25 s, half of it ahead.
    """
    made = raibert(0.0, yaw_rate=1.0) - RECTANGLE
    left, right, front, rear = -0.125 * 0.125, 0.125 * 0.125, 0.125 * 0.19, -0.125 * 0.19
    expected = [[left, front], [right, front], [left, rear], [right, rear]]
    np.testing.assert_allclose(made, expected, atol=1e-12)


def test_a_foot_that_follows_raibert_stays_put_while_the_body_moves() -> None:
    """Over a stance a foot's position in the world is constant to first order in the turn."""
    vx, vy, turning, stance = 0.6, -0.3, 0.4, 0.125
    places = []
    for phase in np.linspace(0.0, 0.5, 11):
        made = raibert(float(phase), frequency=4.0, vx=vx, vy=vy, yaw_rate=turning)
        seconds = phase * 2 * stance
        c, s = math.cos(turning * seconds), math.sin(turning * seconds)
        places.append(made @ np.array([[c, s], [-s, c]]) + seconds * np.array([vx, vy]))
    spread = np.ptp(places, axis=0)
    assert spread.max() < 0.004  # of 0.075 m of travel


def test_raibert_error_is_measured_in_the_heading_frame() -> None:
    step = low_step()
    pose = nominal_pose(RobotConfig())
    step.state.q[:] = pose
    step.state.position[:] = [[3.0, -2.0, 0.3]] * 2
    turn(step, 0.0, 0.0, 2.2)
    expected, _ = foot_kinematics(GEOMETRY, pose[None], np.zeros((1, 12)))
    error = ((expected[0, :, :2] - RECTANGLE) ** 2).sum()
    np.testing.assert_allclose(rewards.raibert_foothold(step), [error, error], atol=1e-9)
    # In mid-stance a velocity shifts nothing; at touch-down the targets lead by 0.0833 m.
    set_command(step, vx=1.0)
    np.testing.assert_allclose(rewards.raibert_foothold(step)[1], error, atol=1e-9)
    step.phases[1] = 0.0
    ahead = ((expected[0, :, :2] - RECTANGLE - [1.0 / 12.0, 0.0]) ** 2).sum()
    np.testing.assert_allclose(rewards.raibert_foothold(step), [error, ahead], atol=1e-9)


def test_swing_height() -> None:
    """Robot 1 has FL at mid-swing 0.01 m too low, FR correctly halfway up, rear feet in stance."""
    phases = np.array([[0.25] * 4, [0.75, 7.0 / 12.0, 0.25, 0.25]])  # half sine: 1 and 1/2
    heights = np.full((2, 4), GEOMETRY.foot_radius)
    heights[1, 0] += 0.07
    heights[1, 1] += 0.04
    step = low_step(
        phases=phases, contact=np.array([[1.0] * 4, [0.0, 0.0, 1.0, 1.0]]),
        swing=swing_profile(phases), foot_height=heights,
    )  # fmt: skip
    np.testing.assert_allclose(rewards.swing_height(step), [0.0, 0.0001], atol=1e-12)
    step.contact[1] = [0.25, 0.0, 1.0, 1.0]
    np.testing.assert_allclose(rewards.swing_height(step), [0.0, 0.000075], atol=1e-12)
    set_command(step, swing_height=0.2)  # now 0.13 and 0.06 m too low
    expected = 0.75 * 0.13**2 + 0.06**2
    np.testing.assert_allclose(rewards.swing_height(step), [0.0, expected], atol=1e-12)


def test_swing_contact_force() -> None:
    step = low_step(contact=np.array([[1.0] * 4, [0.0, 0.5, 1.0, 0.0]]))
    step.state.foot_force[:] = [[50.0] * 4, [10.0, 10.0, 10.0, 0.0]]
    expected = (1.0 + 0.5) * (1.0 - E(-1.0)) / 4
    np.testing.assert_allclose(rewards.swing_contact_force(step), [0.0, expected], atol=1e-12)
    hard = with_constants(step, swing_force_scale=400.0)
    expected = (1.0 + 0.5) * (1.0 - E(-0.25)) / 4
    np.testing.assert_allclose(rewards.swing_contact_force(hard), [0.0, expected], atol=1e-12)


def test_stance_foot_speed() -> None:
    step = low_step(contact=np.array([[0.0] * 4, [1.0, 0.5, 0.0, 1.0]]))
    step.state.foot_velocity[:, :3] = [1.0, 2.0, -1.0]
    expected = 1.5 * (1.0 - E(-0.6)) / 4
    np.testing.assert_allclose(rewards.stance_foot_speed(step), [0.0, expected], atol=1e-12)
    fast = with_constants(step, stance_speed_scale=6.0)
    expected = 1.5 * (1.0 - E(-1.0)) / 4
    np.testing.assert_allclose(rewards.stance_foot_speed(fast), [0.0, expected], atol=1e-12)


def test_foot_slip_counts_feet_in_contact_now_or_a_step_ago() -> None:
    step = low_step()
    step.state.foot_velocity[:] = [0.3, -0.4, 9.0]
    np.testing.assert_allclose(rewards.foot_slip(step), [0.0, 0.0], atol=1e-12)
    step.state.foot_force[0] = [1.0, 1.0, 0.0, 0.0]  # not above the threshold of 1 N
    step.state.foot_force[1] = [1.1, 0.0, 200.0, 0.0]
    step.was_contact[1] = [True, True, False, False]
    np.testing.assert_allclose(rewards.foot_slip(step), [0.0, 0.75], atol=1e-12)


def test_leg_collision_counts_legs() -> None:
    step = low_step()
    step.state.leg_force[:] = [[0.0, 0.1, 0.0, 0.0], [0.2, 300.0, 0.0, 0.11]]
    assert rewards.leg_collision(step).tolist() == [0.0, 3.0]
    assert rewards.leg_collision(with_constants(step, leg_force=0.2)).tolist() == [0.0, 1.0]


# ------------------------------------------------------------------ joints and actions


def test_target_and_action_differences() -> None:
    step = low_step()
    step.targets[0, 1, :2], step.targets[1, 1, :2] = [0.3, 0.1], [0.1, 0.1]
    step.targets[2, 1, :2] = [0.1, -0.2]
    step.actions[0, 1, 3], step.actions[1, 1, 3] = 2.0, -1.0
    np.testing.assert_allclose(rewards.target_rate(step), [0.0, 0.04], atol=1e-12)
    np.testing.assert_allclose(
        rewards.target_acceleration(step), [0.0, 0.2**2 + 0.3**2], atol=1e-12
    )
    np.testing.assert_allclose(rewards.action_rate(step), [0.0, 9.0], atol=1e-12)


def test_joint_limits_cost_beyond_nine_tenths_of_the_range() -> None:
    step = low_step()
    low, high = GEOMETRY.joint_limits.T
    step.state.q[0] = (low + high) / 2 + 0.45 * (high - low)  # at the soft limits
    step.state.q[1] = (low + high) / 2
    step.state.q[1, 0], step.state.q[1, 1] = high[0], low[1] - 0.1
    expected = 0.05 * (high[0] - low[0]) + 0.05 * (high[1] - low[1]) + 0.1
    assert expected == pytest.approx(0.086 + 0.2595 + 0.1)
    np.testing.assert_allclose(rewards.joint_limits(step), [0.0, expected], atol=1e-12)
    whole = with_constants(step, soft_limit=1.0)  # only the angle beyond its range counts
    np.testing.assert_allclose(rewards.joint_limits(whole), [0.0, 0.1], atol=1e-12)


def test_torques_speeds_accelerations_and_power() -> None:
    acceleration = np.zeros((2, 12))
    acceleration[1, :2] = [30.0, -40.0]
    step = set_command(low_step(acceleration=acceleration), power_weight=0.002)
    step.state.torque[1, :3], step.state.qd[1, :3] = [3.0, -4.0, 0.0], [2.0, 1.0, 10.0]
    assert rewards.joint_torques(step).tolist() == [0.0, 25.0]
    assert rewards.joint_speeds(step).tolist() == [0.0, 105.0]
    assert rewards.joint_accelerations(step).tolist() == [0.0, 2500.0]
    np.testing.assert_allclose(rewards.power(step), [0.0, 0.02], atol=1e-12)  # braking costs, too
    set_command(step, power_weight=0.0)
    assert rewards.power(step).tolist() == [0.0, 0.0]


# ------------------------------------------------------------------ the sum


def test_table_and_configuration_name_the_same_terms() -> None:
    fields = {f.name for f in dataclasses.fields(LowRewardConfig)}
    assert set(LOW_TERMS) | {
        "sigma_lin", "sigma_yaw", "walking_penalty", "terrain_penalty",
        "swing_force_scale", "stance_speed_scale", "leg_force", "soft_limit",
    } == fields  # fmt: skip
    assert all(LOW_TERMS[name].__name__ == name for name in LOW_TERMS)
    weights = LowRewardConfig()
    positive = {name for name in LOW_TERMS if getattr(weights, name) > 0.0}
    assert positive == {"track_lin_vel", "track_yaw_rate"}


def test_terms_are_weighted() -> None:
    step = set_command(low_step(base_height=np.array([0.30, 0.20])), vx=0.5)
    terms = low_terms(step, LowRewardConfig(track_lin_vel=2.0, body_height=-10.0))
    assert set(terms) == set(LOW_TERMS)
    np.testing.assert_allclose(terms["track_lin_vel"], [2.0, 2.0 * E(-1.0)], atol=1e-12)
    np.testing.assert_allclose(terms["body_height"], [0.0, -0.1], atol=1e-12)


def test_a_weight_of_zero_switches_a_term_off() -> None:
    terms = low_terms(low_step(), LowRewardConfig(power=0.0, track_yaw_rate=0.0))
    assert set(LOW_TERMS) - set(terms) == {"power", "track_yaw_rate"}


def test_total_multiplies_what_tracking_earns() -> None:
    weights = LowRewardConfig()
    terms = {
        "track_lin_vel": np.array([1.0, 0.5]),
        "track_yaw_rate": np.array([0.5, 0.25]),
        "body_height": np.array([0.0, -0.3]),
        "foot_slip": np.array([0.0, -0.7]),
    }
    expected = [0.02 * 1.5, 0.02 * 0.75 * E(-1.0)]
    np.testing.assert_allclose(total(terms, weights, 0.02), expected, atol=1e-15)


def test_a_share_of_the_penalties() -> None:
    terms = {"track_lin_vel": np.array([1.0, 1.0]), "foot_slip": np.array([-0.6, -0.6])}
    shares = total(terms, LowRewardConfig(), 0.02, np.array([1.0, 0.5]))
    np.testing.assert_allclose(shares, [0.02 * E(-0.6), 0.02 * E(-0.3)], atol=1e-15)


def test_total_groups_by_the_sign_of_the_weight() -> None:
    """The sign of its weight decides a term's group, even if its value has the other sign."""
    terms = {"track_lin_vel": np.array([1.0]), "body_height": np.array([0.5])}
    rewarded = total(terms, LowRewardConfig(body_height=10.0), 0.02)
    np.testing.assert_allclose(rewarded, [0.02 * 1.5], atol=1e-15)
    punished = total(terms, LowRewardConfig(body_height=-10.0), 0.02)
    np.testing.assert_allclose(punished, [0.02 * E(0.5)], atol=1e-15)


def test_a_perfect_step_earns_the_most_there_is() -> None:
    step = low_step()
    step.state.q[:] = GEOMETRY.joint_limits.mean(axis=1)
    step.state.derive()
    weights = LowRewardConfig(raibert_foothold=0.0)
    best = total(low_terms(step, weights), weights, 0.02)
    np.testing.assert_allclose(best, [0.07, 0.07], atol=1e-12)


def test_desired_contact_of_a_trot_weighs_the_diagonal_in_swing() -> None:
    """Trot at g = 0.25: FR and RL in mid-stance, FL and RR in mid-swing but pressing."""
    phases = np.array([[0.75, 0.25, 0.25, 0.75]] * 2)
    step = low_step(phases=phases, contact=desired_contact(phases))
    step.command[:, 12:] = gait_embedding(0)
    step.state.foot_force[1] = [100.0, 0.0, 0.0, 100.0]
    np.testing.assert_allclose(rewards.swing_contact_force(step), [0.0, 0.5], atol=1e-3)
