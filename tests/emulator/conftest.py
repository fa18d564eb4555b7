"""The robot and a small operator that tests of this room share."""

from __future__ import annotations

import os
import select
import time
import tty
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from processes import Emulator, emulators

from surefoot.deploy.wire.frames import Decoder, Frame, encode_frame
from surefoot.deploy.wire.messages import Codec, Fault, Message, Ping, Pong, State
from surefoot.robot import RobotDescription


class Bytes:
    """One side's encoder and decoder."""

    def __init__(self, motors: int = 8) -> None:
        self.codec = Codec(motors)
        self.decoder = Decoder(self.codec)
        self.number = 0

    def frame(self, message: Message, time: float, number: int | None = None) -> bytes:
        """Encode with the next number, or with one of one's own that does not count."""
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
        """Everything that has come, oldest first."""

    def close(self) -> None:
        os.close(self.file)

    def now(self) -> float:
        return time.monotonic() - self.start

    def send(self, message: Message, at: float | None = None, number: int | None = None) -> None:
        os.write(self.file, self.bytes.frame(message, self.now() if at is None else at, number))

    def look(self, wait: float = 0.0) -> list[Frame]:
        """What has come, after waiting for something at most so long."""
        if wait > 0:
            select.select([self.file], [], [], wait)
        try:
            found = self.bytes.decoder.feed(os.read(self.file, 65536))
        except BlockingIOError:
            found = []
        self.frames += found
        return found

    def until(self, condition: Callable[[Frame], bool], patience: float = 20.0) -> Frame:
        """The first frame to come for which a condition holds."""
        end = time.monotonic() + patience
        while time.monotonic() < end:
            for frame in self.look(0.05):
                if condition(frame):
                    return frame
        raise AssertionError(f"nothing of the kind came; last {self.frames[-3:]}")

    def of(self, kind: type[Any], *conditions: Callable[[Any], bool]) -> Frame:
        return self.until(lambda f: isinstance(f.message, kind) and all(check(f.message) for check in conditions))

    def run_to(self, at: float) -> list[Frame]:
        """In lockstep: let the robot run to a time, and take all that it says until then."""
        self.token += 1
        self.send(Ping(self.token), at)
        found: list[Frame] = []
        end = time.monotonic() + 20.0
        while time.monotonic() < end:
            found += self.look(0.5)
            if any(isinstance(frame.message, Pong) and frame.message.token == self.token for frame in found):
                return found
        raise AssertionError("the robot does not answer")


class Process(Emulator):
    """A running `surefoot emulate`, and hosts of it."""

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


@pytest.fixture
def emulate() -> Iterator[Callable[..., Process]]:
    """Start emulators that end with the test."""
    with emulators(Process) as start:
        yield start


def states(frames: list[Frame]) -> list[Frame]:
    return [frame for frame in frames if isinstance(frame.message, State)]


def faults(frames: list[Frame]) -> list[Fault]:
    return [frame.message for frame in frames if isinstance(frame.message, Fault)]


@pytest.fixture
def pick() -> dict[str, Callable[[list[Frame]], list[Any]]]:
    """Pick states (as frames) or faults (as messages) out of frames."""
    return {"states": states, "faults": faults}


@pytest.fixture
def wire_bytes() -> Bytes:
    return Bytes()


@pytest.fixture
def resting(robot: RobotDescription) -> np.ndarray:
    return robot.resting_angles
