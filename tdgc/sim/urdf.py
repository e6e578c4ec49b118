"""A robot's URDF: its joints, its links, and what is fixed to which of them.

Bullet simulates what is fixed to a link as a body of its own: PyBullet's A1, with nine such bodies
beside its thirteen, takes a third longer a step than with them merged. Its own
URDF_MERGE_FIXED_LINKS takes the carrying link's centre of mass for its origin, so ``merged`` is
written here.
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
    """A link, and where it is in the frame of the link that carries it.

    Attributes:
        link: its element.
        place: of its origin, (3,) m.
        rotation: from its frame, (3, 3).
    """

    link: Element
    place: Array
    rotation: Array

    def carry(self, joint: Element, link: Element) -> "Part":
        """The part that ``joint`` fixes to this one."""
        return Part(link, *self.at(joint))

    def at(self, element: Element) -> tuple[Array, Array]:
        """Place and rotation of an element's ``origin`` in the carrying link's frame."""
        place, turn = (numbers(element, "origin", key, "0 0 0") for key in ("xyz", "rpy"))
        return self.place + self.rotation @ place, self.rotation @ _rotation(turn)


@dataclass(frozen=True, eq=False)
class Urdf:
    """What a URDF says.

    Attributes:
        path: of the file.
        root: its element.
        joints: the twelve of ``JOINTS``, by name.
        parts: by name the trunk and in each leg hip, thigh and calf: itself first, then what is
            fixed to it. There are no other links.
    """

    path: Path
    root: Element
    joints: dict[str, Element]
    parts: dict[str, list[Part]]


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


def read_urdf(config: RobotConfig) -> Urdf:
    """The URDF that ``config`` names.

    Raises:
        ConfigError: a file that is not there, cannot be read or has other joints or links; the
            message says what is wrong with it and what is allowed.
    """
    path = urdf_path(config)
    with named(path):
        try:
            root = _parse(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise ConfigError(str(error.strerror)) from error
        except UnicodeDecodeError as error:
            raise ConfigError("not UTF-8 text") from error
        joints, fixed = _joints(root)
        return Urdf(path, root, joints, _parts(root, joints, fixed))


@contextlib.contextmanager
def named(path: Path) -> Iterator[None]:
    """Errors in here are of the file at ``path``."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


# ---------------------------------------------------------------------------- what is fixed


@contextlib.contextmanager
def merged_file(config: RobotConfig) -> Iterator[Path]:
    """A URDF of the same robot without fixed joints: its own file, if that has none.

    Raises:
        ConfigError: as ``read_urdf``, or a link without an inertia.
    """
    urdf = read_urdf(config)
    if all(len(parts) == 1 for parts in urdf.parts.values()):
        yield urdf.path
        return
    with named(urdf.path):
        text = ElementTree.tostring(merged(urdf), encoding="unicode")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / urdf.path.name  # Bullet's own messages name it
        path.write_text(text, encoding="utf-8")
        yield path


def merged(urdf: Urdf) -> Element:
    """The robot with the mass, the inertia and the shapes of what is fixed to a link in that link,
    and meshes by their absolute paths.

    Raises:
        ConfigError: a link without an inertia; names it.
    """
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
        mesh.set("filename", _found(mesh.get("filename", ""), urdf.path))
    return robot


def _inertia(part: Part) -> tuple[float, Array, Array]:
    """Mass in kg, centre of mass (3,) m and inertia about it (3, 3) kg m^2 in the carrier's
    frame."""
    link = part.link
    xx, xy, xz, yy, yz, zz = (
        float(numbers(link, "inertial/inertia", key, "", 1)[0]) for key in _INERTIA
    )
    inertial = link.find("inertial")
    assert inertial is not None  # it has a mass
    centre, turn = part.at(inertial)
    return mass(link), centre, turn @ [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]] @ turn.T


def _together(bodies: list[tuple[float, Array, Array]]) -> tuple[float, Array, Array]:
    """Mass, centre of mass and inertia about it of bodies that move as one."""
    total = sum(body[0] for body in bodies)
    centre = np.asarray(sum(body[0] * body[1] for body in bodies) / total)
    inertia = np.zeros((3, 3))
    for weight, place, own in bodies:
        arm = place - centre
        inertia += own + weight * (arm @ arm * np.eye(3) - np.outer(arm, arm))  # Steiner
    return total, centre, inertia


def _weigh(link: Element, total: float, centre: Array, inertia: Array) -> None:
    """Give a link this mass, centre of mass and inertia."""
    inertial = link.find("inertial")
    assert inertial is not None
    inertial.clear()
    ElementTree.SubElement(inertial, "origin", xyz=_text(centre), rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=repr(total))
    upper = map(_text, inertia[np.triu_indices(3)])
    ElementTree.SubElement(inertial, "inertia", dict(zip(_INERTIA, upper, strict=True)))


def _move(shape: Element, place: Array, rotation: Array) -> None:
    """Put a shape at ``place`` (3,), turned by ``rotation`` (3, 3)."""
    origin = shape.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(shape, "origin")
    origin.set("xyz", _text(place))
    origin.set("rpy", _text(_roll_pitch_yaw(rotation)))


def _found(name: str, urdf: Path) -> str:
    """Absolute path of a mesh that a URDF names relative to itself or to its package; ``name`` as
    it is where there is no such file, which Bullet then says."""
    inside = name.removeprefix("package://")
    for folder in urdf.parents:
        if (folder / inside).is_file():
            return str(folder / inside)
        if inside == name:  # relative to the file alone
            break
    return name


# ---------------------------------------------------------------------------- elements


def _parse(text: str) -> Element:
    # Without a document type there are no entities of its own, which could expand without end.
    if "<!DOCTYPE" in text:
        raise ConfigError("a URDF has no document type (<!DOCTYPE>)")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ConfigError(f"not an XML file: {error}") from error


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


def _parts(
    robot: Element, joints: dict[str, Element], fixed: list[Element]
) -> dict[str, list[Part]]:
    """By name the trunk and in each leg hip, thigh and calf: itself first, then what is fixed to
    it. There are no other links."""
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
            raise ConfigError(f"a joint moves the link {reprlib.repr(carrier)}, which is not there")
        mine = placed[carrier] = [Part(links.pop(carrier), np.zeros(3), np.eye(3))]
        for above in mine:  # which grows
            for joint in fixed:
                if link_of(joint, "parent") == above.link.get("name"):
                    child = links.pop(link_of(joint, "child"), None)
                    if child is None:
                        raise ConfigError(f"{called(joint)}: its child must be a link of its own")
                    mine.append(above.carry(joint, child))
    if links:
        raise ConfigError(
            f"link {reprlib.repr(next(iter(links)))}: belongs to no leg and is not fixed to the "
            "trunk; the trunk, which has the hips, must be the root"
        )
    for part in (part for mine in placed.values() for part in mine):
        mass(part.link)
    return placed


def mass(link: Element) -> float:
    """kg; Bullet would hold a trunk without a mass in the air."""
    value = float(numbers(link, "inertial/mass", "value", "", 1)[0])
    if not value > 0.0:
        raise ConfigError(f"{called(link)}: its mass must be positive, not {value}")
    return value


def link_of(joint: Element, which: str) -> str:
    """Name of a joint's ``parent`` or ``child``."""
    found = joint.find(which)
    return "" if found is None else found.get("link", "")


def numbers(element: Element, path: str, key: str, default: str, count: int = 3) -> Array:
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
            f"{called(element)}: {path} {key} must be {wanted}, not {reprlib.repr(text)}"
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


def _roll_pitch_yaw(rotation: Array) -> Array:
    """The inverse of ``_rotation``: (3,) rad of ``rotation`` (3, 3)."""
    cos, sin, cos_pitch = rotation[0, 0], rotation[1, 0], np.hypot(*rotation[:2, 0])
    pitch = np.arctan2(-rotation[2, 0], cos_pitch)
    if cos_pitch < 1e-9:  # straight up or down, where roll and yaw are one turn
        return np.array([0.0, pitch, np.arctan2(-rotation[0, 1], rotation[1, 1])])
    return np.array([np.arctan2(rotation[2, 1], rotation[2, 2]), pitch, np.arctan2(sin, cos)])


def _text(values: ArrayLike) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def called(element: Element) -> str:
    """An element as messages name it."""
    return f"{element.tag} {reprlib.repr(element.get('name', ''))}"
