"""UDP channels on the loopback address, by which other programs on this computer send JSON to a deployment."""

from __future__ import annotations

import contextlib
import json
import math
import socket
import time
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from surefoot.errors import SurefootError

_MAX_DATAGRAMS = 64
"""Maximum number of datagrams per read."""
_MAX_WAITING = 10_000
"""Maximum number of datagrams that are discarded, more than a socket holds: a flood must not block."""
_ADDRESS = "127.0.0.1"

T = TypeVar("T")


class Channel(Generic[T]):
    """Receives the newest message of another program.

    Args:
        what: name of the option, for errors.
        port: port to listen on; 0 lets the system choose one.
        parse: returns the message in the JSON value of a datagram, or None if it is invalid.
        max_bytes: maximum size of a datagram [bytes].
        clock: returns the time that determines the age of messages [s].

    Raises:
        SurefootError: the port is in use.
    """

    def __init__(
        self,
        what: str,
        port: int,
        parse: Callable[[Any], T | None],
        max_bytes: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._parse, self._max_bytes, self._received = parse, max_bytes, -math.inf
        self.clock = clock
        """Returns the time that determines the age of messages [s]."""
        self.newest: T | None = None
        """Newest message at the last `receive`; None before the first one."""
        self.rejected = 0
        """Number of invalid datagrams."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((_ADDRESS, port))
        except OSError as error:
            self._socket.close()
            raise SurefootError(f"{what}: port {port} can't be listened on: {error.strerror}") from error
        self._socket.setblocking(False)
        self.port = int(self._socket.getsockname()[1])

    def receive(self) -> float:
        """Read the datagrams that have arrived, without waiting; return the age of the newest message [s]."""
        for _ in range(_MAX_DATAGRAMS):
            try:
                data = self._socket.recv(self._max_bytes + 1)
            except OSError:
                break
            message = self._message(data)
            if message is None:
                self.rejected += 1
            else:
                self.newest, self._received = message, self.clock()
        return self.clock() - self._received

    def discard(self) -> None:
        """Forget all messages so far: nobody knows when those that wait unread have arrived."""
        with contextlib.suppress(OSError):
            for _ in range(_MAX_WAITING):
                self._socket.recv(self._max_bytes + 1)
        self.newest, self._received = None, -math.inf

    def _message(self, data: bytes) -> T | None:
        if len(data) > self._max_bytes:
            return None
        try:
            return self._parse(json.loads(data))
        except (ValueError, RecursionError):
            return None

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()


def send(port: int, message: dict[str, Any]) -> None:
    """Send a message to a channel on this computer; it is lost if no program listens."""
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender:
        sender.sendto(json.dumps(message).encode(), (_ADDRESS, port))
