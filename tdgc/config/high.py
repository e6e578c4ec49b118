"""The decision-level MDP (paper Sec. IV-B) and its curriculum (Sec. IV-C)."""

from dataclasses import dataclass, field
from typing import ClassVar, Literal, get_args

from tdgc.config.settings import Count, NotNegative, Positive, Share, Weight, Whole
from tdgc.config.sim import CommandRanges, RandomisationConfig


@dataclass(frozen=True)
class HighRewardConfig:
    """Weights and constants of the high policy's reward (Sec. IV-B), one weight per term.

    The paper gives the terms but no numbers; values without a stated origin are our own.

    Weights are per second: ``tdgc.tasks.high_rewards.high_terms`` multiplies them by the duration
    of a decision. With ``step_time_scaling`` off, they are per decision.
    """

    #: Settings of earlier versions, which files may have recorded.
    RETIRED: ClassVar[tuple[str, ...]] = ("goal_radius",)

    step_time_scaling: bool = field(default=True, metadata={"before": True})

    goal_distance: Weight = 1.0
    face: Weight = 0.2
    arrive: Weight = 2.0
    stable: Weight = 0.5
    action_rate: Weight = -0.01
    command_rate: Weight = -0.2
    command_acceleration: Weight = -0.1
    contact_force: Weight = -0.01
    laziness: Weight = -0.5
    alive: Weight = 0.1
    map_radius: Positive = 8.0  # m, R_map: the tile's length
    curve_gain: Weight = 1.0  # a of the goal distance
    curve_rate: Positive = 3.0  # b of the goal distance
    arrive_base: Weight = 1.0  # b_0
    arrive_speed: Weight = 2.0  # b_1: bonus for arriving early
    joint_speed_weight: NotNegative = 0.05  # beta of eta_t
    height_scale: Positive = 0.01  # m^2, sigma_z
    force_threshold: float = 1.0  # N, F_th
    lazy_speed: float = 0.1  # m/s, v_th


Gait = Literal["trot", "pronk", "pace", "bound"]
_GAITS: tuple[Gait, ...] = get_args(Gait)


@dataclass(frozen=True)
class HighLevelConfig:
    """The decision-level MDP (Sec. IV-B) and its curriculum (Sec. IV-C)."""

    decimation: Count = 5  # control steps per decision: 10 Hz; 1 is the paper's synchronous loop
    cues: Literal["both", "semantic", "geometric", "none"] = "both"
    # Gaits that the gait channel chooses from; each takes an equal share of the channel's range.
    gaits: tuple[Gait, ...] = field(default=_GAITS, metadata={"before": _GAITS})
    # What the high policy decides: all commands, or only the velocities and the gait. The remaining
    # commands then stay at their defaults, or at the nearest value that ``commands`` allows.
    behaviour: Literal["all", "velocities"] = field(default="all", metadata={"before": "all"})
    # What the high policy observes of the gait clock. The paper's phi is the sine alone, which in
    # pronk does not distinguish touch-down from lift-off.
    clock: Literal["sine", "both"] = field(default="both", metadata={"before": "sine"})
    # Layout of the height probes of the geometric cue, see ``tdgc.tasks.probes``.
    probes: Literal["graded", "lines", "staggered"] = field(
        default="graded", metadata={"before": "staggered"}
    )
    # Whether the age of the probe heights is observed, as from a sensor's time stamp.
    probe_age: bool = field(default=True, metadata={"before": False})
    # Whether the speed of approach to the goal since the last decision is observed. A leap is timed
    # by the trunk's speed, which no sensor on the robot measures (docs/experiments.md).
    closing_speed: bool = field(default=True, metadata={"before": False})
    # Share of training episodes whose family is given as unknown, so that the policy must rely on
    # the probes alone: practice for tiles of several families, or of a family without a name.
    unknown_share: Share = 0.2
    # Gap has twice the robots of any other family, since leaps must be precise to a few
    # centimetres. Clutter stands for ground that no other family resembles, ditches for trenches
    # before or behind other ground (docs/experiments.md).
    families: tuple[str, ...] = (
        "rough", "pillar", "stair", "gap", "gap", "tilt", "clutter", "ditches"
    )  # fmt: skip
    levels: Count = 11  # L_max: levels 0..10
    # How levels are chosen in training: by each robot's performance, as in the paper; drawn
    # uniformly for each episode; or always the hardest.
    curriculum: Literal["performance", "uniform", "hardest"] = field(
        default="performance", metadata={"before": "performance"}
    )
    # m, depth of training trenches on level 0; they deepen with the level, see
    # ``tdgc.tasks.tiles.shallow``. null: as deep as in the benchmark on every level.
    shallowest_trench: Positive | None = field(default=None, metadata={"before": None})
    window: Count = 4  # W episodes: few, since one per robot takes minutes on two cores
    threshold: Count = 3  # S successes among them
    # Robots start spread over ``first_levels`` levels, the lowest of which is ``first_level``.
    first_level: Whole = field(default=0, metadata={"before": 0})
    first_levels: Count = 1
    episode_seconds: Positive = 20.0  # T_max (benchmark)
    hold_seconds: NotNegative = 2.0  # s for which an episode continues after the goal is reached
    action_limit: Positive = 1.0  # a_max of the decoder
    # Bounds of the decoder; null: the ranges that the low policy was trained on.
    commands: CommandRanges | None = None
    rewards: HighRewardConfig = field(default_factory=HighRewardConfig)
    randomisation: RandomisationConfig = field(default_factory=RandomisationConfig)
