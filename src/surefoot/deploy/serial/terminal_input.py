"""What has arrived at a terminal device (a serial port, a pseudo-terminal), without ever waiting for the kernel.

A worker of the kernel, with ordinary priority, carries bytes from the device's driver to where `read` finds them. A
`read` that finds nothing, and a `poll` likewise, wait for a worker that is under way, also where the file is
non-blocking: beside busy programs by up to 16 ms, whatever the caller's priority. What is used here waits for nothing:
the count of bytes (FIONREAD), and an edge-triggered epoll, which looks at the device only after the worker woke it.
"""

from __future__ import annotations

import fcntl
import os
import select
import struct
import termios

_CHUNK = 65_536


class TerminalInput:
    """The input of an open, non-blocking terminal device."""

    def __init__(self, file: int) -> None:
        self._file = file
        self._arrivals = select.epoll()
        self._arrivals.register(file, select.EPOLLIN | select.EPOLLET)

    def count(self) -> int:
        """Return how many bytes can be read.

        Raises:
            OSError: the device is gone, or its other end has hung up.
        """
        return int(struct.unpack("i", fcntl.ioctl(self._file, termios.FIONREAD, b"\0\0\0\0"))[0])

    def read(self) -> bytes:
        """Return the bytes that have arrived, maybe none.

        Raises:
            OSError: as `count`.
        """
        parts = []
        while self.count():
            parts.append(os.read(self._file, _CHUNK))
        return b"".join(parts)

    def wait(self, timeout: float) -> bool:
        """Wait until something can be read or the device is gone, at most `timeout` [s]; return whether it is so."""
        try:
            if self.count():
                return True
        except OSError:
            return True
        # `select` takes microseconds, `epoll.poll` whole milliseconds; the latter takes note of what has woken.
        if not select.select([self._arrivals], [], [], max(timeout, 0.0))[0]:
            return False
        return bool(self._arrivals.poll(0))

    def close(self) -> None:
        """Stop waiting; the device stays open."""
        self._arrivals.close()
