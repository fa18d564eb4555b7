"""The link: messages out and in over a port that never blocks, with everything counted."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from surefoot.deploy.clock import Clock, LockstepClock
from surefoot.deploy.messages import Handshake, Message, Ping, Pong, Position, Pwm
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import Decoder, Frame, encode_frame
from surefoot.deploy.serial.port import SerialPort


@dataclass(frozen=True)
class Arrival:
    """A frame, and when it was read [s], on this computer's clock."""

    frame: Frame
    time: float


@dataclass
class LinkCounts:
    """What went over the link, frames damaged on the way aside: `Link.decoder.counts` has those."""

    sent: int = 0
    """Frames sent; one that is sent again counts once."""
    unsent: int = 0
    """Frames that the port did not take."""
    repeated: int = 0
    """Frames dropped because their number was not above the last one's."""
    missing: int = 0
    """Numbers left out between frames that came."""


class Link:
    """Messages over a port. Frames whose numbers go backward or repeat are dropped and counted.

    In lockstep what comes is taken where time goes on, never before: otherwise it would be chance whether the answer
    to a message is seen at once or a step later. Nor do commands go before the ping that lets time go on, in one piece
    with it: two pieces would wake the other end twice.

    Args:
        port: the line.
        codec: of the robot.
        clock: stamps what is sent and received; in lockstep the other end follows it.
    """

    def __init__(self, port: SerialPort, codec: Codec, clock: Clock) -> None:
        self.port, self.codec, self.clock = port, codec, clock
        self.decoder = Decoder(codec)
        self.counts = LinkCounts()
        self.greeted = 0
        """Session whose handshake is waited for; 0: none. It is the one frame that is taken whatever its number."""
        self._sequence = 0
        self._last = 0
        self._inbox: list[Arrival] = []
        self._tokens = 0
        self._held, self._unread = b"", b""
        self._lockstep = isinstance(clock, LockstepClock)
        if isinstance(clock, LockstepClock):
            clock.ping_through = self.ping_through

    def send(self, message: Message) -> int:
        """Send a message; returns the number of its frame."""
        self._send(message)
        return self._sequence

    def _send(self, message: Message) -> bytes:
        """Send a message; returns its frame."""
        self._sequence += 1
        data = encode_frame(self.codec, message, self._sequence, self.clock.now())
        self.counts.sent += 1
        if self._lockstep and isinstance(message, Position | Pwm):
            self._held += data
        else:
            self._write(data)
        return data

    def _write(self, data: bytes) -> None:
        data, self._held = self._held + data, b""
        if self.port.write(data) < len(data):
            # Half a frame is no frame; the zero in front of the next one ends it.
            self.counts.unsent += 1

    def receive(self) -> list[Arrival]:
        """All frames that have come since, in order; never waits."""
        if self._lockstep:
            self._unread += self.port.read()
        else:
            self._gather()
        arrivals, self._inbox = self._inbox, []
        return arrivals

    def _gather(self) -> list[Arrival]:
        data, now = self._unread + self.port.read(), self.clock.now()
        self._unread = b""
        found = [Arrival(frame, now) for frame in self.decoder.feed(data) if self._is_next(frame)]
        self._inbox += found
        return found

    def _is_next(self, frame: Frame) -> bool:
        message = frame.message
        if self.greeted and isinstance(message, Handshake) and message.session == self.greeted:
            # The robot may have been switched on anew, and counts from one again. Only once: were each handshake taken
            # so, one that came twice or late would let old states in.
            self.greeted, self._last = 0, 0
        if frame.sequence <= self._last:
            self.counts.repeated += 1
            return False
        if frame.sequence > self._last + 1 and self._last:
            self.counts.missing += frame.sequence - self._last - 1
        self._last = frame.sequence
        return True

    def ping(self) -> int:
        """Send a ping; returns its token."""
        self._tokens += 1
        self.send(Ping(self._tokens))
        return self._tokens

    def ping_through(self, patience: Sequence[float]) -> bool:
        """Send a ping and wait for its pong, whatever else comes before it is kept; return whether it came.

        Args:
            patience: seconds of real time to wait before the ping is sent again, and at last given up. It is the same
                frame each time: how quick the other end is leaves no trace in the numbers of frames.
        """
        self._tokens += 1
        token, frame = self._tokens, b""
        for seconds in patience:
            if frame:
                self._write(frame)
            else:
                frame = self._send(Ping(token))
            end = time.monotonic() + seconds
            while (left := end - time.monotonic()) > 0:
                self.port.wait(left)
                for arrival in self._gather():
                    message = arrival.frame.message
                    if isinstance(message, Pong) and message.token == token:
                        return True
        return False

    def close(self) -> None:
        """Give the port back."""
        try:
            if self._held:
                self._write(b"")
        finally:
            self.port.close()
