"""Trials of the teacher with a low policy, before training: how fast to walk, step and leap.

What suits depends on the low policy. At the usual speeds the shipped one climbs and leaps best. One
of the Unitree A1 falls on the higher stairs and between trenches at these, and needs faster walks
with faster steps, and slower leaps (docs/experiments.md).
"""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from tdgc.config import HighLevelConfig, TeacherConfig
from tdgc.sim.commands import NUM_ACTIONS
from tdgc.tasks.high_env import NavigationTask
from tdgc.tasks.leaps import measure_landing
from tdgc.tasks.pairing import load_low
from tdgc.tasks.teacher import Skill

if TYPE_CHECKING:
    from tdgc.policies import Policy

Choice = TypeVar("Choice")

#: Walks that are tried besides the usual one: m/s, and Hz of the steps.
_WALKS = ((0.75, 2.8), (0.9, 3.3))
_LEAPS = (1.1, 1.0)  # m/s, speeds of leaps that are tried besides the usual one
_ROBOTS = 48
_FIRST = 5  # lowest level; the robots are dealt to it and to those above it
_SEED = 0
# How many more of the robots must arrive for something else to be preferred to the usual, so that
# near ties, which another machine may decide differently, change nothing.
_BETTER = 5


def suit(low: "Policy", trenches: bool, tell: Callable[[str], None]) -> TeacherConfig:
    """Find out how the teacher best commands ``low``.

    Args:
        low: the low policy.
        trenches: whether to try leaps, too.
        tell: is given the result of each trial, a line of text.
    """
    usual, climbed, leapt = TeacherConfig(), {}, {}
    for walk in ((usual.walk_speed, usual.step_frequency), *_WALKS):
        climbed[walk] = arrivals(low, TeacherConfig(*walk), "stair")
        what = "{:g} m/s and {:g} Hz".format(*walk)
        tell(f"trial: {climbed[walk]} of {_ROBOTS} robots climb stairs at {what}")
    best = choose(climbed)
    if not trenches:
        return TeacherConfig(*best)
    for speed in (usual.leap_speed, *_LEAPS):
        leapt[speed] = arrivals(low, TeacherConfig(leap_speed=speed), "gap")
        tell(f"trial: {leapt[speed]} of {_ROBOTS} robots leap over trenches at {speed:g} m/s")
    return TeacherConfig(*best, choose(leapt))


def choose(arrived: Mapping[Choice, int]) -> Choice:
    """Choose that with which most robots arrived, the first of equals; the very first, which is the
    usual, unless another is clearly better."""
    usual, best = next(iter(arrived)), max(arrived, key=arrived.__getitem__)
    return best if arrived[best] >= arrived[usual] + _BETTER else usual


def arrivals(low: "Policy", manner: TeacherConfig, family: str, robots: int = _ROBOTS) -> int:
    """Count the robots that the teacher leads over tiles of levels 5 to 10, always the same."""
    landing = measure_landing(*load_low(low), manner.leap_speed) if family == "gap" else None
    config = HighLevelConfig(families=(family,), first_level=_FIRST, first_levels=11 - _FIRST)
    skill = Skill(landing, manner)
    task = NavigationTask(config, low, robots, _SEED, training=False, taught=skill, led=np.inf)
    lost = np.zeros(robots, dtype=bool)
    try:
        task.reset(np.arange(robots))
        for _ in range(task.horizon):
            task.observe()  # the teacher decides
            _, failed, _ = task.step(np.zeros((robots, NUM_ACTIONS)))
            lost |= failed & ~task.reached
            if (lost | task.reached).all():
                break
        return int((task.reached & ~lost).sum())
    finally:
        task.close()
