"""The board's end of a serial link: decodes frames from hosts for the board's program, and encodes its packets."""

from __future__ import annotations

from surefoot.deploy.board.firmware import Firmware
from surefoot.deploy.messages import Packet
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import Decoder, encode_frame


class HostFrames:
    """Decoder and encoder of a robot's frames, for a number of motors and with or without an accelerometer."""

    def __init__(self, motors: int, accelerometer: bool = False) -> None:
        # A robot needs no text from a host, so it need not support UTF-8.
        self.codec = Codec(motors, accelerometer, text_errors="replace")
        self.restart()

    def restart(self) -> None:
        """Discard incomplete frames."""
        self._decoder = Decoder(self.codec)
        self.statistics = self._decoder.statistics
        """Counts since the last restart."""

    def receive(self, now: int, data: bytes, firmware: Firmware) -> None:
        """Decode bytes, and pass the resulting packets and reports of damage to the board's program."""
        statistics = self.statistics
        damaged, foreign = statistics.damaged + statistics.unknown, statistics.foreign
        packets = self._decoder.feed(data)
        if statistics.damaged + statistics.unknown > damaged:
            firmware.link_monitor.note_damage()
        if statistics.foreign > foreign:
            firmware.reject_foreign(now, f"schema is {self.codec.schema:#010x}")
        for packet in packets:
            firmware.receive(now, packet)

    def encode(self, packet: Packet) -> bytes:
        """Return the frame of a packet."""
        return encode_frame(self.codec, packet.message, packet.sequence, packet.time)
