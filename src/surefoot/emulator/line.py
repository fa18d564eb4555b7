"""One direction of a serial line: bytes take their time, and what can happen to them happens."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

BITS_PER_BYTE = 10
"""Start bit, eight data bits, stop bit."""
_LONGEST = 4096
"""Bytes that are kept while no zero ends a frame."""


@dataclass(frozen=True)
class LineConfig:
    """What happens to the frames of one direction; all by chances from 0 to 1 a frame, unless said otherwise."""

    baud: float = 0.0
    """Bits a second; 0: bytes take no time."""
    batch: float = 0.0
    """Bytes arrive only at multiples of this time [s], as USB adapters hand them over; 0: when they come."""
    corrupt: float = 0.0
    """One to three bits are turned over."""
    drop: float = 0.0
    """Lost."""
    duplicate: float = 0.0
    """Comes twice."""
    reorder: float = 0.0
    """Comes after the next one."""
    garbage: float = 0.0
    """Bytes that nobody sent come before it."""
    cut: float = 0.0
    """Only its beginning, or only its end, comes."""

    @property
    def harms(self) -> bool:
        """Whether anything at all can happen to a frame."""
        return any((self.corrupt, self.drop, self.duplicate, self.reorder, self.garbage, self.cut))


@dataclass
class LineCounts:
    """Frames to which something happened."""

    corrupt: int = 0
    drop: int = 0
    duplicate: int = 0
    reorder: int = 0
    garbage: int = 0
    cut: int = 0


class Line:
    """One direction of the line. Times are whole microseconds.

    Args:
        config: what happens to frames.
        random: draws it.
    """

    def __init__(self, config: LineConfig, random: np.random.Generator) -> None:
        self.config, self.counts, self.dead = config, LineCounts(), False
        self.harmful = config.harms
        """Whether something may happen to frames just now."""
        self._random = random
        self._open = bytearray()
        self._late: bytes | None = None
        self._free_at = 0.0
        self._coming: deque[tuple[int, bytes]] = deque()

    @property
    def next_time(self) -> int | None:
        """When the next bytes arrive."""
        return self._coming[0][0] if self._coming else None

    def take(self) -> bytes:
        """The bytes that arrive next."""
        return self._coming.popleft()[1]

    def send(self, now: int, data: bytes) -> None:
        """Put bytes on the line; frames are told apart by their zeros."""
        if self.dead:
            return
        self._open += data
        start = 0
        while (end := self._open.find(0, start)) >= 0:
            if end > start:
                self._send_frame(now, bytes(self._open[: end + 1]))
                del self._open[: end + 1]
                start = 0
            else:
                start = end + 1
        # A zero that begins a frame waits for its rest; bytes that never become a frame are passed on as they are.
        if len(self._open) > _LONGEST:
            self._put(now, bytes(self._open))
            self._open.clear()

    def _send_frame(self, now: int, frame: bytes) -> None:
        if not self.harmful:
            self._put(now, frame)
            return
        late, self._late = self._late, None
        for piece in self._harmed(frame):
            self._put(now, piece)
        if late is not None:
            self._put(now, late)

    def _harmed(self, frame: bytes) -> list[bytes]:
        """What becomes of a frame; one that is to come later is kept."""
        config, counts, random = self.config, self.counts, self._random
        chances = random.random(6)
        pieces = []
        if chances[0] < config.garbage:
            counts.garbage += 1
            pieces.append(random.bytes(int(random.integers(1, 64))))
        if chances[1] < config.drop:
            counts.drop += 1
            return pieces
        if chances[2] < config.cut:
            counts.cut += 1
            at = int(random.integers(1, len(frame) - 1))
            frame = frame[:at] if random.random() < 0.5 else frame[at:]
        if chances[3] < config.corrupt:
            counts.corrupt += 1
            bits = np.unpackbits(np.frombuffer(frame, np.uint8))
            bits[random.choice(len(bits), int(random.integers(1, 4)), replace=False)] ^= 1
            frame = np.packbits(bits).tobytes()
        if chances[4] < config.reorder:
            counts.reorder += 1
            self._late = frame
            return pieces
        pieces.append(frame)
        if chances[5] < config.duplicate:
            counts.duplicate += 1
            pieces.append(frame)
        return pieces

    def _put(self, now: int, data: bytes) -> None:
        config = self.config
        at = float(now)
        if config.baud:
            self._free_at = max(self._free_at, at) + len(data) * BITS_PER_BYTE * 1e6 / config.baud
            at = self._free_at
        if config.batch:
            step = config.batch * 1e6
            at = -(-at // step) * step
        self._coming.append((round(at), data))

    def cut_off(self) -> None:
        """The cable is pulled: what is on its way is lost, and all that follows."""
        self.dead = True
        self._coming.clear()
        self._open.clear()
        self._late = None
