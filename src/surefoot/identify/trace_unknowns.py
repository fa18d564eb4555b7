"""What recorded runs are asked for: the numbers to find, what was known about them before, and where to begin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from surefoot.identify.actuator_model import BATTERY_RESISTANCE, VOLTAGE_CHANGE
from surefoot.identify.fits.motor import GAIN
from surefoot.identify.fitting import Unknown
from surefoot.identify.rack_model import TORQUE_GAIN
from surefoot.identify.trace_rows import Piece
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
_VALLEYS = 2
_NEAR = 0.01
_GRID = (0.002, 0.001)
_GRID_ROWS = 800
_TINY = 1e-6


def latency_valleys(
    robot: RobotDescription, pieces: Sequence[Piece], bounds: dict[str, tuple[float, float]], known: PhysicalParams
) -> list[tuple[float, float, float]]:
    """Where latencies may be: mean square error of currents [A2], control latency and servo latency [s], best first.

    Within the duty's limits a current is linear in what is not known but latencies, so that these have a least squares
    solution each:

        I = (k_p U / R) (q_target - q_seen) - (k_d U / R) qdot_seen - (K_t / R) qdot
    """
    axes = [
        np.arange(low, high + 0.5 * step, step)
        for (low, high), step in zip((bounds[name] for name in LATENCIES), _GRID, strict=True)
    ]
    total = sum(len(piece.rows) for piece in pieces)
    every = max(total // _GRID_ROWS, 1)
    thin = [replace(piece, rows=piece.rows[::every]) for piece in pieces if len(piece.rows[::every])]
    currents, torques = robot.torque_table
    nominal = [piece.torque / np.maximum(known.motor_strength[0], 1e-3) for piece in thin]
    current = np.concatenate([np.sign(t) * np.interp(np.abs(t), torques, currents) for t in nominal])
    # Beyond the table's last torque a current is anything.
    inside = np.concatenate([np.abs(t) < 0.95 * torques[-1] for t in nominal])
    target = np.concatenate([piece.target for piece in thin])
    cost = np.full([len(axis) for axis in axes], np.inf)
    for i, late in enumerate(axes[0]):
        speed = np.concatenate([piece.motion(0.0, late)[1] for piece in thin])
        for j, servo in enumerate(axes[1]):
            seen = [piece.motion(servo, late) for piece in thin]
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
    pieces: Sequence[Piece],
) -> list[Unknown]:
    """What is to be found in pieces of traces, and what a fit needs besides.

    Args:
        robot: what it allows.
        wanted: physical parameters.
        known: what was known before, one row.
        latencies: control and servo latency [s] of the valley to look in.
        moving: which motors move (M,).
        pieces: what is fitted.
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
            if name == "servo_latency":
                before = float(known.servo_latency[0])
                unknowns.append(Unknown(name, before, low, high, step, prior=SERVO_LATENCY_SPREAD))
            else:
                unknowns.append(Unknown(name, found, low, high, step))
        elif name == "motor_strength":
            for motor in np.flatnonzero(moving).tolist():
                start = float(known.motor_strength[0, motor])
                prior = SPREAD * max(start, nominal[name])
                unknowns.append(Unknown(name, start, low, high, step, motor, prior, 0))
        else:
            start = float(getattr(known, name)[0])
            prior = (VOLTAGE_SPREAD if name == "voltage" else SPREAD) * start
            unknowns.append(Unknown(name, start, low, high, step, prior=max(prior, 1e-3 * high)))
    if "motor_strength" not in wanted:
        unknowns += [
            Unknown(TORQUE_GAIN, 0.0, -0.5, 0.5, _TINY, motor, GAIN, 0) for motor in np.flatnonzero(moving).tolist()
        ]
    unknowns.append(Unknown(BATTERY_RESISTANCE, 0.01, 0.0, 0.2, 1e-8, prior=0.03))
    unknowns += [Unknown(VOLTAGE_CHANGE, 0.0, -3.0, 3.0, 1e-5, piece.number, CHANGE, 1) for piece in pieces[1:]]
    return unknowns
