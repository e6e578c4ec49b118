"""The rows of the ablation: changes to the full hierarchy, as settings."""

from dataclasses import dataclass
from typing import Literal

from tdgc.config import NO_TEACHER

WHOLE = "full"  # the variant that the others are compared with


@dataclass(frozen=True)
class Variant:
    """A row of the table.

    Attributes:
        name: of the row.
        what: how it differs from ``full``, in a few words.
        settings: of its training; None if nothing is trained.
        alone: further settings if all variants are trained without a teacher.
        low: the low policy: as given, without calibration, or with the paper's fixed nominal pose.
        high: the high policy of ``full`` that a variant without training uses.
        policy: the policy to evaluate, as named by evaluate.py.
    """

    name: str
    what: str
    settings: tuple[str, ...] | None = None
    alone: tuple[str, ...] = ()
    low: Literal["given", "uncalibrated", "fixed-pose"] = "given"
    high: Literal["policy", "imitation"] = "policy"
    policy: Literal["tdgc", "gp", "cues", "teacher"] = "tdgc"


def _discounts(seconds: float) -> tuple[str, ...]:
    """Settings for decisions every ``seconds`` that discount as much per second as the defaults.

    The defaults, ``gamma`` 0.99 and ``gae_lambda`` 0.95, are for decisions every 0.1 s.
    """
    share = seconds / 0.1
    return f"ppo.gamma={0.99**share:.6f}", f"ppo.gae_lambda={0.95**share:.6f}"


_VELOCITIES = "env.behaviour=velocities"
_NO_CLUTTER = 'env.families=["rough","pillar","stair","gap","gap","tilt"]'

#: The rows, in order.
VARIANTS: tuple[Variant, ...] = (
    Variant(WHOLE, "all parts", ()),
    Variant(
        "feed-forward",
        "no memory, as many parameters",
        # Actor and critic have 74,542 and 73,762 parameters; with an LSTM 74,509 and 73,729, not
        # counting the second bias of PyTorch's LSTM, which adds nothing that it could learn.
        ("ppo.lstm=null", "ppo.encoder=[]", "ppo.actor=[469,64]", "ppo.critic=[469,64]"),
    ),
    Variant("semantic", "the family, no probes", ("env.cues=semantic",)),
    Variant("geometric", "probes, no family", ("env.cues=geometric",)),
    Variant("no-cues", "neither family nor probes", ("env.cues=none",)),
    Variant("trot", "trot alone", ('env.gaits=["trot"]',)),
    Variant("velocities", "other commands at their defaults", (_VELOCITIES,)),
    Variant(
        "velocities-high-feet",
        "the same, but feet at 0.19 m",
        (_VELOCITIES, "env.commands.swing_height=[0.19,0.19]"),
    ),
    Variant("uniform", "levels drawn uniformly", ("env.curriculum=uniform",)),
    Variant("hardest", "the hardest level alone", ("env.curriculum=hardest",)),
    Variant(
        "50hz",
        "a decision per control step",
        ("env.decimation=1", *_discounts(0.02)),
        ("ppo.gait_hold=50",),
    ),
    Variant(
        "5hz",
        "a decision per ten control steps",
        ("env.decimation=10", *_discounts(0.2)),
        ("ppo.gait_hold=5",),
    ),
    Variant("unscaled", "no step-time scaling", ("env.rewards.step_time_scaling=false",)),
    Variant("no-clutter", "trained on the benchmark's families alone", (_NO_CLUTTER,)),
    Variant("no-exchange", "untold robots keep their memories", ("ppo.memory_exchange=0",)),
    Variant("no-teacher", "reinforcement learning alone", NO_TEACHER),
    Variant("imitation", "right after imitation", high="imitation"),
    Variant("fixed-pose", "the paper's nominal pose", low="fixed-pose"),
    Variant("uncalibrated", "low policy not calibrated", low="uncalibrated"),
    Variant("gp", "the scripted baseline", policy="gp"),
    Variant("gp-fixed-pose", "the same, nominal pose", low="fixed-pose", policy="gp"),
    Variant("gp-uncalibrated", "the same, not calibrated", low="uncalibrated", policy="gp"),
    Variant("cues", "a script that reads the same cues", policy="cues"),
    Variant("teacher", "the scripted teacher, which knows the tile", policy="teacher"),
)
#: Rows for trainings with a teacher, next to each other: without one, robots are on the benchmark's
#: families alone, and every robot is told its family.
WITH_TEACHER = ("no-clutter", "no-exchange", "no-teacher", "imitation")
#: Rows in their place with ``--no-teacher``: each changes one setting that helps such a training.
HELPS: tuple[Variant, ...] = (
    Variant("gait-per-decision", "noise of the gait not held", ("ppo.gait_hold=1",)),
    Variant("gait-per-episode", "noise of the gait held for 20 s", ("ppo.gait_hold=200",)),
    Variant("no-gait-bonus", "no bonus on the gait's entropy", ("ppo.gait_ent_coef=0",)),
    Variant("deep", "trenches deep on all levels", ("env.shallowest_trench=null",)),
    Variant("low-feet", "feet at 0.08 m at the start", ("start_swing=0.08",)),
    Variant("map-8", "distances as shares of 8 m", ("env.rewards.map_radius=8",)),
)


def variants(alone: bool) -> tuple[Variant, ...]:
    """The rows of an ablation, with a teacher or without one (``alone``)."""
    if not alone:
        return VARIANTS
    place = [variant.name for variant in VARIANTS].index(WITH_TEACHER[0])
    return VARIANTS[:place] + HELPS + VARIANTS[place + len(WITH_TEACHER) :]
