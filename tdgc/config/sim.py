"""The robot, Bullet's settings, the command ranges and the domain randomisation."""

from dataclasses import dataclass, field

from tdgc.config.settings import (
    ConfigError,
    Count,
    NotNegative,
    Positive,
    PositiveRange,
    Range,
    Share,
    ShareRange,
)


@dataclass(frozen=True)
class RobotConfig:
    """The robot and its joint interface (paper Sec. IV-A, q* = q0 + alpha clip(a)).

    Masses, lengths and joint limits are read from the URDF (``tdgc.sim.geometry``). The leg order
    is FL, FR, RL, RR everywhere, with joints hip, thigh, calf within a leg.
    """

    urdf: str = "urdf/quadruped.urdf"  # path from the working directory or the repository
    kp: Positive = 20.0  # N m/rad (benchmark, Walk These Ways)
    kd: Positive = 0.6  # N m s/rad (benchmark: 0.5-0.7)
    # Of hip, thigh and calf, in N m and rad/s (Go1).
    torque_limit: tuple[Positive, Positive, Positive] = (23.7, 23.7, 35.5)
    speed_limit: tuple[Positive, Positive, Positive] = (30.0, 30.0, 20.0)
    nominal_hip: float = 0.1  # rad, outward on both sides (Walk These Ways)
    nominal_thigh: tuple[float, float] = (0.8, 1.0)  # rad, front and rear (Walk These Ways)
    nominal_calf: float = -1.5  # rad (Walk These Ways)
    action_scale: Positive = 0.25  # rad per unit action: alpha in the paper (Walk These Ways)
    hip_scale: Positive = 0.5  # hips move half as far per unit action (Walk These Ways)
    # a_max in the paper: 4 * 0.25 = 1 rad to either side of nominal. At the default physics step,
    # random targets within 1.5 rad drive feet through the ground, within 1 rad they do not.
    action_limit: Positive = 4.0
    base_height: Positive = 0.30  # m, standing (benchmark)
    # m, length and width between the footholds at the default commands, which have these values.
    stance: tuple[Positive, Positive] = field(
        default=(0.38, 0.25), metadata={"before": (0.38, 0.25)}
    )
    # Whether q0 follows the commanded behaviour (``robot.commanded_pose``); fixed in the paper.
    commanded_pose: bool = True
    # Whether such a q0 also walks: it carries the robot's weight, and its feet follow Raibert's
    # footholds (``robot.walking_pose``). With legs this soft, a pose that ignores the load sags by
    # 5 cm and drags its swing feet: with zero actions, feet commanded to 8 cm in trot do not leave
    # the ground.
    commanded_gait: bool = field(default=True, metadata={"before": False})
    # Gait cycles after a start or a change of gait over which q0's swing height and stride grow to
    # the commanded ones: of 21 falls while walking with random changes of gait, 19 came within
    # 0.7 s of one.
    swing_ramp: NotNegative = 1.0
    # Hz and gait cycles: a gait starts at no less than ``start_frequency`` and slows down to the
    # commanded frequency over ``start_cycles``. Falls in 10 minutes with a random gait every 2 s:
    # 2.6 without; 1.4, 1.0 and 0.8 with 3.0, 3.2 and 3.5 Hz over 2 cycles; 1.6 with 3.0 Hz over one
    # (docs/experiments.md).
    start_frequency: NotNegative = 3.5
    start_cycles: NotNegative = 2.0
    # rad, distance of joint targets from the joint limits; null does not limit them. It equals the
    # largest error of a joint's zero (``RandomisationConfig.joint_offset``), so that no real driver
    # clips.
    joint_margin: NotNegative | None = field(default=0.02, metadata={"before": None})


@dataclass(frozen=True)
class PhysicsConfig:
    """Bullet's settings (benchmark, Physics)."""

    control_dt: Positive = 0.02  # s: 50 Hz control
    # 2.5 ms: at most 0.1 % of foot samples sink more than 1 cm (benchmark), but 0.11 % on stairs.
    substeps: Count = 8
    # Physics steps for which a joint torque is held: 200 Hz joint control (benchmark). It saves 8 %
    # of the time of a control step, and no more feet sink (docs/experiments.md).
    hold: Count = field(default=2, metadata={"before": 1})
    solver_iterations: Count = 10  # as in the sinking test
    friction: NotNegative = 0.8  # foot on ground, nominal (benchmark)

    @property
    def dt(self) -> float:
        """Physics step in s."""
        return self.control_dt / self.substeps

    @property
    def joint_steps(self) -> int:
        """Number of times that joint torques are computed per control step.

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

    They are the ranges at which Walk These Ways starts its own curriculum, narrowed where a foot
    could not follow at the step frequencies used. Body height is narrowed so far that pronk and
    bound, which sink at each landing, stay clear of what counts as a fall (at -0.1 m three in four
    robots fell).
    """

    # m/s, forward, in the heading frame; leaps over the widest trenches need 1.2
    vx: Range = (-1.0, 1.2)
    vy: Range = (-0.6, 0.6)  # m/s, left, in the heading frame
    yaw_rate: Range = (-1.0, 1.0)  # rad/s, left turn positive
    body_height: Range = (-0.03, 0.05)  # m, added to the standing height of 0.30 m
    frequency: PositiveRange = (2.0, 4.0)  # Hz, gait cycles per second
    duration: ShareRange = (0.4, 0.6)  # 1, duty factor: share of a cycle in stance
    swing_height: Range = (0.03, 0.24)  # m, apex of the foot above the ground
    pitch: Range = (-0.3, 0.3)  # rad, nose down positive
    roll: Range = (-0.2, 0.2)  # rad, left side up positive
    stance_width: PositiveRange = (0.20, 0.35)  # m, between left and right footholds
    stance_length: PositiveRange = (0.33, 0.43)  # m, between front and rear footholds
    power_weight: Range = (0.0, 0.002)  # 1/W, the auxiliary: price of mechanical power


@dataclass(frozen=True)
class RandomisationConfig:
    """Domain randomisation, drawn at each reset unless a comment states otherwise.

    ``scale`` scales every range but ``push_interval`` about its nominal value; 0 switches off all
    randomisation.
    """

    scale: NotNegative = 1.0
    friction: Range = (0.4, 1.25)  # foot on ground
    payload: Range = (-1.0, 3.0)  # kg on the trunk (Walk These Ways)
    motor_strength: Range = (0.85, 1.1)  # times torque limits and gains
    joint_offset: Range = (-0.02, 0.02)  # rad, error of the joint zero (Walk These Ways)
    # kg m^2, rotor inertia of the motor about each joint; MuJoCo's models of such robots have 0.01.
    armature: Range = field(default=(0.0, 0.015), metadata={"before": (0.0, 0.0)})
    # N m, dry friction of each joint; the same models have 0.2.
    joint_friction: Range = field(default=(0.0, 0.3), metadata={"before": (0.0, 0.0)})
    latency: Range = (0.0, 0.03)  # s from joint targets to effect (real robots: about 30 ms)
    push_speed: NotNegative = 0.75  # m/s, largest horizontal push (benchmark's `pushes`)
    push_interval: PositiveRange = (3.0, 8.0)  # s between pushes
    noise_gravity: NotNegative = 0.02  # 1, half-width of uniform noise, as in all ``noise_*``
    noise_joint_angle: NotNegative = 0.01  # rad
    # Walk These Ways has 0.05 for gravity and 1.5 rad/s here, and 30 steps of history to average
    # the noise over. An actor that observes one step infers the trunk's velocity from its joint
    # speeds.
    noise_joint_speed: NotNegative = 0.3  # rad/s
    noise_gyro: NotNegative = field(default=0.1, metadata={"before": 0.0})  # rad/s
    # Of the high policy's height probes (benchmark's `noise`).
    noise_probes: NotNegative = field(default=0.02, metadata={"before": 0.0})  # m
    # Share of the robots, drawn for each episode, whose probes are one decision late.
    probe_delay: Share = field(default=0.5, metadata={"before": 0.0})
