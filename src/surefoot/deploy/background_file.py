"""File written by another process, so that the control loop never waits for the disk."""

from __future__ import annotations

import fcntl
import os
import select
import subprocess
import sys
import time
from collections import deque
from pathlib import Path
from typing import BinaryIO

from surefoot.deploy import file_writer
from surefoot.errors import describe_os_errors

CLOSE_TIMEOUT = 2.0
"""Maximum time for the last write [s]."""
_PIPE_SIZE = 1 << 20
"""Size of the pipe to the writer [bytes]: the maximum without privileges."""


class BackgroundFile:
    """File that a child process writes every `period` [s], so that `add` never waits for the disk.

    A thread could not do this: next to busy programs, a thread with ordinary priority may be descheduled while it holds
    the interpreter lock, and the control loop would wait for it whatever its own priority. In addition, if this process
    is killed, the child process still writes all data that were added.

    The file is created or replaced with the first data.

    Args:
        path: path of the file.
        period: period of writing [s]; without one, the data are in the file when `add` returns.

    Raises:
        SurefootError: the process cannot be started.
    """

    def __init__(self, path: Path, period: float | None) -> None:
        self.path = path
        self.error = ""
        """Why writing has stopped; "" while it succeeds."""
        self._file: BinaryIO | None = None
        self._pending: deque[bytes] = deque()
        self._writer: subprocess.Popen[bytes] | None = None
        if period is not None:
            command = [sys.executable, "-I", "-S", file_writer.__file__, str(path.absolute()), str(period)]
            with describe_os_errors(f"file {path}", "written"):
                # In a session of its own, it does not receive Ctrl-C from the terminal.
                self._writer = subprocess.Popen(
                    command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
                )
            os.set_blocking(self._pipe, False)
            fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, _PIPE_SIZE)

    @property
    def _pipe(self) -> int:
        assert self._writer is not None
        assert self._writer.stdin is not None
        return self._writer.stdin.fileno()

    @property
    def pending(self) -> int:
        """Number of pieces of data that are not in the pipe yet."""
        return len(self._pending)

    def add(self, data: bytes) -> None:
        """Append data, unless writing has stopped."""
        if self.error:
            return
        self._pending.append(data)
        try:
            if self._writer is None:
                self._write()
            else:
                self._hand_over()
        except OSError as error:
            self._stop(error)

    def _write(self) -> None:
        data = b"".join(self._pending)
        self._pending.clear()
        if data and self._file is None:
            self._file = self.path.open("wb", buffering=0)
        while data and self._file is not None:
            data = data[self._file.write(data) or 0 :]

    def _hand_over(self) -> None:
        """Write pending data to the pipe until it is full."""
        while self._pending:
            data = self._pending[0]
            try:
                rest = data[os.write(self._pipe, data) :]
            except BlockingIOError:
                return
            if rest:
                self._pending[0] = rest
            else:
                self._pending.popleft()

    def _stop(self, error: OSError) -> None:
        """Stop writing, and store the reason: the error of the writer if it has ended."""
        text = ""
        if isinstance(error, BrokenPipeError) and self._writer is not None and self._writer.stdout is not None:
            text = self._writer.stdout.read().decode(errors="replace") or "its process has ended"
        self.error = self.error or text or error.strerror or str(error)
        self._pending.clear()

    def close(self) -> None:
        """Write the remaining data and close the file; wait for the disk at most `CLOSE_TIMEOUT`."""
        try:
            if self._file is not None:
                self._file.close()
            if self._writer is not None:
                self._close(self._writer, time.monotonic() + CLOSE_TIMEOUT)
        except subprocess.TimeoutExpired:
            self.error = self.error or "the disk does not respond"
        except OSError as error:  # some file systems report a full disk only now
            self._stop(error)

    def _close(self, writer: subprocess.Popen[bytes], end: float) -> None:
        assert writer.stdin is not None
        assert writer.stdout is not None
        while self._pending and time.monotonic() < end:
            select.select([], [self._pipe], [], max(end - time.monotonic(), 0.0))
            self._hand_over()
        writer.stdin.close()
        if writer.wait(max(end - time.monotonic(), 0.0)):
            raise BrokenPipeError
        writer.stdout.close()
