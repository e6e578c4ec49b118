"""The execution-level MDP (paper Sec. IV-A)."""

import dataclasses
from dataclasses import dataclass, field
from typing import Literal

from tdgc.config.settings import Count, GaitShares, NotNegative, Positive, Range, Share
from tdgc.config.sim import CommandRanges, PhysicsConfig, RandomisationConfig, RobotConfig


@dataclass(frozen=True)
class LowRewardConfig:
    """Weights of the low policy's reward, one field per term of ``tdgc.tasks.rewards.LOW_TERMS``.

    Penalties of Walk These Ways (its published table), some changed by up to a factor of two where
    the first policies showed the need (docs/experiments.md); ``power`` is ours and is multiplied by
    the commanded ``power_weight``.
    """

    track_lin_vel: float = 2.0
    track_yaw_rate: float = 1.5
    body_height: float = -14.0
    orientation: float = -4.0
    raibert_foothold: float = -10.0
    swing_height: float = -30.0
    swing_contact_force: float = -8.0
    stance_foot_speed: float = -4.0
    target_rate: float = -0.1
    target_acceleration: float = -0.1
    action_rate: float = -0.01
    foot_slip: float = -0.04
    leg_collision: float = -3.0
    joint_limits: float = -6.0
    vertical_velocity: float = -0.02
    tilt_rate: float = -0.001
    # Ours, weighed twice as much as the orientation. Hopping on all four feet at once is unstable
    # in pitch: two of three low policies learned pronk whose trunk was nose down by up to 0.5 rad
    # at every other landing beyond 0.9 m/s (docs/experiments.md).
    nodding: float = field(default=-8.0, metadata={"before": 0.0})
    joint_torques: float = -1e-4
    joint_speeds: float = -1e-4
    joint_accelerations: float = -2.5e-7
    power: float = -1.0
    # sigma_lin, sigma_yaw of the paper: Walk These Ways has 0.25 for both and weights
    # of 1 and 0.5; with those the policy undershot: it walked at 0.3-0.8 of the commanded velocity.
    sigma_lin: Positive = 0.1  # m^2/s^2
    sigma_yaw: Positive = 0.15  # rad^2/s^2
    # Share of the penalties that counts once a gait follows commands over its full ranges: all of
    # them teach the gait, but then they ask for walking slower than told (docs/experiments.md).
    walking_penalty: float = field(default=0.5, metadata={"before": 1.0})
    # The same on a tile that is not flat: with all of them, standing before a step pays more than
    # climbing it.
    terrain_penalty: float = 0.4


@dataclass(frozen=True)
class CommandDrawConfig:
    """Commands drawn in training, uniform within their ranges, and the curriculum that widens the
    velocity ranges of each gait."""

    # Of free commands, which lead anywhere. Trot is what crossings are mostly made in.
    gaits: GaitShares = (0.2, 0.2, 0.3, 0.3)
    standing: Share = 0.1  # with no velocity: stepping on the spot is asked for at every goal
    # Free commands that leap: pronk with a stride as long as the trunk, whose front and rear feet
    # land on the same lines, so that a trench fits between two of them. Drawn evenly, such commands
    # are too rare: of 0.86 m/s at 2 Hz the robot did 0.5.
    leaps: Share = 0.05
    leap_vx: Range = (0.85, 1.0)  # shares of the range: 0.9-1.2 m/s
    leap_frequency: Range = (0.0, 0.375)  # shares of the range: 2-2.75 Hz
    # Free commands that a robot fell at before. Most lead to no fall, so what is left to learn is
    # rare: a third of the robots that walked backward in slow trot fell over within six seconds.
    retries: Share = field(default=0.15, metadata={"before": 0.0})
    growth: Share = 0.05  # of the whole ranges, when a gait was tracked well
    growth_steps: Count = 200  # control steps of all robots, 4 s, after which a gait is judged
    # Shares of what perfect tracking earns: errors of about 0.26 m/s and 0.32 rad/s at the default
    # sigmas.
    growth_velocity: Share = 0.5
    growth_yaw_rate: Share = 0.5
    # Share of feet in contact as desired: speed comes after gait. At 0.8 bound never left its first
    # ranges, since its rear feet lift late, and then undershot every faster command.
    growth_contact: Share = 0.7


@dataclass(frozen=True)
class CrossingConfig:
    """Training episodes that cross a tile from platform to platform, as the high policy will ask
    for, and the levels that rise with them."""

    share: Share = 0.8  # of the episodes on tiles that are not flat; the others have free commands
    # Trot climbs best, and with all gaits alike the worst one decides how far levels rise.
    gaits: GaitShares = (0.8, 0.05, 0.075, 0.075)
    # Over trenches most leap, their landings planned (``tdgc.tasks.leaps``). Other gaits fall into
    # the first trench, and with half of the crossings in them levels stayed below 2.
    trench_gaits: GaitShares = (0.15, 0.85, 0.0, 0.0)
    speed: Range = (0.25, 0.8)  # m/s
    leap_speed: Range = (1.0, 1.2)  # m/s, about ``tdgc.tasks.leaps.SPEED``
    facing: Share = 0.8  # face where they go, the others any way
    heading_gain: float = 1.0  # 1/s, yaw rate asked for per rad of heading error
    # What a crossing leaves of the command ranges: m added to the least swing height, at difficulty
    # 0 and 1. With feet below 9 cm a third crossed level 0 of Gap where all did above 16 cm.
    clearance: tuple[float, float] = (0.05, 0.15)
    bend: Share = 0.3  # of the pitch and roll ranges at difficulty 1
    leap_decimation: Count = 5  # control steps between decisions on a leap: the high policy's
    landing_rate: Share = 0.002  # of a landing in what is known of them: the last 500 count
    shallowest_trench: Positive = 0.05  # m deep on level 0, see ``tdgc.tasks.tiles.shallow``
    demotion: Share = 0.5  # of the tile; who gets less far goes down a level (legged_gym)


@dataclass(frozen=True)
class LowLevelConfig:
    """The execution-level MDP (Sec. IV-A)."""

    terrain: Literal["plane", "tiles"] = "plane"
    levels: Count = 11  # of the curriculum: 0..levels-1
    # Robots begin spread over levels 0..first_levels-1.
    first_levels: Count = field(default=3, metadata={"before": 3})
    # Pillar is left out: a policy that sees no obstacle can learn nothing of it but bumps. Stairs
    # and trenches, twice as many, are what it is still learning when slopes are easy.
    families: tuple[str, ...] = ("stair", "stair", "gap", "gap", "tilt", "rough")
    episode_seconds: Positive = 20.0
    command_seconds: NotNegative = 2.5  # a new command and gait that often; 0: none but the first
    gyro: bool = True  # adds the angular velocity of the base to the actor's observation
    command_start: Share = 0.4  # share of the velocity ranges at the start of the curriculum
    robot: RobotConfig = field(default_factory=RobotConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    commands: CommandRanges = field(default_factory=CommandRanges)
    # These two stood in the code before they were configuration. Where a default of theirs changes,
    # what it was must be written here.
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
