"""The decision-level MDP: observation, rewards, curriculum, tiles, teacher, resume, refusals."""

from __future__ import annotations

import dataclasses
from contextlib import closing

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from test_drivers import put_before_trenches

import tdgc  # noqa: F401  registers the environments
from tdgc import policies
from tdgc.config import (
    NO_TEACHER,
    ConfigError,
    HighLevelConfig,
    HighRewardConfig,
    HighTrainConfig,
    LowLevelConfig,
    RobotConfig,
    to_dict,
    with_overrides,
)
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.commands import NAMES, CommandDecoder, default_command, gait_index
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.observation import JOINT_FLIP, columns, width
from tdgc.sim.robot import nominal_pose
from tdgc.sim.terrain import make_tile
from tdgc.sim.tile import TILE_SIZE
from tdgc.tasks import high_env, high_rewards
from tdgc.tasks.executor import Executor
from tdgc.tasks.high_env import NavigationTask
from tdgc.tasks.high_observation import (
    GUIDANCE,
    GUIDANCE_PARTS,
    SEMANTIC,
    high_layout,
    high_mirror,
    untold_column,
)
from tdgc.tasks.high_rewards import HighStep
from tdgc.tasks.leaps import Landing
from tdgc.tasks.pairing import PRETRAINED, load_low, paired
from tdgc.tasks.probes import PROBE_RANGE, PROBES, height_probes
from tdgc.tasks.rules import FELL, REACHED
from tdgc.tasks.statistics import summarise_high
from tdgc.tasks.teacher import WAY, Skill

LOW = PRETRAINED / "low"
LOW_POLICY, LOW_CONFIG = load_low(LOW)
POINTS = PROBES[HighLevelConfig().probes]
NOMINAL = nominal_pose(RobotConfig())
CONFIG = HighLevelConfig(commands=LOW_CONFIG.commands)


@pytest.fixture
def task():
    task = NavigationTask(CONFIG, LOW_POLICY, 5, seed=3, training=False)
    task.reset(np.arange(5))
    yield task
    task.close()


def step_of(**changes) -> HighStep:
    """A robot standing at rest 4 m from the goal, facing it."""
    zero3 = np.zeros((1, 3))
    base = HighStep(
        distance=np.array([4.0]),
        heading_error=np.zeros(1),
        time_share=np.array([0.25]),
        lin_vel=zero3,
        ang_vel=zero3,
        joint_speed=np.zeros((1, 12)),
        base_height=np.array([0.30]),
        standing_height=0.30,
        actions=np.zeros((2, 1, 13)),
        commands=np.zeros((3, 1, 15)),
        contact_forces=np.zeros((1, 5)),
        config=HighRewardConfig(),
    )
    return dataclasses.replace(base, **changes)


def test_weights_are_scaled_by_the_steps_duration():
    terms = high_rewards.high_terms(step_of(), dt=0.1)
    assert terms["alive"][0] == pytest.approx(0.1 * HighRewardConfig().alive)
    assert terms["laziness"][0] == pytest.approx(0.1 * HighRewardConfig().laziness)
    off = step_of(config=dataclasses.replace(HighRewardConfig(), face=0.0))
    assert "face" not in high_rewards.high_terms(off, dt=0.1)


def test_without_step_time_scaling_weights_are_per_decision():
    config = dataclasses.replace(HighRewardConfig(), step_time_scaling=False)
    for dt in (0.02, 0.1):
        terms = high_rewards.high_terms(step_of(config=config), dt)
        assert terms["alive"][0] == 0.1 and terms["laziness"][0] == -0.5


def worth(rewards_config: HighRewardConfig, falls: float) -> tuple[float, float]:
    """Discounted return of marking time at the start, and of walking towards the goal instead.

    The walk leads from 6.5 m to 0.7 m from the goal at 0.5 m/s; there the robot marks time. On the
    way it falls ``falls`` times a second, after which it earns nothing. It is never slow enough to
    count as lazy.
    """

    def each(distance: float) -> float:
        seen = step_of(
            distance=np.array([distance]), lin_vel=np.full((1, 3), 0.3), config=rewards_config
        )
        return float(sum(term[0] for term in high_rewards.high_terms(seen, 0.1).values()))

    gamma, start, near, decisions = 0.99, 6.5, 0.7, 116
    survive = gamma * np.exp(-0.1 * falls)
    walk = sum(survive**k * each(start - 0.05 * k) for k in range(decisions))
    there = survive**decisions * each(near) / (1.0 - gamma)
    return each(start) / (1.0 - gamma), walk + there


def test_without_a_teacher_standing_at_the_start_does_not_pay():
    """With the settings for training without a teacher, walking pays more than standing.

    The untrained policy falls 0.08 times a second on level 0. By default it then gains next to
    nothing by walking, and at 0.1 falls a second it loses.
    """
    stay, walk = worth(HighRewardConfig(), 0.08)
    assert stay == pytest.approx(9.18, abs=0.01) and walk == pytest.approx(9.56, abs=0.05)
    assert worth(HighRewardConfig(), 0.1)[1] < stay
    alone = with_overrides(HighTrainConfig(), NO_TEACHER).env.rewards
    stay, walk = worth(alone, 0.08)
    assert stay == pytest.approx(3.0) and walk > 2.5 * stay
    assert worth(alone, 0.2)[1] > stay


def test_layout_and_cues():
    sizes = {
        cues: width(high_layout(dataclasses.replace(CONFIG, cues=cues)))
        for cues in ("none", "semantic", "geometric", "both")
    }
    assert sizes == {"none": 53, "semantic": 59, "geometric": 86, "both": 92}
    assert width(high_layout(dataclasses.replace(CONFIG, clock="sine"))) == 88
    assert width(high_layout(dataclasses.replace(CONFIG, probe_age=False))) == 91
    assert width(high_layout(dataclasses.replace(CONFIG, closing_speed=False))) == 91
    assert SEMANTIC[-1] == "unknown"


def test_sees_how_fast_the_goal_comes_nearer(task):
    column = width(high_layout(CONFIG)) - 1
    assert (task.observe()[:, column] == 0.0).all()
    world, away = task.locomotion.world, task.goal - task.locomotion.world.state.position[:, :2]
    world.state.position[:, :2] += 0.12 * away / np.linalg.norm(away, axis=1)[:, None]
    task._observer.measure(task.goal)
    assert task.observe()[:, column] == pytest.approx(np.full(5, 1.2), abs=1e-6)
    task.reset(np.array([1, 3]))
    assert (task.observe()[:, column] != 0.0).tolist() == [True, False, True, False, True]


@pytest.mark.parametrize("cues", ["both", "semantic", "geometric", "none"])
def test_mirrored_robots_see_mirrored_things(cues):
    """A robot's mirror image on the mirrored tile, one of Pillar, has the mirrored observation."""
    config = dataclasses.replace(CONFIG, cues=cues, families=("pillar",), unknown_share=0.0)
    task = NavigationTask(config, LOW_POLICY, 2, seed=0, training=False)
    loco, state, rng = task.locomotion, task.locomotion.world.state, np.random.default_rng(0)
    tile = make_tile("pillar", 1.0, rng)
    image = dataclasses.replace(tile, heights=tile.heights[:, ::-1], support=tile.support[:, ::-1])
    for row, placed in enumerate((tile, image)):
        task.field.place(row, placed)
    task.reset(np.arange(2))
    origin, middle = task.field.origin(np.arange(2)), TILE_SIZE / 2
    task.goal[:] = origin + [[7.25, middle + 0.6], [7.25, middle - 0.6]]
    command = task.decoder.decode(rng.uniform(-1.0, 1.0, 13))
    mirror = high_mirror(config)
    sign = np.array([-1.0 if name in ("vy", "yaw_rate", "roll") else 1.0 for name in NAMES])
    loco.command[:] = [command, sign * command]
    x, y, _ = tile.features.pillars[0]
    xy = origin + [[x - 0.7, y + 0.1], [x - 0.7, TILE_SIZE - y - 0.1]]
    loco.place(np.arange(2), xy, np.array([0.3, -0.3]), np.full(2, 0.2))
    angles = rng.normal(0.0, 0.2, 12)
    index, flip = JOINT_FLIP
    state.q[:] = [NOMINAL + angles, NOMINAL + angles[list(index)] * flip]
    state.derive()
    task.rewards.actions[0] = rng.uniform(-1.0, 1.0, 13)
    task.rewards.actions[0, 1] *= mirror.action_sign
    task._observer.begin(np.arange(2), task.goal)
    seen, other = task.observe()
    np.testing.assert_allclose(
        other, seen[list(mirror.obs_index)] * np.float32(mirror.obs_sign), atol=2e-5
    )
    assert np.abs(other - seen).max() > 0.3
    task.close()


def test_a_symmetric_policy_needs_the_same_bounds_to_both_sides():
    ranges = dataclasses.replace(CONFIG.commands, vy=(-0.2, 0.6))
    with pytest.raises(ConfigError, match=r"^commands.vy must be the same to both sides .* \[-0.2"):
        high_mirror(dataclasses.replace(CONFIG, commands=ranges))
    with pytest.raises(ConfigError, match=r"^probes that are staggered are not the same on both"):
        high_mirror(dataclasses.replace(CONFIG, probes="staggered"))
    high_mirror(dataclasses.replace(CONFIG, probes="staggered", cues="semantic"))  # sees none


def test_the_teachers_episodes_move_no_levels():
    config = dataclasses.replace(CONFIG, window=2, threshold=2, first_levels=3)
    task = NavigationTask(config, LOW_POLICY, 10, seed=0, taught=Skill(), led=75)
    task.reset(np.arange(10))
    task.curriculum.push(np.arange(10), np.zeros(10, dtype=bool))
    task._led[:] = np.arange(10) < 5
    task.elapsed[:] = task.horizon - 1
    before = task.curriculum.levels.copy()
    assert (before[5:] > 0).any()
    task.step(np.zeros((10, 13)))
    after = task.curriculum.levels
    assert (after[:5] == before[:5]).all() and (after[5:] == np.maximum(before[5:] - 1, 0)).all()
    task.close()


def test_some_episodes_in_training_are_not_told_their_family():
    """A fifth of 400 training episodes hide their family, either of two; in evaluation none do."""
    config = dataclasses.replace(CONFIG, families=("tilt", "rough"), unknown_share=0.2)
    where = columns(high_layout(CONFIG))["family"]
    names = np.tile([SEMANTIC.index("tilt"), SEMANTIC.index("rough")], 10)
    for training in (True, False):
        task = NavigationTask(config, LOW_POLICY, 20, seed=0, training=training)
        unknown = np.zeros((20, 20), dtype=bool)
        for episode in unknown:
            task.reset(np.arange(20))
            seen = task.observe()
            told = seen[:, where].argmax(axis=1)
            episode[:] = seen[:, untold_column(CONFIG)] == 1.0
            assert (told == np.where(episode, SEMANTIC.index("unknown"), names)).all()
        task.close()
        if training:
            of_tilt, of_rough = unknown[:, ::2].mean(), unknown[:, 1::2].mean()
            assert 0.1 < of_tilt < 0.3 and 0.1 < of_rough < 0.3
            assert 0 < unknown[1].sum() < 20 and (unknown[0] != unknown[1]).any()
        else:
            assert not unknown.any()
    assert untold_column(dataclasses.replace(CONFIG, cues="geometric")) is None


def test_goal_is_seen_in_the_heading_frame(task):
    where = columns(high_layout(CONFIG))["goal"]
    task.goal[:] = task.locomotion.world.state.position[:, :2] + [0.0, 2.0]  # to the world's +y
    yaw = np.array([0.0, np.pi / 2, np.pi, -np.pi / 2, 0.0])
    xy = task.locomotion.world.state.position[:, :2].copy()
    task.locomotion.place(np.arange(5), xy, yaw, np.zeros(5))
    seen = task.observe()[:, where]
    assert seen[:, 0] == pytest.approx(np.full(5, 0.25), abs=1e-6)
    assert seen[:4, 1] == pytest.approx([0.0, 1.0, 0.0, -1.0], abs=1e-6)
    assert seen[:4, 2] == pytest.approx([1.0, 0.0, -1.0, 0.0], abs=1e-6)


def test_probes_see_what_is_ahead(task):
    # Robot 1 faces a wall that begins 0.4 m ahead of it.
    state = task.locomotion.world.state
    row = np.flatnonzero(POINTS[:, 0] > 0.45)
    near = np.flatnonzero(POINTS[:, 0] < 0.35)
    n = 161
    x = state.position[1, 0] + 0.4
    task.field.heights[n : 2 * n] = 0.0
    task.field.heights[int(np.ceil(x / 0.05)) : 2 * n] = 0.3
    xy = state.position[:, :2].copy()
    task.locomotion.place(np.arange(5), xy, np.zeros(5), np.zeros(5))
    task._observer.begin(np.arange(5), task.goal)
    probes = task.observe()[1, columns(high_layout(CONFIG))["probes"]] * 0.5
    standing = state.position[1, 2] - 0.30
    assert probes[row] == pytest.approx(0.3 - standing, abs=1e-6)
    assert probes[near] == pytest.approx(-standing, abs=1e-6)


@pytest.mark.parametrize("training", [True, False])
def test_sensors_are_noisy_in_training_only(training):
    """Noise is added to the low policy's observation and to the probes, in training only."""
    task = NavigationTask(CONFIG, LOW_POLICY, 5, seed=3, training=training)
    robot, physics = task.low_config.robot, task.low_config.physics
    exact = Locomotion(BulletWorld(5, robot, physics, task.field), task.low_config)
    try:
        task.reset(np.arange(5))
        loco = task.locomotion
        seen = task.observe()[:, columns(high_layout(CONFIG))["probes"]] * PROBE_RANGE
        off = np.abs(seen - height_probes(loco, POINTS))
        assert (off.max() > 0.01) == training and off.max() <= 0.02 + 1e-6
        exact.load_state_dict(loco.state_dict())
        task._executor.step(task.decoder.decode(np.zeros((5, 13))))
        Executor(exact, task.low).step(task.decoder.decode(np.zeros((5, 13))))
        assert np.array_equal(loco.actions[0], exact.actions[0]) != training
    finally:
        task.close()
        exact.world.close()


def test_family_is_one_hot(task):
    family = task.observe()[:, columns(high_layout(CONFIG))["family"]]
    assert np.array_equal(family, np.eye(6)[[0, 1, 2, 3, 3]])  # Gap is listed twice


def test_a_decision_lasts_five_control_steps(task):
    clock = task.locomotion.clock.clock.copy()
    action = np.zeros((5, 13))
    action[:, 4] = 1.0  # 4 Hz
    task.step(action)
    moved = np.mod(task.locomotion.clock.clock - clock, 1.0)
    assert moved == pytest.approx(np.full(5, 4.0 * 0.1))
    assert task.horizon == 200 and task.step_seconds == pytest.approx(0.1)


def test_reaching_the_goal_counts_once_and_ends_after_the_hold(task):
    task.goal[0] = task.locomotion.world.state.position[0, :2]
    ends = []
    for k in range(1, 23):
        _, terminated, truncated = task.step(np.zeros((5, 13)))
        if terminated[0] or truncated[0]:
            ends.append((k, bool(truncated[0])))
            break
    assert task.reached[0] and not task.reached[1]
    assert ends == [(21, True)]  # reached in decision 1, held for 20 more


def test_curriculum_moves_levels_and_redraws_tiles():
    config = dataclasses.replace(
        CONFIG, families=("stair",), window=2, threshold=2, episode_seconds=0.2
    )
    task = NavigationTask(config, LOW_POLICY, 2, seed=0)
    try:
        task.reset(np.arange(2))
        for _ in range(2):  # two episodes of two decisions; only robot 0 reaches its goal
            task.goal[0] = task.locomotion.world.state.position[0, :2]
            task.goal[1] = task.locomotion.world.state.position[1, :2] + 3.0
            for _ in range(2):
                _, terminated, truncated = task.step(np.zeros((2, 13)))
            assert truncated.all() and not terminated.any()
            task.reset(np.arange(2))
        assert task.curriculum.levels.tolist() == [1, 0]
        rises = [task.field.features[k].risers[0, 1] for k in range(2)]
        assert rises == pytest.approx([0.042, 0.03])  # d = 0.1 and d = 0
    finally:
        task.close()


@pytest.mark.parametrize("rule", ["uniform", "hardest"])
def test_levels_without_performance(rule):
    """Levels are drawn for each episode, or always the hardest; outcomes do not change them."""
    config = dataclasses.replace(
        CONFIG, families=("tilt",), curriculum=rule, levels=4, window=2, threshold=2
    )
    task = NavigationTask(config, LOW_POLICY, 30, seed=0)
    try:
        met = []
        for _ in range(6):
            task.reset(np.arange(30))
            met.append(task.curriculum.levels.copy())
            assert np.array_equal(task.tiles.level, met[-1])
            task.goal[:] = task.locomotion.world.state.position[:, :2]
            task.elapsed[:] = task.horizon - 1
            task.step(np.zeros((30, 13)))
            assert task.reached.all() and np.array_equal(task.curriculum.levels, met[-1])
        counts = np.bincount(np.concatenate(met), minlength=4)
        if rule == "hardest":
            assert counts.tolist() == [0, 0, 0, 180]
        else:
            assert counts.sum() == 180 and (counts > 25).all() and (counts < 70).all()
    finally:
        task.close()


def test_trenches_are_shallow_in_training_alone_and_where_it_is_asked_for():
    depths = []
    for asked, training in ((0.05, True), (0.05, False), (None, True)):
        config = dataclasses.replace(CONFIG, families=("gap",), shallowest_trench=asked)
        task = NavigationTask(config, LOW_POLICY, 1, seed=0, training=training)
        depths.append(-task.field.heights.min())
        task.close()
    assert depths == pytest.approx([0.05, 0.6, 0.6], abs=1e-6)


def test_velocities_alone_leave_the_other_commands_at_their_defaults():
    low = LOW_CONFIG
    config = paired(HighLevelConfig(behaviour="velocities"), low)
    decoder = CommandDecoder(config.commands)
    rng, default = np.random.default_rng(0), default_command()
    commands = decoder.decode(rng.uniform(-1.0, 1.0, (50, 13)))
    assert (commands[:, 3:12] == default[3:12]).all()
    assert (np.ptp(commands[:, :3], axis=0) > 1.0).all()
    assert paired(config, low) == config  # as when read from a policy's file
    high = dataclasses.replace(low.commands, swing_height=(0.19, 0.19))
    config = paired(HighLevelConfig(behaviour="velocities", commands=high), low)
    assert config.commands.swing_height == (0.19, 0.19)
    assert config.commands.body_height == (0.0, 0.0)  # the default, within the low policy's bounds


def test_a_teacher_says_what_can_be_said_of_what_it_does():
    """A student limited to trot at fixed parameters is still shown the velocities of a leap."""
    config = dataclasses.replace(CONFIG, families=("gap",), gaits=("trot",), behaviour="velocities")
    task = NavigationTask(config, LOW_POLICY, 2, seed=0, taught=Skill(Landing()), led=6)
    try:
        task.reset(np.arange(2))
        put_before_trenches(task)
        size = width(high_layout(CONFIG))
        taught = task.decoder.decode(task.observe()[:, size : size + 13].astype(float))
        wanted = task.teacher.commands(task.locomotion, task.goal)
        assert (gait_index(wanted) == 1).all() and (gait_index(taught) == 0).all()
        np.testing.assert_allclose(taught[:, :3], wanted[:, :3], atol=1e-6)
        np.testing.assert_allclose(taught[:, 3:12], np.tile(default_command()[3:12], (2, 1)))
    finally:
        task.close()


def test_robots_begin_spread_over_the_first_levels():
    config = dataclasses.replace(CONFIG, families=("stair", "gap"), first_levels=3)
    task = NavigationTask(config, LOW_POLICY, 8, seed=0)
    assert task.curriculum.levels.tolist() == [0, 0, 1, 1, 2, 2, 0, 0]
    task.close()
    config = dataclasses.replace(config, first_level=7, first_levels=2)
    task = NavigationTask(config, LOW_POLICY, 8, seed=0)
    levels = [7, 7, 8, 8, 7, 7, 8, 8]
    assert task.curriculum.levels.tolist() == levels
    task.curriculum.push(np.arange(8), np.zeros(8, dtype=bool))
    state = task.state_dict()
    del state["episodes"], state["curriculum"]  # of a phase before one that sets its own levels
    task.load_state_dict(state)
    assert task.curriculum.levels.tolist() == task.tiles.level.tolist() == levels
    task.close()


def test_a_teacher_shows_the_second_way_around_pillars():
    """The guidance holds the difference of the second way from the first, in actions."""
    task = NavigationTask(
        dataclasses.replace(CONFIG, families=("pillar",)), LOW_POLICY, 40, 0, taught=Skill()
    )
    try:
        task.curriculum.levels[:] = 9
        task.reset(np.arange(40))
        task.locomotion.place(
            np.arange(40),
            np.array([task.field.features[i].pillars[0, :2] for i in range(40)])
            + task._origin
            - [0.5, 0.0],
            np.zeros(40),
            np.zeros(40),
        )
        guidance = task.observe()[:, width(high_layout(CONFIG)) :].astype(float)
        taught, aside, dearer, _ = np.split(
            guidance, np.cumsum([*GUIDANCE_PARTS.values()])[:-1], axis=1
        )
        second = dearer[:, 0] > 0.0
        assert 5 < second.sum() < 40
        assert (np.abs(aside[second]).max(axis=1) > 0.5).all() and not aside[~second].any()
        taught[:, WAY] += aside
        np.testing.assert_allclose(task.decoder.decode(taught), task.teacher.other, atol=1e-6)
    finally:
        task.close()


def test_a_teacher_shows_its_actions_and_leads_fewer_and_fewer_episodes():
    config = dataclasses.replace(CONFIG, families=("stair", "gap"), episode_seconds=0.2)
    task = NavigationTask(config, LOW_POLICY, 40, seed=0, taught=Skill(), led=6)
    try:
        task.reset(np.arange(40))
        size = width(high_layout(CONFIG))
        assert task.observation_space.shape == (size + GUIDANCE,)
        led = []
        for _ in range(8):
            led.append(task._led.mean())
            leads = task._led.copy()
            taught = task.observe()[:, size : size + 13].astype(float)
            commands = task.teacher.commands(task.locomotion, task.goal)
            np.testing.assert_allclose(task.decoder.decode(taught), commands, atol=1e-6)
            _, terminated, truncated = task.step(np.full((40, 13), 0.25))
            np.testing.assert_allclose(task.rewards.actions[0][leads], taught[leads], atol=1e-6)
            assert (task.rewards.actions[0][~leads] == 0.25).all()
            task.reset(np.flatnonzero(terminated | truncated))
        assert led[0] == led[1] == 1.0  # after episodes of two decisions, the share is 2/3, 1/3, 0
        assert 0.45 < led[2] < 0.9 and 0.1 < led[4] < 0.55 and led[6] == led[7] == 0.0
    finally:
        task.close()


def test_the_hardest_level_is_trained_on_alone_also_when_resumed():
    config = dataclasses.replace(CONFIG, families=("stair",), curriculum="uniform")
    task = NavigationTask(config, LOW_POLICY, 4, seed=0)
    hardest = NavigationTask(
        dataclasses.replace(config, curriculum="hardest"), LOW_POLICY, 4, seed=0
    )
    try:
        task.reset(np.arange(4))
        assert (task.tiles.level < 10).any()
        hardest.load_state_dict(task.state_dict())
        assert hardest.tiles.level.tolist() == task.tiles.level.tolist()
        hardest.reset(np.array([1, 2]))
        assert hardest.tiles.level[[1, 2]].tolist() == [10, 10]
        assert hardest.tiles.level[[0, 3]].tolist() == task.tiles.level[[0, 3]].tolist()
    finally:
        task.close()
        hardest.close()


@pytest.mark.parametrize("taught", [None, Skill()])
@pytest.mark.parametrize("episodes", [True, False])
def test_the_future_follows_from_the_state(episodes, taught):
    """A task that loads a state continues exactly as the one that saved it.

    With ``episodes`` in the state, it continues those, as the other does after ``forget``; they end
    during the test. Without, it begins new ones, as the other does after ``restart``.
    """
    config = dataclasses.replace(CONFIG, families=("rough", "gap"), episode_seconds=0.8)
    first = NavigationTask(config, LOW_POLICY, 3, seed=1, taught=taught, led=15)
    second = NavigationTask(config, LOW_POLICY, 3, seed=1, taught=taught, led=15)
    try:
        first.reset(np.arange(3))
        rng = np.random.default_rng(0)
        for _ in range(5):
            first.step(rng.uniform(-1, 1, (3, 13)))
        first._next_push[0] = 0
        first._pushes.push(first.locomotion.world, first.elapsed, np.ones(first.num_robots))
        first.tiles.episodes[:] = 5  # so that the next episodes bring new tiles
        state = first.state_dict()
        if episodes:
            first.forget()
        else:
            del state["episodes"]
            first.restart()
        second.load_state_dict(state)
        actions = rng.uniform(-1, 1, (6, 3, 13))
        futures, drawn = [], []
        for task in (first, second):
            drawn.append(task.tiles.drawn)
            future = []
            for a in actions:
                reward, terminated, truncated = task.step(a)
                done = np.flatnonzero(terminated | truncated)
                task.reset(done)
                future += [reward, terminated, task.observe()]
            drawn.append(task.tiles.drawn)
            futures.append(future)
        for a, b in zip(*futures, strict=True):
            assert np.array_equal(a, b)
        assert drawn[:2] == drawn[2:] and (drawn[1] > drawn[0]) == episodes
    finally:
        first.close()
        second.close()


def test_a_robot_that_blows_up_in_a_decision_is_seen_in_the_observation(task):
    """Only its own observation is not finite; the decision continues for the other robots."""
    task.reset(np.arange(5))
    task.locomotion.world.strength[1] = np.nan
    with np.errstate(invalid="ignore"):
        task.step(np.zeros((5, 13)))
        finite = np.isfinite(task.observe()).all(axis=1)
    assert finite.tolist() == [True, False, True, True, True]


def test_bounds_outside_the_low_levels_training_are_refused():
    low = LOW_CONFIG
    wide = HighLevelConfig(commands=dataclasses.replace(CONFIG.commands, vx=(-1.0, 1.5)))
    with pytest.raises(ConfigError, match=r"commands.vx asks for \[-1.0, 1.5\].*\[-1.0, 1.2\]"):
        paired(wide, low)
    narrow = HighLevelConfig(commands=dataclasses.replace(CONFIG.commands, vx=(-0.5, 0.5)))
    paired(narrow, low)


def test_nan_action_is_refused(task):
    with pytest.raises(ValueError, match=r"finite"):
        task.step(np.full((5, 13), np.nan))


def test_a_robot_that_blew_up_gets_no_guidance():
    """The worker ends its episode, and those of the others; the teacher cannot command it."""
    config = dataclasses.replace(CONFIG, families=("clutter", "gap"))
    task = NavigationTask(config, LOW_POLICY, 2, seed=0, taught=Skill(Landing()))
    task.reset(np.arange(2))
    assert task.observe()[:, -GUIDANCE:].any()
    task.locomotion.world.state.position[0] = np.nan
    seen = task.observe()
    assert np.isnan(seen[0]).any() and not seen[:, -GUIDANCE:].any()
    task.close()


@pytest.mark.parametrize(
    ("cues", "untold"), [("both", False), ("semantic", False), ("geometric", True), ("none", True)]
)
def test_without_the_semantic_cue_no_robot_is_told(cues, untold):
    config = dataclasses.replace(CONFIG, families=("gap",), cues=cues, unknown_share=0.0)
    task = NavigationTask(config, LOW_POLICY, 2, seed=0, taught=Skill(Landing()))
    task.reset(np.arange(2))
    family = "unknown" if untold else "gap"
    assert (task.family_index == SEMANTIC.index(family)).all()
    # Whatever the student sees, the teacher walks until a trench is in sight.
    assert (gait_index(task.teacher.commands(task.locomotion, task.goal)) == 0).all()
    task.close()


def test_families_are_dealt_to_the_robots_of_the_run():
    """Whichever worker they are in: a worker of 3 robots after 14 others; and by an env's seed."""
    config = dataclasses.replace(CONFIG, families=("rough", "stair", "gap", "tilt"), first_levels=3)
    task = NavigationTask(config, LOW_POLICY, 3, seed=0, first=14)
    assert task.tiles.families == ("gap", "tilt", "rough")
    assert task.curriculum.levels.tolist() == [0, 0, 1]  # the 14th robot is the fourth in Gap
    task.close()
    env = gym.make("tdgc/Navigation-v0", config=config)
    env.reset(seed=6)
    assert env.unwrapped.task.tiles.families == ("gap",)
    env.close()


@pytest.mark.parametrize("name", ["tdgc/Navigation-v0", "tdgc/LowLevel-v0"])
def test_environments_refuse_what_is_kept_for_evaluation(name):
    config = HighLevelConfig() if "Navigation" in name else LowLevelConfig(terrain="tiles")
    for change, message in (
        ({"levels": 13}, "'env.levels' must be from 1 to 11, not 13"),
        ({"families": ("mixed",)}, "must not name 'mixed'"),
        ({"families": ()}, "must name at least one terrain family"),
    ):
        with pytest.raises(ValueError, match=message):
            gym.make(name, config=dataclasses.replace(config, **change))


def test_a_large_seed_is_as_good_as_a_small_one():
    env = gym.make("tdgc/Navigation-v0")
    first, _ = env.reset(seed=2**70)
    again, _ = env.reset(seed=2**70)
    other, _ = env.reset(seed=2**70 + 1)
    env.close()
    assert (first == again).all() and (first != other).any()


def test_gymnasium_and_sb3_accept_it():
    env = gym.make("tdgc/Navigation-v0")
    try:
        check_env(env.unwrapped, skip_render_check=True)
        sb3_check_env(env.unwrapped)
    finally:
        env.close()


def test_a_given_low_policy_is_rendered(tmp_path):
    """Its robot stands on the tile, which is not all that can be seen."""
    half = dataclasses.replace(LOW_CONFIG.robot, action_limit=0.5)
    meta = {"config": to_dict(dataclasses.replace(LOW_CONFIG, robot=half))}
    policies.save_copy(tmp_path / "low", LOW_POLICY, meta)
    low = str(tmp_path / "low")
    env = gym.make("tdgc/Navigation-v0", low=low, render_mode="rgb_array")
    try:
        env.reset(seed=0)
        assert env.unwrapped.task.locomotion.robot.action_limit == 0.5
        picture = env.render()
        assert picture.shape == (400, 640, 3) and picture.std() > 10.0
    finally:
        env.close()


def test_an_episode_begins_with_the_default_command() -> None:
    """As in the evaluation: the first observation shows nothing of the episode before."""
    task = NavigationTask(HighLevelConfig(families=("gap",)), LOW_POLICY, 2, seed=0)
    try:
        task.reset(np.arange(2))
        assert (task.locomotion.command == default_command()).all()
        task.locomotion.command[:] = 0.5
        task.reset(np.array([1]))
        assert (task.locomotion.command[1] == default_command()).all()
        assert (task.locomotion.command[0] == 0.5).all()
    finally:
        task.close()


# ------------------------------------------------------------------ what a decision is rewarded for


@pytest.fixture
def steps(monkeypatch):
    """The steps that the tasks of a test had rewarded, and the terms of each."""
    kept, terms = [], high_rewards.high_terms

    def keep(step, seconds):
        kept.append((step, terms(step, seconds)))
        return kept[-1][1]

    monkeypatch.setattr(high_rewards, "high_terms", keep)
    return kept


def test_the_reward_of_a_decision_is_the_sum_of_its_terms(steps):
    task = NavigationTask(CONFIG, LOW_POLICY, 2, seed=3, training=False)
    task.reset(np.arange(2))
    for k in (1, 2):
        reward, *_ = task.step(np.zeros((2, 13)))
        step, terms = steps[-1]
        assert len(terms) > 5
        np.testing.assert_allclose(reward, sum(terms.values()))
        np.testing.assert_allclose(step.time_share, k / task.horizon)
    task.close()


def test_contact_forces_are_the_largest_within_a_decision(steps):
    task = NavigationTask(CONFIG, LOW_POLICY, 1, seed=3, training=False)
    task.reset(np.arange(1))
    executed, forces = task._executor.step, iter([0.0, 30.0, 10.0, 0.0, 5.0])

    def execute(commands):
        executed(commands)
        task.locomotion.world.state.trunk_force[0] = next(forces)

    task._executor.step = execute
    task.step(np.zeros((1, 13)))
    assert steps[0][0].contact_forces[0, 0] == 30.0
    task.close()


def test_base_height_is_above_the_support(steps):
    hardest = CONFIG.levels - 1
    config = dataclasses.replace(CONFIG, families=("stair",), first_level=hardest, first_levels=1)
    task = NavigationTask(config, LOW_POLICY, 1, seed=3, training=False)
    task.reset(np.arange(1))
    loco, middle = task.locomotion, np.array([[4.0, 4.0]])
    loco.place(np.array([0]), task._origin + middle, np.zeros(1), np.zeros(1))
    task.step(np.zeros((1, 13)))
    position = loco.world.state.position
    assert position[0, 2] > 0.4  # on the stairs
    support = loco.world.support_height(position[:, 0], position[:, 1])
    np.testing.assert_allclose(steps[0][0].base_height, position[:, 2] - support)
    task.close()


# ------------------------------------------------------------------ how episodes end and begin


def test_a_new_episode_has_not_reached_its_goal():
    task = NavigationTask(CONFIG, LOW_POLICY, 2, seed=3, training=False)
    task.reset(np.arange(2))
    task.goal[0] = task.locomotion.world.state.position[0, :2]
    task.step(np.zeros((2, 13)))
    assert task.reached.tolist() == [True, False]
    task.reset(np.array([0]))
    assert not task.reached.any()
    task.close()


def test_a_robot_that_falls_neither_reaches_its_goal_nor_runs_out_of_time(monkeypatch):
    """Robot 0 falls in the control step after it has reached the goal, robot 1 at the horizon."""
    task = NavigationTask(CONFIG, LOW_POLICY, 2, seed=3, training=False)
    task.reset(np.arange(2))
    task.elapsed[1] = task.horizon - 1
    outcomes = iter([np.array([FELL, FELL])] + [np.array([REACHED, FELL])] * 4)
    monkeypatch.setattr(high_env, "outcome", lambda *_: next(outcomes))
    _, failed, truncated = task.step(np.zeros((2, 13)))
    assert failed.all() and not truncated.any() and not task.reached.any()
    task.close()


def test_disturbances_widen_with_the_level():
    """Twenty robots on the easiest level are nominal and not pushed, twenty on the hardest vary."""
    task = NavigationTask(CONFIG, LOW_POLICY, 40, seed=3)
    task.curriculum.levels[:] = np.repeat([0, CONFIG.levels - 1], 20)
    task.reset(np.arange(40))
    loco, world, speeds = task.locomotion, task.locomotion.world, np.zeros(40)
    for values in (world.friction, world.payload, loco.delay, world.strength[:, 0]):
        assert np.ptp(values[:20]) == 0.0 and np.ptp(values[20:]) > 0.0

    def push(index, velocity):
        speeds[index] = np.abs(velocity).max(axis=1)

    world.push = push
    task._next_push[:] = 0
    task.step(np.zeros((40, 13)))
    assert (speeds[:20] == 0.0).all() and (speeds[20:] > 0.0).all()
    task.close()


def test_success_is_of_the_episodes_that_the_policy_drove():
    """Robots 0, 2 and 4 are on Tilt, the others on Stair."""
    config = dataclasses.replace(CONFIG, families=("tilt", "stair"))
    task = NavigationTask(config, LOW_POLICY, 6, seed=3, training=False)
    task.reset(np.arange(6))
    task.curriculum.levels[:] = [0, 5, 2, 6, 4, 7]
    task.elapsed[:] = task.horizon - 1
    task.goal[:4] = task.locomotion.world.state.position[:4, :2]
    task._led[2] = True  # reaches its goal, but the teacher drove it
    task.step(np.zeros((6, 13)))
    values = summarise_high(task.take_stats())
    task.close()
    for name, value in (
        ("success/tilt", 1 / 2), ("success/stair", 2 / 3), ("level/tilt", 2.0),
        ("level/stair", 6.0), ("gait/tilt_pace", 1.0), ("gait/stair_pace", 1.0),
    ):  # fmt: skip
        assert values[name] == pytest.approx(value), name  # pace is the gait of an action 0


def test_nothing_is_logged_of_a_family_without_robots():
    config = dataclasses.replace(CONFIG, families=("tilt", "stair"))
    task = NavigationTask(config, LOW_POLICY, 1, seed=3, training=False)
    task.reset(np.arange(1))
    task.step(np.zeros((1, 13)))
    values = summarise_high(task.take_stats())
    task.close()
    assert "level/tilt" in values and not [name for name in values if "stair" in name]


def test_info_says_whether_the_goal_is_reached():
    with closing(gym.make("tdgc/Navigation-v0").unwrapped) as env:
        env.reset(seed=0)
        assert env.step(np.zeros(13, np.float32))[4] == {"is_success": False}
        env.task.goal[:] = env.task.world.state.position[:, :2]
        assert env.step(np.zeros(13, np.float32))[4] == {"is_success": True}
