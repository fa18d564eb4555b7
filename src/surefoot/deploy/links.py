"""Factories of links to robots, over a serial port or DDS."""

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
    """Open a link to a robot at a serial port, pseudo-terminal or Unix socket.

    Args:
        port: path of the port.
        motors: number of motors of the robot.
        lockstep: whether the other end is an emulator that follows this computer's clock.
        baud: bit rate of a serial port [1/s].

    Raises:
        SurefootError: the port cannot be opened, or another program uses it.
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
    """Check a Go2 and open a link to it over DDS; the results are in the link's `preliminary_checks`.

    Args:
        robot: description of the robot.
        interface: name of the network interface that leads to the robot.
        domain: number of the DDS domain.
        gains: servo gains kp and kd [N m/rad, N m s/rad], for all motors or for each. Default to the data sheet's.
        silence: minimum time without a command after which the motors are damped [s], if over the data sheet's.
        release: called with the name of the robot's own controller if that is active; returns whether to make the robot
            lie down and to release its controller.
        hand_back: whether to select the robot's own controller when the link is closed.

    Raises:
        SurefootError: another robot, no cyclonedds, no such interface, no robot, or a robot that does not lie down.
    """
    from surefoot.deploy.dds.dds_link import DdsLink, inspect, make_config

    config = make_config(robot, interface, domain, gains, silence)
    checks = inspect(config, robot, release)
    return DdsLink(config, hand_back=hand_back, checks=checks)
