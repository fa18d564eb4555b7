"""Draw the pictures of robots in the documentation: python docs/pictures.py [FOLDER ...].

They are docs/gaits.png, moments of a stride; docs/robots.png, the robots that ship; and, out of six folders that
`surefoot robot new` wrote, docs/robots-imported.png.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from gallery import recorded
from PIL import Image

from surefoot.report.drawing.mesh import Mesh
from surefoot.report.drawing.renderer import Camera, View, draw
from surefoot.report.drawing.scene import extent, poses, trace_poses
from surefoot.report.drawing.video import write_label
from surefoot.robot import RobotDescription

FOLDER = Path(__file__).parent
MOMENTS = 5
GAP = 4
"""Between pictures [px]."""


def sheet(pictures: list[Image.Image], columns: int) -> Image.Image:
    """Return pictures of one size in rows."""
    width, height = pictures[0].size
    rows = -(-len(pictures) // columns)
    whole = Image.new("RGB", (columns * (width + GAP) - GAP, rows * (height + GAP) - GAP), "white")
    for k, picture in enumerate(pictures):
        whole.paste(picture, (k % columns * (width + GAP), k // columns * (height + GAP)))
    return whole


def stride(name: str, size: tuple[int, int]) -> list[Image.Image]:
    """Return moments of a stride of a policy that ships, after three seconds."""
    one = recorded(name)
    placed = trace_poses(one.robot, one.trace)
    mesh, stack = Mesh(one.robot.appearance(), list(placed)), np.stack(list(placed.values()), axis=1)
    on_ground = one.trace.foot_contact[:, 0] > 0.5
    touchdown = np.flatnonzero(on_ground[1:] & ~on_ground[:-1] & (one.trace.time[1:] > 3.0))
    camera = Camera.for_robot(0.9 * extent(one.robot))
    pictures = []
    for step in np.linspace(touchdown[0], touchdown[1], MOMENTS, endpoint=False).astype(int):
        pictures.append(draw(mesh, stack[step], View(camera, placed[one.robot.base][step, :2, 3], size)))
    return pictures


def portrait(robot: RobotDescription, size: tuple[int, int]) -> Image.Image:
    """Return a robot in its resting pose with its name."""
    level = poses(robot, np.zeros(3), [1.0, 0.0, 0.0, 0.0], robot.resting_angles)
    mesh, stack = Mesh(robot.appearance(), list(level)), np.array([frames[0] for frames in level.values()])
    stack[:, 2, 3] -= mesh.place(stack)[0][:, 2].min()
    camera = Camera.for_robot(1.1 * extent(robot))
    picture = draw(mesh, stack, View(camera, (0.0, 0.0), size))
    write_label(picture, robot.name)
    return picture


if __name__ == "__main__":
    sheet([*stride("gallop", (320, 240)), *stride("trot", (320, 240))], MOMENTS).save(FOLDER / "gaits.png")
    robots = [RobotDescription.load(name) for name in RobotDescription.available()]
    sheet([portrait(robot, (640, 360)) for robot in robots], 2).save(FOLDER / "robots.png")
    if sys.argv[1:]:
        imported = [RobotDescription.load(folder) for folder in sys.argv[1:]]
        sheet([portrait(robot, (480, 320)) for robot in imported], 3).save(FOLDER / "robots-imported.png")
