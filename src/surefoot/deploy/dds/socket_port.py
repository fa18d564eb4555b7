"""One end of a connection between two processes of this computer, as a port that never blocks."""

from __future__ import annotations

import select
import socket

from surefoot.deploy.robot_link import LinkLostError
from surefoot.errors import SurefootError

GREETING = b"\0"
"""What a robot that listens at a socket writes to a host that it accepts; between frames it means nothing."""
_CHUNK = 65_536
_PATIENCE = 2.0
"""Time [s] that a robot has to accept a host."""


class SocketPort:
    """A stream socket. Once its other end has closed, it is readable for ever.

    Args:
        end: the socket.
        name: what is at its other end, for errors.
    """

    def __init__(self, end: socket.socket, name: str) -> None:
        self._socket, self._name = end, name
        end.setblocking(False)

    def fileno(self) -> int:
        """Return the file descriptor, so that `select` takes the port."""
        return self._socket.fileno()

    @property
    def is_open(self) -> bool:
        """Whether this end was not closed."""
        return self._socket.fileno() >= 0

    def read(self) -> bytes:
        """Return the bytes that have arrived, maybe none; never waits.

        Raises:
            LinkLostError: the other end has closed, and all that it wrote was read.
        """
        try:
            data = self._socket.recv(_CHUNK)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise LinkLostError(f"{self._name} is gone: {error.strerror}") from error
        if not data:
            raise LinkLostError(f"{self._name} is gone")
        return data

    def write(self, data: bytes) -> int:
        """Write bytes; never waits. Return how many the socket took.

        Raises:
            LinkLostError: the other end has closed.
        """
        try:
            return self._socket.send(data, socket.MSG_NOSIGNAL)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise LinkLostError(f"{self._name} is gone: {error.strerror}") from error

    def wait(self, timeout: float) -> None:
        """Wait until something can be read, at most `timeout` [s]."""
        select.select([self._socket], [], [], max(timeout, 0.0))

    def close(self) -> None:
        """Close this end."""
        self._socket.close()


def connect(path: str) -> SocketPort:
    """Connect to a robot that listens at a Unix socket: an emulated one.

    Raises:
        SurefootError: none listens there, or another program has it.
    """
    end = socket.socket(socket.AF_UNIX)
    end.settimeout(_PATIENCE)
    try:
        end.connect(path)
        accepted = end.recv(1) == GREETING
    except OSError as error:
        end.close()
        raise SurefootError(f"port {path}: can't be opened: {error.strerror or error}") from error
    if not accepted:
        end.close()
        raise SurefootError(f"port {path}: another program has it; one operator at a time")
    return SocketPort(end, f"port {path}")
