"""When a motor is first reported to have moved after a spike of torque."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surefoot.deploy.wire.messages import Mode
from surefoot.identify.recording import Recording

Array = NDArray[np.float64]

SPIKES = ("spikes", Mode.PWM)
"""Name and mode of the phases that have spikes."""
WINDOW = 0.014
"""Time after the first motion [s] whose readings are fitted; later the spike's speed has faded."""
BEFORE = 0.010
"""Time before a spike [s] whose readings are fitted."""
LONGEST, AGE_STEP = 0.08, 0.0002
"""Greatest age that is looked for, and step between ages that are tried [s]."""
CLEAR = 8.0
"""How many times the noise of speeds a spike's speed must be to count."""


@dataclass(frozen=True)
class Spikes:
    """Delays of K answers to spikes; motors that hardly moved are left out."""

    age: Array
    """Of the readings when states are sent by the robot (K,) [s]."""
    host: Array
    """From sending the spike to the first state that tells of motion, on the host's clock (K,) [s]."""
    tried: int
    """Spikes given to motors."""


def measure_spikes(recording: Recording) -> Spikes:
    """Fit each motor's answer to each spike.

    A torque from 0 to T gives a free motor the way v (t^2 / 2T) until T and v (t - T/2) later; braking adds
    c (t - T)^2. Readings of time t are as they were at t - age.
    """
    dt = float(recording.meta["servo_period"])
    ages, hosts, tried = [], [], 0
    driven = np.abs(recording.sent_value).max(axis=1) > 0
    groups = [k for k, phase in enumerate(recording.meta["phases"]) if (phase["name"], phase["mode"]) == SPIKES]
    for c in np.flatnonzero(driven[:-1] & np.isin(recording.sent_phase[:-1], groups)):
        begin, end = dt * recording.servo_step(recording.arrival[c : c + 2])
        kept = (recording.time > begin - BEFORE) & (recording.time < begin + LONGEST + WINDOW)
        best, moved = _first_motion(
            recording.time[kept] - begin,
            recording.motor_angle[kept],
            recording.motor_velocity[kept],
            float(end - begin),
        )
        tried += len(best)
        told = np.interp(begin + best, recording.time, recording.host_time) - recording.sent_time[c]
        ages += best[moved].tolist()
        hosts += told[moved].tolist()
    return Spikes(np.array(ages), np.array(hosts), tried)


def _first_motion(since: Array, angles: Array, speeds: Array, length: float) -> tuple[Array, NDArray[np.bool_]]:
    """Age at which the fit of each motor's readings (T, M) is best (M,) [s], and whether it clearly moved."""
    found, clear = np.zeros(angles.shape[1]), np.zeros(angles.shape[1], np.bool_)
    quiet = since <= 0
    before = np.median(speeds[quiet], axis=0)
    # Of all motors: a handful of readings of one tell their noise badly.
    noise = float(np.std(speeds[quiet] - before)) + 1e-9
    for motor in range(angles.shape[1]):
        # Where its speed has half of what the spike gives it: about when it began to move.
        gained = np.abs(speeds[:, motor] - before[motor])
        at = int(np.argmax(gained > gained.max() / 2))
        rough = float(since[at])
        if gained.max() < CLEAR * noise or rough < 0:
            continue
        used = (since > rough - BEFORE) & (since < rough + WINDOW)
        ages = rough + np.arange(-0.006, 0.003, AGE_STEP)
        costs = [_cost(since[used], angles[used, motor], age, length) for age in ages]
        best = int(np.argmin(costs))
        if not 0 < best < len(ages) - 1:
            continue
        low, middle, high = costs[best - 1 : best + 2]
        curved = low - 2 * middle + high
        found[motor] = ages[best] + (AGE_STEP * 0.5 * (low - high) / curved if curved > 0 else 0.0)
        clear[motor] = True
    return found, clear


def _cost(since: Array, angles: Array, age: float, length: float) -> float:
    """Sum of squares [rad2] that is left of one motor's angles (T,), with an age of its readings."""
    t = np.maximum(since - age, 0.0)
    way = np.where(t < length, t * t / (2 * length), t - length / 2)
    basis = np.stack([np.ones_like(t), since, way, np.maximum(t - length, 0.0) ** 2], axis=1)
    found, *_ = np.linalg.lstsq(basis, angles, rcond=None)
    return float(np.sum((angles - basis @ found) ** 2))
