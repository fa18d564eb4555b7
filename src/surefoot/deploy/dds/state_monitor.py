"""Readings of a Go2 from its low-level states, and what in them must stop the motors. Times are whole microseconds."""

from __future__ import annotations

import math
import operator
import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from surefoot.deploy.board.signals import Hazard, Sensors, Vitals
from surefoot.deploy.dds.low_level import LOW_STATE, MOTOR_NAMES, SERVO, BadMessageError, RemoteControl, unpack
from surefoot.deploy.messages import Reason
from surefoot.rotations import quat_rpy

MOTORS = len(MOTOR_NAMES)
LATE, MIN_POLLS = 40_000, 3
"""Time [us] without a new state that stops the motors, and how often somebody must have looked for one meanwhile: a
program that was held up itself first reads what has come. With 20 ms a computer that was held up ended 3 of 60 runs;
motors that hold a target for 55 ms may miss states for 40."""
TICK_RESTART = 100
"""Fall of the tick [ms] that is no message out of order, but a robot that counts anew."""
SHOWN = 500_000
"""Time [us] for which what was seen once keeps a robot from arming."""
MAX_LOST, LOST_WINDOW = 10, 200_000
"""Lost messages of a motor within a time [us] that stop it. Counts of a healthy robot are not 0, but steady."""
STICK_THRESHOLD = 0.5
"""Deflection of a stick of the remote control, of 1, that asks to sit."""
STOP_BUTTONS = frozenset(("L2", "B"))
"""Buttons of the remote control that together damp the motors, as in the vendor's own programs."""
MAX_QUATERNION_ERROR = 0.05
"""Greatest difference of a quaternion's length from 1."""
_CELL = (1.0, 5.0)
"""Least and greatest voltage [V] of a cell that is there."""
_NO_REMOTE, _ON = bytes(40), (SERVO,) * MOTORS
_BATTERY_STATES = 25
"""States between two looks at the battery: every .05 s."""


_FIELDS: Mapping[str, Any] = LOW_STATE.fields or {}


def _places(part: str, codes: Mapping[str, str], entry: int = 0) -> dict[int, str]:
    """Return where fields stand in a part of a state, or in an entry of an array of parts [bytes], with their codes."""
    kind, start = _FIELDS[part][:2]
    return {start + entry * kind.base.itemsize + kind.base.fields[name][1]: code for name, code in codes.items()}


def _reader(codes: Mapping[int, str]) -> struct.Struct:
    """Return a struct that reads fields by their places, in rising order, and leaves out what is between them."""
    text, end = "<", 0
    for place, code in codes.items():
        text += f"{place - end}x{code}"
        end = place + struct.calcsize("<" + code)
    return struct.Struct(text)


_MOTOR = {"mode": "B", "q": "f", "dq": "f", "tau_est": "f", "temperature": "B", "lost": "I"}
_MOTOR_PLACES = {at: code for m in range(MOTORS) for at, code in _places("motor_state", _MOTOR, m).items()}
_OTHERS = {int(_FIELDS[name][1]): code for name, code in (("tick", "I"), ("wireless_remote", "40s"), ("power_v", "f"))}
_STATE = _reader(_places("imu_state", {"quaternion": "4f", "gyroscope": "3f"}) | _MOTOR_PLACES | _OTHERS)
"""What is read of each state. A struct and plain numbers take a third of the time of arrays of so few."""
_CELLS = _reader(_places("bms_state", {"cell_vol": "15H"}))


class StateMonitor:
    """The newest of a Go2's states, and whether states come, and come whole.

    Give `take` what has come once a cycle; then read `vitals` and `sensors`.
    """

    def __init__(self) -> None:
        self.received = self.damaged = 0
        """States with a right checksum, and messages that were none."""
        self.energy = 0.0
        """Integral of |sum of torque times speed| [J]."""
        self.voltage = 0.0
        self.tick: int | None = None
        """Of the newest state [ms]."""
        none: tuple[float, ...] = (0.0,) * MOTORS
        self._angle = self._velocity = self._torque = none
        self._roll_pitch_yaw, self._rate = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        self._temperature, self._lost = (0,) * MOTORS, (0,) * MOTORS
        self._new_at, self._looks, self._lost_since = -math.inf, 0, -math.inf
        self._repeats = self._bad = 0
        """States with the same tick, and damaged ones, since the last new one."""
        self._shown: Hazard | None = None
        self._shown_until = 0
        self._found: Hazard | None = None
        self._remote = _NO_REMOTE
        self._stop = self._stick = False

    def take(self, now: int, messages: Sequence[bytes]) -> None:
        """Take the messages that have come since the last call, oldest first."""
        self._looks += 1
        for data in reversed(messages):
            try:
                state = unpack(LOW_STATE, data)
            except BadMessageError:
                self.damaged += 1
                self._bad += 1
                continue
            self.received += 1
            self._read(now, state)
            break

    def _read(self, now: int, state: bytes) -> None:
        numbers = _STATE.unpack_from(state)
        motors, (tick, remote, power) = numbers[7:-3], numbers[-3:]
        if self.tick is not None:
            rise = (tick - self.tick + 2**31) % 2**32 - 2**31
            if -TICK_RESTART < rise <= 0:
                self._repeats += 1
                return
            if rise < 0:
                self._show(now, Reason.RESTARTED, f"the robot's tick went back by {-rise} ms")
                rise = 0
            self.energy += 1e-3 * rise * abs(sum(map(operator.mul, self._torque, self._velocity)))
        self.tick, self._new_at, self._looks, self._repeats, self._bad = tick, now, 0, 0, 0
        mode, self._angle, self._velocity, self._torque, self._temperature, lost = (
            motors[k :: len(_MOTOR)] for k in range(len(_MOTOR))
        )
        self._rate = numbers[4:7]
        if self.received % _BATTERY_STATES == 1:
            self.voltage = battery_voltage(_CELLS.unpack_from(state), power)
        length = math.hypot(*numbers[:4])
        if not math.isfinite(sum(numbers[:-3]) + power):
            self._found = Reason.NOT_FINITE, "a reading of the robot is not finite"
        elif not abs(length - 1) <= MAX_QUATERNION_ERROR:
            self._found = Reason.NOT_FINITE, f"the IMU's quaternion has length {length:.3g}; it must be 1"
        else:
            self._roll_pitch_yaw = quat_rpy(*numbers[:4])
            self._found = self._check_motors(now, mode, lost)
        if remote != self._remote:
            self._read_remote(remote)

    def _check_motors(self, now: int, mode: tuple[int, ...], lost: tuple[int, ...]) -> Hazard | None:
        if mode != _ON:
            motor = next(m for m in range(MOTORS) if mode[m] != SERVO)
            return Reason.MOTOR_OFF, f"{MOTOR_NAMES[motor]} is off (mode {mode[motor]})"
        rises = (0,) if lost == self._lost else tuple(map(operator.sub, lost, self._lost))
        if now - self._lost_since > LOST_WINDOW or min(rises) < 0:
            self._lost, self._lost_since = lost, now
        elif (worst := max(rises)) >= MAX_LOST:
            text = f"{MOTOR_NAMES[rises.index(worst)]} has lost {worst} messages in {1e-3 * LOST_WINDOW:g} ms"
            self._show(now, Reason.MOTOR_OFF, text)
        return None

    def _read_remote(self, data: bytes) -> None:
        self._remote = data
        remote = RemoteControl.decode(np.frombuffer(data, np.uint8))
        self._stop = remote.buttons >= STOP_BUTTONS
        sticks = (remote.left_x, remote.left_y, remote.right_x, remote.right_y)
        self._stick = any(abs(stick) > STICK_THRESHOLD for stick in sticks)

    def _show(self, now: int, reason: Reason, text: str) -> None:
        self._shown, self._shown_until = (reason, text), now + SHOWN

    def hazard(self, now: int) -> Hazard | None:
        """Return why motors must not move; None if they may."""
        silence = now - self._new_at
        if silence >= LATE and self._looks >= MIN_POLLS:
            since = "no state has come" if self.tick is None else f"no new state for {1e-3 * silence:.0f} ms"
            if self._bad >= MIN_POLLS:
                return Reason.STATES_DAMAGED, f"{since}: {self._bad} messages were damaged or of another layout"
            if self._repeats >= MIN_POLLS:
                return Reason.STATES_FROZEN, f"{since}: the robot repeats tick {self.tick}"
            return Reason.STATES_LATE, since
        if self._stop:
            return Reason.REMOTE, "L2 and B of the remote control are pressed"
        if self._found is not None:
            return self._found
        return self._shown if self._shown is not None and now < self._shown_until else None

    def vitals(self, now: int, hazard: Hazard | None = None) -> Vitals:
        """Return what a board checks in every servo step; `hazard` comes before those of the states."""
        roll, pitch, _ = self._roll_pitch_yaw
        return Vitals(
            self._angle,
            max(abs(roll), abs(pitch)),
            self.voltage,
            max(self._temperature),
            hazard or self.hazard(now),
            (Reason.REMOTE, "a stick of the remote control was moved") if self._stick else None,
        )

    def sensors(self) -> Sensors:
        """Return the readings in a state of the protocol."""
        return Sensors(
            np.array(self._angle),
            np.array(self._velocity),
            np.array(self._torque),
            np.array(self._roll_pitch_yaw),
            np.array(self._rate),
            self.energy,
            self.voltage,
            np.array(self._temperature, float),
        )


def battery_voltage(cells: Sequence[int], power_v: float) -> float:
    """Return the battery's voltage [V]: the sum of its cells [mV], or `power_v` of a state without cells."""
    filled = [1e-3 * cell for cell in cells if _CELL[0] <= 1e-3 * cell <= _CELL[1]]
    return sum(filled) if filled else power_v
