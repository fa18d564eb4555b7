"""A link to a Go2 over DDS: the protocol of a board, spoken with the keeper process over a pair of sockets."""

from __future__ import annotations

import contextlib
import socket
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from surefoot.deploy.board.limits import Limits, make_handshake
from surefoot.deploy.clock import MonotonicClock
from surefoot.deploy.dds.low_level import MOTOR_NAMES, STATE_PERIOD
from surefoot.deploy.dds.processes import Child, LinkConfig
from surefoot.deploy.dds.socket_port import SocketPort
from surefoot.deploy.robot_link import LinkLostError
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.serial_link import SerialLink
from surefoot.errors import SurefootError, choices
from surefoot.robot import RobotDescription

LEAD = 0.002
"""Time [s] between a state's sending and the control step that uses it: sockets take a tenth of a millisecond, the rest
is for a keeper or a loop that wakes late."""
FIRST_TORQUE = 5.0
"""Largest torque [N m] that the first command after arming may request."""
FIRMWARE = "surefoot keeper"
_KEEPER, _WATCHER = "surefoot.deploy.dds.keeper", "surefoot.deploy.dds.watcher"
_ENDING = 5.0
"""Time [s] for the keeper to damp the motors and end."""


def make_config(
    robot: RobotDescription, interface: str, domain: int, gains: tuple[ArrayLike, ArrayLike] | None = None
) -> LinkConfig:
    """Return what the keeper needs of a robot; `gains` of its servos in place of the data sheet's.

    Raises:
        SurefootError: a robot whose motors are not a Go2's.
    """
    if tuple(robot.motor_names) != MOTOR_NAMES or (robot.motor_sign != 1).any() or robot.actuator.kind != "joint":
        raise SurefootError(
            f"a link over DDS speaks with a Unitree Go2; {robot.name} must have its joint actuators, all signs +1, in "
            f"this order: {choices(MOTOR_NAMES)}"
        )
    limits = replace(Limits.from_robot(robot), duty=0.0, first_torque=FIRST_TORQUE)
    handshake = make_handshake(robot, limits, FIRMWARE, STATE_PERIOD)
    if gains is not None:
        kp, kd = (np.broadcast_to(np.asarray(gain, float), len(MOTOR_NAMES)) for gain in gains)
        handshake = replace(handshake, servo_kp=kp, servo_kd=kd)
    return LinkConfig(handshake, limits, interface, domain)


class DdsLink(SerialLink):
    """A link to the keeper, which it starts, and which ends with it."""

    advice = "the keeper process does not answer: close other programs"

    def __init__(self, config: LinkConfig, session: int | None = None) -> None:
        (here, host), (keeper, watcher) = socket.socketpair(), socket.socketpair()
        self.children = [Child(_WATCHER, config, [watcher]), Child(_KEEPER, config, [host, keeper])]
        for end in (host, keeper, watcher):
            end.close()
        super().__init__(
            SocketPort(here, "the keeper process"), Codec(len(MOTOR_NAMES)), MonotonicClock(), session, LEAD
        )
        try:
            for child in self.children:
                child.await_ready()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the session; return when the keeper has damped the motors and has ended."""
        with contextlib.suppress(LinkLostError):
            super().close()
        for child in self.children:
            child.finish(_ENDING)
