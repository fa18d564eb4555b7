"""A link over a serial line: COBS frames, numbered, through a port that never blocks."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Protocol

from surefoot.deploy.clock import Clock, LockstepClock
from surefoot.deploy.messages import Bye, Handshake, Hello, Message, Packet, Ping, Pong, Position, Pwm
from surefoot.deploy.robot_link import ReceivedPacket, RobotLink
from surefoot.deploy.serial.codec import VERSION, Codec
from surefoot.deploy.serial.frames import Decoder, encode_frame
from surefoot.errors import SurefootError

LEAD = 0.005
"""Time [s] between a state's sending and the control step that uses it.

At 921,600 baud a command of 8 motors takes 0.6 ms and a state 1.7 ms; the policy takes 0.5 ms. Without a line, a step
of a steered policy with 12 motors takes 1 to 2 ms on a busy computer. The rest is a margin: a state that arrives too
late is a whole control step older, one that arrives too early a millisecond or two."""
_PATIENCE = (0.05, 0.15, 0.5, 1.3, 3.0)
"""Real time [s] after which a ping is sent again, and at last given up. A robot in lockstep answers within a few
milliseconds, unless the line lost the ping or its pong."""


class Port(Protocol):
    """Bytes in and out, without ever blocking; see `port.SerialPort`."""

    def read(self) -> bytes:
        """Return the bytes that have arrived, maybe none."""

    def write(self, data: bytes) -> int:
        """Write bytes; return how many were taken."""

    def wait(self, timeout: float) -> None:
        """Wait until something can be read, at most `timeout` [s]."""

    def close(self) -> None:
        """Release the port."""


class SerialLink(RobotLink):
    """A link over a port that carries bytes. Frames whose numbers repeat or decrease are dropped and counted.

    In lockstep, frames are received only where time passes: otherwise chance would decide whether the answer to a
    message is seen at once or a step later. Commands are sent in one piece with the ping that lets time pass: two
    pieces would wake the other end twice.
    """

    advice = "check port, cable and baud rate, and that it is switched on"

    def __init__(self, port: Port, codec: Codec, clock: Clock, session: int | None = None) -> None:
        super().__init__(clock, LEAD, session)
        self.port, self.codec = port, codec
        self.decoder = Decoder(codec, self.statistics)
        self.awaits_handshake = False
        """Whether the session's handshake is awaited. It is the one frame that is taken whatever its number."""
        self._sequence = self._last = 0
        self._inbox: list[ReceivedPacket] = []
        self._held, self._unread = b"", b""
        if isinstance(clock, LockstepClock):
            clock.follow = self._follow

    @property
    def next_number(self) -> int:
        """Number of the next frame."""
        return self._sequence + 1

    def send(self, message: Message) -> bytes:
        """Send a message; return its frame."""
        self._sequence += 1
        data = encode_frame(self.codec, message, self._sequence, self.clock.now())
        self.statistics.sent += 1
        if isinstance(message, Hello):
            self.awaits_handshake = True
        if self.lockstep and isinstance(message, Position | Pwm):
            self._held += data
        else:
            self._write(data)
        return data

    def _write(self, data: bytes) -> None:
        data, self._held = self._held + data, b""
        if self.port.write(data) < len(data):
            # Half a frame is no frame; the zero in front of the next one ends it.
            self.statistics.unsent += 1

    def receive(self) -> list[ReceivedPacket]:
        """Return all packets that have come since, in order; never waits."""
        if self.lockstep:
            self._unread += self.port.read()
        else:
            self._gather()
        arrivals, self._inbox = self._inbox, []
        return arrivals

    def _gather(self) -> list[ReceivedPacket]:
        data, now = self._unread + self.port.read(), self.clock.now()
        self._unread = b""
        arrivals = [ReceivedPacket(packet, now) for packet in self.decoder.feed(data) if self._is_next(packet)]
        self._inbox += arrivals
        return arrivals

    def _is_next(self, packet: Packet) -> bool:
        message = packet.message
        if self.awaits_handshake and isinstance(message, Handshake) and message.session == self.session:
            # The robot may have been switched on anew, and counts from one again. Only once: were each handshake taken
            # so, one that came twice or late would let old states in.
            self.awaits_handshake, self._last = False, 0
        if packet.sequence <= self._last:
            self.statistics.repeated += 1
            return False
        if packet.sequence > self._last + 1 and self._last:
            self.statistics.missing += packet.sequence - self._last - 1
        self._last = packet.sequence
        return True

    def wait(self, timeout: float) -> None:
        """Wait until something can be received, at most `timeout` [s]."""
        self.port.wait(timeout)

    def await_pong(self, patience: Sequence[float] = _PATIENCE) -> bool:
        """Send a ping, wait for its pong, and return whether it arrived. Other packets are kept for `receive`.

        The ping is repeated after each of the timeouts `patience` [s]. A repetition is the same frame with the same
        sequence number, so sequence numbers do not depend on the robot's response time.
        """
        self._tokens += 1
        token, frame = self._tokens, b""
        for seconds in patience:
            if frame:
                self._write(frame)
            else:
                frame = self.send(Ping(token))
            end = time.monotonic() + seconds
            while (left := end - time.monotonic()) > 0:
                self.port.wait(left)
                for arrival in self._gather():
                    message = arrival.packet.message
                    if isinstance(message, Pong) and message.token == token:
                        return True
        return False

    def _follow(self) -> None:
        if not self.await_pong():
            raise SurefootError("the robot does not answer; a clock in lockstep needs an emulator run with --lockstep")

    def protocol_error(self) -> str | None:
        """Return how the protocol of what was received differs from this one; None if it does not."""
        foreign, codec = self.decoder.foreign, self.codec
        if foreign is None:
            return None
        return (
            f"the robot has version {foreign[0]} and schema {foreign[1]:#010x} of the protocol; this surefoot "
            f"has version {VERSION} and schema {codec.schema:#010x} (for {codec.motors} motors): "
            f"build its firmware with python -m surefoot.deploy.serial.c_header --motors {codec.motors}"
        )

    def close(self) -> None:
        """End the session and give the port back."""
        try:
            self.send(Bye(self.session))
        finally:
            self.port.close()
