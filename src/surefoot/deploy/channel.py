"""Channels: JSON datagrams by which other programs send to a deployment, on this computer (UDP, loopback address)."""

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
"""Datagrams that are read at a time."""
_ADDRESS = "127.0.0.1"

T = TypeVar("T")


class Channel(Generic[T]):
    """The newest message of another program.

    Args:
        what: is sent, for errors.
        port: to listen on; 0 lets the system choose.
        parse: returns the message of a datagram's JSON, None if it is none.
        max_bytes: length of the longest datagram.
        clock: gives the time [s] by which messages age.

    Raises:
        SurefootError: the port is taken.
    """

    def __init__(
        self,
        what: str,
        port: int,
        parse: Callable[[Any], T | None],
        max_bytes: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._parse, self._max_bytes, self._clock, self._received = parse, max_bytes, clock, -math.inf
        self.newest: T | None = None
        """The newest message, as of the last `receive`."""
        self.refused = 0
        """Datagrams that were no messages."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((_ADDRESS, port))
        except OSError as error:
            self._socket.close()
            raise SurefootError(f"{what}: port {port} can't be listened on: {error.strerror}") from error
        self._socket.setblocking(False)
        self.port = int(self._socket.getsockname()[1])

    def receive(self) -> float:
        """Take what has arrived, at once; return the time since the newest message came [s]."""
        for _ in range(_MAX_DATAGRAMS):
            try:
                data = self._socket.recv(self._max_bytes + 1)
            except OSError:
                break
            message = self._message(data)
            if message is None:
                self.refused += 1
            else:
                self.newest, self._received = message, self._clock()
        return self._clock() - self._received

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
    """Send a message to a channel on this computer, whether or not somebody listens."""
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender:
        sender.sendto(json.dumps(message).encode(), (_ADDRESS, port))
