"""Options of commands that connect to a robot."""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields
from typing import Annotated, Literal

import tyro
from numpy.typing import ArrayLike

from surefoot.cli.helpers.options import Port, ask_to_release, changed_option
from surefoot.configuration import Within
from surefoot.deploy.checks import WATCHDOG_STEPS
from surefoot.deploy.links import open_dds_link, open_link
from surefoot.deploy.robot_link import RobotLink
from surefoot.deploy.serial.port import BAUD
from surefoot.errors import SurefootError
from surefoot.policy.contract import Contract
from surefoot.robot import RobotDescription


@dataclass(frozen=True, kw_only=True)
class SerialOptions:
    """Options of a serial link to a robot."""

    lockstep: bool = False
    """Set this if the robot is an emulator that runs with --lockstep."""
    baud: Annotated[int, Within(9600, 100_000_000)] = BAUD
    """Bits per second of a serial port."""

    def open_port(self, port: str, motors: int) -> RobotLink:
        """Open the link to a robot with a given number of motors."""
        return open_link(port, motors, self.lockstep, self.baud)


@dataclass(frozen=True, kw_only=True)
class LinkOptions(SerialOptions):
    """Options of a link to a robot of any kind."""

    port: Port | None = None
    """Serial port or pseudo-terminal of the robot, such as /dev/ttyUSB0; required with --link serial."""
    link: Literal["serial", "dds"] = "serial"
    """Transport of the messages: a serial port, or DDS to a Unitree Go2."""
    interface: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Network interface to the robot, such as eth0; required with --link dds."""
    domain: Annotated[int, Within(0, 230)] = 0
    """DDS domain of the robot; 0 on a Go2."""
    release: bool = False
    """Let a Go2 lie down and release its own controller without asking for confirmation."""
    hand_back: bool = False
    """Activate a Go2's own controller again at the end, if it lies still and its motors were not damped."""

    @property
    def address(self) -> str:
        """Description of the link for messages."""
        return f"port {self.port}" if self.link == "serial" else f"interface {self.interface}, domain {self.domain}"

    def check_link(self) -> None:
        """Reject combinations of options that are not valid."""
        if self.link == "serial":
            if self.port is None:
                raise SurefootError("--port is missing; for a robot over DDS, give --link dds --interface NAME")
            for name in ("interface", "domain", "release", "hand_back"):
                if getattr(self, name):
                    raise SurefootError(f"--{name.replace('_', '-')} is given; it requires --link dds")
        elif self.interface is None:
            raise SurefootError("--interface is missing; it names the network interface to the robot, such as eth0")
        elif self.port is not None or self.lockstep:
            option = "--lockstep" if self.lockstep else "--port"
            raise SurefootError(f"{option} and --link dds can't be combined; {option} is for a serial link")

    def reject_link(self, without: str) -> None:
        """Reject options of a link; `without` says why there is none, such as "a recording needs no robot"."""
        if (option := changed_option(self, [item.name for item in fields(LinkOptions)])) is not None:
            raise SurefootError(f"{option} is given; {without}")

    def open_link(self, robot: RobotDescription, contract: Contract, may_ask: bool = True) -> RobotLink:
        """Open the link to a robot; over DDS the robot receives the policy's gains and a watchdog timeout.

        `may_ask`: ask on a terminal whether a Go2's own controller shall be released.
        """
        gains, silence = (contract.servo_kp, contract.servo_kd), WATCHDOG_STEPS * contract.control_step
        return self.open_with_gains(robot, gains, silence, may_ask)

    def open_with_gains(
        self, robot: RobotDescription, gains: tuple[ArrayLike, ArrayLike], silence: float, may_ask: bool
    ) -> RobotLink:
        """Open the link to a robot; over DDS the robot receives these gains and this watchdog timeout.

        For `gains` and `silence` see `open_dds_link`, for `may_ask` see `open_link`.
        """
        if self.link == "serial":
            return self.open_port(str(self.port), robot.num_motors)

        def release(name: str) -> bool:
            return self.release or (may_ask and sys.stdin.isatty() and ask_to_release(name))

        return open_dds_link(robot, str(self.interface), self.domain, gains, silence, release, self.hand_back)
