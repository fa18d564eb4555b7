"""Runs over time in several worlds: written, and power by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.report.side_by_side import _mean_power, side_by_side
from surefoot.task.trace import EpisodeTrace

pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")


def trace(steps: int = 200, distance: float = 1.0) -> EpisodeTrace:
    """A run of 10 ms steps and 20 W."""
    position = np.zeros((steps + 1, 3))
    position[:, 0] = np.linspace(0.0, distance, steps + 1)
    zeros, motors = np.zeros((steps, 3)), np.zeros((steps, 8))
    return EpisodeTrace(
        time=0.01 * np.arange(1, steps + 1),
        base_position_world=position,
        base_quat_world=np.tile([1.0, 0.0, 0.0, 0.0], (steps + 1, 1)),
        roll_pitch_yaw=zeros,
        angular_velocity_base=zeros,
        motor_angle=motors,
        motor_velocity=motors,
        motor_torque=motors,
        observation=zeros[:, :1],
        feedback=motors,
        target=motors,
        energy=np.full(steps, 0.2),
        foot_contact=np.ones((steps, 4)),
        meta={
            "robot": "minitaur",
            "world": "mujoco",
            "control_step": 0.01,
            "leg_names": ["front_left", "back_left", "front_right", "back_right"],
            "motor_names": [f"motor_{i}" for i in range(8)],
            "observation_names": ["roll"],
            "ended": "time",
        },
    )


@pytest.mark.parametrize("steps", [1, 20, 200, 1000])
@pytest.mark.filterwarnings("error")
def test_a_figure_is_written(steps: int, tmp_path: Path):
    unseen = trace(steps, math.nan)
    path = side_by_side({"home": [trace(steps), trace(steps)], "robot": [unseen]}, tmp_path / "runs.png", "trot")
    with Image.open(path) as picture:
        assert picture.format == "PNG"
        assert picture.size[0] > 800


def test_power_is_the_energy_of_the_last_half_second():
    run = trace(200)
    # 20 W for a second, then 60 W.
    run = replace(run, energy=np.where(run.time > 1.0, 0.6, 0.2))
    times, power = _mean_power(run)
    assert np.allclose(power[times < 1.0 - 1e-9], 20.0)
    assert power[124] == pytest.approx(40.0)  # half of it in either
    assert power[-1] == pytest.approx(60.0)


def test_a_world_without_runs_is_refused(tmp_path: Path):
    for runs in ({}, {"home": []}):
        with pytest.raises(SurefootError, match="every world needs one run or more"):
            side_by_side(runs, tmp_path / "runs.png")
