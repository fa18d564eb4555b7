"""The file of a trace while it is recorded: rows several times a second, and in their place the whole trace at the end.

If the process is killed or the computer stops, the rows remain. `task.partial_trace` defines their file and reads it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

from surefoot.arrays import Array
from surefoot.deploy.background_file import BackgroundFile
from surefoot.errors import SurefootError, describe_os_errors
from surefoot.task.partial_trace import SUFFIX, row_bytes
from surefoot.task.trace import EpisodeTrace

WRITE_PERIOD = 0.1
"""Time [s] between two writes."""
MAX_PENDING = 20_000
"""Pieces of data that may wait for the disk, as memory of a robot's computer is short; then recording stops."""


class TraceFile:
    """Writes the rows of a trace without ever waiting for the disk, and the whole trace at its end.

    Args:
        path: the trace's file (.npz); its folder is made.
        head: returns the first line of the partial file; called when the first rows come.

    Raises:
        SurefootError: the folder can't be written, or no process can be started.
    """

    def __init__(self, path: Path, head: Callable[[], bytes]) -> None:
        with describe_os_errors(f"folder {path.parent}", "written"):
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=path.parent):
                pass
        self.path, self._head = path, head
        self._partial = BackgroundFile(path.with_name(path.name + SUFFIX), WRITE_PERIOD)
        self._has_head = False

    @property
    def stopped(self) -> str:
        """Why rows are not written any more; empty while writing succeeds."""
        return self._partial.stopped

    def add(self, rows: Array) -> None:
        """Append rows (n, width)."""
        if not self._has_head:
            self._has_head = True
            self._partial.add(self._head())
        if self._partial.waiting > MAX_PENDING:
            self._partial.stopped = "the disk is too slow"
        self._partial.add(row_bytes(rows))

    def close(self) -> None:
        """Write the last rows."""
        self._partial.close()

    def replace(self, trace: EpisodeTrace) -> str:
        """Write the whole trace in place of its rows; return what went wrong and what is left, empty if all is well."""
        partial = self._partial.path
        try:
            trace.save(self.path)
        except (OSError, SurefootError) as error:
            reason = getattr(error, "strerror", None) or error
            left = f"what could be written is in {partial}" if partial.exists() else "it is lost"
            return f"trace {self.path} can't be written: {reason}; {left}"
        partial.unlink(missing_ok=True)
        return ""
