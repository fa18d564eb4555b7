"""The one place that makes links to robots."""

from __future__ import annotations

from surefoot.deploy.clock import LockstepClock, MonotonicClock
from surefoot.deploy.robot_link import RobotLink
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.port import BAUD, SerialPort
from surefoot.deploy.serial.serial_link import SerialLink


def open_link(port: str, motors: int, lockstep: bool = False, baud: int = BAUD) -> RobotLink:
    """Open a link to a robot with so many motors at a serial port or pseudo-terminal.

    In lockstep, the other end is an emulator that follows this computer's clock.

    Raises:
        SurefootError: a port that can't be opened, or that another program has.
    """
    return SerialLink(SerialPort(port, baud), Codec(motors), LockstepClock() if lockstep else MonotonicClock())
