"""A file that another process writes."""

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

PATIENCE = 2.0
"""Time [s] that the disk has for the last write."""
_PIPE_SIZE = 1 << 20
"""Bytes that wait for the disk outside this process: what the kernel allows without privileges."""


class BackgroundFile:
    """A file that a process writes every `period` [s], so that whoever adds data never waits for the disk.

    A thread would not do. It has ordinary priority, or disturbs the loop: beside busy programs the loop, with
    whatever priority, waits for the interpreter that such a thread holds and is not scheduled to release. And if this
    process is killed, the writer still writes all that was added.

    The file is made or replaced with the first data. Without a period, data are in the file when `add` returns.

    Raises:
        SurefootError: no process can be started.
    """

    def __init__(self, path: Path, period: float | None) -> None:
        self.path = path
        self.stopped = ""
        """Why nothing is written any more; empty while writing succeeds."""
        self._file: BinaryIO | None = None
        self._waiting: deque[bytes] = deque()
        self._writer: subprocess.Popen[bytes] | None = None
        if period is not None:
            command = [sys.executable, "-I", "-S", file_writer.__file__, str(path.absolute()), str(period)]
            with describe_os_errors(f"file {path}", "written"):
                # A session of its own: Ctrl-C on the terminal is not meant for it.
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
    def waiting(self) -> int:
        """Number of pieces of data that are still in this process."""
        return len(self._waiting)

    def add(self, data: bytes) -> None:
        """Append data, unless writing has stopped."""
        if self.stopped:
            return
        self._waiting.append(data)
        try:
            if self._writer is None:
                self._write()
            else:
                self._hand_over()
        except OSError as error:
            self._stop(error)

    def _write(self) -> None:
        data = b"".join(self._waiting)
        self._waiting.clear()
        if data and self._file is None:
            self._file = self.path.open("wb", buffering=0)
        while data and self._file is not None:
            data = data[self._file.write(data) or 0 :]

    def _hand_over(self) -> None:
        """Give the writer what the pipe takes."""
        while self._waiting:
            data = self._waiting[0]
            try:
                rest = data[os.write(self._pipe, data) :]
            except BlockingIOError:
                return
            if rest:
                self._waiting[0] = rest
            else:
                self._waiting.popleft()

    def _stop(self, error: OSError) -> None:
        """Keep why writing failed: the writer's error, if it has ended."""
        text = ""
        if isinstance(error, BrokenPipeError) and self._writer is not None and self._writer.stdout is not None:
            text = self._writer.stdout.read().decode(errors="replace") or "its process has ended"
        self.stopped = self.stopped or text or error.strerror or str(error)
        self._waiting.clear()

    def close(self) -> None:
        """Write the rest and close the file; wait for the disk no longer than `PATIENCE`."""
        try:
            if self._file is not None:
                self._file.close()
            if self._writer is not None:
                self._close(self._writer, time.monotonic() + PATIENCE)
        except subprocess.TimeoutExpired:
            self.stopped = self.stopped or "the disk does not answer"
        except OSError as error:  # some file systems report a full disk only here
            self._stop(error)

    def _close(self, writer: subprocess.Popen[bytes], end: float) -> None:
        assert writer.stdin is not None
        assert writer.stdout is not None
        while self._waiting and time.monotonic() < end:
            select.select([], [self._pipe], [], max(end - time.monotonic(), 0.0))
            self._hand_over()
        writer.stdin.close()
        if writer.wait(max(end - time.monotonic(), 0.0)):
            raise BrokenPipeError
        writer.stdout.close()
