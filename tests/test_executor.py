"""The executor: commands in, joint targets and physics out; noise only where it is asked for."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from tdgc.config import RandomisationConfig
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.commands import INDEX, default_command
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.sensors import EpisodeDraws, Noise
from tdgc.tasks.executor import Executor
from tdgc.tasks.pairing import PRETRAINED, load_low

LOW, CONFIG = load_low(PRETRAINED / "low")


@pytest.fixture
def robots() -> Iterator[list[Locomotion]]:
    """Three worlds of three robots each, which all stand in the same pose."""
    made = [Locomotion(BulletWorld(3, CONFIG.robot, CONFIG.physics), CONFIG) for _ in range(3)]
    for loco in made:
        xy = np.array([[0.0, 0.0], [0.0, 3.0], [0.0, 6.0]])
        loco.place(np.arange(3), xy, np.zeros(3), np.zeros(3))
    yield made
    for loco in made:
        loco.world.close()


def walk() -> np.ndarray:
    command = np.tile(default_command(), (3, 1))
    command[:, INDEX["vx"]] = 0.5
    return command


def test_a_step_is_observation_policy_and_action(robots: list[Locomotion]) -> None:
    mine, theirs, _ = robots
    executor = Executor(mine, LOW)
    for _ in range(10):
        executor.step(walk())
        theirs.command[:] = walk()
        theirs.act(LOW.predict(theirs.observe())[0])
    assert np.array_equal(mine.world.state.q, theirs.world.state.q)
    assert (mine.command[:, INDEX["vx"]] == 0.5).all()


def test_noise_is_drawn_where_it_is_given(robots: list[Locomotion]) -> None:
    """Noise is drawn only if given, and depends on a robot's own draws, not on its neighbours."""
    exact, noisy, again = robots
    noise = RandomisationConfig()
    seeds = [(7, k) for k in range(3)]
    first = Executor(noisy, LOW, Noise(noise, EpisodeDraws(seeds)))
    swapped = Executor(again, LOW, Noise(noise, EpisodeDraws([seeds[0], seeds[2], seeds[1]])))
    plain = Executor(exact, LOW)
    for executor in (plain, first, swapped):
        executor.step(walk())
    off = np.abs(noisy.actions[0] - exact.actions[0])
    assert off.max(axis=1).min() > 0.01
    assert np.array_equal(exact.actions[0, 0], exact.actions[0, 1])
    assert np.array_equal(noisy.actions[0, [0, 2, 1]], again.actions[0])
    assert not np.array_equal(noisy.actions[0, 1], noisy.actions[0, 2])


def test_robots_that_do_not_decide_keep_their_action(robots: list[Locomotion]) -> None:
    loco = robots[0]
    executor = Executor(loco, LOW)
    for _ in range(3):
        executor.step(walk())
    before = loco.actions[0].copy()
    executor.step(walk(), np.array([0, 2]))
    kept = (loco.actions[0] == before).all(axis=1)
    assert kept.tolist() == [False, True, False]


def test_a_robot_that_blew_up_has_no_action(robots: list[Locomotion]) -> None:
    loco = robots[0]
    loco.world.state.q[1] = np.nan
    Executor(loco, LOW).step(walk())
    assert (loco.actions[0, 1] == 0.0).all() and (loco.actions[0, 0] != 0.0).any()
