"""Trials of how fast the teacher should walk, step and leap with a low policy.

The best speeds depend on the low policy. With the shipped one, none are better than the usual ones.
At these the Unitree A1's falls on the higher stairs and between trenches; it needs faster walks
with faster steps, and slower leaps (docs/experiments.md).
"""

import dataclasses
from collections.abc import Callable, Sequence
from contextlib import closing

import numpy as np

from tdgc.config import FIRST_TEACHER, CommandRanges, HighLevelConfig, TeacherConfig, recorded
from tdgc.policies import Policy
from tdgc.sim.commands import NUM_ACTIONS
from tdgc.sim.families import MAX_LEVEL
from tdgc.sim.terrain import may_have_trenches
from tdgc.tasks.high_env import NavigationTask
from tdgc.tasks.leaps import measure_landing
from tdgc.tasks.pairing import mdp_of
from tdgc.tasks.teacher import Skill

#: Walks that are tried besides the usual one: m/s, and Hz of the steps.
WALKS = ((0.75, 2.8), (0.9, 3.3))
#: m/s, speeds of leaps that are tried besides the usual one.
LEAPS = (1.1, 1.0)
#: Of each trial. By chance, 40 of 48 vary by 2.6 (standard deviation).
ROBOTS = 48
_FIRST = 5  # lowest level, the middle one; the robots are dealt to it and to those above it
_SEED = 0
# How many more of the robots must arrive for a manner to be preferred to one that is nearer to the
# usual, so that near ties, which another machine may decide differently, change nothing.
_BETTER = 4


def may_leap(env: HighLevelConfig) -> bool:
    """Whether a teacher may leap in the MDP ``env``: it may have trenches, and pronk is allowed."""
    return "pronk" in env.gaits and any(map(may_have_trenches, env.families))


def within(manner: TeacherConfig, ranges: CommandRanges) -> TeacherConfig:
    """The manner as a teacher with these command ranges carries it out."""
    allowed = {"walk_speed": ranges.vx, "step_frequency": ranges.frequency, "leap_speed": ranges.vx}
    return TeacherConfig(
        **{name: float(np.clip(getattr(manner, name), *ends)) for name, ends in allowed.items()}
    )


def find_manner(low: Policy, env: HighLevelConfig, tell: Callable[[str], None]) -> TeacherConfig:
    """Find out how the teacher best commands ``low`` on stairs and over trenches.

    Leaps are tried only if the teacher may leap.

    Args:
        low: the low policy.
        env: the MDP in which the teacher decides.
        tell: is given the result of each trial, a line of text.
    """

    def climb(manner: TeacherConfig) -> int:
        arrived = arrivals(low, env, manner, "stair")
        walk = f"{manner.walk_speed:g} m/s with {manner.step_frequency:g} Hz"
        tell(f"trial: {arrived} of {ROBOTS} robots climb stairs at {walk}")
        return arrived

    def leap(manner: TeacherConfig) -> int:
        arrived = arrivals(low, env, manner, "gap")
        tell(f"trial: {arrived} of {ROBOTS} robots leap over trenches at {manner.leap_speed:g} m/s")
        return arrived

    usual = TeacherConfig()
    others = [
        dataclasses.replace(usual, walk_speed=speed, step_frequency=frequency)
        for speed, frequency in WALKS
    ]
    best = choose(climb, [usual, *others])
    if may_leap(env):
        others = [dataclasses.replace(best, leap_speed=speed) for speed in LEAPS]
        best = choose(leap, [best, *others])
    return best


def manner_of(high: Policy, source: object) -> TeacherConfig:
    """The manner of the teacher that the policy ``high`` of the file ``source`` imitated; the first
    one if it records none.

    Raises:
        ConfigError: the record cannot be used; the message begins with ``source``.
    """
    taught = high.meta.get("teacher", FIRST_TEACHER)
    return recorded(TeacherConfig, taught, f"{source}, meta.teacher")


def choose(
    trial: Callable[[TeacherConfig], int], manners: Sequence[TeacherConfig]
) -> TeacherConfig:
    """Choose the manner with which most robots arrive in a trial.

    One is preferred to another before it in the sequence, which begins with the usual one, only if
    it is clearly better. If nothing can be clearly better than the usual one, no other is tried.
    """
    usual, *others = manners
    arrived = [trial(usual)]
    if arrived[0] + _BETTER > ROBOTS:
        return usual
    arrived += [trial(manner) for manner in others]
    close = [number + _BETTER > max(arrived) for number in arrived]
    return manners[close.index(True)]


def arrivals(
    low: Policy, env: HighLevelConfig, manner: TeacherConfig, family: str, robots: int = ROBOTS
) -> int:
    """Count the robots that the teacher leads over tiles of levels 5 to 10, always the same.

    On Gap none arrive with a policy that falls when it leaps: in training, its teacher will walk.
    """
    landing = None
    if family == "gap":
        landing = measure_landing(low, mdp_of(low), manner.leap_speed)
        if landing is None:
            return 0
    config = dataclasses.replace(
        env,
        families=(family,),
        curriculum="performance",
        levels=MAX_LEVEL + 1,
        first_level=_FIRST,
        first_levels=MAX_LEVEL + 1 - _FIRST,
    )
    skill = Skill(landing, manner)
    task = NavigationTask(config, low, robots, _SEED, training=False, taught=skill, led=np.inf)
    lost = np.zeros(robots, dtype=bool)
    with closing(task):
        task.reset(np.arange(robots))
        for _ in range(task.horizon):
            if not np.isfinite(task.observe()).all():  # the teacher decides
                break  # a robot's simulation has blown up, and will corrupt those of the others
            _, failed, _ = task.step(np.zeros((robots, NUM_ACTIONS)))
            lost |= failed & ~task.reached
            if (lost | task.reached).all():
                break
        return int((task.reached & ~lost).sum())
