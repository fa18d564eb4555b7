"""Robot's end of a Unix socket, which hosts open instead of a serial port.

Bytes of a pseudo-terminal wait for a kernel worker (see `deploy.serial.terminal_input`); bytes of a socket do not.
"""

from __future__ import annotations

import select
import socket
from pathlib import Path

from surefoot.deploy.dds.socket_port import GREETING, SocketPort
from surefoot.deploy.robot_link import LinkLostError
from surefoot.errors import SurefootError


class SocketServerPort:
    """Socket for one host at a time; others are rejected. It blocks only with a timeout.

    Args:
        path: path of the socket; it is removed when the port is closed.

    Raises:
        SurefootError: the path exists, or no socket can be created there.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.unread = str(path), 0
        """Number of frames dropped because the host did not read the earlier ones."""
        self._listener = socket.socket(socket.AF_UNIX)
        if path.is_socket() and self._listener.connect_ex(self.path):
            path.unlink()  # left by an emulator that was killed
        try:
            self._listener.bind(self.path)
        except OSError as error:
            self._listener.close()
            raise SurefootError(f"socket {path}: {error.strerror or error}; give another name") from None
        self._listener.listen(1)
        self._listener.setblocking(False)
        self._host: SocketPort | None = None

    def _accept(self) -> None:
        try:
            end, _ = self._listener.accept()
        except BlockingIOError:
            return
        if self._host is not None:
            end.close()
            return
        self._host = SocketPort(end, "the host")
        self.write(GREETING)

    def has_no_host(self) -> bool:
        """Return whether no host is connected."""
        self._accept()
        return self._host is None

    def read(self) -> bytes:
        """Return the bytes that the host has written."""
        self._accept()
        try:
            return self._host.read() if self._host is not None else b""
        except LinkLostError:
            self._disconnect()
            return b""

    def _disconnect(self) -> None:
        if self._host is not None:
            self._host.close()
            self._host = None

    def wait(self, timeout: float) -> bool:
        """Wait for data, or for a host that connects or leaves, at most `timeout` [s]; return whether one came."""
        files = [self._listener.fileno(), *([self._host.fileno()] if self._host is not None else [])]
        return bool(select.select(files, [], [], max(timeout, 0.0))[0])

    def write(self, data: bytes, patience: float = 0.0) -> None:
        """Write to the host; drop data that it does not read within `patience` [s]."""
        try:
            while data and self._host is not None:
                data = data[self._host.write(data) :]
                if data and (patience <= 0 or not select.select([], [self._host], [], patience)[1]):
                    self.unread += 1
                    return
        except LinkLostError:
            self._disconnect()

    def close(self) -> None:
        """Close the connection, and remove the socket."""
        self._disconnect()
        self._listener.close()
        Path(self.path).unlink(missing_ok=True)
