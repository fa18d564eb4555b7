"""The robot and a small operator that tests of this package share."""

from __future__ import annotations

import os
import select
import threading
import time
import tty
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from processes import Emulator, emulators

from surefoot.deploy.wire.frames import Decoder, Frame, encode_frame
from surefoot.deploy.wire.messages import Codec, Message, Ping, Pong
from surefoot.robot import RobotDescription


class Bytes:
    """One side's encoder and decoder."""

    def __init__(self, motors: int = 8) -> None:
        self.codec = Codec(motors)
        self.decoder = Decoder(self.codec)
        self.number = 0

    def frame(self, message: Message, time: float, number: int | None = None) -> bytes:
        """Encode with the next number, or with a given one that does not count."""
        if number is None:
            self.number = number = self.number + 1
        return encode_frame(self.codec, message, number, time)


class Host:
    """An operator at the other end of a pseudo-terminal."""

    def __init__(self, path: str) -> None:
        self.file = os.open(path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self.file)
        os.set_blocking(self.file, False)
        self.bytes = Bytes()
        self.start = time.monotonic()
        self.token = 0
        self.frames: list[Frame] = []
        """All frames received, oldest first."""

    def close(self) -> None:
        os.close(self.file)

    def now(self) -> float:
        return time.monotonic() - self.start

    def send(self, message: Message, at: float | None = None) -> None:
        os.write(self.file, self.bytes.frame(message, self.now() if at is None else at))

    def look(self, wait: float = 0.0) -> list[Frame]:
        """Wait for something, at most so long, and return what has arrived."""
        if wait > 0:
            select.select([self.file], [], [], wait)
        try:
            found = self.bytes.decoder.feed(os.read(self.file, 65536))
        except BlockingIOError:
            found = []
        self.frames += found
        return found

    def of(self, kind: type[Any], condition: Callable[[Any], bool] = lambda message: True) -> Frame:
        """Return the first frame to arrive of a kind for which a condition holds."""
        end = time.monotonic() + 20.0
        while time.monotonic() < end:
            for frame in self.look(0.05):
                if isinstance(frame.message, kind) and condition(frame.message):
                    return frame
        raise AssertionError(f"no such frame; last {self.frames[-3:]}")

    def run_to(self, at: float, kind: type[Message] = Message) -> list[Frame]:
        """In lockstep: let the robot run to a time, and return all frames of a kind that it sends until then."""
        self.token += 1
        self.send(Ping(self.token), at)
        before = len(self.frames)
        self.of(Pong, lambda pong: pong.token == self.token)
        return [frame for frame in self.frames[before:] if isinstance(frame.message, kind)]


class Process(Emulator):
    """A running `surefoot emulate`, and its hosts."""

    def __init__(self, *words: str) -> None:
        super().__init__(*words)
        self.hosts: list[Host] = []

    def host(self) -> Host:
        self.hosts.append(Host(self.port))
        return self.hosts[-1]

    def stop(self) -> tuple[int, str]:
        while self.hosts:
            self.hosts.pop().close()
        return super().stop()


class Thread:
    """What `surefoot emulate` runs, in a thread of the test: in lockstep, or in real time with `--baud 0`."""

    def __init__(self, robot: RobotDescription, *words: str) -> None:
        from surefoot.cli.emulate import EmulateCommand, _build
        from surefoot.cli.parsing import parse
        from surefoot.emulator.process import Lockstep, RealTime, Summary
        from surefoot.emulator.pty_port import PtyPort

        command = parse(EmulateCommand, list(words), "surefoot emulate")
        self.board, self.summary = _build(command, robot, {}), Summary()
        self._port = PtyPort(held=not command.lockstep)
        loop = (Lockstep if command.lockstep else RealTime)(self.board, self._port, self.summary)
        self.hosts: list[Host] = []
        self._thread = threading.Thread(target=loop.run, daemon=True)
        self._thread.start()

    host = Process.host

    @property
    def port(self) -> str:
        return self._port.path

    @property
    def unread(self) -> int:
        return self._port.unread

    def stop(self) -> None:
        while self.hosts:
            self.hosts.pop().close()
        self.summary.stop = True
        self._thread.join()
        self._port.close()


@pytest.fixture
def emulate() -> Iterator[Callable[..., Process]]:
    """Start processes that end with the test."""
    with emulators(Process) as start:
        yield start


@pytest.fixture
def emulate_here(robot: RobotDescription) -> Iterator[Callable[..., Thread]]:
    """Start threads that end with the test."""
    started: list[Thread] = []

    def start(*words: str) -> Thread:
        started.append(Thread(robot, *words))
        return started[-1]

    yield start
    for thread in started:
        thread.stop()


@pytest.fixture
def wire_bytes() -> Bytes:
    return Bytes()
