"""A robot as shapes that move: the URDF's visuals, placed by base pose and motor angles, no engine needed."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.report.drawing.renderer import Mesh
from surefoot.robot import RobotDescription
from surefoot.robot.urdf import Shape
from surefoot.rotations import quat_matrix
from surefoot.task.trace import EpisodeTrace

_HIP = 0.35
"""Radius of a hip that is drawn over its length."""


def scene(robot: RobotDescription) -> list[Shape]:
    """Return the boxes, cylinders and spheres among the URDF's visuals, one or more.

    Links from abduction to hip that have none of these are drawn as cylinders.
    """
    shapes = [shape for link in robot.urdf.links.values() for shape in link.visuals]
    if not shapes:
        raise SurefootError(
            f"{robot.urdf.path}: has nothing to draw; a link's <visual> must be a box, cylinder or sphere"
        )
    return shapes + _hips(robot, {shape.link for shape in shapes})


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
            frame = np.eye(4)
            frame[:3] = np.column_stack([side, np.cross(along, side), along, hip.frame[:3, 3] / 2])
            shapes.append(Shape(hip.parent, "cylinder", (_HIP * length, length / 2), frame))
    return shapes


def extent(robot: RobotDescription) -> float:
    """Return how large a robot is [m]: the diagonal of the box around its shapes in the resting pose."""
    frames = robot.link_frames(robot.resting_angles)
    points = Mesh(scene(robot), list(frames)).place_points(np.array(list(frames.values())))
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def poses(
    robot: RobotDescription, base_position: ArrayLike, base_quat: ArrayLike, motor_angles: ArrayLike
) -> dict[str, Array]:
    """Return by link the frames (T, 4, 4) in the world, with every leg's loop closed.

    Args:
        robot: whose links.
        base_position: (T, 3) m, origin of the base link in the world.
        base_quat: (T, 4) w x y z, from the base to the world.
        motor_angles: (T, M) rad, in the robot's motor order.

    Raises:
        SurefootError: numbers that are not finite, or angles at which a leg's loop can't close.
    """
    position, quat, theta = (np.atleast_2d(np.asarray(x, float)) for x in (base_position, base_quat, motor_angles))
    for name, array in (("base position", position), ("base orientation", quat), ("motor angles", theta)):
        if not np.isfinite(array).all():
            raise SurefootError(f"the {name} is not known throughout; the robot can't be drawn")
    base = np.tile(np.eye(4), (len(theta), 1, 1))
    base[:, :3, :3], base[:, :3, 3] = quat_matrix(quat / np.linalg.norm(quat, axis=-1, keepdims=True)), position
    frames = {link: base @ frame for link, frame in robot.link_frames(theta).items()}
    for leg in robot.legs:
        open_steps = ~np.isfinite(frames[leg.foot]).all(axis=(-1, -2))
        if open_steps.any():
            step = int(np.argmax(open_steps))
            raise SurefootError(f"leg {leg.name} can't close its loop at step {step}; check the motor angles")
    return frames


def trace_poses(robot: RobotDescription, trace: EpisodeTrace) -> dict[str, Array]:
    """Return by link the frames (T, 4, 4) in the world at the end of each control step of a trace.

    Where the true motor angles are missing, the readings are used, which are a little old.
    """
    complete = np.isfinite(trace.true_motor_angle).all()
    angles = trace.true_motor_angle if complete else trace.motor_angle
    return poses(robot, trace.base_position_world[1:], trace.base_quat_world[1:], angles)
