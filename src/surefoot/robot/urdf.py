"""Reader of a robot's URDF: links with their inertias and shapes, joints, and the forward kinematics of their tree.

Engines read the same file with their own readers; this one checks a description without any engine.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.errors import SurefootError, accessible, choices
from surefoot.files import read_configuration
from surefoot.robot.rigid_body import RigidBody
from surefoot.rotations import quat_matrix, rpy_matrix

Color = tuple[int, int, int]
"""Red, green and blue, 0 to 255."""
GREY: Color = (120, 130, 140)
_NO_ANGLES: Mapping[str, ArrayLike] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class Shape:
    """A box, cylinder or sphere on a link."""

    link: str
    kind: str
    """box, cylinder or sphere."""
    size: tuple[float, ...]
    """Box: half of the sides; cylinder: radius and half of the length along z; sphere: radius [m]."""
    frame: Array
    """Frame (4, 4) of the shape in the link's."""
    color: Color = GREY

    @property
    def position(self) -> Array:
        """Centre (3,) in the link's frame [m]."""
        return self.frame[:3, 3]

    @property
    def rotation(self) -> Array:
        """Rotation (3, 3) from the shape's axes to the link's."""
        return self.frame[:3, :3]


@dataclass(frozen=True, eq=False)
class Link:
    """A rigid link, all in its own frame. Shapes that are no box, cylinder or sphere are left out."""

    name: str
    body: RigidBody
    visuals: tuple[Shape, ...]
    collisions: tuple[Shape, ...]

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return self.body.mass


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint between two links."""

    name: str
    kind: str
    """Type in the URDF: fixed, revolute, continuous, ..."""
    parent: str
    child: str
    axis: tuple[float, float, float]
    """Direction of the axis in the child's frame, of length 1."""
    frame: Array
    """Frame (4, 4) of the child in the parent's at angle 0."""
    limits: tuple[float, float] | None = None
    """Least and greatest angle [rad]; None: it turns without end."""

    def child_frame(self, angle: ArrayLike) -> Array:
        """Return the frames (..., 4, 4) of the child in the parent's at angles (...) [rad]."""
        half = np.asarray(angle, float)[..., None] / 2
        turn = np.zeros((*half.shape[:-1], 4, 4))
        turn[..., 3, 3] = 1.0
        turn[..., :3, :3] = quat_matrix(np.concatenate([np.cos(half), np.sin(half) * self.axis], axis=-1))
        return self.frame @ turn


@dataclass(frozen=True, eq=False)
class Urdf:
    """Links and joints of a URDF, by name, in the order of the file."""

    path: Path
    links: dict[str, Link]
    joints: dict[str, Joint]
    root: str
    """Name of the link that has no parent joint."""
    tree: tuple[Joint, ...]
    """All joints, each after the one that carries its parent."""

    @property
    def total_mass(self) -> float:
        """Mass of all links [kg]."""
        return sum(link.mass for link in self.links.values())

    def frames(
        self, angles: Mapping[str, ArrayLike] = _NO_ANGLES, joints: Sequence[Joint] | None = None
    ) -> dict[str, Array]:
        """Return the frames (..., 4, 4) of links in the root's: forward kinematics.

        Args:
            angles: angles (...) [rad] by joint; the other joints are at 0.
            joints: a part of `tree` that starts at the root, such as a `chain`; all, if not given.
        """
        frames = {self.root: np.eye(4)}
        for joint in self.tree if joints is None else joints:
            step = joint.child_frame(angles[joint.name]) if joint.name in angles else joint.frame
            frames[joint.child] = frames[joint.parent] @ step
        return frames

    def chain(self, link: str) -> list[Joint]:
        """Return the joints from the root to a link."""
        parents = {joint.child: joint for joint in self.tree}
        chain: list[Joint] = []
        while link != self.root:
            chain.insert(0, parents[link])
            link = parents[link].parent
        return chain

    @cached_property
    def places(self) -> dict[str, tuple[str, Array]]:
        """For each link the topmost of the links that are fixed to it, and its frame (4, 4) in that one's."""
        places = {self.root: (self.root, np.eye(4))}
        for joint in self.tree:
            top, frame = places[joint.parent]
            fixed = joint.kind == "fixed"
            places[joint.child] = (top, frame @ joint.frame) if fixed else (joint.child, np.eye(4))
        return places

    def fixed_to(self, link: str) -> set[str]:
        """Return the names of the links that move as one with `link`, itself included."""
        return {name for name, (top, _) in self.places.items() if top == self.places[link][0]}

    def below(self, joint: str) -> set[str]:
        """Return the names of the links that a joint moves."""
        links = {self.joints[joint].child}
        for other in self.tree:
            if other.parent in links:
                links.add(other.child)
        return links


def attribute(element: ElementTree.Element | None, key: str, default: str = "") -> str:
    """Return an attribute of an element; the default if either is missing."""
    return default if element is None else element.get(key, default)


def read_frame(element: ElementTree.Element | None, where: str = "a shape") -> Array:
    """Return the frame (4, 4) of an <origin>, or of none; roll, pitch and yaw are about fixed axes."""
    frame = np.eye(4)
    frame[:3, :3] = rpy_matrix(*_floats(attribute(element, "rpy", "0 0 0"), 3, f"{where}: rpy"))
    frame[:3, 3] = _floats(attribute(element, "xyz", "0 0 0"), 3, f"{where}: origin")
    return frame


def _floats(text: str, count: int, where: str) -> tuple[float, ...]:
    try:
        values = tuple(float(word) for word in text.split())
    except ValueError:
        values = ()
    if len(values) != count or not all(map(math.isfinite, values)):
        rule = "a finite number" if count == 1 else f"{count} finite numbers"
        raise SurefootError(f"{where} is '{text}'; it must be {rule}")
    return values


def _float(element: ElementTree.Element | None, key: str, where: str, default: str = "") -> float:
    return _floats(attribute(element, key, default), 1, f"{where}: {key}")[0]


def read_urdf(path: Path) -> Urdf:
    """Read a URDF.

    Raises:
        SurefootError: the file can't be read or is not a URDF, its joints are not a tree, or a link, joint or shape is
            invalid.
    """
    try:
        with accessible(path):
            robot = ElementTree.fromstring(read_configuration(path))
    except ElementTree.ParseError as error:
        raise SurefootError(f"{path}: is not well-formed XML: {error}") from error
    if robot.tag != "robot":
        raise SurefootError(f"{path}: the root element is <{robot.tag}>; a URDF's is <robot>")
    colors = {
        item.get("name", ""): color
        for item in robot.findall("material")
        if (color := _read_color(item, f"{path}: material '{item.get('name')}'"))
    }
    links: dict[str, Link] = {}
    for element in robot.findall("link"):
        name = _new_name(path, element, links)
        links[name] = _read_link(element, name, colors, f"{path}: link '{name}'")
    joints: dict[str, Joint] = {}
    for element in robot.findall("joint"):
        name = _new_name(path, element, joints)
        joints[name] = _read_joint(element, name, links, f"{path}: joint '{name}'")
    return Urdf(path, links, joints, *_order(path, links, joints))


def _new_name(path: Path, element: ElementTree.Element, names: Collection[str]) -> str:
    name = element.get("name", "")
    if name in names:
        raise SurefootError(f"{path}: there are two {element.tag}s '{name}'; each must have a name of its own")
    return name


def _read_link(element: ElementTree.Element, name: str, colors: Mapping[str, Color], where: str) -> Link:
    mass_element, tensor = element.find("inertial/mass"), element.find("inertial/inertia")
    if mass_element is None or tensor is None:
        raise SurefootError(f"{where} has no <inertial> with <mass> and <inertia>; every link needs both")
    mass = _floats(attribute(mass_element, "value"), 1, f"{where}: mass")[0]
    xx, yy, zz = (_float(tensor, key, where) for key in ("ixx", "iyy", "izz"))
    xy, xz, yz = (_float(tensor, key, where, "0") for key in ("ixy", "ixz", "iyz"))
    if not mass > 0:
        raise SurefootError(f"{where}: mass is {mass:g}; it must be over 0 kg")
    if not (min(xx, yy, zz) > 0 and 2 * max(xx, yy, zz) <= (xx + yy + zz) * (1 + 1e-9)):
        raise SurefootError(
            f"{where}: inertia ({xx:g}, {yy:g}, {zz:g}) is not a rigid body's; "
            "each must be over 0 and none over the sum of the other two"
        )
    frame = read_frame(element.find("inertial/origin"), f"{where}: inertial")
    turn, inertia = frame[:3, :3], np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    visuals, collisions = (
        tuple(shape for item in element.findall(use) if (shape := _read_shape(item, name, colors, f"{where}: {use}")))
        for use in ("visual", "collision")
    )
    return Link(name, RigidBody(mass, frame[:3, 3], turn @ inertia @ turn.T), visuals, collisions)


def _read_shape(element: ElementTree.Element, link: str, colors: Mapping[str, Color], where: str) -> Shape | None:
    """Return a <visual> or <collision>; None for a mesh and other kinds."""
    for kind in ("box", "cylinder", "sphere"):
        if (solid := element.find(f"geometry/{kind}")) is not None:
            break
    else:
        return None
    where = f"{where}: {kind}"
    if kind == "box":
        size = tuple(side / 2 for side in _floats(attribute(solid, "size"), 3, f"{where}: size"))
    else:
        size = (_float(solid, "radius", where),)
        if kind == "cylinder":
            size = (*size, _float(solid, "length", where) / 2)
    if not min(size) > 0:
        raise SurefootError(f"{where} has a side, radius or length of {2 * min(size):g}; they must be over 0 m")
    material = element.find("material")
    color = None if material is None else _read_color(material, where) or colors.get(material.get("name", ""))
    return Shape(link, kind, size, read_frame(element.find("origin"), where), color or GREY)


def _read_color(material: ElementTree.Element, where: str) -> Color | None:
    """Return the color of a material; None if it only names one."""
    color = material.find("color")
    if color is None:
        return None
    red, green, blue, _ = _floats(attribute(color, "rgba", "0.5 0.5 0.5 1"), 4, f"{where}: rgba")
    return round(255 * red), round(255 * green), round(255 * blue)


def _read_joint(element: ElementTree.Element, name: str, links: Collection[str], where: str) -> Joint:
    parent, child = attribute(element.find("parent"), "link"), attribute(element.find("child"), "link")
    for end in (parent, child):
        if end not in links:
            raise SurefootError(f"{where} joins '{end}', not a link; choices: {choices(links)}")
    kind, limits = attribute(element, "type"), None
    x, y, z = _floats(attribute(element.find("axis"), "xyz", "1 0 0"), 3, f"{where}: axis")
    length = math.hypot(x, y, z)
    if kind != "fixed" and length == 0.0:
        raise SurefootError(f"{where}: axis is (0, 0, 0); it must have a direction")
    frame = read_frame(element.find("origin"), where)
    if kind == "revolute":
        low, high = (
            _floats(attribute(element.find("limit"), end, "0"), 1, f"{where}: limit {end}")[0]
            for end in ("lower", "upper")
        )
        if not low < high:
            raise SurefootError(f"{where}: limits are [{low:g}, {high:g}]; the lower one must be below the upper")
        limits = low, high
    return Joint(name, kind, parent, child, (x / (length or 1), y / (length or 1), z / (length or 1)), frame, limits)


def _order(path: Path, links: Collection[str], joints: Mapping[str, Joint]) -> tuple[str, tuple[Joint, ...]]:
    """Return the root and all joints from it outward; refuse joints that are not a tree."""
    children = [joint.child for joint in joints.values()]
    roots = [name for name in links if name not in children]
    if len(roots) != 1:
        raise SurefootError(
            f"{path}: {len(roots)} links have no parent ({choices(roots)}); exactly one must be the root"
        )
    tree: list[Joint] = []
    reached, waiting = set(roots), list(roots)
    while waiting:
        parent = waiting.pop()
        for joint in joints.values():
            if joint.parent == parent:
                tree.append(joint)
                if joint.child in reached:
                    raise SurefootError(f"{path}: link '{joint.child}' has two parents; joints must be a tree")
                reached.add(joint.child)
                waiting.append(joint.child)
    if len(reached) < len(links):
        missing = choices(name for name in links if name not in reached)
        raise SurefootError(f"{path}: links are joined in a circle ({missing}); joints must be a tree")
    return roots[0], tuple(tree)
