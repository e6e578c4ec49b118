"""Leaps: planned landings over trenches, and the measured landing of a low policy."""

import dataclasses

import numpy as np
import pytest

from tdgc.config import CommandRanges, LowLevelConfig, RobotConfig
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.commands import INDEX
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array
from tdgc.sim.terrain import make_tile
from tdgc.tasks.leaps import (
    FREQUENCIES,
    LENGTHS,
    SPEED,
    STRIDE,
    Landing,
    LeapPlan,
    Motion,
    foothold_risk,
    lead,
    leap_command,
    measure_landing,
    speed_up,
    steer_leap,
)
from tdgc.tasks.pairing import PRETRAINED, load_low

LOW = PRETRAINED / "low"
RANGES = CommandRanges()
LANDING = Landing(-0.02, 0.08)
#: Cycles after which a gait has slowed down to the commanded frequency.
LATE = np.full(1, 9.0)


def land(
    trenches: Array, clock: float = 0.0, x: float = 0.75, choice: str = "steps"
) -> tuple[list[float], list[float]]:
    """Where the front and rear feet of a simulated point land, in m, when it leaps over trenches.

    It is commanded SPEED and moves at 0.95 of it, as low policies do. ``choice`` names the method
    of ``LeapPlan`` that decides, ten times a second.
    """
    speed = 0.95 * SPEED
    plan = LeapPlan(1, RANGES, RobotConfig())
    plan.look(0, trenches, LANDING.spread)
    one, front, rear, length = np.ones(1), [], [], STRIDE
    frequency = SPEED / STRIDE
    for step in range(290):
        if step % 5 == 0:
            row = np.zeros(1, dtype=int)
            motion = Motion(
                x * one, speed * one, SPEED * one, clock * one, LATE, frequency * one, length * one
            )
            f, wanted = getattr(plan, choice)(row, motion, LANDING)[:2]
            frequency, length = float(f[0]), float(wanted[0])
        x, clock = x + 0.02 * speed, clock + 0.02 * frequency
        if clock >= 1.0:
            clock -= 1.0
            trunk = x - speed * clock / frequency
            foothold = trunk + 0.5 * length + float(lead(speed * one, frequency * one)[0])
            front.append(foothold + LANDING.front)
            rear.append(front[-1] - length - LANDING.spread)
    return front, rear


@pytest.mark.parametrize("choice", ["steps", "lesson"])
@pytest.mark.parametrize("level", [4, 8, 10])
def test_planned_landings_miss_the_trenches(level: int, choice: str) -> None:
    """Over 97 % of feet land at least 1 cm from a trench, and over 99 % at most 1 cm inside one.

    1 cm is half a foot's radius. The feet are those of 20 tiles per level, each started at another
    phase of the gait.
    """
    feet = []
    for seed in range(20):
        trenches = make_tile("gap", level / 10, np.random.default_rng(seed)).features.trenches
        front, rear = land(trenches, clock=seed / 20, choice=choice)
        places = np.array([*front, *rear])[:, None]
        away = np.maximum(trenches[:, 0] - places, places - trenches[:, 1]).min(axis=1)
        feet += [away]
    away = np.concatenate(feet)
    assert np.mean(away < -0.01) < 0.01 and np.mean(away < 0.01) < 0.03 and len(away) > 500


def test_speeding_up() -> None:
    """From rest a robot reaches 95 % of 1.2 m/s, two thirds of it (1 - 1/e) in 0.3 s.

    A faster robot keeps its speed.
    """
    speed = np.array([0.0, 1.14, 1.3])
    way, then = speed_up(speed, 1.2, 0.3)
    np.testing.assert_allclose(then, [1.14 * (1 - np.exp(-1.0)), 1.14, 1.3])
    np.testing.assert_allclose(way[1:], 0.3 * speed[1:])
    _, nearly = speed_up(speed, 1.2, 3.0)
    np.testing.assert_allclose(nearly, [1.14, 1.14, 1.3], atol=1e-3)
    steps, v = 0.0, np.zeros(1)  # the distance is the sum of small steps
    for _ in range(300):
        _, after = speed_up(v, 1.2, 0.001)
        steps, v = steps + 0.001 * 0.5 * (v[0] + after[0]), after
    assert way[0] == pytest.approx(steps, abs=1e-5)


@pytest.mark.parametrize("start_cycles", [2.0, 0.5, 0.0])
def test_the_first_landings_are_planned_for_the_frequency_carried_out(start_cycles: float) -> None:
    """A gait that is commanded at 2.5 Hz starts at 3.5: the plan knows when the feet touch down, to
    5 ms, and the frequency then, to 2 %, as a robot's clock advances."""
    robot = RobotConfig(start_cycles=start_cycles)
    plan = LeapPlan(3, CommandRanges(frequency=(2.5, 4.0)), robot)
    world = BulletWorld(3, robot, LowLevelConfig().physics)
    loco = Locomotion(world, LowLevelConfig(robot=robot))
    world.close()
    leap_command(loco.command, 2.5, STRIDE, RANGES)
    loco.update_clock()
    loco.clock.reset(np.arange(3), np.array([0.0, 0.5, 0.9]))
    for landing in range(4):
        motion = Motion.of(loco, np.arange(3), np.zeros(3), np.ones(3), np.ones(3))
        planned, wanted = (found[:, 0] for found in plan._touchdown(motion))
        seconds = np.zeros(3)
        todo, before = np.ones(3, dtype=bool), loco.clock.clock
        while todo.any():
            frequency = np.where(todo, loco.executed()[:, INDEX["frequency"]], 0.0)
            loco.clock.advance(0.001, frequency, loco.command[:, 12:], np.full(3, 0.55))
            seconds += 0.001 * todo
            todo &= loco.clock.clock >= before
            before = loco.clock.clock
        np.testing.assert_allclose(seconds, planned, atol=5e-3, err_msg=str(landing))
        carried_out = loco.executed()[:, INDEX["frequency"]]
        np.testing.assert_allclose(carried_out, wanted, rtol=0.02)
        assert (carried_out > 2.51).all() == (landing == 0 and start_cycles == 2.0)


def test_a_robot_that_begins_to_leap_lands_sooner() -> None:
    """Its first stride is up to 9 cm shorter, so in front of a trench other strides are dear."""
    plan = LeapPlan(1, RANGES, RobotConfig())
    plan.look(0, np.array([[2.0, 2.3]]), LANDING.spread)
    row, one, different = np.zeros(1, dtype=int), np.ones(1), 0
    for x in np.arange(1.2, 1.9, 0.02):
        steady, begun = (
            plan.lesson(
                row,
                Motion(x * one, 0.9 * one, SPEED * one, 0.0 * one, c, 2.6 * one, STRIDE * one),
                LANDING,
            ).price
            for c in (LATE, 0.0 * one)
        )
        different += np.abs(steady - begun).max() > 1.0
    assert different > 15


def test_a_leap_begins_with_the_gait() -> None:
    """A robot that trots has leapt for no cycle, whatever its clock."""
    world = BulletWorld(2, RobotConfig(), LowLevelConfig().physics)
    loco = Locomotion(world, LowLevelConfig())
    world.close()
    leap_command(loco.command[1:], 3.0, STRIDE, RANGES)
    loco.update_clock()
    loco.clock.advance(0.1, np.full(2, 3.0), loco.command[:, 12:], np.full(2, 0.55))
    one = np.ones(2)
    np.testing.assert_allclose(Motion.of(loco, np.arange(2), one, one, one).cycles, [0.0, 0.3])


def test_without_trenches_strides_are_the_usual_ones() -> None:
    front, rear = land(np.empty((0, 2)))
    np.testing.assert_allclose(np.diff(front), STRIDE, atol=0.03)
    np.testing.assert_allclose(np.array(front[1:]) - STRIDE, front[:-1], atol=0.03)
    assert np.abs(np.array(rear[1:]) - front[:-1]).max() < 0.05  # where the front feet stood


def test_risk_of_a_foothold() -> None:
    trenches = np.array([[1.0, 1.3], [2.0, 2.2]])
    risk = foothold_risk(
        np.array([0.5, 0.9, 0.96, 1.0, 1.15, 1.34, 2.1, 3.0]), trenches, clear=0.08
    )
    np.testing.assert_allclose(risk, [0.0, 0.0, 0.25, 1.0, 4.0, 0.25, 4.0, 0.0], atol=1e-9)


def test_a_slow_robot_is_timed_for_the_speed_of_a_leap() -> None:
    """A slow robot's stride is timed for ``SPEED``: robots that leap at 2 Hz from rest fall."""
    plan = LeapPlan(1, RANGES, RobotConfig())
    one, row = np.ones(1), np.zeros(1, dtype=int)
    motion = Motion(one, 0.1 * one, SPEED * one, 0.0 * one, LATE, 3.0 * one, STRIDE * one)
    frequency, _ = plan.steps(row, motion, LANDING)
    assert frequency[0] == pytest.approx(SPEED / STRIDE, abs=0.09)


def test_what_is_imitated_depends_smoothly_on_the_speed() -> None:
    """The means of ``lesson`` vary less with speed than the best choices, whose length jumps.

    Between speeds 1 cm/s apart, the mean squared change is below 0.8 of the best choice's for the
    stance length, and below 1.1 of it for the frequency.
    """
    trenches = make_tile("gap", 0.8, np.random.default_rng(0)).features.trenches
    plan, speeds = LeapPlan(1, RANGES, RobotConfig()), np.arange(0.9, 1.3, 0.01)
    plan.look(0, trenches, LANDING.spread)
    rows, one = np.zeros(len(speeds), dtype=int), np.ones(len(speeds))
    changes = [
        [
            np.diff(
                choose(
                    rows,
                    Motion(
                        x * one, speeds, SPEED * one, 0.3 * one, LATE * one, 3.0 * one, STRIDE * one
                    ),
                    LANDING,
                )[:2]
            )
            ** 2
            for x in trenches[0, 0] - [0.3, 0.5, 0.7]
        ]
        for choose in (plan.steps, plan.lesson)
    ]
    best, smooth = (np.mean(each, axis=(0, 2)) for each in changes)  # of frequency and length
    assert smooth[1] < 0.8 * best[1] and smooth[0] < 1.1 * best[0]


def test_prices_of_strides() -> None:
    """The taught stride costs next to nothing; at a trench others cost over 1, a foot on the lip.

    The cheapest frequency depends on the stance length, so prices depend on both together.
    """
    trenches = make_tile("gap", 0.8, np.random.default_rng(0)).features.trenches
    plan = LeapPlan(1, RANGES, RobotConfig())
    plan.look(0, trenches, LANDING.spread)
    x = np.arange(0.8, trenches[-1, 0], 0.01)
    rows, one = np.zeros(len(x), dtype=int), np.ones(len(x))
    motion = Motion(x, SPEED * one, SPEED * one, 0.2 * one, LATE * one, 3.0 * one, STRIDE * one)
    taught = plan.lesson(rows, motion, LANDING)
    assert taught.price.shape == (len(x), FREQUENCIES, LENGTHS)
    np.testing.assert_array_equal(taught.price.min(axis=(1, 2)), 0.0)
    f_grid = np.linspace(*RANGES.frequency, FREQUENCIES)
    l_grid = np.linspace(*RANGES.stance_length, LENGTHS)
    own = [
        np.interp(f, f_grid, [np.interp(length, l_grid, row) for row in price])
        for f, length, price in zip(*taught, strict=True)
    ]
    assert np.percentile(own, 90) < 0.1
    assert np.mean(taught.price.max(axis=(1, 2)) > 1.0) > 0.5
    best = taught.price.argmin(axis=1)  # frequency of each length, (n, LENGTHS)
    assert np.mean(np.ptp(best, axis=1) >= 3) > 0.3


def test_price_of_a_stride_on_flat_ground() -> None:
    """Off by d m from the usual stride 10 d^2, off by d m in stance length 2 d^2, changed by d Hz
    0.5 d^2, and 4 where the stride is longer than 0.48 m."""
    plan, one = LeapPlan(1, RANGES, RobotConfig()), np.ones(1)
    plan.look(0, np.empty((0, 2)), 0.0)
    motion = Motion(one, SPEED * one, SPEED * one, 0.0 * one, LATE, 2.6 * one, STRIDE * one)
    price = plan.lesson(np.zeros(1, dtype=int), motion, Landing()).price[0]
    f = np.linspace(*RANGES.frequency, FREQUENCIES)[:, None]
    length = np.linspace(*RANGES.stance_length, LENGTHS)
    by_hand = 10.0 * (SPEED / f - STRIDE) ** 2 + 0.5 * (f - 2.6) ** 2 + 4.0 * (SPEED / f > 0.48)
    by_hand = by_hand + 2.0 * (length - STRIDE) ** 2
    np.testing.assert_allclose(price, by_hand - by_hand.min(), atol=1e-9)


def test_the_command_of_a_leap() -> None:
    command = np.tile(np.arange(15.0), (2, 1))
    leap_command(command, [2.2, 2.4], 0.36, CommandRanges())
    assert command[:, 4].tolist() == [2.2, 2.4] and command[:, 10].tolist() == [0.36] * 2
    assert command[:, 6].tolist() == [0.07] * 2
    assert command[:, 12:].tolist() == [[0.0, 0.0, 0.0]] * 2  # pronk
    assert command[0, :4].tolist() == [0.0, 1.0, 2.0, 3.0]
    narrow = dataclasses.replace(CommandRanges(), swing_height=(0.08, 0.24), duration=(0.4, 0.5))
    leap_command(command, 2.2, 0.36, narrow)
    assert command[0, 5:7].tolist() == [0.5, 0.08]


def test_landing_of_the_shipped_low_policy() -> None:
    found = measure_landing(*load_low(LOW), SPEED)
    assert found is not None
    assert -0.08 < found.front < 0.02 and -0.03 < found.spread < 0.12
    assert found != Landing()


class Flail:
    """A low policy that commands the same random joint targets at every step."""

    def correct(self, commands: np.ndarray) -> np.ndarray:
        return commands

    def predict(self, observation: np.ndarray) -> tuple[np.ndarray, None]:
        rng = np.random.default_rng(0)
        return rng.uniform(-4.0, 4.0, (len(observation), 12)), None


def test_a_robot_that_blew_up_teaches_no_landing() -> None:
    _, config = load_low(PRETRAINED / "low")
    world, landings = BulletWorld(2, config.robot, config.physics), []
    loco = Locomotion(world, config)
    for blown, rows in ((None, [1]), (np.nan, [0, 1]), (1e4, [0, 1])):
        loco.place(np.arange(2), np.zeros((2, 2)), np.zeros(2), np.full(2, 0.3))
        loco.command[:, INDEX["frequency"]] = 2.0
        loco.clock.cycles[:] = 1.0
        if blown is not None:
            loco.world.state.foot_position[0] = blown
        landing = Landing()
        landing.learn(loco, np.array(rows), np.full(len(rows), 0.1), rate=0.1)
        landings.append((landing.front, landing.spread))
        first = Landing()
        loco.clock.cycles[:] = 0.9  # it was placed with its clock there: no leap has ended
        first.learn(loco, np.array(rows), np.full(len(rows), 0.1), rate=0.1)
        assert first == Landing()
    loco.world.close()
    assert landings[1] == landings[2] == landings[0] != (0.0, 0.0)


def test_a_low_policy_that_falls_has_no_landing() -> None:
    _, config = load_low(LOW)
    assert measure_landing(Flail(), config, SPEED) is None  # type: ignore[arg-type]


@pytest.mark.parametrize("choice", ["steps", "lesson"])
def test_who_pushes_off_has_decided(choice: str) -> None:
    """From 0.4 of the cycle on, the stride is kept and all prices are zero.

    Before that, some robots in front of a trench change their stride.
    """
    trenches = make_tile("gap", 0.8, np.random.default_rng(0)).features.trenches
    plan = LeapPlan(1, RANGES, RobotConfig())
    plan.look(0, trenches, LANDING.spread)
    x = np.arange(0.8, trenches[-1, 0], 0.05)
    rows, one = np.zeros(len(x), dtype=int), np.ones(len(x))
    for clock, same in ((0.39, False), (0.4, True), (0.9, True)):
        motion = Motion(x, SPEED * one, SPEED * one, clock * one, LATE * one, 2.9 * one, 0.36 * one)
        chosen = getattr(plan, choice)(rows, motion, LANDING)
        assert (np.allclose(chosen[0], 2.9) and np.allclose(chosen[1], 0.36)) == same
        if choice == "lesson":
            assert (chosen.price.max() == 0.0) == same


def test_leaps_lead_to_the_goal_whatever_the_heading() -> None:
    """Velocities are commanded in the heading frame."""
    bearing, heading = np.array([0.3, -0.1, 0.1]), np.array([0.4, 0.3, -0.3])
    command = np.zeros((3, 15))
    steer_leap(command, bearing, heading, CommandRanges(), SPEED)
    velocity = command[:, [INDEX["vx"], INDEX["vy"]]]
    np.testing.assert_allclose(np.hypot(*velocity.T), SPEED)
    np.testing.assert_allclose(np.arctan2(*velocity.T[::-1]) + heading, bearing, atol=1e-12)
    assert (np.sign(command[:, INDEX["yaw_rate"]]) == -np.sign(heading)).all()
