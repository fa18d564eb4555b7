"""Lockstep loop of an emulated board, which follows the times in received frames."""

from __future__ import annotations

import re
import sys
import time

from surefoot.deploy.board.signals import microseconds
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import Decoder
from surefoot.emulator.board import EmulatedBoard
from surefoot.emulator.real_time import Summary, measure
from surefoot.emulator.serial.serial_host_link import HostPort, SerialHostLink

HOST_TIMEOUT = 2.0
"""Maximum time for a host to read data of the robot [s]."""
_WAIT_TIME = 0.05
_POLL_PERIOD = 0.005
"""Period of checks whether a host has opened the port [s]."""
_STRIDE = 10_000
"""Step of robot time while no host has opened the port [us]."""


class LockstepLoop:
    """Advances a board with the times in received frames.

    Before a frame is processed, the robot runs to the time of the frame, and sends all states that are due until then.
    A host that has received the pong of its ping thus has all data that the robot sent before.

    Robot time starts with the first frame. The time of a frame on the robot's clock is its own time plus an offset.
    Frames without a session (pings) and the first operator have the offset of the first frame; the offset of each other
    operator is set such that its first frame arrives at the present time. Decreasing times are ignored.

    When a host dies, no more frames arrive: time would stop, and the robot would stay armed and reserved for this host.
    Therefore time advances while no host has the port open, until another operator may connect. A slow host keeps its
    port open, and thus its robot.

    The link takes no time, the port must not be `held`, and `summary.stop` ends the loop.
    """

    def __init__(self, board: EmulatedBoard, link: SerialHostLink, port: HostPort, summary: Summary) -> None:
        self.board, self._link, self._port, self._summary = board, link, port, summary
        codec = link.frames.codec
        self._decoder = Decoder(Codec(codec.motors, codec.accelerometer))
        self._anonymous: int | None = None
        self._offsets: dict[int, int] = {}

    def run(self, until: float | None = None) -> None:
        """Run for `until` of robot time [s], or until stopped."""
        board, port, summary = self.board, self._port, self._summary
        end = sys.maxsize if until is None else microseconds(until)
        with measure(board, summary):
            while not summary.stop and board.now < end:
                if port.has_no_host():
                    self._pass_time()
                    time.sleep(_POLL_PERIOD)  # `wait` would return immediately
                elif port.wait(_WAIT_TIME) and (data := port.read()):
                    self._receive(data)

    def _pass_time(self) -> None:
        """Advance robot time until another operator may connect; data that the robot sends are lost."""
        board = self.board
        while board.firmware.has_operator(board.now) and not self._summary.stop:
            board.run_to(board.now + _STRIDE)
            self._link.take(board.now)

    def _receive(self, data: bytes) -> None:
        """Process bytes frame by frame; a complete frame first advances the time."""
        board, link = self.board, self._link
        for piece in re.findall(rb"[^\0]*\0|[^\0]+", data):
            if self._summary.stop:
                return
            for packet in self._decoder.feed(piece):
                session = getattr(packet.message, "session", 0)
                if not board.firmware.armed or session in (0, board.firmware.owner):
                    # Frames of another operator must not advance the time of an armed robot: it would miss commands.
                    self._follow(microseconds(packet.time), session)
            link.inbound.send(board.now, piece)
            board.run_to(board.now)
            link.flush(board.now)

    def _follow(self, sent: int, session: int) -> None:
        """Run to the time of a frame on its sender's clock [us]; session 0: none."""
        board = self.board
        if self._anonymous is None:
            self._anonymous = board.now - sent
        if session and session not in self._offsets:
            self._offsets[session] = board.now - sent if self._offsets else self._anonymous
        offset = self._offsets.get(session or board.firmware.owner, self._anonymous)
        board.run_to(max(board.now, sent + offset))
