"""Firmware compiled for this computer, run as the program of an emulated board."""

from __future__ import annotations

import contextlib
import os
import select
import struct
import subprocess
import weakref
from collections.abc import Callable
from pathlib import Path

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.board.signals import Hazard, Sensors
from surefoot.deploy.messages import Mode, Packet, Reason
from surefoot.deploy.robot_link import LinkStatistics
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import Decoder
from surefoot.errors import SurefootError

_ANSWER_TIMEOUT = 5.0
"""Maximum time for an answer of the program [s]."""
_NEVER = 2**64 - 1
_GREETING = struct.Struct("<I24s")
_EVENT = struct.Struct("<cQH")
_MAX_DATA = 2**16 - 1
_NOTHING: Hazard = (Reason.NONE, "")


class FirmwareProcess:
    """Process that runs the firmware; a `BoardProgram`.

    Robot time advances only with the events sent to the process; `firmware/emulation/events.c` describes their bytes.

    Args:
        program: path of the program compiled by `firmware.project.build_firmware`.
        robot: name of the robot that it must be for.
        motors: number of motors of the robot.

    Raises:
        SurefootError: the program cannot be started, or is for another robot; from each method: it has ended.
    """

    def __init__(self, program: Path, robot: str, motors: int) -> None:
        self._program = program
        try:
            self._process = subprocess.Popen(
                [program.absolute()], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0
            )
        except OSError as error:
            raise SurefootError(f"firmware {program}: {error.strerror or error}") from None
        weakref.finalize(self, _end, self._process)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._input, self._output = self._process.stdin.fileno(), self._process.stdout.fileno()
        self._ready = select.poll()
        self._ready.register(self._output, select.POLLIN)
        self._answer = struct.Struct(f"<BBH3Q6I{2 * motors}fBIII")
        codec = Codec(motors)
        self._decoder = Decoder(codec)
        self._out: list[Packet] = []
        self.statistics = LinkStatistics()
        """Packets that the firmware has received."""
        self.mode, self.reason, self.owner = Mode.DISARMED, Reason.NONE, 0
        self.effort, self.motor_values = np.zeros((2, motors))
        """Duties or torques of the last servo step, and the commanded angles or duties of an armed robot (M,)."""
        self.next_state: float = np.inf
        self.command_time = self.old_numbers = self.stale = 0
        """Time of the last accepted command or of arming [us]; number of dropped frames and of dropped commands."""
        self.watchdog = self.cycles = 0
        """Time without a servo step after which the microcontroller restarts [us]; processor cycles of the last event,
        0 if they are not counted."""
        self._reserved_until = 0
        schema, name = _GREETING.unpack(self._read(_GREETING.size))
        if (schema, name.rstrip(b"\0")) != (codec.schema, robot.encode()):
            raise SurefootError(f"firmware {program} is not for robot {robot}; `surefoot robot firmware new` writes it")

    @property
    def armed(self) -> bool:
        """Whether motors follow commands."""
        return self.mode in (Mode.POSITION, Mode.PWM)

    def has_operator(self, now: int) -> bool:
        """Return whether an operator uses the robot, so that others are rejected."""
        return bool(self.owner) and now <= self._reserved_until

    def take(self) -> list[Packet]:
        """Remove and return the packets to send, oldest first."""
        packets, self._out = self._out, []
        return packets

    def receive(self, now: int, data: bytes) -> None:
        """Pass received bytes of the line to the firmware."""
        for start in range(0, len(data), _MAX_DATA):
            self._exchange(b"B", now, data[start : start + _MAX_DATA])

    def tick(self, now: int, seen: Sensors, hazard: Hazard | None = None, sit: Hazard | None = None) -> Array:
        """Run a servo step; `hazard` damps the motors, `sit` asks the host to bring the robot to rest.

        Returns:
            Duties, or torques of joint actuators [N m] (M,).
        """
        self._exchange(b"T", now, _pack(seen, hazard or _NOTHING, sit or _NOTHING))
        return self.effort

    def report(self, now: int, read: Callable[[], Sensors]) -> None:
        """Send a state with the sensor readings of `read`, if one is due."""
        if now >= self.next_state:
            self._exchange(b"R", now, _pack(read(), _NOTHING, _NOTHING))

    def share_priority(self) -> None:
        """Give the threads of the firmware the priority of this process, so that this process never waits for them."""
        policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
        if parameters.sched_priority:
            for thread in Path(f"/proc/{self._process.pid}/task").iterdir():
                with contextlib.suppress(OSError):  # it has just ended
                    os.sched_setscheduler(int(thread.name), policy, parameters)

    def _exchange(self, what: bytes, now: int, content: bytes) -> None:
        try:
            os.write(self._input, _EVENT.pack(what, now, len(content)) + content)
        except BrokenPipeError:
            self._fail()
        mode, reason, self.owner, *rest = self._answer.unpack(self._read(self._answer.size))
        self.command_time, following, self._reserved_until, *rest = rest
        *counts, self.old_numbers, self.stale = rest[:6]
        *floats, enabled, self.watchdog, self.cycles, size = rest[6:]
        seen = self.statistics
        seen.received, seen.damaged, seen.foreign, seen.unknown = counts
        try:
            self.mode, self.reason = Mode(mode), Reason(reason)
        except ValueError as error:
            raise SurefootError(f"firmware {self._program}: {error}") from None
        self.effort, self.motor_values = enabled * np.reshape(floats, (2, -1))
        self.next_state = np.inf if following == _NEVER else following
        if size:
            self._out += self._decoder.feed(self._read(size))

    def _read(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            if not self._ready.poll(1e3 * _ANSWER_TIMEOUT):
                raise SurefootError(f"firmware {self._program} does not answer")
            more = os.read(self._output, size - len(data))
            if not more:
                self._fail()
            data += more
        return data

    def _fail(self) -> None:
        raise SurefootError(f"firmware {self._program} has ended with code {self._process.wait()}")


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.communicate()


def _pack(seen: Sensors, hazard: Hazard, sit: Hazard) -> bytes:
    numbers = (
        *(seen.motor_angle, seen.motor_velocity, seen.motor_torque, seen.temperature),
        *(seen.roll_pitch_yaw, seen.angular_velocity_base, (seen.voltage,)),
    )
    texts = struct.pack("<BB81s81s", hazard[0], sit[0], hazard[1].encode(), sit[1].encode())
    return np.concatenate(numbers).astype("<f4").tobytes() + texts
