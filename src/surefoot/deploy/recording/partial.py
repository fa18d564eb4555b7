"""A run on the disk while it goes: rows are added several times a second, so that a killed computer leaves its run.

What stands in the file, and how it is read again: see `task.partial_trace`.
"""

from __future__ import annotations

import itertools
import os
import threading
from collections import deque
from pathlib import Path
from typing import Any

from surefoot.arrays import Array
from surefoot.task.partial_trace import SUFFIX, Layout, head_line, row_bytes

FLUSH = 0.1
"""Time [s] between two writes."""
PATIENCE = 2.0
"""Time [s] that the disk has for the last write."""
_MOST = 20_000
"""Rows that may wait for the disk; beyond that recording stops, the memory of a robot's computer is not endless."""


class PartialFile:
    """Writes rows from a thread of its own; whoever adds rows never waits for the disk.

    Args:
        path: the file; made with the first row, and replaced, if there is one.
        layout: of a row.
        meta: meta of the trace, as far as it is known when the first row comes.
    """

    def __init__(self, path: Path, layout: Layout, meta: dict[str, Any]) -> None:
        self.path = path
        self.stopped = ""
        """Why nothing is written any more; empty while all goes well."""
        self._layout, self._meta = layout, meta
        self._begun = False
        self._waiting: deque[bytes] = deque()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._write, name="trace", daemon=True)
        self._thread.start()

    def add(self, rows: Array) -> None:
        """Take rows (n, width)."""
        if self.stopped:
            return
        if len(self._waiting) > _MOST:
            self.stopped = "the disk is too slow"
            return
        if not self._begun:
            self._begun = True
            self._waiting.append(head_line(self._layout, self._meta))
        self._waiting.append(row_bytes(rows))

    def _write(self) -> None:
        try:
            while not self._waiting:
                if self._end.wait(FLUSH) and not self._waiting:
                    return
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("wb", buffering=0) as file:
                while True:
                    over = self._end.wait(FLUSH)
                    parts = [self._waiting.popleft() for _ in range(len(self._waiting))]
                    data = memoryview(b"".join(parts))
                    while data:
                        data = data[file.write(data) :]
                    if over and not self._waiting:
                        return
        except OSError as error:
            self.stopped = error.strerror or str(error)
            self._waiting.clear()

    def close(self) -> None:
        """Write what waits, and end; waits for the disk no longer than `PATIENCE`."""
        self._end.set()
        self._thread.join(PATIENCE)
        if self._thread.is_alive() and not self.stopped:
            self.stopped = "the disk does not answer"

    def remove(self) -> None:
        """Drop the file, once the whole trace is kept elsewhere."""
        self.close()
        self.path.unlink(missing_ok=True)


def next_free(folder: Path) -> Path:
    """The first of run_000.npz, run_001.npz, ... that stands for no run yet, whole or partial."""
    taken = set(os.listdir(folder)) if folder.is_dir() else set()
    names = (f"run_{number:03d}.npz" for number in itertools.count())
    return folder / next(name for name in names if not {name, name + SUFFIX} & taken)
