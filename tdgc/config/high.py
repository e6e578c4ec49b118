"""The decision-level MDP (paper Sec. IV-B) and its curriculum (Sec. IV-C)."""

from dataclasses import dataclass, field
from typing import Literal

from tdgc.config.settings import Count, NotNegative, Positive, Share, Whole
from tdgc.config.sim import CommandRanges, RandomisationConfig


@dataclass(frozen=True)
class HighRewardConfig:
    """Weights and constants of the high policy's reward (Sec. IV-B), one weight per term.

    The paper gives the terms and no numbers, so those without an origin of their own are ours.

    Weights are per second: ``tdgc.tasks.rewards.high_terms`` multiplies them by the step's
    duration, unless ``step_time_scaling`` is off: then they are per decision.
    """

    step_time_scaling: bool = field(default=True, metadata={"before": True})

    goal_distance: float = 1.0
    face: float = 0.2
    arrive: float = 2.0
    stable: float = 0.5
    action_rate: float = -0.01
    command_rate: float = -0.2
    command_acceleration: float = -0.1
    contact_force: float = -0.01
    laziness: float = -0.5
    alive: float = 0.1
    map_radius: Positive = 8.0  # m, R_map: the tile's length
    curve_gain: float = 1.0  # a of the goal distance
    curve_rate: float = 3.0  # b of the goal distance
    goal_radius: Positive = 0.5  # m, d_0: the paper's reach distance
    arrive_base: float = 1.0  # b_0
    arrive_speed: float = 2.0  # b_1: what an early arrival adds
    joint_speed_weight: float = 0.05  # beta of eta_t
    height_scale: Positive = 0.01  # m^2, sigma_z
    force_threshold: float = 1.0  # N, F_th
    lazy_speed: float = 0.1  # m/s, v_th


_GAITS: tuple[Literal["trot", "pronk", "pace", "bound"], ...] = ("trot", "pronk", "pace", "bound")


@dataclass(frozen=True)
class HighLevelConfig:
    """The decision-level MDP (Sec. IV-B) and its curriculum (Sec. IV-C)."""

    decimation: Count = 5  # control steps a decision: 10 Hz; 1 is the paper's synchronous loop
    cues: Literal["both", "semantic", "geometric", "none"] = "both"
    # Gaits that the gait channel chooses from, in equal shares of its range.
    gaits: tuple[Literal["trot", "pronk", "pace", "bound"], ...] = field(
        default=_GAITS, metadata={"before": _GAITS}
    )
    # What it decides: all commands, or the velocities and the gait. The other commands then stay at
    # their defaults, or as near as ``commands`` lets them.
    behaviour: Literal["all", "velocities"] = field(default="all", metadata={"before": "all"})
    # What the high policy sees of the gait clock. The paper's phi is the sine alone, which in pronk
    # does not tell feet that touch down from feet that take off.
    clock: Literal["sine", "both"] = field(default="both", metadata={"before": "sine"})
    # Where the heights of the geometric cue are probed, see ``tdgc.tasks.probes``.
    probes: Literal["graded", "lines", "staggered"] = field(
        default="graded", metadata={"before": "staggered"}
    )
    # Whether it is told how old the probes' heights are, as a sensor's time stamp does.
    probe_age: bool = field(default=True, metadata={"before": False})
    # Whether it sees how fast the goal came nearer since the last decision. A leap is timed by the
    # trunk's speed, which no sensor of the robot gives (docs/experiments.md).
    closing_speed: bool = field(default=True, metadata={"before": False})
    # Share of the episodes in training whose family is told as unknown, so that the probes alone
    # have to do: tiles of several families, or of none that has a name.
    unknown_share: Share = 0.2
    # Trenches, which are leapt to a few centimetres, take twice the robots of the others.
    # Clutter stands for ground that no other family resembles, and ditches for trenches behind and
    # before other ground (docs/experiments.md).
    families: tuple[str, ...] = (
        "rough", "pillar", "stair", "gap", "gap", "tilt", "clutter", "ditches"
    )  # fmt: skip
    levels: Count = 11  # L_max: levels 0..10
    # How levels are chosen in training: by each robot's performance, as the paper has it; drawn
    # uniformly for each episode; or always the hardest.
    curriculum: Literal["performance", "uniform", "hardest"] = field(
        default="performance", metadata={"before": "performance"}
    )
    # m: in training trenches are this deep on level 0 and deepen from there, see
    # ``tdgc.tasks.tiles.shallow``; null: all of them are as deep as in the benchmark.
    shallowest_trench: Positive | None = field(default=None, metadata={"before": None})
    window: Count = 4  # W episodes: few, since one of every robot takes minutes on two cores
    threshold: Count = 3  # S successes of them
    # Robots begin spread over ``first_levels`` levels, of which ``first_level`` is the lowest.
    first_level: Whole = field(default=0, metadata={"before": 0})
    first_levels: Count = 1
    episode_seconds: Positive = 20.0  # T_max (benchmark)
    hold_seconds: NotNegative = 2.0  # an episode goes on that long after the goal was reached
    action_limit: Positive = 1.0  # a_max of the decoder
    # The decoder's bounds; all that the low policy was trained on where there are none.
    commands: CommandRanges | None = None
    rewards: HighRewardConfig = field(default_factory=HighRewardConfig)
    randomisation: RandomisationConfig = field(default_factory=RandomisationConfig)
