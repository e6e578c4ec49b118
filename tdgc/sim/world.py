"""A Bullet world of M robots: the only module that imports pybullet.

Robots pass through each other (a collision mask). Arrays have a leading axis of M robots.
"""

import contextlib
import ctypes
import functools
import importlib
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tdgc.config import ConfigError, PhysicsConfig, RobotConfig
from tdgc.sim.geometry import read_geometry
from tdgc.sim.robot import (
    GRAVITY,
    NUM_JOINTS,
    Array,
    RobotState,
    pd_torque,
    quaternion_product,
    rotation_matrix,
)
from tdgc.sim.terrain import HEIGHT_RANGE, MAX_SAMPLES, TILE_SAMPLES, TileField
from tdgc.sim.urdf import JOINTS, merged_file, urdf_path

_GROUND, _ROBOT = 1, 2  # collision groups: robots meet the ground and nothing else
_TRUNK = -1  # Bullet's number of a body's root link
_PARKED = 50.0  # m above its place nothing touches a robot: terrain stays within HEIGHT_RANGE
_SKY = (226, 234, 243)  # light enough for print, and the robot's white shell stands out from it
_FOOT_REACH = 0.03  # m below the foot's centre sits a contact that is the foot's, not the calf's


def _load() -> Any:
    """PyBullet, whose import says when it was built, in each process and over progress bars."""
    stream = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        return importlib.import_module("pybullet")
    finally:
        os.dup2(stream, 2)
        os.close(stream)


pybullet = _load()


class _Client:
    """pybullet's functions bound to one connection.

    pybullet_utils' BulletClient binds at every call, which costs as much as a short call; here
    each function is bound once, at its first use.
    """

    def __init__(self, robots: tuple[int, int], window: bool) -> None:
        self.id: int = pybullet.connect(pybullet.GUI if window else pybullet.DIRECT)
        self.robots = robots  # of the world: the first, and the one after the last
        self.rows: dict[int, int] = {}  # row of the world that a body of this client is
        self.ground = -1
        self.shape = -1
        self.samples = slice(0, 0)  # of the field along x, that this client holds

    def __getattr__(self, name: str) -> Callable[..., Any]:
        bound = functools.partial(getattr(pybullet, name), physicsClientId=self.id)
        setattr(self, name, bound)
        return bound


#: Robots a Bullet client. Bullet walks all constraints of a client for each robot's island, so the
#: time a robot takes grows with their number: measured on a plane 44 us a step with 5 in a client,
#: 46 with 10, 54 with 25, 75 with 50, 122 with 100.
CLIENT_ROBOTS = 10


class World:
    """M robots on a plane, or each on a tile row of its own in a field.

    Robots are spread over several Bullet clients, ``CLIENT_ROBOTS`` in each; a client holds its own
    robots' part of the field only. ``visual`` keeps what is needed for pictures, ``window`` shows
    all in Bullet's own window.

    Raises:
        ConfigError: the robot's URDF is not there or no robot that this package can drive.

    Attributes:
        state: the ``RobotState`` after the last step, push or reset.
        strength: (M, 1) motor strength, times gains and torque limits.
        joint_friction: (M, 1) N m, dry friction in each joint.
        bullet_seconds: wall time spent inside Bullet's step so far.
    """

    def __init__(
        self,
        num_robots: int,
        robot: RobotConfig,
        physics: PhysicsConfig,
        field: TileField | None = None,
        visual: bool = False,
        window: bool = False,
    ) -> None:
        if field is not None and field.shape[0] != num_robots:
            raise ValueError(f"{num_robots} robots need as many tile rows, not {field.shape[0]}")
        self.num_robots = num_robots
        self.robot = robot
        self.physics = physics
        self.field = field
        self._visual = visual
        self.strength = np.ones((num_robots, 1))
        self.joint_friction = np.zeros((num_robots, 1))
        self.bullet_seconds = 0.0
        self.state = RobotState.zeros(read_geometry(robot), num_robots)
        self._clients: list[_Client] = []
        self._bodies: list[int] = []
        self._client_of: list[_Client] = []
        parts = -(-num_robots // CLIENT_ROBOTS)
        with merged_file(robot) as urdf:
            for rows in np.array_split(np.arange(num_robots), parts):
                self._connect(rows, urdf, window)
        self._joint_inertia = [self._inertia_about_joint(joint) for joint in self._joints]
        trunk = self._client_of[0].getDynamicsInfo(self._bodies[0], _TRUNK)
        # Bullet's pose of a robot is that of its trunk's inertia: where its centre of mass is in
        # the trunk's frame, and how the axes of its inertia are turned there.
        self._trunk_inertia, self._centre, self._axes = map(np.array, trunk[2:5])
        self._active = np.arange(num_robots)

    def _connect(self, rows: NDArray[np.int64], urdf: Path, window: bool) -> None:
        """Give the robots ``rows`` (n,) a client, with their ground."""
        client = _Client((int(rows[0]), int(rows[-1]) + 1), window)
        client.setGravity(0.0, 0.0, -GRAVITY)
        # No early stop of the solver: it would couple robots through the worst residual.
        client.setPhysicsEngineParameter(
            fixedTimeStep=self.physics.hold * self.physics.dt,
            numSubSteps=self.physics.hold if self.physics.hold > 1 else 0,
            numSolverIterations=self.physics.solver_iterations,
            solverResidualThreshold=0.0,
            deterministicOverlappingPairs=1,
        )
        self._make_ground(client)
        for k in range(len(rows)):
            self._bodies.append(self._load_robot(client, k, urdf))
            self._client_of.append(client)
            client.rows[self._bodies[-1]] = int(rows[k])
        self._clients.append(client)

    def _make_ground(self, client: _Client) -> None:
        if self.field is None:
            shape = client.createCollisionShape(pybullet.GEOM_PLANE)
            client.ground = client.createMultiBody(0.0, shape)
        else:
            client.samples = slice(*(TILE_SAMPLES * row for row in client.robots))
            heights = self.field.heights[client.samples]
            low, high = float(heights.min()), float(heights.max())
            if heights.flags.writeable:
                # The first upload fixes the height range that Bullet keeps, so it spans all that
                # tiles can ever be; the second brings the heights.
                low, high = HEIGHT_RANGE
                spanning = np.zeros_like(heights)
                spanning[0, 0], spanning[0, 1] = HEIGHT_RANGE
                client.shape = self._upload(client, spanning, -1)
                self._upload(client, heights, client.shape)
            else:
                client.shape = self._upload(client, heights, -1)
            nx, ny = heights.shape
            cell = self.field.cell
            centre = [
                (client.samples.start + 0.5 * (nx - 1)) * cell,
                0.5 * (ny - 1) * cell,
                0.5 * (low + high),
            ]
            # Without a visual of its own, Bullet keeps 360 bytes a sample to draw the field.
            drawn = -1
            if not self._visual:
                drawn = client.createVisualShape(pybullet.GEOM_SPHERE, radius=0.001)
            client.ground = client.createMultiBody(0.0, client.shape, drawn, basePosition=centre)
        client.changeDynamics(client.ground, -1, lateralFriction=1.0)  # feet carry the friction
        client.setCollisionFilterGroupMask(client.ground, -1, _GROUND, _ROBOT)

    def _upload(self, client: _Client, heights: NDArray[np.float32], replace: int) -> int:
        """Send heights to Bullet, which checks neither sizes nor range, so this does."""
        assert self.field is not None
        if heights.size > MAX_SAMPLES:
            raise ValueError(f"Bullet holds {MAX_SAMPLES} samples a field, not {heights.size}")
        low, high = float(heights.min()), float(heights.max())
        if low < HEIGHT_RANGE[0] or high > HEIGHT_RANGE[1]:
            raise ValueError(f"heights {low:.2f}..{high:.2f} m leave {HEIGHT_RANGE} m")
        return int(
            client.createCollisionShape(
                pybullet.GEOM_HEIGHTFIELD,
                meshScale=[self.field.cell, self.field.cell, 1.0],
                heightfieldData=heights.T.ravel(),  # Bullet's rows run along x
                numHeightfieldRows=heights.shape[0],
                numHeightfieldColumns=heights.shape[1],
                replaceHeightfieldIndex=replace,
            )
        )

    def upload_terrain(self, index: ArrayLike | None = None) -> None:
        """Bring the field's heights, redrawn in place, into Bullet.

        With ``index`` only where those robots' tiles changed. About 1 us a sample of every client
        concerned, so it is for the ends of episodes, not for every step.

        Raises:
            ValueError: heights outside the range that the field was made for.
        """
        assert self.field is not None, "a plane has no heights"
        rows = range(self.num_robots) if index is None else np.asarray(index)
        for client in dict.fromkeys(self._client_of[i] for i in rows):
            self._upload(client, self.field.heights[client.samples], client.shape)

    def _load_robot(self, client: _Client, place: int, urdf: Path) -> int:
        # Apart and high, so that nothing touches before the first reset.
        try:
            body = client.loadURDF(
                str(urdf),
                basePosition=[2.0 * place, 0.0, _PARKED],
                flags=pybullet.URDF_USE_INERTIA_FROM_FILE
                | (0 if self._visual else pybullet.URDF_IGNORE_VISUAL_SHAPES),
            )
        except pybullet.error as error:  # a mesh that is not there, an element it cannot read
            path = urdf_path(self.robot)
            raise ConfigError(f"{path}: Bullet cannot load it and says why above") from error
        links = range(client.getNumJoints(body))
        found = {client.getJointInfo(body, link)[1].decode(): link for link in links}
        self._joints = [found[name] for name in JOINTS]
        self._leg_of_link = {link: k // 3 for k, link in enumerate(self._joints)}
        self._calf_links = set(self._joints[2::3])
        # Bullet holds one speed limit a body, so it gets the slowest joint's: a calf that whips at
        # the other joints' 30 rad/s moves its foot further a step than the foot's radius.
        slowest = min(self.robot.speed_limit)
        for link in (_TRUNK, *links):
            client.setCollisionFilterGroupMask(body, link, _ROBOT, _GROUND)
            client.changeDynamics(
                body,
                link,
                linearDamping=0.0,
                angularDamping=0.0,
                jointDamping=0.0,
                maxJointVelocity=slowest,
            )
            # In the call above, with dampings, PyBullet would give it to the trunk instead.
            client.changeDynamics(body, link, lateralFriction=self.physics.friction)
        # Bullet's default velocity motors would hold the joints.
        client.setJointMotorControlArray(
            body, self._joints, pybullet.VELOCITY_CONTROL, forces=[0.0] * NUM_JOINTS
        )
        return int(body)

    def reset_robots(
        self,
        index: Iterable[int] | NDArray[np.integer],
        position: Array,
        quaternion: Array,
        q: Array,
    ) -> None:
        """Put the robots ``index`` (n,) at rest at ``position`` (n, 3), ``quaternion`` (n, 4)
        with joint angles ``q`` (n, 12); refreshes ``state``."""
        state = self.state
        for k, i in enumerate(index):
            state.position[i], state.quaternion[i], state.q[i] = position[k], quaternion[k], q[k]
            for still in (state.lin_vel, state.ang_vel, state.qd, state.torque):
                still[i] = 0.0
            state.foot_force[i] = state.leg_force[i] = 0.0
            state.trunk_force[i] = 0.0
            self._put(int(i))
        state.derive()

    def _put(self, i: int) -> None:
        """Bring robot ``i`` of Bullet to where ``state`` has it."""
        body, client, state = self._bodies[i], self._client_of[i], self.state
        self._place_trunk(i, state.position[i])
        self._move_trunk(i)
        for joint, angle, speed in zip(self._joints, state.q[i], state.qd[i], strict=True):
            client.resetJointState(body, joint, angle, speed)

    def _to_centre(self, i: int) -> Array:
        """From the trunk's frame to its centre of mass, in the world, (3,) m."""
        return np.asarray(rotation_matrix(self.state.quaternion[i : i + 1])[0] @ self._centre)

    def _place_trunk(self, i: int, position: Array) -> None:
        """Bring the trunk of robot ``i`` to ``position`` (3,), turned as ``state`` has it."""
        self._client_of[i].resetBasePositionAndOrientation(
            self._bodies[i],
            position + self._to_centre(i),
            quaternion_product(self.state.quaternion[i], self._axes),
        )

    def _move_trunk(self, i: int) -> None:
        """Let the trunk of robot ``i`` move as ``state`` has it."""
        lin_vel, ang_vel = self.state.lin_vel[i], self.state.ang_vel[i]
        self._client_of[i].resetBaseVelocity(
            self._bodies[i], lin_vel + np.cross(ang_vel, self._to_centre(i)), ang_vel
        )

    def _read_trunks(self, live: NDArray[np.integer]) -> None:
        """Fill ``state`` with where the trunks of the robots ``live`` are and how they move."""
        robots = [(self._bodies[i], self._client_of[i].id) for i in live]
        poses = [pybullet.getBasePositionAndOrientation(*robot) for robot in robots]
        speeds = [pybullet.getBaseVelocity(*robot) for robot in robots]
        axes = np.reshape([quaternion for _, quaternion in poses], (-1, 4))
        quaternion = quaternion_product(axes, self._axes * [-1.0, -1.0, -1.0, 1.0])
        arm = rotation_matrix(quaternion) @ self._centre
        ang_vel = np.reshape([angular for _, angular in speeds], (-1, 3))
        lin_vel = np.reshape([linear for linear, _ in speeds], (-1, 3))
        state = self.state
        state.position[live] = np.reshape([position for position, _ in poses], (-1, 3)) - arm
        state.quaternion[live] = quaternion
        state.lin_vel[live] = lin_vel - np.cross(ang_vel, arm)
        state.ang_vel[live] = ang_vel

    def forget(self) -> None:
        """Let Bullet forget the contacts of the steps before; ``state`` stays as it is.

        Bullet starts its solver from the last step's contact forces. Afterwards what follows is
        what would follow in a world rebuilt with the same ``state``, strength and dynamics, bit
        for bit. For that every robot spends one physics step high above the ground.
        """
        for i in self._active:
            self._place_trunk(int(i), self.state.position[i] + [0.0, 0.0, _PARKED])
        for client in dict.fromkeys(self._client_of[i] for i in self._active):
            client.stepSimulation()
        for i in self._active:
            self._put(int(i))

    def _inertia_about_joint(self, joint: int) -> tuple[list[float], int]:
        """Principal inertia of a joint's link, (3,) kg m^2, and which is nearest to its axis."""
        client, body = self._client_of[0], self._bodies[0]
        inertia, _, turned = client.getDynamicsInfo(body, joint)[2:5]
        axis = np.array(client.getJointInfo(body, joint)[13])
        along = rotation_matrix(np.array([turned]))[0].T @ axis
        return list(inertia), int(np.abs(along).argmax())

    def set_dynamics(
        self, index: ArrayLike, friction: Array, payload: Array, armature: Array
    ) -> None:
        """Friction of every link, extra mass of the trunk, rotor inertia of the joints.

        Bullet's joints have no inertia of their own, so it is the links' about their joints; other
        than a rotor's it also resists a turn of all links together.

        Args:
            index: (n,) robots.
            friction: (n,).
            payload: (n,) kg.
            armature: (n,) kg m^2.
        """
        nominal = self.state.geometry.trunk_mass
        for k, i in enumerate(np.asarray(index)):
            body, client = self._bodies[i], self._client_of[i]
            mass = nominal + float(payload[k])
            for link in (_TRUNK, *sorted(self._joints)):
                client.changeDynamics(body, link, lateralFriction=float(friction[k]))
            for joint, (inertia, axis) in zip(self._joints, self._joint_inertia, strict=True):
                about = inertia.copy()
                about[axis] += float(armature[k])
                client.changeDynamics(body, joint, localInertiaDiagonal=about)
            # Spread over the trunk, the payload scales its inertia.
            client.changeDynamics(
                body,
                _TRUNK,
                mass=mass,
                localInertiaDiagonal=(self._trunk_inertia * (mass / nominal)).tolist(),
            )

    def push(self, index: ArrayLike, velocity: Array) -> None:
        """Add ``velocity`` (n, 3) m/s to the trunks of the robots ``index``; refreshes
        ``state``."""
        state = self.state
        for k, i in enumerate(np.asarray(index)):
            state.lin_vel[i] += velocity[k]
            self._move_trunk(int(i))
        state.derive()

    def retire(self, index: ArrayLike) -> None:
        """Take the robots ``index`` out for good; their rows of ``state`` stay as they are."""
        for i in np.asarray(index):
            self._client_of[i].removeBody(self._bodies[i])
        self._active = np.setdiff1d(self._active, index)

    def step(self, targets: Array, delay: Array, offset: Array) -> None:
        """One control step of PD control.

        Args:
            targets: (H, M, 12) rad, the joint targets of this control step and the H-1 before.
            delay: (M,) s from a decision to its effect, below H control steps.
            offset: (M, 12) rad, error of each joint's zero.
        """
        live, state = self._active, self.state
        wanted = self._wanted(targets, delay, offset)
        state.trunk_force = np.zeros(self.num_robots)
        for client in self._clients:
            mine = slice(*np.searchsorted(live, client.robots))
            if live[mine].size:
                self._step_client(client, live[mine], wanted[:, mine])
        self._read_trunks(live)
        state.derive()
        self._read_contacts()

    def _wanted(self, targets: Array, delay: Array, offset: Array) -> Array:
        """Targets of each of k joint controls, (k, n, 12) rad for the n active robots: those of the
        control step that has taken effect by then."""
        live = self._active
        interval = self.physics.hold * self.physics.dt
        passed = interval * np.arange(self.physics.joint_steps)[:, None]
        age = np.ceil(np.maximum(delay[live] - passed - 1e-9, 0.0) / self.physics.control_dt)
        return np.asarray(targets[age.astype(int), live] + offset[live])

    def _step_client(self, client: _Client, live: NDArray[np.integer], wanted: Array) -> None:
        """All physics steps of one client's robots ``live`` (n,), with ``wanted`` (k, n, 12) rad,
        their joint targets at each of k joint controls.

        One client after another, since the processor's cache holds one but not all: with 50 robots
        in 5 clients Bullet took half as long again when they took turns at every physics step.
        """
        joints, state = self._joints, self.state
        bodies = [self._bodies[i] for i in live]
        # At these calls, one a robot and physics step, even a client's bound functions are slow.
        command, measure = pybullet.setJointMotorControlArray, pybullet.getJointStates
        strength, friction = self.strength[live], self.joint_friction[live]
        q, qd = state.q[live], state.qd[live]
        for target in wanted:
            torque = pd_torque(target - q, qd, strength, self.robot, friction)
            for body, forces in zip(bodies, torque.tolist(), strict=True):
                command(
                    body, joints, pybullet.TORQUE_CONTROL, forces=forces, physicsClientId=client.id
                )
            started = time.perf_counter()
            client.stepSimulation()
            self.bullet_seconds += time.perf_counter() - started
            flat = [s for body in bodies for s in measure(body, joints, client.id)]
            q, qd = (
                np.fromiter(map(itemgetter(k), flat), np.float64, len(flat)).reshape(q.shape)
                for k in (0, 1)
            )
            pressed: dict[int, float] = {}  # row -> N on its trunk, none most of the time
            for contact in client.getContactPoints(bodyA=client.ground, linkIndexB=_TRUNK):
                row = client.rows[contact[2]]
                pressed[row] = pressed.get(row, 0.0) + self._force(contact)
            for row, force in pressed.items():
                state.trunk_force[row] = max(force, state.trunk_force[row])
        state.q[live], state.qd[live], state.torque[live] = q, qd, torque

    def _force(self, contact: tuple[Any, ...]) -> float:
        """Normal force of a contact in N: Bullet divides the impulse of its last internal step by
        the time of all of them."""
        return float(contact[9] * self.physics.hold)

    def _read_contacts(self) -> None:
        """Forces of the last physics step, split into feet and the legs above them.

        The foot is the end of the calf link, so a calf contact counts as the foot's when it is
        within reach of the foot's centre. Plain lists: indexing arrays one contact at a time
        would take longer than all the rest of a step.
        """
        feet = self.state.foot_position.tolist()
        foot_force = [[0.0] * 4 for _ in range(self.num_robots)]
        leg_force = [[0.0] * 4 for _ in range(self.num_robots)]
        reach = (self.state.geometry.foot_radius + _FOOT_REACH) ** 2
        for client in self._clients:
            for contact in client.getContactPoints(bodyA=client.ground):
                force, link = self._force(contact), contact[4]
                leg = self._leg_of_link.get(link)
                if force <= 0.0 or leg is None:  # None is the trunk
                    continue
                row = client.rows[contact[2]]
                if link in self._calf_links:
                    (x, y, z), (fx, fy, fz) = contact[6], feet[row][leg]
                    if (x - fx) ** 2 + (y - fy) ** 2 + (z - fz) ** 2 < reach:
                        foot_force[row][leg] += force
                        continue
                leg_force[row][leg] += force
        self.state.foot_force = np.array(foot_force)
        self.state.leg_force = np.array(leg_force)

    def ground_height(self, x: Array, y: Array) -> Array:
        """Surface height in m under points of any shape."""
        return np.zeros_like(x) if self.field is None else self.field.height_at(x, y)

    def support_height(self, x: Array, y: Array) -> Array:
        """Height in m of the support surface of the fall rule: trenches filled, no pillars."""
        return np.zeros_like(x) if self.field is None else self.field.support_at(x, y)

    def picture(
        self,
        row: int,
        width: int = 640,
        height: int = 400,
        azimuth: float = -0.9,
        elevation: float = 0.33,
        distance: float = 1.4,
        target: Array | None = None,
    ) -> NDArray[np.uint8]:
        """Robot ``row`` and its ground from the side, (height, width, 3), without a display.

        The camera looks at ``target`` (3,) m, the trunk by default, from ``distance`` m away:
        ``azimuth`` rad from the world's x axis and ``elevation`` rad above the target. Worlds that
        were not made with ``visual`` have nothing to show.
        """
        client = self._client_of[row]
        target = self.state.position[row] if target is None else target
        away = [np.cos(azimuth), np.sin(azimuth), np.tan(elevation)]
        eye = target + distance * np.cos(elevation) * np.array(away)
        _, _, pixels, _, bodies = client.getCameraImage(
            width,
            height,
            client.computeViewMatrix(eye.tolist(), target.tolist(), [0.0, 0.0, 1.0]),
            client.computeProjectionMatrixFOV(45.0, width / height, 0.05, 30.0),
            renderer=pybullet.ER_TINY_RENDERER,
            lightDirection=[0.5, -1.0, 2.0],
        )
        image = np.reshape(pixels, (height, width, 4))[..., :3].astype(np.uint8)
        image[np.reshape(bodies, (height, width)) < 0] = _SKY  # -1 is no body
        return image

    def close(self) -> None:
        """Disconnect from Bullet; the world is of no use afterwards."""
        for client in self._clients:
            if client.isConnected():  # a window may have been closed by hand
                client.disconnect()
        self._clients.clear()


def check_robot(robot: RobotConfig, physics: PhysicsConfig) -> None:
    """See that such a robot can be simulated.

    Raises:
        ConfigError: a URDF that cannot be used; names it.
    """
    World(1, robot, physics).close()


class WindowError(RuntimeError):
    """Bullet's window cannot be opened, or was closed; the message is one line."""


def check_display() -> None:
    """Ask for a display before Bullet does: it would end the whole process without one.

    Raises:
        WindowError: there is none.
    """
    if sys.platform != "linux":
        return  # elsewhere the system always has one
    name = os.environ.get("DISPLAY", "")
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError as error:
        raise WindowError("Bullet's window needs X11, and libX11.so.6 is not installed") from error
    x11.XOpenDisplay.argtypes, x11.XOpenDisplay.restype = [ctypes.c_char_p], ctypes.c_void_p
    x11.XCloseDisplay.argtypes = [ctypes.c_void_p]
    display = x11.XOpenDisplay(None) if name else None
    if not display:
        raise WindowError(f"Bullet's window needs a display; DISPLAY='{name}' is none")
    x11.XCloseDisplay(display)


class Stage(World):
    """One robot on its tile, moved by hand and not simulated: for films and Bullet's window.

    Args:
        robot, physics, field: as in ``World``.
        window: open Bullet's window.

    Raises:
        WindowError: no display.
    """

    def __init__(
        self, robot: RobotConfig, physics: PhysicsConfig, field: TileField, window: bool = False
    ) -> None:
        if window:
            check_display()
        super().__init__(1, robot, physics, field, visual=True, window=window)
        self._client = self._clients[0]
        self._sliders: list[int] = []
        self._text = -1  # none yet
        if window:
            for flag in (
                pybullet.COV_ENABLE_RGB_BUFFER_PREVIEW,
                pybullet.COV_ENABLE_DEPTH_BUFFER_PREVIEW,
                pybullet.COV_ENABLE_SEGMENTATION_MARK_PREVIEW,
            ):
                self._client.configureDebugVisualizer(flag, 0)
            # As the films have it: from behind, to the right and above.
            self._client.resetDebugVisualizerCamera(1.8, -50.0, -29.0, [0.0, 0.0, 0.0])

    def show(self, position: Array, quaternion: Array, q: Array) -> None:
        """Put the robot at ``position`` (3,), ``quaternion`` (4,) with joint angles ``q`` (12,).

        Raises:
            WindowError: the window was closed.
        """
        with self._in_window():
            self.reset_robots([0], position[None], quaternion[None], q[None])

    def paint(self, texture: Path) -> None:
        """Lay a picture over the tile: its rows run along y, its columns against x."""
        image = self._client.loadTexture(str(texture))
        self._client.changeVisualShape(
            self._client.ground, -1, textureUniqueId=image, rgbaColor=[1.0] * 4
        )

    def mark(self, foot: Array, colour: tuple[float, float, float]) -> None:
        """A pole with a ball on top, 0.8 m tall, its foot at ``foot`` (3,) m."""
        for kind, height, size in (
            (pybullet.GEOM_CYLINDER, 0.4, {"radius": 0.015, "length": 0.8}),
            (pybullet.GEOM_SPHERE, 0.8, {"radius": 0.06}),
        ):
            shape = self._client.createVisualShape(kind, rgbaColor=[*colour, 1.0], **size)
            self._client.createMultiBody(0.0, -1, shape, basePosition=foot + [0.0, 0.0, height])

    # ------------------------------------------------------------------ the window

    def add_slider(self, name: str, low: float, high: float, start: float) -> None:
        """A slider in the window; where ``low`` is above ``high``, a button that counts."""
        self._sliders.append(self._client.addUserDebugParameter(name, low, high, start))

    def read_sliders(self) -> Array:
        """Where all sliders stand, in the order in which they were added.

        Raises:
            WindowError: the window was closed.
        """
        with self._in_window():
            return np.array([self._client.readUserDebugParameter(i) for i in self._sliders])

    def follow(self, text: str) -> None:
        """Turn the window's camera to the robot, as far and from where it is; ``text`` above it.

        Raises:
            WindowError: the window was closed.
        """
        position, black = self.state.position[0], [0.0, 0.0, 0.0]
        with self._in_window():
            yaw, pitch, distance = self._client.getDebugVisualizerCamera()[8:11]
            self._client.resetDebugVisualizerCamera(distance, yaw, pitch, position.tolist())
            # Bullet writes from there to the right, so that begins at the left of the robot.
            turn, away = np.radians(yaw), 0.35 * distance
            place = position + [-away * np.cos(turn), -away * np.sin(turn), 0.35]
            self._text = self._client.addUserDebugText(
                text, place.tolist(), black, 1.0, replaceItemUniqueId=self._text
            )

    @contextlib.contextmanager
    def _in_window(self) -> Iterator[None]:
        """Bullet's errors in here are the window's, where that was closed."""
        try:
            yield
        except pybullet.error as error:
            if self._client.isConnected():
                raise
            raise WindowError("the window was closed") from error
