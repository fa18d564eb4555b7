"""Draw the pictures of robots in the documentation: python tools/pictures.py [FOLDER ...].

They are docs/gaits.webp, two gaits in motion; docs/gaits.png, moments of a stride; docs/leg-space.png, the coordinates
of a leg; docs/robots.png, the robots that ship; docs/terrain.png and docs/terrain-seeing.png, policies on terrain; and,
out of six folders that `surefoot robot new` wrote, docs/robots-imported.png.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from gallery import recorded
from PIL import Image, ImageDraw

from surefoot.api.policies import find_policy, load_policy, run_policy
from surefoot.evaluation.conditions import Condition
from surefoot.evaluation.recorded import ground_of
from surefoot.report.drawing.mesh import Mesh
from surefoot.report.drawing.renderer import Camera, View, draw
from surefoot.report.drawing.scene import extent, poses, trace_poses
from surefoot.report.drawing.video import write_label
from surefoot.report.figures.style import BLUE, INK, ORANGE, QUIET, new_figure
from surefoot.robot import FiveBar, RobotDescription

FOLDER = Path(__file__).resolve().parents[1] / "docs"
MOMENTS = 5
GAP = 4
"""Between pictures [px]."""
BETWEEN, FPS = (1.0, 4.7), 20
"""What the moving picture shows [s], and its frames a second."""
PUSH = 60.0
"""Force of its pushes [N]."""
RED = (200, 40, 40)
TERRAIN, HOLES = ("stairs:0.10", "slope:20", "rough:0.12", "blocks:0.10"), ("gaps:0.25", "stones:0.25")
"""Terrain on which policies are shown, `ON_IT` seconds after their start at .5 m/s."""
ON_IT = 4.0


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


def motion(name: str, label: str, size: tuple[int, int], force: float | None = None) -> Iterator[Image.Image]:
    """Yield the frames of a policy that ships, with an arrow for .4 s from each push [N] if it is pushed."""
    one = recorded(name, None if force is None else (force, force))
    placed = trace_poses(one.robot, one.trace)
    mesh, stack = Mesh(one.robot.appearance(), list(placed)), np.stack(list(placed.values()), axis=1)
    base = placed[one.robot.base][:, :3, 3]
    camera = Camera.for_robot(1.25 * extent(one.robot))
    for now in np.arange(*BETWEEN, 1 / FPS):
        step = int(np.searchsorted(one.trace.time, now))
        around = np.abs(one.trace.time - now) < 0.4
        view = View(camera, base[around, :2].mean(axis=0), size)
        picture = draw(mesh, stack[step], view)
        recent = (one.trace.time <= now) & (one.trace.time > now - 0.4)
        pushes = np.nan_to_num(one.trace.push_force_world[recent[: len(one.trace.push_force_world)]])
        if (strongest := np.linalg.norm(pushes, axis=1)).any():
            push = pushes[strongest.argmax()]
            tail, tip = view.project(np.stack([base[step] - 0.4 * push / np.linalg.norm(push), base[step]]))[0]
            along = (tip - tail) / np.linalg.norm(tip - tail)
            across = np.array([-along[1], along[0]])
            pen, end = ImageDraw.Draw(picture), tip - 16 * along
            pen.line([*tail, *end], RED, 6)
            pen.polygon([*tip, *(end + 9 * across), *(end - 9 * across)], RED)
        write_label(picture, label)
        yield picture


def leg_lines(robot: RobotDescription, swing: float, extension: float) -> list[np.ndarray]:
    """Return the links of a leg as lines (K, 2) [m] in its plane, x forward and z up from the hip; the foot is last."""
    legs, hip = robot.leg_geometry, np.zeros(2)
    if isinstance(legs, FiveBar):
        angles = legs.to_motors([[swing], [extension]])[0]
        first, second = legs.knees(angles)
        return [np.array([hip, first, legs.pin(angles)]), np.array([hip, second, legs.foot_in_plane(angles)])]
    foot = -extension * legs.length * np.array([np.sin(swing), np.cos(swing)])
    half, middle = 0.5 * legs.length, 0.5 * foot
    knee = middle + np.sqrt(half**2 - middle @ middle) * np.array([-np.cos(swing), np.sin(swing)])
    return [np.array([hip, knee, foot])]


def leg_space(path: Path) -> None:
    """Draw what swing and extension do to both kinds of legs."""
    with new_figure(path, (4.8, 3.6), 1, 2) as (_, axes):
        for axis, name, title, extensions in (
            (axes[0], "minitaur", "five-bar leg (Minitaur)", (1.4, 2.1)),
            (axes[1], "go2", "serial leg (Go2)", (0.65, 0.85)),
        ):
            robot = RobotDescription.load(name)
            short, long = extensions
            unit = "" if name == "go2" else " rad"
            for swing, extension, color in ((0.0, short, QUIET), (0.5, short, BLUE), (0.0, long, ORANGE)):
                lines = leg_lines(robot, swing, extension)
                label = f"swing {swing:g} rad, extension {extension:g}{unit}"
                for line in lines:
                    axis.plot(*line.T, color=color, linewidth=2.5, label=label if line is lines[-1] else None)
                axis.plot(*lines[-1][-1], "o", color=color, markersize=7)
            axis.plot(0, 0, "s", color=INK, markersize=8)
            axis.annotate("", (0.27, 0.08), (0.12, 0.08), arrowprops={"arrowstyle": "->", "color": INK})
            axis.text(0.12, 0.09, "forward")
            axis.set(title=title, aspect="equal", xlim=(-0.29, 0.29), ylim=(-0.4, 0.13), xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
            axis.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0))


def portrait(robot: RobotDescription, size: tuple[int, int]) -> Image.Image:
    """Return a robot in its resting pose with its name."""
    level = poses(robot, np.zeros(3), [1.0, 0.0, 0.0, 0.0], robot.resting_angles)
    mesh, stack = Mesh(robot.appearance(), list(level)), np.array([frames[0] for frames in level.values()])
    stack[:, 2, 3] -= mesh.place(stack)[0][:, 2].min()
    camera = Camera.for_robot(1.1 * extent(robot))
    picture = draw(mesh, stack, View(camera, (0.0, 0.0), size))
    write_label(picture, robot.name)
    return picture


def on_terrain(policy: str, terrain: str, size: tuple[int, int]) -> Image.Image:
    """Return a policy on a terrain, on its way forward."""
    controller, robot, task = load_policy(find_policy(policy), None)
    condition = Condition(terrain=terrain, duration=ON_IT, command_rows=((0.5, 0.0, 0.0),))
    task = condition.apply(task, robot)
    (trace,) = run_policy(controller, task, 1, "mujoco", seed=0, name=policy)
    placed = trace_poses(robot, trace)
    mesh, stack = Mesh(robot.appearance(), list(placed)), np.array([frames[-1] for frames in placed.values()])
    view = View(Camera.for_robot(1.2 * extent(robot)), placed[robot.base][-1, :2, 3], size, ground_of(trace))
    picture = draw(mesh, stack, view)
    write_label(picture, terrain)
    return picture


def moving(path: Path, size: tuple[int, int]) -> None:
    """Write an animation: a gallop beside a trot that is pushed."""
    gallop = motion("gallop", "gallop", size)
    trot = motion("trot-robust", f"robust trot, pushed with {PUSH:.0f} N", size, PUSH)
    first, *others = (sheet(list(pair), 2) for pair in zip(gallop, trot, strict=True))
    first.save(path, save_all=True, append_images=others, duration=1000 // FPS, loop=0, quality=55, method=6)


if __name__ == "__main__":
    sheet([on_terrain("go2-terrain", one, (480, 300)) for one in TERRAIN], 2).save(FOLDER / "terrain.png")
    sheet([on_terrain("go2-terrain-seeing", one, (480, 300)) for one in HOLES], 2).save(FOLDER / "terrain-seeing.png")
    moving(FOLDER / "gaits.webp", (400, 280))
    leg_space(FOLDER / "leg-space.png")
    sheet([*stride("gallop", (320, 240)), *stride("trot", (320, 240))], MOMENTS).save(FOLDER / "gaits.png")
    robots = [RobotDescription.load(name) for name in RobotDescription.available()]
    sheet([portrait(robot, (640, 360)) for robot in robots], 2).save(FOLDER / "robots.png")
    if sys.argv[1:]:
        imported = [RobotDescription.load(folder) for folder in sys.argv[1:]]
        sheet([portrait(robot, (480, 320)) for robot in imported], 3).save(FOLDER / "robots-imported.png")
