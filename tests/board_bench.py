"""Test bench for a microcontroller, whose sensors and messages are set by tests; its program is in Python or C."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from compiled_firmware import compiled, needs_gcc, needs_qemu

from surefoot.deploy.board.firmware import Firmware
from surefoot.deploy.board.limits import Limits, make_handshake
from surefoot.deploy.board.signals import MotorCommand, Sensors, Vitals
from surefoot.deploy.messages import Handshake, Message, Mode, Packet, Reason
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import Decoder, encode_frame
from surefoot.emulator.firmware_process import FirmwareProcess
from surefoot.emulator.serial.serial_host_link import SerialHostLink

MS = 1000
ME, OTHER = 7, 8
"""Sessions of two operators."""
IN_C = pytest.param("C", marks=needs_gcc)
IN_QEMU = pytest.param("QEMU", marks=[needs_gcc, needs_qemu])
PROGRAMS = ("messages", "serial line", IN_C)


class NoHosts:
    """Host end of a line that is read by the test."""

    unread = 0


class CompiledFirmware(FirmwareProcess):
    """Program in C, with the attributes of the Python program that tests use."""

    def __init__(self, robot: Any, handshake: Handshake, limits: Limits, *target: str) -> None:
        super().__init__(compiled(robot, limits, handshake, *target), robot.name, robot.num_motors)
        self.handshake = handshake

    def tick(self, now: int, vitals: Vitals) -> MotorCommand:  # type: ignore[override]
        zeros, attitude = np.zeros(8), np.array([0.0, vitals.tilt, 0.0])
        temperature = np.array([25.0, vitals.temperature, *[25.0] * 6])
        seen = Sensors(vitals.motor_angle, zeros, zeros, attitude, zeros[:3], 0.0, vitals.voltage, temperature)
        super().tick(now, seen, vitals.hazard, vitals.sit)
        return MotorCommand(self.mode, self.motor_values) if self.armed else MotorCommand(Mode.DISARMED, zeros)

    @property
    def link_monitor(self) -> CompiledFirmware:
        return self


class Bench:
    """Microcontroller whose sensors are set by the test, with a servo step every millisecond.

    A host's messages reach the Python program directly (`where` is "messages") or as bytes over a "serial line", or
    the program in "C" as bytes, on this computer or on an STM32F405 in "QEMU".
    """

    def __init__(self, robot: Any, where: str, **changes: Any) -> None:
        limits = replace(Limits.from_robot(robot), **changes)
        handshake = make_handshake(robot, limits, "test 1", 0.001)
        self.where, self.in_c = where, where in ("C", "QEMU")
        if self.in_c:
            target = ("board-qemu",) if where == "QEMU" else ()
            self.firmware: Any = CompiledFirmware(robot, handshake, limits, *target)
        else:
            self.firmware = Firmware(handshake, limits)
        self.line = SerialHostLink(NoHosts(), 8) if where == "serial line" else None
        self.host = Decoder(Codec(8))
        self.now = self.number = 0
        self.vitals = Vitals(np.arange(8) / 10, 0.0, 16.0, 25.0)
        self.motor_command: MotorCommand | None = None
        self.sent: list[Packet] = []
        """Messages sent by the robot, oldest first."""
        self.sensors = Sensors(*(np.zeros(8),) * 3, np.zeros(3), np.zeros(3), 5.0, 16.0, np.full(8, 25.0))

    def take(self) -> list[Packet]:
        """Return the messages that the host has received since the last call."""
        packets = self.firmware.take()
        if self.line is not None:
            for packet in packets:
                self.line.send(self.now, packet)
            packets = self.host.feed(self.line.take(self.now))
        self.sent += packets
        return packets

    def run(self, milliseconds: int) -> list[Packet]:
        """Advance time; return the robot's messages."""
        before = len(self.sent)
        for _ in range(milliseconds):
            self.motor_command = self.firmware.tick(self.now, self.vitals)
            self.now += MS
            self.firmware.report(self.now, lambda: self.sensors)
            self.take()
        return self.sent[before:]

    def send(self, message: Message, sent: float | None = None, number: int | None = None) -> list[Message]:
        """Send a message and return the answers; time and number default to the present and the next number."""
        sent = self.now / 1e6 + 100.0 if sent is None else sent
        if number is None:
            self.number = number = self.number + 1
        if self.where == "messages":
            self.firmware.receive(self.now, Packet(message, number, sent))
        else:
            self.put(encode_frame(self.host.codec, message, number, sent))
        return [packet.message for packet in self.take()]

    def put(self, data: bytes) -> None:
        """Send bytes to the robot."""
        if self.line is None:
            self.firmware.receive(self.now, data) if self.in_c else self.firmware.link_monitor.note_damage()
            return
        self.line.inbound.send(self.now, data)
        while self.line.next_arrival <= self.now:
            self.line.receive(self.now, self.firmware)

    @property
    def mode(self) -> tuple[Mode, Reason]:
        return self.firmware.mode, self.firmware.reason
