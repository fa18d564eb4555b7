"""Robot's end of a simulated serial line, with encoding and decoding of packets."""

from __future__ import annotations

from collections.abc import Mapping

from surefoot.deploy.board.firmware import Firmware
from surefoot.deploy.board.host_frames import HostFrames
from surefoot.deploy.messages import Packet
from surefoot.deploy.robot_link import LinkStatistics
from surefoot.emulator.fault_table import InjectedFault
from surefoot.emulator.serial.line import Line
from surefoot.emulator.serial.pty_port import PtyPort
from surefoot.emulator.serial.socket_server_port import SocketServerPort
from surefoot.seeding import generator

HostPort = PtyPort | SocketServerPort


class SerialHostLink:
    """COBS frames over a simulated line in both directions; a `Transport`.

    Args:
        port: port that hosts open.
        motors: number of motors of the robot.
        faults: injected faults by name; only faults of the line have an effect here.
        baud: bit rate [1/s]; 0: bytes take no time.
        seed: seed of the random faults.
        patience: maximum time to wait for a host to read [s].
        lead: time from the sending of a state to its use by a deployment [s]; 0 in lockstep.
        accelerometer: whether states have the reading of an accelerometer.
    """

    def __init__(
        self,
        port: HostPort,
        motors: int,
        faults: Mapping[str, InjectedFault] | None = None,
        baud: float = 0.0,
        seed: int = 0,
        patience: float = 0.0,
        lead: float = 0.0,
        accelerometer: bool = False,
    ) -> None:
        faults = faults or {}
        self.port, self.lead, self._patience = port, lead, patience
        self.frames = HostFrames(motors, accelerometer)
        if "other-schema" in faults:
            self.frames.codec.schema ^= 0xFFFF
        batch = faults["batching"].value if "batching" in faults else 0.0
        self.inbound = Line(generator(seed, "line to robot"), baud)
        self.outbound = Line(generator(seed, "line to host"), baud, batch)

    @property
    def statistics(self) -> LinkStatistics:
        """Packets received by the firmware since its start, and packets not read by hosts."""
        self.frames.statistics.unsent = self.port.unread
        return self.frames.statistics

    @property
    def probabilities(self) -> Mapping[str, float]:
        """Probability of each active line fault, 0 to 1 per frame."""
        return self.inbound.probabilities

    @probabilities.setter
    def probabilities(self, probabilities: Mapping[str, float]) -> None:
        self.inbound.probabilities = self.outbound.probabilities = probabilities

    @property
    def next_arrival(self) -> float:
        """Time at which the next bytes reach the robot; infinite if none are in transit."""
        return self.inbound.next_time

    @property
    def next_departure(self) -> float:
        """Time at which the next bytes reach the host; infinite if none are in transit."""
        return self.outbound.next_time

    def poll(self, now: int) -> None:
        """Send the bytes that hosts have written to the robot."""
        if data := self.port.read():
            self.inbound.send(now, data)

    def take(self, now: int) -> bytes:
        """Remove and return the bytes that have reached the hosts by now."""
        data = b""
        while self.outbound.next_time <= now:
            data += self.outbound.take()
        return data

    def flush(self, now: int) -> None:
        """Write the bytes that have reached the hosts by now to the port."""
        if data := self.take(now):
            self.port.write(data, self._patience)

    def wait(self, timeout: float) -> bool:
        """Wait until hosts have written data, at most `timeout` [s]; return whether they have."""
        return self.port.wait(timeout)

    def receive(self, now: int, firmware: Firmware) -> None:
        """Pass the packets in the next bytes to the firmware, and report damage to it."""
        self.frames.receive(now, self.inbound.take(), firmware)

    def send(self, now: int, packet: Packet) -> None:
        """Send the frame of a packet to the host."""
        self.outbound.send(now, self.frames.encode(packet))

    def restart(self) -> None:
        """Discard incomplete frames, since the firmware restarts."""
        self.frames.restart()

    def cut_off(self) -> None:
        """Pull the cable: data in transit and all later data are lost."""
        self.inbound.cut_off()
        self.outbound.cut_off()
