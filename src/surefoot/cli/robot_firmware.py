"""`surefoot robot firmware`: a robot's firmware as a folder of C, and the first motion of a motor."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surefoot.cli.doctor import FAILED, print_result
from surefoot.cli.helpers.link_options import SerialOptions
from surefoot.cli.helpers.options import Port, Yes, ask_to_move, check_terminal
from surefoot.cli.helpers.output import Actions, make_console, next_command, run_action
from surefoot.cli.helpers.parsing import parse
from surefoot.configuration import Within
from surefoot.deploy.doctor.duty_check import MAX_DUTY, try_duty
from surefoot.deploy.robot_link import LinkLostError
from surefoot.errors import SurefootError, choices
from surefoot.robot import DEFAULT_ROBOT, RobotDescription
from surefoot.stop_signals import StopSignals


@dataclass(frozen=True)
class NewFirmwareCommand:
    """Write the firmware of a robot's microcontroller: portable C11, with motors, gains and limits of its data sheet.

    What touches a board is behind one header, core/hal.h. `make` in the folder compiles the firmware for this computer.
    """

    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ROBOT")]
    """Name of a robot that ships, or the path of a robot's folder."""
    out: Path | None = None
    """Folder to write; ROBOT-firmware here, if not given."""


@dataclass(frozen=True, kw_only=True)
class MotorCommand(SerialOptions):
    """Give one motor of a robot that hangs free a small duty for a moment, without a servo: does it turn the right way?

    A positive duty must increase the angle that is read. Exit code 0: it did; 3: it did not.
    """

    motor: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="MOTOR")]
    """Name of the motor, as in the robot's data sheet."""
    port: Port
    robot: str = DEFAULT_ROBOT
    """Name or folder of the robot."""
    duty: Annotated[float, Within(-MAX_DUTY, MAX_DUTY)] = 0.05
    """Of a joint actuator a share of its greatest torque."""
    duration: Annotated[float, Within(0, 2, exclusive=True)] = 0.3
    """Time [s] after which it has no duty any more; it has none beyond .3 rad either."""
    yes: Yes = False


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    return run_action(argv, "robot firmware", ACTIONS)


def _new(argv: list[str]) -> int:
    command = parse(NewFirmwareCommand, argv, "surefoot robot firmware new")
    from surefoot.firmware.project import write_sources

    robot = RobotDescription.load(command.robot)
    folder = command.out or Path(f"{robot.name}-firmware")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise SurefootError(f"out {folder} exists; give another name")
    write_sources(folder, robot, word=command.robot)
    print(f"wrote {folder}: the firmware of {robot.name}, {robot.num_motors} motors; begin with its README.md")
    print(f"to compile it for this computer: make -C {folder.absolute()}")
    print(next_command("emulate a robot with it", "emulate", "--robot", command.robot, "--firmware", folder / "board"))
    return 0


def _motor(argv: list[str]) -> int:
    command = parse(MotorCommand, argv, "surefoot robot firmware motor")
    robot = RobotDescription.load(command.robot)
    if command.motor not in robot.motor_names:
        raise SurefootError(f"'{command.motor}' is no motor of {robot.name}; it has {choices(robot.motor_names)}")
    if not command.yes:
        place = "hang free, its legs in the air"
        check_terminal(place)
        ask_to_move(place)
    link = command.open_port(command.port, robot.num_motors)
    try:
        with StopSignals() as operator:
            link.connect()
            link.wait_for(lambda: link.state is not None, 1.0)
            number = robot.motor_names.index(command.motor)
            result = try_duty(link, robot, number, command.duty, command.duration, operator)
    except LinkLostError as error:
        raise SurefootError(str(error)) from None
    finally:
        with contextlib.suppress(LinkLostError, OSError):
            link.close()
    print_result(make_console(), result)
    return 0 if result.passed else FAILED


ACTIONS: Actions = {
    "new": ("write the firmware of a robot as a folder of C", _new),
    "motor": ("turn one motor a little, without a servo", _motor),
}
