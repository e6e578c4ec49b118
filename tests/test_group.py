"""``TaskGroup``: each task behaves as it does alone."""

import dataclasses

import numpy as np
import pytest

import train_low
from tdgc.config import ConfigError, LowLevelConfig, LowTrainConfig, PhysicsConfig
from tdgc.learn.flags import Machine
from tdgc.parallel.group import TaskGroup
from tdgc.parallel.worker import ProcessLink
from tdgc.tasks.low_env import LowLevelTask, make_task
from tdgc.tasks.statistics import summarise_low

PLANE = LowLevelConfig(physics=PhysicsConfig(substeps=4), episode_seconds=0.4)
MACHINE = Machine("cpu", 1.0, ProcessLink)
TILES = dataclasses.replace(PLANE, terrain="tiles", families=("stair", "rough"))


def make() -> tuple[LowLevelTask, LowLevelTask]:
    """Two robots on the plane and three on tiles."""
    return LowLevelTask(PLANE, 2, seed=0), LowLevelTask(TILES, 3, seed=1)


def advance(task: LowLevelTask | TaskGroup, steps: int, seed: int) -> list[np.ndarray]:
    """Step with random actions as a worker does; return rewards, flags and observations."""
    everything = np.random.default_rng(seed).normal(size=(steps, 5, 12))
    seen = []
    for actions in everything:
        reward, terminated, truncated = task.step(actions[: task.num_robots])
        done = np.flatnonzero(terminated | truncated)
        if done.size:
            task.reset(done)
        seen += [reward[:, None], terminated[:, None], truncated[:, None], task.observe()]
    return seen


def test_each_does_what_it_does_alone() -> None:
    """This holds through the ends of episodes, which last 20 steps; statistics are summed."""
    plane, tiles = make()
    group = TaskGroup(make())
    assert group.num_robots == 5
    plane.restart()
    tiles.restart()
    group.restart()
    np.testing.assert_array_equal(group.observe(), [*plane.observe(), *tiles.observe()])
    actions = np.random.default_rng(1).normal(size=(30, 5, 12))
    ends = 0
    for step in actions:
        alone = plane.step(step[:2]), tiles.step(step[2:])
        together = group.step(step)
        for one, other, both in zip(*alone, together, strict=True):
            np.testing.assert_array_equal(both, [*one, *other])
        done = np.flatnonzero(together[1] | together[2])
        ends += done.size
        if done.size:
            group.reset(done)
            for task, mine in ((plane, done[done < 2]), (tiles, done[done >= 2] - 2)):
                if mine.size:
                    task.reset(mine)
        np.testing.assert_array_equal(group.observe(), [*plane.observe(), *tiles.observe()])
    assert ends >= 5
    sums, one, other = group.take_stats(), plane.take_stats(), tiles.take_stats()
    assert sums["steps"] == 150 and sums["robots"] == 5
    assert sums["term/track_lin_vel"] == one["term/track_lin_vel"] + other["term/track_lin_vel"]
    assert summarise_low(sums)["level/stair"] == summarise_low(other)["level/stair"]
    for task in (plane, tiles, group):
        task.close()


def test_command_share_is_the_mean_over_robots() -> None:
    group = TaskGroup(make())
    group.tasks[0].commands.share[:], group.tasks[1].commands.share[:] = 0.5, 1.0
    assert summarise_low(group.take_stats())["command_share/pace"] == pytest.approx(0.8)
    group.close()


def test_goes_on_from_its_state() -> None:
    group, other = TaskGroup(make()), TaskGroup(make())
    for task, steps in ((group, 10), (other, 5)):
        task.restart()
        advance(task, steps, seed=2)
    state = group.state_dict()
    group.forget()
    expected = advance(group, 25, seed=3)
    other.load_state_dict(state)
    for one, two in zip(expected, advance(other, 25, seed=3), strict=True):
        np.testing.assert_array_equal(one, two)
    without = {key: value for key, value in state.items() if key != "episodes"}
    other.load_state_dict(without)  # new episodes, on the levels of the state
    np.testing.assert_array_equal(other.tasks[1].level, state["tasks"][1]["level"])
    with pytest.raises(ValueError, match="a state of 2 tasks, not 1"):
        TaskGroup(group.tasks[:1]).load_state_dict(state)
    group.close()
    other.close()


def test_a_share_of_each_workers_robots_stays_on_the_plane() -> None:
    config = dataclasses.replace(LowTrainConfig(), plane_share=0.6)
    (phase,) = train_low.phases(config, MACHINE)
    pair = phase.build.args[1]  # type: ignore[attr-defined]
    assert [mdp.terrain for mdp in pair] == ["plane", "tiles"]
    task = make_task(pair, 0.6, 5, seed=0)
    assert isinstance(task, TaskGroup)
    assert [part.num_robots for part in task.tasks] == [3, 2]
    assert [part.field is None for part in task.tasks] == [True, False]
    draws = [part.rng.uniform() for part in task.tasks]
    task.close()
    assert draws[0] != draws[1]
    alone = make_task(pair, 0.0, 2, seed=0)
    assert isinstance(alone, LowLevelTask) and alone.field is not None
    alone.close()


def test_all_robots_on_the_plane_is_refused() -> None:
    config = dataclasses.replace(LowTrainConfig(), plane_share=1.0)
    with pytest.raises(ConfigError, match="'plane_share' must be from 0 to below 1, not 1"):
        train_low.check(config)
