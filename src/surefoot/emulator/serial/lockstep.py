"""The emulator in lockstep: a board that follows the times in the frames that arrive."""

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

PATIENCE = 2.0
"""Time [s] that a host has to read what the robot sends."""
_WAIT_TIME = 0.05
_POLL_PERIOD = 0.005
"""Time [s] between two checks whether a host has opened the port."""
_STRIDE = 10_000
"""Robot time [us] that passes at once while nobody has the port open."""


class LockstepLoop:
    """Advances a board by the times in the frames that arrive.

    Before a frame is handed over, the robot runs to the frame's time and sends what is due until then. So a host that
    has the pong of its ping has all that the robot sent until then.

    Robot time begins with the first frame. A frame's time on the robot's clock is its own plus an offset. Frames
    without a session (pings) have the offset of the first frame, and so has the first operator; the clock of any other
    operator is set to the present when its first frame arrives. A time that goes back leaves the robot's as it is.

    A host that dies sends no more frames: time would stand still, and the robot would stay armed and owned. So when the
    last host has closed the port, time goes on by itself until another operator may connect. A slow host keeps its port
    open, and its robot.

    The link takes no time, its port must not be held, and `summary.stop` ends the loop.
    """

    def __init__(self, board: EmulatedBoard, link: SerialHostLink, port: HostPort, summary: Summary) -> None:
        self.board, self._link, self._port, self._summary = board, link, port, summary
        self._decoder = Decoder(Codec(link.frames.codec.motors))
        self._anonymous: int | None = None
        self._offsets: dict[int, int] = {}

    def run(self, until: float | None = None) -> None:
        """Run until so much robot time [s] has passed, or until stopped."""
        board, port, summary = self.board, self._port, self._summary
        end = sys.maxsize if until is None else microseconds(until)
        with measure(board, summary):
            while not summary.stop and board.now < end:
                if port.has_no_host():
                    self._pass_time()
                    time.sleep(_POLL_PERIOD)  # nothing to wait for would wake the process
                elif port.wait(_WAIT_TIME) and (data := port.read()):
                    self._receive(data)

    def _pass_time(self) -> None:
        """Let robot time go on until another operator may connect; what the robot sends meanwhile is lost."""
        board = self.board
        while board.firmware.has_operator(board.now) and not self._summary.stop:
            board.run_to(board.now + _STRIDE)
            self._link.take(board.now)

    def _receive(self, data: bytes) -> None:
        """Take bytes up to each zero, one after another; those that complete a frame first advance time."""
        board, link = self.board, self._link
        for piece in re.findall(rb"[^\0]*\0|[^\0]+", data):
            if self._summary.stop:
                return
            for packet in self._decoder.feed(piece):
                session = getattr(packet.message, "session", 0)
                if not board.firmware.armed or session in (0, board.firmware.owner):
                    # Frames of another operator must not make an armed robot miss its operator's commands.
                    self._follow(microseconds(packet.time), session)
            link.inbound.send(board.now, piece)
            board.run_to(board.now)
            link.flush(board.now)

    def _follow(self, sent: int, session: int) -> None:
        """Run to a frame's time [us] on its sender's clock; session 0: none."""
        board = self.board
        if self._anonymous is None:
            self._anonymous = board.now - sent
        if session and session not in self._offsets:
            self._offsets[session] = board.now - sent if self._offsets else self._anonymous
        offset = self._offsets.get(session or board.firmware.owner, self._anonymous)
        board.run_to(max(board.now, sent + offset))
