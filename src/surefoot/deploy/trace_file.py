"""Recording of a trace: rows are written several times a second, and replaced by the complete trace at the end.

If the process is killed or the computer stops, the rows remain. `task.partial_trace` defines and reads their file.
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
"""Period of writing [s]."""
MAX_PENDING = 20_000
"""Maximum number of pieces of data that wait for the disk, since memory of a robot's computer is limited."""


class TraceFile:
    """Writes the rows of a trace without waiting for the disk, and the complete trace at the end.

    Args:
        path: file of the trace (.npz); its folder is created.
        head: returns the first line of the partial file; called before the first rows.

    Raises:
        SurefootError: the folder cannot be written, or the process that writes cannot be started.
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
    def error(self) -> str:
        """Why writing of rows has stopped; "" while it succeeds."""
        return self._partial.error

    def add(self, rows: Array) -> None:
        """Append rows (n, width)."""
        if not self._has_head:
            self._has_head = True
            self._partial.add(self._head())
        if self._partial.pending > MAX_PENDING:
            self._partial.error = "the disk is too slow"
        self._partial.add(row_bytes(rows))

    def close(self) -> None:
        """Write the remaining rows."""
        self._partial.close()

    def replace(self, trace: EpisodeTrace) -> str:
        """Replace the rows by the complete trace; return an error message with what is left on disk, or ""."""
        partial = self._partial.path
        try:
            trace.save(self.path)
        except (OSError, SurefootError) as error:
            reason = getattr(error, "strerror", None) or error
            left = f"what could be written is in {partial}" if partial.exists() else "it is lost"
            return f"trace {self.path} can't be written: {reason}; {left}"
        partial.unlink(missing_ok=True)
        return ""
