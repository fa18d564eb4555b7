"""`surefoot play`: watch a policy, in a window where there is a display, else as a video."""

from __future__ import annotations

import os
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from surefoot.cli.helpers.options import PAGE_PORT, PolicyName, check_suffix
from surefoot.cli.helpers.parsing import parse
from surefoot.cli.helpers.simulator import RunOptions
from surefoot.configuration import Duration
from surefoot.errors import SurefootError

if TYPE_CHECKING:
    from surefoot.robot import RobotDescription
    from surefoot.task.config import TaskConfig
    from surefoot.task.trace import EpisodeTrace


@dataclass(frozen=True)
class PlayCommand(RunOptions):
    """Run a policy once and show it: in MuJoCo's viewer where there is a display, else as an MP4.

    With --browser it runs on the page of `surefoot drive`, with this command's world, robot, parameters and commands.
    """

    policy: PolicyName
    seconds: Duration = 6.0
    """How long the robot runs, in simulated time."""
    out: Path | None = None
    """MP4 to write, display or not; POLICY.mp4 here, if not given and there is no display."""
    browser: bool = False
    """Run it in real time on a page in the browser, until Ctrl-C."""


def main(argv: list[str]) -> int:
    """Run the command with the words after its name; return the exit code."""
    command = parse(PlayCommand, argv, "surefoot play")
    check_suffix("video", command.out, ".mp4")
    from surefoot.cli.helpers.policies import adjust_task, find_policy, lasting, load_gait, run_policy
    from surefoot.world.registry import find_world

    path = find_policy(command.policy)
    find_world(command.world)
    if command.browser:
        return _on_a_page(command)
    policy, robot, task, known = load_gait(path, command.robot)
    given = (task, robot, command.settings, command.pushes)
    task = adjust_task(*given, simulator=command.simulator, push_force=command.push_force, commands=command.commands)
    task = lasting(task, robot, command.seconds)
    window = command.out is None and has_display()
    # Imported before anything is simulated: what is not installed is told at once.
    for module in ("mujoco",) if window else ("imageio_ffmpeg", "PIL"):
        import_module(module)
    (trace,) = run_policy(policy, task, 1, command.world, command.seed, name=known["name"])
    if window:
        from surefoot.cli.helpers.viewer import replay

        replay(robot, trace)
    else:
        print(film(robot, trace, command.out or Path(f"{path.stem}.mp4")))
    return 0


def _on_a_page(command: PlayCommand) -> int:
    """Run the policy on the page of `surefoot drive`; return the exit code."""
    if command.out is not None:
        raise SurefootError("--browser and --out are given; a page makes no MP4")
    from surefoot.cli.helpers.drive_page import DrivePage, serve
    from surefoot.cli.helpers.policies import adjust_task

    def adjust(task: TaskConfig, robot: RobotDescription) -> TaskConfig:
        return adjust_task(task, robot, command.settings, False, simulator=command.simulator)

    drive = DrivePage(command.policy, command.world, command.robot, adjust)
    serve(drive, None, PAGE_PORT, None if command.commands is None else str(command.commands))
    return 0


def film(robot: RobotDescription, trace: EpisodeTrace, path: Path) -> Path:
    """Write a video (.mp4) of a trace; return its path."""
    from surefoot.report.drawing.renderer import Camera
    from surefoot.report.drawing.scene import extent, scene, trace_poses
    from surefoot.report.drawing.video import render_video

    shapes, poses = scene(robot), trace_poses(robot, trace)
    camera = Camera.for_robot(extent(robot))
    return render_video(shapes, poses, trace.time, path, overlay=_captions(trace), follow=robot.base, camera=camera)


def has_display() -> bool:
    """Return whether a window can be opened here."""
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _captions(trace: EpisodeTrace) -> list[str]:
    """Return a text for each control step of a trace: policy, world, and speed over the last half second."""
    half = max(round(0.5 / trace.meta["control_step"]), 1)
    lines = []
    for step, time in enumerate(trace.time):
        start = max(step + 1 - half, 0)
        moved = trace.base_position_world[step + 1, 0] - trace.base_position_world[start, 0]
        since = time - (trace.time[start - 1] if start else 0.0)
        lines.append(f"{trace.meta['policy']} in {trace.meta['world']}\n{time:4.1f} s   {moved / since:5.2f} m/s")
    return lines
