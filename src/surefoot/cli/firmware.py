"""`surefoot firmware new ROBOT`: the firmware of a robot's microcontroller as a folder of C."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surefoot.cli.helpers.output import next_command, run_action
from surefoot.cli.helpers.parsing import parse
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription


@dataclass(frozen=True)
class NewCommand:
    """Write the firmware of a robot's microcontroller: portable C11, with motors, gains and limits of its data sheet.

    What touches a board is behind one header, core/hal.h. `make` in the folder compiles the firmware for this computer.
    """

    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ROBOT")]
    """Name of a robot that ships, or the path of a robot's folder."""
    out: Path | None = None
    """Folder to write; ROBOT-firmware here, if not given."""


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    return run_action(argv, "firmware", ACTIONS)


def _new(argv: list[str]) -> int:
    command = parse(NewCommand, argv, "surefoot firmware new")
    from surefoot.firmware.project import write_sources

    robot = RobotDescription.load(command.robot)
    folder = command.out or Path(f"{robot.name}-firmware")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise SurefootError(f"out {folder} exists; give another name")
    write_sources(folder, robot)
    print(f"wrote {folder}: the firmware of {robot.name}, {robot.num_motors} motors; its numbers are in core/robot.h")
    print(f"to compile it for this computer: make -C {folder.absolute()}")
    print(next_command("emulate a robot with it", "emulate", "--robot", command.robot, "--firmware", folder / "board"))
    return 0


ACTIONS = {"new": ("write the firmware of a robot as a folder of C", _new)}
