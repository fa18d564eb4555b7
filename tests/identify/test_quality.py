"""Recordings that can't be fitted are rejected with a number and a rule: copies of a real one, each with one fault."""

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


def without(recording: Recording, gone: np.ndarray) -> Recording:
    """A copy without some of the states."""
    return replace(recording, **{name: np.delete(getattr(recording, name), gone, axis=0) for name in STATES})


def column(recording: Recording, name: str, motor: int, change: Callable[[np.ndarray], np.ndarray]) -> Recording:
    """A copy in which a motor reads otherwise."""
    array = getattr(recording, name).copy()
    array[:, motor] = change(array[:, motor])
    return replace(recording, **{name: array})


def with_meta(recording: Recording, **entries: Any) -> Recording:
    return replace(recording, meta={**recording.meta, **entries})


def jump(recording: Recording, name: str, by: float) -> Recording:
    """A copy in which a clock jumps in the middle."""
    array = getattr(recording, name).copy()
    array[array > array[len(array) // 2]] += by
    return replace(recording, **{name: array})


def in_phase(recording: Recording, phase: int) -> np.ndarray:
    return np.arange(len(recording.time))[recording.phase_states(phase)]


def in_phases(recording: Recording, *phases: int) -> np.ndarray:
    return np.concatenate([in_phase(recording, phase) for phase in phases])


def stuck(recording: Recording, states: np.ndarray, motor: int | slice) -> Recording:
    """A copy in which angles stand still."""
    angle = recording.motor_angle.copy()
    angle[states, motor] = angle[states[0], motor]
    return replace(recording, motor_angle=angle)


def clipped(recording: Recording) -> tuple[Recording, float]:
    """A copy in which an angle is never read above a value."""
    maximum = float(np.quantile(recording.motor_angle[in_phase(recording, SWEEP), 2], 0.7))
    return column(recording, "motor_angle", 2, lambda x: np.minimum(x, maximum)), maximum


def saturated(recording: Recording) -> tuple[Recording, float]:
    """A copy in which a torque saturates; it is scaled by five, because legs in the air need little torque."""
    limit = 5 * float(np.quantile(np.abs(recording.motor_torque[in_phase(recording, SWEEP), 1]), 0.6))
    return column(recording, "motor_torque", 1, lambda x: np.clip(5 * x, -limit, limit)), limit


def not_finite(recording: Recording, name: str) -> Recording:
    return column(recording, name, 3, lambda x: np.where(np.arange(len(x)) == 700, np.nan, x))


def rejected(recording: Recording, robot: RobotDescription) -> str:
    with pytest.raises(SurefootError, match=r"^the recording can't be fitted: ") as caught:
        check_recording(recording, robot)
    assert "\n" not in str(caught.value)
    return str(caught.value)


WRONG: dict[str, tuple[Callable[[Recording], Recording], str]] = {
    "too short": (
        lambda r: without(r, np.flatnonzero(r.time > r.time[0] + 1.5)),
        "it has 1.5 s of states; at least 2",
    ),
    "half of a phase": (
        lambda r: without(r, in_phase(r, STEPS)[: len(in_phase(r, STEPS)) * 6 // 10]),
        "phase 'steps' (3 of 7) has 40% of its states; at least 50%",
    ),
    "lost frames": (
        lambda r: with_meta(r, frames={"received": 900, "missing": 60, "damaged": 40}),
        "100 frames, 10.0%, were lost or damaged on the link; at most 5%",
    ),
    "robot's clock": (
        # Otherwise a phase could lose its states, which would be reported first.
        lambda r: with_meta(
            jump(r, "time", -0.3), phases=[{**phase, "use": "transition"} for phase in r.meta["phases"]]
        ),
        "the robot's clock goes back by 0.298 s",
    ),
    "host's clock": (lambda r: jump(r, "host_time", -0.3), "the host's clock goes back by 0.298 s"),
    "host's clock, sent": (lambda r: jump(r, "sent_time", -0.3), "the host's clock goes back by 0.298 s"),
    "shifted clocks": (
        lambda r: jump(r, "host_time", 0.2),
        "offset between the clocks of robot and host changes by 0.2",
    ),
    "a jump": (lambda r: jump(r, "host_time", 0.2), "with a jump of +0.200 s at"),
    "angle": (lambda r: not_finite(r, "motor_angle"), "motor_angle of {3} has values that are not finite"),
    "torque": (lambda r: not_finite(r, "motor_torque"), "motor_torque of {3} has values that are not finite"),
    "temperature": (lambda r: not_finite(r, "temperature"), "temperature of {3} has values that are not finite"),
    "voltage": (
        lambda r: replace(r, voltage=np.append(r.voltage[:-1], np.inf)),
        "voltage has values that are not finite",
    ),
    "no motor": (
        lambda r: replace(r, motor_angle=np.full_like(r.motor_angle, 1.7)),
        "no motor moves by more than 2 mrad; are the motors powered?",
    ),
    "stuck": (lambda r: stuck(r, in_phase(r, SWEEP)[50:250], 6), "the angle of {6} stays at"),
    "no velocity": (
        lambda r: column(r, "motor_velocity", 4, np.zeros_like),
        "{4} moves, but its velocity is always 0 rad/s",
    ),
    "no torque": (
        lambda r: column(r, "motor_torque", 4, np.zeros_like),
        "{4} moves, but its torque is always 0 N m",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_check_rejects_a_defective_recording(name: str, recorded: Recording, robot: RobotDescription):
    change, message = WRONG[name]
    assert message.format(*robot.motor_names) in rejected(change(recorded), robot)


def test_check_counts_lost_states(recorded: Recording, robot: RobotDescription):
    # The first and last state of a phase are kept, because nothing shows that they are missing.
    gone = np.concatenate([in_phase(recorded, phase)[5:-1:8] for phase in (SWEEP, STEPS)])
    gaps = sum(len(in_phase(recorded, phase)) - 1 for phase in recorded.phases("fit", "check"))
    message = rejected(without(recorded, gone), robot)
    assert f"{len(gone)} states, {len(gone) / gaps:.1%}, are missing between others; at most 5%" in message


def test_check_rejects_clipped_readings(recorded: Recording, robot: RobotDescription):
    altered, maximum = clipped(recorded)
    message = rejected(altered, robot)
    assert f"the angle of {robot.motor_names[2]} stays at its maximum of {maximum:.3f} rad for" in message
    assert "of the time in which it is commanded to move; at most 10%" in message
    altered, limit = saturated(recorded)
    message = rejected(altered, robot)
    assert f"the torque of {robot.motor_names[1]} is saturated at {limit:.3f} N m for" in message


SOUND: dict[str, Callable[[Recording], Recording]] = {
    "as it is": lambda r: r,
    "states lost in a transition": lambda r: without(r, in_phase(r, 0)[::3]),
    "few lost frames": lambda r: with_meta(r, frames={"received": 960, "missing": 30, "damaged": 10}),
    "a small jump": lambda r: jump(r, "host_time", 0.05),
    "drift": lambda r: replace(r, host_time=r.host_time * 1.05 + 100.0),
    # A leg that is held for any length of time is not a defect.
    "held": lambda r: stuck(r, in_phase(r, 3), slice(None)),
}


@pytest.mark.parametrize("name", SOUND)
def test_check_passes_a_sound_recording(name: str, recorded: Recording, robot: RobotDescription):
    assert check_recording(SOUND[name](recorded), robot) == ()


def test_tolerable_defects_are_noted(recorded: Recording, robot: RobotDescription):
    (note,) = check_recording(without(recorded, in_phases(recorded, SWEEP, STEPS)[5::40]), robot)
    assert note == "20 states, 2.1%, are missing between others"
    noise = np.random.default_rng(0).normal(0.0, 5e-4, len(recorded.time))
    (note,) = check_recording(column(recorded, "motor_angle", 5, lambda x: 1.7 + noise), robot)
    assert note.startswith(f"{robot.motor_names[5]} never moves (its angle varies by less than 2 mrad)")


def test_a_gyro_that_is_not_read_is_rejected_on_the_ground(recorded: Recording, robot: RobotDescription):
    silent = column(recorded, "angular_velocity_base", 1, np.zeros_like)
    assert check_recording(silent, robot) == ()  # the rack does not turn
    message = rejected(with_meta(silent, rack=False), robot)
    assert message.endswith("the IMU's pitch rate is always 0 rad/s; is its gyro read?")
