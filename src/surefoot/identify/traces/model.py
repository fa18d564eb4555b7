"""Torques of recorded runs by the motors' own law, without a body: the model, its unknowns, where to start a fit.

`identify.trace_data` says which value is of which time. The battery sags: its voltage is U - R_b P / U, with
open-circuit voltage U, internal resistance R_b and P = sum of I (R I + K_t w) over the motors.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from surefoot.actuator import motor_current, motor_torque, servo_duty
from surefoot.arrays import Array
from surefoot.identify.fitting import BLOCK, GAIN, TORQUE_GAIN, Unknown, params_of
from surefoot.identify.traces.data import TraceSegment, thinned
from surefoot.robot import PhysicalParams, RobotDescription

MASS = "base_mass_ratio"
NAMES = (
    *("motor_strength", "torque_constant", "resistance", "voltage"),
    *("servo_kp", "servo_kd", "servo_latency", "control_latency", MASS),
)
"""Physical parameters that traces can tell."""
USUAL = tuple(name for name in NAMES if name not in ("servo_kp", "servo_kd", MASS))
"""Those that are found if nothing else is said: gains are numbers that somebody gave the firmware, and unless duties
are often at their limit traces tell gains times U / R only. The base's mass takes legs whose mass is known."""
LATENCIES = ("control_latency", "servo_latency")
SPREAD = 0.2
"""Relative standard deviation of what was known before, for a robot that is not what its data sheet says."""
VOLTAGE_SPREAD = 0.05
"""The same for the battery's voltage: 14 to 16.8 V in use (Tan et al. 2018) for 16 V nominal."""
CHANGE = 0.3
"""Standard deviation of the voltage from trace to trace [V]: a battery loses some .25 V an ampere hour."""
SERVO_LATENCY_SPREAD = 0.002
"""Standard deviation of the servo's latency as it was known before [s]."""
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
_VALLEYS = 2
_NEAR = 0.01
_GRID = (0.002, 0.001)
_GRID_ROWS = 800
_TINY = 1e-6


class TorqueModel:
    """Residuals of the torques that a robot's motors reported in segments of traces.

    Args:
        robot: its description.
        segments: of traces.
        unknowns: what is to be found.
        base: all that is not, one row.
        motors: which motors are compared (M,).
        noise: standard deviation with which torques are compared [N m].
    """

    def __init__(
        self,
        robot: RobotDescription,
        segments: Sequence[TraceSegment],
        unknowns: Sequence[Unknown],
        base: PhysicalParams,
        motors: NDArray[np.bool_],
        noise: float = NOISE,
    ) -> None:
        self.robot, self.segments, self.base, self.noise = robot, segments, base, noise
        self.unknowns: Sequence[Unknown] = tuple(unknowns)
        self._compared = np.flatnonzero(motors)
        blocks, traces = [], []
        for segment in segments:
            # Numbers of blocks of different traces must differ.
            times = segment.trace.time[segment.rows] / BLOCK + 1e6 * segment.number
            blocks.append(np.repeat(times.astype(np.int64), len(self._compared)))
            traces.append(np.full(len(blocks[-1]), segment.number))
        self.blocks = np.concatenate(blocks)
        self._trace = np.concatenate(traces)
        self._motor = np.tile(self._compared, len(self.blocks) // len(self._compared))

    def touched(self, unknown: int) -> NDArray[np.bool_] | None:
        """Return the residuals of the motor, or of the trace, to which an unknown belongs."""
        name, index = self.unknowns[unknown].name, self.unknowns[unknown].index
        if index is None:
            return None
        return (self._trace if name == VOLTAGE_CHANGE else self._motor) == index

    def residuals(self, values: Array) -> Array:
        """Return residuals (K, m) of K candidates (K, n)."""
        parts = [
            (torque - segment.torque)[:, :, self._compared].reshape(len(values), -1) / self.noise
            for segment, torque in zip(self.segments, self.torques(values), strict=True)
        ]
        return np.concatenate(parts, axis=1)

    def torques(self, values: Array) -> list[Array]:
        """Return the torques that K candidates (K, n) would have reported, (K, rows, M) [N m] for each segment."""
        count, motors = len(values), self.robot.num_motors
        params = params_of(self.base, self.unknowns, values)
        sag, gain = np.zeros(count), np.ones((count, motors))
        change = np.zeros((count, 1 + max(segment.number for segment in self.segments)))
        for i, unknown in enumerate(self.unknowns):
            if unknown.name == BATTERY_RESISTANCE:
                sag = values[:, i]
            elif unknown.name == TORQUE_GAIN:
                gain[:, unknown.index] += values[:, i]
            elif unknown.name == VOLTAGE_CHANGE:
                change[:, unknown.index] = values[:, i]
        return [
            self._torque(segment, params, params.voltage + change[:, segment.number], sag) * gain[:, None]
            for segment in self.segments
        ]

    def _torque(self, segment: TraceSegment, params: PhysicalParams, open_circuit: Array, sag: Array) -> Array:
        late = params.control_latency.tolist()
        pairs = list(zip(late, params.servo_latency.tolist(), strict=True))
        now = {c: segment.motion(0.0, c)[1] for c in set(late)}
        before = {(c, s): segment.motion(s, c) for c, s in set(pairs)}
        speed = np.stack([now[c] for c in late])
        seen_angle, seen_speed = (np.stack([before[pair][part] for pair in pairs]) for part in (0, 1))
        kp, kd, constant, resistance = (
            values.reshape(len(values), 1, -1)
            for values in (params.servo_kp, params.servo_kd, params.torque_constant, params.resistance)
        )
        open_circuit, sag = open_circuit[:, None, None], sag[:, None, None]
        duty = servo_duty(segment.target, seen_angle, seen_speed, kp, kd)
        table = self.robot.torque_table
        clip = self.robot.dc_motor.voltage_clip
        voltage = open_circuit
        for _ in range(_SAG_ROUNDS):
            current = motor_current(duty, speed, voltage, constant, resistance, clip)
            # The battery's current follows from torques (`emulator.hardware.power_tick`): at most the table's last one.
            current = np.clip(current, -table[0][-1], table[0][-1])
            power = np.sum(current * (resistance * current + constant * speed), axis=2, keepdims=True)
            voltage = open_circuit - sag * power / open_circuit
        current = motor_current(duty, speed, voltage, constant, resistance, clip)
        torque: Array = motor_torque(current, params.motor_strength[:, None], *table)
        return torque


def latency_valleys(
    robot: RobotDescription,
    segments: Sequence[TraceSegment],
    bounds: dict[str, tuple[float, float]],
    known: PhysicalParams,
) -> list[tuple[float, float, float]]:
    """Return where latencies may be, best first: mean square error of currents [A2], control and servo latency [s].

    Within the duty's limits a current is linear in what is not known but latencies, so that these have a least squares
    solution each:

        I = (k_p U / R) (q_target - q_seen) - (k_d U / R) qdot_seen - (K_t / R) qdot
    """
    axes = [
        np.arange(low, high + 0.5 * step, step)
        for (low, high), step in zip((bounds[name] for name in LATENCIES), _GRID, strict=True)
    ]
    total = sum(len(segment.rows) for segment in segments)
    every = max(total // _GRID_ROWS, 1)
    thin = [segment for segment in thinned(segments, every) if len(segment.rows)]
    currents, torques = robot.torque_table
    nominal = [segment.torque / np.maximum(known.motor_strength[0], 1e-3) for segment in thin]
    current = np.concatenate([np.sign(t) * np.interp(np.abs(t), torques, currents) for t in nominal])
    # Beyond the table's last torque a current is anything.
    inside = np.concatenate([np.abs(t) < 0.95 * torques[-1] for t in nominal])
    target = np.concatenate([segment.target for segment in thin])
    cost = np.full([len(axis) for axis in axes], np.inf)
    for i, late in enumerate(axes[0]):
        speed = np.concatenate([segment.motion(0.0, late)[1] for segment in thin])
        for j, servo in enumerate(axes[1]):
            seen = [segment.motion(servo, late) for segment in thin]
            error = target - np.concatenate([part[0] for part in seen])
            terms = np.stack([error, np.concatenate([part[1] for part in seen]), speed], axis=-1)
            # Where the duty is at its limit the law is another one.
            free = inside & (np.abs(error * known.servo_kp[0] - terms[..., 1] * known.servo_kd[0]) < 1.0)
            a, b = terms[free], current[free]
            if len(b) > 10:
                solution = np.linalg.lstsq(a.T @ a, a.T @ b, rcond=1e-9)[0]
                cost[i, j] = np.mean((b - a @ solution) ** 2)
    around = np.pad(cost, 1, constant_values=np.inf)
    shifts = [(i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    lowest = np.all([cost <= around[i : i + cost.shape[0], j : j + cost.shape[1]] for i, j in shifts], axis=0)
    places = sorted((float(cost[i, j]), float(axes[0][i]), float(axes[1][j])) for i, j in np.argwhere(lowest))
    # Where latencies go with gains a valley is long: the place in it that is nearest to what was known is tried too.
    nearest = int(np.argmin(np.abs(axes[1] - known.servo_latency[0])))
    likely = int(np.argmin(cost[:, nearest]))
    places = [*places[:_VALLEYS], (float(cost[likely, nearest]), float(axes[0][likely]), float(axes[1][nearest]))]
    places = list(dict.fromkeys(place for place in places if np.isfinite(place[0])))
    # Motors that are always at their limits tell nothing of latencies: what was known is as good as anything.
    return places or [(float("inf"), float(known.control_latency[0]), float(known.servo_latency[0]))]


def unknowns_of(
    robot: RobotDescription,
    wanted: Sequence[str],
    known: PhysicalParams,
    latencies: tuple[float, float],
    moving: NDArray[np.bool_],
    segments: Sequence[TraceSegment],
) -> list[Unknown]:
    """Return what is to be found in segments of traces, and what a fit needs besides.

    Wanted are physical parameters; known is one row; the latencies [s], control and servo, are of the valley to look
    in; moving tells which motors move (M,).
    """
    nominal = robot.nominal_params()
    unknowns = []
    for name in wanted:
        low, high = robot.allowed[name]
        step = _TINY * (0.01 if name in LATENCIES else nominal[name])
        if name in LATENCIES:
            found = latencies[LATENCIES.index(name)]
            # One valley: `usable_rows` leaves room for all that is allowed.
            low, high = max(low, found - _NEAR), min(high, found + _NEAR)
            servo = name == "servo_latency"
            start = float(known.servo_latency[0]) if servo else found
            unknowns.append(Unknown(name, start, low, high, step, prior=SERVO_LATENCY_SPREAD if servo else None))
        elif name == "motor_strength":
            for motor in np.flatnonzero(moving).tolist():
                start = float(known.motor_strength[0, motor])
                prior = SPREAD * max(start, nominal[name])
                unknowns.append(Unknown(name, start, low, high, step, motor, prior, 0))
        else:
            start = float(np.mean(getattr(known, name)[0]))
            prior = (VOLTAGE_SPREAD if name == "voltage" else SPREAD) * start
            unknowns.append(Unknown(name, start, low, high, step, prior=max(prior, 1e-3 * high)))
    if "motor_strength" not in wanted:
        unknowns += [
            Unknown(TORQUE_GAIN, 0.0, -0.5, 0.5, _TINY, motor, GAIN, 0) for motor in np.flatnonzero(moving).tolist()
        ]
    unknowns.append(Unknown(BATTERY_RESISTANCE, 0.01, 0.0, 0.2, 1e-8, prior=0.03))
    unknowns += [Unknown(VOLTAGE_CHANGE, 0.0, -3.0, 3.0, 1e-5, segment.number, CHANGE, 1) for segment in segments[1:]]
    return unknowns
