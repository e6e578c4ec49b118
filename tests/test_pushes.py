"""Random pushes: when they come and how fast they are."""

from typing import Any

import numpy as np
import pytest

from tdgc.config import RandomisationConfig
from tdgc.sim.robot import Array
from tdgc.tasks.pushes import Pushes

CONFIG = RandomisationConfig(push_speed=0.6, push_interval=(0.45, 0.45))


class Pushed:
    """A stub of the world that adds up the velocities of each trunk's pushes, (M, 3) m/s."""

    def __init__(self, num_robots: int) -> None:
        self.velocity = np.zeros((num_robots, 3))

    def push(self, index: Array, velocity: Array) -> None:
        self.velocity[index] += velocity


@pytest.mark.parametrize(("kind", "first"), [(np.int64, 4), (np.float64, 5)])
def test_pushes_come_after_their_interval(kind: Any, first: int) -> None:
    """An interval of 4.5 steps ends at step 4 if due steps are integers, at step 5 if floats.

    It is 0.45 s at 0.1 s per step.
    """
    pushes = Pushes(CONFIG, np.random.default_rng(0), 0.1, np.zeros(3, dtype=kind))
    elapsed, world, robots = np.array([0, 0, 10]), Pushed(3), np.arange(3)
    pushes.schedule(robots, elapsed)
    moved = []
    for _ in range(11):
        elapsed += 1
        before: Any = world.velocity.copy()
        pushes.push(world, elapsed, np.ones(3))  # type: ignore[arg-type]
        moved.append((world.velocity != before).any(axis=1).tolist())
    # A new interval begins with each push.
    assert np.flatnonzero([any(step) for step in moved]).tolist() == [first - 1, 2 * first - 1]
    assert moved[first - 1] == [True] * 3


def test_speeds_are_horizontal_and_scaled_by_the_width() -> None:
    pushes = Pushes(CONFIG, np.random.default_rng(0), 0.1, np.zeros(900))
    world, width = Pushed(900), np.repeat([0.0, 0.5, 1.0], 300)
    pushes.push(world, np.ones(900, dtype=int), width)  # type: ignore[arg-type]
    speed = np.linalg.norm(world.velocity, axis=1).reshape(3, 300)
    assert (world.velocity[:, 2] == 0.0).all() and (speed[0] == 0.0).all()
    assert 0.28 < speed[1].max() <= 0.3 and 0.57 < speed[2].max() <= 0.6
    angle = np.arctan2(world.velocity[300:, 1], world.velocity[300:, 0])
    assert (np.histogram(angle, 8, (-np.pi, np.pi))[0] > 40).all()  # 75 less 4 deviations
