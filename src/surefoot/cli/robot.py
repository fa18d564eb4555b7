"""`surefoot robot`: import a robot from a URDF or MJCF, check its description, and write its firmware."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.prompt import Prompt

from surefoot.cli.doctor import FAILED, print_result
from surefoot.cli.helpers.options import Json, check_folder
from surefoot.cli.helpers.output import Actions, make_console, next_command, print_json, run_action
from surefoot.cli.helpers.parsing import parse
from surefoot.errors import SurefootError, check_name
from surefoot.robot import RobotDescription
from surefoot.robot.appearance import VISUALS_FILE
from surefoot.robot.archive import DATA_SHEET
from surefoot.robot.importing.imported import KNEE_SIGNS, ImportedRobot, Knees
from surefoot.robot.importing.rules import describe_origins
from surefoot.robot.importing.writer import URDF, set_servo_step, write_robot

PICTURE = "robot.png"
"""Image in a robot's folder: the robot in its resting pose, with axes and names of legs."""


@dataclass(frozen=True)
class NewRobotCommand:
    """Import a quadruped from a URDF or MJCF, and write its folder: robot.urdf, robot.toml and an image.

    Base, legs, motors, knees and feet are derived from the tree of joints. Values that the file lacks are guessed; each
    guess is printed, and marked by a comment in robot.toml.
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """URDF or MJCF of a robot with four serial legs, each with two or three motors."""
    out: Path | None = None
    """Folder to write. Defaults to the robot's name in the current folder."""
    name: str | None = None
    """Name of the robot. Defaults to the file's name, or to the name in the file if that is generic, as robot.urdf."""
    forward: Literal["+x", "-x", "+y", "-y"] | None = None
    """Forward direction in the file's base frame. By default it is derived from names and axes of the joints."""
    knees: Knees | None = None
    """Direction in which the knees point. By default it is derived from the knees' limits or a pose in the file."""
    meshes: bool = True
    """Read meshes and colours. With --no-meshes the base is a box with its inertia, and links are primitives."""


@dataclass(frozen=True)
class CheckCommand:
    """Check a robot's description; print one line per check (pass, warn or FAIL) with the reason and the remedy.

    The origin of each number in the data sheet is printed first. Exit codes: 0: all checks passed, some possibly with a
    warning; 3: a check failed; 2: the description can't be read.
    """

    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")]
    """Name of a released robot, or the folder of a robot."""
    json: Json = False


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    return run_action(argv, "robot", ACTIONS)


def _new(argv: list[str]) -> int:
    command = parse(NewRobotCommand, argv, "surefoot robot new")
    from surefoot.report.drawing.robot_picture import save_robot_picture
    from surefoot.robot.importing.isolated_reader import read_robot
    from surefoot.world.physics_step import longest_servo_step

    imported = read_robot(command.file, command.forward, command.meshes)
    name = command.name or imported.name
    check_name("name", name)
    folder = command.out or Path(name)
    check_folder(folder)
    print(
        f"{name}: {imported.mass:.2f} kg, {imported.torque.size} motors, legs of {imported.length:.3f} m, "
        f"forward is {imported.forward} of the file"
    )
    knees = command.knees or find_knees(imported)
    with _whole_or_nothing(folder, (DATA_SHEET, URDF, VISUALS_FILE, PICTURE)):
        guesses = write_robot(imported, folder, name, knees)
        robot = RobotDescription.load(folder)
        if (step := longest_servo_step(robot)) < robot.timing.servo_step:
            guesses = [line for line in guesses if not line.startswith("servo_step")] + [set_servo_step(folder, step)]
            robot = RobotDescription.load(folder)
        for line in guesses:
            print(f"guessed  {line}")
        for guessed, line in describe_origins(robot):
            if not guessed:
                print(f"stated   {line}")
        save_robot_picture(robot, folder / PICTURE)
        print(f"wrote {folder}: robot.toml, robot.urdf, {PICTURE}")
        code = _run_checks(robot)
    if code == 0:
        print(next_command("train it", "train", "trot", "--robot", folder))
    return code


@contextmanager
def _whole_or_nothing(folder: Path, names: Sequence[str]) -> Iterator[None]:
    """Remove the files of a robot's folder that were written inside, and the folder, if an error occurs.

    A folder that `robot check` can't read would be useless.
    """
    if (folder / DATA_SHEET).exists():  # a robot that was there before
        yield
        return
    was_there = folder.exists()
    before = {name for name in names if (folder / name).exists()}
    try:
        yield
    except Exception as error:  # after Ctrl-C the files remain
        for name in set(names) - before:
            with suppress(OSError):
                (folder / name).unlink(missing_ok=True)
        if not was_there:
            with suppress(OSError):
                folder.rmdir()
        if isinstance(error, SurefootError):
            raise SurefootError(f"{error}; {folder} was not written") from error
        raise


def find_knees(robot: ImportedRobot) -> Knees | None:
    """Print the direction of the knees and the evidence for it; if it is uncertain, ask on a terminal."""
    knees, reason, uncertain = robot.guess_knees()
    if uncertain and sys.stdin.isatty():
        answer = Prompt.ask(f"Where do the knees point? {reason}", choices=list(KNEE_SIGNS), default=knees)
        return answer  # type: ignore[return-value]
    if uncertain:
        others = "|".join(other for other in KNEE_SIGNS if other != knees)
        print(f"guessed  knees: {knees}; {reason}; --knees {others} changes it")
    else:
        print(f"knees point {knees}, according to {reason}")
    return None


def _check(argv: list[str]) -> int:
    command = parse(CheckCommand, argv, "surefoot robot check")
    robot = RobotDescription.load(command.robot)
    if not command.json:
        for guessed, line in describe_origins(robot):
            print(f"{'guessed' if guessed else 'stated':<8} {line}")
    return _run_checks(robot, command.json)


def _run_checks(robot: RobotDescription, as_json: bool = False) -> int:
    from surefoot.evaluation.trot_check import check_trot
    from surefoot.world.description_checks import run_description_checks

    console, results = make_console(), []
    for result in chain(run_description_checks(robot), check_trot(robot)):
        results.append(result)
        if not as_json:
            print_result(console, result)
    failed = sum(result.passed is False for result in results)
    if as_json:
        checks = [asdict(item) for item in results]
        numbers = [{"guessed": guessed, "origin": line} for guessed, line in describe_origins(robot)]
        print_json({"robot": robot.name, "passed": not failed, "checks": checks, "numbers": numbers})
    else:
        warned = sum(result.warn for result in results)
        counts = f"{len(results) - failed - warned} passed, " + (f"{warned} passed with a warning, " if warned else "")
        print(f"{counts}{failed} failed")
    return FAILED if failed else 0


ACTIONS: Actions = {
    "new": ("import a robot from a URDF or MJCF, and write its folder", _new),
    "check": ("check a robot's description", _check),
    "firmware": ("write the firmware of its microcontroller, and try a motor", "surefoot.cli.robot_firmware"),
}
