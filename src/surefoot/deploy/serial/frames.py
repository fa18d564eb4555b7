"""Frames on a serial line: header, payload and CRC-32, encoded with COBS, between two zero bytes.

    00 | COBS( header (18) | payload | CRC-32 of both (4) ) | 00

Zero bytes occur nowhere else, so a receiver that starts at any byte finds the next frame. The leading zero separates a
frame from damaged bytes before it.
"""

from __future__ import annotations

import math
import zlib

from cobs import cobs

from surefoot.deploy.messages import Message, Packet
from surefoot.deploy.robot_link import LinkStatistics
from surefoot.deploy.serial.codec import HEADER, NUMBERS, VERSION, Codec

MAX_FRAME = 1024
"""Maximum number of bytes between two zeros: `MAX_PAYLOAD`, header, CRC-32 and the overhead of COBS."""
CRC_BYTES = 4


def frame_bytes(codec: Codec, kind: type[Message]) -> int:
    """Return the maximum size of a message's frame, with its zeros [bytes]."""
    body = HEADER.size + codec.size(kind) + CRC_BYTES
    return body + math.ceil(body / 254) + 2


def encode_frame(codec: Codec, message: Message, sequence: int, time: float) -> bytes:
    """Return the frame of a message, with its zeros.

    Args:
        codec: encodes the message.
        message: message to send.
        sequence: number of the frame, from 1.
        time: sending time on the sender's clock [s].

    Raises:
        ValueError: a sequence number out of range, a time that is not finite, or a message that does not fit.
    """
    if not 1 <= sequence < 2**32:
        raise ValueError(f"the number of a frame is {sequence}; it must be 1 to {2**32 - 1}")
    if not math.isfinite(time):
        raise ValueError(f"the time of a frame is {time}; it must be finite")
    microseconds = min(max(round(time * 1e6), 0), 2**64 - 1)
    body = HEADER.pack(VERSION, NUMBERS[type(message)], codec.schema, sequence, microseconds) + codec.pack(message)
    encoded = cobs.encode(body + zlib.crc32(body).to_bytes(CRC_BYTES, "little"))
    return b"\0" + encoded + b"\0"


class Decoder:
    """Finds complete frames in a byte stream. It buffers at most `MAX_FRAME` bytes and never raises."""

    def __init__(self, codec: Codec, statistics: LinkStatistics | None = None) -> None:
        self.codec = codec
        self.statistics = statistics or LinkStatistics()
        self.foreign: tuple[int, int] | None = None
        """Version and schema of the last complete frame of another protocol."""
        self._buffer = bytearray()
        self._overlong = False

    def feed(self, data: bytes) -> list[Packet]:
        """Add received bytes; return the packets of all frames that they complete, in order."""
        *ended, rest = bytes(data).split(b"\0")
        packets = [packet for piece in ended if (packet := self._take(piece)) is not None]
        self._hold(rest)
        return packets

    def _hold(self, piece: bytes) -> None:
        if len(self._buffer) + len(piece) > MAX_FRAME:
            self._overlong = True
            self._buffer.clear()
        elif not self._overlong:
            self._buffer += piece

    def _take(self, piece: bytes) -> Packet | None:
        """Return the packet of the frame that ends with this piece and a zero, or None."""
        self._hold(piece)
        encoded, overlong = bytes(self._buffer), self._overlong
        self._buffer.clear()
        self._overlong = False
        if not encoded and not overlong:
            return None
        body = b"" if overlong else _decode_body(encoded)
        if len(body) < HEADER.size:
            self.statistics.damaged += 1
            return None
        version, code, schema, sequence, time = HEADER.unpack_from(body)
        if version != VERSION or schema != self.codec.schema:
            self.statistics.foreign += 1
            self.foreign = version, schema
            return None
        message = self.codec.unpack(code, body[HEADER.size :])
        if message is None:
            self.statistics.unknown += 1
            return None
        self.statistics.received += 1
        return Packet(message, sequence, time / 1_000_000)


def _decode_body(encoded: bytes) -> bytes:
    """Return header and payload of an encoded frame, or b"" if the frame is damaged."""
    try:
        whole = cobs.decode(encoded)
    except cobs.DecodeError:
        return b""
    body, crc = whole[:-CRC_BYTES], whole[-CRC_BYTES:]
    return body if zlib.crc32(body).to_bytes(CRC_BYTES, "little") == crc else b""
