"""The rules of an episode: the paper's three constants, and how it can end."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from tdgc.config import LowLevelConfig, PhysicsConfig, RobotConfig
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.terrain import make_tile
from tdgc.sim.tile import TileField
from tdgc.tasks import rules
from tdgc.tasks.rules import OUTCOMES, has_failed, is_fallen, outcome


@pytest.fixture
def loco() -> Iterator[Locomotion]:
    """Five robots in the middle of level tiles."""
    field = TileField(5)
    for k in range(5):
        field.place(k, make_tile("tilt", 0.0, np.random.default_rng(k)))
    loco = Locomotion(BulletWorld(5, RobotConfig(), PhysicsConfig(), field), LowLevelConfig())
    xy = field.origin(np.arange(5)) + [4.0, 4.0]
    loco.place(np.arange(5), xy, np.zeros(5), np.zeros(5))
    yield loco
    loco.world.close()


def names(ended: np.ndarray) -> list[str]:
    return ["going" if i < 0 else OUTCOMES[i] for i in ended]


def test_constants_are_the_papers() -> None:
    assert (rules.FALL_HEIGHT, rules.TRUNK_FORCE, rules.GOAL_RADIUS) == (0.15, 40.0, 0.5)
    assert rules.HORIZON == 20.0


def test_outcomes_are_told_apart(loco: Locomotion) -> None:
    state = loco.world.state
    goal = state.position[:, :2] + [3.0, 0.0]
    goal[0] = state.position[0, :2] + [0.49, 0.0]
    goal[4] = state.position[4, :2] + [0.51, 0.0]
    state.position[1, 1] -= 4.01
    state.trunk_force[2] = 40.1
    state.trunk_force[4] = 39.9
    state.position[3, 2] = 0.149
    state.position[4, 2] = 0.151
    ended = outcome(loco.world, goal)
    assert names(ended) == ["reached", "left_tile", "collided", "fell", "going"]
    assert has_failed(ended).tolist() == [False, True, True, True, False]
    assert is_fallen(loco.world).tolist() == [False, False, True, True, False]
    late = outcome(loco.world, goal, time_is_up=True)
    assert names(late) == ["reached", "left_tile", "collided", "fell", "timeout"]
    assert not has_failed(late)[4]
    assert names(outcome(loco.world))[0] == "going"  # without a goal nothing is reached


def test_a_robot_that_blew_up_has_fallen(loco: Locomotion) -> None:
    loco.world.state.position[1] = np.nan
    assert is_fallen(loco.world).tolist() == [False, True, False, False, False]


def test_who_falls_into_the_goal_has_fallen(loco: Locomotion) -> None:
    state = loco.world.state
    goal = state.position[:, :2].copy()
    state.position[0, 2] = 0.1
    state.trunk_force[1] = 50.0
    assert names(outcome(loco.world, goal))[:3] == ["fell", "collided", "reached"]


def test_a_plane_has_no_tile_to_leave() -> None:
    loco = Locomotion(BulletWorld(1, RobotConfig(), PhysicsConfig()), LowLevelConfig())
    loco.place(np.arange(1), np.array([[-50.0, 90.0]]), np.zeros(1), np.zeros(1))
    assert names(outcome(loco.world)) == ["going"]
    loco.world.close()
