"""Operators and emulators for tests of this package."""

from __future__ import annotations

import os
import select
import time
import tty
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from compiled_firmware import compiled, needs_gcc
from processes import Emulator, EmulatorHere, emulators

from surefoot.deploy.messages import Arm, Fault, Hello, Message, Mode, Packet, Ping, Pong, Position, Reason, State
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import Decoder, encode_frame
from surefoot.robot import RobotDescription

ME = 7
STEP = 6000


class Bytes:
    """Encoder and decoder of one side."""

    def __init__(self, motors: int = 8) -> None:
        self.codec = Codec(motors)
        self.decoder = Decoder(self.codec)
        self.number = 0

    def frame(self, message: Message, time: float, number: int | None = None) -> bytes:
        """Encode with the next number, or with a given one that is not counted."""
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
        """Wait for data, at most a timeout [s], and return the frames that have arrived."""
        if wait > 0:
            select.select([self.file], [], [], wait)
        try:
            packets = self.bytes.decoder.feed(os.read(self.file, 65536))
        except BlockingIOError:
            packets = []
        self.frames += packets
        return packets

    def wait_for(self, kind: type[Any], condition: Callable[[Any], bool] = lambda message: True) -> Packet:
        """Return the first arriving frame of a type for which a condition holds."""
        end = time.monotonic() + 20.0
        while time.monotonic() < end:
            for frame in self.receive(0.05):
                if isinstance(frame.message, kind) and condition(frame.message):
                    return frame
        raise AssertionError(f"no such frame; last {self.frames[-3:]}")

    def run_to(self, at: float, kind: type[Message] = Message) -> list[Packet]:
        """In lockstep, run the robot to a time, and return all frames of a type that it sends until then."""
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


class NoHosts:
    """A port without hosts."""

    unread = 0


class Rig:
    """A board with a program in "Python" or "C", and an operator whose bytes take no time."""

    def __init__(self, robot: RobotDescription, program: str, *words: str, noise: bool = False) -> None:
        from surefoot.cli.emulate import EmulateCommand, _make_board
        from surefoot.emulator.fault_table import parse_faults
        from surefoot.emulator.hardware import PowerConfig, SensorConfig
        from surefoot.emulator.plant import Plant
        from surefoot.emulator.serial.serial_host_link import SerialHostLink

        sensors = SensorConfig() if noise else SensorConfig.ideal()
        plant = Plant(robot, sensors=sensors, power=PowerConfig.ideal(robot), rack=True)
        faults = parse_faults(words, motors=robot.num_motors)
        self.robot, self.wire = robot, Bytes(robot.num_motors)
        self.line = SerialHostLink(NoHosts(), robot.num_motors, faults, seed=1)  # type: ignore[arg-type]
        firmware = compiled(robot) if program == "C" else None
        self.board = _make_board(EmulateCommand(firmware=firmware, lockstep=True), plant, self.line, faults)
        self.frames: list[Packet] = []
        self.angles = robot.pose_angles(0.0, 1.5) if robot.num_motors == 8 else robot.pose_angles(0.0, 0.0, 0.8)

    def send(self, message: Message) -> None:
        self.line.inbound.send(self.board.now, self.wire.frame(message, self.board.now / 1e6))
        self.run(0)

    def run(self, microseconds: int) -> list[Packet]:
        self.board.run_to(self.board.now + microseconds)
        frames = self.wire.decoder.feed(self.line.take(self.board.now))
        self.frames += frames
        return frames

    def arm(self, mode: Mode = Mode.POSITION) -> None:
        self.send(Hello(ME, 0.010))
        self.run(10_000)
        self.send(Arm(ME, int(mode), 0.006, 0.006))

    def walk(self, steps: int, angles: np.ndarray | None = None) -> list[Packet]:
        """Send commands, by default of a constant pose; return the received packets."""
        before = len(self.frames)
        for _ in range(steps):
            self.send(Position(ME, self.angles if angles is None else angles))
            self.run(STEP)
        return self.frames[before:]

    @property
    def states(self) -> list[Packet]:
        return [frame for frame in self.frames if isinstance(frame.message, State)]

    @property
    def faults(self) -> list[Packet]:
        return [frame for frame in self.frames if isinstance(frame.message, Fault)]

    @property
    def reasons(self) -> list[Reason]:
        return [Reason(frame.message.reason) for frame in self.faults]

    @property
    def mode(self) -> tuple[Mode, Reason]:
        return self.board.firmware.mode, self.board.firmware.reason


@pytest.fixture(params=["Python", pytest.param("C", marks=needs_gcc)])
def rig(robot: RobotDescription, request: pytest.FixtureRequest) -> Callable[..., Rig]:
    def make(*words: str, **more: bool) -> Rig:
        return Rig(robot, request.param, *words, **more)

    return make


@pytest.fixture
def rigs() -> Callable[..., list[Rig]]:
    """Return two boards of a robot that differ only in their programs."""
    return lambda robot, *words, **more: [Rig(robot, program, *words, **more) for program in ("Python", "C")]
