"""The robot's geometry, read from its URDF, and what a URDF must be like to be read.

The kinematics (``tdgc.sim.robot``) know one kind of robot: a trunk with four equal legs, mirrored
left to right, each with a hip that turns about the axis ahead and a thigh and a calf that turn
about the one to the left; at zero the legs are straight down. What does not fit is refused here,
since Bullet would simulate it and everything computed beside Bullet would be wrong without a word.
"""

import reprlib
import xml.etree.ElementTree as ElementTree
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tdgc.config import ConfigError, RobotConfig
from tdgc.sim.gaits import FEET

Array = NDArray[np.float64]

_PARTS = ("hip", "thigh", "calf")
JOINTS = tuple(f"{leg}_{part}_joint" for leg in FEET for part in _PARTS)
#: Which way is out from the trunk's centre for each leg: front + and rear -, left + and right -.
FRONT: Array = np.array([1.0 if leg[0] == "F" else -1.0 for leg in FEET])
SIDE: Array = np.array([1.0 if leg[1] == "L" else -1.0 for leg in FEET])

_SAME = 1e-6  # m and rad: what is left of arithmetic where a URDF was generated
#: Of each joint: its axis, and the coordinates in which it may lie away from its parent's.
_AXES = {"hip": (1.0, 0.0, 0.0), "thigh": (0.0, 1.0, 0.0), "calf": (0.0, 1.0, 0.0)}
_FREE = {"hip": (True, True, False), "thigh": (False, True, False), "calf": (False, False, True)}
_PLACES = {
    "hip": "x y 0, x > 0 in front and y > 0 on the left",
    "thigh": "0 y 0, y > 0 on the left",
    "calf": "0 0 z, z < 0",
}


@dataclass(frozen=True, eq=False)
class Geometry:
    """What the kinematics, rewards and exports need to know of a robot.

    Attributes:
        hips: hip joints in the trunk's frame, (4, 2) m ahead and to the left.
        abduction: m, from the hip joint out to the thigh joint.
        thigh, calf: m, from the thigh joint to the calf joint, and on to the foot's centre.
        foot_radius: m.
        trunk_mass: kg, without what is fixed to the trunk by joints.
        masses: kg of each link, by name.
        joint_limits: lowest and highest angle of each joint, (12, 2) rad.
        motor_limits: torque in N m and speed in rad/s of hip, thigh and calf, (2, 3), the least of
            the four legs; infinite where the URDF says nothing.
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


def urdf_path(config: RobotConfig) -> Path:
    """Absolute path of the robot's URDF: as given, or relative to the repository.

    Raises:
        ConfigError: no such file.
    """
    given = Path(config.urdf)
    for path in (given, Path(__file__).resolve().parents[2] / given):
        if path.is_file():
            return path.resolve()
    raise ConfigError(f"robot.urdf: no file '{config.urdf}' here or in the repository")


def read_geometry(config: RobotConfig) -> Geometry:
    """The geometry of the robot whose URDF ``config`` names.

    It is read at each call, as Bullet reads it for each robot: a world reads it once and
    keeps it. docs/robot.md says what a URDF must have.

    Raises:
        ConfigError: a file that is not there, cannot be read or is no robot of this kind; the
            message says what is wrong with it and what is allowed.
    """
    path = urdf_path(config)
    try:
        return _measure(_parse(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 text") from error
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def _parse(text: str) -> Element:
    # Without a document type there are no entities of its own, which could expand without end.
    if "<!DOCTYPE" in text:
        raise ConfigError("a URDF has no document type (<!DOCTYPE>)")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ConfigError(f"not an XML file: {error}") from error


def _measure(robot: Element) -> Geometry:
    joints, fixed = _joints(robot)
    parts = _parts(robot, joints, fixed)
    origins = np.stack([_origin(joints[name]) for name in JOINTS]).reshape(4, 3, 3)
    limits = np.stack([_limits(joints[name]) for name in JOINTS]).reshape(4, 3, 2)
    feet = np.stack([_foot(parts[_link_of(joints[f"{leg}_calf_joint"], "child")]) for leg in FEET])
    # Left legs as they are, right ones in a mirror.
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
        trunk_mass=_mass(parts[_link_of(joints["FL_hip_joint"], "parent")][0].link),
        masses={p.link.get("name", ""): _mass(p.link) for own in parts.values() for p in own},
        joint_limits=limits.reshape(len(JOINTS), 2),
        motor_limits=np.stack(
            [[_motor_limit(joints[name], key) for name in JOINTS] for key in ("effort", "velocity")]
        )
        .reshape(2, 4, 3)
        .min(axis=1),
    )


# ---------------------------------------------------------------------------- elements


def _joints(robot: Element) -> tuple[dict[str, Element], list[Element]]:
    """The joints of ``JOINTS`` by name, and the fixed ones; there are no others."""
    found = robot.findall("joint")
    names = Counter(joint.get("name", "") for joint in found)
    missing = [name for name in JOINTS if name not in names]
    if missing:
        raise ConfigError(f"lacks the joints {', '.join(missing)}")
    fixed = [j for j in found if j.get("type") == "fixed" and j.get("name") not in JOINTS]
    moving = [joint for joint in found if joint not in fixed]
    others = list(Counter(joint.get("name", "") for joint in moving) - Counter(JOINTS))
    if others:
        raise ConfigError(
            f"has the joint {reprlib.repr(others[0])} beside the twelve of its legs, {JOINTS[0]} "
            f"to {JOINTS[-1]}: others must be fixed"
        )
    return {joint.get("name", ""): joint for joint in moving}, fixed


@dataclass(frozen=True, eq=False)
class _Part:
    """A link, and where it is in the frame of the link that carries it.

    Attributes:
        link: its element.
        place: of its origin, (3,) m.
        rotation: from its frame, (3, 3).
    """

    link: Element
    place: Array
    rotation: Array

    def carry(self, joint: Element, link: Element) -> "_Part":
        """The part that ``joint`` fixes to this one."""
        place, turn = (_numbers(joint, "origin", key, "0 0 0") for key in ("xyz", "rpy"))
        return _Part(link, self.place + self.rotation @ place, self.rotation @ _rotation(turn))


def _parts(
    robot: Element, joints: dict[str, Element], fixed: list[Element]
) -> dict[str, list[_Part]]:
    """By name the trunk and in each leg hip, thigh and calf: itself first, then what is fixed to
    it. There are no other links."""
    links = {link.get("name", ""): link for link in robot.findall("link")}
    if len(links) < len(robot.findall("link")):
        raise ConfigError("two of its links have one name")
    trunk = _link_of(joints["FL_hip_joint"], "parent")
    carriers = [trunk]
    for leg in FEET:
        parent = trunk
        for name in _PARTS:
            joint = joints[f"{leg}_{name}_joint"]
            if _link_of(joint, "parent") != parent:
                raise ConfigError(
                    f"{_called(joint)}: its parent must be {reprlib.repr(parent)}; a leg is a hip "
                    "on the trunk, a thigh on the hip and a calf on the thigh"
                )
            parent = _link_of(joint, "child")
            carriers.append(parent)
    placed: dict[str, list[_Part]] = {}
    for carrier in carriers:
        if carrier not in links:
            raise ConfigError(f"a joint moves the link {reprlib.repr(carrier)}, which is not there")
        mine = placed[carrier] = [_Part(links.pop(carrier), np.zeros(3), np.eye(3))]
        for above in mine:  # which grows
            for joint in fixed:
                if _link_of(joint, "parent") == above.link.get("name"):
                    child = links.pop(_link_of(joint, "child"), None)
                    if child is None:
                        raise ConfigError(f"{_called(joint)}: its child must be a link of its own")
                    mine.append(above.carry(joint, child))
    if links:
        raise ConfigError(
            f"link {reprlib.repr(next(iter(links)))}: belongs to no leg and is not fixed to the "
            "trunk; the trunk, which has the hips, must be the root"
        )
    for part in (part for mine in placed.values() for part in mine):
        _mass(part.link)
    return placed


def _origin(joint: Element) -> Array:
    """Where a joint is in its parent's frame, (3,) m; the axes are checked, too."""
    name = joint.get("name", "")
    leg, part = name.split("_")[:2]
    axis = _numbers(joint, "axis", "xyz", "1 0 0")
    if joint.get("type") != "revolute" or not _same(axis, _AXES[part]):
        wanted = " ".join(f"{a:g}" for a in _AXES[part])
        raise ConfigError(f"{_called(joint)}: must be revolute about the axis {wanted}")
    origin = _numbers(joint, "origin", "xyz", "0 0 0")
    outward = origin * [FRONT[FEET.index(leg)], SIDE[FEET.index(leg)], -1.0]
    free = np.array(_FREE[part])
    if not _same(_numbers(joint, "origin", "rpy", "0 0 0"), 0.0):
        raise ConfigError(f"{_called(joint)}: its origin must not be turned, rpy 0 0 0")
    if not (_same(origin[~free], 0.0) and (outward[free] > _SAME).all()):
        raise ConfigError(f"{_called(joint)}: its origin must be {_PLACES[part]}, not {origin}")
    return origin


def _limits(joint: Element) -> Array:
    """Lowest and highest angle of a joint, (2,) rad."""
    low, high = (float(_numbers(joint, "limit", key, "", 1)[0]) for key in ("lower", "upper"))
    if not low < high:
        raise ConfigError(f"{_called(joint)}: its limits must be lower < upper, not {low}, {high}")
    if "calf" in joint.get("name", "") and not low < 0.0:
        raise ConfigError(f"{_called(joint)}: a knee bends to negative angles, lower < 0")
    return np.array([low, high])


def _motor_limit(joint: Element, key: str) -> float:
    """Torque (``effort``) or speed (``velocity``) that a joint's motor ends at; 0 means none."""
    value = float(_numbers(joint, "limit", key, "0", 1)[0])
    if value < 0.0:
        raise ConfigError(f"{_called(joint)}: limit {key} must be at least 0, not {value:g}")
    return value or np.inf


def _foot(parts: list[_Part]) -> Array:
    """Height in the calf's frame and radius of the foot, (2,) m."""
    calf = parts[0].link
    shapes = [
        (part.place + part.rotation @ _numbers(shape, "origin", "xyz", "0 0 0"), shape)
        for part in parts
        for shape in part.link.findall("collision")
    ]
    (x, y, z), foot = min(shapes, key=lambda shape: shape[0][2], default=(np.zeros(3), calf))
    if foot.find("geometry/sphere") is None:
        raise ConfigError(
            f"{_called(calf)}: its lowest collision shape must be its foot, which is a sphere"
        )
    radius = float(_numbers(foot, "geometry/sphere", "radius", "", 1)[0])
    if not (_same([x, y], 0.0) and z < -_SAME and radius > 0.0):
        raise ConfigError(f"{_called(calf)}: the foot must be at 0 0 z, z < 0, and its radius > 0")
    return np.array([z, radius])


def _mass(link: Element) -> float:
    """kg; Bullet would hold a trunk without a mass in the air."""
    mass = float(_numbers(link, "inertial/mass", "value", "", 1)[0])
    if not mass > 0.0:
        raise ConfigError(f"{_called(link)}: its mass must be positive, not {mass}")
    return mass


def _link_of(joint: Element, which: str) -> str:
    """Name of a joint's ``parent`` or ``child``."""
    found = joint.find(which)
    return "" if found is None else found.get("link", "")


def _numbers(element: Element, path: str, key: str, default: str, count: int = 3) -> Array:
    """An attribute's numbers, (count,); ``default`` where there is none."""
    found = element.find(path)
    text = default if found is None else found.get(key, default)
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.empty(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        wanted = f"{count} numbers" if count > 1 else "a number"
        raise ConfigError(
            f"{_called(element)}: {path} {key} must be {wanted}, not {reprlib.repr(text)}"
        )
    return values


def _rotation(rpy: Array) -> Array:
    """Of a URDF's roll, pitch and yaw, (3,) rad, about fixed axes in that order: (3, 3)."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy), np.cos(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _called(element: Element) -> str:
    return f"{element.tag} {reprlib.repr(element.get('name', ''))}"


def _same(one: ArrayLike, other: ArrayLike) -> bool:
    return bool(np.allclose(one, other, rtol=0.0, atol=_SAME))
