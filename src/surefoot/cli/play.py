"""`surefoot play`: watch a policy, in a window where there is a display, else as a video."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

from surefoot.cli.helpers.options import PAGE_PORT, PolicyName, check_suffix
from surefoot.cli.helpers.parsing import parse
from surefoot.cli.helpers.simulator import RunOptions
from surefoot.configuration import Duration
from surefoot.errors import SurefootError
from surefoot.task.commands import schedule_duration

_DURATION = 6.0
"""Least length of a run [s], if none is given."""


@dataclass(frozen=True)
class PlayCommand(RunOptions):
    """Run a policy once and show it: in MuJoCo's viewer where there is a display, else as an MP4.

    With --browser it runs on the page of `surefoot drive`, with this command's world, robot, parameters and commands.
    """

    policy: PolicyName
    duration: Duration | None = None
    """How long the robot runs, in simulated time; 6 s or, with --commands, its file to the end, if not given."""
    out: Path | None = None
    """MP4 to write, display or not; POLICY.mp4 here, if not given and there is no display."""
    browser: bool = False
    """Run it in real time on a page in the browser, until Ctrl-C."""


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(PlayCommand, argv, "surefoot play")
    check_suffix("video", command.out, ".mp4")
    from surefoot.api.episodes import film
    from surefoot.api.policies import find_policy, load_gait, run_policy
    from surefoot.cli.helpers.viewer import has_display, replay
    from surefoot.evaluation.conditions import with_duration
    from surefoot.world.registry import find_world

    path = find_policy(command.policy)
    find_world(command.world)
    if command.browser:
        return _serve_page(command)
    policy, robot, task, origin = load_gait(path, command.robot)
    task = command.apply(task, robot)
    # The video's camera stands beside a robot that heads along x.
    task = replace(task, terrain=replace(task.terrain, heading=0.0))
    duration = command.duration or max(_DURATION, schedule_duration(task.commands.schedule))
    task = with_duration(task, robot, duration)
    window = command.out is None and has_display()
    # Imported before anything is simulated, so that a missing package is reported at once.
    for module in ("mujoco",) if window else ("imageio_ffmpeg", "PIL"):
        import_module(module)
    (trace,) = run_policy(policy, task, 1, command.world, command.seed, name=origin["name"])
    ground = task.terrain.build(command.seed).ground
    if window:
        replay(robot, trace, ground)
    else:
        print(f"wrote {film(robot, trace, command.out or Path(f'{path.stem}.mp4'), ground)}")
    return 0


def _serve_page(command: PlayCommand) -> int:
    """Run the policy on the page of `surefoot drive`; return the exit code."""
    if command.out is not None:
        raise SurefootError("--browser and --out are given; a page makes no MP4")
    from surefoot.api.drive_page import DrivePage, serve

    adjust = replace(command, commands=None).apply
    drive = DrivePage(command.policy, command.world, command.robot, adjust, terrain=command.terrain)
    serve(drive, None, PAGE_PORT, None if command.commands is None else str(command.commands))
    return 0
