"""Plug-in with a reward term and an observation, which the task `examples/plugin.yaml` uses.

    surefoot train examples/plugin.yaml --plugin examples/plugin.py

It is an ordinary Python file that registers functions on NumPy arrays, each for a batch of N robots.
"""

import numpy as np

from surefoot.arrays import Array
from surefoot.task.plugins import observation, reward_term
from surefoot.task.state import EnvState, RobotState

CLEARANCE = 0.15
"""Target height of a swinging foot above the lowest foot, in leg lengths."""


@reward_term(
    "foot_clearance",
    unit="squared error of the height times speed, l^2 sqrt(g l)",
    source="Ji et al. 2022, Concurrent Training of a Control Policy and a State Estimator",
)
def foot_clearance(state: EnvState) -> Array:
    """Return the mean squared height error of feet that move forward, weighted by their speed (N,)."""
    robot, scales = state.gait.robot, state.scales
    feet = [
        robot.leg_geometry.foot_position(truth.motor_angle[:, robot.leg_motor_index])
        for truth in (state.before, state.truth)
    ]
    height = (feet[1][..., 2] - feet[1][..., 2].min(axis=1, keepdims=True)) / scales.length
    # Feet on the ground move backward in the base's frame.
    speed = np.maximum((feet[1] - feet[0])[..., 0] / state.duration[:, None], 0.0) / scales.speed
    return np.asarray(((height - CLEARANCE) ** 2 * speed).mean(axis=1))


@observation("lean", unit="1", frame="world", columns=("lean_roll", "lean_pitch"), flipped=("lean_roll",))
def lean(state: RobotState) -> Array:
    """Return the sines of the IMU's roll and pitch (N, 2)."""
    return np.sin(state.readings.roll_pitch_yaw[:, :2])
