"""Configuration: frozen dataclasses, one per section of the paper, with a JSON round trip.

A setting that came later than the first policies says in its metadata what it was ``before``.

Every number that a user may want to change lives here, with its unit and where it comes from.
``with_overrides`` applies ``key=value`` pairs, ``to_dict``/``from_dict`` go to and from JSON.
Unknown keys, values of the wrong type and values outside the allowed range raise ``ConfigError``.
"""

from __future__ import annotations

import dataclasses
import json
import math
import reprlib
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

from tdgc.errors import InputError

Range = typing.Annotated[tuple[float, float], "low <= high"]
Share = typing.Annotated[float, "0 to 1"]
#: Of trot, pronk, pace and bound.
GaitShares = typing.Annotated[tuple[Share, Share, Share, Share], "1 together"]


class ConfigError(InputError):
    """A configuration that cannot be used; the message is one line."""


@dataclass(frozen=True)
class RobotConfig:
    """The robot and its joint interface (paper Sec. IV-A, q* = q0 + alpha clip(a)).

    Masses, lengths and joint limits are read from the URDF (``tdgc.sim.geometry``); leg order FL,
    FR, RL, RR everywhere and joints hip, thigh, calf within a leg.
    """

    urdf: str = "urdf/quadruped.urdf"  # path, from here or from the repository
    kp: float = 20.0  # N m/rad (benchmark, Walk These Ways)
    kd: float = 0.6  # N m s/rad (benchmark: 0.5-0.7)
    torque_limit: tuple[float, float, float] = (23.7, 23.7, 35.5)  # N m, hip thigh calf (Go1)
    speed_limit: tuple[float, float, float] = (30.0, 30.0, 20.0)  # rad/s, hip thigh calf (Go1)
    nominal_hip: float = 0.1  # rad, outward on both sides (Walk These Ways)
    nominal_thigh: tuple[float, float] = (0.8, 1.0)  # rad, front and rear (Walk These Ways)
    nominal_calf: float = -1.5  # rad (Walk These Ways)
    action_scale: float = 0.25  # rad per unit action: alpha in the paper (Walk These Ways)
    hip_scale: float = 0.5  # hips move half as far per unit action (Walk These Ways)
    # a_max in the paper: 4 * 0.25 = 1 rad either side of nominal. Random targets over 1.5 rad drive
    # feet through the ground at the default physics step, over 1 rad they do not.
    action_limit: float = 4.0
    base_height: float = 0.30  # m, standing (benchmark)
    # q0 follows the commanded behaviour (``robot.commanded_pose``); the paper's q0 is fixed.
    commanded_pose: bool = True
    # q0 walks as well: it carries the robot's weight and its feet run along Raibert's footholds
    # (``robot.walking_pose``). On legs this soft a pose without its load hangs 5 cm low, and its
    # swing feet drag: at zero actions feet asked for 8 cm in trot do not leave the ground.
    commanded_gait: bool = field(default=True, metadata={"before": False})
    # Gait cycles after a start or a change of gait over which q0's swing grows to what is asked:
    # of 21 falls in walking with random changes of gait 19 came within 0.7 s of one.
    swing_ramp: float = 1.0
    # Hz and gait cycles: a gait begins no slower than this, and is as slow as asked after so many.
    # Falls in 10 minutes with a random gait every 2 s: 2.6 without, 1.4, 1.0 and 0.8 with 3.0, 3.2
    # and 3.5 Hz over 2 cycles, 1.6 with 3.0 Hz over one (docs/experiments.md).
    start_frequency: float = 3.5
    start_cycles: float = 2.0
    # rad that joint targets keep from the joint limits; None lets them run past. A joint's zero may
    # be off by as much (``RandomisationConfig.joint_offset``), so that no real driver clips.
    joint_margin: float | None = field(default=0.02, metadata={"before": None})


@dataclass(frozen=True)
class PhysicsConfig:
    """Bullet's settings (benchmark, Physics)."""

    control_dt: float = 0.02  # s: 50 Hz control
    substeps: int = 8  # 2.5 ms: at most 0.1 % of foot samples sink more than 1 cm
    # Physics steps that a joint torque is held for: 200 Hz joint control (benchmark). It saves 8 %
    # of the time of a control step and sinks no deeper (docs/experiments.md).
    hold: int = field(default=2, metadata={"before": 1})
    solver_iterations: int = 10  # the setting the sinking test was made with
    friction: float = 0.8  # foot on ground, nominal (benchmark)

    @property
    def dt(self) -> float:
        """Physics step in s."""
        return self.control_dt / self.substeps

    @property
    def joint_steps(self) -> int:
        """How often joint torques are computed per control step.

        Raises:
            ConfigError: ``hold`` does not divide ``substeps``.
        """
        if self.hold < 1 or self.substeps % self.hold:
            raise ConfigError(
                f"'physics.hold' must divide substeps, {self.substeps}, not {self.hold}"
            )
        return self.substeps // self.hold


@dataclass(frozen=True)
class CommandRanges:
    """Lower and upper bound of each continuous command: l_j and u_j of the decoder (Sec. IV-B).

    Ranges of Walk These Ways at the start of its own curriculum, narrowed where a foot could not
    follow at the step frequencies used; body height so far that pronk and bound, which sink in
    at each landing, stay clear of what counts as a fall (at -0.1 m three in four fell).
    """

    vx: Range = (-1.0, 1.0)  # m/s, forward, in the heading frame
    vy: Range = (-0.6, 0.6)  # m/s, left, in the heading frame
    yaw_rate: Range = (-1.0, 1.0)  # rad/s, left turn positive
    body_height: Range = (-0.03, 0.05)  # m, added to the standing height of 0.30 m
    frequency: Range = (2.0, 4.0)  # Hz, gait cycles a second
    duration: Range = (0.4, 0.6)  # 1, duty factor: share of a cycle in stance
    swing_height: Range = (0.03, 0.24)  # m, apex of the foot above the ground
    pitch: Range = (-0.3, 0.3)  # rad, nose down positive
    roll: Range = (-0.2, 0.2)  # rad, left side up positive
    stance_width: Range = (0.20, 0.35)  # m, between left and right footholds
    stance_length: Range = (0.33, 0.43)  # m, between front and rear footholds
    power_weight: Range = (0.0, 0.002)  # 1/W, the auxiliary: price of mechanical power


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
    raibert_foothold: float = -6.0
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
    joint_torques: float = -1e-4
    joint_speeds: float = -1e-4
    joint_accelerations: float = -2.5e-7
    power: float = -1.0
    # sigma_lin, sigma_yaw of the paper: Walk These Ways has 0.25 for both and weights
    # of 1 and 0.5; with those the policy undershot: it walked at 0.3-0.8 of the commanded velocity.
    sigma_lin: float = 0.1  # m^2/s^2
    sigma_yaw: float = 0.15  # rad^2/s^2
    # Share of the penalties that counts once a gait follows commands over its full ranges: all of
    # them teach the gait, but then they ask for walking slower than told (docs/experiments.md).
    walking_penalty: float = field(default=0.5, metadata={"before": 1.0})
    # The same on a tile that is not flat: with all of them, standing before a step pays more than
    # climbing it.
    terrain_penalty: float = 0.4


@dataclass(frozen=True)
class RandomisationConfig:
    """Domain randomisation, drawn at each reset unless a unit says otherwise.

    ``scale`` multiplies the width of every range about its nominal value: 0 switches all off.
    """

    scale: float = 1.0
    friction: Range = (0.4, 1.25)  # foot on ground
    payload: Range = (-1.0, 3.0)  # kg on the trunk (Walk These Ways)
    motor_strength: Range = (0.85, 1.1)  # times torque limits and gains
    joint_offset: Range = (-0.02, 0.02)  # rad, error of the joint zero (Walk These Ways)
    # kg m^2 about each joint, of its motor's rotor: MuJoCo's models of such robots have 0.01.
    armature: Range = field(default=(0.0, 0.015), metadata={"before": (0.0, 0.0)})
    # N m, dry friction of each joint; those models have 0.2.
    joint_friction: Range = field(default=(0.0, 0.3), metadata={"before": (0.0, 0.0)})
    latency: Range = (0.0, 0.03)  # s between decision and effect (real robots: about 30 ms)
    push_speed: float = 0.75  # m/s, largest horizontal push (benchmark's `pushes`)
    push_interval: Range = (3.0, 8.0)  # s between pushes
    noise_gravity: float = 0.02  # half-width of uniform noise
    noise_joint_angle: float = 0.01  # rad
    # Walk These Ways has 0.05 and 1.5 rad/s, and 30 steps of history to average them over. An actor
    # that sees one step needs its joint speeds to tell how fast the trunk moves.
    noise_joint_speed: float = 0.3  # rad/s
    noise_gyro: float = field(default=0.1, metadata={"before": 0.0})  # rad/s
    # The high policy's height probes (benchmark's `noise`).
    noise_probes: float = field(default=0.02, metadata={"before": 0.0})  # m
    # Share of the robots, drawn for each episode, whose probes are a decision late.
    probe_delay: float = field(default=0.5, metadata={"before": 0.0})


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
    leap_vx: Range = (0.85, 1.0)  # shares of the range: 0.7-1 m/s
    leap_frequency: Range = (0.0, 0.375)  # shares of the range: 2-2.75 Hz
    growth: float = 0.05  # of the whole ranges, when a gait was tracked well
    growth_steps: int = 200  # control steps of all robots, 4 s, after which a gait is judged
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
    leap_speed: Range = (0.9, 1.0)  # m/s, up to ``tdgc.tasks.leaps.SPEED``
    facing: Share = 0.8  # face where they go, the others any way
    heading_gain: float = 1.0  # 1/s, yaw rate asked for per rad of heading error
    # What a crossing leaves of the command ranges: m added to the least swing height, at difficulty
    # 0 and 1. With feet below 9 cm a third crossed level 0 of Gap where all did above 16 cm.
    clearance: tuple[float, float] = (0.05, 0.15)
    bend: Share = 0.3  # of the pitch and roll ranges at difficulty 1
    leap_decimation: int = 5  # control steps between two decisions on a leap: as the high policy's
    landing_rate: float = 0.002  # of a landing in what is known of them: the last 500 count
    shallowest_trench: float = 0.05  # m deep on level 0, see ``tdgc.tasks.tiles.shallow``
    demotion: Share = 0.5  # of the tile; who gets less far goes down a level (legged_gym)


@dataclass(frozen=True)
class LowLevelConfig:
    """The execution-level MDP (Sec. IV-A)."""

    terrain: Literal["plane", "tiles"] = "plane"
    levels: int = 11  # of the curriculum: 0..levels-1
    # Robots begin spread over levels 0..first_levels-1.
    first_levels: int = field(default=3, metadata={"before": 3})
    # Pillar is left out: a policy that sees no obstacle can learn nothing of it but bumps. Stairs
    # and trenches, twice as many, are what it is still learning when slopes are easy.
    families: tuple[str, ...] = ("stair", "stair", "gap", "gap", "tilt", "rough")
    episode_seconds: float = 20.0
    command_seconds: float = 2.5  # a new command and gait that often
    gyro: bool = True  # adds the angular velocity of the base to the actor's observation
    command_start: float = 0.4  # share of the velocity ranges at the start of the curriculum
    robot: RobotConfig = field(default_factory=RobotConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    commands: CommandRanges = field(default_factory=CommandRanges)
    # These two stood in the code before they were configuration. Where a default of theirs changes,
    # what it was must be written here.
    command_draw: CommandDrawConfig = field(
        default_factory=CommandDrawConfig,
        metadata={"before": dataclasses.asdict(CommandDrawConfig())},
    )
    crossing: CrossingConfig = field(
        default_factory=CrossingConfig, metadata={"before": dataclasses.asdict(CrossingConfig())}
    )
    rewards: LowRewardConfig = field(default_factory=LowRewardConfig)
    randomisation: RandomisationConfig = field(default_factory=RandomisationConfig)


@dataclass(frozen=True)
class HighRewardConfig:
    """Weights and constants of the high policy's reward (Sec. IV-B), one weight per term.

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
    map_radius: float = 8.0  # m, R_map: the tile's length
    curve_gain: float = 1.0  # a of the goal distance
    curve_rate: float = 3.0  # b of the goal distance
    goal_radius: float = 0.5  # m, d_0: the paper's reach distance
    arrive_base: float = 1.0  # b_0
    arrive_speed: float = 2.0  # b_1: what an early arrival adds
    joint_speed_weight: float = 0.05  # beta of eta_t
    height_scale: float = 0.01  # m^2, sigma_z
    force_threshold: float = 1.0  # N, F_th
    lazy_speed: float = 0.1  # m/s, v_th


_GAITS: tuple[Literal["trot", "pronk", "pace", "bound"], ...] = ("trot", "pronk", "pace", "bound")


@dataclass(frozen=True)
class HighLevelConfig:
    """The decision-level MDP (Sec. IV-B) and its curriculum (Sec. IV-C)."""

    decimation: int = 5  # control steps a decision: 10 Hz; 1 is the paper's synchronous loop
    cues: Literal["both", "semantic", "geometric", "none"] = "both"
    # Gaits that the gait channel chooses from, in equal shares of its range.
    gaits: tuple[Literal["trot", "pronk", "pace", "bound"], ...] = field(
        default=_GAITS, metadata={"before": _GAITS}
    )
    # What it decides: all commands, or the velocities and the gait. The other commands then stay at
    # their defaults, or as near as ``commands`` lets them.
    behaviour: Literal["all", "velocities"] = field(default="all", metadata={"before": "all"})
    # Where the heights of the geometric cue are probed, see ``tdgc.tasks.probes``.
    probes: Literal["lines", "staggered"] = field(default="lines", metadata={"before": "staggered"})
    # Share of the robots in training that are told an unknown family, so that the probes alone have
    # to do: tiles of several families, or of none that has a name.
    unknown_share: float = 0.2
    families: tuple[str, ...] = ("rough", "pillar", "stair", "gap", "tilt")
    levels: int = 11  # L_max: levels 0..10
    # How levels are chosen in training: by each robot's performance, as the paper has it; drawn
    # uniformly for each episode; or always the hardest.
    curriculum: Literal["performance", "uniform", "hardest"] = field(
        default="performance", metadata={"before": "performance"}
    )
    # m: in training trenches are this deep on level 0 and deepen from there, see
    # ``tdgc.tasks.tiles.shallow``; null: all of them are as deep as in the benchmark.
    shallowest_trench: float | None = field(default=None, metadata={"before": None})
    window: int = 4  # W episodes: short, since an episode of every robot takes minutes on two cores
    threshold: int = 3  # S successes of them
    first_levels: int = 1  # robots begin spread over levels 0..first_levels-1
    episode_seconds: float = 20.0  # T_max (benchmark)
    hold_seconds: float = 2.0  # an episode goes on that long after the goal was reached
    action_limit: float = 1.0  # a_max of the decoder
    # The decoder's bounds; all that the low policy was trained on where there are none.
    commands: CommandRanges | None = None
    rewards: HighRewardConfig = field(default_factory=HighRewardConfig)
    randomisation: RandomisationConfig = field(default_factory=RandomisationConfig)


@dataclass(frozen=True)
class PPOConfig:
    """PPO and the networks of the low policy; see docs/experiments.md for what was compared."""

    # Times the mean standard deviation of the actions: as exploration shrinks, the same step of the
    # mean moves the policy further (the clipped share rose from 0.2 to 0.4 at a constant rate).
    learning_rate: float = 6e-4
    final_learning_rate: float = 1e-5  # reached linearly at the last step
    n_steps: int = 32  # control steps a robot between updates
    batch_size: int = 960  # a quarter of a rollout
    n_epochs: int = 5
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    ent_coef: float = 0.0005
    vf_coef: float = 0.5
    max_grad_norm: float = 1.0
    initial_std: float = 1.0
    # SB3's 1e-5 swallows the critic's gradients: rewards carry dt and are below 0.03 a step.
    adam_eps: float = 1e-8
    actor: tuple[int, ...] = (256, 192)
    critic: tuple[int, ...] = (256, 128)
    activation: Literal["elu", "relu", "tanh"] = "elu"
    mirror: bool = True  # policy and value exactly left-right symmetric


@dataclass(frozen=True)
class CalibrationConfig:
    """Calibration of the low policy (``tdgc.calibration``), the end of a run of train_low.py."""

    robots: int = 4800  # that walk to be measured; 0 leaves the policy as it is
    turns: int = 60  # of 60 control steps each, in which the copy learns


@dataclass(frozen=True)
class LowTrainConfig:
    """A run of train_low.py: robots on a plane and on terrain, then calibration."""

    seed: int = 42  # the paper's
    n_envs: int = 120
    workers: int = 2
    steps: int = 32_000_000  # of reinforcement learning, altogether
    # Of the robots, on the plane, where a step costs less than half of one on a tile; the others
    # cross tiles.
    plane_share: float = 0.6
    log_steps: int = 100_000
    checkpoint_seconds: float = 30.0  # with the update under way, less than a minute is lost
    env: LowLevelConfig = field(default_factory=LowLevelConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    calibration: CalibrationConfig = field(
        default_factory=CalibrationConfig, metadata={"before": {"robots": 0, "turns": 60}}
    )


@dataclass(frozen=True)
class RecurrentPPOConfig:
    """RecurrentPPO and the networks of the high policy: the paper's table but for the first two."""

    # The paper's 1e-4 needs more updates than two cores give. Above 3e-4 two fifths of the samples
    # were clipped.
    learning_rate: float = 3e-4
    final_learning_rate: float = 5e-5  # reached linearly at the last step
    n_steps: int = 24  # decisions a robot between updates
    minibatches: int = 4
    n_epochs: int = 5
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    ent_coef: float = 1e-4
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    # Leaps that are timed to 0.1 of a cycle do not survive more: at 0.15 the teacher's success on
    # level 8 of Gap fell from 1.0 to 0.6.
    initial_std: float = 0.1
    # of the gait channel: a gait is 0.5 wide, so that noise changes it once in a thousand decisions
    initial_gait_std: float = 0.08
    # Decisions that the noise of the gait channel is held for, within an episode: what a gait is
    # worth shows in a second, not in a tenth of one.
    gait_hold: int = field(default=1, metadata={"before": 1})
    # Bonus on the entropy of the gait alone, which falls linearly to nothing at the last step.
    gait_ent_coef: float = field(default=0.0, metadata={"before": 0.0})
    # Units of both LSTMs; null for a feed-forward policy. With 128 units each an update takes twice
    # as long, and what is learned is no better.
    lstm: int | None = 64
    mirror: bool = True  # policy and value exactly left-right symmetric
    actor: tuple[int, ...] = (64,)
    critic: tuple[int, ...] = (64,)


@dataclass(frozen=True)
class ImitationConfig:
    """Imitation of the scripted teacher, with which a run of train_high.py begins."""

    steps: int = 240_000  # decisions altogether; 0 leaves everything to reinforcement learning
    learning_rate: float = 1e-3
    n_epochs: int = 8


@dataclass(frozen=True)
class HighTrainConfig:
    """A run of train_high.py."""

    seed: int = 42
    n_envs: int = 100
    workers: int = 2
    steps: int = 1_200_000  # decisions altogether: an hour of two cores
    log_steps: int = 24_000
    checkpoint_seconds: float = 30.0  # with the update under way, less than a minute is lost
    start_speed: float = 0.5  # m/s: before any training it walks straight on in the default gait
    # m, of its feet then; 0.08 is the default of Walk These Ways.
    start_swing: float = field(default=0.08, metadata={"before": 0.08})
    # The low policy: by default what train_low.py left in runs/low, or else the shipped one.
    low: str | None = None
    env: HighLevelConfig = field(default_factory=HighLevelConfig)
    imitation: ImitationConfig = field(default_factory=ImitationConfig)
    ppo: RecurrentPPOConfig = field(default_factory=RecurrentPPOConfig)


#: ``train_high.py --preset``: assignments before those of the flags. ``paper`` is the paper's
#: hyperparameter table and its synchronous loop.
PRESETS: dict[str, tuple[str, ...]] = {
    "default": (),
    "paper": (
        "seed=42",
        "n_envs=100",
        "steps=48000000",  # 20,000 updates
        "env.decimation=1",
        "imitation.steps=0",
        "ppo.initial_std=0.3",
        "ppo.initial_gait_std=0.15",
        "ppo.n_steps=24",
        "ppo.learning_rate=1e-4",
        "ppo.final_learning_rate=1e-4",
        "ppo.ent_coef=1e-4",
        "ppo.gamma=0.99",
        "ppo.gae_lambda=0.95",
        "ppo.clip_range=0.2",
        "ppo.n_epochs=5",
        "ppo.minibatches=4",
        "ppo.lstm=128",
        "ppo.mirror=false",
        "ppo.actor=[128]",
        "ppo.critic=[128]",
        "env.unknown_share=0",
    ),
}

#: ``train_high.py --no-teacher``: what reinforcement learning alone needs. Its noise has to find
#: what the teacher would have shown.
NO_TEACHER: tuple[str, ...] = (
    "imitation.steps=0",
    "ppo.initial_std=0.3",
    "ppo.initial_gait_std=0.4",
    "ppo.learning_rate=5e-4",
    "env.unknown_share=0",
    # With feet at 0.08 m it reached 67 % of the goals on Stair, with feet as high as gp's 98.5 %.
    "start_swing=0.19",
    # Standing at the start must not pay. With distances as shares of the tile's 8 m it is worth
    # more than walking on once 0.086 falls a second are to be expected, and the untrained policy
    # has 0.08; as shares of the distance between start and goal, from 0.24 on.
    "env.rewards.map_radius=6.5",
    # A trench of 60 cm ends whatever is tried at it.
    "env.shallowest_trench=0.05",
    # A second of a gait shows what it is worth. A bonus of the size that PPO takes for discrete
    # actions keeps the gaits that easy levels do not need until hard ones do.
    "ppo.gait_hold=10",
    "ppo.gait_ent_coef=0.01",
)


Config = TypeVar("Config")


def to_dict(config: Any) -> dict[str, Any]:
    """Nested plain dict of a configuration, ready for JSON (tuples become lists)."""
    return typing.cast(dict[str, Any], json.loads(json.dumps(dataclasses.asdict(config))))


def read_json(path: Path) -> Any:
    """What a JSON file holds.

    Raises:
        ConfigError: a file that cannot be read or is no JSON, or a key that stands twice.
    """

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        table = dict(pairs)
        if len(table) < len(pairs):
            keys = [key for key, _ in pairs]
            twice = next(key for key in keys if keys.count(key) > 1)
            raise ConfigError(f"{path}: the key '{twice}' stands twice")
        return table

    try:
        return json.loads(path.read_text(encoding="utf-8"), object_pairs_hook=unique)
    except ConfigError:
        raise
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not a JSON file") from error


def from_dict(cls: type[Config], data: Mapping[str, Any], where: str = "") -> Config:
    """Build ``cls`` from a plain dict; missing keys keep their defaults.

    Raises:
        ConfigError: a key that ``cls`` does not have, or a value of the wrong type.
    """
    if not isinstance(data, Mapping):
        shown = reprlib.repr(data)
        raise ConfigError(f"{where or cls.__name__} must be a table of keys, not {shown}")
    hints = typing.get_type_hints(cls, include_extras=True)
    names = [f.name for f in dataclasses.fields(cls)]  # type: ignore[arg-type]
    values = {}
    for key, value in data.items():
        path = f"{where}.{key}" if where else str(key)
        if key not in names:
            raise ConfigError(f"unknown configuration key '{path}'; allowed: {', '.join(names)}")
        values[key] = _coerce(hints[key], value, path)
    return cls(**values)


def recorded(cls: type[Config], data: Mapping[str, Any], source: object) -> Config:
    """Build ``cls`` from what a policy or a run has written down, which must name every key.

    What was trained with one value must not be run with today's default of a key that came later.

    Raises:
        ConfigError: as ``from_dict``, or a key that is missing; the message begins with ``source``.
    """
    try:
        config = from_dict(cls, _with_before(cls, data))
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from error
    for key, value in _missing(to_dict(config), _with_before(cls, data)):
        raise ConfigError(f"{source}: no key '{key}', by default {value}; say what it was")
    return config


def _with_before(cls: Any, data: Any) -> Any:
    """``data``, and for each setting of ``cls`` that came later what it was before."""
    if not isinstance(data, Mapping):
        return data
    filled = dict(data)
    hints = typing.get_type_hints(cls)
    for f in dataclasses.fields(cls):
        if f.name in data and dataclasses.is_dataclass(hints[f.name]):
            filled[f.name] = _with_before(hints[f.name], data[f.name])
        elif f.name not in data and "before" in f.metadata:
            filled[f.name] = f.metadata["before"]
    return filled


def _missing(whole: Mapping[str, Any], data: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Dotted keys of ``whole`` that ``data`` lacks, and their values."""
    for key, value in whole.items():
        if isinstance(value, dict):
            below = _missing(value, data.get(key, {}))
            yield from ((f"{key}.{name}", default) for name, default in below)
        elif key not in data:
            yield key, json.dumps(value)


def with_overrides(config: Config, assignments: Iterable[str]) -> Config:
    """Apply ``dotted.key=value`` strings, values written as in JSON (bare words are strings).

    Raises:
        ConfigError: an assignment without ``=``, an unknown key, or a value of the wrong type.
    """
    for text in assignments:
        key, equals, raw = text.partition("=")
        if not equals or not key:
            raise ConfigError(f"cannot read --set '{text}'; write key=value, e.g. kp=25")
        try:
            value = json.loads(raw)
        except (ValueError, RecursionError):
            value = raw
        config = _replace(config, key.strip().split("."), value, key.strip())
    return config


def _replace(config: Any, path: list[str], value: Any, full: str) -> Any:
    names = [f.name for f in dataclasses.fields(config)]
    head, rest = path[0], path[1:]
    if head not in names:
        raise ConfigError(f"unknown configuration key '{full}'; allowed: {', '.join(names)}")
    child = getattr(config, head)
    if rest:
        if child is None:  # a table that may be left out
            options = typing.get_args(typing.get_type_hints(type(config))[head])
            table = next((o for o in options if dataclasses.is_dataclass(o)), None)
            child = None if table is None else typing.cast(type, table)()
        if not dataclasses.is_dataclass(child):
            raise ConfigError(f"'{full}': '{head}' is a value, it has no keys of its own")
        return dataclasses.replace(config, **{head: _replace(child, rest, value, full)})
    hint = typing.get_type_hints(type(config), include_extras=True)[head]
    return dataclasses.replace(config, **{head: _coerce(hint, value, full)})


def _coerce(hint: Any, value: Any, path: str) -> Any:
    """``value`` as the annotated type: the few that configurations use, and nothing else."""
    origin = typing.get_origin(hint)
    shown = reprlib.repr(value)  # short, whatever the file holds
    if origin is typing.Annotated:
        checked = _coerce(typing.get_args(hint)[0], value, path)
        if hint == Range and checked[0] > checked[1]:
            raise ConfigError(f"'{path}' must be [low, high] with low <= high, not {shown}")
        if hint == Share and not 0.0 <= checked <= 1.0:
            raise ConfigError(f"'{path}' must be from 0 to 1, not {shown}")
        if hint == GaitShares and not math.isclose(sum(checked), 1.0):
            raise ConfigError(f"'{path}' must add up to 1, not {shown}")
        return checked
    if origin is Literal:
        if value not in typing.get_args(hint):
            allowed = ", ".join(typing.get_args(hint))
            raise ConfigError(f"'{path}' must be one of {allowed}, not {shown}")
        return value
    if dataclasses.is_dataclass(hint):
        return from_dict(typing.cast(type, hint), value, path)
    if origin in (typing.Union, types.UnionType):
        options = typing.get_args(hint)
        if value is None and type(None) in options:
            return None
        return _coerce(next(o for o in options if o is not type(None)), value, path)
    if origin is tuple:
        args = typing.get_args(hint)
        if not isinstance(value, (list, tuple)):
            raise ConfigError(f"'{path}' must be a list, not {shown}")
        if args[-1] is Ellipsis:
            return tuple(_coerce(args[0], v, path) for v in value)
        if len(value) != len(args):
            raise ConfigError(f"'{path}' must have {len(args)} values, not {len(value)}")
        return tuple(_coerce(a, v, path) for a, v in zip(args, value, strict=True))
    if hint is bool and isinstance(value, bool):
        return value
    if hint is int and isinstance(value, int) and not isinstance(value, bool):
        return value
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:  # a whole number beyond the largest float
            number = math.inf
        if not math.isfinite(number):
            raise ConfigError(f"'{path}' must be a finite number, not {shown}")
        return number
    if hint is str and isinstance(value, str):
        return value
    kind = getattr(hint, "__name__", str(hint))
    raise ConfigError(f"'{path}' must be of type {kind}, not {shown}")
