"""The robot, Bullet, the commands' ranges and what is randomised."""

from dataclasses import dataclass, field

from tdgc.config.settings import (
    ConfigError,
    Count,
    NotNegative,
    Positive,
    PositiveRange,
    Range,
    Share,
)


@dataclass(frozen=True)
class RobotConfig:
    """The robot and its joint interface (paper Sec. IV-A, q* = q0 + alpha clip(a)).

    Masses, lengths and joint limits are read from the URDF (``tdgc.sim.geometry``); leg order FL,
    FR, RL, RR everywhere and joints hip, thigh, calf within a leg.
    """

    urdf: str = "urdf/quadruped.urdf"  # path, from here or from the repository
    kp: Positive = 20.0  # N m/rad (benchmark, Walk These Ways)
    kd: NotNegative = 0.6  # N m s/rad (benchmark: 0.5-0.7)
    # Of hip, thigh and calf, N m and rad/s (Go1).
    torque_limit: tuple[Positive, Positive, Positive] = (23.7, 23.7, 35.5)
    speed_limit: tuple[Positive, Positive, Positive] = (30.0, 30.0, 20.0)
    nominal_hip: float = 0.1  # rad, outward on both sides (Walk These Ways)
    nominal_thigh: tuple[float, float] = (0.8, 1.0)  # rad, front and rear (Walk These Ways)
    nominal_calf: float = -1.5  # rad (Walk These Ways)
    action_scale: Positive = 0.25  # rad per unit action: alpha in the paper (Walk These Ways)
    hip_scale: Positive = 0.5  # hips move half as far per unit action (Walk These Ways)
    # a_max in the paper: 4 * 0.25 = 1 rad either side of nominal. Random targets over 1.5 rad drive
    # feet through the ground at the default physics step, over 1 rad they do not.
    action_limit: Positive = 4.0
    base_height: Positive = 0.30  # m, standing (benchmark)
    # q0 follows the commanded behaviour (``robot.commanded_pose``); the paper's q0 is fixed.
    commanded_pose: bool = True
    # q0 walks as well: it carries the robot's weight and its feet run along Raibert's footholds
    # (``robot.walking_pose``). On legs this soft a pose without its load hangs 5 cm low, and its
    # swing feet drag: at zero actions feet asked for 8 cm in trot do not leave the ground.
    commanded_gait: bool = field(default=True, metadata={"before": False})
    # Gait cycles after a start or a change of gait over which q0's swing grows to what is asked:
    # of 21 falls in walking with random changes of gait 19 came within 0.7 s of one.
    swing_ramp: NotNegative = 1.0
    # Hz and gait cycles: a gait begins no slower than this, and is as slow as asked after so many.
    # Falls in 10 minutes with a random gait every 2 s: 2.6 without, 1.4, 1.0 and 0.8 with 3.0, 3.2
    # and 3.5 Hz over 2 cycles, 1.6 with 3.0 Hz over one (docs/experiments.md).
    start_frequency: NotNegative = 3.5
    start_cycles: NotNegative = 2.0
    # rad that joint targets keep from the joint limits; None lets them run past. A joint's zero may
    # be off by as much (``RandomisationConfig.joint_offset``), so that no real driver clips.
    joint_margin: NotNegative | None = field(default=0.02, metadata={"before": None})


@dataclass(frozen=True)
class PhysicsConfig:
    """Bullet's settings (benchmark, Physics)."""

    control_dt: Positive = 0.02  # s: 50 Hz control
    substeps: Count = 8  # 2.5 ms: at most 0.1 % of foot samples sink more than 1 cm
    # Physics steps that a joint torque is held for: 200 Hz joint control (benchmark). It saves 8 %
    # of the time of a control step and sinks no deeper (docs/experiments.md).
    hold: Count = field(default=2, metadata={"before": 1})
    solver_iterations: Count = 10  # the setting the sinking test was made with
    friction: NotNegative = 0.8  # foot on ground, nominal (benchmark)

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

    # m/s, forward, in the heading frame; leaps over the widest trenches need the 1.2
    vx: Range = (-1.0, 1.2)
    vy: Range = (-0.6, 0.6)  # m/s, left, in the heading frame
    yaw_rate: Range = (-1.0, 1.0)  # rad/s, left turn positive
    body_height: Range = (-0.03, 0.05)  # m, added to the standing height of 0.30 m
    frequency: PositiveRange = (2.0, 4.0)  # Hz, gait cycles a second
    duration: PositiveRange = (0.4, 0.6)  # 1, duty factor: share of a cycle in stance
    swing_height: Range = (0.03, 0.24)  # m, apex of the foot above the ground
    pitch: Range = (-0.3, 0.3)  # rad, nose down positive
    roll: Range = (-0.2, 0.2)  # rad, left side up positive
    stance_width: PositiveRange = (0.20, 0.35)  # m, between left and right footholds
    stance_length: PositiveRange = (0.33, 0.43)  # m, between front and rear footholds
    power_weight: Range = (0.0, 0.002)  # 1/W, the auxiliary: price of mechanical power


@dataclass(frozen=True)
class RandomisationConfig:
    """Domain randomisation, drawn at each reset unless a unit says otherwise.

    ``scale`` multiplies the width of every range about its nominal value: 0 switches all off.
    """

    scale: NotNegative = 1.0
    friction: Range = (0.4, 1.25)  # foot on ground
    payload: Range = (-1.0, 3.0)  # kg on the trunk (Walk These Ways)
    motor_strength: Range = (0.85, 1.1)  # times torque limits and gains
    joint_offset: Range = (-0.02, 0.02)  # rad, error of the joint zero (Walk These Ways)
    # kg m^2 about each joint, of its motor's rotor: MuJoCo's models of such robots have 0.01.
    armature: Range = field(default=(0.0, 0.015), metadata={"before": (0.0, 0.0)})
    # N m, dry friction of each joint; those models have 0.2.
    joint_friction: Range = field(default=(0.0, 0.3), metadata={"before": (0.0, 0.0)})
    latency: Range = (0.0, 0.03)  # s between decision and effect (real robots: about 30 ms)
    push_speed: NotNegative = 0.75  # m/s, largest horizontal push (benchmark's `pushes`)
    push_interval: PositiveRange = (3.0, 8.0)  # s between pushes
    noise_gravity: NotNegative = 0.02  # half-width of uniform noise
    noise_joint_angle: NotNegative = 0.01  # rad
    # Walk These Ways has 0.05 and 1.5 rad/s, and 30 steps of history to average them over. An actor
    # that sees one step needs its joint speeds to tell how fast the trunk moves.
    noise_joint_speed: NotNegative = 0.3  # rad/s
    noise_gyro: NotNegative = field(default=0.1, metadata={"before": 0.0})  # rad/s
    # The high policy's height probes (benchmark's `noise`).
    noise_probes: NotNegative = field(default=0.02, metadata={"before": 0.0})  # m
    # Share of the robots, drawn for each episode, whose probes are a decision late.
    probe_delay: Share = field(default=0.5, metadata={"before": 0.0})
