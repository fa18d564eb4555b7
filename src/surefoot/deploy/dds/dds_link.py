"""A link to a Go2 over DDS: the protocol of a board, spoken with the keeper process over a pair of sockets."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from surefoot.check_result import CheckResult
from surefoot.deploy.board.limits import Limits, make_handshake
from surefoot.deploy.clock import MonotonicClock
from surefoot.deploy.dds.bus import Bus
from surefoot.deploy.dds.inspection import Inspection
from surefoot.deploy.dds.low_level import MOTOR_NAMES, STATE_PERIOD
from surefoot.deploy.dds.motion_service import MotionService
from surefoot.deploy.dds.processes import Child, LinkConfig
from surefoot.deploy.dds.socket_port import SocketPort
from surefoot.deploy.robot_link import LinkLostError
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.serial_link import SerialLink
from surefoot.errors import SurefootError, choices
from surefoot.robot import RobotDescription

FIRST_TORQUE = 5.0
"""Largest torque [N m] that the first command after arming may request."""
FIRMWARE = "surefoot keeper"
_SUPERVISOR, _WATCHDOG = "surefoot.deploy.dds.keeper", "surefoot.deploy.dds.watcher"
_EXIT_TIMEOUT = 5.0
"""Time [s] for the keeper to damp the motors and end."""


def make_config(
    robot: RobotDescription,
    interface: str,
    domain: int,
    gains: tuple[ArrayLike, ArrayLike] | None = None,
    silence: float = 0.0,
) -> LinkConfig:
    """Return what the keeper needs of a robot.

    `gains` of its servos are in place of the data sheet's; the keeper waits for commands for `silence` [s] at least.

    Raises:
        SurefootError: a robot whose motors are not a Go2's.
    """
    if tuple(robot.motor_names) != MOTOR_NAMES or (robot.motor_sign != 1).any() or robot.actuator.kind != "joint":
        raise SurefootError(
            f"a link over DDS speaks with a Unitree Go2; {robot.name} must have its joint actuators, all signs +1, in "
            f"this order: {choices(MOTOR_NAMES)}"
        )
    limits = replace(Limits.from_robot(robot), duty=0.0, first_torque=FIRST_TORQUE)
    limits = replace(limits, command_timeout=max(limits.command_timeout, silence))
    handshake = make_handshake(robot, limits, FIRMWARE, STATE_PERIOD)
    if gains is not None:
        kp, kd = (np.broadcast_to(np.asarray(gain, float), len(MOTOR_NAMES)) for gain in gains)
        handshake = replace(handshake, servo_kp=kp, servo_kd=kd)
    return LinkConfig(handshake, limits, interface, domain)


def inspect(config: LinkConfig, robot: RobotDescription, release: Callable[[str], bool]) -> list[CheckResult]:
    """Return the results of an `Inspection` of the robot; see there."""
    bus = Bus(config.interface, config.domain)
    try:
        inspection = Inspection(bus, config.interface, config.domain)
        return inspection.inspect(robot, config.handshake.servo_kp, config.handshake.servo_kd, release)
    finally:
        bus.close()


def check_priority(processes: Sequence[int]) -> CheckResult:
    """Return whether processes have a real-time priority; without one, nothing is wrong on a computer that is idle."""
    name = "keeper's priority"
    if all(os.sched_getscheduler(process) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO for process in processes):
        return CheckResult(name, True, "real time, above the control loop's")
    message = "ordinary: beside other programs it holds the robot late, and damps it"
    return CheckResult(name, None, message, "allow real time: sudo setcap cap_sys_nice+ep on Python, or a limit rtprio")


class DdsLink(SerialLink):
    """A link to the keeper, which it starts, and which ends with it.

    Args:
        config: what the keeper must know.
        session: number of the operator's session; drawn, if not given.
        hand_back: select the robot's own controller at the end.
        checks: results of what was checked before.

    Raises:
        SurefootError: the keeper or the watcher does not start.
    """

    hears_others = True
    advice = "the keeper process does not answer: close other programs"

    def __init__(
        self,
        config: LinkConfig,
        session: int | None = None,
        hand_back: bool = False,
        checks: Sequence[CheckResult] = (),
    ) -> None:
        (here, host), (supervisor, watcher) = socket.socketpair(), socket.socketpair()
        self.children = [Child(_WATCHDOG, config, [watcher]), Child(_SUPERVISOR, config, [host, supervisor])]
        for end in (host, supervisor, watcher):
            end.close()
        super().__init__(SocketPort(here, "the keeper process"), Codec(len(MOTOR_NAMES)), MonotonicClock(), session)
        self.preliminary_checks = list(checks)
        self._config, self._hand_back = config, hand_back
        try:
            for child in self.children:
                child.await_ready()
            self.preliminary_checks.append(check_priority([child.pid for child in self.children]))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the session; return when the keeper has damped the motors and has ended.

        Raises:
            SurefootError: the robot's own controller should have been selected, and was not.
        """
        children, self.children = self.children, []
        with contextlib.suppress(LinkLostError):
            super().close()
        for child in children:
            child.finish(_EXIT_TIMEOUT)
        if self._hand_back and children:
            bus = Bus(self._config.interface, self._config.domain)
            try:
                MotionService(bus).hand_back()
            finally:
                bus.close()
