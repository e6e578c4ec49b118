"""Leaps: where feet land on the way over trenches, and what is measured of a low policy."""

import numpy as np
import pytest

from tdgc.config import CommandRanges
from tdgc.sim.robot import Array
from tdgc.sim.terrain import make_tile
from tdgc.tasks.high_env import PRETRAINED, load_low
from tdgc.tasks.leaps import (
    STRIDE,
    Landing,
    LeapPlan,
    foothold_risk,
    leap_command,
    measure_landing,
)

LOW = PRETRAINED / "low"
RANGES = CommandRanges()
LANDING = Landing(0.22, 0.01)


def land(trenches: Array, clock: float = 0.0, x: float = 0.75) -> tuple[list[float], list[float]]:
    """Places of front and rear feet of a point that leaps at 1 m/s, decided ten times a second."""
    plan = LeapPlan(1, RANGES)
    plan.look(0, trenches, LANDING.spread)
    one, front, rear, length = np.ones(1), [], [], STRIDE
    frequency = 2.5
    for step in range(330):
        if step % 5 == 0:
            row = np.zeros(1, dtype=int)
            f, wanted = plan.steps(row, x * one, one, clock * one, LANDING)
            frequency, length = float(f[0]), float(wanted[0])
        x, clock = x + 0.02, clock + 0.02 * frequency
        if clock >= 1.0:
            clock -= 1.0
            front.append(x - clock / frequency + LANDING.front)
            rear.append(front[-1] - length - LANDING.spread)
    return front, rear


@pytest.mark.parametrize("level", [4, 8, 10])
def test_planned_landings_miss_the_trenches(level: int) -> None:
    """Of 20 tiles a level, from any phase of the gait: all feet at least 1 cm from each lip, but
    for one landing in a hundred."""
    feet = []
    for seed in range(20):
        trenches = make_tile("gap", level / 10, np.random.default_rng(seed)).features.trenches
        front, rear = land(trenches, clock=seed / 20)
        places = np.array([*front, *rear])[:, None]
        away = np.maximum(trenches[:, 0] - places, places - trenches[:, 1]).min(axis=1)
        feet += [away]
    away = np.concatenate(feet)
    assert np.mean(away < 0.01) < 0.01 and len(away) > 500


def test_without_trenches_strides_are_the_usual_ones() -> None:
    front, rear = land(np.empty((0, 2)))
    np.testing.assert_allclose(np.diff(front), STRIDE, atol=0.03)
    np.testing.assert_allclose(np.array(front[1:]) - STRIDE, front[:-1], atol=0.03)
    assert np.abs(np.array(rear[1:]) - front[:-1]).max() < 0.05  # where the front feet stood


def test_risk_of_a_foothold() -> None:
    trenches = np.array([[1.0, 1.3], [2.0, 2.2]])
    risk = foothold_risk(np.array([0.5, 0.9, 0.96, 1.0, 1.15, 1.34, 2.1, 3.0]), trenches)
    np.testing.assert_allclose(risk, [0.0, 0.0, 0.25, 1.0, 4.0, 0.25, 4.0, 0.0], atol=1e-9)


def test_a_slow_robot_is_timed_for_the_speed_of_a_leap() -> None:
    """At 2 Hz from rest robots are thrown down."""
    plan = LeapPlan(1, RANGES)
    one, row = np.ones(1), np.zeros(1, dtype=int)
    frequency, _ = plan.steps(row, one, 0.1 * one, 0.0 * one, LANDING)
    assert frequency[0] == pytest.approx(1.0 / STRIDE, abs=0.05)


def test_the_command_of_a_leap() -> None:
    command = np.tile(np.arange(15.0), (2, 1))
    leap_command(command, [2.2, 2.4], 0.36)
    assert command[:, 4].tolist() == [2.2, 2.4] and command[:, 10].tolist() == [0.36] * 2
    assert command[:, 6].tolist() == [0.07] * 2
    assert command[:, 12:].tolist() == [[0.0, 0.0, 0.0]] * 2  # pronk
    assert command[0, :4].tolist() == [0.0, 1.0, 2.0, 3.0]


def test_landing_of_the_shipped_low_policy() -> None:
    found = measure_landing(*load_low(LOW))
    assert 0.15 < found.front < 0.30 and -0.03 < found.spread < 0.12
    assert found != Landing()


class Limp:
    """A low policy that does nothing."""

    def predict(self, observation: np.ndarray) -> tuple[np.ndarray, None]:
        return np.zeros((len(observation), 12)), None


def test_a_low_policy_that_does_not_move_has_some_landing() -> None:
    _, config = load_low(LOW)
    found = measure_landing(Limp(), config)  # type: ignore[arg-type]
    assert np.isfinite([found.front, found.spread]).all()
