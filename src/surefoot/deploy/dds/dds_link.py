"""Link to a Go2 over DDS: the wire protocol of a board, spoken with the supervisor process through a socket pair."""

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
from surefoot.deploy.messages import Mode
from surefoot.deploy.robot_link import LinkLostError
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.serial_link import SerialLink
from surefoot.errors import SurefootError, choices
from surefoot.robot import RobotDescription

FIRST_TORQUE = 5.0
"""Maximum torque that the first command after arming may request [N m]."""
FIRMWARE = "surefoot supervisor"
CODEC = Codec(len(MOTOR_NAMES), accelerometer=True)
"""Encodes the messages between control loop and supervisor."""
_SUPERVISOR, _WATCHDOG = "surefoot.deploy.dds.supervisor", "surefoot.deploy.dds.watchdog"
_EXIT_TIMEOUT = 5.0
"""Time for the supervisor to damp the motors and exit [s]."""


def make_config(
    robot: RobotDescription,
    interface: str,
    domain: int,
    gains: tuple[ArrayLike, ArrayLike] | None = None,
    silence: float = 0.0,
) -> LinkConfig:
    """Return the configuration of the supervisor for a robot.

    Args:
        robot: its description.
        interface: network interface that leads to the robot.
        domain: DDS domain.
        gains: servo gains kp and kd [N m/rad, N m s/rad], for all motors or for each. Default to the data sheet's.
        silence: minimum time without a command after which the motors are damped [s], if over the data sheet's.

    Raises:
        SurefootError: the motors are not a Go2's.
    """
    if tuple(robot.motor_names) != MOTOR_NAMES or (robot.motor_sign != 1).any() or robot.actuator.kind != "joint":
        raise SurefootError(
            f"a DDS link needs a Unitree Go2; {robot.name} must have joint actuators, all with sign +1, in this order: "
            f"{choices(MOTOR_NAMES)}"
        )
    limits = replace(Limits.from_robot(robot), duty=0.0, first_torque=FIRST_TORQUE)
    limits = replace(limits, command_timeout=max(limits.command_timeout, silence))
    handshake = make_handshake(robot, limits, FIRMWARE, STATE_PERIOD)
    if gains is not None:
        kp, kd = (np.broadcast_to(np.asarray(gain, float), len(MOTOR_NAMES)) for gain in gains)
        handshake = replace(handshake, servo_kp=kp, servo_kd=kd)
    return LinkConfig(handshake, limits, interface, domain)


def inspect(config: LinkConfig, robot: RobotDescription, release: Callable[[str], bool]) -> list[CheckResult]:
    """Check a Go2 before it is armed; return the results of `Inspection.inspect`."""
    bus = Bus(config.interface, config.domain)
    try:
        inspection = Inspection(bus, config.interface, config.domain)
        return inspection.inspect(robot, config.handshake.servo_kp, config.handshake.servo_kd, release)
    finally:
        bus.close()


def check_priority(processes: Sequence[int]) -> CheckResult:
    """Check whether processes have real-time priority. Without it the result is a warning: an idle computer is fine."""
    name = "supervisor priority"
    if all(os.sched_getscheduler(process) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO for process in processes):
        return CheckResult(name, True, "real time, above the control loop's")
    message = "ordinary: if other programs are busy, the supervisor may be late, and then damps the motors"
    return CheckResult(
        name, None, message, "allow real-time priority: sudo setcap cap_sys_nice+ep on Python, or an rtprio limit"
    )


class DdsLink(SerialLink):
    """Link to the supervisor process; it starts supervisor and watchdog, and they exit when it is closed.

    Args:
        config: configuration of the supervisor.
        session: number of the operator's session. Defaults to a random one.
        hand_back: whether to select the robot's own controller at the end.
        checks: results of earlier checks.

    Raises:
        SurefootError: the supervisor or the watchdog does not start.
    """

    detects_other_programs = True
    advice = "the supervisor process does not answer: close other programs"

    def __init__(
        self,
        config: LinkConfig,
        session: int | None = None,
        hand_back: bool = False,
        checks: Sequence[CheckResult] = (),
    ) -> None:
        (here, host), (supervisor, watchdog) = socket.socketpair(), socket.socketpair()
        self.children = [Child(_WATCHDOG, config, [watchdog]), Child(_SUPERVISOR, config, [host, supervisor])]
        for end in (host, supervisor, watchdog):
            end.close()
        super().__init__(SocketPort(here, "the supervisor process"), CODEC, MonotonicClock(), session)
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
        """End the session; return when the supervisor has damped the motors and exited.

        The robot's own controller is handed the robot only if its motors were not damped by a stop or a fault, and it
        lies still.

        Raises:
            SurefootError: the robot's own controller was not, or could not be selected.
        """
        children, self.children = self.children, []
        ended = self.state is None or self.state.mode == Mode.DISARMED
        with contextlib.suppress(LinkLostError):
            super().close()
        for child in children:
            child.finish(_EXIT_TIMEOUT)
        if self._hand_back and children:
            if not ended:
                raise SurefootError(
                    "--hand-back: the motors were damped, so the robot's own controller is not activated"
                )
            bus = Bus(self._config.interface, self._config.domain)
            try:
                if not Inspection(bus, self._config.interface, self._config.domain).is_lying():
                    raise SurefootError("--hand-back: the robot does not lie still; its controller is not activated")
                MotionService(bus).hand_back()
            finally:
                bus.close()
