"""One direction of a serial line: transmission time, and harm to frames on the way."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping

import numpy as np

from surefoot.emulator.fault_table import LINE_FAULTS
from surefoot.emulator.faults import flip_bits

BITS_PER_BYTE = 10
"""Start bit, eight data bits, stop bit."""
_MAX_OPEN = 4096
"""Bytes that are kept while no zero ends a frame."""


class Line:
    """One direction of the line. Times are whole microseconds.

    Args:
        random: draws harms of frames.
        baud: bits per second; 0: bytes take no time.
        batch: bytes arrive only at multiples of this time [s], as with some USB adapters; 0: without delay.
    """

    def __init__(self, random: np.random.Generator, baud: float = 0.0, batch: float = 0.0) -> None:
        self.probabilities: Mapping[str, float] = {}
        """Chance of each harm that may happen now, 0 to 1 per frame."""
        self.counts: Counter[str] = Counter()
        """Frames to which something happened, by harm."""
        self.dead = False
        self._random, self._baud, self._batch = random, baud, batch
        self._open = bytearray()
        self._late: bytes | None = None
        self._free_at = 0.0
        self._coming: deque[tuple[int, bytes]] = deque()

    @property
    def next_time(self) -> float:
        """When the next bytes arrive; infinite if none are on their way."""
        return self._coming[0][0] if self._coming else math.inf

    def take(self) -> bytes:
        """Return the bytes that arrive next."""
        return self._coming.popleft()[1]

    def send(self, now: int, data: bytes) -> None:
        """Put bytes on the line; zeros separate frames."""
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
        # A zero that begins a frame waits for the rest; bytes that never become a frame are passed on as they are.
        if len(self._open) > _MAX_OPEN:
            self._put(now, bytes(self._open))
            self._open.clear()

    def _send_frame(self, now: int, frame: bytes) -> None:
        if not self.probabilities:
            self._put(now, frame)
            return
        late, self._late = self._late, None
        for piece in self._apply_faults(frame):
            self._put(now, piece)
        if late is not None:
            self._put(now, late)

    def _apply_faults(self, frame: bytes) -> list[bytes]:
        """Return the pieces that a frame becomes; keep a frame that arrives after the next one."""
        random = self._random
        draws = dict(zip(LINE_FAULTS, random.random(len(LINE_FAULTS)).tolist(), strict=True))

        def occurs(harm: str) -> bool:
            hit = draws[harm] < self.probabilities.get(harm, 0.0)
            self.counts[harm] += hit
            return hit

        pieces = []
        if occurs("garbage"):
            pieces.append(random.bytes(int(random.integers(1, 64))))
        if occurs("drop"):
            return pieces
        if occurs("cut-frames"):
            at = int(random.integers(1, len(frame) - 1))
            frame = frame[:at] if random.random() < 0.5 else frame[at:]
        if occurs("corrupt"):
            frame = flip_bits(frame, random)
        if occurs("reorder"):
            self._late = frame
            return pieces
        return [*pieces, frame, frame] if occurs("duplicate") else [*pieces, frame]

    def _put(self, now: int, data: bytes) -> None:
        at = float(now)
        if self._baud:
            self._free_at = max(self._free_at, at) + len(data) * BITS_PER_BYTE * 1e6 / self._baud
            at = self._free_at
        if self._batch:
            step = self._batch * 1e6
            at = -(-at // step) * step
        self._coming.append((round(at), data))

    def cut_off(self) -> None:
        """Pull the cable: what is on its way is lost, and all that follows."""
        self.dead = True
        self._coming.clear()
