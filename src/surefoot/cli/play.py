"""`surefoot play`: watch a policy, in a window where there is a display, else as a video."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from surefoot.cli.evaluate import Settings
from surefoot.cli.parsing import parse
from surefoot.cli.simulator import Simulator, SimulatorOptions
from surefoot.configuration import Duration, Seed
from surefoot.errors import SurefootError

if TYPE_CHECKING:
    from surefoot.task.trace import EpisodeTrace


@dataclass(frozen=True)
class PlayCommand:
    """Run a policy once and show it: in MuJoCo's viewer where there is a display, else as an MP4."""

    policy: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY")]
    """Path of a policy file (.onnx), or the name of a policy that ships with surefoot."""
    seconds: Duration = 6.0
    """How long the robot runs, in simulated time."""
    out: Path | None = None
    """MP4 to write, display or not; POLICY.mp4 here, if not given and there is no display."""
    pushes: bool = False
    """Push the robot at random, as its task says how; without this nothing pushes."""
    settings: Settings = ()
    """Physical parameters that differ from the task's, such as motor_strength=0.8."""
    seed: Seed = 1
    """The one seed."""
    world: str = "mujoco"
    """Where to run: mujoco or bullet."""
    simulator: SimulatorOptions = Simulator()
    """Another simulator than the policy's own."""
    robot: str | None = None
    """Name or folder of the robot; the one of the policy's task, if not given."""


def main(argv: list[str]) -> int:
    """Run the command with the words after its name; return the exit code."""
    command = parse(PlayCommand, argv, "surefoot play")
    if command.out is not None and command.out.suffix.lower() != ".mp4":
        raise SurefootError(f"video {command.out}: the name must end in .mp4")
    from surefoot.cli.policies import adjust_task, find_policy, find_world, load_policy

    path = find_policy(command.policy)
    make_world = find_world(command.world)
    policy, robot, task = load_policy(path, command.robot)
    task = adjust_task(task, robot, command.settings, command.pushes, simulator=command.simulator)
    control_step = float(task.nominal(robot).control_step[0])
    task = replace(task, max_steps=max(round(command.seconds / control_step), 1))
    window = command.out is None and has_display()
    # Imported before anything is simulated: what is not installed is told at once.
    from surefoot.cli.progress import progress_bar
    from surefoot.evaluate.rollout import run_episodes
    from surefoot.report.scene import scene, trace_poses

    if window:
        from surefoot.cli.viewer import replay
    else:
        import imageio_ffmpeg  # noqa: F401

        from surefoot.report.video import render_video
    name = policy.contract.name
    with progress_bar(name) as progress:
        (trace,) = run_episodes(
            policy, task, 1, make_world, command.seed, 0, progress, world_name=command.world, policy_name=name
        )
    shapes, poses = scene(robot), trace_poses(robot, trace)
    if window:
        replay(shapes, poses, trace.time, robot.base)
        return 0
    out = command.out or Path(f"{path.stem}.mp4")
    print(render_video(shapes, poses, trace.time, out, overlay=captions(trace), follow=robot.base))
    return 0


def has_display() -> bool:
    """Return whether a window can be opened here."""
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def captions(trace: EpisodeTrace) -> list[str]:
    """Return a text for each control step of a trace: policy, world, and speed over the last half second."""
    half = max(round(0.5 / trace.meta["control_step"]), 1)
    lines = []
    for step, time in enumerate(trace.time):
        start = max(step + 1 - half, 0)
        moved = trace.base_position_world[step + 1, 0] - trace.base_position_world[start, 0]
        since = time - (trace.time[start - 1] if start else 0.0)
        lines.append(f"{trace.meta['policy']} in {trace.meta['world']}\n{time:4.1f} s   {moved / since:5.2f} m/s")
    return lines
