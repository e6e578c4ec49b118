"""Drivers: the baseline's law, the hierarchy as in training, and pairs that are refused."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from tdgc import policies
from tdgc.benchmark.cues import CuesLaw
from tdgc.benchmark.drivers import BaselineDriver, Driver, HierarchyDriver, TeacherDriver, load_high
from tdgc.config import (
    CommandRanges,
    ConfigError,
    HighLevelConfig,
    LowLevelConfig,
    PhysicsConfig,
    RandomisationConfig,
    TeacherConfig,
    to_dict,
)
from tdgc.learn.recurrent import FastRecurrentPolicy
from tdgc.policies import Policy
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.commands import INDEX, NUM_ACTIONS, CommandDecoder, default_command, gait_index
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.observation import columns, observe, width
from tdgc.sim.robot import Array
from tdgc.tasks.executor import Executor
from tdgc.tasks.high_env import NavigationTask
from tdgc.tasks.high_observation import GUIDANCE, SEMANTIC, HighSources, high_layout
from tdgc.tasks.leaps import Landing
from tdgc.tasks.pairing import PRETRAINED, load_low, paired
from tdgc.tasks.probes import PROBES, height_probes
from tdgc.tasks.teacher import Skill, toward

LOW = PRETRAINED / "low"
LOW_POLICY, LOW_CONFIG = load_low(LOW)
CONFIG = HighLevelConfig(commands=LOW_CONFIG.commands, randomisation=RandomisationConfig(scale=0.0))


def save_high(
    path: Path,
    low: tuple[Policy, LowLevelConfig],
    config: HighLevelConfig = CONFIG,
    size: int | None = None,
    meta: dict[str, Any] | None = None,
    hidden: int | None = 8,
) -> Path:
    """Save a small high policy with random weights; as it walks, gaits and commands vary."""
    size = size or width(high_layout(config))
    policy = FastRecurrentPolicy(
        spaces.Box(-np.inf, np.inf, (size,)),
        spaces.Box(-config.action_limit, config.action_limit, (NUM_ACTIONS,)),
        lambda _: 0.0,
        lstm_hidden_size=hidden,
        net_arch={"pi": [8], "vf": [8]},
    )
    generator = th.Generator().manual_seed(3)
    walk = default_command()
    walk[INDEX["vx"]] = 0.6
    with th.no_grad():
        for parameter in policy.parameters():
            if parameter.dim() == 2:
                noise = th.randn(parameter.shape, generator=generator)
                parameter.copy_(noise / parameter.shape[-1] ** 0.5)
        if hidden is not None:
            policy.lstm_actor.weight_ih_l0.mul_(8.0)  # so that decisions change quickly
        policy.action_net.weight[:-1].mul_(0.5)
        policy.action_net.weight[-1].mul_(4.0)
        policy.action_net.bias.copy_(th.from_numpy(CommandDecoder().encode(walk)))
        policy.action_net.bias[-1] = 0.0  # between pronk and pace
    trained_on = {"config": to_dict(low[1]), "observation": low[0].actor_dim}
    policies.save(path, policy, {"config": to_dict(config), "low": trained_on} | (meta or {}))
    return path


@pytest.fixture
def loco(low) -> Iterator[Locomotion]:
    """A robot at the origin of a plane."""
    with closing(BulletWorld(1, low[1].robot, low[1].physics)) as world:
        loco = Locomotion(world, low[1])
        loco.place(np.arange(1), np.zeros((1, 2)), np.zeros(1), np.zeros(1))
        yield loco


# ------------------------------------------------------------------ gp


def test_toward_turns_to_the_goal_and_slows_while_it_faces_away():
    distance, error = np.array([5.0, 5.0, 5.0, 0.3]), np.array([0.0, np.pi / 2, np.pi, 0.0])
    speed, turn = toward(distance, error, 0.8)
    assert speed == pytest.approx([0.8, 0.0, 0.0, 0.3], abs=1e-9)
    assert turn == pytest.approx([0.0, 1.0, 1.0, 0.0], abs=1e-9)  # 1.5 * pi/2 is above the bound
    _, right = toward(np.array([5.0]), np.array([-0.4]), 0.8)
    assert right == pytest.approx([-0.6])


def test_baseline_holds_the_default_behaviour_parameters(loco):
    driver = BaselineDriver()
    driver.begin(loco, np.array([[6.5, 0.0]]), "stair")
    command = driver.command(0)[0]
    expected = default_command()
    for name, value in (("vx", 0.6), ("swing_height", 0.2), ("body_height", 0.04)):
        expected[INDEX[name]] = value
    assert command == pytest.approx(expected)


def test_baseline_keeps_to_the_ranges_that_it_is_given(low):
    """They are narrower than what its law asks for with a goal straight ahead and one behind."""
    narrow = dataclasses.replace(
        CommandRanges(),
        vx=(-0.3, 0.3),
        yaw_rate=(-0.5, 0.5),
        swing_height=(0.03, 0.1),
        body_height=(-0.03, 0.0),
        duration=(0.52, 0.6),
    )
    loco = Locomotion(BulletWorld(2, low[1].robot, low[1].physics), low[1])
    try:
        driver = BaselineDriver(bounds=narrow)
        assert driver.bounds == narrow
        loco.place(np.arange(2), np.array([[0.0, 0.0], [0.0, 5.0]]), np.zeros(2), np.zeros(2))
        driver.begin(loco, np.array([[6.5, 0.0], [-6.5, 4.9]]), "stair")
        ahead, behind = driver.command(0)
        expected = default_command()
        for name, value in (("swing_height", 0.1), ("body_height", 0.0), ("duration", 0.52)):
            expected[INDEX[name]] = value
        expected[INDEX["vx"]] = 0.3
        assert ahead == pytest.approx(expected)
        expected[INDEX["vx"]], expected[INDEX["yaw_rate"]] = 0.0, -0.5
        assert behind == pytest.approx(expected)
    finally:
        loco.world.close()


# ------------------------------------------------------------------ tdgc


def put_before_trenches(task):
    """Place two robots half a metre before the first trench of their tiles, which is in sight."""
    rows = np.arange(2)
    first = [tile.trenches[0, 0] for tile in task.field.features]
    xy = task.field.origin(rows) + np.column_stack([first, [4.0, 4.0]]) - [0.5, 0.0]
    task.locomotion.place(rows, xy, np.zeros(2), np.zeros(2))


@pytest.mark.parametrize("family", ["gap", "stair"])
def test_the_teacher_drives_as_it_teaches(low, family):
    """Its commands are those that the student is shown, held for a decision."""
    config = dataclasses.replace(CONFIG, families=(family,))
    skill = Skill(Landing(-0.02, 0.08))
    task = NavigationTask(config, LOW_POLICY, 2, seed=4, training=False, taught=skill)
    try:
        task.reset(np.arange(2))
        if family == "gap":
            put_before_trenches(task)
        executor, driver = Executor(task.locomotion, low[0]), TeacherDriver(low[1], skill)
        driver.begin(task.locomotion, task.goal, family)
        for step in range(12):
            if step % 5 == 0:
                if step > 0:
                    task.teacher.watch(task.locomotion, task.step_seconds)
                taught = task.decoder.decode(
                    task.observe()[:, -GUIDANCE:][:, :NUM_ACTIONS].astype(float)
                )
            np.testing.assert_allclose(driver.command(step), taught, atol=1e-6)
            executor.step(taught)
        assert (gait_index(taught) == (1 if family == "gap" else 0)).all()  # pronk, trot
    finally:
        task.close()


@pytest.mark.parametrize("script", ["teacher", "cues"])
def test_scripts_leap_at_the_speed_that_suits_the_low_policy(low, script):
    skill = Skill(Landing(), TeacherConfig(leap_speed=0.9))
    task = NavigationTask(
        dataclasses.replace(CONFIG, families=("gap",)), LOW_POLICY, 2, seed=4, training=False
    )
    try:
        task.reset(np.arange(2))
        put_before_trenches(task)
        driver: Driver = TeacherDriver(low[1], skill)
        if script == "cues":
            config = HighLevelConfig(commands=low[1].commands)
            driver = HierarchyDriver(CuesLaw(low[1], skill, config), config)
        driver.begin(task.locomotion, task.goal, "gap")
        command = driver.command(0)
        velocity = command[:, [INDEX["vx"], INDEX["vy"]]]
        np.testing.assert_allclose(np.hypot(*velocity.T), 0.9, atol=0.01)
        assert (gait_index(command) == 1).all()  # pronk
    finally:
        task.close()


@pytest.mark.parametrize("hidden", [8, None], ids=["recurrent", "feed-forward"])
def test_hierarchy_decides_in_the_evaluation_as_in_its_environment(low, tmp_path, hidden):
    """Its commands, and so its observation, hidden state, last action and clock, are the same."""
    gaits = ("trot", "pace", "bound") if hidden is None else CONFIG.gaits
    config = dataclasses.replace(CONFIG, families=("gap",), gaits=gaits)
    high, loaded = load_high(save_high(tmp_path / "high", low, config, hidden=hidden), *low)
    assert loaded == config and high.kind == ("mlp" if hidden is None else "lstm")
    task = NavigationTask(config, LOW_POLICY, 2, seed=1, training=False)
    try:
        task.reset(np.arange(2))
        driver = HierarchyDriver(high, loaded)
        driver.begin(task.locomotion, task.goal, "gap")
        state, seen = None, []
        for decision in range(4):
            action, state = high.predict(task.observe(), state)
            for step in range(5):
                command = driver.command(5 * decision + step)
                assert np.array_equal(command, task.decoder.decode(action))
            seen.append(command)
            task.step(action)
        assert (np.ptp(seen, axis=0).max(axis=0)[:3] > 1e-3).all()  # the policy reacts
        # New episodes begin with a fresh hidden state.
        task.reset(np.arange(2))
        first, _ = high.predict(task.observe())
        driver.begin(task.locomotion, task.goal, "gap")
        assert np.array_equal(driver.command(0), task.decoder.decode(first))
    finally:
        task.close()


def test_commands_are_held_between_decisions(low, loco, tmp_path):
    high, config = load_high(save_high(tmp_path / "high", low), *low)
    driver = HierarchyDriver(high, config)
    driver.begin(loco, np.array([[6.5, 0.0]]), "rough")
    commands = []
    for step in range(2 * config.decimation):
        commands.append(driver.command(step).copy())
        loco.world.state.q += 0.1  # something to react to
    changed = [not np.array_equal(a, b) for a, b in pairwise(commands)]
    assert np.flatnonzero(changed).tolist() == [4]


class Listener:
    """A high policy that does nothing, and keeps what it observed."""

    def __init__(self):
        self.seen = []

    def predict(self, observation, state=None):
        self.seen.append(observation)
        return np.zeros((len(observation), NUM_ACTIONS)), None


def test_no_time_is_left_after_the_longest_episode_of_training(low, loco):
    config = dataclasses.replace(paired(CONFIG, low[1]), episode_seconds=0.4)
    high = Listener()
    driver = HierarchyDriver(high, config)
    driver.begin(loco, np.array([[6.5, 0.0]]), "rough")
    for step in range(0, 30, config.decimation):
        driver.command(step)
    left = np.concatenate(high.seen)[:, columns(high_layout(config))["time_left"]]
    np.testing.assert_allclose(left.ravel(), [1.0, 0.75, 0.5, 0.25, 0.0, 0.0], atol=1e-6)


def test_mixed_terrain_is_unknown_to_the_high_level(low, loco, tmp_path):
    high, config = load_high(save_high(tmp_path / "high", low), *low)
    goal = np.array([[6.5, 0.0]])

    def first_command(family: str) -> Array:
        driver = HierarchyDriver(high, config)
        driver.begin(loco, goal, family)
        return driver.command(0)

    def expected(index: int) -> Array:
        zero, families = np.zeros((1, NUM_ACTIONS)), np.array([index])
        probes = height_probes(loco, PROBES[HighLevelConfig().probes])
        nothing = np.zeros(1)
        seen = HighSources(loco, goal, nothing, zero, families, probes, nothing, nothing)
        action, _ = high.predict(observe(high_layout(config), seen))
        return CommandDecoder(config.commands).decode(action)

    for family in ("rough", "tilt"):
        assert np.array_equal(first_command(family), expected(SEMANTIC.index(family)))
    assert np.array_equal(first_command("mixed"), expected(len(SEMANTIC) - 1))
    assert not np.array_equal(first_command("mixed"), first_command("rough"))


# ------------------------------------------------------------------ pairs that do not fit


def test_a_low_level_that_does_not_match_is_refused_by_name(low, tmp_path):
    policy, config = low
    path = save_high(tmp_path / "high", low)
    slow = dataclasses.replace(config, physics=PhysicsConfig(control_dt=0.04))
    with pytest.raises(ConfigError, match=r"high: .* a control step of 0.02 s, not 0.04$"):
        load_high(path, policy, slow)
    fixed = dataclasses.replace(
        config, robot=dataclasses.replace(config.robot, commanded_pose=False)
    )
    with pytest.raises(ConfigError, match=r"with robot.commanded_pose True, not False$"):
        load_high(path, policy, fixed)
    other = dataclasses.replace(config, robot=dataclasses.replace(config.robot, urdf="other.urdf"))
    with pytest.raises(ConfigError, match=r"with robot.urdf urdf/quadruped.urdf, not other.urdf$"):
        load_high(path, policy, other)
    narrow = dataclasses.replace(
        config, commands=dataclasses.replace(CommandRanges(), vy=(-0.3, 0.3))
    )
    with pytest.raises(ConfigError, match=r"commands.vy asks for \[-0.6, 0.6\].*\[-0.3, 0.3\]"):
        load_high(path, policy, narrow)
    other = {"config": to_dict(config), "observation": policy.actor_dim - 3}
    path = save_high(tmp_path / "other", low, meta={"low": other})
    n = policy.actor_dim
    with pytest.raises(ConfigError, match=f"low policy that observes {n - 3} values, not {n}$"):
        load_high(path, *low)


def test_files_that_are_no_high_level_are_refused(low, tmp_path):
    with pytest.raises(ConfigError, match=r"low: not a high policy of this package$"):
        load_high(LOW, *low)
    path = save_high(tmp_path / "high", low, meta={"low": None})
    with pytest.raises(ConfigError, match=r"high: its metadata do not say what it was trained on$"):
        load_high(path, *low)
    path = save_high(tmp_path / "high", low, size=80)
    with pytest.raises(ConfigError, match=r"high policy that observes 92 values, not 80$"):
        load_high(path, *low)
    with pytest.raises(policies.PolicyFileError, match=r"none.json: no such file$"):
        load_high(tmp_path / "none", *low)
