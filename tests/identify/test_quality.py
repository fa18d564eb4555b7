"""Recordings that can't be fitted are refused with a number and a rule: copies of a real one, each with one fault."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.identify.quality import check_recording
from surefoot.identify.recording import Recording
from surefoot.robot import RobotDescription

STATES = ("time", "host_time", "mode", "command", "command_age", "motor_angle", "motor_velocity", "motor_torque",
          "roll_pitch_yaw", "angular_velocity_base", "voltage", "temperature")  # fmt: skip
SWEEP, STEPS = 1, 2


def changed(recording: Recording, **arrays: np.ndarray) -> Recording:
    """A copy without what was computed from the former arrays."""
    return replace(recording, **arrays)


def without(recording: Recording, gone: np.ndarray) -> Recording:
    """A copy without some of the states."""
    return changed(recording, **{name: np.delete(getattr(recording, name), gone, axis=0) for name in STATES})


def column(recording: Recording, name: str, motor: int, change: Callable[[np.ndarray], np.ndarray]) -> Recording:
    """A copy in which a motor reads otherwise."""
    array = getattr(recording, name).copy()
    array[:, motor] = change(array[:, motor])
    return changed(recording, **{name: array})


def with_meta(recording: Recording, **entries: Any) -> Recording:
    return replace(recording, meta={**recording.meta, **entries})


def after(recording: Recording, name: str, moment: float, by: float) -> Recording:
    """A copy in which a clock jumps."""
    array = getattr(recording, name).copy()
    array[array > moment] += by
    return changed(recording, **{name: array})


def test_a_sound_recording_passes_without_a_word(recorded: Recording, robot: RobotDescription):
    assert recorded.meta["ended"] == "complete"
    assert check_recording(recorded, robot) == ()


def in_phase(recording: Recording, phase: int) -> np.ndarray:
    return np.arange(len(recording.time))[recording.phase_states(phase)]


def refused(recording: Recording, robot: RobotDescription) -> str:
    with pytest.raises(SurefootError, match=r"^the recording can't be fitted: ") as caught:
        check_recording(recording, robot)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# What is missing.


def test_too_short(recorded: Recording, robot: RobotDescription):
    late = np.flatnonzero(recorded.time > recorded.time[0] + 1.5)
    assert "it has 1.5 s of states; at least 2" in refused(without(recorded, late), robot)


def test_half_of_a_phase_is_missing(recorded: Recording, robot: RobotDescription):
    states = in_phase(recorded, STEPS)
    said = refused(without(recorded, states[: len(states) * 6 // 10]), robot)
    assert "phase 'steps' (3 of 7) has 40% of its states; at least 50%" in said


def test_lost_states(recorded: Recording, robot: RobotDescription):
    states = np.concatenate([in_phase(recorded, SWEEP), in_phase(recorded, STEPS)])
    assert "states, 10.3%, are missing between others; at most 5%" in refused(without(recorded, states[5::8]), robot)
    (note,) = check_recording(without(recorded, states[5::40]), robot)
    assert note == "20 states, 2.1%, are missing between others"


def test_states_missing_while_nothing_is_fitted_are_not_missed(recorded: Recording, robot: RobotDescription):
    assert check_recording(without(recorded, in_phase(recorded, 0)[::3]), robot) == ()


def test_lost_frames(recorded: Recording, robot: RobotDescription):
    frames = {"received": 900, "missing": 60, "damaged": 40}
    said = refused(with_meta(recorded, frames=frames), robot)
    assert "100 frames, 10.0%, were lost or damaged on the link; at most 5%" in said
    assert check_recording(with_meta(recorded, frames={"received": 960, "missing": 30, "damaged": 10}), robot) == ()


# Clocks.


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("time", "the robot's clock goes back by 0.298 s"),
        ("host_time", "the host's clock goes back by 0.298 s"),
        ("sent_time", "the host's clock goes back by 0.298 s"),
    ],
)
def test_a_clock_goes_back(recorded: Recording, robot: RobotDescription, name: str, said: str):
    # What it says when it jumps in the middle of a phase; a phase may lose its states by that.
    middle = float(getattr(recorded, name)[len(getattr(recorded, name)) // 2])
    doctored = after(recorded, name, middle, -0.3)
    if name == "time":
        doctored = with_meta(doctored, phases=[{**phase, "use": "way"} for phase in recorded.meta["phases"]])
    assert said in refused(doctored, robot)


def test_a_clock_jumps(recorded: Recording, robot: RobotDescription):
    middle = float(recorded.host_time[len(recorded.time) // 2])
    said = refused(after(recorded, "host_time", middle, 0.2), robot)
    assert "the clocks of robot and host shift by 0.2" in said
    assert "by +0.200 s at once at" in said
    assert said.endswith("at most 0.1")
    assert check_recording(after(recorded, "host_time", middle, 0.05), robot) == ()


def test_clocks_may_drift(recorded: Recording, robot: RobotDescription):
    drifted = changed(recorded, host_time=recorded.host_time * 1.05 + 100.0)
    assert check_recording(drifted, robot) == ()


# Readings.


@pytest.mark.parametrize("name", ["motor_angle", "motor_torque", "temperature"])
def test_a_reading_is_not_finite(recorded: Recording, robot: RobotDescription, name: str):
    doctored = column(recorded, name, 3, lambda x: np.where(np.arange(len(x)) == 700, np.nan, x))
    assert f"{name} of {robot.motor_names[3]} has values that are not finite" in refused(doctored, robot)
    voltage = recorded.voltage.copy()
    voltage[-1] = np.inf
    assert "voltage has values that are not finite" in refused(changed(recorded, voltage=voltage), robot)


def test_a_motor_that_never_moves_is_named(recorded: Recording, robot: RobotDescription):
    noise = np.random.default_rng(0).normal(0.0, 5e-4, len(recorded.time))
    doctored = column(recorded, "motor_angle", 5, lambda x: 1.7 + noise)
    (note,) = check_recording(doctored, robot)
    assert note.startswith(f"{robot.motor_names[5]} never moves (its angle varies by less than 2 mrad)")


def test_no_motor_moves(recorded: Recording, robot: RobotDescription):
    doctored = changed(recorded, motor_angle=np.full_like(recorded.motor_angle, 1.7))
    assert "no motor moves by more than 2 mrad; are the motors powered?" in refused(doctored, robot)


def test_an_angle_is_clipped(recorded: Recording, robot: RobotDescription):
    states = in_phase(recorded, SWEEP)
    most = float(np.quantile(recorded.motor_angle[states, 2], 0.7))
    said = refused(column(recorded, "motor_angle", 2, lambda x: np.minimum(x, most)), robot)
    assert f"the angle of {robot.motor_names[2]} stands still, at its greatest, at {most:.3f} rad for" in said
    assert "of the time in which it is moved; at most 10%" in said


def test_an_angle_stands_still(recorded: Recording, robot: RobotDescription):
    states = in_phase(recorded, SWEEP)
    stuck = recorded.motor_angle.copy()
    stuck[states[50:250], 6] = stuck[states[50], 6]
    said = refused(changed(recorded, motor_angle=stuck), robot)
    assert f"the angle of {robot.motor_names[6]} stands still at" in said
    # A leg that is held, as long as one likes, is no fault.
    held = recorded.motor_angle.copy()
    hold = in_phase(recorded, 3)
    held[hold] = held[hold[0]]
    assert check_recording(changed(recorded, motor_angle=held), robot) == ()


def test_a_torque_at_a_ceiling(recorded: Recording, robot: RobotDescription):
    states = in_phase(recorded, SWEEP)
    ceiling = 5 * float(np.quantile(np.abs(recorded.motor_torque[states, 1]), 0.6))
    # Legs in the air are light: this one is five times as heavy.
    said = refused(column(recorded, "motor_torque", 1, lambda x: np.clip(5 * x, -ceiling, ceiling)), robot)
    assert f"the torque of {robot.motor_names[1]} is at a ceiling of {ceiling:.3f} N m for" in said


@pytest.mark.parametrize(("name", "unit"), [("velocity", "rad/s"), ("torque", "N m")])
def test_a_reading_that_is_never_told(recorded: Recording, robot: RobotDescription, name: str, unit: str):
    doctored = column(recorded, f"motor_{name}", 4, np.zeros_like)
    said = refused(doctored, robot)
    assert f"{robot.motor_names[4]} moves, and its {name} is 0 {unit} all the time" in said
