"""Camera for images of simulated robots as arrays."""

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
    """Camera that renders robots of one kind.

    Args:
        robot: description of the robots.
        size: width and height of images [px].
    """

    def __init__(self, robot: RobotDescription, size: tuple[int, int] = (640, 480)) -> None:
        self._robot, self._size, self._camera = robot, size, Camera.for_robot(extent(robot))
        self._links = list(robot.link_frames(robot.resting_angles))
        self._mesh = Mesh(robot.appearance(), self._links)

    def __call__(self, position: Array, quat: Array, angles: Array, ground: Ground) -> NDArray[np.uint8]:
        """Render robots on a ground; return images (N, height, width, 3). For the states of robots see `poses`."""
        placed = poses(self._robot, position, quat, angles)
        stack = np.stack([placed[link] for link in self._links], axis=1)
        images = []
        for point, frames in zip(position, stack, strict=True):
            view = View(self._camera, point[:2], self._size, ground)
            images.append(np.asarray(draw(self._mesh, frames, view)))
        return np.array(images, np.uint8)
