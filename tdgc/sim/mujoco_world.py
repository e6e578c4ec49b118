"""A robot on its tile in MuJoCo: the only module that imports mujoco.

Robot, ground and joint control match the Bullet world: the same URDF, the same surface and the same
PD law. Contacts, integration and the rotor inertia of the motors are MuJoCo's.
"""

import contextlib
import time
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tdgc.config import ConfigError, PhysicsConfig, RobotConfig
from tdgc.config.settings import NotNegative, Positive
from tdgc.sim.display import WindowError, check_display
from tdgc.sim.geometry import read_geometry
from tdgc.sim.robot import GRAVITY, Array, pd_torque, rotation_matrix
from tdgc.sim.tile import CELL, TileField
from tdgc.sim.urdf import JOINTS, urdf_path
from tdgc.sim.world import World

# Otherwise MuJoCo writes to MUJOCO_LOG.TXT in the working folder that a simulation diverges, which
# the closed loop notices by itself.
mujoco.set_mju_user_warning(lambda _: None)

_CONES = {"elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC, "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL}
_NAME = "ground"
_BASE = 0.5  # m of ground below its lowest point: MuJoCo's height fields are solid
# Codes of the part that a geom belongs to: ground, trunk, a foot, a leg above it (the last two
# plus the leg's index, 0-3).
_GROUND, _TRUNK, _FOOT, _LEG = -1, 0, 1, 5


@dataclass(frozen=True)
class MujocoConfig:
    """MuJoCo's settings; docs/mujoco.md gives the reason for each."""

    timestep: Positive = 0.0025  # s, Bullet's on terrain
    # s, time constant of contacts and joint limits. At MuJoCo's default of 0.02 s feet sink 3-4 cm
    # into the ground, past their centres, and stay there.
    solref: Positive = 0.005
    # Damping ratio of the same. At MuJoCo's default of 1, feet that land at 1 m/s leave the
    # ground again at 0.10 m/s; at 2 they stay down nearly as in Bullet, at 0.04 m/s.
    dampratio: Positive = 2.0
    # With pyramidal cones and MuJoCo's default impratio of 1, feet creep down slopes.
    cone: Literal["elliptic", "pyramidal"] = "elliptic"
    impratio: Positive = 100.0
    friction: NotNegative = 0.8  # foot on ground, nominal (benchmark)
    armature: NotNegative = 0.01  # kg m^2, rotor inertia of each joint, as in models of such robots
    joint_friction: NotNegative = 0.0  # N m, dry friction of each joint

    def physics(self, control_dt: float, joint_rate: float) -> PhysicsConfig:
        """Time steps of control, joint control and physics.

        Args:
            control_dt: s, duration of a control step.
            joint_rate: Hz, rate at which joint torques are computed.

        Raises:
            ConfigError: ``timestep`` does not divide the step of the joint control, or is too long
                for ``solref``.
        """
        if self.solref < 2.0 * self.timestep:  # MuJoCo would replace it by that
            raise ConfigError(
                f"'solref' must be at least twice 'timestep', {2.0 * self.timestep:g} s, not "
                f"{self.solref:g}"
            )
        joint_dt = 1.0 / joint_rate
        substeps, hold = round(control_dt / self.timestep), round(joint_dt / self.timestep)
        steps = np.array([substeps, hold]) * self.timestep
        if not np.allclose(steps, [control_dt, joint_dt]):
            raise ConfigError(
                f"'timestep' must divide the joint control's step, {joint_dt:g} s, not "
                f"{self.timestep:g}"
            )
        return PhysicsConfig(control_dt, substeps, hold, friction=self.friction)


class MujocoWorld(World):
    """One robot on the only tile of a field, simulated by MuJoCo instead of Bullet.

    ``armature`` is added to that of the settings; dry friction is that of the settings, and
    ``joint_friction`` is not used.

    Args:
        robot: its URDF, gains and limits.
        physics: as returned by ``config.physics``.
        field: one tile.
        config: MuJoCo's settings.
        visual: keep shapes that only a window shows.

    Raises:
        ConfigError: a URDF that MuJoCo cannot load.
    """

    def __init__(
        self,
        robot: RobotConfig,
        physics: PhysicsConfig,
        field: TileField,
        config: MujocoConfig,
        visual: bool = False,
    ) -> None:
        super().__init__(1, robot, physics, field, read_geometry(robot))
        self.model = _build(robot, field, config, visual)
        self.data = mujoco.MjData(self.model)
        joints = [self.model.joint(name) for name in JOINTS]
        self._q = np.array([joint.qposadr[0] for joint in joints])
        self._qd = np.array([joint.dofadr[0] for joint in joints])
        self._part = self._parts()
        trunk = self.model.body(1)
        self._trunk = trunk.mass.copy(), trunk.inertia.copy()
        self._rotor = config.armature

    def _parts(self) -> NDArray[np.int64]:
        """Code of the part that each geom belongs to."""
        model = self.model
        carrier = model.body_weldid[model.geom_bodyid]  # bodies fixed to a link count as that link
        parts = np.where(model.geom_bodyid == 0, _GROUND, _TRUNK)
        for k, name in enumerate(JOINTS):
            parts[carrier == model.joint(name).bodyid[0]] = _LEG + k // 3
        mujoco.mj_kinematics(model, self.data)
        feet = self.state.foot_body[0]  # trunk at the origin, joint angles 0, as in ``data``
        for leg in range(4):
            mine = np.flatnonzero((parts == _LEG + leg) & (model.geom_contype > 0))
            away = np.linalg.norm(self.data.geom_xpos[mine] - feet[leg], axis=1)
            parts[mine[away.argmin()]] = _FOOT + leg
        return parts

    def _put(self, i: int) -> None:
        state, data = self.state, self.data
        mujoco.mj_resetData(self.model, data)
        data.qpos[:3], data.qpos[3:7] = state.position[i], np.roll(state.quaternion[i], 1)
        data.qpos[self._q], data.qvel[self._qd] = state.q[i], state.qd[i]
        self._move_trunk(i)

    def _move_trunk(self, i: int) -> None:
        state, velocity = self.state, self.data.qvel
        turn = rotation_matrix(state.quaternion)[i].T
        velocity[:3], velocity[3:6] = state.lin_vel[i], turn @ state.ang_vel[i]

    def apply_dynamics(self, index: ArrayLike) -> None:
        model, (mass, inertia) = self.model, self._trunk
        # The payload is spread over the trunk, so the inertia scales with the mass.
        share = (mass + self.payload) / mass
        model.body(1).mass, model.body(1).inertia = share * mass, share * inertia
        model.geom_friction[:, 0] = self.friction[0]  # MuJoCo takes the larger of two in contact
        model.dof_armature[self._qd] = self._rotor + self.armature
        mujoco.mj_setConst(model, mujoco.MjData(model))  # on scratch data, as it moves the robot

    def retire(self, index: ArrayLike) -> None:
        """Do nothing: the episode of the only robot has ended."""

    def forget(self) -> None:
        self._put(0)

    def step(self, targets: Array, delay: Array, offset: Array) -> None:
        model, data, state = self.model, self.data, self.state
        state.trunk_force = np.zeros(1)
        for target in self._wanted(targets, delay, offset):
            error, speed = target - data.qpos[self._q], data.qvel[self._qd]
            state.torque = pd_torque(error, speed[None], self.strength, self.robot)
            data.qfrc_applied[self._qd] = state.torque[0]
            for _ in range(self.physics.hold):
                mujoco.mj_step(model, data)
                force = self._contact_force()
                state.trunk_force[0] = max(force[_TRUNK], state.trunk_force[0])
        state.foot_force[0], state.leg_force[0] = force[_FOOT:_LEG], force[_LEG:]
        state.position[0], state.quaternion[0] = data.qpos[:3], np.roll(data.qpos[3:7], -1)
        state.q[0], state.qd[0] = data.qpos[self._q], data.qvel[self._qd]
        state.lin_vel[0] = data.qvel[:3]
        state.ang_vel[0] = rotation_matrix(state.quaternion)[0] @ data.qvel[3:6]
        state.derive()

    def _contact_force(self) -> Array:
        """Normal force on the trunk, the feet and the legs in the last physics step, (9,) N."""
        force, wrench = np.zeros(_LEG + 4), np.zeros(6)
        parts = self._part[self.data.contact.geom].max(axis=1)  # the robot's, not the ground's
        for k, part in enumerate(parts):
            mujoco.mj_contactForce(self.model, self.data, k, wrench)
            force[part] += wrench[0]
        return force

    def close(self) -> None:
        """Do nothing: MuJoCo has nothing to close."""


def _build(
    robot: RobotConfig, field: TileField, config: MujocoConfig, visual: bool
) -> mujoco.MjModel:
    """Model of the robot and its ground."""
    path = urdf_path(robot)
    try:
        spec = _with_visuals(path) if visual else mujoco.MjSpec.from_file(str(path))
        spec.compiler.fusestatic = False  # True would weld the trunk to the world
        spec.worldbody.first_body().add_freejoint()
        _add_ground(spec, field)
        _set(spec, config)
        return spec.compile()
    except ValueError as error:  # a missing mesh, an element it cannot read
        raise ConfigError(f"{path}: MuJoCo cannot load it: {error}") from error


def _with_visuals(urdf: Path) -> mujoco.MjSpec:
    """The robot with the visual shapes that MuJoCo discards by default, except meshes."""
    tree = ElementTree.fromstring(urdf.read_text(encoding="utf-8"))
    for link in tree.iter("link"):
        for shape in link.findall("visual"):
            if shape.find("geometry/mesh") is not None:
                link.remove(shape)
    compiler = ElementTree.SubElement(ElementTree.SubElement(tree, "mujoco"), "compiler")
    compiler.set("discardvisual", "false")
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(tree, encoding="unicode"))
    spec.modelfiledir = str(urdf.resolve().parent)  # where collision meshes are looked for
    return spec


def _add_ground(spec: mujoco.MjSpec, field: TileField) -> None:
    """Add the field's surface.

    MuJoCo and Bullet split a cell along different diagonals, and their surfaces would differ by up
    to 5 mm on rough ground. So the field is rotated by a quarter turn: its columns run along y, its
    rows against x.
    """
    half_x, half_y = 0.5 * CELL * (np.array(field.heights.shape) - 1)
    low, high = float(field.heights.min()), float(field.heights.max())
    spec.add_hfield(
        name=_NAME,
        size=[half_y, half_x, high - low or _BASE, _BASE],  # flat ground has nothing to scale
        nrow=field.heights.shape[0],
        ncol=field.heights.shape[1],
        userdata=field.heights[::-1].ravel().astype(np.float64),
    )
    spec.worldbody.add_geom(
        name=_NAME,
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname=_NAME,
        pos=[half_x, half_y, low],
        quat=[0.5**0.5, 0.0, 0.0, 0.5**0.5],
        contype=0,
        conaffinity=1,
        rgba=[0.87, 0.84, 0.77, 1.0],
    )


def _set(spec: mujoco.MjSpec, config: MujocoConfig) -> None:
    """Apply the settings to the model."""
    option = spec.option
    option.timestep, option.gravity = config.timestep, [0.0, 0.0, -GRAVITY]
    option.cone, option.impratio = _CONES[config.cone], config.impratio
    # Otherwise a simulation that diverges starts again at the origin, which looks like a fall.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.visual.headlight.ambient = [0.5, 0.5, 0.5]  # the window's only light
    for geom in spec.geoms:
        geom.solref, geom.condim = [config.solref, config.dampratio], 3
        geom.friction[0] = config.friction  # MuJoCo takes the larger of two in contact
        if geom.name != _NAME:  # as in Bullet, a robot collides only with the ground
            geom.conaffinity = 0
    for joint in spec.joints:
        if joint.name not in JOINTS:
            continue
        # Everything that acts on a joint besides its torque is set here and overrides the URDF.
        joint.armature, joint.frictionloss = config.armature, config.joint_friction
        joint.damping = [0.0, 0.0, 0.0]
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        joint.solref_limit = [config.solref, config.dampratio]


class Window(contextlib.ExitStack):
    """A ``Watcher`` that shows an episode in MuJoCo's viewer in real time.

    Raises:
        WindowError: no display, or the window was closed.
    """

    def __init__(self) -> None:
        check_display()
        super().__init__()

    def begin(self, batch: Any) -> None:
        from mujoco import viewer

        world = batch.loco.world
        assert isinstance(world, MujocoWorld)
        self._dt = world.physics.control_dt
        opened = viewer.launch_passive(
            world.model, world.data, show_left_ui=False, show_right_ui=False
        )
        self._shown = self.enter_context(opened)
        self._shown.cam.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        self._shown.cam.trackbodyid, self._shown.cam.distance = 1, 2.0
        self._due = time.perf_counter()

    def step(self, step: int, live: NDArray[np.intp]) -> None:
        if not self._shown.is_running():
            raise WindowError("the window was closed")
        self._shown.sync()
        self._due = max(self._due + self._dt, time.perf_counter())  # delays are not made up
        time.sleep(max(0.0, self._due - time.perf_counter()))
