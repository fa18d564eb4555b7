"""One direction of a simulated serial line: transmission time, and faults of frames."""

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
"""Maximum number of buffered bytes without a zero that ends a frame."""


class Line:
    """One direction of a serial line. Times are whole microseconds.

    Args:
        random: random numbers of the faults.
        baud: bit rate [1/s]; 0: bytes take no time.
        batch: bytes arrive only at multiples of this time, as with some USB adapters [s]; 0: no delay.
    """

    def __init__(self, random: np.random.Generator, baud: float = 0.0, batch: float = 0.0) -> None:
        self.probabilities: Mapping[str, float] = {}
        """Probability of each active line fault, 0 to 1 per frame."""
        self.counts: Counter[str] = Counter()
        """Number of affected frames by fault."""
        self.unplugged = False
        self._random, self._baud, self._batch = random, baud, batch
        self._open = bytearray()
        self._delayed: bytes | None = None
        self._free_at = 0.0
        self._in_transit: deque[tuple[int, bytes]] = deque()

    @property
    def next_time(self) -> float:
        """Time at which the next bytes arrive; infinite if none are in transit."""
        return self._in_transit[0][0] if self._in_transit else math.inf

    def take(self) -> bytes:
        """Remove and return the next bytes."""
        return self._in_transit.popleft()[1]

    def send(self, now: int, data: bytes) -> None:
        """Send bytes; zeros separate frames."""
        if self.unplugged:
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
        # The leading zero of a frame waits for the rest. Bytes that are too long for a frame are sent unchanged.
        if len(self._open) > _MAX_OPEN:
            self._put(now, bytes(self._open))
            self._open.clear()

    def _send_frame(self, now: int, frame: bytes) -> None:
        if not self.probabilities:
            self._put(now, frame)
            return
        delayed, self._delayed = self._delayed, None
        for piece in self._apply_faults(frame):
            self._put(now, piece)
        if delayed is not None:
            self._put(now, delayed)

    def _apply_faults(self, frame: bytes) -> list[bytes]:
        """Return the bytes that arrive instead of a frame; a reordered frame is stored until the next one."""
        random = self._random
        samples = dict(zip(LINE_FAULTS, random.random(len(LINE_FAULTS)).tolist(), strict=True))

        def occurs(fault: str) -> bool:
            occurs = samples[fault] < self.probabilities.get(fault, 0.0)
            self.counts[fault] += occurs
            return occurs

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
            self._delayed = frame
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
        self._in_transit.append((round(at), data))

    def cut_off(self) -> None:
        """Pull the cable: data in transit and all later data are lost."""
        self.unplugged = True
        self._in_transit.clear()
