"""A file that a thread writes."""

from __future__ import annotations

import threading
from collections import deque
from pathlib import Path
from typing import BinaryIO

PATIENCE = 2.0
"""Time [s] that the disk has for the last write."""


class BackgroundFile:
    """A file that a thread writes every `period` [s], so that whoever adds data never waits for the disk.

    It is made or replaced with the first data. Without a period, data are in the file when `add` returns.
    """

    def __init__(self, path: Path, period: float | None) -> None:
        self.path = path
        self.stopped = ""
        """Why nothing is written any more; empty while writing succeeds."""
        self._file: BinaryIO | None = None
        self._waiting: deque[bytes] = deque()
        self._end = threading.Event()
        self._thread: threading.Thread | None = None
        if period is not None:
            self._thread = threading.Thread(target=self._write_on, args=(period,), name="file", daemon=True)
            self._thread.start()

    @property
    def waiting(self) -> int:
        """Number of pieces of data that are not written yet."""
        return len(self._waiting)

    def add(self, data: bytes) -> None:
        """Append data, unless writing has stopped."""
        if not self.stopped:
            self._waiting.append(data)
            if self._thread is None:
                self._write()

    def _write_on(self, period: float) -> None:
        over = False
        while not over or self._waiting:
            over = self._end.wait(period)
            self._write()

    def _write(self) -> None:
        data = b"".join(self._waiting.popleft() for _ in range(len(self._waiting)))
        try:
            if data and self._file is None:
                self._file = self.path.open("wb", buffering=0)
            while data and self._file is not None:
                data = data[self._file.write(data) or 0 :]
        except OSError as error:
            self.stopped = error.strerror or str(error)
            self._waiting.clear()

    def close(self) -> None:
        """Write the rest and close the file; wait for the disk no longer than `PATIENCE`."""
        self._end.set()
        if self._thread is not None:
            self._thread.join(PATIENCE)
            if self._thread.is_alive():
                self.stopped = self.stopped or "the disk does not answer"
                return
        try:
            if self._file is not None:
                self._file.close()
        except OSError as error:  # some file systems report a full disk only here
            self.stopped = self.stopped or error.strerror or str(error)
