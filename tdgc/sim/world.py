"""What every simulator of M robots offers, whatever computes their motion.

``tdgc.sim.bullet_world`` is the one that robots are trained and evaluated in;
``tdgc.sim.mujoco_world`` is there to compare. Arrays have a leading axis of M robots.
"""

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import ArrayLike

from tdgc.config import PhysicsConfig, RobotConfig
from tdgc.sim.geometry import Geometry
from tdgc.sim.robot import Array, RobotState
from tdgc.sim.tile import TileField


class World(ABC):
    """M robots on a plane, or each on its own tile of a field.

    The dynamics are nominal at first; the caller changes their arrays in place and then calls
    ``apply_dynamics``.

    Args:
        num_robots: M.
        robot: gains, limits and the nominal pose.
        physics: time steps and the nominal friction.
        field: M tiles; None for a plane.
        geometry: of the robot.

    Raises:
        ValueError: ``field`` has not one tile per robot.

    Attributes:
        state: the ``RobotState`` after the last step, push or reset.
        friction: (M,) coefficient of friction of all links.
        payload: (M,) kg, spread over the trunk.
        armature: (M,) kg m^2, rotor inertia of each joint.
        strength: (M, 1) or (M, 12) motor strength, a factor on gains and torque limits.
        joint_friction: (M, 1) N m, dry friction in each joint.
    """

    def __init__(
        self,
        num_robots: int,
        robot: RobotConfig,
        physics: PhysicsConfig,
        field: TileField | None,
        geometry: Geometry,
    ) -> None:
        if field is not None and field.count != num_robots:
            raise ValueError(f"{num_robots} robots need as many tiles, not {field.count}")
        m = num_robots
        self.num_robots, self.robot, self.physics, self.field = m, robot, physics, field
        self.state = RobotState.zeros(geometry, m)
        self.friction = np.full(m, physics.friction)
        self.payload, self.armature = np.zeros((2, m))
        self.strength, self.joint_friction = np.ones((m, 1)), np.zeros((m, 1))
        self._active = np.arange(m)  # robots that are simulated

    @abstractmethod
    def apply_dynamics(self, index: ArrayLike) -> None:
        """Pass on changes of ``friction``, ``payload`` and ``armature`` of the robots ``index``
        (n,) to the simulator; ``strength`` and ``joint_friction`` are read at every step."""

    @abstractmethod
    def step(self, targets: Array, delay: Array, offset: Array) -> None:
        """Simulate one control step of PD control.

        Args:
            targets: (H, M, 12) rad, the joint targets of this control step and the H-1 before.
            delay: (M,) s until a target takes effect, at most H-1 control steps.
            offset: (M, 12) rad, error of each joint's zero.
        """

    @abstractmethod
    def retire(self, index: ArrayLike) -> None:
        """Remove the robots ``index`` permanently; their rows of ``state`` keep the last pose and
        velocities."""

    @abstractmethod
    def forget(self) -> None:
        """Make the simulator forget the contacts of earlier steps; ``state`` stays as it is.

        Solvers start from the last step's contact forces. After this call the simulation continues,
        bit for bit, as in a world rebuilt with the same ``state`` and dynamics.
        """

    @abstractmethod
    def close(self) -> None:
        """Free what the simulator holds; the world cannot be used afterwards."""

    @abstractmethod
    def _put(self, i: int) -> None:
        """Set the simulator's robot ``i`` to its pose and velocities in ``state``."""

    @abstractmethod
    def _move_trunk(self, i: int) -> None:
        """Give the trunk of robot ``i`` its velocities in ``state``."""

    def reset_robots(self, index: ArrayLike, position: Array, quaternion: Array, q: Array) -> None:
        """Place the robots ``index`` (n,) at rest at ``position`` (n, 3), ``quaternion`` (n, 4)
        with joint angles ``q`` (n, 12), and refresh ``state``."""
        state, rows = self.state, np.asarray(index, dtype=np.intp)
        state.position[rows], state.quaternion[rows], state.q[rows] = position, quaternion, q
        for still in (
            state.lin_vel, state.ang_vel, state.qd, state.torque, state.rotor_excess,
            state.foot_force, state.leg_force, state.trunk_force,
        ):  # fmt: skip
            still[rows] = 0.0
        for i in rows.tolist():
            self._put(i)
        state.derive()

    def push(self, index: ArrayLike, velocity: Array) -> None:
        """Add ``velocity`` (n, 3) m/s to the trunks of the robots ``index`` (n,), which are
        distinct, and refresh ``state``."""
        state, rows = self.state, np.asarray(index, dtype=np.intp)
        state.lin_vel[rows] += velocity
        for i in rows.tolist():
            self._move_trunk(i)
        state.derive()

    def _wanted(self, targets: Array, delay: Array, offset: Array) -> Array:
        """Joint targets of the n active robots at each of k joint controls, (k, n, 12) rad: those
        of the latest control step that has taken effect by then."""
        live = self._active
        interval = self.physics.hold * self.physics.dt
        passed = interval * np.arange(self.physics.joint_steps)[:, None]
        age = np.ceil(np.maximum(delay[live] - passed - 1e-9, 0.0) / self.physics.control_dt)
        return targets[age.astype(int), live] + offset[live]

    def ground_height(self, x: Array, y: Array) -> Array:
        """Surface height in m at points ``x``, ``y``, arrays of any shape."""
        return np.zeros_like(x) if self.field is None else self.field.height_at(x, y)

    def support_height(self, x: Array, y: Array) -> Array:
        """Height in m of the fall rule's support surface: trenches filled, pillars removed."""
        return np.zeros_like(x) if self.field is None else self.field.support_at(x, y)

    def trunk_height(self) -> Array:
        """Height of each trunk above the support surface under it, (M,) m."""
        x, y, z = self.state.position.T
        return z - self.support_height(x, y)
