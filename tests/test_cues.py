"""``CuesLaw``, the scripted law on the cues: its memory is right, and robots reach their goals."""

from __future__ import annotations

import numpy as np
import pytest

from tdgc.benchmark import evaluation
from tdgc.benchmark.cues import CuesLaw
from tdgc.benchmark.cues import Memory as LawMemory
from tdgc.benchmark.drivers import HierarchyDriver
from tdgc.benchmark.evaluation import Cell, run_cell, tile_of
from tdgc.benchmark.memory import Obstacles, Profile, Reckoning
from tdgc.config import HighLevelConfig
from tdgc.sim.commands import INDEX
from tdgc.sim.robot import Array, wrap_angle
from tdgc.sim.tile import GOAL_X, START_X
from tdgc.tasks.leaps import SPEED, Landing, LeapPlan, Motion, measure_landing
from tdgc.tasks.pairing import PRETRAINED, load_low
from tdgc.tasks.probes import PROBES
from tdgc.tasks.teacher import Skill

LOW, CONFIG = load_low(PRETRAINED / "low")
POINTS = PROBES[HighLevelConfig().probes]


# ------------------------------------------------------------------ what it remembers


def goal_cue(position: Array, heading: Array, goal: Array) -> tuple[Array, Array]:
    offset = goal - position
    bearing = wrap_angle(np.arctan2(offset[:, 1], offset[:, 0]) - heading)
    return np.linalg.norm(offset, axis=1), bearing


def test_one_of_two_tracks_is_where_the_robot_is() -> None:
    """Robots weave and sidestep to a goal on the left and one on the right, 0.1 s per decision."""
    goal = np.array([[GOAL_X, 1.5], [GOAL_X, -0.8]])
    position, heading = np.array([[START_X, 0.0]] * 2), np.array([0.4, -0.3])
    where = Reckoning(*goal_cue(position, heading, goal))
    for step in range(50):
        velocity, turn = np.array([[0.8, 0.2 * np.sin(0.3 * step)]] * 2), np.sin(0.2 * step)
        c, s = np.cos(heading), np.sin(heading)
        world = np.stack(
            [c * velocity[:, 0] - s * velocity[:, 1], s * velocity[:, 0] + c * velocity[:, 1]],
            axis=1,
        )
        position, heading = position + 0.1 * world, wrap_angle(heading + 0.1 * turn)
        where.move(*goal_cue(position, heading, goal), velocity, 0.1)
    for robot, track in ((0, 0), (1, 1)):  # the goal is to the left, or to the right
        assert where.heading[track, robot] == pytest.approx(heading[robot], abs=0.05)
        wanted = position[robot] - [0.0, goal[robot, 1]]
        assert where.position[track, robot] == pytest.approx(wanted, abs=0.1)


def test_lips_and_track_come_from_what_was_probed() -> None:
    """A robot walks along track 1; on track 0 its heading is off by 0.3 rad."""
    trenches = np.array([[2.12, 2.41], [3.3, 3.55]])
    profile, ahead = Profile(1), POINTS[:, 1] == 0.0
    x, y = POINTS.T
    for at in np.arange(0.75, 3.2, 0.093):
        deep = ((at + x > trenches[:, :1]) & (at + x < trenches[:, 1:])).any(axis=0)
        off = at + np.cos(0.3) * x - np.sin(0.3) * y
        profile.add(np.stack([off, at + x])[:, None], deep[None], ahead)
        if at < 1.0:
            assert profile.track()[0] == -1
    assert profile.track()[0] == 1
    assert profile.trenches(0, 1, 0.35) == pytest.approx(trenches, abs=0.011)
    assert profile.seen(0, 1) == pytest.approx(at + x.max(), abs=0.011)


def test_a_trench_whose_end_is_out_of_sight_is_as_wide_as_any() -> None:
    profile, ahead = Profile(1), np.ones(20, dtype=bool)
    x = 1.0 + 0.05 * np.arange(20)
    profile.add(np.stack([x, x])[:, None], (x > 1.78)[None], ahead)
    assert profile.trenches(0, 0, 0.35) == pytest.approx(np.array([[1.78, 2.13]]), abs=0.025)
    assert Profile(1).trenches(0, 0, 0.35).shape == (0, 2)


def test_the_way_leads_around_what_was_seen() -> None:
    obstacles, goal = Obstacles(1), np.array([6.0, 0.0])
    at = np.array([2.0, 0.05])
    assert obstacles.direction(0, at, goal, 0.0) == 0.0
    angles = np.linspace(0.0, 2.0 * np.pi, 40)
    pillar = np.array([3.0, 0.0])
    obstacles.add(0, pillar + 0.15 * np.stack([np.cos(angles), np.sin(angles)], axis=1))
    closest = np.inf
    for _ in range(80):
        offset = goal - at
        ahead = float(np.arctan2(offset[1], offset[0]))
        way = obstacles.direction(0, at, goal, ahead)
        at = at + 0.05 * np.array([np.cos(way), np.sin(way)])
        closest = min(closest, float(np.linalg.norm(at - pillar)))
    assert 0.15 + 0.24 < closest < 0.7
    assert at[0] > 5.0 and abs(at[1]) < 0.5


# ------------------------------------------------------------------ where it gets by it


class Watched(CuesLaw):
    """The law, with its memory exposed."""

    memory: LawMemory

    def predict(
        self, obs: np.ndarray, state: LawMemory | None = None
    ) -> tuple[np.ndarray, LawMemory]:
        action, self.memory = super().predict(obs, state)
        return action, self.memory


@pytest.fixture(scope="module")
def law() -> Watched:
    skill = Skill(measure_landing(LOW, CONFIG, SPEED))
    return Watched(CONFIG, skill, HighLevelConfig(commands=CONFIG.commands))


def run(law: CuesLaw, condition: str, family: str, level: int, count: int) -> list[str]:
    driver = HierarchyDriver(law, HighLevelConfig(commands=CONFIG.commands))
    cell = Cell("cues", condition, family, level, 0, count)
    return [e.outcome for e in run_cell(cell, LOW, driver, seed=11)]


@pytest.mark.parametrize("condition", ["nominal", "noise"])
def test_lips_are_where_probes_met_them(
    law: Watched, condition: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lips are right within 6 cm, though noisy probes are also 12 cm late at leaping speed."""
    monkeypatch.setattr(evaluation, "HORIZON", 1.2)
    run(law, condition, "gap", 4, 4)
    track = law.memory.profile.track()
    found = [law.memory.profile.trenches(i, max(track[i], 0), 0.3)[0, 0] for i in range(4)]
    there = [tile_of(11, "gap", 4, i).features.trenches[0, 0] for i in range(4)]
    np.testing.assert_allclose(found, there, atol=0.06)


def test_leaps_are_planned_from_the_clock_and_the_speed(
    law: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Leaps warp the phases in the cue by 0.05 of a cycle, 2 cm of travel.

    The robots on track 1 are placed up to 23 cm further along their tiles once that is known, which
    is no speed.
    """
    driver = HierarchyDriver(law, HighLevelConfig(commands=CONFIG.commands))
    clocks, speeds, cycles, plan_steps = [], [], [], LeapPlan.steps

    def steps(plan: LeapPlan, rows: Array, motion: Motion, landing: Landing) -> tuple[Array, Array]:
        loco = driver._loco
        clocks.extend(wrap_angle(2.0 * np.pi * (motion.clock - loco.clock.clock[rows])))
        wanted = Motion.of(loco, rows, motion.x, motion.speed, motion.commanded).cycles
        cycles.append((motion.cycles, wanted))
        speeds.extend(motion.speed - loco.world.state.lin_vel[rows, 0])
        return plan_steps(plan, rows, motion, landing)

    monkeypatch.setattr(LeapPlan, "steps", steps)
    monkeypatch.setattr(evaluation, "HORIZON", 2.0)
    run_cell(Cell("cues", "nominal", "gap", 6, 0, 48), LOW, driver, seed=11)
    assert len(clocks) > 500
    np.testing.assert_allclose(clocks, 0.0, atol=1e-5)
    assert np.abs(speeds).max() < 0.6
    counted, wanted = np.concatenate(cycles, axis=1)
    np.testing.assert_allclose(counted, wanted, atol=1e-5)
    assert (counted == 0.0).sum() >= 48 and counted.max() > 3.0


def test_the_slope_is_seen_by_the_probes_at_either_side(
    law: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "HORIZON", 3.0)
    run(law, "nominal", "tilt", 8, 4)
    assert np.abs(law.memory.slope) == pytest.approx(0.36, abs=0.06)
    went = law.memory.command[:, INDEX["vy"]]
    assert np.sign(went) == pytest.approx(np.sign(law.memory.slope)) and np.abs(went).min() > 0.1


@pytest.mark.parametrize(
    ("condition", "family", "level"),
    [
        ("nominal", "gap", 5),
        ("nominal", "pillar", 9),
        ("no-family", "gap", 2),
        ("no-family", "pillar", 8),
        ("no-family", "stair", 3),
    ],
)
def test_it_gets_to_its_goals(law: Watched, condition: str, family: str, level: int) -> None:
    outcomes = run(law, condition, family, level, 4)
    assert outcomes.count("reached") >= 3, outcomes
    if condition == "no-family":
        assert law.memory.gap.all() == (family == "gap")
        assert law.memory.pillar.all() == (family == "pillar")
