"""A robot as shapes that move: the URDF's visuals, placed by base pose and motor angles, no engine needed."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.report.drawing.renderer import GREY, Mesh, Shape
from surefoot.robot import RobotDescription
from surefoot.robot.urdf import frame_of
from surefoot.rotations import quat_matrix
from surefoot.task.trace import EpisodeTrace

_HIP = 0.35
"""Radius of a hip that is drawn over its length."""


def scene(robot: RobotDescription) -> list[Shape]:
    """The boxes, cylinders and spheres among the URDF's visuals, one or more; a link's name is the body's.

    Links from abduction to hip that have none of these are drawn as cylinders.
    """
    root = ElementTree.parse(robot.urdf.path).getroot()
    colors = {item.get("name", ""): color for item in root.findall("material") if (color := _color(item))}
    shapes = []
    for link in root.findall("link"):
        for visual in link.findall("visual"):
            kind, size = _solid(visual)
            if not kind:
                continue
            origin, material = frame_of(visual.find("origin")), visual.find("material")
            color = None if material is None else _color(material) or colors.get(material.get("name", ""))
            shapes.append(Shape(link.get("name", ""), kind, size, origin[:3, 3], origin[:3, :3], color or GREY))
    if not shapes:
        raise SurefootError(
            f"{robot.urdf.path}: has nothing to draw; a link's <visual> must be a box, cylinder or sphere"
        )
    return shapes + _hips(robot, {shape.body for shape in shapes})


def _hips(robot: RobotDescription, drawn: set[str]) -> list[Shape]:
    """Return a cylinder along the hip's axis for each link between abduction and hip that is not `drawn`."""
    shapes, joints = [], robot.urdf.joints
    for leg in robot.legs:
        hip = joints[leg.motors[-2]]
        length = float(np.linalg.norm(hip.frame[:3, 3]))
        if len(leg.motors) == 3 and hip.parent == joints[leg.motors[0]].child not in drawn and length > 1e-3:
            along = hip.frame[:3, 3] / length
            side = np.cross(along, [1.0, 0.0, 0.0] if abs(along[0]) < 0.9 else [0.0, 0.0, 1.0])
            side /= np.linalg.norm(side)
            turn = np.column_stack([side, np.cross(along, side), along])
            shapes.append(Shape(hip.parent, "cylinder", (_HIP * length, length / 2), hip.frame[:3, 3] / 2, turn))
    return shapes


def extent(robot: RobotDescription) -> float:
    """Return how large a robot is [m]: the diagonal of the box around its shapes in the resting pose."""
    placed = poses(robot, np.zeros(3), [1.0, 0.0, 0.0, 0.0], robot.resting_angles)
    bodies = list(placed)
    mesh = Mesh(scene(robot), bodies)
    frames = np.array([placed[body][0] for body in bodies])[mesh.point_body]
    points = np.einsum("nij,nj->ni", frames[:, :3, :3], mesh.points) + frames[:, :3, 3]
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def poses(
    robot: RobotDescription, base_position: ArrayLike, base_quat: ArrayLike, motor_angles: ArrayLike
) -> dict[str, Array]:
    """Forward kinematics, with every leg's loop closed.

    Args:
        robot: whose links.
        base_position: (T, 3) m, origin of the base link in the world.
        base_quat: (T, 4) w x y z, from the base to the world.
        motor_angles: (T, M) rad, in the robot's motor order.

    Returns:
        by link, (T, 4, 4) transforms from the link's frame to the world.

    Raises:
        SurefootError: numbers that are not finite, or angles at which a leg's loop can't close.
    """
    position, quat, theta = (np.atleast_2d(np.asarray(x, float)) for x in (base_position, base_quat, motor_angles))
    for name, array in (("base position", position), ("base orientation", quat), ("motor angles", theta)):
        if not np.isfinite(array).all():
            raise SurefootError(f"the {name} is not known throughout; the robot can't be drawn")
    angles = _joint_angles(robot, theta)
    count = len(theta)
    found = {robot.urdf.root: np.tile(np.eye(4), (count, 1, 1))}
    waiting = list(robot.urdf.joints.values())
    while waiting:
        ready = [joint for joint in waiting if joint.parent in found]
        for joint in ready:
            turn = np.tile(np.eye(4), (count, 1, 1))
            if joint.name in angles:
                turn[:, :3, :3] = _axis_turn(np.array(joint.axis), angles[joint.name])
            found[joint.child] = found[joint.parent] @ joint.frame @ turn
        waiting = [joint for joint in waiting if joint not in ready]
    base = np.tile(np.eye(4), (count, 1, 1))
    base[:, :3, :3], base[:, :3, 3] = quat_matrix(quat / np.linalg.norm(quat, axis=-1, keepdims=True)), position
    world = base @ np.linalg.inv(found[robot.base])
    return {name: world @ pose for name, pose in found.items()}


def trace_poses(robot: RobotDescription, trace: EpisodeTrace) -> dict[str, Array]:
    """The links' poses (T, 4, 4) at the end of each control step of a trace.

    Where true motor angles are not known the readings are taken, which are a little old.
    """
    known = np.isfinite(trace.true_motor_angle).all()
    angles = trace.true_motor_angle if known else trace.motor_angle
    return poses(robot, trace.base_position_world[1:], trace.base_quat_world[1:], angles)


def _joint_angles(robot: RobotDescription, theta: Array) -> dict[str, Array]:
    """Angles (T,) [rad] of motor and knee joints by name, in the URDF's sense."""
    angles = robot.joint_angles(theta)
    for leg in robot.legs:
        for name in leg.knees:
            if not np.isfinite(angles[name]).all():
                step = int(np.argmax(~np.isfinite(angles[name])))
                raise SurefootError(f"leg {leg.name} can't close its loop at step {step}; check the motor angles")
    return angles


def _axis_turn(axis: Array, angle: Array) -> Array:
    """Rotation matrices (T, 3, 3) about an axis by angles (T,) [rad]: a quaternion's."""
    unit = axis / np.linalg.norm(axis)
    return quat_matrix(np.concatenate([np.cos(angle / 2)[:, None], np.sin(angle / 2)[:, None] * unit], axis=1))


def _solid(visual: ElementTree.Element) -> tuple[str, tuple[float, ...]]:
    """Kind and sizes of a visual as `Shape` takes them; an empty kind for a mesh."""
    box, cylinder, sphere = (visual.find(f"geometry/{kind}") for kind in ("box", "cylinder", "sphere"))
    if box is not None:
        return "box", tuple(0.5 * x for x in _numbers(box.get("size", "")))
    if cylinder is not None:
        return "cylinder", (float(cylinder.get("radius", "0")), float(cylinder.get("length", "0")) / 2)
    if sphere is not None:
        return "sphere", (float(sphere.get("radius", "0")),)
    return "", ()


def _color(material: ElementTree.Element) -> tuple[int, int, int] | None:
    """Red, green and blue of a material, 0 to 255; None if it only names one."""
    color = material.find("color")
    if color is None:
        return None
    red, green, blue, _ = (round(255 * x) for x in _numbers(color.get("rgba", "0.5 0.5 0.5 1")))
    return red, green, blue


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.split()]
