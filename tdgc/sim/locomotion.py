"""Robots in a world, driven by commands and by the low policy's actions.

``Locomotion`` turns the low policy's actions into joint targets, keeps the phase clock and the
histories, applies domain randomisation and builds the low policy's observation s^L of Sec. IV-A. It
knows nothing about rewards or tasks: ``tdgc.tasks.low_env`` trains the low policy on it, and
``tdgc.tasks.high_env`` drives it.
"""

import contextlib
import dataclasses
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tdgc.config import (
    ConfigError,
    LowLevelConfig,
    PhysicsConfig,
    RandomisationConfig,
    Range,
    RobotConfig,
)
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.commands import INDEX, NAMES, SIDEWAYS, default_command, gait_index, observed_command
from tdgc.sim.gaits import GAITS, PhaseClock, begun, executed_frequency, foot_phases
from tdgc.sim.geometry import Geometry
from tdgc.sim.observation import (
    JOINT_FLIP,
    LEG_FLIP,
    RATE_FLIP,
    VECTOR_FLIP,
    Term,
    in_place,
    observe,
)
from tdgc.sim.robot import (
    NUM_JOINTS,
    Array,
    commanded_pose,
    joint_targets,
    nominal_feet,
    nominal_height,
    nominal_pose,
    to_world,
    walking_pose,
    yaw_quaternion,
)
from tdgc.sim.sensors import Noise
from tdgc.sim.world import World
from tdgc.state import State, copies, fill

SPEED_SCALE = 0.05  # s/rad, scale of joint speeds in the observation (Walk These Ways)
GYRO_SCALE = 0.25  # s/rad, scale of angular velocity in the observation (Walk These Ways)
_FREQUENCY = INDEX["frequency"]
_LATENCY = 0.04  # s, the longest: real robots have about 0.03


def check_randomisation(config: RandomisationConfig, world: World) -> None:
    """Check that the ranges are physical for the robots of ``world``, and latencies no longer than
    joint targets are kept for.

    Raises:
        ConfigError: a range outside what is allowed; the message names the limits.
    """
    trunk_mass = world.state.geometry.trunk_mass
    allowed = {  # nominal, least and greatest value
        "friction": (world.physics.friction, 0.0, np.inf),
        "payload": (0.0, -0.9 * trunk_mass, np.inf),  # leave some mass for Bullet
        "motor_strength": (1.0, 0.0, np.inf),
        "latency": (0.0, 0.0, _LATENCY),
        "armature": (0.0, 0.0, np.inf),
        "joint_friction": (0.0, 0.0, np.inf),
    }
    for name, (nominal, least, greatest) in allowed.items():
        low, high = (nominal + config.scale * (b - nominal) for b in getattr(config, name))
        if low < least or high > greatest:
            raise ConfigError(
                f"'randomisation.{name}' times its scale must be from {least:g} to {greatest:g}, "
                f"not [{low:g}, {high:g}]"
            )


def check_robot(
    robot: RobotConfig, physics: PhysicsConfig, randomisation: RandomisationConfig
) -> None:
    """Check that the robot can be simulated with these disturbances.

    Raises:
        ConfigError: an unusable URDF, or a range outside what is allowed; the message says which.
    """
    with contextlib.closing(BulletWorld(1, robot, physics)) as world:
        check_randomisation(randomisation, world)


class Locomotion:
    """M robots that take 12 actions each control step and follow 15 commands.

    Args:
        world: the robots.
        config: the MDP of the low policy, which says how the robots are controlled and observed.

    Attributes:
        command: (M, 15), to be set by the caller.
        actions: (2, M, 12), the last clipped action and the one before.
        targets: (H, M, 12) rad, joint targets of the last control step and those before, as far
            back as latency reaches; 3 by default.
        carried_out: (M, 15), ``executed`` commands of the last control step.
        correct: the low policy's correction of commands (M, 15), which the executor sets before
            anything is observed; by default there is none.
        frequency_limit: Hz, cap on the robot's ``start_frequency``.
        layout: terms of the observation.
        delay: (M,) s, latency.
        joint_offset: (M, 12) rad, error of each joint's zero.
    """

    def __init__(self, world: World, config: LowLevelConfig) -> None:
        self.world = world
        self.robot, self.physics = robot, physics = config.robot, config.physics
        self.num_robots = num_robots = world.num_robots
        self.layout = actor_layout(robot, config.gyro)
        self.clock = PhaseClock(num_robots)
        self.nominal = nominal_pose(robot)
        self.command = np.tile(default_command(), (num_robots, 1))
        self.carried_out = self.command.copy()
        self.correct: Callable[[Array], Array] = lambda commands: commands
        self.frequency_limit = np.inf
        self.actions = np.zeros((2, num_robots, NUM_JOINTS))
        # The rewards look two steps back.
        kept = max(3, 1 + math.ceil(_LATENCY / physics.control_dt - 1e-6))
        self.targets = np.tile(self.nominal, (kept, num_robots, 1))
        self.delay = np.zeros(num_robots)
        self.joint_offset = np.zeros((num_robots, NUM_JOINTS))
        geometry = world.state.geometry
        self._feet = nominal_feet(robot, geometry)
        self._stand = nominal_height(robot, geometry)
        self._pose = self._pose_of = np.empty(0)  # cached ``pose`` and what it was computed from

    def swing(self) -> Array:
        """Swing profile, (M, 4): height of each foot as a share of the commanded apex."""
        return self.clock.swing(self.robot.swing_ramp)

    def executed(self) -> Array:
        """Commands as they are carried out now, (M, 15).

        A gait begins at ``start_frequency`` or faster, unless ``frequency_limit`` is lower, and
        slows to the commanded frequency over ``start_cycles``. At 2 Hz pronk and bound have a
        flight phase of a quarter of a second, and a robot's first jump is too weak for that.
        """
        command, cycles = self.command.copy(), self.clock.cycles
        start = min(self.robot.start_frequency, self.frequency_limit)
        command[:, _FREQUENCY] = executed_frequency(
            command[:, _FREQUENCY], cycles, start, self.robot.start_cycles
        )
        return command

    def followed(self) -> Array:
        """Commands (M, 15) that the low policy is told to follow: as they are carried out now, with
        velocities at which it does what is asked."""
        return self.correct(self.executed())

    def pose(self) -> Array:
        """q0, the pose to which actions are added and joint errors refer, (M, 12) rad."""
        if not self.robot.commanded_pose:
            return np.tile(self.nominal, (self.num_robots, 1))
        # ``act`` reuses the pose of the observation, unless commands or clocks changed in between.
        follows = np.column_stack([self.command, self.clock.clock, self.clock.cycles])
        if not np.array_equal(follows, self._pose_of):
            geometry = self.world.state.geometry
            if self.robot.commanded_gait:
                self._pose = self._walking_pose(geometry)
            else:
                self._pose = commanded_pose(self.robot, geometry, self.command, self.swing())
            self._pose_of = follows
            self._pose.setflags(write=False)
        return self._pose

    def _walking_pose(self, geometry: Geometry) -> Array:
        """Pose that the joints should reach in the middle of the coming control step.

        Joints lag a moving target by kd / kp, so the feet are placed for that much later.
        """
        command, middle = self.followed(), 0.5 * self.physics.control_dt
        phases, ahead = (
            foot_phases(
                np.mod(self.clock.clock + time * command[:, _FREQUENCY], 1.0),
                command[:, 12:],
                command[:, INDEX["duration"]],
            )
            for time in (middle, middle + self.robot.kd / self.robot.kp)
        )
        grown = begun(self.clock.cycles, self.robot.swing_ramp)
        return walking_pose(self.robot, geometry, command, phases, ahead, grown)

    def place(self, index: NDArray[np.integer], xy: Array, yaw: Array, clock: Array) -> None:
        """Place the robots ``index`` (n,) in the nominal pose at ``xy`` (n, 2) m, ``yaw`` (n,)
        rad, with their clocks at ``clock`` (n,), and clear their histories."""
        ground = self.world.ground_height(*to_world(xy, yaw, self._feet)).max(axis=1)
        position = np.column_stack([xy, ground + self._stand])
        pose = np.tile(self.nominal, (len(index), 1))
        self.world.reset_robots(index, position, yaw_quaternion(yaw), pose)
        self.actions[:, index] = 0.0
        self.targets[:, index] = self.nominal
        self.clock.reset(index, clock)
        self.update_clock()

    def randomise(
        self,
        index: NDArray[np.integer],
        config: RandomisationConfig,
        rng: np.random.Generator,
        width: Array | float = 1.0,
    ) -> None:
        """Draw the physical parameters of the robots ``index`` around their nominal values.

        ``width`` (n,) scales the ranges of each robot, in addition to ``config.scale`` for all.

        Raises:
            ConfigError: see ``check_randomisation``.
        """
        n, world = len(index), self.world
        check_randomisation(config, world)
        scale = np.broadcast_to(config.scale * np.asarray(width), n)

        def draw(bounds: Range, nominal: float, shape: tuple[int, ...] = (n,)) -> Array:
            drawn = rng.uniform(*bounds, size=shape) - nominal
            return nominal + (scale * drawn.T).T

        world.friction[index] = draw(config.friction, self.physics.friction)
        world.payload[index] = draw(config.payload, 0.0)
        world.strength[index, 0] = draw(config.motor_strength, 1.0)
        self.joint_offset[index] = draw(config.joint_offset, 0.0, (n, NUM_JOINTS))
        self.delay[index] = draw(config.latency, 0.0)
        world.armature[index] = draw(config.armature, 0.0)
        world.joint_friction[index, 0] = draw(config.joint_friction, 0.0)
        world.apply_dynamics(index)

    def act(self, actions: NDArray[np.floating]) -> None:
        """Run one control step: clip, scale, delay, PD control, clock (Sec. IV-A).

        Args:
            actions: (M, 12).

        Raises:
            ValueError: an action that is not finite.
        """
        if not np.isfinite(actions).all():
            raise ValueError("an action must be finite; it has NaN or infinite values")
        limit = self.robot.action_limit
        clipped = np.clip(np.asarray(actions, dtype=np.float64), -limit, limit)
        self.actions = np.stack([clipped, self.actions[0]])
        geometry = self.world.state.geometry
        targets = joint_targets(self.robot, geometry, self.pose(), clipped)
        self.targets = np.concatenate([targets[None], self.targets[:-1]])
        self.world.step(self.targets, self.delay, self.joint_offset)
        self.carried_out = self.executed()
        self.clock.advance(
            self.physics.control_dt,
            self.carried_out[:, _FREQUENCY],
            self.command[:, 12:],
            self.command[:, INDEX["duration"]],
        )

    def _arrays(self) -> dict[str, Array]:
        """Everything that a step passes on to the next, except Bullet's memory of contacts."""
        world = self.world
        fields = dataclasses.fields(world.state)
        measured = [f.name for f in fields if f.init and f.name != "geometry"]
        return {
            "command": self.command,
            "actions": self.actions,
            "targets": self.targets,
            "clock": self.clock.clock,
            "cycles": self.clock.cycles,
            "gait": self.clock.embedding,
            "delay": self.delay,
            "joint_offset": self.joint_offset,
            "friction": world.friction,
            "payload": world.payload,
            "armature": world.armature,
            "strength": world.strength,
            "joint_friction": world.joint_friction,
            **{name: getattr(world.state, name) for name in measured},
        }

    def state_dict(self) -> State:
        """Copies of the robots' complete state; saving the terrain is up to the caller."""
        return copies(self._arrays())

    def load_state_dict(self, state: State) -> None:
        """Restore a ``state_dict``; continues as the original does after ``World.forget``.

        Raises:
            ValueError: the state lacks an array or has one of another shape.
        """
        fill(self._arrays(), state)
        self.world.state.derive()
        self.update_clock()
        self.world.apply_dynamics(np.arange(self.num_robots))
        self.world.forget()

    def observe(self, noise: Noise | None = None) -> NDArray[np.float32]:
        """s^L = [g^b, dq, qdot, a_{t-1}, a_{t-2}, c, phi, g] and the rest of ``actor_layout``,
        (M, n); ``noise`` is added to measured terms."""
        self.update_clock()
        return observe(self.layout, self, noise)

    def update_clock(self) -> None:
        """Recompute the phases of the feet after the command or the clock was set."""
        self.clock.update(self.command[:, 12:], self.command[:, INDEX["duration"]])


_FLIP_COMMAND = in_place(*(-1.0 if name in SIDEWAYS else 1.0 for name in NAMES))
# fmt: off
_ACTOR_LAYOUT: tuple[Term[Locomotion], ...] = (
    Term("gravity", 3, lambda loco: loco.world.state.gravity, 1.0, "noise_gravity", VECTOR_FLIP),
    Term("joint_error", 12, lambda loco: loco.world.state.q - loco.joint_offset - loco.pose(), 1.0,
         "noise_joint_angle", JOINT_FLIP),
    Term("pose", 12, lambda loco: loco.pose() - loco.nominal, mirror=JOINT_FLIP),
    Term("joint_speed", 12, lambda loco: loco.world.state.qd, SPEED_SCALE, "noise_joint_speed",
         JOINT_FLIP),
    Term("last_action", 12, lambda loco: loco.actions[0], mirror=JOINT_FLIP),
    Term("action_before", 12, lambda loco: loco.actions[1], mirror=JOINT_FLIP),
    Term("command", 15, lambda loco: observed_command(loco.followed()), mirror=_FLIP_COMMAND),
    Term("clock", 4, lambda loco: loco.clock.signal(), mirror=LEG_FLIP),
    Term("clock_cosine", 4, lambda loco: loco.clock.cosine(), mirror=LEG_FLIP),
    Term("gait", 1, lambda loco: gait_index(loco.command)[:, None] / (len(GAITS) - 1)),
    Term("gyro", 3, lambda loco: loco.world.state.body_rate, GYRO_SCALE, "noise_gyro", RATE_FLIP),
)
# fmt: on


def actor_layout(robot: RobotConfig, gyro: bool) -> tuple[Term[Locomotion], ...]:
    """Terms of s^L of Sec. IV-A, the actor's observation: 71 values, 3 more with a gyro and 16 more
    with ``robot.commanded_gait``."""
    # Joint errors from a walking pose do not determine the joint angles, and the sine of a phase
    # does not distinguish the beginning of a stance from its end, so two terms are added.
    walks = robot.commanded_gait
    optional = {"pose": walks, "clock_cosine": walks, "gyro": gyro}
    return tuple(term for term in _ACTOR_LAYOUT if optional.get(term.name, True))
