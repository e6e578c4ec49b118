"""Trials of how the teacher best commands a low policy."""

import dataclasses

import pytest

from tdgc.config import HighLevelConfig, TeacherConfig
from tdgc.policies import Policy
from tdgc.tasks import manners
from tdgc.tasks.leaps import SPEED
from tdgc.tasks.manners import arrivals, choose, find_manner
from tdgc.tasks.pairing import PRETRAINED, load_low, paired

FAST = TeacherConfig(walk_speed=0.9, step_frequency=3.3)


def test_leaps_are_planned_for_the_usual_speed() -> None:
    assert TeacherConfig().leap_speed == SPEED


@pytest.mark.parametrize(
    ("arrived", "chosen", "tried"),
    [
        ((14, 35, 44), 1.0, 3),
        ((26, 45, 45), 1.1, 3),  # the earlier of equals
        ((26, 42, 45), 1.1, 3),  # or of near ties
        ((26, 42, 46), 1.0, 3),
        ((41, 44, 43), 1.2, 3),  # hardly better
        ((41, 44, 45), 1.1, 3),
        ((45, 48, 48), 1.2, 1),  # of 48 robots, no more than 3 can be gained
    ],
)
def test_something_unusual_has_to_be_clearly_better(
    arrived: tuple[int, ...], chosen: float, tried: int
) -> None:
    trials = []

    def trial(manner: TeacherConfig) -> int:
        trials.append(manner)
        return arrived[len(trials) - 1]

    options = [TeacherConfig(leap_speed=speed) for speed in (1.2, 1.1, 1.0)]
    assert choose(trial, options).leap_speed == chosen
    assert trials == options[:tried]


def test_walks_are_tried_first_and_leaps_only_where_there_may_be_trenches(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Stands in for a robot that climbs fast or not at all, and leaps slowly or not at all."""
    asked = []

    def arrives(low: object, env: object, manner: TeacherConfig, family: str) -> int:
        asked.append((family, manner))
        return 48 * (manner.walk_speed == 0.9 if family == "stair" else manner.leap_speed == 1.0)

    monkeypatch.setattr(manners, "arrivals", arrives)
    low, told = load_low(PRETRAINED / "low")[0], []
    flat = HighLevelConfig(families=("tilt",))
    for env in (flat, dataclasses.replace(flat, families=("gap",), gaits=("trot", "pace"))):
        asked.clear()
        assert find_manner(low, env, told.append) == FAST
        assert [family for family, _ in asked] == 3 * ["stair"]
    told.clear()
    best = find_manner(low, dataclasses.replace(flat, families=("tilt", "gap")), told.append)
    assert best == dataclasses.replace(FAST, leap_speed=1.0)
    assert all(manner.walk_speed == 0.9 for family, manner in asked if family == "gap")
    assert told[2] == "trial: 48 of 48 robots climb stairs at 0.9 m/s with 3.3 Hz"
    assert told[-1] == "trial: 48 of 48 robots leap over trenches at 1 m/s"


def test_a_policy_that_falls_when_it_leaps_is_not_tried_on_trenches(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    low, config = load_low(PRETRAINED / "low")
    monkeypatch.setattr(manners, "measure_landing", lambda *_: None)
    monkeypatch.setattr(manners, "NavigationTask", None)  # so none is made
    assert arrivals(low, paired(HighLevelConfig(), config), TeacherConfig(), "gap") == 0


def test_the_shipped_low_policy_arrives_and_one_that_falls_does_not() -> None:
    shipped, config = load_low(PRETRAINED / "low")
    flailing = Policy(shipped.header, {name: 30.0 * t for name, t in shipped.tensors.items()})
    env = paired(HighLevelConfig(), config)
    for family in ("stair", "gap"):
        assert arrivals(shipped, env, TeacherConfig(), family, robots=4) >= 3
        assert arrivals(flailing, env, TeacherConfig(), family, robots=4) == 0
