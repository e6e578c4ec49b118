"""The robot's geometry, read from its URDF, and the checks that the URDF must pass.

The kinematics (``tdgc.sim.robot``) handle one kind of robot: a trunk with four equal legs, mirrored
left to right. The hip turns about the forward axis, the thigh and the calf about the leftward axis;
at zero the legs point straight down. A robot that does not fit is refused here: Bullet would
simulate it, but everything computed outside Bullet would be silently wrong.
"""

from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tdgc.config import ConfigError, RobotConfig
from tdgc.sim.gaits import FEET
from tdgc.sim.urdf import JOINTS, Part, Urdf, called, link_of, mass, named, numbers, read_urdf

Array = NDArray[np.float64]

#: Outward direction of each leg from the trunk's centre: front + and rear -, left + and right -.
FRONT: Array = np.array([1.0 if leg[0] == "F" else -1.0 for leg in FEET])
SIDE: Array = np.array([1.0 if leg[1] == "L" else -1.0 for leg in FEET])

_SAME = 1e-6  # m and rad: tolerance for rounding errors in a generated URDF
#: Axis of each joint, and the coordinates in which its origin may differ from its parent's.
_AXES = {"hip": (1.0, 0.0, 0.0), "thigh": (0.0, 1.0, 0.0), "calf": (0.0, 1.0, 0.0)}
_FREE = {"hip": (True, True, False), "thigh": (False, True, False), "calf": (False, False, True)}
_PLACES = {
    "hip": "x y 0, x > 0 in front and y > 0 on the left",
    "thigh": "0 y 0, y > 0 on the left",
    "calf": "0 0 z, z < 0",
}


@dataclass(frozen=True, eq=False)
class Geometry:
    """What the kinematics, rewards and exports need to know about a robot.

    Attributes:
        hips: positions of the hip joints in the trunk's frame, (4, 2) m forward and left.
        abduction: m, from the hip joint out to the thigh joint.
        thigh, calf: m, from the thigh joint to the calf joint, and from there to the foot's centre.
        foot_radius: m.
        trunk_mass: kg, including what is fixed to the trunk.
        masses: kg of each link, by name.
        joint_limits: lowest and highest angle of each joint, (12, 2) rad.
        motor_limits: torque in N m and speed in rad/s of hip, thigh and calf, (2, 3), the lowest of
            the four legs; infinite where the URDF gives none.
    """

    hips: Array
    abduction: float
    thigh: float
    calf: float
    foot_radius: float
    trunk_mass: float
    masses: dict[str, float]
    joint_limits: Array
    motor_limits: Array


def read_geometry(config: RobotConfig) -> Geometry:
    """Read the geometry of the robot whose URDF ``config`` names; every call reads the file.

    Raises:
        ConfigError: a file that is missing or cannot be read, or see ``geometry_of``.
    """
    return geometry_of(read_urdf(config))


def geometry_of(urdf: Urdf) -> Geometry:
    """The geometry of a robot. docs/robot.md lists what its URDF must have.

    Raises:
        ConfigError: it does not describe a robot of this kind; the message says what is wrong with
            it and what is allowed.
    """
    with named(urdf.path):
        return _measure(urdf)


def _measure(urdf: Urdf) -> Geometry:
    joints, parts = urdf.joints, urdf.parts
    origins = np.stack([_origin(joints[name]) for name in JOINTS]).reshape(4, 3, 3)
    limits = np.stack([_limits(joints[name]) for name in JOINTS]).reshape(4, 3, 2)
    feet = np.stack([_foot(parts[link_of(joints[f"{leg}_calf_joint"], "child")]) for leg in FEET])
    # Right legs are mirrored, so that they can be compared with the left ones.
    mirrored = origins * np.stack([np.ones(4), SIDE, np.ones(4)], axis=1)[:, None]
    turned = np.where(SIDE[:, None] > 0.0, limits[:, 0], -limits[:, 0, ::-1])
    for k, leg in enumerate(FEET):
        left = f"{leg[0]}L"
        pair = FEET.index(left)
        for what, seen, where, other in (
            ("the origin of {}_hip_joint", mirrored[:, 0], pair, left),
            ("the limits of {}_hip_joint", turned, pair, left),
            ("the limits of {}_thigh_joint", limits[:, 1], pair, left),
            ("the limits of {}_calf_joint", limits[:, 2], pair, left),
            ("the origin of {}_thigh_joint", mirrored[:, 1], 0, FEET[0]),
            ("the origin of {}_calf_joint", mirrored[:, 2], 0, FEET[0]),
            ("the foot of {}", feet, 0, FEET[0]),
        ):
            if not _same(seen[k], seen[where]):
                wrong, right = what.format(leg), what.format(other)
                raise ConfigError(
                    f"{wrong} does not fit {right}: legs must be equal, mirrored left to right"
                )
    return Geometry(
        hips=origins[:, 0, :2],
        abduction=float(origins[0, 1, 1]),
        thigh=float(-origins[0, 2, 2]),
        calf=float(-feet[0, 0]),
        foot_radius=float(feet[0, 1]),
        trunk_mass=sum(mass(p.link) for p in parts[link_of(joints["FL_hip_joint"], "parent")]),
        masses={p.link.get("name", ""): mass(p.link) for own in parts.values() for p in own},
        joint_limits=limits.reshape(len(JOINTS), 2),
        motor_limits=np.stack(
            [[_motor_limit(joints[name], key) for name in JOINTS] for key in ("effort", "velocity")]
        )
        .reshape(2, 4, 3)
        .min(axis=1),
    )


def _origin(joint: Element) -> Array:
    """Position of a joint in its parent's frame, (3,) m; its type and axis are checked as well."""
    name = joint.get("name", "")
    leg, part = name.split("_")[:2]
    axis = numbers(joint, "axis", "xyz", "1 0 0")
    if joint.get("type") != "revolute" or not _same(axis, _AXES[part]):
        wanted = " ".join(f"{a:g}" for a in _AXES[part])
        raise ConfigError(f"{called(joint)}: must be revolute about the axis {wanted}")
    origin = numbers(joint, "origin", "xyz", "0 0 0")
    outward = origin * [FRONT[FEET.index(leg)], SIDE[FEET.index(leg)], -1.0]
    free = np.array(_FREE[part])
    if not _same(numbers(joint, "origin", "rpy", "0 0 0"), 0.0):
        raise ConfigError(f"{called(joint)}: its origin must not be turned, rpy 0 0 0")
    if not (_same(origin[~free], 0.0) and (outward[free] > _SAME).all()):
        raise ConfigError(f"{called(joint)}: its origin must be {_PLACES[part]}, not {origin}")
    return origin


def _limits(joint: Element) -> Array:
    """Lowest and highest angle of a joint, (2,) rad."""
    low, high = (float(numbers(joint, "limit", key, "", 1)[0]) for key in ("lower", "upper"))
    if not low < high:
        raise ConfigError(f"{called(joint)}: its limits must be lower < upper, not {low}, {high}")
    if "calf" in joint.get("name", "") and not low < 0.0:
        raise ConfigError(f"{called(joint)}: a knee bends to negative angles, lower < 0")
    return np.array([low, high])


def _motor_limit(joint: Element, key: str) -> float:
    """Torque (``effort``) or speed (``velocity``) limit of a joint's motor; infinite if it is 0."""
    value = float(numbers(joint, "limit", key, "0", 1)[0])
    if value < 0.0:
        raise ConfigError(f"{called(joint)}: limit {key} must be at least 0, not {value:g}")
    return value or np.inf


def _foot(parts: list[Part]) -> Array:
    """Height of the foot in the calf's frame and its radius, (2,) m."""
    calf = parts[0].link
    shapes = [
        (part.at(shape)[0], shape) for part in parts for shape in part.link.findall("collision")
    ]
    (x, y, z), foot = min(shapes, key=lambda shape: shape[0][2], default=(np.zeros(3), calf))
    if foot.find("geometry/sphere") is None:
        raise ConfigError(
            f"{called(calf)}: its lowest collision shape must be its foot, which is a sphere"
        )
    radius = float(numbers(foot, "geometry/sphere", "radius", "", 1)[0])
    if not (_same([x, y], 0.0) and z < -_SAME and radius > 0.0):
        raise ConfigError(f"{called(calf)}: the foot must be at 0 0 z, z < 0, and its radius > 0")
    return np.array([z, radius])


def _same(one: ArrayLike, other: ArrayLike) -> bool:
    return bool(np.allclose(one, other, rtol=0.0, atol=_SAME))
