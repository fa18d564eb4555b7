"""The one place that makes links to robots."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from numpy.typing import ArrayLike

from surefoot.deploy.clock import LockstepClock, MonotonicClock
from surefoot.deploy.dds.socket_port import connect
from surefoot.deploy.robot_link import RobotLink
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.port import BAUD, SerialPort
from surefoot.deploy.serial.serial_link import SerialLink
from surefoot.robot import RobotDescription


def open_link(port: str, motors: int, lockstep: bool = False, baud: int = BAUD) -> RobotLink:
    """Open a link to a robot with so many motors at a serial port, pseudo-terminal or Unix socket.

    In lockstep, the other end is an emulator that follows this computer's clock.

    Raises:
        SurefootError: a port that can't be opened, or that another program has.
    """
    line = connect(port) if Path(port).is_socket() else SerialPort(port, baud)
    return SerialLink(line, Codec(motors), LockstepClock() if lockstep else MonotonicClock())


def open_dds_link(
    robot: RobotDescription,
    interface: str,
    domain: int = 0,
    gains: tuple[ArrayLike, ArrayLike] | None = None,
    silence: float = 0.0,
    release: Callable[[str], bool] = lambda name: False,
    hand_back: bool = False,
) -> RobotLink:
    """Observe a Go2 and open a link to it over DDS; results of what was checked are in its `preliminary_checks`.

    Args:
        robot: its description.
        interface: name of the network interface that leads to it.
        domain: number of the DDS domain.
        gains: kp and kd of all motors, or of each [N m/rad, N m s/rad]; the data sheet's, if not given.
        silence: least time [s] without a command after which the motors are damped; the data sheet's, if that is more.
        release: gets the name of the robot's own controller, if it is active, and returns whether the robot is to lie
            down and its controller to be released.
        hand_back: select the robot's own controller when the link is closed.

    Raises:
        SurefootError: another robot, no cyclonedds, no such interface, no robot, or one that does not lie down.
    """
    from surefoot.deploy.dds.dds_link import DdsLink, inspect, make_config

    config = make_config(robot, interface, domain, gains, silence)
    checks = inspect(config, robot, release)
    return DdsLink(config, hand_back=hand_back, checks=checks)
