"""The scripted teacher: what it commands on which ground."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tdgc.config import CommandRanges, LowLevelConfig, PhysicsConfig, RobotConfig, TeacherConfig
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.commands import INDEX, CommandDecoder, gait_index
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.terrain import make_tile
from tdgc.sim.tile import CELL, Tile, TileField
from tdgc.tasks.leaps import SWING_HEIGHT, Landing
from tdgc.tasks.teacher import LEAPING, SIGHT, SLOPING, UNEVEN, WAY, Skill, Teacher

Heights = Callable[[np.ndarray, np.ndarray], np.ndarray]


def ground(heights: Heights) -> Tile:
    """A tile with heights of (x, y) in m, and no list of its features."""
    x, y = np.meshgrid(np.arange(161) * CELL, np.arange(161) * CELL, indexing="ij")
    surface = np.broadcast_to(heights(x, y), x.shape).astype(np.float32)
    start, goal = np.array([0.75, 4.0, 0.0]), np.array([7.25, 4.0])
    return Tile(surface, surface, start, goal, "own.npy", 1.0, ("own.npy",))


def trench(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A trench across the tile, with lips at 4 and 4.25 m."""
    return np.where((x > 4.01) & (x < 4.24), -0.6, 0.0)


class Course:
    """Robots that a test places on a tile each, with a teacher."""

    def __init__(self, grounds: list[str | Heights], level: int) -> None:
        rng = np.random.default_rng(0)
        self.field = TileField(len(grounds))
        for k, kind in enumerate(grounds):
            tile = make_tile(kind, level / 10, rng) if isinstance(kind, str) else ground(kind)
            self.field.place(k, tile)
        self.origin = self.field.origin(np.arange(len(grounds)))
        self.loco = Locomotion(
            BulletWorld(len(grounds), RobotConfig(), PhysicsConfig(), self.field), LowLevelConfig()
        )
        self.goal = self.origin + [7.25, 4.0]
        self.lead(Landing())

    def lead(self, landing: Landing | None) -> None:
        """Start an episode with a teacher of a low policy with this ``landing``."""
        self.teacher = Teacher(self.field, CommandRanges(), RobotConfig(), Skill(landing))
        self.teacher.begin(np.arange(len(self.origin)), self.goal)

    def put(self, x: float, y: float = 4.0, yaw: float = 0.0) -> None:
        m = len(self.origin)
        self.loco.place(np.arange(m), self.origin + [x, y], np.full(m, yaw), np.zeros(m))

    def commands(self) -> np.ndarray:
        return self.teacher.commands(self.loco, self.goal)


@pytest.fixture
def course():
    courses: list[Course] = []

    def make(grounds: list[str | Heights], level: int = 8) -> Course:
        courses.append(Course(grounds, level))
        return courses[-1]

    yield make
    for made in courses:
        made.loco.world.close()


def test_the_ground_decides_how_to_walk(course) -> None:
    styles = {"rough": UNEVEN, "stair": UNEVEN, "gap": LEAPING, "tilt": SLOPING}
    course = course(list(styles))
    course.put(1.0)
    commands = course.commands()
    for row, (family, style) in zip(commands, styles.items(), strict=True):
        assert row[INDEX["vx"]] == pytest.approx(style.speed)
        assert row[INDEX["yaw_rate"]] == pytest.approx(0.0, abs=1e-9)
        swing = SWING_HEIGHT if family == "gap" else style.swing_height
        assert row[INDEX["swing_height"]] == swing
        assert row[INDEX["stance_width"]] == style.stance_width
        assert row[INDEX["body_height"]] == style.body_height
        assert gait_index(row) == (1 if family == "gap" else 0)
    decoder = CommandDecoder()  # all commands can be expressed as actions
    np.testing.assert_allclose(decoder.decode(decoder.encode(commands)), commands)


def test_only_leaps_are_expected_to_speed_up(course) -> None:
    """At 0.6 m/s, a robot that walked is taken to do so; of one that leapt, more is expected.

    It is the past that counts: a robot that comes to where it will leap has walked there.
    """
    course = course([trench])
    speeds = []
    course.put(3.0)  # it leaps from 2.85 m on
    for leaps in (False, True):
        if leaps:
            course.loco.command[:] = course.commands()
            assert gait_index(course.loco.command[0]) == 1
            course.loco.update_clock()
        course.loco.world.state.heading_vel[:, 0] = 0.6
        for _ in range(20):
            course.teacher.watch(course.loco, 0.1)
        speeds.append(course.teacher.speed[0])
    assert speeds[0] == pytest.approx(0.6) and speeds[1] > 0.7


def test_goes_uphill_across_a_slope(course) -> None:
    course = course(["tilt", "rough"])
    slope = course.field.features[0].slope
    climb = SLOPING.uphill * np.sin(slope)
    assert abs(climb) > 0.1
    for yaw in (0.0, 0.3):
        course.put(1.0, yaw=yaw)
        command = course.commands()[0]
        ahead = SLOPING.speed * np.cos(yaw)
        assert command[INDEX["vx"]] == pytest.approx(ahead + climb * np.sin(yaw))
        assert command[INDEX["vy"]] == pytest.approx(climb * np.cos(yaw))
    course.put(1.0)
    left, right = course.loco.world.ground_height(
        np.repeat(course.origin[:1, 0] + 4.0, 2), course.origin[0, 1] + np.array([5.0, 3.0])
    )
    assert np.sign(climb) == np.sign(left - right)
    assert course.commands()[1, INDEX["vy"]] == 0.0  # level ground


def test_walks_as_on_a_slope_only_near_it(course) -> None:
    """The ground begins to rise to the left at 4 m, and slopes by 0.3 from 5 m on."""
    course = course([lambda x, y: np.where(x < 4.0, 0.0, 0.3 * (y - 4.0) * np.clip(x - 4, 0, 1))])
    for x, sloping in ((1.0, False), (2.5, False), (4.0, True), (6.0, True)):
        course.put(x)
        command = course.commands()[0]
        assert command[INDEX["frequency"]] == (SLOPING if sloping else UNEVEN).frequency
        assert (command[INDEX["vy"]] > 0.0) == sloping


@pytest.mark.parametrize(("walk_speed", "expected"), [(0.6, 0.5), (0.9, 0.75)])
def test_among_obstacles_it_is_a_sixth_slower(course, walk_speed: float, expected: float) -> None:
    course = course(["pillar"])
    skill = Skill(None, TeacherConfig(walk_speed=walk_speed))
    course.teacher = Teacher(course.field, CommandRanges(), RobotConfig(), skill)
    course.teacher.begin(np.arange(1), course.goal)
    course.put(1.0)
    assert np.hypot(*course.commands()[0, :2]) == pytest.approx(expected)


def test_turns_to_the_goal_and_slows_before_it(course) -> None:
    course = course(["stair"])
    course.put(1.0, yaw=-0.4)
    command = course.commands()[0]
    assert command[INDEX["yaw_rate"]] == pytest.approx(0.6)
    assert command[INDEX["vx"]] == pytest.approx(UNEVEN.speed * np.cos(0.4))
    course.put(7.05)
    assert course.commands()[0, INDEX["vx"]] == pytest.approx(0.2)


def test_leaps_face_across_the_trenches_and_end_behind_them(course) -> None:
    course = course(["gap"])
    course.goal[:, 1] += 0.8
    x = course.field.features[0].trenches[0, 0] - 0.4
    course.put(x, yaw=0.2)
    command = course.commands()[0]
    bearing = np.arctan2(0.8, 7.25 - x)
    assert gait_index(command) == 1
    assert command[INDEX["vx"]] == pytest.approx(1.2 * np.cos(bearing - 0.2))
    assert command[INDEX["vy"]] == pytest.approx(1.2 * np.sin(bearing - 0.2))
    assert command[INDEX["yaw_rate"]] == pytest.approx(-0.3)
    course.put(course.field.features[0].trenches[-1, 1] + 0.55)
    command = course.commands()
    assert gait_index(command[0]) == 0 and command[0, INDEX["frequency"]] == UNEVEN.frequency


def test_goes_around_a_pillar(course) -> None:
    # Its centre is left of the straight way, so the shorter way is on the right.
    course = course([lambda x, y: 0.8 * (np.hypot(x - 3.05, y - 4.15) < 0.2)])
    course.put(2.3)
    assert course.commands()[0, INDEX["yaw_rate"]] < -0.5
    assert course.commands()[0, INDEX["vy"]] < -0.2
    course.put(4.0)  # behind it
    assert abs(course.commands()[0, INDEX["yaw_rate"]]) < 0.2


def test_knows_both_ways_around_what_stands_before_it(course) -> None:
    # A wall that ends sooner on the right.
    wall = lambda x, y: 0.5 * ((np.abs(x - 3.0) < 0.12) & (np.abs(y - 4.1) < 0.6))  # noqa: E731
    course = course([wall, "stair"])
    course.put(2.5)
    command, straight_on = course.commands()
    other, same = course.teacher.other
    assert command[INDEX["vy"]] < -0.3 and command[INDEX["yaw_rate"]] < -0.5
    assert other[INDEX["vy"]] > 0.3 and other[INDEX["yaw_rate"]] > 0.5
    np.testing.assert_array_equal(np.delete(other, WAY), np.delete(command, WAY))
    # Around the wall's ends: the left way is 0.2 m longer, and near walls a metre costs up to 3.
    assert 0.1 < course.teacher.dearer[0] < 0.6
    np.testing.assert_array_equal(same, straight_on)
    assert course.teacher.dearer[1] == 0.0
    for x in (1.0, 4.0):  # far away and behind the wall there is only one way
        course.put(x)
        command = course.commands()
        np.testing.assert_array_equal(course.teacher.other, command)
        np.testing.assert_array_equal(course.teacher.dearer, 0.0)


def test_knows_a_way_back_for_a_robot_far_off_its_tile(course) -> None:
    """It may be there at the end of a long decision."""
    course = course(["pillar"])
    course.put(-1.0)
    assert np.isfinite(course.commands()).all()
    assert np.isfinite(course.teacher.other).all() and np.isfinite(course.teacher.dearer).all()


def test_leaps_over_a_trench_once_the_probes_show_it(course) -> None:
    """Wherever it lies: the robot walks until there, leaps, and then walks again."""
    course = course([lambda x, y: trench(x, y) + 0.08 * ((x > 1.8) & (x < 2.5)), trench, "gap"])
    before = course.field.features[2].trenches[0, 0] - 4.0  # m, how far its first trench is moved
    for x, gait in ((4.0 - SIGHT - 0.05, 0), (4.0 - SIGHT + 0.05, 1), (4.7, 1), (4.8, 0)):
        course.put(x)
        command, expected, _ = course.commands()
        assert gait_index(command) == gait
        np.testing.assert_array_equal(command, expected)
        if not gait:
            assert command[INDEX["swing_height"]] == UNEVEN.swing_height
            assert command[INDEX["vx"]] == pytest.approx(UNEVEN.speed, abs=0.02)
        if x < 4.0:
            course.put(x + before)
            assert gait_index(course.commands()[2]) == gait


def test_walks_around_a_pit_and_a_trench_that_is_too_wide(course) -> None:
    """Neither can be leapt over; around the wide trench leads a bridge on the left."""
    pit = lambda x, y: -0.6 * (np.hypot(x - 3.0, y - 3.95) < 0.25)  # noqa: E731
    wide = lambda x, y: -0.6 * ((np.abs(x - 4.0) < 0.5) & (y < 4.8))  # noqa: E731
    course = course([pit, wide])
    course.put(2.4)
    command = course.commands()
    assert gait_index(command).tolist() == [0, 0]
    assert (command[:, INDEX["yaw_rate"]] > 0.3).all()
    assert (command[:, INDEX["vy"]] > 0.2).all()


def test_a_policy_that_does_not_leap_walks_over_trenches(course) -> None:
    course = course(["gap"])
    course.lead(None)
    course.put(1.7)
    command = course.commands()[0]
    assert command[INDEX["vx"]] == pytest.approx(UNEVEN.speed) and gait_index(command) == 0
