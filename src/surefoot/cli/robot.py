"""`surefoot robot`: from a URDF or MJCF to a robot to train, checks of its description, and its firmware."""

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
from surefoot.robot.archive import SHEET
from surefoot.robot.importing.imported import KNEE_SIGNS, ImportedRobot, Knees
from surefoot.robot.importing.rules import describe_origins
from surefoot.robot.importing.writer import URDF, set_servo_step, write_robot

PICTURE = "robot.png"
"""File of a robot's folder: the robot in its resting pose, axes and legs named."""


@dataclass(frozen=True)
class NewRobotCommand:
    """Read a quadruped from a URDF or MJCF, and write its folder: robot.urdf, robot.toml and a picture.

    Base, legs, motors, knees and feet are derived from the tree of joints. What the file lacks is guessed; every
    guess is printed, and stands as a comment in robot.toml.
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """URDF or MJCF of a robot with four serial legs of two or three motors."""
    out: Path | None = None
    """Folder to write; the robot's name here, if not given."""
    name: str | None = None
    """Name of the robot; the file's, if not given."""
    forward: Literal["+x", "-x", "+y", "-y"] | None = None
    """Direction in the file's frame that is forward; by the names and axes of the joints, if not given."""
    knees: Knees | None = None
    """Where knees point; by the knees' limits or a pose of the file, if not given."""
    meshes: bool = True
    """Read meshes and colours; without them the base is a box with its inertia, and drawn are primitive shapes."""


@dataclass(frozen=True)
class CheckCommand:
    """Check a robot's description, one line a check: pass, warn or FAIL, why, and what to do.

    First it prints where each number of the data sheet comes from. Exit code 0: all passed, some perhaps with a
    warning; 3: something failed; 2: the description can't be read.
    """

    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")]
    """Name of a robot that ships, or the path of a robot's folder."""
    json: Json = False


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    return run_action(argv, "robot", ACTIONS)


def _new(argv: list[str]) -> int:
    command = parse(NewRobotCommand, argv, "surefoot robot new")
    from surefoot.report.drawing.robot_picture import save_robot_picture
    from surefoot.robot.importing.isolated_reader import read_robot
    from surefoot.world.description_checks import longest_servo_step

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
    with _whole_or_nothing(folder, (SHEET, URDF, VISUALS_FILE, PICTURE)):
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
    """Remove files of a robot's folder that are made inside, and the folder, where something fails.

    A folder that `robot check` can't read is of no use to anybody.
    """
    if (folder / SHEET).exists():  # a robot that was there before
        yield
        return
    was_there = folder.exists()
    before = {name for name in names if (folder / name).exists()}
    try:
        yield
    except Exception as error:  # after Ctrl-C what is there can be read
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
    """Print where knees point and what shows it; ask, if nothing shows it and there is somebody to ask."""
    knees, reason, uncertain = robot.guess_knees()
    if uncertain and sys.stdin.isatty():
        answer = Prompt.ask(f"Where do the knees point? {reason}", choices=list(KNEE_SIGNS), default=knees)
        return answer  # type: ignore[return-value]
    if uncertain:
        others = "|".join(other for other in KNEE_SIGNS if other != knees)
        print(f"guessed  knees: {knees}; {reason}; --knees {others} changes it")
    else:
        print(f"knees point {knees}, by {reason}")
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
    "new": ("read a robot from a URDF or MJCF, and write its folder", _new),
    "check": ("check a robot's description", _check),
    "firmware": ("write the firmware of its microcontroller, and turn a motor", "surefoot.cli.robot_firmware"),
}
