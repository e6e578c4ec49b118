"""A robot's URDF: its joints, its links, and the links that are fixed to them.

Bullet simulates a link on a fixed joint as a separate body: PyBullet's A1 has nine such bodies
besides its thirteen links, and a step takes a third longer than with them merged. PyBullet's
URDF_MERGE_FIXED_LINKS mistakes the centre of mass of the carrying link for its origin, so
``merged`` does this instead.
"""

import contextlib
import copy
import reprlib
import tempfile
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterator
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
_INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


@dataclass(frozen=True, eq=False)
class Part:
    """A link and its pose in the frame of the moving link that carries it.

    Attributes:
        link: element of the link.
        place: position of its origin in the carrying link's frame, (3,) m.
        rotation: from its own frame to the carrying link's, (3, 3).
    """

    link: Element
    place: Array
    rotation: Array

    def at(self, element: Element) -> tuple[Array, Array]:
        """Position and rotation of an element's ``origin`` in the carrying link's frame."""
        place, turn = (numbers(element, "origin", key, "0 0 0") for key in ("xyz", "rpy"))
        return self.place + self.rotation @ place, self.rotation @ _rotation(turn)


@dataclass(frozen=True, eq=False)
class Urdf:
    """Contents of a URDF.

    Attributes:
        path: path of the file.
        root: root element.
        joints: the twelve joints of ``JOINTS``, by name.
        parts: link name -> parts, for the trunk and the hip, thigh and calf of each leg: the link
            itself first, then all that is fixed to it. There are no other links.
    """

    path: Path
    root: Element
    joints: dict[str, Element]
    parts: dict[str, list[Part]]


def urdf_path(config: RobotConfig) -> Path:
    """Absolute path of the robot's URDF: as given, or relative to the repository.

    Raises:
        ConfigError: no such file, or two that differ or cannot be read.
    """
    given = Path(config.urdf)
    paths = (given, Path(__file__).resolve().parents[2] / given)
    found = [path.resolve() for path in paths if path.is_file()]
    try:
        differ = len(set(found)) > 1 and found[0].read_bytes() != found[1].read_bytes()
    except OSError as error:
        raise ConfigError(f"robot.urdf: {error}") from error
    if differ:
        raise ConfigError(
            f"robot.urdf: '{config.urdf}' here is not the repository's; move it or give its full "
            "path"
        )
    if found:
        return found[0]
    raise ConfigError(f"robot.urdf: no file '{config.urdf}' here or in the repository")


def read_urdf(config: RobotConfig) -> Urdf:
    """Read the URDF that ``config`` names.

    Raises:
        ConfigError: the file is missing, cannot be read or has other joints or links; the message
            says what is wrong and what is allowed.
    """
    path = urdf_path(config)
    with named(path):
        try:
            text = path.read_text(encoding="utf-8")
            # Without a document type a file cannot define entities, which could expand without end.
            if "<!DOCTYPE" in text:
                raise ConfigError("a URDF has no document type (<!DOCTYPE>)")
            root = ElementTree.fromstring(text)
        except OSError as error:
            raise ConfigError(str(error.strerror)) from error
        except UnicodeDecodeError as error:
            raise ConfigError("not UTF-8 text") from error
        except ElementTree.ParseError as error:
            raise ConfigError(f"not an XML file: {error}") from error
        joints, fixed = _joints(root)
        parts = _parts(root, joints, fixed)
        for own in parts.values():
            _check_inertia(own)
        return Urdf(path, root, joints, parts)


@contextlib.contextmanager
def named(path: Path) -> Iterator[None]:
    """Prefix a ``ConfigError`` raised in the block with ``path``."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


# ---------------------------------------------------------------------------- what is fixed


@contextlib.contextmanager
def merged_file(urdf: Urdf) -> Iterator[Path]:
    """URDF of the same robot with fixed links merged: a temporary file, or its own if it has
    none."""
    if all(len(parts) == 1 for parts in urdf.parts.values()):
        yield urdf.path
        return
    text = ElementTree.tostring(merged(urdf), encoding="unicode")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / urdf.path.name  # same name, for Bullet's messages
        path.write_text(text, encoding="utf-8")
        yield path


def merged(urdf: Urdf) -> Element:
    """The robot with the mass, inertia and shapes of fixed links moved to the links that carry
    them, and meshes named by absolute paths."""
    robot = copy.deepcopy(urdf.root)
    links = {link.get("name", ""): link for link in robot.findall("link")}
    for name, parts in urdf.parts.items():
        carrier = links[name]
        for part in parts[1:]:
            fixed = links[part.link.get("name", "")]
            robot.remove(fixed)
            for shape in (*fixed.findall("visual"), *fixed.findall("collision")):
                _move(shape, *part.at(shape))
                carrier.append(shape)
        if len(parts) > 1:
            _weigh(carrier, *_together([_inertia(part) for part in parts]))
    for joint in robot.findall("joint"):
        if joint.get("name") not in JOINTS:
            robot.remove(joint)
    for mesh in robot.iter("mesh"):
        mesh.set("filename", mesh_path(mesh.get("filename", ""), urdf.path))
    return robot


def _inertia(part: Part) -> tuple[float, Array, Array]:
    """Mass in kg, centre of mass (3,) m and inertia about it (3, 3) kg m^2, in the frame of the
    carrying link."""
    link, weight = part.link, mass(part.link)
    inertial = link.find("inertial")
    assert inertial is not None  # as it has a mass
    xx, xy, xz, yy, yz, zz = (
        float(numbers(link, "inertial/inertia", key, "", 1)[0]) for key in _INERTIA
    )
    centre, turn = part.at(inertial)
    return weight, centre, turn @ [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]] @ turn.T


def _together(bodies: list[tuple[float, Array, Array]]) -> tuple[float, Array, Array]:
    """Mass, centre of mass and inertia about it of rigidly connected bodies."""
    total = sum(body[0] for body in bodies)
    centre = np.asarray(sum(body[0] * body[1] for body in bodies) / total)
    inertia = np.zeros((3, 3))
    for weight, place, own in bodies:
        arm = place - centre
        inertia += own + weight * (arm @ arm * np.eye(3) - np.outer(arm, arm))  # parallel axes
    return total, centre, inertia


def _check_inertia(parts: list[Part]) -> None:
    """Refuse a link whose inertia no body has; Bullet would set it to zero."""
    *_, inertia = _together([_inertia(part) for part in parts])
    least, middle, greatest = np.linalg.eigvalsh(inertia)
    if not 0.0 < least <= middle <= greatest <= least + middle:
        raise ConfigError(
            f"{called(parts[0].link)}: its principal moments of inertia must be positive and none "
            f"above the sum of the others, not {least:g}, {middle:g}, {greatest:g}"
        )


def _weigh(link: Element, total: float, centre: Array, inertia: Array) -> None:
    """Set the mass, centre of mass and inertia of a link."""
    inertial = link.find("inertial")
    assert inertial is not None
    inertial.clear()
    ElementTree.SubElement(inertial, "origin", xyz=_text(centre), rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=repr(total))
    upper = map(_text, inertia[np.triu_indices(3)])
    ElementTree.SubElement(inertial, "inertia", dict(zip(_INERTIA, upper, strict=True)))


def _move(shape: Element, place: Array, rotation: Array) -> None:
    """Set the origin of a shape to ``place`` (3,) m and ``rotation`` (3, 3)."""
    origin = shape.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(shape, "origin")
    origin.set("xyz", _text(place))
    origin.set("rpy", _text(_roll_pitch_yaw(rotation)))


def mesh_path(name: str, urdf: Path) -> str:
    """Absolute path of a mesh that a URDF names relative to itself or to its package.

    If there is no such file, ``name`` stays as it is, and Bullet reports it.
    """
    inside = name.removeprefix("package://")
    for folder in urdf.parents:
        if (folder / inside).is_file():
            return str(folder / inside)
        if inside == name:  # relative to the URDF's own folder only
            break
    return name


# ---------------------------------------------------------------------------- elements


def _joints(robot: Element) -> tuple[dict[str, Element], list[Element]]:
    """The joints of ``JOINTS`` by name, and the fixed joints; any others are an error."""
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


def _parts(
    robot: Element, joints: dict[str, Element], fixed: list[Element]
) -> dict[str, list[Part]]:
    """Parts by link name, see ``Urdf.parts``; links that belong to none are an error."""
    links = {link.get("name", ""): link for link in robot.findall("link")}
    if len(links) < len(robot.findall("link")):
        raise ConfigError("two of its links have one name")
    trunk = link_of(joints["FL_hip_joint"], "parent")
    carriers = [trunk]
    for leg in FEET:
        parent = trunk
        for name in _PARTS:
            joint = joints[f"{leg}_{name}_joint"]
            if link_of(joint, "parent") != parent:
                raise ConfigError(
                    f"{called(joint)}: its parent must be {reprlib.repr(parent)}; a leg is a hip "
                    "on the trunk, a thigh on the hip and a calf on the thigh"
                )
            parent = link_of(joint, "child")
            carriers.append(parent)
    placed: dict[str, list[Part]] = {}
    for carrier in carriers:
        if carrier not in links:
            raise ConfigError(f"a joint moves the link {reprlib.repr(carrier)}, which is missing")
        mine = placed[carrier] = [Part(links.pop(carrier), np.zeros(3), np.eye(3))]
        for above in mine:  # grows here, so that chains are followed
            for joint in fixed:
                if link_of(joint, "parent") == above.link.get("name"):
                    child = links.pop(link_of(joint, "child"), None)
                    if child is None:
                        raise ConfigError(f"{called(joint)}: its child must be a link of its own")
                    mine.append(Part(child, *above.at(joint)))
    if links:
        raise ConfigError(
            f"link {reprlib.repr(next(iter(links)))}: belongs to no leg and is not fixed to the "
            "trunk; the trunk, which has the hips, must be the root"
        )
    return placed


def mass(link: Element) -> float:
    """Mass in kg; must be positive, since Bullet would fix a trunk without mass in the air."""
    value = float(numbers(link, "inertial/mass", "value", "", 1)[0])
    if not value > 0.0:
        raise ConfigError(f"{called(link)}: its mass must be positive, not {value}")
    return value


def link_of(joint: Element, which: str) -> str:
    """Name of the link that is a joint's ``parent`` or ``child``."""
    found = joint.find(which)
    return "" if found is None else found.get("link", "")


def numbers(element: Element, path: str, key: str, default: str, count: int = 3) -> Array:
    """Numbers in attribute ``key`` of the child at ``path``, (count,); ``default`` if absent."""
    found = element.find(path)
    text = default if found is None else found.get(key, default)
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.empty(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        wanted = f"{count} numbers" if count > 1 else "a number"
        raise ConfigError(
            f"{called(element)}: {path} {key} must be {wanted}, not {reprlib.repr(text)}"
        )
    return values


def _rotation(rpy: Array) -> Array:
    """Rotation matrix (3, 3) of a URDF's roll, pitch and yaw, (3,) rad about fixed axes in this
    order."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy), np.cos(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _roll_pitch_yaw(rotation: Array) -> Array:
    """Roll, pitch and yaw, (3,) rad, of ``rotation`` (3, 3), the inverse of ``_rotation``."""
    cos, sin, cos_pitch = rotation[0, 0], rotation[1, 0], np.hypot(*rotation[:2, 0])
    pitch = np.arctan2(-rotation[2, 0], cos_pitch)
    if cos_pitch < 1e-9:  # straight up or down: only roll and yaw combined matter
        return np.array([0.0, pitch, np.arctan2(-rotation[0, 1], rotation[1, 1])])
    return np.array([np.arctan2(rotation[2, 1], rotation[2, 2]), pitch, np.arctan2(sin, cos)])


def _text(values: ArrayLike) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def called(element: Element) -> str:
    """Tag and name of an element, for messages."""
    return f"{element.tag} {reprlib.repr(element.get('name', ''))}"
