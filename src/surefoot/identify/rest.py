"""What a robot on its rack tells without moving: battery, and errors of roll and pitch."""

from __future__ import annotations

import numpy as np

from surefoot.identify.recording import Recording
from surefoot.identify.result import Estimate

LEVEL = 0.002
"""Standard deviation [rad] of how level a rack is: a spirit level's bubble of .1 degrees."""
VOLTAGE = 0.02
"""Standard deviation [V] of what a battery at rest is said to have: sensor, and charge used meanwhile."""


def imu_estimates(recording: Recording) -> list[Estimate]:
    """Constant error of roll and pitch, and the noise on them, of a base that is held level and still."""
    tilt = recording.roll_pitch_yaw[:, :2]
    count = len(tilt)
    noise = float(np.sqrt(np.mean(tilt.var(axis=0, ddof=1))))
    estimates = [
        Estimate("imu_bias", float(tilt[:, axis].mean()), float(np.hypot(noise / np.sqrt(count), LEVEL)), "rad", axis)
        for axis in range(2)
    ]
    estimates.append(
        Estimate("imu_noise", noise, float(np.hypot(noise / np.sqrt(4 * count), 1e-5 + 0.004 * noise)), "rad", low=0.0)
    )
    return estimates


def rest_voltage(recording: Recording) -> Estimate:
    """Voltage of the battery before motors moved."""
    resting = recording.voltage[: max(int(recording.meta["resting_states"]), 1)]
    return Estimate("voltage", float(np.mean(resting)), VOLTAGE, "V", low=0.0)
