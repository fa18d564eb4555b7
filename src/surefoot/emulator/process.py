"""The emulator's loop: a board moved by the computer's clock, or in lockstep by the times in the frames."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from surefoot.deploy.wire.frames import Decoder
from surefoot.deploy.wire.messages import Codec
from surefoot.emulator.board import Board
from surefoot.emulator.lockstep_time import LockstepTime
from surefoot.emulator.pty_port import PtyPort
from surefoot.emulator.signals import microseconds

BEHIND = 10_000
"""Lag of the physics [us] from which on it is told."""
SLIP = 50_000
"""Lag [us] beyond which robot time is let slip instead of being caught up."""
_TELL_EVERY = 1.0
_IDLE = 0.05
_LOOK = 0.005
"""Time [s] between two looks whether a host has opened the port, in lockstep."""
_PIECE = 10_000
"""Robot time [us] that passes at once while nobody has the port open, in lockstep."""
_PATIENCE = 2.0
_BREATH = 1e-3
"""Pause [s] when robot time slips: a process that may run before all others must not keep the processor."""


@dataclass
class Summary:
    """What happened while the emulator ran."""

    robot_time: float = 0.0
    """Time on the robot's clock [s]."""
    real_time: float = 0.0
    """Time on the wall [s]."""
    processor_time: float = 0.0
    """Time that the process used the processor [s]."""
    behind: int = 0
    """How often the physics fell behind by more than `BEHIND`."""
    slips: int = 0
    """How often robot time was let slip."""
    slipped: float = 0.0
    """By how much in all [s]."""
    worst: float = 0.0
    """Largest lag [s]."""
    stop: bool = field(default=False, repr=False)
    """Set from outside to end the loop."""

    def text(self, board: Board, port: PtyPort) -> str:
        """One line for the end."""
        counts, firmware = board.firmware.decoder.counts, board.firmware
        share = self.processor_time / self.real_time if self.real_time > 0 else 0.0
        words = [
            f"{self.robot_time:.3f} s of robot time in {self.real_time:.1f} s",
            f"{100 * share:.0f} % of a processor",
            f"behind {self.behind} times (by {1e3 * self.worst:.1f} ms at worst)",
            f"slipped {self.slips} times ({self.slipped:.3f} s)",
            f"frames heard {counts.frames}, damaged {counts.damaged}, foreign {counts.foreign}",
            f"repeated {firmware.watch.old_numbers}, stale {firmware.stale}, not read {port.unread}",
            f"mode {firmware.mode.name}, reason {firmware.reason.name}",
        ]
        return "; ".join(words)


class RealTime:
    """Moves a board by the computer's monotonic clock, sleeping in between.

    Args:
        board: the robot.
        port: where its line ends.
        summary: kept up to date; its `stop` ends the loop.
        load: times of real time that the physics takes at least; 0: as it comes.
        tell: takes a line for the user.
    """

    def __init__(
        self,
        board: Board,
        port: PtyPort,
        summary: Summary,
        load: float = 0.0,
        tell: Callable[[str], None] | None = None,
    ) -> None:
        self._board, self._port, self._summary, self._load = board, port, summary, load
        self._tell = tell or (lambda text: print(text, file=sys.stderr, flush=True))

    def run(self, until: float | None = None) -> None:
        """Run until so much robot time [s] has passed, or until stopped."""
        board, port, summary = self._board, self._port, self._summary
        started, used = time.monotonic(), time.process_time()
        start = started - board.now / 1e6
        told, used_then, then = -_TELL_EVERY, used, started
        end = None if until is None else round(until * 1e6)
        late = readable = False
        while not summary.stop and (end is None or board.now < end):
            now = int((time.monotonic() - start) * 1e6)
            lag = now - board.next_step
            summary.worst = max(summary.worst, lag / 1e6)
            if lag > BEHIND:
                summary.behind += not late
                real = time.monotonic()
                if real - started - told >= _TELL_EVERY:
                    share = (time.process_time() - used_then) / max(real - then, 1e-3)
                    self._tell(
                        f"surefoot: the emulator is {lag / 1e3:.0f} ms behind real time "
                        f"(it used {100 * share:.0f} % of a processor since)"
                    )
                    told, used_then, then = real - started, time.process_time(), real
            late = lag > BEHIND
            if lag > SLIP:
                summary.slips += 1
                summary.slipped += lag / 1e6
                start += lag / 1e6
                now -= lag
                time.sleep(_BREATH)
            if readable and (data := port.read()):
                board.hear(max(now, board.now), data)
            target = now if end is None else min(now, end)
            # At most a few steps before the port is looked at again, or what comes would be stamped too late.
            target = min(target, board.next_step + 4_000)
            before = board.plant.ticks
            board.run_to(max(target, board.now))
            if self._load:
                time.sleep(self._load * 1e-3 * (board.plant.ticks - before))
            if said := board.said():
                port.write(said)
            left = board.next_time / 1e6 - (time.monotonic() - start)
            readable = port.wait(left)
        summary.robot_time = board.now / 1e6
        summary.real_time = time.monotonic() - started
        summary.processor_time = time.process_time() - used


class Lockstep:
    """Moves a board by the times in the frames that come: see `LockstepTime`.

    A frame's time comes first: the robot runs as far, and says what there is to say, before it hears the frame. So who
    sends a ping and has its pong, has all that the robot said until then.

    A host that dies sends no frames any more, and time would stand still: the robot would stay armed, and be its
    operator's, for good. So when the last host has closed the port, time goes on by itself until another operator may
    have the robot. A host that is only slow keeps its port open, and its robot.

    Args:
        board: the robot; its line takes no time.
        port: where its line ends; it must not be held.
        summary: kept up to date; its `stop` ends the loop.
    """

    def __init__(self, board: Board, port: PtyPort, summary: Summary) -> None:
        self._board, self._port, self._summary = board, port, summary
        self._time = LockstepTime()
        self._clock = Decoder(Codec(board.codec.motors))
        self._open = bytearray()

    def run(self, until: float | None = None) -> None:
        """Run until so much robot time [s] has passed, or until stopped."""
        board, port, summary = self._board, self._port, self._summary
        started, used = time.monotonic(), time.process_time()
        end = None if until is None else round(until * 1e6)
        while not summary.stop and (end is None or board.now < end):
            if port.deserted():
                self._pass_time_alone()
                time.sleep(_LOOK)  # there is nothing to wait for that would wake us up
            elif port.wait(_IDLE) and (data := port.read()):
                self._hear(data)
        summary.robot_time = board.now / 1e6
        summary.real_time = time.monotonic() - started
        summary.processor_time = time.process_time() - used

    def _pass_time_alone(self) -> None:
        """Let robot time go on until another operator may have the robot; nobody hears what it says meanwhile."""
        board = self._board
        while board.firmware.is_taken(board.now) and not self._summary.stop:
            self._time.now = board.now + _PIECE
            board.run_to(self._time.now)
            board.said()

    def _hear(self, data: bytes) -> None:
        """Take bytes up to each zero, one after another; those that complete a frame first move time."""
        board = self._board
        self._open += data
        while (end := self._open.find(0)) >= 0 and not self._summary.stop:
            piece = bytes(self._open[: end + 1])
            del self._open[: end + 1]
            for frame in self._clock.feed(piece):
                session = getattr(frame.message, "session", 0)
                firmware = board.firmware
                if not firmware.armed or session in (0, firmware.owner):
                    # Frames of a stranger must not make an armed robot miss its operator's commands.
                    board.run_to(self._time.follow(microseconds(frame.time), session, firmware.owner))
            board.hear(board.now, piece)
            board.run_to(board.now)
            if said := board.said():
                self._port.write(said, _PATIENCE)
