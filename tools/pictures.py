"""Draw the pictures of robots in the documentation: python tools/pictures.py [FOLDER ...].

They are docs/hero.webp (animation of four policies), docs/gaits.png (moments of a stride), docs/leg-space.png
(coordinates of a leg), docs/robots.png (released robots), docs/terrain.png and docs/terrain-seeing.png (policies on
terrain), and docs/robots-imported.png, from six folders of `surefoot robot new`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from gallery import SECONDS, recorded
from PIL import Image, ImageDraw

from surefoot.api.policies import find_policy, load_policy, run_policy
from surefoot.evaluation.conditions import Condition
from surefoot.evaluation.recorded import ground_for_trace
from surefoot.report.drawing.mesh import Mesh
from surefoot.report.drawing.renderer import Camera, View, draw
from surefoot.report.drawing.scene import extent, poses, trace_poses
from surefoot.report.drawing.video import write_label
from surefoot.report.figures.style import BLUE, INK, ORANGE, QUIET, new_figure
from surefoot.report.pages.recorded_runs import ShownTrace
from surefoot.robot import FiveBar, RobotDescription

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs"
MOMENTS = 5
GAP = 4
"""Space between pictures [px]."""
BETWEEN, FPS = (0.8, 4.8), 15
"""Start and end of the animation [s], and its frames per second."""
PUSH = 60.0
"""Force of pushes in the animation [N]."""
RED = (200, 40, 40)
FAINT = "#c3c8ce"
"""Color of a leg in its other pose."""
TERRAIN, HOLES = ("stairs:0.12", "slope:20", "rough:0.12", "blocks:0.10"), ("gaps:0.25", "stones:0.25")
"""Terrain in the pictures."""
TERRAIN_TIME = 4.0
"""Time of the pictures on terrain after the start [s]."""


def sheet(pictures: list[Image.Image], columns: int) -> Image.Image:
    """Return an image with pictures of the same size in rows."""
    width, height = pictures[0].size
    rows = -(-len(pictures) // columns)
    whole = Image.new("RGB", (columns * (width + GAP) - GAP, rows * (height + GAP) - GAP), "white")
    for k, picture in enumerate(pictures):
        whole.paste(picture, (k % columns * (width + GAP), k // columns * (height + GAP)))
    return whole


def stride(name: str, size: tuple[int, int]) -> list[Image.Image]:
    """Return pictures of a stride of a released policy, after three seconds."""
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


def moving(run: ShownTrace, label: str, size: tuple[int, int]) -> Iterator[Image.Image]:
    """Yield the frames of a run on its terrain, with an arrow for 0.4 s after each push."""
    placed = trace_poses(run.robot, run.trace)
    mesh, stack = Mesh(run.robot.appearance(), list(placed)), np.stack(list(placed.values()), axis=1)
    base, ground = placed[run.robot.base][:, :3, 3], ground_for_trace(run.trace)
    camera = Camera.for_robot(1.15 * extent(run.robot))
    for now in np.arange(*BETWEEN, 1 / FPS):
        step = int(np.searchsorted(run.trace.time, now))
        around = np.abs(run.trace.time - now) < 0.4
        view = View(camera, base[around, :2].mean(axis=0), size, ground)
        picture = draw(mesh, stack[step], view)
        recent = (run.trace.time <= now) & (run.trace.time > now - 0.4)
        pushes = np.nan_to_num(run.trace.push_force_world[recent[: len(run.trace.push_force_world)]])
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


def hero(path: Path, size: tuple[int, int]) -> None:
    """Write an animation of four policies."""
    shown = (
        (recorded("go2-steer"), "Go2: velocity commands"),
        (run_on_terrain("go2-terrain", "stairs:0.12"), "Go2: stairs of 12 cm, blind"),
        (run_on_terrain("go2-terrain-seeing", "stones:0.25"), "Go2: stepping stones of 25 cm"),
        (recorded("trot-robust", (PUSH, PUSH)), f"Minitaur: pushed with {PUSH:.0f} N"),
    )
    first, *others = (sheet(list(four), 2) for four in zip(*(moving(*one, size) for one in shown), strict=True))
    first.save(path, save_all=True, append_images=others, duration=1000 // FPS, loop=0, quality=50, method=6)


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


def mark_angle(axis: Axes, start: float, end: float, radius: float, color: str, label: str) -> None:
    """Draw an angle at the hip from a direction to another [rad], with its name outside."""
    turn = np.linspace(start, end, 30)
    axis.plot(radius * np.cos(turn), radius * np.sin(turn), color=color, linewidth=2)
    x, y = (radius + 0.015) * np.array([np.cos(turn[15]), np.sin(turn[15])])
    axis.text(x, y, label, color=color, ha="left" if x > 0.03 else "center", va="center" if x > 0.03 else "top")


def leg_space(path: Path) -> None:
    """Draw the definition of swing and extension for both kinds of legs."""
    with new_figure(path, (8.6, 4.2), 1, 2) as (_, axes):
        for axis, name, title, (swing, short, long), unit in (
            (axes[0], "minitaur", "Five-bar leg (Minitaur)", (0.45, 1.45, 2.1), " rad"),
            (axes[1], "go2", "Serial leg (Go2)", (0.45, 0.65, 0.85), ""),
        ):
            robot = RobotDescription.load(name)
            foot = leg_lines(robot, swing, long)[-1][-1]
            for angle, extension, color, width in ((0.0, short, FAINT, 2.0), (swing, long, INK, 3.0)):
                lines = leg_lines(robot, angle, extension)
                for line in lines:
                    axis.plot(*line.T, color=color, linewidth=width, solid_capstyle="round")
                    axis.plot(*line[1:-1].T, "o", color="white", markeredgecolor=color, markersize=6)
                axis.plot(*lines[-1][-1], "o", color=color, markersize=9)
            axis.plot([0, 0], [0, -0.36], color=QUIET, linewidth=1, linestyle=(0, (4, 4)))
            down = -0.5 * np.pi - swing
            mark_angle(axis, -0.5 * np.pi, down, 0.2, BLUE, "swing")
            if isinstance(robot.leg_geometry, FiveBar):
                ends = np.outer([-0.1, 0.24], [np.cos(down), np.sin(down)])
                axis.plot(*ends.T, color=ORANGE, linewidth=1, linestyle=(0, (4, 4)))
                knee = max((line[1] for line in leg_lines(robot, swing, long)), key=lambda point: point[0])
                mark_angle(axis, down + np.pi, np.arctan2(knee[1], knee[0]), 0.06, ORANGE, "extension")
            else:
                axis.annotate("", foot, (0, 0), arrowprops={"arrowstyle": "<->", "color": ORANGE, "linewidth": 2})
                axis.text(0.02, 0.86 * foot[1], "extension × leg length", color=ORANGE, va="center")
                axis.plot([0.01, 0.82 * foot[0]], 2 * [0.86 * foot[1]], color=ORANGE, linewidth=0.8)
            axis.plot(0, 0, "s", color=INK, markersize=9)
            axis.text(-0.015, 0.02, "hip", color=INK, ha="right")
            axis.text(foot[0] - 0.02, foot[1] - 0.005, "foot", color=INK, ha="right", va="top")
            axis.annotate("", (0.27, 0.1), (0.13, 0.1), arrowprops={"arrowstyle": "->", "color": QUIET})
            axis.text(0.13, 0.112, "forward", color=QUIET)
            note = f"dark: swing {swing:g} rad, extension {long:g}{unit}; light: swing 0, extension {short:g}{unit}"
            axis.set_title(title)
            axis.text(0, -0.41, note, color=QUIET, ha="center", va="top", fontsize=8)
            axis.set(aspect="equal", xlim=(-0.3, 0.3), ylim=(-0.43, 0.15), xticks=[], yticks=[])
            axis.spines[:].set_visible(False)


def portrait(robot: RobotDescription, size: tuple[int, int]) -> Image.Image:
    """Return a robot in its resting pose with its name."""
    level = poses(robot, np.zeros(3), [1.0, 0.0, 0.0, 0.0], robot.resting_angles)
    mesh, stack = Mesh(robot.appearance(), list(level)), np.array([frames[0] for frames in level.values()])
    stack[:, 2, 3] -= mesh.place(stack)[0][:, 2].min()
    camera = Camera.for_robot(1.1 * extent(robot))
    picture = draw(mesh, stack, View(camera, (0.0, 0.0), size))
    write_label(picture, robot.name)
    return picture


def run_on_terrain(policy: str, terrain: str, seconds: float = SECONDS) -> ShownTrace:
    """Return a run of a policy on a terrain, forward at 0.5 m/s."""
    controller, robot, task = load_policy(find_policy(policy), None)
    condition = Condition(terrain=terrain, duration=seconds, command_rows=((0.5, 0.0, 0.0),))
    (trace,) = run_policy(controller, condition.apply(task, robot), 1, "mujoco", seed=0, name=policy)
    return ShownTrace(policy, robot, trace)


def on_terrain(policy: str, terrain: str, size: tuple[int, int]) -> Image.Image:
    """Return a picture of a policy on a terrain, `TERRAIN_TIME` after its start."""
    run = run_on_terrain(policy, terrain, TERRAIN_TIME)
    placed = trace_poses(run.robot, run.trace)
    mesh, stack = Mesh(run.robot.appearance(), list(placed)), np.array([frames[-1] for frames in placed.values()])
    place = placed[run.robot.base][-1, :2, 3]
    picture = draw(
        mesh, stack, View(Camera.for_robot(1.2 * extent(run.robot)), place, size, ground_for_trace(run.trace))
    )
    write_label(picture, terrain)
    return picture


if __name__ == "__main__":
    sheet([on_terrain("go2-terrain", one, (480, 300)) for one in TERRAIN], 2).save(FOLDER / "terrain.png")
    sheet([on_terrain("go2-terrain-seeing", one, (480, 300)) for one in HOLES], 2).save(FOLDER / "terrain-seeing.png")
    hero(FOLDER / "hero.webp", (420, 260))
    leg_space(FOLDER / "leg-space.png")
    sheet([*stride("gallop", (320, 240)), *stride("trot", (320, 240))], MOMENTS).save(FOLDER / "gaits.png")
    robots = [RobotDescription.load(name) for name in RobotDescription.available()]
    sheet([portrait(robot, (640, 360)) for robot in robots], 2).save(FOLDER / "robots.png")
    if sys.argv[1:]:
        imported = [RobotDescription.load(folder) for folder in sys.argv[1:]]
        sheet([portrait(robot, (480, 320)) for robot in imported], 3).save(FOLDER / "robots-imported.png")
