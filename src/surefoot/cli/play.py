"""`surefoot play`: watch a policy, in a window where there is a display, else as a video."""

from __future__ import annotations

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
    from surefoot.cli.helpers.episodes import film
    from surefoot.cli.helpers.policies import adjust_task, find_policy, lasting, load_gait, run_policy
    from surefoot.cli.helpers.viewer import has_display, replay
    from surefoot.world.registry import find_world

    path = find_policy(command.policy)
    find_world(command.world)
    if command.browser:
        return _serve_page(command)
    policy, robot, task, known = load_gait(path, command.robot)
    given = (task, robot, command.settings, command.pushes)
    task = adjust_task(*given, simulator=command.simulator, push_force=command.push_force, commands=command.commands)
    task = lasting(task, robot, command.seconds)
    window = command.out is None and has_display()
    # Imported before anything is simulated, so that a missing package is reported at once.
    for module in ("mujoco",) if window else ("imageio_ffmpeg", "PIL"):
        import_module(module)
    (trace,) = run_policy(policy, task, 1, command.world, command.seed, name=known["name"])
    if window:
        replay(robot, trace)
    else:
        print(f"wrote {film(robot, trace, command.out or Path(f'{path.stem}.mp4'))}")
    return 0


def _serve_page(command: PlayCommand) -> int:
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
