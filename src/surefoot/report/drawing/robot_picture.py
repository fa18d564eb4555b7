"""Image of a robot in its resting pose, with the axes of the base and the names of the legs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import ImageDraw

from surefoot.report.drawing.mesh import Mesh
from surefoot.report.drawing.renderer import Camera, View, draw
from surefoot.report.drawing.scene import poses
from surefoot.report.drawing.video import INK, label_font
from surefoot.robot import RobotDescription

SIZE = (960, 720)
"""Width and height of the image [px]."""
_AXES = {
    "x forward": ((0.6, 0.0, 0.0), (200, 40, 40)),
    "y left": ((0.0, 0.6, 0.0), (30, 140, 50)),
    "z up": ((0.0, 0.0, 0.35), (40, 70, 200)),
}
"""Vectors of the axes, in leg lengths, and their colors."""


def save_robot_picture(robot: RobotDescription, path: Path) -> None:
    """Write the image as a PNG file."""
    length = robot.leg_geometry.length
    level = poses(robot, np.zeros(3), [1.0, 0.0, 0.0, 0.0], robot.resting_angles)
    height = -min(float(level[leg.foot][0, 2, 3]) for leg in robot.legs)
    placed = poses(robot, [0.0, 0.0, height], [1.0, 0.0, 0.0, 0.0], robot.resting_angles)
    bodies = list(placed)
    size = 4.6 * max(length, robot.body_length)
    camera = Camera(offset=(0.55 * size, -0.7 * size, 0.42 * size), height=0.5 * height)
    view = View(camera, (0.0, 0.0), SIZE)
    picture = draw(Mesh(robot.appearance(), bodies), np.array([placed[name][0] for name in bodies]), view)
    pen, font = ImageDraw.Draw(picture), label_font(20)

    def at(point: np.ndarray) -> tuple[float, float]:
        pixel, _ = view.project(np.asarray(point, float))
        return float(pixel[0]), float(pixel[1])

    start = np.array([0.0, 0.0, height + 0.2 * length])
    for name, (vector, color) in _AXES.items():
        axis = length * np.array(vector)
        pen.line([at(start), at(start + axis)], fill=color, width=4)
        label = start + axis + 0.06 * length * axis / np.linalg.norm(axis)
        pen.text(at(label), name, fill=color, font=font, anchor="mm")
    for leg in robot.legs:
        foot = placed[leg.foot][0, :3, 3]
        pen.text(at(foot - [0.0, 0.0, 0.12 * length]), leg.name.replace("_", " "), fill=INK, font=font, anchor="mm")
    picture.save(path)
