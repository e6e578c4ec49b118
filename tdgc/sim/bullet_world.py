"""A Bullet world of M robots: the only module that imports pybullet.

A collision mask lets robots pass through each other.
"""

import functools
import importlib
import os
import time
from collections.abc import Callable, Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tdgc.config import ConfigError, PhysicsConfig, RobotConfig
from tdgc.sim.geometry import geometry_of
from tdgc.sim.robot import (
    GRAVITY,
    NUM_JOINTS,
    Array,
    check_nominal_pose,
    pd_torque,
    quaternion_product,
    rotation_matrix,
)
from tdgc.sim.rotors import excess_momentum, force_on_calf
from tdgc.sim.tile import CELL, HEIGHT_RANGE, TILE_SAMPLES, TileField
from tdgc.sim.urdf import JOINTS, merged_file, read_urdf, urdf_path
from tdgc.sim.world import World

_GROUND, _ROBOT = 1, 2  # collision groups: robots collide with the ground only
_TRUNK = -1  # Bullet's index of a body's root link
_PARKED = 50.0  # m, lift that clears all terrain, which stays within HEIGHT_RANGE
_SKY = (226, 234, 243)  # light enough for print, and the robot's white shell stands out
# m, chosen by hand: a calf this close to the ground is in contact, even if it does not press.
_TOUCHES = 0.0005
#: rad/s^2: a leg in contact is held against what rotors give back only if that exceeds this times
#: J. So feet that meet a riser at less than 0.4 m/s bounce back; half of it would halve that speed,
#: but twice as many legs would be looked up.
_FELT = 500.0
# m beyond the foot's radius, chosen by hand: nearer calf contacts are the foot's.
_FOOT_REACH = 0.03


def _load() -> Any:
    """Import PyBullet without its build-time message, which every process would print over
    progress bars."""
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

    pybullet_utils' BulletClient binds at every call, which costs as much as a short call. Here
    each function is bound once, on first use.
    """

    def __init__(self, robots: tuple[int, int], window: bool) -> None:
        self.id: int = pybullet.connect(pybullet.GUI if window else pybullet.DIRECT)
        self.robots = robots  # rows of the world: the first, and one past the last
        self.rows: dict[int, int] = {}  # body of this client -> row of the world
        self.ground = -1
        self.shape = -1
        self.samples = slice(0, 0)  # this client's part of the field, along x

    def __getattr__(self, name: str) -> Callable[..., Any]:
        bound = functools.partial(getattr(pybullet, name), physicsClientId=self.id)
        setattr(self, name, bound)
        return bound


#: Robots per Bullet client. For each robot's island Bullet walks all constraints of the client, so
#: the time per robot grows with their number. On a plane without rotors, a step takes 44 us per
#: robot with 5 robots in a client, 46 with 10, 54 with 25, 75 with 50 and 122 with 100. Each client
#: costs Python time as well, more with rotors; on a plane, where Bullet's share is smaller, 36
#: robots with rotors are 12 % faster in two clients than in four.
CLIENT_ROBOTS, PLANE_CLIENT_ROBOTS = 10, 20


class BulletWorld(World):
    """M robots on a plane, or each on its own tile of a field, simulated by Bullet.

    Robots are spread over Bullet clients with at most ``CLIENT_ROBOTS`` each, or
    ``PLANE_CLIENT_ROBOTS`` on a plane; a client holds only its own robots' part of the field.
    Rotors are simulated as in ``tdgc.sim.rotors``.

    Args:
        num_robots, robot, physics, field: as in ``World``.
        visual: load what pictures need.
        window: open Bullet's own window.

    Raises:
        ConfigError: the robot's URDF is missing, or not of a robot that this package can drive.
        ValueError: ``field`` has not one tile per robot.

    Attributes:
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
        urdf = read_urdf(robot)
        super().__init__(num_robots, robot, physics, field, geometry_of(urdf))
        check_nominal_pose(robot, self.state.geometry)
        self._visual = visual
        self.bullet_seconds = 0.0
        self._clients: list[_Client] = []
        self._bodies: list[int] = []
        self._client_of: list[_Client] = []
        parts = -(-num_robots // (PLANE_CLIENT_ROBOTS if field is None else CLIENT_ROBOTS))
        try:
            with merged_file(urdf) as file:
                for rows in np.array_split(np.arange(num_robots), parts):
                    self._connect(rows, file, window)
        except BaseException:
            self.close()
            raise
        trunk = self._client_of[0].getDynamicsInfo(self._bodies[0], _TRUNK)
        # Bullet's pose of a robot is that of the trunk's inertial frame: these are the centre of
        # mass and the orientation of the principal axes in the trunk's frame.
        self._centre, self._axes = map(np.array, trunk[3:5])
        self._to_axes = rotation_matrix(self._axes[None])[0].T
        self._inertia = {link: self._links_inertia(link) for link in (_TRUNK, *self._joints)}

    def _connect(self, rows: NDArray[np.int64], urdf: Path, window: bool) -> None:
        """Create a client for the robots ``rows`` (n,), with their ground."""
        client = _Client((int(rows[0]), int(rows[-1]) + 1), window)
        self._clients.append(client)
        client.setGravity(0.0, 0.0, -GRAVITY)
        # The solver must not stop early: the worst residual would couple the robots.
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

    def _make_ground(self, client: _Client) -> None:
        if self.field is None:
            shape = client.createCollisionShape(pybullet.GEOM_PLANE)
            client.ground = client.createMultiBody(0.0, shape)
        else:
            client.samples = slice(*(TILE_SAMPLES * row for row in client.robots))
            heights = self.field.heights[client.samples]
            low, high = float(heights.min()), float(heights.max())
            if heights.flags.writeable:
                # Bullet keeps the height range of the first upload, so that spans everything
                # that tiles can ever need; the second sends the heights.
                low, high = HEIGHT_RANGE
                spanning = np.zeros_like(heights)
                spanning[0, 0], spanning[0, 1] = HEIGHT_RANGE
                client.shape = self._upload(client, spanning, -1)
                self._upload(client, heights, client.shape)
            else:
                client.shape = self._upload(client, heights, -1)
            nx, ny = heights.shape
            centre = [
                (client.samples.start + 0.5 * (nx - 1)) * CELL,
                0.5 * (ny - 1) * CELL,
                0.5 * (low + high),
            ]
            # Without another visual shape, Bullet keeps 360 bytes per sample to draw the field.
            drawn = -1
            if not self._visual:
                drawn = client.createVisualShape(pybullet.GEOM_SPHERE, radius=0.001)
            client.ground = client.createMultiBody(0.0, client.shape, drawn, basePosition=centre)
        client.changeDynamics(client.ground, -1, lateralFriction=1.0)  # the feet set the friction
        client.setCollisionFilterGroupMask(client.ground, -1, _GROUND, _ROBOT)

    def _upload(self, client: _Client, heights: NDArray[np.float32], replace: int) -> int:
        """Send heights to Bullet after checking their range, which Bullet does not."""
        low, high = float(heights.min()), float(heights.max())
        if low < HEIGHT_RANGE[0] or high > HEIGHT_RANGE[1]:
            raise ValueError(f"heights {low:.2f}..{high:.2f} m leave {HEIGHT_RANGE} m")
        return int(
            client.createCollisionShape(
                pybullet.GEOM_HEIGHTFIELD,
                meshScale=[CELL, CELL, 1.0],
                heightfieldData=heights.T.ravel(),  # Bullet's rows run along x
                numHeightfieldRows=heights.shape[0],
                numHeightfieldColumns=heights.shape[1],
                replaceHeightfieldIndex=replace,
            )
        )

    def upload_terrain(self, index: ArrayLike | None = None) -> None:
        """Send the field's heights to Bullet after they were changed in place.

        With ``index`` only the clients of those robots are updated. This takes about 1 us for each
        sample of these clients: do it at the end of an episode, not in every step.

        Raises:
            ValueError: heights outside ``HEIGHT_RANGE``.
        """
        assert self.field is not None, "a plane has no heights"
        rows = range(self.num_robots) if index is None else np.asarray(index)
        for client in dict.fromkeys(self._client_of[i] for i in rows):
            self._upload(client, self.field.heights[client.samples], client.shape)

    def _load_robot(self, client: _Client, place: int, urdf: Path) -> int:
        # Far apart and high up, so that nothing is in contact before the first reset.
        try:
            body = client.loadURDF(
                str(urdf),
                basePosition=[2.0 * place, 0.0, _PARKED],
                flags=pybullet.URDF_USE_INERTIA_FROM_FILE
                | (0 if self._visual else pybullet.URDF_IGNORE_VISUAL_SHAPES),
            )
        except pybullet.error as error:  # a missing mesh, an element it cannot read
            path = urdf_path(self.robot)
            raise ConfigError(f"{path}: Bullet cannot load it, see above") from error
        links = range(client.getNumJoints(body))
        found = {client.getJointInfo(body, link)[1].decode(): link for link in links}
        self._joints = [found[name] for name in JOINTS]
        self._leg_of_link = {link: k // 3 for k, link in enumerate(self._joints)}
        self._calf_links = set(self._joints[2::3])
        # Bullet has one speed limit per body, so it gets the slowest joint's: a calf at the other
        # joints' 30 rad/s would move its foot by more than the foot's radius in a step.
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
            # Not in the call above: together with damping, PyBullet would set it on the trunk.
            client.changeDynamics(body, link, lateralFriction=self.physics.friction)
        # Switch off Bullet's default velocity motors, which would hold the joints.
        client.setJointMotorControlArray(
            body, self._joints, pybullet.VELOCITY_CONTROL, forces=[0.0] * NUM_JOINTS
        )
        return int(body)

    def _put(self, i: int) -> None:
        body, client, state = self._bodies[i], self._client_of[i], self.state
        self._place_trunk(i, state.position[i])
        self._move_trunk(i)
        for joint, angle, speed in zip(self._joints, state.q[i], state.qd[i], strict=True):
            client.resetJointState(body, joint, angle, speed)

    def _to_centre(self, i: int) -> Array:
        """Vector from the trunk's origin to its centre of mass in the world frame, (3,) m."""
        return rotation_matrix(self.state.quaternion[i : i + 1])[0] @ self._centre

    def _place_trunk(self, i: int, position: Array) -> None:
        """Move the trunk of robot ``i`` to ``position`` (3,), with its orientation in ``state``."""
        self._client_of[i].resetBasePositionAndOrientation(
            self._bodies[i],
            position + self._to_centre(i),
            quaternion_product(self.state.quaternion[i], self._axes),
        )

    def _move_trunk(self, i: int) -> None:
        lin_vel, ang_vel = self.state.lin_vel[i], self.state.ang_vel[i]
        self._client_of[i].resetBaseVelocity(
            self._bodies[i], lin_vel + np.cross(ang_vel, self._to_centre(i)), ang_vel
        )

    def _read_trunks(self, live: NDArray[np.integer]) -> None:
        """Read the trunk poses and velocities of the robots ``live`` into ``state``."""
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
        # Every robot spends one ``stepSimulation`` high above the ground.
        for i in self._active:
            self._place_trunk(int(i), self.state.position[i] + [0.0, 0.0, _PARKED])
        for client in dict.fromkeys(self._client_of[i] for i in self._active):
            client.stepSimulation()
        for i in self._active:
            self._put(int(i))

    def _links_inertia(self, link: int) -> tuple[Array, Array]:
        """A link's inertia about its principal axes, (3,) kg m^2, and the number of rotors that
        turn about the axis closest to each, (3,): of its own joint and of those it carries."""
        _, _, inertia, _, quaternion, *_ = self._client_of[0].getDynamicsInfo(self._bodies[0], link)
        part = -1 if link == _TRUNK else self._joints.index(link) % 3
        forward, leftward = [(4, 0), (1, 1), (0, 2), (0, 1)][part + 1]  # trunk, hip, thigh, calf
        axes = np.abs(rotation_matrix(np.array([quaternion]))[0])  # one in each column
        rotors = np.zeros(3)
        rotors[axes[0].argmax()] += forward
        rotors[axes[1].argmax()] += leftward
        return np.array(inertia), rotors

    def apply_dynamics(self, index: ArrayLike) -> None:
        nominal = self.state.geometry.trunk_mass
        for i in np.asarray(index):
            body, client = self._bodies[i], self._client_of[i]
            friction, mass = float(self.friction[i]), nominal + float(self.payload[i])
            for link in (_TRUNK, *sorted(self._joints)):
                client.changeDynamics(body, link, lateralFriction=friction)
            client.changeDynamics(body, _TRUNK, mass=mass)  # first: it resets the inertia
            for link, (inertia, rotors) in self._inertia.items():
                # The payload is spread over the trunk, so the inertia scales with the mass.
                grown = inertia * (mass / nominal) if link == _TRUNK else inertia
                about = (grown + float(self.armature[i]) * rotors).tolist()
                client.changeDynamics(body, link, localInertiaDiagonal=about)

    def retire(self, index: ArrayLike) -> None:
        for i in np.asarray(index):
            self._client_of[i].removeBody(self._bodies[i])
        self._active = np.setdiff1d(self._active, index)

    def step(self, targets: Array, delay: Array, offset: Array) -> None:
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

    def _step_client(self, client: _Client, live: NDArray[np.integer], wanted: Array) -> None:
        """Run all physics steps of one client's robots ``live`` (n,), with joint targets ``wanted``
        (k, n, 12) rad at each of k joint controls.

        Clients run one after another because the CPU cache holds one of them but not all: with 50
        robots in 5 clients, Bullet took 1.5 times as long when they alternated at every physics
        step.
        """
        joints, state = self._joints, self.state
        bodies = [self._bodies[i] for i in live]
        dt = self.physics.hold * self.physics.dt
        # Called for every robot and joint control; even a client's bound functions are too slow.
        command, measure = pybullet.setJointMotorControlArray, pybullet.getJointStates
        strength, friction = self.strength[live], self.joint_friction[live]
        q, qd = state.q[live], state.qd[live]
        armature = self.armature[live]
        excess = np.where(armature[:, None] > 0.0, state.rotor_excess[live], 0.0)
        rotors = armature.any()
        if rotors:
            rotation, momentum, _ = self._excess(client, bodies, q, qd)
        for target in wanted:
            torque = pd_torque(target - q, qd, strength, self.robot, friction)
            applied = torque + excess[:, :NUM_JOINTS]
            for body, forces in zip(bodies, applied.tolist(), strict=True):
                command(
                    body, joints, pybullet.TORQUE_CONTROL, forces=forces, physicsClientId=client.id
                )
            if rotors:
                about = (rotation @ excess[:, NUM_JOINTS:, None])[..., 0].tolist()
                for body, turn in zip(bodies, about, strict=True):
                    pybullet.applyExternalTorque(
                        body, _TRUNK, turn, pybullet.WORLD_FRAME, physicsClientId=client.id
                    )
                for held in self._held(client, bodies, armature, rotation, q, excess):
                    pybullet.applyExternalForce(*held, pybullet.WORLD_FRAME, client.id)
            started = time.perf_counter()
            client.stepSimulation()
            self.bullet_seconds += time.perf_counter() - started
            flat = [s for body in bodies for s in measure(body, joints, client.id)]
            q, qd = (
                np.fromiter(map(itemgetter(k), flat), np.float64, len(flat)).reshape(q.shape)
                for k in (0, 1)
            )
            if rotors:
                before = momentum
                rotation, momentum, turning = self._excess(client, bodies, q, qd)
                excess = armature[:, None] * ((momentum - before) / dt + turning)
            pressed: dict[int, float] = {}  # row -> N on its trunk, usually empty
            for contact in client.getContactPoints(bodyA=client.ground, linkIndexB=_TRUNK):
                row = client.rows[contact[2]]
                pressed[row] = pressed.get(row, 0.0) + self._force(contact)
            for row, force in pressed.items():
                state.trunk_force[row] = max(force, state.trunk_force[row])
        state.q[live], state.qd[live], state.torque[live] = q, qd, torque
        state.rotor_excess[live] = excess

    def _excess(
        self, client: _Client, bodies: list[int], q: Array, qd: Array
    ) -> tuple[Array, Array, Array]:
        """Rotation matrices of the trunks of ``bodies`` (n,), (n, 3, 3), and the two parts of
        ``excess_momentum``, (n, 15) each."""
        turned = [pybullet.getBasePositionAndOrientation(body, client.id)[1] for body in bodies]
        ang_vel = np.array([pybullet.getBaseVelocity(body, client.id)[1] for body in bodies])
        rotation = rotation_matrix(np.array(turned)) @ self._to_axes
        return rotation, *excess_momentum((ang_vel[:, None] @ rotation)[:, 0], q, qd)

    def _held(
        self,
        client: _Client,
        bodies: list[int],
        armature: Array,
        rotation: Array,
        q: Array,
        excess: Array,
    ) -> Iterator[tuple[int, int, list[float], tuple[float, ...]]]:
        """Forces that keep the calves of ``bodies`` (n,) where they touch the ground, against
        ``excess`` (n, 15) where it would lift them: body, link, force and point in the world."""
        torque = excess[:, :NUM_JOINTS].reshape(-1, 4, 3)
        large = (np.abs(torque) > _FELT * armature[:, None, None]).any(axis=2)
        for k, leg in np.argwhere(large).tolist():
            body, link, turn = bodies[k], self._joints[3 * leg + 2], rotation[k]
            # One call per leg: they are few, and reading all contacts takes longer.
            for contact in pybullet.getContactPoints(client.ground, body, -1, link, client.id):
                if contact[9] <= 0.0 and contact[8] > _TOUCHES:
                    continue
                centre, _ = pybullet.getBasePositionAndOrientation(body, client.id)
                point, (nx, ny, nz) = contact[6:8]  # on the calf; the normal, into the ground
                place = np.subtract(point, centre) @ turn + self._centre
                angles = q[k, 3 * leg : 3 * leg + 3]
                force = force_on_calf(self.state.geometry, leg, angles, place, torque[k, leg])
                fx, fy, fz = (turn @ force).tolist()
                if fx * nx + fy * ny + fz * nz < 0.0:
                    yield body, link, [-fx, -fy, -fz], point
                    break

    def _force(self, contact: tuple[Any, ...]) -> float:
        """Normal force of a contact in N.

        Bullet divides the impulse of its last internal step by the duration of all of them.
        """
        return float(contact[9] * self.physics.hold)

    def _read_contacts(self) -> None:
        """Read the forces of the last physics step on the feet and on the legs above them.

        The foot is the end of the calf link, so a calf contact counts as the foot's when it is
        within reach of the foot's centre. The sums are plain lists, because indexing arrays one
        contact at a time would take longer than the rest of a step.
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
        """Render robot ``row`` and its ground, (height, width, 3); needs no display.

        The camera looks at ``target`` (3,) m, the trunk by default, from ``distance`` m away,
        ``azimuth`` rad from the world's x axis and ``elevation`` rad above the target. The world
        must have been created with ``visual``.
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
        image[np.reshape(bodies, (height, width)) < 0] = _SKY  # -1: background
        return image

    def close(self) -> None:
        for client in self._clients:
            if client.isConnected():  # the user may have closed the window
                client.disconnect()
        self._clients.clear()
