"""An emulated board with the firmware in C moves the robot like the program in Python."""

from __future__ import annotations

import contextlib
import random
import select
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from compiled_firmware import compiled, needs_gcc, needs_qemu
from firmware import fuzz

pytest.importorskip("mujoco")

from surefoot.cli.main import main
from surefoot.deploy.board.signals import MotorCommand, Sensors
from surefoot.deploy.messages import (
    Arm,
    Fault,
    Handshake,
    Hello,
    Message,
    Mode,
    Packet,
    Ping,
    Position,
    Pwm,
    Reason,
    State,
)
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import Decoder, encode_frame
from surefoot.emulator.firmware_process import FirmwareProcess
from surefoot.emulator.hardware import PowerConfig, SensorConfig
from surefoot.emulator.plant import Plant
from surefoot.errors import SurefootError
from surefoot.firmware.project import build_firmware, write_sources
from surefoot.robot import RobotDescription

pytestmark = needs_gcc
ME = 7
EIGHT = np.zeros(8)
READINGS = (EIGHT, EIGHT[:3], EIGHT[:3], 0.0, 16.0, EIGHT + 25.0)
"""Torques, attitude, rates, energy, voltage and temperatures."""


@pytest.mark.parametrize(
    ("robot_name", "words"),
    [("minitaur", ()), ("minitaur", ("swap-motors=2", "flip-sign=5", "motor-hot=95@0.3")), ("go2", ())],
)
def test_both_programs_move_the_robot_alike(rigs, robot_name, words):
    pair = rigs(RobotDescription.load(robot_name), *words, noise=True)
    for rig in pair:
        rig.arm()
        for k in range(50):
            rig.walk(1, rig.angles + 0.3 * np.sin(0.2 * k + np.arange(len(rig.angles))))
        rig.run(60_000)
    states = [[frame.message for frame in rig.states] for rig in pair]
    assert [rig.mode for rig in pair] == [pair[0].mode] * 2
    assert [frame.message.text for frame in pair[0].faults] == [frame.message.text for frame in pair[1].faults]
    assert len(states[0]) == len(states[1]) > 50
    assert [frame.time for frame in pair[0].states] == [frame.time for frame in pair[1].states]
    for name, tolerance in (("motor_angle", 2e-6), ("motor_velocity", 2e-4), ("roll_pitch_yaw", 1e-6)):
        one, other = (np.array([getattr(state, name) for state in run]) for run in states)
        np.testing.assert_allclose(one, other, atol=tolerance)
    for name in ("mode", "reason", "command_age", "dropped", "voltage"):
        assert [getattr(state, name) for state in states[0]] == [getattr(state, name) for state in states[1]]
    # The firmware integrates the work from its readings, which have the servo latency.
    assert states[1][-1].energy == pytest.approx(states[0][-1].energy, rel=0.02)


class Direct:
    """The firmware of a Minitaur without a body, and an operator; one servo step per call of `tick`."""

    def __init__(self, robot: RobotDescription) -> None:
        self.firmware, self.now, self.number = FirmwareProcess(compiled(robot), "minitaur", 8), 0, 0
        self.seen = Sensors(np.linspace(0.0, 0.7, 8), np.linspace(-3.0, 4.0, 8), *READINGS)

    def send(self, *messages: Message) -> None:
        for message in messages:
            self.number += 1
            self.firmware.receive(self.now, encode_frame(Codec(8), message, self.number, self.now / 1e6))

    def tick(self, **changes: np.ndarray) -> np.ndarray:
        self.now += 1000
        return self.firmware.tick(self.now, replace(self.seen, **changes))

    def arm(self, mode: Mode) -> None:
        self.tick()
        self.send(Hello(ME, 0.01), Arm(ME, int(mode), 0.006, 0.006))


@pytest.fixture
def direct(robot) -> Direct:
    return Direct(robot)


def test_its_servos_are_proportional_and_derivative_and_damped_motors_brake(direct):
    angle, speed = direct.seen.motor_angle, direct.seen.motor_velocity
    np.testing.assert_allclose(direct.tick(), -0.015 * speed, rtol=1e-6)
    direct.arm(Mode.POSITION)
    target = np.linspace(0.5, 2.4, 8)
    direct.send(Position(ME, target))
    duty = np.clip(1.0 * (target - angle) - 0.015 * speed, -1.0, 1.0)
    assert 2 < (duty == 1.0).sum() < 8
    np.testing.assert_allclose(direct.tick(), duty, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("roll_pitch_yaw", [-1.01, 0.0, 0.0], Reason.TILT),
        ("roll_pitch_yaw", [np.nan, 0.0, 0.0], Reason.TILT),
        ("motor_angle", [0.0, np.nan, *[0.0] * 6], Reason.NOT_FINITE),
        ("motor_velocity", [0.0, np.inf, *[0.0] * 6], Reason.NOT_FINITE),
    ],
)
def test_a_reading_beyond_its_limit_or_not_finite_damps(direct, name, value, reason):
    direct.arm(Mode.PWM)
    direct.send(Pwm(ME, EIGHT + 0.5))
    np.testing.assert_array_equal(direct.tick(), EIGHT + 0.5)
    effort = direct.tick(**{name: np.array(value)})
    assert (direct.firmware.mode, direct.firmware.reason) == (Mode.FAULT, reason)
    assert np.isfinite(effort).all()
    assert (np.abs(effort) <= (1.0 if name == "motor_velocity" else 0.1)).all()


def test_a_program_that_is_not_firmware_of_the_robot_is_rejected(robot, tmp_path, capsys):
    quiet = tmp_path / "quiet"
    quiet.write_text("#!/bin/sh\nexit 3\n")
    with pytest.raises(SurefootError, match="Permission denied"):
        FirmwareProcess(quiet, "minitaur", 8)
    quiet.chmod(0o755)
    with pytest.raises(SurefootError, match="has ended with code 3"):
        FirmwareProcess(quiet, "minitaur", 8)
    with pytest.raises(SurefootError, match="is not for robot solo8"):
        FirmwareProcess(compiled(robot), "solo8", 8)
    words = ["--firmware", str(tmp_path / "none"), "--duration", "0.01"]
    for more, message in (([], "No such file"), (["--set", "servo_kp=2"], "a firmware has its own gains, in robot.h")):
        assert main(["emulate", *words, *more]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert message in error


def test_errors_of_the_compiler_are_one_line(robot, tmp_path):
    write_sources(tmp_path, robot)
    (tmp_path / "core" / "board.c").write_text("int x = y;")
    with pytest.raises(SurefootError, match=r"error: .y. undeclared"):
        build_firmware(tmp_path)
    with pytest.raises(SurefootError, match=r"the firmware does not compile: .*no-such-cc"):
        build_firmware(tmp_path, "CC=no-such-cc")


def test_mutated_frames_find_no_error_of_memory_or_of_a_count(robot):
    # benchmarks/firmware.py sends a million.
    result = fuzz(4000, 2, compiled(robot))
    assert result["wrong"] == 0
    assert result["received"] > 1000
    assert len(result["servo_steps"]) == 4


class Stm32:
    """The firmware of an STM32F405 in QEMU, and an operator on its serial line; clock and interrupts are QEMU's.

    Its motors and sensors are those of a plant on a rack, if there is one.
    """

    def __init__(self, elf: Path, folder: Path, plant: Plant | None = None) -> None:
        listener = socket.socket(socket.AF_UNIX)
        listener.bind(str(folder / "line"))
        listener.listen()
        words = ["-M", "netduinoplus2", "-nographic", "-monitor", "none", "-kernel", str(elf)]
        words += ["-serial", f"unix:{folder / 'line'}", "-semihosting-config", "enable=on,target=native"]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(["qemu-system-arm", *words], stdin=pipe, stdout=pipe, bufsize=0)
        self.line, _ = listener.accept()
        listener.close()
        self.decoder, self.start, self.number = Decoder(Codec(8)), time.monotonic(), 0
        self.frames: list[Packet] = []
        self._body = threading.Thread(target=self._embody, args=(plant,), daemon=True)
        if plant is not None:
            self._body.start()

    def _embody(self, plant: Plant) -> None:
        with contextlib.suppress(BrokenPipeError):
            while True:
                seen = plant.servo_readings()
                numbers = (seen.motor_angle, seen.motor_velocity, seen.motor_torque, seen.temperature)
                self.process.stdin.write(
                    np.concatenate([*numbers, seen.roll_pitch_yaw, seen.angular_velocity_base, [seen.voltage]])
                    .astype("<f4")
                    .tobytes()
                )
                effort = self.process.stdout.read(4 * plant.robot.num_motors)
                if len(effort) < 4 * plant.robot.num_motors:
                    return
                plant.step(MotorCommand(Mode.PWM, np.frombuffer(effort, "<f4").astype(float)))

    def send(self, message: Message) -> None:
        self.number += 1
        self.line.sendall(encode_frame(Codec(8), message, self.number, time.monotonic() - self.start))

    def receive(self, wait: float) -> list[Packet]:
        """Return the data that arrive within a time [s]."""
        end, found = time.monotonic() + wait, []
        while select.select([self.line], [], [], max(end - time.monotonic(), 0.0))[0]:
            found += self.decoder.feed(self.line.recv(4096))
        self.frames += found
        return found

    def wait_for(self, kind: type[Message], count: int = 1) -> list[Packet]:
        """Return the next packets of a kind."""
        found: list[Packet] = []
        end = time.monotonic() + 20.0
        while len(found) < count:
            assert time.monotonic() < end, self.frames[-3:]
            found += [packet for packet in self.receive(0.002) if type(packet.message) is kind]
        return found

    def begin(self) -> Any:
        """Connect; return the handshake."""
        while not self.receive(0.1):  # data sent before it has started are lost
            self.send(Ping(3))
        self.send(Hello(ME, 0.020))
        return self.wait_for(Handshake)[0].message

    def close(self) -> None:
        self.process.kill()
        if self._body.ident is not None:
            self._body.join()  # it writes to a pipe that is closed next
        self.process.communicate()
        self.line.close()


@pytest.fixture
def stm32(robot, tmp_path) -> Iterator[Callable[..., Stm32]]:
    started: list[Stm32] = []

    def start(*variables: str, plant: Plant | None = None) -> Stm32:
        started.append(Stm32(compiled(robot, None, None, "board.elf", *variables), tmp_path, plant))
        return started[-1]

    yield start
    for board in started:
        board.close()


@needs_qemu
def test_the_firmware_of_the_stm32f405_answers_on_its_serial_line_and_does_not_arm_without_motors(stm32):
    # The Makefile links it into 32 KiB of flash and 8 KiB of RAM.
    board = stm32()
    assert board.begin().robot == "minitaur"
    states = board.wait_for(State, 10)
    assert np.median(np.diff([state.time for state in states])) == pytest.approx(0.020, abs=0.005)
    assert np.isnan(states[-1].message.motor_angle).all()
    board.line.sendall(random.Random(1).randbytes(20_000) + b"\0")
    board.send(Arm(ME, int(Mode.POSITION), 0.006, 0.006))
    (fault,) = board.wait_for(Fault)
    assert (fault.message.session, fault.message.reason) == (ME, Reason.NOT_FINITE)


@needs_qemu
@pytest.mark.realtime
def test_the_firmware_of_the_stm32f405_moves_a_body_and_damps_it_when_its_operator_is_silent(robot, stm32):
    plant = Plant(robot, sensors=SensorConfig.ideal(), power=PowerConfig.ideal(robot), rack=True)
    board = stm32("DRIVERS=emulation/body_qemu.c emulation/readings.c emulation/semihosting.c", plant=plant)
    board.begin()
    board.send(Arm(ME, int(Mode.POSITION), 0.010, 0.005))
    start = board.wait_for(State)[0].message.motor_angle
    target = robot.pose_angles(0.0, 1.5)
    for k in range(100):
        board.send(Position(ME, start + (target - start) * min(k / 60, 1.0)))
        board.receive(0.010)
    state = [packet for packet in board.frames if isinstance(packet.message, State)][-1]
    assert (state.message.mode, state.message.reason) == (Mode.POSITION, Reason.NONE)
    np.testing.assert_allclose(state.message.motor_angle, target, atol=0.05)
    (fault,) = board.wait_for(Fault)
    assert fault.message.reason == Reason.TIMEOUT
    (state,) = board.wait_for(State)
    assert state.message.mode == Mode.FAULT
    accepted = state.time - state.message.command_age
    assert 0.050 <= fault.time - accepted <= 0.060
