"""The robot's end of its link to a host: packets in and out, and the time that they take."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

from surefoot.deploy.messages import Packet
from surefoot.deploy.robot_link import LinkStatistics

if TYPE_CHECKING:
    from surefoot.deploy.board.firmware import Firmware


class Transport(Protocol):
    """What a loop that advances a robot needs of its link. Times are whole microseconds on the robot's clock."""

    def poll(self, now: int) -> None:
        """Put what hosts have written on its way to the robot."""

    def flush(self, now: int) -> None:
        """Hand over to hosts what has reached them by now."""

    def wait(self, timeout: float) -> bool:
        """Wait until hosts have written something, at most `timeout` [s]; return whether they have."""


class HostLink(Transport, Protocol):
    """What an emulated microcontroller needs of a link."""

    chances: Mapping[str, float]
    """Chance of each harm of `fault_table.HARMS` that may happen now, 0 to 1 per packet."""
    lead: float
    """Time [s] between a state's sending and its use by a deployment; 0 in lockstep."""

    @property
    def statistics(self) -> LinkStatistics:
        """What the firmware has received since it started, and what hosts did not read."""

    @property
    def next_arrival(self) -> float:
        """When the next packets reach the robot; infinite if none are on their way."""

    @property
    def next_departure(self) -> float:
        """When the next packets reach the host; infinite if none are on their way."""

    def receive(self, now: int, firmware: Firmware) -> None:
        """Hand the firmware the packets that arrive next."""

    def send(self, now: int, packet: Packet) -> None:
        """Put a packet on its way to the host."""

    def restart(self) -> None:
        """Forget packets that are not complete: the firmware starts anew."""

    def cut_off(self) -> None:
        """Cut the connection: bytes in transit and all later ones are lost."""
