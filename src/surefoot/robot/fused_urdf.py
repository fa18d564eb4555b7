"""A URDF in which links with fixed joints are fused, for engines that would keep them apart.

A rotor and the link bolted to it move as one rigid body. For bodies k with mass m_k, centre of mass c_k and inertia
I_k about it, all in the frame of the fused link,

    m = sum m_k        c = sum m_k c_k / m
    I = sum (I_k + m_k (|d_k|^2 1 - d_k d_k^T)),   d_k = c_k - c                (parallel axes)

The fused link is written with its principal moments, in an inertial frame along its principal axes: readers of URDF
differ in how they handle products of inertia.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from surefoot.arrays import Array
from surefoot.robot.rigid_body import RigidBody, fuse
from surefoot.robot.urdf import Urdf, attribute, frame_of
from surefoot.rotations import matrix_rpy


@dataclass(frozen=True)
class FusedUrdf:
    """The fused links by name, the place of each link of the file in them, and the new URDF."""

    bodies: dict[str, RigidBody]
    place: dict[str, tuple[str, Array]]
    """For each link of the file: the fused link, and the link's frame (4, 4) in the fused link's."""
    text: str


def _origin(frame: Array) -> ElementTree.Element:
    """Return the <origin> of a frame (4, 4), in decimals that are read back as the same numbers."""

    def words(values: Array) -> str:
        return " ".join(repr(float(value)) for value in values)

    return ElementTree.Element("origin", xyz=words(frame[:3, 3]), rpy=words(matrix_rpy(frame[:3, :3])))


def _rigid_body(link: ElementTree.Element) -> RigidBody:
    """Return mass, centre and inertia of a link of the file, in the link's own frame."""
    frame = frame_of(link.find("inertial/origin"))
    # `read_urdf` has refused links without inertia and mass.
    element = link.find("inertial/inertia")
    xx, xy, xz, yy, yz, zz = (float(attribute(element, key, "0")) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    turn = frame[:3, :3]
    return RigidBody(float(attribute(link.find("inertial/mass"), "value")), frame[:3, 3], turn @ inertia @ turn.T)


def _places(joints: list[ElementTree.Element], root: str) -> dict[str, tuple[str, Array]]:
    """Return for each link the root of its group of fixed links, and its frame there."""
    children: dict[str, list[ElementTree.Element]] = {}
    for joint in joints:
        children.setdefault(attribute(joint.find("parent"), "link"), []).append(joint)
    place, waiting = {root: (root, np.eye(4))}, [root]
    while waiting:
        parent = waiting.pop()
        for joint in children.get(parent, []):
            child = attribute(joint.find("child"), "link")
            top, frame = place[parent]
            fixed = joint.get("type") == "fixed"
            place[child] = (top, frame @ frame_of(joint.find("origin"))) if fixed else (child, np.eye(4))
            waiting.append(child)
    return place


def fuse_urdf(urdf: Urdf, shifts: Mapping[str, Array] = MappingProxyType({})) -> FusedUrdf:
    """Fuse the links of a URDF that fixed joints join; a group takes the name and frame of its topmost link.

    Visuals are left out. `shifts` moves centres of mass of fused links, by name [m].
    """
    robot = ElementTree.parse(urdf.path).getroot()
    links = {link.get("name", ""): link for link in robot.findall("link")}
    joints = robot.findall("joint")
    place = _places(joints, urdf.root)
    fused = ElementTree.Element("robot", name=robot.get("name", ""))
    groups: dict[str, list[str]] = {}
    for name, (top, _) in place.items():
        groups.setdefault(top, []).append(name)
    bodies = {}
    for top, names in groups.items():
        bodies[top] = fuse([(_rigid_body(links[name]), place[name][1]) for name in names])
        if top in shifts:
            bodies[top] = replace(bodies[top], centre=bodies[top].centre + shifts[top])
        link = ElementTree.SubElement(fused, "link", name=top)
        link.append(_inertial(bodies[top]))
        for name in names:
            for shape in links[name].findall("collision"):
                _move(shape, place[name][1])
                link.append(shape)
    for joint in joints:
        if joint.get("type") != "fixed":
            parent = joint.find("parent")
            assert parent is not None
            top, frame = place[parent.get("link", "")]
            parent.set("link", top)
            _move(joint, frame)
            fused.append(joint)
    return FusedUrdf(bodies, place, ElementTree.tostring(fused, encoding="unicode"))


def _inertial(body: RigidBody) -> ElementTree.Element:
    moments, axes = body.principal()
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = axes, body.centre
    inertial = ElementTree.Element("inertial")
    inertial.append(_origin(frame))
    ElementTree.SubElement(inertial, "mass", value=repr(float(body.mass)))
    values = {key: "0" for key in ("ixy", "ixz", "iyz")}
    values |= {key: repr(float(moment)) for key, moment in zip(("ixx", "iyy", "izz"), moments, strict=True)}
    ElementTree.SubElement(inertial, "inertia", values)
    return inertial


def _move(element: ElementTree.Element, frame: Array) -> None:
    """Transform an element's <origin> from its link's frame into another, in which the link's is `frame`."""
    origin = element.find("origin")
    moved = frame @ frame_of(origin)
    if origin is not None:
        element.remove(origin)
    element.insert(0, _origin(moved))
