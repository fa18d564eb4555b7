"""Motor torques of recorded runs, predicted by the motor model without simulating the body: observations and unknowns.

`identify.motion.torque_rows` defines the times of the values. The battery voltage sags under load to U - R_b P / U,
with the open-circuit voltage U, the internal resistance R_b, and the power P = sum of I (R I + K_t w) over the motors.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from surefoot.actuator import motor_current, motor_torque, servo_duty
from surefoot.arrays import Array
from surefoot.identify.model import GAIN_DEVIATION, TORQUE_GAIN, Nuisance, Observations, Unknown
from surefoot.identify.motion.torque_rows import TorqueRows, subsample
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import GAINS

MASS = "base_mass_ratio"
NAMES = (
    *("motor_strength", "torque_constant", "resistance", "voltage"),
    *(*GAINS, "servo_latency", "control_latency", MASS),
)
"""Physical parameters that traces can identify."""
DEFAULT_NAMES = tuple(name for name in NAMES if name not in (*GAINS, MASS))
"""Parameters that are identified by default. Gains are set in the firmware, and unless duties are often at their limit,
traces determine only gains times U / R. The mass of the base needs legs of known mass."""
LATENCIES = ("control_latency", "servo_latency")
RELATIVE_DEVIATION = 0.2
"""Relative standard deviation of priors: how much a robot deviates from its data sheet."""
VOLTAGE_DEVIATION = 0.05
"""Relative standard deviation of the battery voltage: 14 to 16.8 V in use (Tan et al. 2018), 16 V nominal."""
VOLTAGE_CHANGE_DEVIATION = 0.3
"""Standard deviation of the voltage between traces [V]: a battery loses some 0.25 V per ampere hour."""
SERVO_LATENCY_DEVIATION = 0.002
"""Standard deviation of the servo latency [s]."""
BATTERY_RESISTANCE = "battery_resistance"
"""Internal resistance of the battery [Ohm]; not a parameter of the simulation."""
VOLTAGE_CHANGE = "voltage_change"
"""Open-circuit voltage of a trace minus that of the first trace [V]; not a parameter of the simulation."""
NOISE = 0.12
"""Standard deviation of compared torques [N m]. Reported torques have a noise of 0.02, and predictions with the true
parameters have an error of 0.022; but interpolation errors repeat in every stride and do not average out. The noise is
six times as large, so that intervals contain the true values of emulated robots."""
REMAINING_ERROR = 0.022
"""Root mean square error of predictions with the true parameters [N m]; a larger error increases `NOISE`."""
_SAG_ROUNDS = 2
_MAX_MINIMA = 2
_LATENCY_REACH = 0.01
_GRID = (0.002, 0.001)
_GRID_ROWS = 800
_RELATIVE_STEP = 1e-6


def predict_torque(robot: RobotDescription, segment: TorqueRows, params: PhysicalParams, nuisance: Nuisance) -> Array:
    """Predict the reported torques (K, rows, M) [N m] in a segment for K rows of parameters."""
    control = params.control_latency.tolist()
    pairs = list(zip(control, params.servo_latency.tolist(), strict=True))
    present = {c: segment.state(0.0, c)[1] for c in set(control)}
    delayed = {(c, s): segment.state(s, c) for c, s in set(pairs)}
    speed = np.stack([present[c] for c in control])
    servo_angle, servo_speed = (np.stack([delayed[pair][part] for pair in pairs]) for part in (0, 1))
    kp, kd, constant, resistance, clip = (
        values.reshape(len(values), 1, -1)
        for values in (params.servo_kp, params.servo_kd, params.torque_constant, params.resistance, params.voltage_clip)
    )
    zeros = np.zeros(len(control))
    open_circuit, battery_resistance = (
        values[:, None, None]
        for values in (
            params.voltage + nuisance.get((VOLTAGE_CHANGE, segment.number), zeros),
            nuisance.get((BATTERY_RESISTANCE, None), zeros),
        )
    )
    gain = np.ones((len(control), robot.num_motors))
    for (name, motor), column in nuisance.items():
        if name == TORQUE_GAIN:
            gain[:, motor] += column
    duty = servo_duty(segment.target, servo_angle, servo_speed, kp, kd)
    table, voltage = robot.torque_table, open_circuit
    for _ in range(_SAG_ROUNDS):
        current = motor_current(duty, speed, voltage, constant, resistance, clip)
        # The battery current is computed from torques (`emulator.hardware.power_tick`), so it is limited by the last
        # current of the torque table.
        current = np.clip(current, -table[0][-1], table[0][-1])
        power = np.sum(current * (resistance * current + constant * speed), axis=2, keepdims=True)
        voltage = open_circuit - battery_resistance * power / open_circuit
    current = motor_current(duty, speed, voltage, constant, resistance, clip)
    torque: Array = motor_torque(current, params.motor_strength[:, None], *table) * gain[:, None]
    return torque


def torque_observations(
    robot: RobotDescription, segment: TorqueRows, moving: NDArray[np.bool_], noise: float = NOISE
) -> Observations:
    """Return the torques of the moving motors (mask (M,)) in a segment as observations with a noise [N m].

    Observations are labelled by motor and trace.
    """
    return Observations(
        lambda params, nuisance: predict_torque(robot, segment, params, nuisance) - segment.torque,
        np.broadcast_to(np.where(moving, noise, np.inf), segment.torque.shape),
        segment.motion.read_time[segment.rows][:, None],
        {"motor": np.arange(robot.num_motors), "trace": np.array(segment.number)},
    )


def rank_latencies(
    robot: RobotDescription,
    segments: Sequence[TorqueRows],
    bounds: dict[str, tuple[float, float]],
    prior: PhysicalParams,
) -> list[tuple[float, float, float]]:
    """Return the local minima over both latencies, best first: mean squared error [A2], control and servo latency [s].

    While the duty is within its limits, the current is linear in all unknowns except the latencies, so that each pair
    of latencies has a least-squares solution:

        I = (k_p U / R) (q_target - q_servo) - (k_d U / R) qdot_servo - (K_t / R) qdot
    """
    axes = [
        np.arange(low, high + 0.5 * step, step)
        for (low, high), step in zip((bounds[name] for name in LATENCIES), _GRID, strict=True)
    ]
    every = max(sum(len(segment.rows) for segment in segments) // _GRID_ROWS, 1)
    subset = [segment for segment in subsample(segments, every) if len(segment.rows)]
    currents, torques = robot.torque_table
    torque = np.concatenate([segment.torque for segment in subset]) / np.maximum(prior.motor_strength[0], 1e-3)
    current = np.sign(torque) * np.interp(np.abs(torque), torques, currents)
    # The current is undetermined where the torque saturates, at the end of the table.
    inside = np.abs(torque) < 0.95 * torques[-1]
    target = np.concatenate([segment.target for segment in subset])
    cost = np.full([len(axis) for axis in axes], np.inf)
    for i, control in enumerate(axes[0]):
        speed = np.concatenate([segment.state(0.0, control)[1] for segment in subset])
        for j, servo in enumerate(axes[1]):
            angles, speeds = zip(*(segment.state(servo, control) for segment in subset), strict=True)
            error = target - np.concatenate(angles)
            terms = np.stack([error, np.concatenate(speeds), speed], axis=-1)
            # The current is not linear where the duty is at its limit.
            free = inside & (np.abs(error * prior.servo_kp[0] - terms[..., 1] * prior.servo_kd[0]) < 1.0)
            a, b = terms[free], current[free]
            if len(b) > 10:
                solution = np.linalg.lstsq(a.T @ a, a.T @ b, rcond=1e-9)[0]
                cost[i, j] = np.mean((b - a @ solution) ** 2)
    around = np.pad(cost, 1, constant_values=np.inf)
    shifts = [(i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    lowest = np.all([cost <= around[i : i + cost.shape[0], j : j + cost.shape[1]] for i, j in shifts], axis=0)
    minima = sorted((float(cost[i, j]), float(axes[0][i]), float(axes[1][j])) for i, j in np.argwhere(lowest))
    # If latencies trade off against gains, a minimum is flat; its point nearest to the prior servo latency is added.
    nearest = int(np.argmin(np.abs(axes[1] - prior.servo_latency[0])))
    likely = int(np.argmin(cost[:, nearest]))
    minima = [*minima[:_MAX_MINIMA], (float(cost[likely, nearest]), float(axes[0][likely]), float(axes[1][nearest]))]
    minima = list(dict.fromkeys(minimum for minimum in minima if np.isfinite(minimum[0])))
    # If motors are always at their limits, the latencies are undetermined and the prior is used.
    return minima or [(float("inf"), float(prior.control_latency[0]), float(prior.servo_latency[0]))]


def torque_unknowns(
    robot: RobotDescription,
    names: Sequence[str],
    prior: PhysicalParams,
    latencies: tuple[float, float],
    moving: NDArray[np.bool_],
    segments: Sequence[TorqueRows],
) -> list[Unknown]:
    """Return the unknowns of a fit to segments of traces: the named parameters, and nuisance unknowns.

    Args:
        robot: robot description.
        names: physical parameters to identify.
        prior: parameters before the fit, one row.
        latencies: control and servo latency [s] at a local minimum, where the fit starts.
        moving: mask of the moving motors (M,).
        segments: fitted segments.
    """
    nominal, motors = robot.nominal_params(), np.flatnonzero(moving).tolist()
    unknowns = []
    for name in names:
        low, high = robot.allowed[name]
        step = _RELATIVE_STEP * (0.01 if name in LATENCIES else nominal[name])
        if name in LATENCIES:
            middle = latencies[LATENCIES.index(name)]
            # The fit stays near one local minimum; `usable_rows` leaves room for all allowed latencies.
            low, high = max(low, middle - _LATENCY_REACH), min(high, middle + _LATENCY_REACH)
            servo = name == "servo_latency"
            start, deviation = (float(prior.servo_latency[0]), SERVO_LATENCY_DEVIATION) if servo else (middle, None)
            unknowns.append(Unknown(name, start, low, high, step, prior=deviation))
        elif name == "motor_strength":
            for motor in motors:
                start = float(prior.motor_strength[0, motor])
                deviation = RELATIVE_DEVIATION * max(start, nominal[name])
                unknowns.append(Unknown(name, start, low, high, step, motor, deviation, 0, ("motor", motor)))
        else:
            start = float(np.mean(getattr(prior, name)[0]))
            deviation = (VOLTAGE_DEVIATION if name == "voltage" else RELATIVE_DEVIATION) * start
            unknowns.append(Unknown(name, start, low, high, step, prior=max(deviation, 1e-3 * high)))
    if "motor_strength" not in names:
        unknowns += [
            Unknown(TORQUE_GAIN, 0.0, -0.5, 0.5, _RELATIVE_STEP, motor, GAIN_DEVIATION, 0, ("motor", motor))
            for motor in motors
        ]
    unknowns.append(Unknown(BATTERY_RESISTANCE, 0.01, 0.0, 0.2, 1e-8, prior=0.03))
    changes = [(segment.number, ("trace", segment.number)) for segment in segments[1:]]
    return unknowns + [
        Unknown(VOLTAGE_CHANGE, 0.0, -3.0, 3.0, 1e-5, number, VOLTAGE_CHANGE_DEVIATION, 1, affects)
        for number, affects in changes
    ]
