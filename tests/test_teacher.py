"""The scripted teacher: what it sees of a tile, and what it commands there."""

from __future__ import annotations

import numpy as np
import pytest

from tdgc.config import CommandRanges, PhysicsConfig, RobotConfig
from tdgc.sim.commands import INDEX, CommandDecoder, gait_index
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.terrain import Features, TileField, make_tile
from tdgc.tasks.leaps import SWING_HEIGHT, Landing
from tdgc.tasks.teacher import SIGHT, STYLES, UNEVEN, WAY, Teacher, travel_cost


def test_travel_cost_in_the_open_is_the_way_of_a_king() -> None:
    goal = np.array([7.0, 4.0])
    cost, step, left = travel_cost(np.empty((0, 3)), 81, 2.0, goal)
    assert cost.shape == (81, 41) and step == 0.1 and left == 2.0
    assert cost[70, 20] == 0.0
    assert cost[10, 20] == pytest.approx(6.0)
    assert cost[60, 10] == pytest.approx(np.sqrt(2.0))  # 1 m along each axis
    assert cost[50, 10] == pytest.approx(np.sqrt(2.0) + 1.0)


def test_travel_cost_leads_around_a_wall() -> None:
    # The wall leaves only a metre free, on the right.
    wall = np.array([[4.0, y, 0.2] for y in np.arange(3.1, 6.1, 0.1)])
    cost, _, _ = travel_cost(wall, 81, 2.0, np.array([7.0, 5.0]))
    straight = 6.0
    assert straight + 1.0 < cost[10, 30] < straight + 5.0  # not through it, at 30 per metre


class Course:
    """Robots that a test places on a tile each, with a teacher."""

    def __init__(self, families: list[str], level: int) -> None:
        rng = np.random.default_rng(0)
        self.field = TileField((len(families), 1))
        for k, family in enumerate(families):
            self.field.place(k, 0, make_tile(family, level / 10, rng))
        self.origin = self.field.origin(np.arange(len(families)), 0)
        self.loco = Locomotion(len(families), RobotConfig(), PhysicsConfig(), self.field)
        self.goal = self.origin + [7.25, 4.0]
        self.teacher = Teacher(self.field, families, CommandRanges(), Landing())

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
    families = [family for family in STYLES if family not in ("pillar", "clutter", "ditches")]
    course = course(families)
    course.put(1.0)
    commands = course.commands()
    for row, family in zip(commands, families, strict=True):
        style = STYLES[family]
        assert row[INDEX["vx"]] == pytest.approx(style.speed)
        assert row[INDEX["yaw_rate"]] == pytest.approx(0.0, abs=1e-9)
        swing = SWING_HEIGHT if family == "gap" else style.swing_height
        assert row[INDEX["swing_height"]] == swing
        assert row[INDEX["stance_width"]] == style.stance_width
        assert row[INDEX["body_height"]] == style.body_height
        assert gait_index(row) == (1 if family == "gap" else 0)
    decoder = CommandDecoder()  # all commands can be expressed as actions
    np.testing.assert_allclose(decoder.decode(decoder.encode(commands)), commands)


def test_goes_uphill_across_a_slope(course) -> None:
    course = course(["tilt", "rough"])
    slope = course.field.features[0, 0].slope
    climb = STYLES["tilt"].uphill * np.sin(slope)
    assert abs(climb) > 0.1
    for yaw in (0.0, 0.3):
        course.put(1.0, yaw=yaw)
        command = course.commands()[0]
        ahead = STYLES["tilt"].speed * np.cos(yaw)
        assert command[INDEX["vx"]] == pytest.approx(ahead + climb * np.sin(yaw))
        assert command[INDEX["vy"]] == pytest.approx(climb * np.cos(yaw))
    course.put(1.0)
    left, right = course.loco.world.ground_height(
        np.repeat(course.origin[:1, 0] + 4.0, 2), course.origin[0, 1] + np.array([5.0, 3.0])
    )
    assert np.sign(climb) == np.sign(left - right)
    assert course.commands()[1, INDEX["vy"]] == 0.0  # level ground


def test_turns_to_the_goal_and_slows_before_it(course) -> None:
    course = course(["stair"])
    course.put(1.0, yaw=-0.4)
    command = course.commands()[0]
    assert command[INDEX["yaw_rate"]] == pytest.approx(0.6)
    assert command[INDEX["vx"]] == pytest.approx(STYLES["stair"].speed * np.cos(0.4))
    course.put(7.05)
    assert course.commands()[0, INDEX["vx"]] == pytest.approx(0.2)


def test_leaps_face_across_the_trenches_and_end_behind_them(course) -> None:
    course = course(["gap"])
    course.goal[:, 1] += 0.8
    course.put(1.2, yaw=0.2)
    command = course.commands()[0]
    bearing = np.arctan2(0.8, 7.25 - 1.2)
    assert gait_index(command) == 1
    assert command[INDEX["vx"]] == pytest.approx(1.2 * np.cos(bearing - 0.2))
    assert command[INDEX["vy"]] == pytest.approx(1.2 * np.sin(bearing - 0.2))
    assert command[INDEX["yaw_rate"]] == pytest.approx(-0.3)
    course.put(course.field.features[0, 0].trenches[-1, 1] + 0.55)
    command = course.commands()
    assert gait_index(command[0]) == 0 and command[0, INDEX["frequency"]] == 3.0


def test_goes_around_a_pillar(course) -> None:
    course = course(["pillar"])
    # Its centre is left of the straight way, so the shorter way is on the right.
    course.field.features[0, 0] = Features(pillars=np.array([[3.05, 4.15, 0.4]]))
    course.teacher.begin(np.arange(1), course.goal)
    course.put(2.3)
    assert course.commands()[0, INDEX["yaw_rate"]] < -0.5
    course.put(4.0)  # behind it
    assert abs(course.commands()[0, INDEX["yaw_rate"]]) < 0.2


def test_knows_both_ways_around_what_stands_before_it(course) -> None:
    course = course(["pillar", "stair"])
    pillars = np.array([[3.05, 4.0, 0.4], [3.05, 4.7, 0.3], [3.05, 3.4, 0.3]])
    course.field.features[0, 0] = Features(pillars=pillars)  # a wall that ends sooner on the right
    course.teacher.begin(np.arange(2), course.goal)
    course.put(2.5)
    command, straight_on = course.commands()
    other, same = course.teacher.other
    assert command[INDEX["vy"]] < -0.3 and command[INDEX["yaw_rate"]] < -0.5
    assert other[INDEX["vy"]] > 0.3 and other[INDEX["yaw_rate"]] > 0.5
    np.testing.assert_array_equal(np.delete(other, WAY), np.delete(command, WAY))
    # Around the wall's ends, 0.28 m from its pillars: the left way is 0.2 m longer, and near
    # pillars a metre costs up to 3.
    assert 0.1 < course.teacher.dearer[0] < 0.6
    np.testing.assert_array_equal(same, straight_on)
    assert course.teacher.dearer[1] == 0.0
    for x in (1.0, 4.0):  # far away and behind the wall there is only one way
        course.put(x)
        command = course.commands()
        np.testing.assert_array_equal(course.teacher.other, command)
        np.testing.assert_array_equal(course.teacher.dearer, 0.0)


def test_a_family_without_a_style_is_walked_straight_on(course) -> None:
    course = course(["mixed"])
    course.put(1.0)
    command = course.commands()[0]
    assert command[INDEX["vx"]] == pytest.approx(UNEVEN.speed) and gait_index(command) == 0
    assert command[INDEX["swing_height"]] == UNEVEN.swing_height


def test_leaps_over_trenches_between_other_ground(course) -> None:
    """On Ditches the robot walks until it sees the trench, leaps, and then walks again."""
    course = course(["ditches", "gap"])
    trench = np.array([[4.0, 4.25]])
    course.field.features[0, 0] = Features(trenches=trench, pillars=np.array([[2.0, 4.6, 0.3]]))
    course.field.features[1, 0] = Features(trenches=trench)
    course.teacher.begin(np.arange(2), course.goal)
    for x, gait in ((4.0 - SIGHT - 0.05, 0), (4.0 - SIGHT + 0.05, 1), (4.7, 1), (4.8, 0)):
        course.put(x)
        command, on_gap = course.commands()
        assert gait_index(command) == gait
        if gait:
            np.testing.assert_array_equal(command, on_gap)
        else:
            assert command[INDEX["swing_height"]] == UNEVEN.swing_height
            assert command[INDEX["vx"]] == pytest.approx(UNEVEN.speed, abs=0.02)


def test_a_policy_that_does_not_leap_walks_over_trenches(course) -> None:
    course = course(["gap"])
    course.teacher = Teacher(course.field, ["gap"], CommandRanges(), None)
    course.teacher.begin(np.arange(1), course.goal)
    course.put(1.7)
    command = course.commands()[0]
    assert command[INDEX["vx"]] == pytest.approx(UNEVEN.speed) and gait_index(command) == 0


def test_who_is_not_told_of_trenches_leaps_when_it_sees_one(course) -> None:
    course = course(["gap", "gap"])
    course.field.features[1, 0] = course.field.features[0, 0]
    course.teacher.begin(np.arange(2), course.goal, np.array([False, True]))
    lip = course.field.features[0, 0].trenches[0, 0]
    course.put(lip - SIGHT - 0.05)
    leaps, walks = course.commands()
    assert gait_index(leaps) == 1 and gait_index(walks) == 0
    assert walks[INDEX["swing_height"]] == UNEVEN.swing_height
    assert walks[INDEX["vx"]] == pytest.approx(UNEVEN.speed, abs=1e-3)
    course.put(lip - SIGHT + 0.05)
    leaps, sees = course.commands()
    assert gait_index(leaps) == gait_index(sees) == 1
