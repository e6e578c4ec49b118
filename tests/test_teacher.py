"""The scripted teacher: what it sees of a tile, and what it commands there."""

from __future__ import annotations

import numpy as np
import pytest

from tdgc.config import PhysicsConfig, RobotConfig
from tdgc.sim.commands import INDEX, CommandDecoder, gait_index
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.terrain import TileField, make_tile, trench_centres
from tdgc.tasks.leaps import STANCE_LENGTH, STRIDE, straddling_frequency
from tdgc.tasks.teacher import STYLES, Teacher, travel_cost, trenches


@pytest.mark.parametrize(
    ("level", "first"),
    [(0, 2.1), (3, 2.125), (6, 2.1), (8, 2.125), (10, 2.1)],
)
def test_trenches_are_found_where_they_were_made(level: int, first: float) -> None:
    """An odd number of lowered samples sits half a cell towards the start."""
    expected = first + 1.25 * np.arange(4)
    np.testing.assert_allclose(trench_centres(level / 10), expected)
    heights = make_tile("gap", level / 10, np.random.default_rng(0)).heights
    np.testing.assert_allclose(trenches(heights), expected)


def test_no_trenches_on_steps() -> None:
    assert trenches(make_tile("stair", 1.0, np.random.default_rng(0)).heights).size == 0


def test_travel_cost_in_the_open_is_the_way_of_a_king() -> None:
    goal = np.array([7.0, 4.0])
    cost, step, left = travel_cost(np.zeros((161, 81)), 2.0, goal)
    assert cost.shape == (81, 41) and step == 0.1 and left == 2.0
    assert cost[70, 20] == 0.0
    assert cost[10, 20] == pytest.approx(6.0)
    assert cost[60, 10] == pytest.approx(np.sqrt(2.0))  # 1 m either way
    assert cost[50, 10] == pytest.approx(np.sqrt(2.0) + 1.0)


def test_travel_cost_leads_around_a_wall() -> None:
    heights = np.zeros((161, 81))
    heights[80:84, 20:] = 0.8  # all but a metre on the right, y from 2 to 3
    cost, _, _ = travel_cost(heights, 2.0, np.array([7.0, 5.0]))
    straight = 6.0
    assert straight + 1.0 < cost[10, 30] < straight + 5.0  # and not through it, at 30 a metre


class Course:
    """Robots that stand where a test wants them, on a tile each."""

    def __init__(self, families: list[str], level: int) -> None:
        rng = np.random.default_rng(0)
        self.field = TileField((len(families), 1))
        for k, family in enumerate(families):
            self.field.place(k, 0, make_tile(family, level / 10, rng))
        self.origin = self.field.origin(np.arange(len(families)), 0)
        self.loco = Locomotion(len(families), RobotConfig(), PhysicsConfig(), self.field)
        self.goal = self.origin + [7.25, 4.0]
        self.teacher = Teacher(self.field, families)

    def put(self, x: float, y: float = 4.0, yaw: float = 0.0) -> None:
        m = len(self.origin)
        self.loco.place(np.arange(m), self.origin + [x, y], np.full(m, yaw), np.zeros(m))

    def commands(self) -> np.ndarray:
        return self.teacher.commands(self.loco, self.goal)


@pytest.fixture
def course():
    courses: list[Course] = []

    def make(families: list[str], level: int = 8) -> Course:
        courses.append(Course(families, level))
        courses[-1].teacher.begin(np.arange(len(families)), courses[-1].goal)
        return courses[-1]

    yield make
    for made in courses:
        made.loco.world.close()


def test_each_family_is_walked_in_its_style(course) -> None:
    families = [family for family in STYLES if family != "pillar"]
    course = course(families)
    course.put(1.0)
    commands = course.commands()
    for row, family in zip(commands, families, strict=True):
        style = STYLES[family]
        assert row[INDEX["vx"]] == pytest.approx(style.speed)
        assert row[INDEX["yaw_rate"]] == pytest.approx(0.0, abs=1e-9)
        assert row[INDEX["swing_height"]] == style.swing_height
        assert row[INDEX["stance_width"]] == style.stance_width
        assert gait_index(row) == (1 if family == "gap" else 0)
    decoder = CommandDecoder()  # all of it can be said in actions
    np.testing.assert_allclose(decoder.decode(decoder.encode(commands)), commands)


def test_turns_to_the_goal_and_slows_before_it(course) -> None:
    course = course(["stair"])
    course.put(1.0, yaw=-0.4)
    command = course.commands()[0]
    assert command[INDEX["yaw_rate"]] == pytest.approx(0.6)
    assert command[INDEX["vx"]] == pytest.approx(0.6 * np.cos(0.4))
    course.put(7.05)
    assert course.commands()[0, INDEX["vx"]] == pytest.approx(0.2)


def test_leaps_are_timed_before_trenches_and_end_behind_them(course) -> None:
    course = course(["gap"])
    course.put(1.7)
    course.loco.world.state.heading_vel[:, 0] = 1.1
    command = course.commands()
    one = np.ones(1)
    expected = straddling_frequency(
        1.7 * one, 1.1 * one, 0 * one, STRIDE * one, STANCE_LENGTH * one, trench_centres(0.8)[None]
    )
    assert 2.0 < expected[0] < 4.0
    assert command[0, INDEX["frequency"]] == pytest.approx(expected[0])
    course.put(6.45)  # the last trench is at 5.875
    command = course.commands()
    assert gait_index(command[0]) == 0 and command[0, INDEX["frequency"]] == 3.0


def test_goes_around_a_pillar(course) -> None:
    course = course(["pillar"])
    heights = course.field.heights
    heights[:] = 0.0
    heights[58:64, 78:90] = 0.8  # x 2.9-3.2, y 3.9-4.5: more of it on the left
    course.teacher.begin(np.arange(1), course.goal)
    course.put(2.3)
    assert course.commands()[0, INDEX["yaw_rate"]] < -0.5
    course.put(4.0)  # behind it
    assert abs(course.commands()[0, INDEX["yaw_rate"]]) < 0.2


def test_a_family_without_a_style_is_refused() -> None:
    with pytest.raises(
        ValueError,
        match=r"does not know mixed, only rough, .*; imitation\.steps=0 does without it$",
    ):
        Teacher(TileField((1, 1)), ["mixed"])
