"""Checks of a recording before its fit: missing states, clocks that jump, readings that can't be true."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.deploy.messages import Mode
from surefoot.errors import SurefootError
from surefoot.identify.recording import STILL, Recording
from surefoot.robot import RobotDescription

Mask = NDArray[np.bool_]

MIN_LENGTH = 2.0
"""Shortest recording [s]."""
MIN_COVERAGE = 0.5
"""Share of a phase with states."""
MAX_LOSS = 0.05
"""Share of states, or of frames, that may be lost."""
NOTED_LOSS = 0.01
"""Share of lost states from which a note is given."""
GAP = 1.5
"""Periods between two states beyond which one is lost."""
MAX_CLOCK_SHIFT = 0.1
"""Deviation of robot's and host's clocks from even drift [s]."""
MAX_STUCK_FRACTION = 0.1
"""Share of the time in which a motor is moved for which a reading may stand still."""
_STUCK_TIME = 0.02
"""Time [s] without change from which an angle stands still: a few readings are equal at every turn."""
_MOVING_SPEED = 0.5
"""Speed [rad/s] of the target from which a motor is moved."""
_SATURATED_STATES = 3
"""Equal torques in a row that count as a ceiling."""
_TORQUE_RESOLUTION = 6e-4
"""Half of the resolution of torques in states [N m], and a little."""
_MIN_SATURATION_TORQUE = 0.2
"""Torque [N m] below which nothing is a ceiling."""


def check_recording(recording: Recording, robot: RobotDescription) -> tuple[str, ...]:
    """Refuse a recording whose fit would be wrong; return notes on defects that are tolerable.

    Raises:
        SurefootError: the defect, with its number and the rule.
    """
    _check_finite(recording, robot)
    _check_length(recording)
    _check_clocks(recording)
    notes = (*_check_loss(recording), *_check_motion(recording, robot))
    _check_readings(recording, robot)
    return notes


def _error(text: str) -> SurefootError:
    return SurefootError(f"the recording can't be fitted: {text}")


def _check_finite(recording: Recording, robot: RobotDescription) -> None:
    for name in ("time", "host_time", "sent_time", "roll_pitch_yaw", "angular_velocity_base", "voltage"):
        if not np.isfinite(getattr(recording, name)).all():
            raise _error(f"{name} has values that are not finite; all must be")
    for name in ("motor_angle", "motor_velocity", "motor_torque", "temperature", "sent_value"):
        bad = ~np.isfinite(getattr(recording, name)).all(axis=0)
        if bad.any():
            motor = robot.motor_names[int(np.argmax(bad))]
            raise _error(f"{name} of {motor} has values that are not finite; all must be")


def _check_length(recording: Recording) -> None:
    if recording.duration < MIN_LENGTH:
        raise _error(f"it has {recording.duration:.1f} s of states; at least {MIN_LENGTH:g}")
    phases = recording.meta["phases"]
    for k in recording.phases("fit", "check"):
        states = recording.phase_states(k)
        share = (states.stop - states.start) / (float(phases[k]["duration"]) / recording.period)
        if share < MIN_COVERAGE:
            raise _error(
                f"phase '{phases[k]['name']}' ({k + 1} of {len(phases)}) has {share:.0%} of its states; "
                f"at least {MIN_COVERAGE:.0%}"
            )


def _check_clocks(recording: Recording) -> None:
    for name, whose in (("time", "robot's"), ("host_time", "host's"), ("sent_time", "host's")):
        steps = np.diff(getattr(recording, name))
        if len(steps) and steps.min() < 0:
            at = getattr(recording, name)[int(np.argmin(steps))]
            raise _error(f"the {whose} clock goes back by {-steps.min():.3f} s at {at:.3f} s; it must not")
    # Two quartzes drift evenly apart; the rest is the time of transmission, and jumps.
    time, offset = recording.time - recording.time[0], recording.host_time - recording.time
    left = offset - np.polyval(np.polyfit(time, offset, 1), time)
    if np.ptp(left) > MAX_CLOCK_SHIFT:
        jumps = np.diff(offset)
        worst = int(np.argmax(np.abs(jumps)))
        raise _error(
            f"the clocks of robot and host shift by {np.ptp(left):.3f} s against each other, by {jumps[worst]:+.3f} s "
            f"at once at {recording.time[worst]:.3f} s of the robot's; at most {MAX_CLOCK_SHIFT:g}"
        )


def _check_loss(recording: Recording) -> tuple[str, ...]:
    frames = recording.meta["frames"]
    gone = int(frames["missing"]) + int(frames["damaged"])
    share = gone / max(int(frames["received"]) + gone, 1)
    if share > MAX_LOSS:
        raise _error(f"{gone} frames, {share:.1%}, were lost or damaged on the link; at most {MAX_LOSS:.0%}")
    lost, states = 0, 0
    for k in recording.phases("fit", "check"):
        gaps = np.diff(recording.time[recording.phase_states(k)]) / recording.period
        lost += int(np.sum(np.maximum(np.round(gaps[gaps > GAP]) - 1, 0)))
        states += len(gaps)
    share = lost / max(states + lost, 1)
    text = f"{lost} states, {share:.1%}, are missing between others"
    if share > MAX_LOSS:
        raise _error(f"{text}; at most {MAX_LOSS:.0%}")
    return (text,) if share > NOTED_LOSS else ()


def _check_motion(recording: Recording, robot: RobotDescription) -> tuple[str, ...]:
    still = sorted(recording.still_motors)
    if len(still) == recording.num_motors:
        raise _error(f"no motor moves by more than {1e3 * STILL:g} mrad; are the motors powered?")
    return tuple(
        f"{robot.motor_names[motor]} never moves (its angle varies by less than {1e3 * STILL:g} mrad): its parameters "
        "are not identifiable"
        for motor in still
    )


def _check_readings(recording: Recording, robot: RobotDescription) -> None:
    """Refuse readings that stand still while their motor moves, or is commanded to."""
    moved, driven = _driven_motors(recording)
    phases = [recording.phase_states(k) for k in recording.phases("fit", "check")]
    fitted = np.concatenate([np.arange(part.start, part.stop) for part in phases]) if phases else np.arange(0)
    for motor in sorted(set(range(recording.num_motors)) - recording.still_motors):
        name, angle, torque = (
            robot.motor_names[motor],
            recording.motor_angle[:, motor],
            recording.motor_torque[:, motor],
        )
        for what, unit in (("velocity", "rad/s"), ("torque", "N m")):
            values = getattr(recording, f"motor_{what}")[fitted, motor]
            if len(values) and np.ptp(values) == 0:
                raise _error(f"{name} moves, and its {what} is {values[0]:g} {unit} all the time")
        stuck = moved[:, motor] & (_run_lengths(angle) > _STUCK_TIME / recording.period)
        share = stuck.sum() / max(moved[:, motor].sum(), 1)
        if share > MAX_STUCK_FRACTION:
            at = float(np.median(angle[stuck]))
            ends = {", at its greatest,": angle[fitted].max(), ", at its least,": angle[fitted].min()}
            end = next((text for text, value in ends.items() if np.isclose(at, value)), "")
            raise _error(
                f"the angle of {name} stands still{end} at {at:.3f} rad for {share:.0%} of the time in which it is "
                f"moved; at most {MAX_STUCK_FRACTION:.0%}: encoder, or something in the way"
            )
        ceiling = float(np.abs(torque[fitted]).max())
        high = driven[:, motor] & (np.abs(torque) > ceiling - _TORQUE_RESOLUTION)
        high &= _run_lengths(torque, _TORQUE_RESOLUTION) >= _SATURATED_STATES
        share = high.sum() / max(driven[:, motor].sum(), 1)
        if share > MAX_STUCK_FRACTION and ceiling > _MIN_SATURATION_TORQUE:
            raise _error(
                f"the torque of {name} is at a ceiling of {ceiling:.3f} N m for {share:.0%} of the time in which it is "
                f"driven; at most {MAX_STUCK_FRACTION:.0%}: raise the limit of the current"
            )


def _driven_motors(recording: Recording) -> tuple[Mask, Mask]:
    """Return the states in which each motor is moved by its servo, and in which it is driven, by duties too (T, M)."""
    moved = np.zeros_like(recording.motor_angle, np.bool_)
    driven = moved.copy()
    back = max(round(_STUCK_TIME / recording.period), 1)
    for k in recording.phases("fit", "check"):
        states = recording.phase_states(k)
        order = np.searchsorted(recording.arrival, recording.time[states], side="right") - 1
        value = recording.sent_value[np.clip(order, 0, None)]
        if recording.meta["phases"][k]["mode"] == Mode.PWM:
            driven[states] = np.abs(value) > 0
        else:
            earlier = value[np.maximum(np.arange(len(value)) - back, 0)]
            moved[states] = np.abs(value - earlier) > _MOVING_SPEED * _STUCK_TIME
    return moved, driven | moved


def _run_lengths(values: Array, within: float = 0.0) -> NDArray[np.int64]:
    """Return the length of the run of equal neighbours around each value (T,)."""
    starts = np.concatenate([[True], np.abs(np.diff(values)) > within])
    run = np.cumsum(starts) - 1
    lengths: NDArray[np.int64] = np.bincount(run)[run]
    return lengths
