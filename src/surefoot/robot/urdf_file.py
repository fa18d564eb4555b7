"""Read, validate and write URDF files without a physics engine."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from xml.parsers.expat import ErrorString
from xml.parsers.expat.errors import XML_ERROR_UNBOUND_PREFIX, codes
from xml.sax.saxutils import quoteattr

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices, describe_os_errors, suggest
from surefoot.files import read_configuration
from surefoot.robot.rigid_body import RigidBody
from surefoot.robot.urdf import GREY, Color, Joint, Link, Shape, Urdf
from surefoot.rotations import matrix_rpy, rpy_matrix

KINDS = ("fixed", "revolute", "continuous")
"""Supported joint types."""
_UNBOUND_PREFIX = codes[XML_ERROR_UNBOUND_PREFIX]
_MAX_DEPTH = 200
"""Maximum nesting of XML elements; deeper files would exceed Python's recursion limit when written."""


def read_xml(path: Path) -> ElementTree.Element:
    """Return the root element of an XML file; reject unreadable files, entities and deep nesting."""
    with describe_os_errors(path):
        content = read_configuration(path)
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise SurefootError(f"{path}: declares XML entities; a robot's description needs none")
    try:
        root = ElementTree.fromstring(content)
    except ElementTree.ParseError as error:
        line, column = error.position
        reason = ErrorString(error.code)
        if error.code == _UNBOUND_PREFIX and b"<xacro:" in content:
            reason = 'a xacro without xmlns:xacro="http://www.ros.org/wiki/xacro" in its <robot>; add that'
        raise SurefootError(f"{path}: is not well-formed XML in line {line}, column {column + 1}: {reason}") from error
    level, depth = [root], 0
    while level:
        level, depth = [child for element in level for child in element], depth + 1
        if depth > _MAX_DEPTH:
            raise SurefootError(f"{path}: nests over {_MAX_DEPTH} elements; a robot's description nests few")
    return root


def attribute(element: ElementTree.Element | None, key: str, default: str = "") -> str:
    """Return an attribute of an element, or the default if the element or attribute is missing."""
    return default if element is None else element.get(key, default)


def read_urdf(path: Path) -> Urdf:
    """Read a URDF.

    Raises:
        SurefootError: the file can't be read or is not a URDF, its joints do not form a tree, or a link, joint or shape
            is invalid.
    """
    robot = read_xml(path)
    if robot.tag != "robot":
        raise SurefootError(f"{path}: the root element is <{robot.tag}>; a URDF's is <robot>")
    colors = read_colors(robot, path)
    links = {
        name: _read_link(element, name, colors, f"{path}: link '{name}'")
        for name, element in _read_names(robot.findall("link"), path).items()
    }
    joints = {
        name: _read_joint(element, name, links, f"{path}: joint '{name}'")
        for name, element in _read_names(robot.findall("joint"), path).items()
    }
    children: set[str] = set()
    for joint in joints.values():
        if joint.child in children:
            raise SurefootError(f"{path}: link '{joint.child}' has two parents; joints must form a tree")
        children.add(joint.child)
    roots = [name for name in links if name not in children]
    if len(roots) != 1:
        raise SurefootError(
            f"{path}: {len(roots)} links have no parent ({choices(roots)}); exactly one must be the root"
        )
    urdf = Urdf(path, links, joints)
    if missing := children - {joint.child for joint in urdf.tree}:
        raise SurefootError(f"{path}: joints form a loop ({choices(sorted(missing))}); they must form a tree")
    return urdf


def read_colors(robot: ElementTree.Element, path: Path) -> dict[str, Color]:
    """Return the colors of all materials in a URDF by name."""
    return {
        item.get("name", ""): color
        for item in robot.iter("material")
        if (color := _read_color(item, f"{path}: material '{item.get('name')}'"))
    }


def _read_names(elements: Iterable[ElementTree.Element], path: Path) -> dict[str, ElementTree.Element]:
    """Return elements by name; reject duplicate names."""
    names: dict[str, ElementTree.Element] = {}
    for element in elements:
        if (name := element.get("name", "")) in names:
            raise SurefootError(f"{path}: there are two {element.tag}s '{name}'; names must be unique")
        names[name] = element
    return names


def read_numbers(text: str, count: int, where: str) -> tuple[float, ...]:
    """Parse `count` finite numbers from a text; error messages begin with `where`."""
    try:
        values = tuple(float(word) for word in text.split())
    except ValueError:
        values = ()
    if len(values) != count or not all(map(math.isfinite, values)):
        rule = "a finite number" if count == 1 else f"{count} finite numbers"
        raise SurefootError(f"{where} is '{text}'; it must be {rule}")
    return values


def read_number(element: ElementTree.Element | None, key: str, where: str, default: str = "") -> float:
    """Parse an element's attribute as a number; error messages begin with `where`."""
    return read_numbers(attribute(element, key, default), 1, where)[0]


def read_inertia(element: ElementTree.Element, where: str) -> Array:
    """Return the inertia tensor (3, 3) [kg m2] of an <inertia>; missing products of inertia are 0."""
    rows = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
    moments = ("ixx", "iyy", "izz")
    return np.array(
        [[read_number(element, key, f"{where}: {key}", "" if key in moments else "0") for key in row] for row in rows]
    )


def read_frame(element: ElementTree.Element | None, where: str) -> Array:
    """Return the frame (4, 4) of an <origin>, the identity without one; roll, pitch and yaw are about fixed axes."""
    frame = np.eye(4)
    frame[:3, :3] = rpy_matrix(*read_numbers(attribute(element, "rpy", "0 0 0"), 3, f"{where}: rpy"))
    frame[:3, 3] = read_numbers(attribute(element, "xyz", "0 0 0"), 3, f"{where}: origin")
    return frame


def _read_link(element: ElementTree.Element, name: str, colors: Mapping[str, Color], where: str) -> Link:
    mass_element, tensor = element.find("inertial/mass"), element.find("inertial/inertia")
    if mass_element is None or tensor is None:
        raise SurefootError(f"{where} has no <inertial> with <mass> and <inertia>; every link needs both")
    mass = read_number(mass_element, "value", f"{where}: mass")
    inertia = read_inertia(tensor, where)
    xx, yy, zz = np.diag(inertia)
    if not mass > 0:
        raise SurefootError(f"{where}: mass is {mass:g}; it must be over 0 kg")
    if not (min(xx, yy, zz) > 0 and 2 * max(xx, yy, zz) <= (xx + yy + zz) * (1 + 1e-9)):
        raise SurefootError(
            f"{where}: inertia ({xx:g}, {yy:g}, {zz:g}) is impossible for a rigid body; "
            "each must be over 0 and none over the sum of the other two"
        )
    frame = read_frame(element.find("inertial/origin"), f"{where}: inertial")
    visuals, collisions = (
        tuple(shape for item in element.findall(use) if (shape := read_shape(item, name, colors, f"{where}: {use}")))
        for use in ("visual", "collision")
    )
    return Link(RigidBody(mass, frame[:3, 3], frame[:3, :3] @ inertia @ frame[:3, :3].T), visuals, collisions)


def read_shape(element: ElementTree.Element, link: str, colors: Mapping[str, Color], where: str) -> Shape | None:
    """Parse a <visual> or <collision>; return None for a mesh or another kind of shape."""
    for kind in ("box", "cylinder", "sphere"):
        if (solid := element.find(f"geometry/{kind}")) is not None:
            break
    else:
        return None
    where = f"{where}: {kind}"
    if kind == "box":
        size = tuple(side / 2 for side in read_numbers(attribute(solid, "size"), 3, f"{where}: size"))
    else:
        size = (read_number(solid, "radius", f"{where}: radius"),)
        if kind == "cylinder":
            size = (*size, read_number(solid, "length", f"{where}: length") / 2)
    if not min(size) > 0:
        raise SurefootError(f"{where} has a side, radius or length of {2 * min(size):g}; they must be over 0 m")
    return Shape(link, kind, size, read_frame(element.find("origin"), where), read_material(element, colors, where))


def read_material(element: ElementTree.Element, colors: Mapping[str, Color], where: str) -> Color:
    """Return the color of a <visual>: of its own material, of a material in `colors` that it names, or else grey."""
    material = element.find("material")
    color = None if material is None else _read_color(material, where) or colors.get(material.get("name", ""))
    return color or GREY


def _read_color(material: ElementTree.Element, where: str) -> Color | None:
    """Return the color of a material, or None if it only refers to another by name."""
    color = material.find("color")
    if color is None:
        return None
    rgba = read_numbers(attribute(color, "rgba", "0.5 0.5 0.5 1"), 4, f"{where}: rgba")
    red, green, blue, _ = (round(255 * min(max(value, 0.0), 1.0)) for value in rgba)
    return red, green, blue


def _read_joint(element: ElementTree.Element, name: str, links: Collection[str], where: str) -> Joint:
    parent, child = attribute(element.find("parent"), "link"), attribute(element.find("child"), "link")
    for end in (parent, child):
        if end not in links:
            raise SurefootError(f"{where} refers to '{end}', which is not a link; {suggest(end, links)}")
    kind, limits = attribute(element, "type"), None
    if kind not in KINDS:
        raise SurefootError(f"{where}: type is '{kind}'; {suggest(kind, KINDS)}")
    x, y, z = read_numbers(attribute(element.find("axis"), "xyz", "1 0 0"), 3, f"{where}: axis")
    length = math.hypot(x, y, z)
    if kind != "fixed" and length == 0.0:
        raise SurefootError(f"{where}: axis is (0, 0, 0); it must have a direction")
    frame = read_frame(element.find("origin"), where)
    if kind == "revolute":
        limit = element.find("limit")
        low, high = (read_number(limit, end, f"{where}: limit {end}", "0") for end in ("lower", "upper"))
        if not low < high:
            raise SurefootError(f"{where}: limits are [{low:g}, {high:g}]; the lower one must be below the upper")
        limits = low, high
    length = length or 1.0
    return Joint(name, kind, parent, child, (x / length, y / length, z / length), frame, limits)


def format_urdf(urdf: Urdf, name: str, *, principal: bool = False) -> str:
    """Format a URDF as text, without colors.

    Args:
        urdf: links and joints.
        name: name of the robot.
        principal: whether to write inertias as principal moments in a frame along the principal axes, because readers
            treat products of inertia differently, and numbers with enough digits to be read back exactly.
    """

    def words(*values: float) -> str:
        return quoteattr(" ".join(f"{value:.17g}" if principal else f"{value:.9g}" for value in values))

    def origin(frame: Array) -> str:
        place, turn = frame[:3, 3], np.asarray(matrix_rpy(frame[:3, :3]))
        if not principal:
            place, turn = (np.where(np.abs(part) < 1e-9, 0.0, part) for part in (place, turn))
        return f"<origin xyz={words(*place)} rpy={words(*turn)}/>"

    lines = [f"<robot name={quoteattr(name)}>"]
    for link_name, link in urdf.links.items():
        frame, inertia = np.eye(4), link.body.inertia
        frame[:3, 3] = link.body.centre
        if principal:
            moments, frame[:3, :3] = link.body.principal()
            inertia = np.diag(moments)
        tensor = " ".join(f"i{'xyz'[r]}{'xyz'[c]}={words(inertia[r, c])}" for r in range(3) for c in range(r, 3))
        mass = f"<mass value={words(link.mass)}/><inertia {tensor}/>"
        lines += [f"  <link name={quoteattr(link_name)}>", f"    <inertial>{origin(frame)}{mass}</inertial>"]
        for use, shapes in (("visual", link.visuals), ("collision", link.collisions)):
            for shape in shapes:
                size = f"radius={words(shape.size[0])}"
                if shape.kind == "box":
                    size = f"size={words(*(2 * side for side in shape.size))}"
                elif shape.kind == "cylinder":
                    size += f" length={words(2 * shape.size[1])}"
                lines.append(f"    <{use}>{origin(shape.frame)}<geometry><{shape.kind} {size}/></geometry></{use}>")
        lines.append("  </link>")
    for joint in urdf.joints.values():
        parts = f"<parent link={quoteattr(joint.parent)}/><child link={quoteattr(joint.child)}/>{origin(joint.frame)}"
        if joint.kind != "fixed":
            parts += f"<axis xyz={words(*joint.axis)}/>"
        if joint.limits is not None:
            low, high = map(words, joint.limits)
            parts += f'<limit lower={low} upper={high} effort="1000" velocity="1000"/>'
        lines.append(f'  <joint name={quoteattr(joint.name)} type="{joint.kind}">{parts}</joint>')
    return "\n".join([*lines, "</robot>", ""])
