"""The motors' own law along a recorded run: torques that follow from targets, angles and speeds, and no body.

What is of which time `identify.trace_rows` says. The battery sags: its voltage is U - R_b P / U, with open-circuit
voltage U, internal resistance R_b and P = sum of I (R I + K_t w) over the motors.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from surefoot.actuator import motor_current, motor_torque, servo_duty
from surefoot.identify.fitting import Unknown
from surefoot.identify.rack_model import BLOCK, TORQUE_GAIN
from surefoot.identify.trace_rows import Piece
from surefoot.robot import PhysicalParams, RobotDescription

Array = NDArray[np.float64]

BATTERY_RESISTANCE = "battery_resistance"
"""Internal resistance of the battery [Ohm]; nothing that a simulation needs."""
VOLTAGE_CHANGE = "voltage_change"
"""Open-circuit voltage of a trace less that of the first one [V]; nothing that a simulation needs."""
NOISE = 0.12
"""Standard deviation [N m] with which a torque is compared. Reports have .02, and along true parameters predictions are
within .022 of them; but errors of interpolation are the same in every stride and do not average out, so that a row
tells less than one of white noise would. Six times as much gives intervals that hold the truth of emulated robots."""
EXPLAINED = 0.022
"""Root mean square error [N m] that is left along true parameters; more of it makes `NOISE` so much larger."""
_SAG_ROUNDS = 2


class ActuatorModel:
    """Residuals of the torques that a robot's motors reported.

    Args:
        robot: its description.
        pieces: of traces.
        unknowns: what is to be found.
        base: all that is not, one row.
        motors: which motors are compared (M,).
        noise: standard deviation with which torques are compared [N m].
    """

    def __init__(
        self,
        robot: RobotDescription,
        pieces: Sequence[Piece],
        unknowns: Sequence[Unknown],
        base: PhysicalParams,
        motors: NDArray[np.bool_],
        noise: float = NOISE,
    ) -> None:
        self.robot, self.pieces, self.base, self.noise = robot, pieces, base, noise
        self.unknowns: Sequence[Unknown] = tuple(unknowns)
        self._compared = np.flatnonzero(motors)
        blocks, traces = [], []
        for piece in pieces:
            # Numbers of blocks of different traces must differ.
            times = piece.trace.time[piece.rows] / BLOCK + 1e6 * piece.number
            blocks.append(np.repeat(times.astype(np.int64), len(self._compared)))
            traces.append(np.full(len(blocks[-1]), piece.number))
        self.blocks = np.concatenate(blocks)
        self._trace = np.concatenate(traces)
        self._motor = np.tile(self._compared, len(self.blocks) // len(self._compared))

    def touched(self, unknown: int) -> NDArray[np.bool_] | None:
        """Residuals of the motor, or of the trace, to which an unknown belongs."""
        name, index = self.unknowns[unknown].name, self.unknowns[unknown].index
        if index is None:
            return None
        return (self._trace if name == VOLTAGE_CHANGE else self._motor) == index

    def residuals(self, values: Array) -> Array:
        """Residuals (K, m) of K candidates (K, n)."""
        parts = [
            (torque - piece.torque)[:, :, self._compared].reshape(len(values), -1) / self.noise
            for piece, torque in zip(self.pieces, self.torques(values), strict=True)
        ]
        return np.concatenate(parts, axis=1)

    def torques(self, values: Array) -> list[Array]:
        """Torques that should have been reported, (K, rows, M) [N m] for each piece, of K candidates (K, n)."""
        count, motors = len(values), self.robot.num_motors
        given = {name: np.repeat(getattr(self.base, name), count, axis=0) for name in PhysicalParams.names()}
        sag, gain = np.zeros(count), np.ones((count, motors))
        change = np.zeros((count, 1 + max(piece.number for piece in self.pieces)))
        for i, unknown in enumerate(self.unknowns):
            if unknown.name == BATTERY_RESISTANCE:
                sag = values[:, i]
            elif unknown.name == TORQUE_GAIN:
                gain[:, unknown.index] += values[:, i]
            elif unknown.name == VOLTAGE_CHANGE:
                change[:, unknown.index] = values[:, i]
            elif unknown.index is None:
                given[unknown.name].T[...] = values[:, i]
            else:
                given[unknown.name][:, unknown.index] = values[:, i]
        return [
            self._torque(piece, given, given["voltage"] + change[:, piece.number], sag) * gain[:, None]
            for piece in self.pieces
        ]

    def _torque(self, piece: Piece, given: dict[str, Array], open_circuit: Array, sag: Array) -> Array:
        late = given["control_latency"].tolist()
        pairs = list(zip(late, given["servo_latency"].tolist(), strict=True))
        now = {c: piece.motion(0.0, c)[1] for c in set(late)}
        before = {(c, s): piece.motion(s, c) for c, s in set(pairs)}
        speed = np.stack([now[c] for c in late])
        seen_angle, seen_speed = (np.stack([before[pair][part] for pair in pairs]) for part in (0, 1))
        kp, kd, constant, resistance = (
            given[name][:, None, None] for name in ("servo_kp", "servo_kd", "torque_constant", "resistance")
        )
        open_circuit, sag = open_circuit[:, None, None], sag[:, None, None]
        duty = servo_duty(piece.target, seen_angle, seen_speed, kp, kd)
        table = self.robot.torque_table
        clip = self.robot.actuator.voltage_clip
        voltage = open_circuit
        for _ in range(_SAG_ROUNDS):
            current = motor_current(duty, speed, voltage, constant, resistance, clip)
            # The battery's current follows from torques (`emulator.hardware.power_tick`): at most the table's last one.
            current = np.clip(current, -table[0][-1], table[0][-1])
            power = np.sum(current * (resistance * current + constant * speed), axis=2, keepdims=True)
            voltage = open_circuit - sag * power / open_circuit
        current = motor_current(duty, speed, voltage, constant, resistance, clip)
        torque: Array = motor_torque(current, given["motor_strength"][:, None], *table)
        return torque
