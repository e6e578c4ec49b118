"""Trials of how the teacher best commands a low policy."""

import pytest

from tdgc.config import TeacherConfig
from tdgc.policies import Policy
from tdgc.tasks.leaps import SPEED
from tdgc.tasks.pairing import PRETRAINED, load_low
from tdgc.tasks.teacher import UNEVEN
from tdgc.tasks.trials import arrivals, choose


def test_the_usual_manner_is_that_of_the_styles() -> None:
    usual = TeacherConfig()
    assert (usual.walk_speed, usual.step_frequency) == (UNEVEN.speed, UNEVEN.frequency)
    assert usual.leap_speed == SPEED


@pytest.mark.parametrize(
    ("arrived", "chosen"),
    [
        ((23, 22, 21), 1.2),
        ((14, 35, 44), 1.0),
        ((26, 45, 45), 1.1),  # the first of equals
        ((40, 44, 43), 1.2),  # hardly better
        ((40, 44, 45), 1.0),
    ],
)
def test_something_unusual_has_to_be_clearly_better(
    arrived: tuple[int, int, int], chosen: float
) -> None:
    assert choose(dict(zip((1.2, 1.1, 1.0), arrived, strict=True))) == chosen


def test_the_shipped_low_policy_climbs() -> None:
    low = load_low(PRETRAINED / "low")[0]
    assert arrivals(low, TeacherConfig(), "stair", robots=12) >= 10


def test_a_policy_that_falls_does_not_arrive() -> None:
    shipped = load_low(PRETRAINED / "low")[0]
    flailing = Policy(shipped.header, {name: 30.0 * t for name, t in shipped.tensors.items()})
    assert [arrivals(flailing, TeacherConfig(), family, 12) for family in ("stair", "gap")] == [
        0,
        0,
    ]
