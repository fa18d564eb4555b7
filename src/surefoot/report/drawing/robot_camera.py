"""Pictures of simulated robots as arrays, each by a camera that follows it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.report.drawing.mesh import Mesh
from surefoot.report.drawing.renderer import Camera, View, draw
from surefoot.report.drawing.scene import extent, poses
from surefoot.robot import RobotDescription
from surefoot.world.ground import Ground


class RobotCamera:
    """Takes pictures of robots of one kind.

    Args:
        robot: their description.
        size: width and height in pixels.
    """

    def __init__(self, robot: RobotDescription, size: tuple[int, int] = (640, 480)) -> None:
        self._robot, self._size, self._camera = robot, size, Camera.for_robot(extent(robot))
        self._links = list(robot.link_frames(robot.resting_angles))
        self._mesh = Mesh(robot.appearance(), self._links)

    def __call__(self, position: Array, quat: Array, angles: Array, ground: Ground) -> NDArray[np.uint8]:
        """Return pictures (N, height, width, 3) of robots, as `poses` takes them, on a ground."""
        placed = poses(self._robot, position, quat, angles)
        stack = np.stack([placed[link] for link in self._links], axis=1)
        pictures = []
        for point, frames in zip(position, stack, strict=True):
            view = View(self._camera, point[:2], self._size, ground)
            pictures.append(np.asarray(draw(self._mesh, frames, view)))
        return np.array(pictures, np.uint8)
