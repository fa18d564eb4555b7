"""Non-blocking port at one end of a socket between two processes on this computer."""

from __future__ import annotations

import select
import socket

from surefoot.deploy.robot_link import LinkLostError
from surefoot.errors import SurefootError

GREETING = b"\0"
"""Byte that a robot at a socket sends to a host that it accepts; it has no meaning between frames."""
_CHUNK = 65_536
_ACCEPT_TIMEOUT = 2.0
"""Maximum time for a robot to accept a host [s]."""


class SocketPort:
    """Port over a stream socket. After the other end was closed, `select` always reports it as readable.

    Args:
        end: the socket.
        name: name of the other end, for errors.
    """

    def __init__(self, end: socket.socket, name: str) -> None:
        self._socket, self._name = end, name
        end.setblocking(False)

    def fileno(self) -> int:
        """Return the file descriptor, so that `select` accepts the port."""
        return self._socket.fileno()

    @property
    def is_open(self) -> bool:
        """Whether this end is open."""
        return self._socket.fileno() >= 0

    def read(self) -> bytes:
        """Return the bytes that have arrived, possibly none, without waiting.

        Raises:
            LinkLostError: the other end was closed, and all its data were read.
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
        """Write bytes without waiting; return how many were accepted.

        Raises:
            LinkLostError: the other end was closed.
        """
        try:
            return self._socket.send(data, socket.MSG_NOSIGNAL)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise LinkLostError(f"{self._name} is gone: {error.strerror}") from error

    def wait(self, timeout: float) -> None:
        """Wait until data can be read, at most `timeout` [s]."""
        select.select([self._socket], [], [], max(timeout, 0.0))

    def close(self) -> None:
        """Close this end."""
        self._socket.close()


def connect(path: str) -> SocketPort:
    """Connect to an emulated robot at a Unix socket.

    Raises:
        SurefootError: no robot listens there, or another program uses it.
    """
    end = socket.socket(socket.AF_UNIX)
    end.settimeout(_ACCEPT_TIMEOUT)
    try:
        end.connect(path)
        accepted = end.recv(1) == GREETING
    except OSError as error:
        end.close()
        raise SurefootError(f"port {path}: can't be opened: {error.strerror or error}") from error
    if not accepted:
        end.close()
        raise SurefootError(f"port {path}: another program uses it; only one operator at a time")
    return SocketPort(end, f"port {path}")
