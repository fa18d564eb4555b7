"""Poses of a robot's links from base pose and motor angles, computed without a physics engine."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.rotations import quat_matrix
from surefoot.task.trace import EpisodeTrace


def extent(robot: RobotDescription) -> float:
    """Return the extent of a robot [m]: the diagonal of the bounding box of its visual parts in the resting pose."""
    frames = robot.link_frames(robot.resting_angles)
    parts = robot.appearance().parts
    points = [part.vertices @ frames[part.link][:3, :3].T + frames[part.link][:3, 3] for part in parts]
    return float(np.linalg.norm(np.ptp(np.concatenate(points), axis=0)))


def poses(
    robot: RobotDescription, base_position: ArrayLike, base_quat: ArrayLike, motor_angles: ArrayLike
) -> dict[str, Array]:
    """Return the poses (T, 4, 4) of all links in the world frame, by link, with closed leg loops.

    Args:
        robot: description of the robot.
        base_position: (T, 3) position of the base link in the world frame [m].
        base_quat: (T, 4) orientation w x y z, from the base to the world frame.
        motor_angles: (T, M) motor angles in the robot's motor order [rad].

    Raises:
        SurefootError: values are not finite, or a leg can't close its loop at the given angles.
    """
    position, quat, theta = (np.atleast_2d(np.asarray(x, float)) for x in (base_position, base_quat, motor_angles))
    for name, array in (("base position", position), ("base orientation", quat), ("motor angles", theta)):
        if not np.isfinite(array).all():
            raise SurefootError(f"the {name} is not known in all rows; the robot can't be drawn")
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
    """Return the poses (T, 4, 4) of all links in the world frame at the end of each control step of a trace, by link.

    If the true motor angles are missing, the slightly delayed readings are used.
    """
    complete = np.isfinite(trace.true_motor_angle).all()
    angles = trace.true_motor_angle if complete else trace.motor_angle
    return poses(robot, trace.base_position_world[1:], trace.base_quat_world[1:], angles)
