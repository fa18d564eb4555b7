"""Input of a terminal device (serial port, pseudo-terminal) that never waits for the kernel.

A kernel worker with ordinary priority moves bytes from the device's driver to the buffer of `read`. If `read` finds
nothing, it waits for a worker in progress, even if the file is non-blocking, and so does `poll`: next to busy programs
for up to 16 ms, whatever the caller's priority. Two calls do not wait: the byte count (FIONREAD), and an edge-triggered
epoll, which checks the device only after the worker has signalled it.
"""

from __future__ import annotations

import fcntl
import os
import select
import struct
import termios

_CHUNK = 65_536


class TerminalInput:
    """Input of an open, non-blocking terminal device."""

    def __init__(self, file: int) -> None:
        self._file = file
        self._arrivals = select.epoll()
        self._arrivals.register(file, select.EPOLLIN | select.EPOLLET)

    def count(self) -> int:
        """Return the number of bytes that can be read.

        Raises:
            OSError: the device is gone, or the other end was closed.
        """
        return int(struct.unpack("i", fcntl.ioctl(self._file, termios.FIONREAD, b"\0\0\0\0"))[0])

    def read(self) -> bytes:
        """Return the bytes that have arrived, possibly none.

        Raises:
            OSError: as for `count`.
        """
        parts = []
        while self.count():
            parts.append(os.read(self._file, _CHUNK))
        return b"".join(parts)

    def wait(self, timeout: float) -> bool:
        """Wait until data can be read or the device is gone, at most `timeout` [s]; return whether that happened."""
        try:
            if self.count():
                return True
        except OSError:
            return True
        # `select` has microsecond resolution, `epoll.poll` only milliseconds; the latter resets the edge trigger.
        if not select.select([self._arrivals], [], [], max(timeout, 0.0))[0]:
            return False
        return bool(self._arrivals.poll(0))

    def close(self) -> None:
        """Release the epoll; the device stays open."""
        self._arrivals.close()
