"""Every reward term of the high policy in states worked out by hand, and its memory."""

import dataclasses
import math

import numpy as np

from tdgc.config import CommandRanges, HighLevelConfig, HighRewardConfig, RobotConfig
from tdgc.sim.commands import INDEX, CommandDecoder
from tdgc.sim.geometry import read_geometry
from tdgc.sim.robot import RobotState
from tdgc.tasks import high_rewards as rewards
from tdgc.tasks.high_rewards import HIGH_TERMS, HighReward, HighStep, high_terms

E = math.exp


def high_step(**changes: object) -> HighStep:
    """Two robots at rest, 4 m from the goal and facing it, halfway through the episode."""
    step = HighStep(
        distance=np.full(2, 4.0),
        heading_error=np.zeros(2),
        time_share=np.full(2, 0.5),
        lin_vel=np.zeros((2, 3)),
        ang_vel=np.zeros((2, 3)),
        joint_speed=np.zeros((2, 12)),
        base_height=np.full(2, 0.30),
        standing_height=0.30,
        actions=np.zeros((2, 2, 13)),
        commands=np.zeros((3, 2, 15)),
        contact_forces=np.zeros((2, 5)),
        config=HighRewardConfig(),
    )
    return dataclasses.replace(step, **changes)  # type: ignore[arg-type]


def test_goal_distance_and_face() -> None:
    step = high_step(distance=np.array([4.0, 9.0]), heading_error=np.array([0.0, 2.0]))
    np.testing.assert_allclose(rewards.goal_distance(step), [0.5 + 1 - E(-1.5), 0.0], atol=1e-12)
    np.testing.assert_allclose(rewards.face(step), [1.0, math.cos(2.0)], atol=1e-12)
    there = high_step(distance=np.zeros(2))
    np.testing.assert_allclose(rewards.goal_distance(there), [2.0 - E(-3.0)] * 2, atol=1e-12)


def test_arrive_and_stable() -> None:
    step = high_step(distance=np.array([0.5, 0.49]), time_share=np.array([0.1, 0.25]))
    step.lin_vel[1], step.ang_vel[1] = [0.3, 0.0, 0.4], [0.0, 0.0, -0.2]
    step.joint_speed[1, 0] = 2.0
    step.base_height[1] = 0.35
    np.testing.assert_allclose(rewards.arrive(step), [0.0, 2.5], atol=1e-12)
    np.testing.assert_allclose(rewards.stable(step), [0.0, E(-0.8) * E(-0.25)], atol=1e-12)
    late = high_step(distance=np.zeros(2), time_share=np.array([1.0, 1.5]))
    assert rewards.arrive(late).tolist() == [1.0, 1.0]


def test_differences_of_actions_and_commands() -> None:
    step = high_step()
    step.actions[0, 1, :2] = [1.0, -0.5]
    step.commands[0, 1, 0], step.commands[1, 1, 0], step.commands[2, 1, 0] = 0.9, 0.3, 0.0
    np.testing.assert_allclose(rewards.action_rate(step), [0.0, 1.25], atol=1e-12)
    np.testing.assert_allclose(rewards.command_rate(step), [0.0, 0.36 / 15], atol=1e-12)
    np.testing.assert_allclose(rewards.command_acceleration(step), [0.0, 0.09 / 15], atol=1e-12)


def test_contact_laziness_and_alive() -> None:
    step = high_step(distance=np.array([4.0, 0.4]))
    step.contact_forces[1] = [41.0, 0.5, 1.0, 3.0, 0.0]
    assert rewards.contact_force(step).tolist() == [0.0, 42.0]
    assert rewards.laziness(step).tolist() == [1.0, 0.0]
    step.lin_vel[0] = [0.0, 0.06, 0.08]  # not below 0.1 m/s
    assert rewards.laziness(step).tolist() == [0.0, 0.0]
    assert rewards.alive(step).tolist() == [1.0, 1.0]


def test_high_terms_are_scaled_by_the_duration_of_a_step() -> None:
    config = dataclasses.replace(high_step().config, alive=0.5, face=0.2, laziness=0.0)
    terms = high_terms(high_step(config=config), 0.1)
    assert set(HIGH_TERMS) - set(terms) == {"laziness"}
    np.testing.assert_allclose(terms["alive"], [0.05, 0.05], atol=1e-15)
    np.testing.assert_allclose(terms["face"], [0.02, 0.02], atol=1e-15)
    assert set(HIGH_TERMS) <= {f.name for f in dataclasses.fields(HighRewardConfig)}


def memory() -> tuple[HighReward, CommandDecoder]:
    decoder = CommandDecoder(CommandRanges(vx=(-1.0, 1.0)))
    return HighReward(HighLevelConfig(), decoder, 2, 0.1), decoder


def test_the_reward_looks_back_on_decisions_as_shares_of_their_ranges() -> None:
    reward, decoder = memory()
    actions = np.zeros((2, 13))
    for value in (0.5, -1.0):
        actions[1, 0] = value
        reward.decide(decoder.decode(actions), actions)
    np.testing.assert_allclose(reward.actions[:, :, 0], [[0.0, -1.0], [0.0, 0.5]], atol=1e-12)
    np.testing.assert_allclose(
        reward.commands[:, :, INDEX["vx"]], [[0.5, 0.0], [0.5, 0.75], [0.5, 0.5]], atol=1e-12
    )
    reward.begin(np.array([1]))
    assert (reward.actions == 0.0).all()
    np.testing.assert_allclose(reward.commands[:, :, INDEX["vx"]], 0.5, atol=1e-12)


def test_a_script_without_actions_leaves_them_alone() -> None:
    reward, decoder = memory()
    reward.decide(decoder.decode(np.full((2, 13), 0.5)), None)
    assert (reward.actions == 0.0).all()
    np.testing.assert_allclose(reward.commands[0, :, INDEX["vx"]], 0.75, atol=1e-12)


def test_forces_are_the_largest_since_the_decision_of_robots_under_way() -> None:
    reward, decoder = memory()
    state = RobotState.zeros(read_geometry(RobotConfig()), 2)
    for trunk, leg in ((30.0, 1.0), (10.0, 4.0)):
        state.trunk_force[:], state.leg_force[:, 2] = trunk, leg
        reward.measure(state, np.array([0]))
    assert reward.force.tolist() == [[30.0, 0.0, 0.0, 4.0, 0.0], [0.0] * 5]
    reward.decide(decoder.decode(np.zeros((2, 13))), None)
    assert (reward.force == 0.0).all()
