"""A toy robot for tests of the host: the real protocol, and motors that reach their targets immediately."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from surefoot.deploy.board.firmware import Firmware, MotorCommand, Sensors, Vitals
from surefoot.deploy.board.limits import Limits, make_handshake
from surefoot.deploy.clock import LockstepClock
from surefoot.deploy.loop import RunMonitor, Snapshot
from surefoot.deploy.messages import Message, State
from surefoot.deploy.robot_link import LinkLostError, RobotLink
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import Decoder, encode_frame
from surefoot.deploy.serial.serial_link import SerialLink
from surefoot.robot import RobotDescription


class ToyRobot:
    """The other end of a link in lockstep, as a port; robot time is the time in the frames.

    Attributes:
        sensors: called with the robot's time [s] and its readings, may return others.
        received: received messages, oldest first.
        cut: the cable has been pulled.
        silent: what the robot sends is lost.
    """

    def __init__(self, robot: RobotDescription) -> None:
        self.codec = Codec(robot.num_motors)
        limits = Limits.from_robot(robot)
        self.firmware = Firmware(make_handshake(robot, limits, "toy", 0.001), limits)
        self._decoder = Decoder(self.codec)
        self.angle = robot.pose_angles(np.zeros(4), np.full(4, 0.9))
        self.sensors: Callable[[float, Sensors], Sensors] = lambda time, readings: readings
        self.received: list[tuple[float, Message]] = []
        self.cut = self.silent = False
        self._now = 0
        self._ticked = -1000
        self._out = bytearray()

    def _readings(self, now: int) -> Sensors:
        motors = self.codec.motors
        plain = Sensors(
            motor_angle=self.angle.copy(),
            motor_velocity=np.zeros(motors),
            motor_torque=np.full(motors, 0.1),
            roll_pitch_yaw=np.zeros(3),
            angular_velocity_base=np.zeros(3),
            energy=now * 1e-5,
            voltage=16.0,
            temperature=np.full(motors, 30.0),
        )
        return self.sensors(now / 1e6, plain)

    def run_to(self, now: int) -> None:
        """Run to a time in steps of 1 ms, and send due states."""
        firmware = self.firmware
        while self._ticked + 1000 <= now:
            self._ticked += 1000
            self._report_until(self._ticked)
            vitals = Vitals(self.angle, 0.0, 16.0, 30.0)
            order: MotorCommand = firmware.tick(self._ticked, vitals)
            if firmware.armed:
                self.angle = order.values.copy()
        self._report_until(now)
        self._now = max(self._now, now)

    def _report_until(self, now: int) -> None:
        firmware = self.firmware
        while firmware.next_state is not None and firmware.next_state <= now:
            due = max(firmware.next_state, 0)
            readings = self._readings(due)
            firmware.report(due, lambda readings=readings: readings)
            self._send()

    def _send(self) -> None:
        for frame in self.firmware.take():
            if not self.silent:
                self._out += encode_frame(self.codec, frame.message, frame.sequence, frame.time)

    def write(self, data: bytes) -> int:
        if self.cut:
            raise LinkLostError("port toy is gone")
        for frame in self._decoder.feed(data):
            self.run_to(max(round(frame.time * 1e6), self._now))
            self.received.append((frame.time, frame.message))
            self.firmware.receive(self._now, frame)
            self._send()
        return len(data)

    def read(self) -> bytes:
        if self.cut:
            raise LinkLostError("port toy is gone")
        data = bytes(self._out)
        self._out.clear()
        return data

    def wait(self, timeout: float) -> None:
        pass

    def close(self) -> None:
        pass

    def kinds(self) -> list[str]:
        """Return the names of received messages, without repetitions and pings."""
        names = [type(message).__name__ for _, message in self.received if type(message).__name__ != "Ping"]
        return [name for k, name in enumerate(names) if k == 0 or names[k - 1] != name]


@dataclass
class MonitorLog(RunMonitor):
    """A monitor that records its calls."""

    phases: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    snapshots: list[Snapshot] = field(default_factory=list)
    recordings: list[str] = field(default_factory=list)

    def phase(self, name: str, duration: float) -> None:
        self.phases.append(name)

    def warn(self, text: str) -> None:
        self.warnings.append(text)

    def recording(self, text: str) -> None:
        self.recordings.append(text)

    def tick(self, snapshot: Snapshot) -> None:
        self.snapshots.append(snapshot)


@pytest.fixture
def toy(robot: RobotDescription) -> ToyRobot:
    return ToyRobot(robot)


@pytest.fixture
def link(toy: ToyRobot) -> RobotLink:
    clock = LockstepClock()
    return SerialLink(toy, toy.codec, clock, session=77)


@pytest.fixture
def monitor() -> MonitorLog:
    return MonitorLog()


@pytest.fixture
def a_state() -> State:
    """A state of a standing robot that follows session 77."""
    return State(
        session=77,
        mode=1,
        reason=0,
        command=1,
        command_age=0.001,
        dropped=0,
        motor_angle=np.full(8, 2.0),
        motor_velocity=np.zeros(8),
        motor_torque=np.zeros(8),
        roll_pitch_yaw=np.zeros(3),
        angular_velocity_base=np.zeros(3),
        energy=0.0,
        voltage=16.0,
        temperature=np.full(8, 30.0),
    )
