"""Traces whose numbers are known by construction."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from surefoot.task.trace import EpisodeTrace

LEGS = ["front_left", "back_left", "front_right", "back_right"]


def trace_of_run(distance: float = 3.0, energy: float = 100.0, steps: int = 100, **meta: Any) -> EpisodeTrace:
    """A run of 10 ms control steps that came so far [m] with so much energy [J]; NaN: not known how far."""
    time = 0.01 * np.arange(1, steps + 1)
    position = np.zeros((steps + 1, 3))
    position[:, 0] = np.linspace(0.0, distance, steps + 1)
    return EpisodeTrace(
        time=time,
        base_position_world=position if np.isfinite(distance) else np.full_like(position, np.nan),
        base_quat_world=np.tile([1.0, 0.0, 0.0, 0.0], (steps + 1, 1)),
        roll_pitch_yaw=np.zeros((steps, 3)),
        angular_velocity_base=np.zeros((steps, 3)),
        motor_angle=np.zeros((steps, 8)),
        motor_velocity=np.zeros((steps, 8)),
        motor_torque=np.zeros((steps, 8)),
        observation=np.zeros((steps, 1)),
        feedback=np.zeros((steps, 8)),
        target=np.zeros((steps, 8)),
        energy=np.full(steps, energy / steps),
        foot_contact=np.ones((steps, 4)),
        meta={
            "robot": "minitaur",
            "world": "mujoco",
            "policy": "trot",
            "control_step": 0.01,
            "leg_names": LEGS,
            "motor_names": [f"m{i}" for i in range(8)],
            "observation_names": ["roll"],
            "energy_weight": 0.008,
            "ended": "time",
            **meta,
        },
    )


@pytest.fixture(scope="session")
def make_run() -> Callable[..., EpisodeTrace]:
    return trace_of_run
