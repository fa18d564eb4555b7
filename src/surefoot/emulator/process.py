"""The emulator's loop: a board moved by the computer's clock, or in lockstep by the times in the frames."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import MAX_FRAME, Decoder
from surefoot.emulator.board import Board
from surefoot.emulator.pty_port import PtyPort
from surefoot.emulator.signals import microseconds

BEHIND = 10_000
"""Lag of the physics [us] from which on it is reported."""
SLIP = 50_000
"""Lag [us] beyond which robot time slips instead of catching up."""
_REPORT_EVERY = 1.0
_IDLE = 0.05
_LOOK = 0.005
"""Time [s] between two checks whether a host has opened the port, in lockstep."""
_PIECE = 10_000
"""Robot time [us] that passes at once while nobody has the port open, in lockstep."""
_PATIENCE = 2.0
_BREATH = 1e-3
"""Pause [s] when robot time slips: a process that has priority over all others must not keep the processor."""


@dataclass
class Summary:
    """What happened while the emulator ran."""

    robot_time: float = 0.0
    """Time on the robot's clock [s]."""
    real_time: float = 0.0
    """Time on the computer's clock [s]."""
    processor_time: float = 0.0
    """Processor time of the process [s]."""
    behind: int = 0
    """How often the physics fell behind by more than `BEHIND`."""
    slips: int = 0
    """How often robot time slipped."""
    slipped: float = 0.0
    """By how much in total [s]."""
    worst: float = 0.0
    """Largest lag [s]."""
    stop: bool = field(default=False, repr=False)
    """Set from outside to end the loop."""

    def text(self, board: Board, port: PtyPort) -> str:
        """Return one line for the end."""
        counts, firmware = board.firmware.decoder.statistics, board.firmware
        share = self.processor_time / self.real_time if self.real_time > 0 else 0.0
        words = [
            f"{self.robot_time:.3f} s of robot time in {self.real_time:.1f} s",
            f"{100 * share:.0f} % of a processor",
            f"behind {self.behind} times (by {1e3 * self.worst:.1f} ms at worst)",
            f"slipped {self.slips} times ({self.slipped:.3f} s)",
            f"frames heard {counts.received}, damaged {counts.damaged}, foreign {counts.foreign}",
            f"repeated {firmware.watch.old_numbers}, stale {firmware.stale}, not read {port.unread}",
            f"mode {firmware.mode.name}, reason {firmware.reason.name}",
        ]
        return "; ".join(words)


@contextmanager
def _measured(board: Board, summary: Summary) -> Iterator[None]:
    started, used = time.monotonic(), time.process_time()
    yield
    summary.robot_time = board.now / 1e6
    summary.real_time = time.monotonic() - started
    summary.processor_time = time.process_time() - used


class RealTime:
    """Moves a board by the computer's monotonic clock, and sleeps in between.

    Args:
        board: the robot.
        port: where its line ends.
        summary: kept up to date; its `stop` ends the loop.
        load: least time that the physics takes, in multiples of real time; 0: no minimum.
    """

    def __init__(self, board: Board, port: PtyPort, summary: Summary, load: float = 0.0) -> None:
        self._board, self._port, self._summary, self._load = board, port, summary, load
        self._next_report = -math.inf
        self._since = 0.0, 0.0

    def run(self, until: float | None = None) -> None:
        """Run until so much robot time [s] has passed, or until stopped."""
        board, port, summary = self._board, self._port, self._summary
        self._since = time.monotonic(), time.process_time()
        start = self._since[0] - board.now / 1e6
        end = sys.maxsize if until is None else microseconds(until)
        late = readable = False
        with _measured(board, summary):
            while not summary.stop and board.now < end:
                now = int((time.monotonic() - start) * 1e6)
                lag = now - board.next_step
                summary.worst = max(summary.worst, lag / 1e6)
                if lag > BEHIND:
                    summary.behind += not late
                    self._report(lag)
                late = lag > BEHIND
                if lag > SLIP:
                    summary.slips += 1
                    summary.slipped += lag / 1e6
                    start += lag / 1e6
                    now -= lag
                    time.sleep(_BREATH)
                if readable and (data := port.read()):
                    board.hear(max(now, board.now), data)
                # At most a few steps before the port is read again, or what arrives would be stamped too late.
                target = min(now, end, board.next_step + 4_000)
                before = board.plant.ticks
                board.run_to(max(target, board.now))
                if self._load:
                    time.sleep(self._load * 1e-3 * (board.plant.ticks - before))
                if said := board.said():
                    port.write(said)
                readable = port.wait(board.next_time / 1e6 - (time.monotonic() - start))

    def _report(self, lag: int) -> None:
        """Print that physics lags, at most once per `_REPORT_EVERY`."""
        real, used = time.monotonic(), time.process_time()
        if real < self._next_report:
            return
        share = (used - self._since[1]) / max(real - self._since[0], 1e-3)
        print(
            f"surefoot: the emulator is {lag / 1e3:.0f} ms behind real time "
            f"(it used {100 * share:.0f} % of a processor since)",
            file=sys.stderr,
            flush=True,
        )
        self._next_report, self._since = real + _REPORT_EVERY, (real, used)


class Lockstep:
    """Moves a board by the times in the frames that arrive.

    Before it hears a frame, the robot runs to the frame's time and sends what is due until then. So a host that has the
    pong of its ping has all that the robot sent until then.

    Robot time begins with the first frame. A frame's time on the robot's clock is its own plus an offset. The frames
    that name no session (pings) have the offset of the first frame, and so has the first operator; the clock of any
    other operator is set to the present when it is first seen. A time that goes back leaves the robot's as it is.

    A host that dies sends no more frames: time would stand still, and the robot would stay armed and owned for good. So
    when the last host has closed the port, time goes on by itself until another operator may take the robot. A host
    that is only slow keeps its port open, and its robot.

    Args:
        board: the robot; its line takes no time.
        port: where its line ends; it must not be held.
        summary: kept up to date; its `stop` ends the loop.
    """

    def __init__(self, board: Board, port: PtyPort, summary: Summary) -> None:
        self._board, self._port, self._summary = board, port, summary
        self._decoder = Decoder(Codec(board.codec.motors))
        self._open = bytearray()
        self._anonymous: int | None = None
        self._offsets: dict[int, int] = {}

    def run(self, until: float | None = None) -> None:
        """Run until so much robot time [s] has passed, or until stopped."""
        board, port, summary = self._board, self._port, self._summary
        end = sys.maxsize if until is None else microseconds(until)
        with _measured(board, summary):
            while not summary.stop and board.now < end:
                if port.deserted():
                    self._pass_time_alone()
                    time.sleep(_LOOK)  # nothing to wait for would wake the process
                elif port.wait(_IDLE) and (data := port.read()):
                    self._hear(data)

    def _pass_time_alone(self) -> None:
        """Let robot time go on until another operator may take the robot; what it says meanwhile is lost."""
        board = self._board
        while board.firmware.is_taken(board.now) and not self._summary.stop:
            board.run_to(board.now + _PIECE)
            board.said()

    def _hear(self, data: bytes) -> None:
        """Take bytes up to each zero, one after another; those that complete a frame first advance time."""
        board = self._board
        self._open += data
        while not self._summary.stop:
            end = self._open.find(0) + 1
            if not end and len(self._open) <= MAX_FRAME:
                return
            # So many bytes without a zero are no frame: they are damage for the decoder to count, not to keep.
            piece = bytes(self._open[: end or MAX_FRAME])
            del self._open[: len(piece)]
            for frame in self._decoder.feed(piece):
                session = getattr(frame.message, "session", 0)
                if not board.firmware.armed or session in (0, board.firmware.owner):
                    # Frames of another operator must not make an armed robot miss its operator's commands.
                    self._follow(microseconds(frame.time), session)
            board.hear(board.now, piece)
            board.run_to(board.now)
            if said := board.said():
                self._port.write(said, _PATIENCE)

    def _follow(self, sent: int, session: int) -> None:
        """Run to a frame's time [us] on its sender's clock; session 0: none."""
        board = self._board
        if self._anonymous is None:
            self._anonymous = board.now - sent
        if session and session not in self._offsets:
            self._offsets[session] = board.now - sent if self._offsets else self._anonymous
        offset = self._offsets.get(session or board.firmware.owner, self._anonymous)
        board.run_to(max(board.now, sent + offset))
