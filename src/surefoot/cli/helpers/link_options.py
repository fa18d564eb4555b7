"""Options of commands that use a link to a robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from surefoot.configuration import Within
from surefoot.deploy.links import open_link
from surefoot.deploy.robot_link import RobotLink
from surefoot.deploy.serial.port import BAUD


@dataclass(frozen=True, kw_only=True)
class LinkOptions:
    """How a command opens its link to a robot."""

    lockstep: bool = False
    """The robot is an emulator that runs with --lockstep."""
    baud: Annotated[int, Within(9600, 100_000_000)] = BAUD
    """Bits a second of a serial port."""

    def open_link(self, port: str, motors: int) -> RobotLink:
        """Open a link to a robot with so many motors."""
        return open_link(port, motors, self.lockstep, self.baud)
