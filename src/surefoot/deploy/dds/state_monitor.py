"""Readings of a Go2 from its low-level states, and what in them must stop the motors. Times are whole microseconds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.deploy.board.signals import Hazard, Sensors, Vitals
from surefoot.deploy.dds.low_level import LOW_STATE, MOTOR_NAMES, SERVO, BadMessageError, Record, Remote, decode
from surefoot.deploy.messages import Reason
from surefoot.rotations import quat_rpy

MOTORS = len(MOTOR_NAMES)
LATE, LATE_LOOKS = 20_000, 3
"""Time [us] without a new state that stops the motors, and how often somebody must have looked for one meanwhile: a
program that was held up itself first reads what has come."""
RESTART = 100
"""Fall of the tick [ms] that is no message out of order, but a robot that counts anew."""
SHOWN = 500_000
"""Time [us] for which what was seen once keeps a robot from arming."""
LOST_RISE, LOST_WINDOW = 10, 200_000
"""Lost messages of a motor within a time [us] that stop it. Counts of a healthy robot are not 0, but steady."""
STICK = 0.5
"""Deflection of a stick of the remote control, of 1, that asks to sit."""
STOP_BUTTONS = frozenset(("L2", "B"))
"""Buttons of the remote control that together damp the motors, as in the vendor's own programs."""
QUATERNION_ERROR = 0.05
"""Greatest difference of a quaternion's length from 1."""
_CELL = (1.0, 5.0)
"""Least and greatest voltage [V] of a cell that is there."""
_NO_REMOTE, _ON = bytes(40), bytes([SERVO] * MOTORS)
_BATTERY_EVERY = 25
"""States between two looks at the battery: every .05 s."""


_FIELDS: Mapping[str, Any] = LOW_STATE.fields or {}


def _offsets(part: str, names: Sequence[str], count: int = 1) -> list[int]:
    """Return where numbers stand in a state [bytes]: `count` of each field of its IMU, or one of each motor."""
    kind, start = _FIELDS[part][:2]
    entry = kind.base
    return [
        start + m * entry.itemsize + entry.fields[name][1] + 4 * k
        for name in names
        for m in range(MOTORS if kind.subdtype else 1)
        for k in range(count)
    ]


_ANGLES = _offsets("motor_state", ["q", "dq", "tau_est"])
_IMU = [*_offsets("imu_state", ["quaternion"], 4), *_offsets("imu_state", ["gyroscope"], 3)]
_POWER = int(_FIELDS["power_v"][1])
_FLOATS = np.array([*_ANGLES, *_IMU, _POWER]) // 4
_LOST = np.array(_offsets("motor_state", ["lost"])) // 4
_BYTES = np.array(_offsets("motor_state", ["mode", "temperature"]))
"""Where angles, speeds, torques, quaternion, rates and power_v are among a state's 32-bit words, lost messages
likewise, and modes and temperatures among its bytes: two reads of an array take a tenth of those of twelve records."""


class StateMonitor:
    """The newest of a Go2's states, and whether states come, and come whole.

    Give `take` what has come once a cycle; then read `vitals` and `sensors`.
    """

    def __init__(self) -> None:
        self.received = self.damaged = 0
        """States with a right checksum, and messages that were none."""
        self.record: Record | None = None
        """The newest state."""
        self.energy = 0.0
        """Integral of |sum of torque times speed| [J]."""
        self.angle, self.velocity, self.torque = np.zeros((3, MOTORS))
        self.roll_pitch_yaw, self.rate = (0.0, 0.0, 0.0), np.zeros(3)
        self.voltage = 0.0
        self.temperature = np.zeros(MOTORS)
        self._new_at, self._looks = -math.inf, 0
        self._repeats = self._bad = 0
        """States with the same tick, and damaged ones, since the last new one."""
        self._shown: Hazard | None = None
        self._shown_until = 0
        self._lost, self._lost_since = np.zeros(MOTORS, np.int64), -math.inf
        self._found: Hazard | None = None
        self._remote = _NO_REMOTE
        self._stop = self._stick = False

    def take(self, now: int, messages: Sequence[bytes]) -> None:
        """Take the messages that have come since the last call, oldest first."""
        self._looks += 1
        for data in reversed(messages):
            try:
                record = decode(LOW_STATE, data)
            except BadMessageError:
                self.damaged += 1
                self._bad += 1
                continue
            self.received += 1
            self._read(now, record)
            break

    def _read(self, now: int, record: Record) -> None:
        tick = int(record["tick"])
        if self.record is not None:
            rise = (tick - int(self.record["tick"]) + 2**31) % 2**32 - 2**31
            if -RESTART < rise <= 0:
                self._repeats += 1
                return
            if rise < 0:
                self._show(now, Reason.RESTARTED, f"the robot's tick went back by {-rise} ms")
                rise = 0
            self.energy += 1e-3 * rise * abs(float(self.torque @ self.velocity))
        self.record, self._new_at, self._looks, self._repeats, self._bad = record, now, 0, 0, 0
        values = np.frombuffer(record, "<f4")[_FLOATS].astype(np.float64)
        self.angle, self.velocity, self.torque = values[:12], values[12:24], values[24:36]
        quaternion, self.rate = values[36:40].tolist(), values[40:43]
        small = np.frombuffer(record, np.uint8)[_BYTES]
        self.temperature = small[MOTORS:].astype(np.float64)
        if self.received % _BATTERY_EVERY == 1:
            self.voltage = battery_voltage(record, float(values[43]))
        length = math.hypot(*quaternion)
        self._found = None
        if not math.isfinite(float(values.sum())):
            self._found = Reason.NOT_FINITE, "a reading of the robot is not finite"
        elif not abs(length - 1) <= QUATERNION_ERROR:
            self._found = Reason.NOT_FINITE, f"the IMU's quaternion has length {length:.3g}; it must be 1"
        else:
            self.roll_pitch_yaw = quat_rpy(*quaternion)
            self._found = self._motors(now, small[:MOTORS], np.frombuffer(record, "<u4")[_LOST])
        self._read_remote(record["wireless_remote"].tobytes())

    def _motors(self, now: int, mode: NDArray[np.uint8], lost: NDArray[np.uint32]) -> Hazard | None:
        if mode.tobytes() != _ON:
            motor = int(np.argmax(mode != SERVO))
            return Reason.MOTOR_OFF, f"{MOTOR_NAMES[motor]} is off (mode {int(mode[motor])})"
        rise = lost.astype(np.int64) - self._lost
        if now - self._lost_since > LOST_WINDOW or rise.min() < 0:
            self._lost, self._lost_since = lost.astype(np.int64), now
        elif (worst := int(rise.max())) >= LOST_RISE:
            motor = int(np.argmax(rise))
            self._show(
                now, Reason.MOTOR_OFF, f"{MOTOR_NAMES[motor]} has lost {worst} messages in {1e-3 * LOST_WINDOW:g} ms"
            )
        return None

    def _read_remote(self, data: bytes) -> None:
        if data == self._remote:
            return
        self._remote = data
        remote = Remote.decode(np.frombuffer(data, np.uint8))
        self._stop = remote.buttons >= STOP_BUTTONS
        sticks = (remote.left_x, remote.left_y, remote.right_x, remote.right_y)
        self._stick = any(abs(stick) > STICK for stick in sticks)

    def _show(self, now: int, reason: Reason, text: str) -> None:
        self._shown, self._shown_until = (reason, text), now + SHOWN

    def hazard(self, now: int) -> Hazard | None:
        """Return why motors must not move; None if they may."""
        silence = now - self._new_at
        if silence >= LATE and self._looks >= LATE_LOOKS:
            since = "no state has come" if self.record is None else f"no new state for {1e-3 * silence:.0f} ms"
            if self._bad >= LATE_LOOKS:
                return Reason.STATES_DAMAGED, f"{since}: {self._bad} messages were damaged or of another layout"
            if self._repeats >= LATE_LOOKS:
                return Reason.STATES_FROZEN, f"{since}: the robot repeats tick {int(self.record['tick'])}"  # type: ignore[index]
            return Reason.STATES_LATE, since
        if self._stop:
            return Reason.REMOTE, "L2 and B of the remote control are pressed"
        if self._found is not None:
            return self._found
        return self._shown if self._shown is not None and now < self._shown_until else None

    def vitals(self, now: int, hazard: Hazard | None = None) -> Vitals:
        """Return what a board checks in every servo step; `hazard` comes before those of the states."""
        roll, pitch, _ = self.roll_pitch_yaw
        return Vitals(
            self.angle,
            max(abs(roll), abs(pitch)),
            self.voltage,
            float(self.temperature.max()),
            hazard or self.hazard(now),
            (Reason.REMOTE, "a stick of the remote control was moved") if self._stick else None,
        )

    def sensors(self) -> Sensors:
        """Return the readings in a state of the protocol."""
        return Sensors(
            self.angle,
            self.velocity,
            self.torque,
            np.array(self.roll_pitch_yaw),
            self.rate,
            self.energy,
            self.voltage,
            self.temperature,
        )


def battery_voltage(record: Record, power_v: float) -> float:
    """Return the battery's voltage [V]: the sum of its cells, or `power_v` of a state without cells."""
    cells = 1e-3 * record["bms_state"]["cell_vol"]
    cells = cells[(cells >= _CELL[0]) & (cells <= _CELL[1])]
    return float(cells.sum()) if len(cells) else power_v
