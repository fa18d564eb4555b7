"""Link over a serial line: numbered COBS frames through a non-blocking port."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Protocol

from surefoot.deploy.clock import Clock, LockstepClock
from surefoot.deploy.messages import Bye, Handshake, Hello, Message, Packet, Ping, Pong, Position, Pwm
from surefoot.deploy.robot_link import STATE_PERIOD, ReceivedPacket, RobotLink
from surefoot.deploy.serial.codec import VERSION, Codec
from surefoot.deploy.serial.frames import Decoder, encode_frame
from surefoot.errors import SurefootError

LEAD = 0.005
"""Time from the sending of a state to the control step that uses it [s].

At 921,600 baud a command for 8 motors takes 0.6 ms and a state 1.7 ms; the policy takes 0.5 ms. A step of a steered
policy with 12 motors takes 1 to 2 ms on a busy computer, without the line. The rest is a margin: a state that arrives
too late is a whole control step older, a state that arrives too early only a millisecond or two."""
_PING_TIMEOUTS = (0.05, 0.15, 0.5, 1.3, 3.0)
"""Timeouts in real time after which a ping is repeated, and the last one after which it has failed [s]. A robot in
lockstep answers within a few milliseconds, unless the ping or its pong was lost."""


class Port(Protocol):
    """Non-blocking byte stream in both directions, such as `port.SerialPort`."""

    def read(self) -> bytes:
        """Return the bytes that have arrived, possibly none."""

    def write(self, data: bytes) -> int:
        """Write bytes; return how many were accepted."""

    def wait(self, timeout: float) -> None:
        """Wait until data can be read, at most `timeout` [s]."""

    def close(self) -> None:
        """Release the port."""


class SerialLink(RobotLink):
    """Link over a byte stream. Frames with repeated or decreasing sequence numbers are dropped and counted.

    `codec` is for boards with or without an accelerometer; if the robot turns out to be of the other kind, `connect`
    changes it.

    In lockstep, frames are received only while time advances. Otherwise it would depend on chance whether an answer is
    received immediately or one step later. A command is sent together with the ping that advances the time, so that the
    other end wakes up only once.
    """

    advice = "check port, cable and baud rate, and that it is switched on"

    def __init__(self, port: Port, codec: Codec, clock: Clock, session: int | None = None) -> None:
        super().__init__(clock, LEAD, session)
        self.port, self.codec = port, codec
        self.decoder = Decoder(codec, self.statistics)
        self.awaits_handshake = False
        """Whether a handshake is expected; it is accepted with any sequence number."""
        self._sequence = self._last = 0
        self._inbox: list[ReceivedPacket] = []
        self._held, self._unread = b"", b""
        if isinstance(clock, LockstepClock):
            clock.follow = self._follow

    @property
    def next_number(self) -> int:
        """Sequence number of the next frame."""
        return self._sequence + 1

    def connect(self, timeout: float = 2.0, state_period: float = STATE_PERIOD) -> Handshake:
        """Start or continue a session, see `RobotLink.connect`, with a board with or without an accelerometer."""
        try:
            return super().connect(timeout, state_period)
        except SurefootError:
            other = Codec(self.codec.motors, not self.codec.accelerometer)
            if self.decoder.foreign != (VERSION, other.schema):
                raise
        # Frames of the other schema are no fault of the link.
        self.codec = self.decoder.codec = other
        self.decoder.foreign, self.statistics.foreign = None, 0
        return super().connect(timeout, state_period)

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
            # The leading zero of the next frame ends the incomplete one.
            self.statistics.unsent += 1

    def receive(self) -> list[ReceivedPacket]:
        """Return all packets that have arrived since the last call, in order, without waiting."""
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
            # The robot may have restarted, and counts from one again. This is allowed once per hello: otherwise a
            # repeated or late handshake would let old states pass.
            self.awaits_handshake, self._last = False, 0
        if packet.sequence <= self._last:
            self.statistics.repeated += 1
            return False
        if packet.sequence > self._last + 1 and self._last:
            self.statistics.missing += packet.sequence - self._last - 1
        self._last = packet.sequence
        return True

    def wait(self, timeout: float) -> None:
        """Wait until data can be received, at most `timeout` [s]."""
        self.port.wait(timeout)

    def await_pong(self, timeouts: Sequence[float] = _PING_TIMEOUTS) -> bool:
        """Send a ping, wait for its pong, and return whether it arrived. Other packets are kept for `receive`.

        A robot that has answered with another protocol before its handshake sends no pong.

        The ping is repeated after each of the `timeouts` [s] but the last. A repetition is the same frame with the same
        sequence number, so sequence numbers do not depend on the robot's response time.
        """
        self._tokens += 1
        token, frame = self._tokens, b""
        for seconds in timeouts:
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
                if self.handshake is None and self.decoder.foreign is not None:
                    return False
        return False

    def _follow(self) -> None:
        if not self.await_pong():
            raise SurefootError("the robot does not answer; lockstep needs an emulator started with --lockstep")

    def protocol_error(self) -> str | None:
        """Return how the protocol of received frames differs from this one, or None."""
        foreign, codec = self.decoder.foreign, self.codec
        if foreign is None:
            return None
        return (
            f"the robot has version {foreign[0]} and schema {foreign[1]:#010x} of the protocol; this surefoot "
            f"has version {VERSION} and schema {codec.schema:#010x} (for {codec.motors} motors): "
            f"build its firmware with python -m surefoot.deploy.serial.c_header --motors {codec.motors}"
        )

    def close(self) -> None:
        """End the session and close the port."""
        try:
            self.send(Bye(self.session))
        finally:
            self.port.close()
