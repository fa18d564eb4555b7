"""`surefoot robot firmware`: write a robot's firmware as a folder of C, and try the first motion of a motor."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surefoot.check_result import first_failure
from surefoot.cli.doctor import FAILED, print_result
from surefoot.cli.helpers.link_options import SerialOptions
from surefoot.cli.helpers.options import PLACES, Port, Yes, ask_to_move, check_terminal
from surefoot.cli.helpers.output import Actions, make_console, next_command, run_action
from surefoot.cli.helpers.parsing import parse
from surefoot.configuration import Within
from surefoot.deploy.checks import check_handshake
from surefoot.deploy.doctor.duty_check import MAX_DUTY, try_duty
from surefoot.deploy.robot_link import LinkLostError
from surefoot.errors import SurefootError, choices
from surefoot.robot import DEFAULT_ROBOT, RobotDescription
from surefoot.stop_signals import StopSignals


@dataclass(frozen=True)
class NewFirmwareCommand:
    """Write the firmware of a robot's microcontroller in portable C11, with motors, gains and limits of the data sheet.

    All access to the hardware is behind one header, core/hal.h. `make` in the folder compiles it for this computer.
    """

    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ROBOT")]
    """Name of a released robot, or the folder of a robot."""
    out: Path | None = None
    """Folder to write. Defaults to ROBOT-firmware in the current folder."""


@dataclass(frozen=True, kw_only=True)
class MotorCommand(SerialOptions):
    """Turn one motor by a small duty for a moment, without the servo, to check its sign; the robot must hang freely.

    A positive duty must increase the measured angle. Exit codes: 0: it does; 3: it does not.
    """

    motor: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="MOTOR")]
    """Name of the motor, as in the robot's data sheet."""
    port: Port
    robot: str = DEFAULT_ROBOT
    """Name of a released robot, or the folder of a robot."""
    duty: Annotated[float, Within(-MAX_DUTY, MAX_DUTY)] = 0.05
    """Duty, -1 to 1. For joint actuators it is the fraction of the maximum torque."""
    duration: Annotated[float, Within(0, 2, exclusive=True)] = 0.3
    """Time after which the duty ends [s]; it also ends after 0.3 rad."""
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
    print(f"wrote {folder}: the firmware of {robot.name}, {robot.num_motors} motors; start with its README.md")
    print(f"to compile it for this computer: make -C {folder.absolute()}")
    print(next_command("emulate a robot with it", "emulate", "--robot", command.robot, "--firmware", folder / "board"))
    return 0


def _motor(argv: list[str]) -> int:
    command = parse(MotorCommand, argv, "surefoot robot firmware motor")
    robot = RobotDescription.load(command.robot)
    if command.motor not in robot.motor_names:
        raise SurefootError(f"'{command.motor}' is no motor of {robot.name}; it has {choices(robot.motor_names)}")
    if not command.yes:
        place = PLACES[True]
        check_terminal(place)
        ask_to_move(place)
    link = command.open_port(command.port, robot.num_motors)
    try:
        with StopSignals() as operator:
            handshake = link.connect()
            # Signs and servo period may be wrong: this command is for the time before the servo works.
            needed = [result for result in check_handshake(handshake, robot) if result.name in ("robot", "motors")]
            if (error := first_failure(needed)) is not None:
                raise SurefootError(f"no motor is turned: {error}")
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
    "new": ("write the firmware of a robot as a folder of C sources", _new),
    "motor": ("turn one motor a little, without the servo, to check its sign", _motor),
}
