"""The execution-level MDP (paper Sec. IV-A)."""

import dataclasses
from dataclasses import dataclass, field
from typing import Literal

from tdgc.config.settings import (
    Count,
    GaitShares,
    NotNegative,
    Positive,
    Range,
    Share,
    SharesRange,
    Weight,
)
from tdgc.config.sim import CommandRanges, PhysicsConfig, RandomisationConfig, RobotConfig


@dataclass(frozen=True)
class LowRewardConfig:
    """Weights of the low policy's reward, one per term of ``tdgc.tasks.low_rewards.LOW_TERMS``, and
    its constants.

    Penalties are those of Walk These Ways (its published table), some changed by up to a factor of
    two where the first policies showed the need (docs/experiments.md). ``power`` is our own; it is
    multiplied by the commanded ``power_weight``.
    """

    track_lin_vel: Weight = 2.0
    track_yaw_rate: Weight = 1.5
    body_height: Weight = -14.0
    orientation: Weight = -4.0
    raibert_foothold: Weight = -10.0
    swing_height: Weight = -30.0
    swing_contact_force: Weight = -8.0
    stance_foot_speed: Weight = -4.0
    target_rate: Weight = -0.1
    target_acceleration: Weight = -0.1
    action_rate: Weight = -0.01
    foot_slip: Weight = -0.04
    leg_collision: Weight = -3.0
    joint_limits: Weight = -6.0
    vertical_velocity: Weight = -0.02
    tilt_rate: Weight = -0.001
    # Our own, with twice the weight of ``orientation``. Hopping on all four feet at once is
    # unstable in pitch: two of three low policies learned a pronk in which, above 0.9 m/s, the
    # trunk pitched nose down by up to 0.5 rad at every other landing (docs/experiments.md).
    nodding: Weight = field(default=-8.0, metadata={"before": 0.0})
    joint_torques: Weight = -1e-4
    joint_speeds: Weight = -1e-4
    joint_accelerations: Weight = -2.5e-7
    power: Weight = -1.0
    # sigma_lin, sigma_yaw of the paper. Walk These Ways has 0.25 for both, with weights of 1 and
    # 0.5; with those the policy walked at only 0.3-0.8 of the commanded velocity.
    sigma_lin: Positive = 0.1  # m^2/s^2
    sigma_yaw: Positive = 0.15  # rad^2/s^2
    # These four are of Walk These Ways, too.
    swing_force_scale: Positive = field(default=100.0, metadata={"before": 100.0})  # N^2
    stance_speed_scale: Positive = field(default=10.0, metadata={"before": 10.0})  # m^2/s^2
    # N, above which a contact of a leg above its foot counts.
    leg_force: NotNegative = field(default=0.1, metadata={"before": 0.1})
    # Share of a joint's range, around its middle, without a penalty.
    soft_limit: Share = field(default=0.9, metadata={"before": 0.9})
    # Share of the penalties that remains once a gait's velocity ranges have grown to their full
    # width. Full penalties teach the gait, but later they reward walking more slowly than commanded
    # (docs/experiments.md).
    walking_penalty: float = field(default=0.5, metadata={"before": 1.0})
    # The same share on tiles that are not flat. With full penalties, standing before a step pays
    # more than climbing it.
    terrain_penalty: float = 0.4


@dataclass(frozen=True)
class CommandDrawConfig:
    """Commands drawn in training, and the curriculum that widens each gait's velocity ranges.

    Commands are uniform within their ranges. Free commands are those that do not cross a tile.
    """

    # Of free commands. Most crossings are in trot.
    gaits: GaitShares = (0.2, 0.2, 0.3, 0.3)
    standing: Share = 0.1  # with zero velocity: the robot steps on the spot at every goal
    # Share of free commands that leap: pronk with a stride as long as the trunk, so that front and
    # rear feet land on the same lines and a trench fits between two of these. Among uniform draws
    # such commands are too rare: commanded 0.86 m/s at 2 Hz, the robot reached 0.5 m/s.
    leaps: Share = 0.05
    leap_vx: SharesRange = (0.85, 1.0)  # shares of the range: 0.9-1.2 m/s
    leap_frequency: SharesRange = (0.0, 0.375)  # shares of the range: 2-2.75 Hz
    # Share of free commands that repeat one at which a robot fell. Most commands cause no fall, so
    # those still to be learned are rare in uniform draws: a third of the robots that walked
    # backward in a slow trot fell within six seconds.
    retries: Share = field(default=0.15, metadata={"before": 0.0})
    growth: Share = 0.05  # of the full ranges, added when a gait was tracked well
    # Control steps (4 s) after which a gait with a quarter of the robots is judged.
    growth_steps: Count = 200
    # To grow, a gait must earn at least these shares of the reward for perfect tracking. At the
    # default sigmas they stand for errors of about 0.26 m/s and 0.32 rad/s.
    growth_velocity: Share = 0.5
    growth_yaw_rate: Share = 0.5
    # Likewise for the share of feet in contact as scheduled: the gait comes before speed. At 0.8
    # bound never left its initial ranges, since its rear feet lift late, and then undershot every
    # faster command.
    growth_contact: Share = 0.7


@dataclass(frozen=True)
class CrossingConfig:
    """Training episodes that cross a tile from platform to platform, and how levels follow them.

    Crossings resemble what the high policy will command.
    """

    share: Share = 0.8  # of the episodes on tiles that are not flat; the others have free commands
    # Trot climbs best; with equal shares the worst gait limits how far levels rise.
    gaits: GaitShares = (0.8, 0.05, 0.075, 0.075)
    # Over trenches most robots leap, with planned landings (``tdgc.tasks.leaps``). In other gaits
    # they fall into the first trench; with half of the crossings in those, levels stayed below 2.
    trench_gaits: GaitShares = (0.15, 0.85, 0.0, 0.0)
    speed: Range = (0.25, 0.8)  # m/s
    leap_speed: Range = (1.0, 1.2)  # m/s, about ``tdgc.tasks.leaps.SPEED``
    facing: Share = 0.8  # face their direction of travel; the others face any direction
    heading_gain: float = 1.0  # 1/s, commanded yaw rate per rad of heading error
    # Crossings narrow the command ranges. m by which they raise the lowest swing height, at
    # difficulty 0 and 1: with feet below 9 cm a third of the robots crossed level 0 of Gap, above
    # 16 cm all of them.
    clearance: tuple[float, float] = (0.05, 0.15)
    bend: Share = 0.3  # share of the pitch and roll ranges that is left at difficulty 1
    leap_decimation: Count = 5  # control steps between decisions on a leap, as in the high policy
    landing_rate: Share = 0.002  # weight of a landing in the running mean: the last 500 count
    shallowest_trench: Positive = 0.05  # m, depth on level 0, see ``tdgc.tasks.tiles.shallow``
    demotion: Share = 0.5  # of the tile; a robot that gets less far drops a level (legged_gym)


@dataclass(frozen=True)
class LowLevelConfig:
    """The execution-level MDP (Sec. IV-A)."""

    terrain: Literal["plane", "tiles"] = "plane"
    levels: Count = 11  # in the curriculum: 0..levels-1
    # Robots start spread over levels 0..first_levels-1, or over all if there are fewer.
    first_levels: Count = field(default=3, metadata={"before": 3})
    # No Pillar: a policy that cannot see obstacles learns nothing there but collisions. Stair and
    # Gap count twice, because they are still being learned when slopes are already easy.
    families: tuple[str, ...] = ("stair", "stair", "gap", "gap", "tilt", "rough")
    episode_seconds: Positive = 20.0
    command_seconds: NotNegative = 2.5  # s between new commands and gaits; 0: one per episode
    gyro: bool = True  # adds the angular velocity of the base to the actor's observation
    command_start: Share = 0.4  # share of the velocity ranges at the start of the curriculum
    robot: RobotConfig = field(default_factory=RobotConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    commands: CommandRanges = field(default_factory=CommandRanges)
    # Configurations stored with the first policies lack these two; ``before`` is what applied to
    # them. If one of the defaults changes, its previous value must be recorded here.
    command_draw: CommandDrawConfig = field(
        default_factory=CommandDrawConfig,
        metadata={"before": dataclasses.asdict(CommandDrawConfig(retries=0.0))},
    )
    crossing: CrossingConfig = field(
        default_factory=CrossingConfig,
        metadata={"before": dataclasses.asdict(CrossingConfig(leap_speed=(0.9, 1.0)))},
    )
    rewards: LowRewardConfig = field(default_factory=LowRewardConfig)
    randomisation: RandomisationConfig = field(default_factory=RandomisationConfig)
