"""Operators and emulators that tests of this package share."""

from __future__ import annotations

import os
import select
import time
import tty
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from processes import Emulator, EmulatorHere, emulators

from surefoot.deploy.messages import Message, Packet, Ping, Pong
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import Decoder, encode_frame


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
        self.frames: list[Packet] = []
        """All frames received, oldest first."""

    def close(self) -> None:
        os.close(self.file)

    def now(self) -> float:
        return time.monotonic() - self.start

    def send(self, message: Message, at: float | None = None) -> None:
        os.write(self.file, self.bytes.frame(message, self.now() if at is None else at))

    def receive(self, wait: float = 0.0) -> list[Packet]:
        """Wait for something, at most so long, and return what has arrived."""
        if wait > 0:
            select.select([self.file], [], [], wait)
        try:
            packets = self.bytes.decoder.feed(os.read(self.file, 65536))
        except BlockingIOError:
            packets = []
        self.frames += packets
        return packets

    def wait_for(self, kind: type[Any], condition: Callable[[Any], bool] = lambda message: True) -> Packet:
        """Return the first frame to arrive of a kind for which a condition holds."""
        end = time.monotonic() + 20.0
        while time.monotonic() < end:
            for frame in self.receive(0.05):
                if isinstance(frame.message, kind) and condition(frame.message):
                    return frame
        raise AssertionError(f"no such frame; last {self.frames[-3:]}")

    def run_to(self, at: float, kind: type[Message] = Message) -> list[Packet]:
        """In lockstep: let the robot run to a time, and return all frames of a kind that it sends until then."""
        self.token += 1
        self.send(Ping(self.token), at)
        before = len(self.frames)
        self.wait_for(Pong, lambda pong: pong.token == self.token)
        return [frame for frame in self.frames[before:] if isinstance(frame.message, kind)]


class _Hosts:
    """An emulator with operators at its pseudo-terminal."""

    def __init__(self, *words: object) -> None:
        super().__init__(*words)
        self.hosts: list[Host] = []

    def host(self) -> Host:
        self.hosts.append(Host(self.port))
        return self.hosts[-1]

    def stop(self) -> Any:
        while self.hosts:
            self.hosts.pop().close()
        return super().stop()


class Process(_Hosts, Emulator):
    """A running `surefoot emulate`, and its hosts."""


class Thread(_Hosts, EmulatorHere):
    """An emulator in a thread of the test, and its hosts."""


@pytest.fixture
def emulate() -> Iterator[Callable[..., Process]]:
    """Start processes that end with the test."""
    with emulators(Process) as start:
        yield start


@pytest.fixture
def emulate_here() -> Iterator[Callable[..., Thread]]:
    """Start threads that end with the test."""
    with emulators(Thread) as start:
        yield start


@pytest.fixture
def wire_bytes() -> Bytes:
    return Bytes()
