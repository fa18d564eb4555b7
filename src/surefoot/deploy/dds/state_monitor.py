"""Monitor of a Go2's low-level states: sensor readings, and hazards that must stop the motors.

Times are whole microseconds.
"""

from __future__ import annotations

import math
import operator
import struct
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from surefoot.deploy.board.signals import Hazard, Sensors, Vitals
from surefoot.deploy.dds.low_level import LOW_STATE, MOTOR_NAMES, SERVO, BadMessageError, RemoteControl, unpack
from surefoot.deploy.messages import Reason
from surefoot.rotations import quat_rpy

MOTORS = len(MOTOR_NAMES)
STATE_TIMEOUT, MIN_POLLS = 40_000, 3
"""Time without a new state after which the motors are stopped [us], and how often states must have been polled in that
time: a process that was delayed itself first reads the states that have arrived. With 20 ms, delays of the computer
ended 3 of 60 runs. The motors may hold a target for 55 ms, so they can also miss states for 40 ms."""
TICK_RESTART = 100
"""Minimum decrease of the tick that means a restart of the robot [ms]; smaller ones are messages out of order."""
HAZARD_HOLD = 500_000
"""Time for which a momentary hazard prevents arming [us]."""
MAX_LOST, LOST_WINDOW = 10, 200_000
"""Number of lost messages of a motor within a time window [us] at which the motors are stopped. On a healthy robot the
counts are not 0, but constant."""
STICK_THRESHOLD = 0.5
"""Deflection of a stick of the remote control at which the robot sits, relative to the maximum."""
STOP_BUTTONS = frozenset(("L2", "B"))
"""Buttons of the remote control that damp the motors if pressed together, as in the vendor's programs."""
MAX_QUATERNION_ERROR = 0.05
"""Maximum difference of a quaternion's norm from 1."""
_CELL_RANGE = (1.0, 5.0)
"""Voltage range of a battery cell that exists [V]."""
_NO_REMOTE, _ON = bytes(40), (SERVO,) * MOTORS
_BATTERY_STATES = 25
"""Number of states between two readings of the battery voltage: every 0.05 s."""


_FIELDS: Mapping[str, Any] = LOW_STATE.fields or {}


def _offsets(part: str, codes: Mapping[str, str], entry: int = 0) -> dict[int, str]:
    """Return the format code of each field of a part of a state by its offset [bytes]; `entry` indexes arrays."""
    kind, start = _FIELDS[part][:2]
    return {start + entry * kind.base.itemsize + kind.base.fields[name][1]: code for name, code in codes.items()}


def _reader(codes: Mapping[int, str]) -> struct.Struct:
    """Return a struct that reads fields at increasing offsets, and skips the bytes in between."""
    text, end = "<", 0
    for offset, code in codes.items():
        text += f"{offset - end}x{code}"
        end = offset + struct.calcsize("<" + code)
    return struct.Struct(text)


_MOTOR = {"mode": "B", "q": "f", "dq": "f", "tau_est": "f", "temperature": "B", "lost": "I"}
_MOTOR_PLACES = {at: code for m in range(MOTORS) for at, code in _offsets("motor_state", _MOTOR, m).items()}
_OTHERS = {int(_FIELDS[name][1]): code for name, code in (("tick", "I"), ("wireless_remote", "40s"), ("power_v", "f"))}
_IMU_PLACES = _offsets("imu_state", {"quaternion": "4f", "gyroscope": "3f", "accelerometer": "3f"})
_STATE = _reader(_IMU_PLACES | _MOTOR_PLACES | _OTHERS)
"""Fields read from each state. For so few numbers, a struct is three times as fast as numpy arrays."""
_CELLS = _reader(_offsets("bms_state", {"cell_vol": "15H"}))


class StateMonitor:
    """Latest state of a Go2, and hazards such as late, repeated or damaged states.

    Call `update` once per cycle with the messages that have arrived; then read `vitals` and `sensors`.
    """

    def __init__(self) -> None:
        self.received = self.damaged = 0
        """Number of valid states, and of damaged messages."""
        self.energy = 0.0
        """Integral of |sum of torque times speed| over time [J]."""
        self.voltage = 0.0
        self.tick: int | None = None
        """Tick of the latest state [ms]."""
        none: tuple[float, ...] = (0.0,) * MOTORS
        self._angle = self._velocity = self._torque = none
        self._roll_pitch_yaw = self._rate = self._force = (0.0, 0.0, 0.0)
        self._temperature = (0,) * MOTORS
        self._lost: tuple[int, ...] | None = None
        """Counts of the motors' lost messages in the latest state; None before the first one."""
        self._losses: deque[tuple[int, tuple[int, ...]]] = deque()
        """When a motor lost messages within `LOST_WINDOW` [us], and the counts of all motors before."""
        self._new_at, self._polls = -math.inf, 0
        self._repeats = self._bad = 0
        """Number of states with a repeated tick, and of damaged ones, since the last new state."""
        self._held_hazard: Hazard | None = None
        self._held_until = 0
        self._state_hazard: Hazard | None = None
        self._remote = _NO_REMOTE
        self._stop = self._stick = False

    def update(self, now: int, messages: Sequence[bytes]) -> None:
        """Process the messages that have arrived since the last call, oldest first."""
        self._polls += 1
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
        motors, (tick, remote, board_voltage) = numbers[10:-3], numbers[-3:]
        if self.tick is not None:
            rise = (tick - self.tick + 2**31) % 2**32 - 2**31
            if -TICK_RESTART < rise <= 0:
                self._repeats += 1
                return
            if rise < 0:
                self._hold(now, Reason.RESTARTED, f"the robot's tick went back by {-rise} ms")
                rise = 0
            power = abs(sum(map(operator.mul, self._torque, self._velocity)))
            if math.isfinite(power):  # a single damaged reading must not stay in the sum
                self.energy += 1e-3 * rise * power
        self.tick, self._new_at, self._polls, self._repeats, self._bad = tick, now, 0, 0, 0
        mode, self._angle, self._velocity, self._torque, self._temperature, lost = (
            motors[k :: len(_MOTOR)] for k in range(len(_MOTOR))
        )
        self._rate, self._force = numbers[4:7], numbers[7:10]
        if self.received % _BATTERY_STATES == 1:
            self.voltage = battery_voltage(_CELLS.unpack_from(state), board_voltage)
        length = math.hypot(*numbers[:4])
        if not math.isfinite(sum(numbers[:-3]) + board_voltage):
            self._state_hazard = Reason.NOT_FINITE, "a reading of the robot is not finite"
        elif not abs(length - 1) <= MAX_QUATERNION_ERROR:
            self._state_hazard = Reason.NOT_FINITE, f"the IMU's quaternion has norm {length:.3g}; it must be 1"
        else:
            self._roll_pitch_yaw = quat_rpy(*numbers[:4])
            self._state_hazard = self._check_motors(now, mode, lost)
        if remote != self._remote:
            self._read_remote(remote)

    def _check_motors(self, now: int, mode: tuple[int, ...], lost: tuple[int, ...]) -> Hazard | None:
        if mode != _ON:
            motor = next(m for m in range(MOTORS) if mode[m] != SERVO)
            return Reason.MOTOR_OFF, f"{MOTOR_NAMES[motor]} is off (mode {mode[motor]})"
        if lost == self._lost:
            return None
        # The first counts say nothing, and neither do counts that decrease: the robot has restarted.
        if self._lost is None or min(map(operator.sub, lost, self._lost)) < 0:
            self._losses.clear()
        else:
            self._losses.append((now, self._lost))
        self._lost = lost
        while self._losses and now - self._losses[0][0] > LOST_WINDOW:
            self._losses.popleft()
        if self._losses:
            rises = tuple(map(operator.sub, lost, self._losses[0][1]))
            if (worst := max(rises)) >= MAX_LOST:
                text = f"{MOTOR_NAMES[rises.index(worst)]} has lost {worst} messages in {1e-3 * LOST_WINDOW:g} ms"
                self._hold(now, Reason.MOTOR_OFF, text)
        return None

    def _read_remote(self, data: bytes) -> None:
        self._remote = data
        remote = RemoteControl.decode(np.frombuffer(data, np.uint8))
        self._stop = remote.buttons >= STOP_BUTTONS
        sticks = (remote.left_x, remote.left_y, remote.right_x, remote.right_y)
        self._stick = any(abs(stick) > STICK_THRESHOLD for stick in sticks)

    def _hold(self, now: int, reason: Reason, text: str) -> None:
        self._held_hazard, self._held_until = (reason, text), now + HAZARD_HOLD

    @property
    def stop_hazard(self) -> Hazard | None:
        """The hazard that the operator stops the robot with the remote control; None if not."""
        return (Reason.REMOTE, "L2 and B of the remote control are pressed") if self._stop else None

    def hazard(self, now: int) -> Hazard | None:
        """Return why the motors must not move, or None."""
        silence = now - self._new_at
        if silence >= STATE_TIMEOUT and self._polls >= MIN_POLLS:
            since = "no state has arrived" if self.tick is None else f"no new state for {1e-3 * silence:.0f} ms"
            if self._bad >= MIN_POLLS:
                return Reason.STATES_DAMAGED, f"{since}: {self._bad} messages were damaged or had another layout"
            if self._repeats >= MIN_POLLS:
                return Reason.STATES_FROZEN, f"{since}: the robot repeats tick {self.tick}"
            return Reason.STATES_LATE, since
        if self.stop_hazard is not None:
            return self.stop_hazard
        if self._state_hazard is not None:
            return self._state_hazard
        return self._held_hazard if self._held_hazard is not None and now < self._held_until else None

    def vitals(self, now: int, hazard: Hazard | None = None) -> Vitals:
        """Return the readings that the board checks in every servo step; `hazard` has priority over other hazards."""
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
        """Return the readings for a state message of the wire protocol."""
        return Sensors(
            np.array(self._angle),
            np.array(self._velocity),
            np.array(self._torque),
            np.array(self._roll_pitch_yaw),
            np.array(self._rate),
            self.energy,
            self.voltage,
            np.array(self._temperature, float),
            np.array(self._force),
        )


def battery_voltage(cells: Sequence[int], power_v: float) -> float:
    """Return the battery voltage [V]: the sum of the cells [mV], or `power_v` [V] if a state has no cells."""
    volts = [1e-3 * cell for cell in cells if _CELL_RANGE[0] <= 1e-3 * cell <= _CELL_RANGE[1]]
    return sum(volts) if volts else power_v
