"""Inertias of imported links: massless frames, placeholders, and implausible values."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices
from surefoot.robot.rigid_body import are_valid_moments, box_moments, describe_gyration, first_with_count
from surefoot.robot.urdf_file import attribute, read_frame, read_inertia, read_number, read_shape

_MAX_FRAME_MASS = 1e-6
"""Mass [kg] below which a fixed link counts as a massless frame; CAD exporters give frames such masses."""
_DENSITY = 1000.0
"""Assumed density [kg/m3] of a link with known mass and unknown size."""
_MIN_THICKNESS_RATIO = 0.2
"""Minimum thickness of the box around a link's joints relative to its length."""
_MIN_MOMENT = 1e-14
"""Minimum moment of inertia [kg m2] that MuJoCo accepts."""
_MAX_POINT_INERTIA = 1e-12
"""Maximum trace of the inertia [kg m2] of a fixed link that counts as a point mass."""
_MIN_BODY_FRACTION = 0.2
"""Fraction of the robot's mass from which a link without inertia counts as a body, such as the trunk, instead of a
point mass."""
_MIN_COMPARED_FRACTION = 0.01
"""Fraction of the robot's mass from which a link's inertia is compared with its shapes instead of the robot's size."""
_NO_PRODUCTS = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
"""Attributes of an inertia without products."""
_NO_INERTIA = dict.fromkeys(("ixx", "iyy", "izz"), "0") | _NO_PRODUCTS
"""Attributes of an inertia of 0."""


def prepare_inertias(root: ElementTree.Element, path: Path, notes: list[str]) -> None:
    """Change a URDF's inertias in place so that MuJoCo accepts them.

    The <inertial> of a massless link is removed. Zero, missing or negative inertias are estimated from shapes for
    moving links, for heavy links, and for all links if no link has an inertia. Physically impossible inertias are
    noted, and MuJoCo balances them, by the mean of the three moments; those that are only rounded get the closest
    possible largest moment.
    """
    moved, frames, odd = _moved_links(root), [], []
    inertials: dict[str, tuple[ElementTree.Element, float, Array]] = {}
    for link in root.findall("link"):
        if (inertial := link.find("inertial")) is None:
            continue
        name = link.get("name", "")
        where, tensor = f"{path}: link '{name}'", inertial.find("inertia")
        mass = read_number(inertial.find("mass"), "value", f"{where}: mass")
        if mass > 0.0 and tensor is None and name in moved:
            tensor = ElementTree.SubElement(inertial, "inertia", _NO_INERTIA)
        if mass == 0.0 or tensor is None:
            link.remove(inertial)
        elif 0.0 < mass < _MAX_FRAME_MASS and name not in moved:
            link.remove(inertial)
            frames.append(name)
        else:
            inertials[name] = tensor, mass, read_inertia(tensor, where)
    if not inertials:
        raise SurefootError(f"{path}: no link has an <inertial> with a mass; masses and inertias are needed")
    if frames:
        notes.append(f"frames of less than {_MAX_FRAME_MASS:g} kg count as massless: {choices(frames)}")
    zero = [name for name, (_, mass, inertia) in inertials.items() if mass > 0 and not inertia.any()]
    heavy = _MIN_BODY_FRACTION * sum(mass for _, mass, _ in inertials.values())
    estimated = [name for name in zero if len(zero) == len(inertials) or name in moved or inertials[name][1] > heavy]
    for name, (tensor, mass, inertia) in inertials.items():
        min_moment = float(np.linalg.eigvalsh(inertia).min())
        if mass <= 0 or min_moment >= _MIN_MOMENT or not inertia.any():
            continue
        if name not in moved and min_moment >= 0 and float(np.trace(inertia)) < _MAX_POINT_INERTIA:
            tensor.attrib |= _NO_INERTIA
            inertials[name] = tensor, mass, np.zeros((3, 3))
        else:  # MuJoCo rejects it
            estimated.append(name)
    links = {link.get("name", ""): link for link in root.findall("link")}
    for name in estimated:
        tensor, mass, _ = inertials[name]
        moments = _moments_of_shapes(links[name], root, mass, path)
        tensor.attrib |= {f"i{axis}": f"{value:.6g}" for axis, value in zip(("xx", "yy", "zz"), moments, strict=True)}
        tensor.attrib |= _NO_PRODUCTS
        inertials[name] = tensor, mass, np.diag(moments)
    if estimated:
        few = choices(estimated[:4]) + (f" and {len(estimated) - 4} more" if len(estimated) > 4 else "")
        notes.append(f"inertias of 0 or less in the file are estimated from masses and shapes: {few}")
    for name, (tensor, mass, inertia) in inertials.items():
        principal = np.linalg.eigvalsh(inertia)
        point_mass = mass > 0 and not np.diag(inertia).any()
        if not point_mass and not (mass > 0 and are_valid_moments(principal)):
            odd.append(name)
        elif mass > 0 and principal[2] > principal[:2].sum():
            _round_down(tensor, inertia)
        if not principal.min() > 0:
            tensor.attrib |= _NO_PRODUCTS
    if odd:
        notes.append(f"inertias that no rigid body can have are balanced: {choices(odd)}")


def _round_down(tensor: ElementTree.Element, inertia: Array) -> None:
    """Write an inertia whose largest moment is the sum of the others, which is the most that a rigid body can have."""
    moments, axes = np.linalg.eigh(inertia)
    moments[2] = moments[:2].sum() * (1 - 1e-9)  # MuJoCo compares without a tolerance
    inertia = axes @ np.diag(moments) @ axes.T
    tensor.attrib |= {
        f"i{'xyz'[row]}{'xyz'[column]}": repr(float(inertia[row, column]))
        for row in range(3)
        for column in range(row, 3)
    }


def drop_frame_masses(spec: mujoco.MjSpec, notes: list[str]) -> None:
    """Remove the mass of fixed bodies in an MJCF that have almost none."""
    frames = [
        body
        for body in spec.bodies
        if body.explicitinertial and 0 < body.mass < _MAX_FRAME_MASS and not body.joints and not body.geoms
    ]
    for body in frames:
        body.explicitinertial = False
    if frames:
        notes.append(
            f"frames of less than {_MAX_FRAME_MASS:g} kg count as massless: {choices(body.name for body in frames)}"
        )


def _moved_links(root: ElementTree.Element) -> set[str]:
    """Return the names of links that a joint moves relative to their parent."""
    joints = root.findall("joint")
    return {attribute(joint.find("child"), "link") for joint in joints if joint.get("type") != "fixed"}


def _moments_of_shapes(link: ElementTree.Element, root: ElementTree.Element, mass: float, path: Path) -> Array:
    """Estimate the moments (3,) [kg m2] by a box around a link's shapes, else around its joints, else by a ball."""
    points = _shape_corners(link, path)
    if not points:
        name = link.get("name")
        children = [joint for joint in root.findall("joint") if attribute(joint.find("parent"), "link") == name]
        ends = [read_frame(joint.find("origin"), f"{path}: joint '{joint.get('name')}'")[:3, 3] for joint in children]
        points = [np.zeros((1, 3)), *(end[None] for end in ends)]
    sides = np.ptp(np.concatenate(points), axis=0)
    if not sides.any():
        return np.full(3, 0.4 * mass * (3 * mass / (4 * np.pi * _DENSITY)) ** (2 / 3))
    return box_moments(mass, np.maximum(sides, _MIN_THICKNESS_RATIO * sides.max()))


def _shape_corners(link: ElementTree.Element, path: Path) -> list[Array]:
    """Return the corners (8, 3) of the bounding boxes of a link's collision shapes, or else of its visuals."""
    name = link.get("name")
    for use in ("collision", "visual"):
        shapes = [read_shape(shape, name or "", {}, f"{path}: link '{name}': {use}") for shape in link.findall(use)]
        if corners := [shape.corners for shape in shapes if shape is not None]:
            return corners
    return []


def implausible_inertias(model: mujoco.MjModel, data: mujoco.MjData, points: Sequence[Array]) -> list[str]:
    """Return warnings about bodies whose inertia does not match their size: at most one each for too large and small.

    The radius of gyration is at most the distance of the farthest point from the centre of mass.

    Args:
        model: the imported model.
        data: its kinematic state at zero angles.
        points: points (p, 3) on the shapes of each body.
    """
    everything = np.concatenate([data.xpos[1:], *points[1:]])
    robot_size, total = float(np.linalg.norm(np.ptp(everything, axis=0))), float(model.body_mass.sum())
    large: list[str] = []
    small: list[str] = []
    for body in range(1, model.nbody):
        mass, moments = float(model.body_mass[body]), np.array(model.body_inertia[body])
        if mass <= 0 or not moments.any():
            continue
        joints = data.xpos[[body, *np.flatnonzero(model.body_parentid == body)]]
        own = np.concatenate([points[body], joints])
        in_frame = (own - data.xipos[body]) @ data.xmat[body].reshape(3, 3)
        known = len(points[body]) > 0 and mass > _MIN_COMPARED_FRACTION * total
        words = describe_gyration(model.body(body).name, mass, moments, in_frame if known else None, robot_size)
        if words is not None:
            (large if words[0] else small).append(words[1])
    return [first_with_count(words) for words in (large, small) if words]
