"""The part of a URDF that surefoot reads itself: names, masses, inertias and joint axes.

Engines read the same file with their own readers; this one exists so that a description can be checked, and
refused with a clear message, without any engine.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError, accessible, choices
from surefoot.files import read_configuration
from surefoot.rotations import rpy_matrix


@dataclass(frozen=True)
class Link:
    """One rigid link: mass [kg] and diagonal of the inertia [kg m2] about its centre of mass."""

    name: str
    mass: float
    inertia: tuple[float, float, float]


@dataclass(frozen=True)
class Joint:
    """One joint: name, type, the links that it joins, its axis in the child's frame, and its place in the parent's."""

    name: str
    kind: str
    parent: str
    child: str
    axis: tuple[float, float, float]
    frame: Array
    """Frame (4, 4) of the child in the parent's at angle 0."""
    limits: tuple[float, float] | None = None
    """Least and greatest angle [rad]; None: it turns without end."""


@dataclass(frozen=True)
class Urdf:
    """Links and joints of a URDF, by name, in the order of the file."""

    path: Path
    links: dict[str, Link]
    joints: dict[str, Joint]

    @property
    def total_mass(self) -> float:
        """Mass of all links [kg]."""
        return sum(link.mass for link in self.links.values())

    @property
    def root(self) -> str:
        """Name of the link that has no parent joint."""
        return _roots(self.links, self.joints)[0]

    @property
    def frames(self) -> dict[str, Array]:
        """Frames (4, 4) of all links in the root's, with all joints at 0."""
        found, waiting = {self.root: np.eye(4)}, list(self.joints.values())
        while waiting:
            ready = [joint for joint in waiting if joint.parent in found]
            found |= {joint.child: found[joint.parent] @ joint.frame for joint in ready}
            waiting = [joint for joint in waiting if joint.child not in found]
        return found

    def below(self, joint: str) -> set[str]:
        """Return the names of the links that a joint moves."""
        found = {self.joints[joint].child}
        while more := {other.child for other in self.joints.values() if other.parent in found} - found:
            found |= more
        return found

    def fixed_to(self, link: str) -> set[str]:
        """Return the names of the links that move as one with `link`, itself included."""
        group = {link}
        while True:
            more = set(group)
            for joint in self.joints.values():
                if joint.kind == "fixed" and (joint.parent in group) != (joint.child in group):
                    more |= {joint.parent, joint.child}
            if more == group:
                return group
            group = more


def _roots(links: dict[str, Link], joints: dict[str, Joint]) -> list[str]:
    """Return the names of the links that have no parent joint."""
    return [name for name in links if name not in {joint.child for joint in joints.values()}]


def attribute(element: ElementTree.Element | None, key: str, default: str = "") -> str:
    """Return an attribute of an element; the default if either is missing."""
    return default if element is None else element.get(key, default)


def frame_of(element: ElementTree.Element | None, where: str = "a shape") -> Array:
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


def read_urdf(path: Path) -> Urdf:
    """Read a URDF.

    Raises:
        SurefootError: the file can't be read, is not a URDF, or a mass or inertia is not that of a body.
    """
    try:
        with accessible(path):
            robot = ElementTree.fromstring(read_configuration(path))
    except ElementTree.ParseError as error:
        raise SurefootError(f"{path}: is not well-formed XML: {error}") from error
    if robot.tag != "robot":
        raise SurefootError(f"{path}: the root element is <{robot.tag}>; a URDF's is <robot>")

    links = {}
    for element in robot.findall("link"):
        name = element.get("name", "")
        mass_element = element.find("inertial/mass")
        inertia_element = element.find("inertial/inertia")
        if mass_element is None or inertia_element is None:
            raise SurefootError(
                f"{path}: link '{name}' has no <inertial> with <mass> and <inertia>; every link needs both"
            )
        (mass,) = _floats(attribute(mass_element, "value"), 1, f"{path}: link '{name}': mass")
        ixx, iyy, izz = (
            _floats(attribute(inertia_element, key), 1, f"{path}: link '{name}': {key}")[0]
            for key in ("ixx", "iyy", "izz")
        )
        if not mass > 0:
            raise SurefootError(f"{path}: link '{name}': mass is {mass:g}; it must be over 0 kg")
        if not (min(ixx, iyy, izz) > 0 and 2 * max(ixx, iyy, izz) <= (ixx + iyy + izz) * (1 + 1e-9)):
            raise SurefootError(
                f"{path}: link '{name}': inertia ({ixx:g}, {iyy:g}, {izz:g}) is not a rigid body's; "
                "each must be over 0 and none over the sum of the other two"
            )
        links[name] = Link(name, mass, (ixx, iyy, izz))

    joints = {}
    for element in robot.findall("joint"):
        name = element.get("name", "")
        ends = attribute(element.find("parent"), "link"), attribute(element.find("child"), "link")
        for end in ends:
            if end not in links:
                raise SurefootError(f"{path}: joint '{name}' joins '{end}', not a link; choices: {choices(links)}")
        axis = element.find("axis")
        x, y, z = _floats(attribute(axis, "xyz") if axis is not None else "1 0 0", 3, f"{path}: joint '{name}': axis")
        where = f"{path}: joint '{name}'"
        frame = frame_of(element.find("origin"), where)
        kind, limits = attribute(element, "type"), None
        if kind == "revolute":
            (low,), (high,) = (
                _floats(attribute(element.find("limit"), end, "0"), 1, f"{where}: limit {end}")
                for end in ("lower", "upper")
            )
            if not low < high:
                raise SurefootError(f"{where}: limits are [{low:g}, {high:g}]; the lower one must be below the upper")
            limits = low, high
        joints[name] = Joint(name, kind, *ends, (x, y, z), frame, limits)

    roots = _roots(links, joints)
    if len(roots) != 1:
        raise SurefootError(
            f"{path}: {len(roots)} links have no parent ({choices(roots)}); exactly one must be the root"
        )
    return Urdf(path, links, joints)
