"""A board's end of a link that carries frames: bytes of hosts to its program, and its packets to bytes."""

from __future__ import annotations

from surefoot.deploy.board.firmware import Firmware
from surefoot.deploy.messages import Packet
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import Decoder, encode_frame


class HostFrames:
    """Frames of hosts for a robot of so many motors."""

    def __init__(self, motors: int) -> None:
        # No text of a host means anything to a robot: it need not know UTF-8.
        self.codec = Codec(motors, text_errors="replace")
        self.restart()

    def restart(self) -> None:
        """Forget frames that are not complete."""
        self._decoder = Decoder(self.codec)
        self.statistics = self._decoder.statistics
        """What was received since."""

    def receive(self, now: int, data: bytes, firmware: Firmware) -> None:
        """Hand the board's program the packets that bytes complete, and report damage to it."""
        statistics = self.statistics
        damaged, foreign = statistics.damaged + statistics.unknown, statistics.foreign
        packets = self._decoder.feed(data)
        if statistics.damaged + statistics.unknown > damaged:
            firmware.watch.note_damage()
        if statistics.foreign > foreign:
            firmware.reject_foreign(now, f"schema is {self.codec.schema:#010x}")
        for packet in packets:
            firmware.receive(now, packet)

    def encode(self, packet: Packet) -> bytes:
        """Return the frame of a packet."""
        return encode_frame(self.codec, packet.message, packet.sequence, packet.time)
