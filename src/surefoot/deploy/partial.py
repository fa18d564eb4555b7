"""A run on the disk while it goes: rows are added several times a second, so that a killed computer leaves its run.

A partial file is a line of JSON (layout and meta of the trace) and then rows of little-endian 64-bit floats. A row that
was cut off is left out when it is read.
"""

from __future__ import annotations

import json
import os
import threading
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from surefoot.deploy.recorder import Array, Layout, trace_of
from surefoot.errors import SurefootError
from surefoot.task.trace import EpisodeTrace

SUFFIX = ".partial"
FLUSH = 0.1
"""Time [s] between two writes."""
_KIND = "surefoot-partial-trace"
_MOST = 20_000
"""Rows that may wait for the disk; beyond that recording stops, the memory of a robot's computer is not endless."""


class PartialFile:
    """Writes rows from a thread of its own; whoever adds rows never waits for the disk.

    Args:
        path: the file; replaced, if there is one.
        layout: of a row.
        meta: meta of the trace, as far as it is known when the run starts.
    """

    def __init__(self, path: Path, layout: Layout, meta: dict[str, Any]) -> None:
        self.path = path
        self.stopped = ""
        """Why nothing is written any more; empty while all goes well."""
        head = {"kind": _KIND, "motors": layout.motors, "legs": layout.legs, "observations": layout.observations}
        self._waiting: deque[bytes] = deque([json.dumps({**head, "meta": meta}).encode() + b"\n"])
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
        self._waiting.append(rows.astype("<f8").tobytes())

    def _write(self) -> None:
        try:
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

    def close(self, patience: float = 2.0) -> None:
        """Write what waits, and end; waits for the disk no longer than `patience` [s]."""
        self._end.set()
        self._thread.join(patience)
        if self._thread.is_alive() and not self.stopped:
            self.stopped = "the disk does not answer"

    def remove(self) -> None:
        """Drop the file, once the whole trace is kept elsewhere."""
        self.close()
        self.path.unlink(missing_ok=True)


def recover(path: str | Path) -> EpisodeTrace:
    """The trace of a run that was cut off, from its partial file; it ended as a fault.

    Raises:
        SurefootError: no such file, another kind of file, or one without a whole row.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SurefootError(f"partial trace {path}: can't be read: {error.strerror}") from error
    line, _, body = data.partition(b"\n")
    try:
        head = json.loads(line)
        if head["kind"] != _KIND:
            raise ValueError("of another kind")
        layout = Layout(int(head["motors"]), int(head["legs"]), int(head["observations"]))
        meta = dict(head["meta"])
    except (ValueError, KeyError, TypeError) as error:
        raise SurefootError(f"partial trace {path}: is none: {' '.join(str(error).split())}") from error
    whole = len(body) // (8 * layout.width)
    rows = np.frombuffer(body, "<f8", whole * layout.width).reshape(whole, layout.width).astype(float)
    if not whole:
        raise SurefootError(f"partial trace {path}: holds no whole control step")
    try:
        return trace_of(layout, rows, {**meta, "ended": "fault", "reason": "cut off"})
    except SurefootError as error:
        raise SurefootError(f"partial trace {path}: {error}") from error


def next_free(folder: Path, stem: str = "run") -> Path:
    """The first of stem_000.npz, stem_001.npz, ... that stands for no run yet, whole or partial."""
    taken = set(os.listdir(folder)) if folder.is_dir() else set()
    number = 0
    while {f"{stem}_{number:03d}.npz", f"{stem}_{number:03d}{SUFFIX}"} & taken:
        number += 1
    return folder / f"{stem}_{number:03d}.npz"
