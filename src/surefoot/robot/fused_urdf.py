"""A URDF in which links with fixed joints are fused, for engines that would keep them apart.

A rotor and the link bolted to it move as one rigid body. For bodies k with mass m_k, centre of mass c_k and inertia
I_k about it, all in the frame of the fused link,

    m = sum m_k        c = sum m_k c_k / m
    I = sum (I_k + m_k (|d_k|^2 1 - d_k d_k^T)),   d_k = c_k - c                (parallel axes)

The fused link is written with its principal moments, in an inertial frame along its principal axes: readers of URDF
differ in how they handle products of inertia. Nothing here is MuJoCo's, so that its masses and these check each other.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from surefoot.arrays import Array
from surefoot.robot.rigid_body import RigidBody, fuse
from surefoot.robot.urdf import Urdf, read_frame
from surefoot.rotations import matrix_rpy


@dataclass(frozen=True)
class FusedUrdf:
    """The fused links by name, the place of each link of the file in them, and the new URDF."""

    bodies: dict[str, RigidBody]
    place: dict[str, tuple[str, Array]]
    """For each link of the file: the fused link, and the link's frame (4, 4) in the fused link's."""
    text: str


def fuse_urdf(urdf: Urdf, shifts: Mapping[str, Array] = MappingProxyType({})) -> FusedUrdf:
    """Fuse the links of a URDF that fixed joints join; a group takes the name and frame of its topmost link.

    Visuals are left out. `shifts` moves centres of mass of fused links, by name [m].
    """
    robot = ElementTree.parse(urdf.path).getroot()
    elements = {link.get("name", ""): link for link in robot.findall("link")}
    fused = ElementTree.Element("robot", name=robot.get("name", ""))
    groups: dict[str, list[str]] = {}
    for name, (top, _) in urdf.places.items():
        groups.setdefault(top, []).append(name)
    bodies = {}
    for top, names in groups.items():
        body = fuse([(urdf.links[name].body, urdf.places[name][1]) for name in names])
        bodies[top] = replace(body, centre=body.centre + shifts[top]) if top in shifts else body
        link = ElementTree.SubElement(fused, "link", name=top)
        link.append(_inertial(bodies[top]))
        for name in names:
            for shape in elements[name].findall("collision"):
                _move(shape, urdf.places[name][1])
                link.append(shape)
    for joint in robot.findall("joint"):
        if joint.get("type") != "fixed" and (parent := joint.find("parent")) is not None:
            top, frame = urdf.places[parent.get("link", "")]
            parent.set("link", top)
            _move(joint, frame)
            fused.append(joint)
    return FusedUrdf(bodies, urdf.places, ElementTree.tostring(fused, encoding="unicode"))


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


def _origin(frame: Array) -> ElementTree.Element:
    """Return the <origin> of a frame (4, 4), in decimals that are read back as the same numbers."""
    xyz, rpy = frame[:3, 3].tolist(), np.asarray(matrix_rpy(frame[:3, :3])).tolist()
    return ElementTree.Element("origin", xyz=" ".join(map(repr, xyz)), rpy=" ".join(map(repr, rpy)))


def _move(element: ElementTree.Element, frame: Array) -> None:
    """Transform an element's <origin> from its link's frame into another, in which the link's is `frame`."""
    origin = element.find("origin")
    moved = frame @ read_frame(origin)
    if origin is not None:
        element.remove(origin)
    element.insert(0, _origin(moved))
