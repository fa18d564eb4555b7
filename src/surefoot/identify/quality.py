"""Checks of a recording before it is fitted: missing states, clock jumps, implausible readings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.deploy.messages import Mode
from surefoot.errors import SurefootError
from surefoot.identify.recording import STILL_DEVIATION, Recording
from surefoot.robot import RobotDescription

Mask = NDArray[np.bool_]

MIN_LENGTH = 2.0
"""Minimum length of a recording [s]."""
MIN_COVERAGE = 0.5
"""Minimum fraction of a phase that is covered by states."""
MAX_LOSS = 0.05
"""Maximum fraction of states, or of frames, that may be lost."""
NOTED_LOSS = 0.01
"""Fraction of lost states above which a note is returned."""
MAX_GAP_PERIODS = 1.5
"""Number of periods between two states above which a state is counted as lost."""
MAX_CLOCK_SHIFT = 0.1
"""Maximum deviation of the offset between the robot's and the host's clock from linear drift [s]."""
MAX_STUCK_FRACTION = 0.1
"""Maximum fraction of a motor's commanded motion during which a reading may be constant."""
_STUCK_TIME = 0.02
"""Time [s] without change after which an angle counts as stuck: a few readings are equal at every reversal."""
_MOVING_SPEED = 0.5
"""Speed [rad/s] of the target above which a motor counts as commanded to move."""
_SATURATED_STATES = 3
"""Number of consecutive equal torques that count as saturation."""
_TORQUE_RESOLUTION = 6e-4
"""Slightly more than half the resolution of torques in states [N m]."""
_MIN_SATURATION_TORQUE = 0.2
"""Torque [N m] below which nothing counts as saturation."""


def check_recording(recording: Recording, robot: RobotDescription) -> tuple[str, ...]:
    """Reject a recording with defects that would spoil a fit; return notes on tolerable defects.

    Raises:
        SurefootError: the recording has such a defect; the message states the value and the limit.
    """
    _check_finite(recording, robot)
    _check_length(recording)
    _check_clocks(recording)
    notes = (*_check_loss(recording), *_check_motion(recording, robot))
    _check_readings(recording, robot)
    return notes


def _error(reason: str) -> SurefootError:
    return SurefootError(f"the recording can't be fitted: {reason}")


def _check_finite(recording: Recording, robot: RobotDescription) -> None:
    for name in ("time", "host_time", "sent_time", "roll_pitch_yaw", "angular_velocity_base", "voltage"):
        if not np.isfinite(getattr(recording, name)).all():
            raise _error(f"{name} has values that are not finite; all must be finite")
    for name in ("motor_angle", "motor_velocity", "motor_torque", "temperature", "sent_value"):
        bad = ~np.isfinite(getattr(recording, name)).all(axis=0)
        if bad.any():
            motor = robot.motor_names[int(np.argmax(bad))]
            raise _error(f"{name} of {motor} has values that are not finite; all must be finite")


def _check_length(recording: Recording) -> None:
    if recording.duration < MIN_LENGTH:
        raise _error(f"it has {recording.duration:.1f} s of states; at least {MIN_LENGTH:g}")
    phases = recording.meta["phases"]
    for k in recording.phases("fit", "check"):
        states = recording.phase_states(k)
        coverage = (states.stop - states.start) / (float(phases[k]["duration"]) / recording.period)
        if coverage < MIN_COVERAGE:
            raise _error(
                f"phase '{phases[k]['name']}' ({k + 1} of {len(phases)}) has {coverage:.0%} of its states; "
                f"at least {MIN_COVERAGE:.0%}"
            )


def _check_clocks(recording: Recording) -> None:
    for name, whose in (("time", "robot's"), ("host_time", "host's"), ("sent_time", "host's")):
        steps = np.diff(getattr(recording, name))
        if len(steps) and steps.min() < 0:
            at = getattr(recording, name)[int(np.argmin(steps))]
            raise _error(f"the {whose} clock goes back by {-steps.min():.3f} s at {at:.3f} s; it must not go back")
    # Two quartz clocks drift apart linearly; what remains is transmission time and jumps.
    time, offset = recording.time - recording.time[0], recording.host_time - recording.time
    remainder = offset - np.polyval(np.polyfit(time, offset, 1), time)
    if np.ptp(remainder) > MAX_CLOCK_SHIFT:
        jumps = np.diff(offset)
        worst = int(np.argmax(np.abs(jumps)))
        raise _error(
            f"the offset between the clocks of robot and host changes by {np.ptp(remainder):.3f} s, with a jump of "
            f"{jumps[worst]:+.3f} s at {recording.time[worst]:.3f} s of the robot's clock; at most {MAX_CLOCK_SHIFT:g}"
        )


def _check_loss(recording: Recording) -> tuple[str, ...]:
    frames = recording.meta["frames"]
    lost_frames = int(frames["missing"]) + int(frames["damaged"])
    loss = lost_frames / max(int(frames["received"]) + lost_frames, 1)
    if loss > MAX_LOSS:
        raise _error(f"{lost_frames} frames, {loss:.1%}, were lost or damaged on the link; at most {MAX_LOSS:.0%}")
    lost, states = 0, 0
    for k in recording.phases("fit", "check"):
        gaps = np.diff(recording.time[recording.phase_states(k)]) / recording.period
        lost += int(np.sum(np.maximum(np.round(gaps[gaps > MAX_GAP_PERIODS]) - 1, 0)))
        states += len(gaps)
    loss = lost / max(states + lost, 1)
    message = f"{lost} states, {loss:.1%}, are missing between others"
    if loss > MAX_LOSS:
        raise _error(f"{message}; at most {MAX_LOSS:.0%}")
    return (message,) if loss > NOTED_LOSS else ()


def _check_motion(recording: Recording, robot: RobotDescription) -> tuple[str, ...]:
    still = sorted(recording.still_motors)
    if len(still) == recording.num_motors:
        raise _error(f"no motor moves by more than {1e3 * STILL_DEVIATION:g} mrad; are the motors powered?")
    return tuple(
        f"{robot.motor_names[motor]} never moves (its angle varies by less than {1e3 * STILL_DEVIATION:g} mrad): its "
        "parameters are not identifiable"
        for motor in still
    )


def _check_readings(recording: Recording, robot: RobotDescription) -> None:
    """Reject readings that are constant while their motor moves or is commanded to move."""
    moved, driven = _driven_motors(recording)
    phases = [recording.phase_states(k) for k in recording.phases("fit", "check")]
    fitted = np.concatenate([np.arange(part.start, part.stop) for part in phases]) if phases else np.arange(0)
    pitch_rate = recording.angular_velocity_base[fitted, 1]
    if not recording.meta["rack"] and len(fitted) and np.ptp(pitch_rate) == 0:
        raise _error(f"the IMU's pitch rate is always {pitch_rate[0]:g} rad/s; is its gyro read?")
    for motor in sorted(set(range(recording.num_motors)) - recording.still_motors):
        name, angle, torque = (
            robot.motor_names[motor],
            recording.motor_angle[:, motor],
            recording.motor_torque[:, motor],
        )
        for quantity, unit in (("velocity", "rad/s"), ("torque", "N m")):
            values = getattr(recording, f"motor_{quantity}")[fitted, motor]
            if len(values) and np.ptp(values) == 0:
                raise _error(f"{name} moves, but its {quantity} is always {values[0]:g} {unit}")
        stuck = moved[:, motor] & (_run_lengths(angle) > _STUCK_TIME / recording.period)
        fraction = stuck.sum() / max(moved[:, motor].sum(), 1)
        if fraction > MAX_STUCK_FRACTION:
            at = float(np.median(angle[stuck]))
            extremes = {" its maximum of": angle[fitted].max(), " its minimum of": angle[fitted].min()}
            end = next((text for text, value in extremes.items() if np.isclose(at, value)), "")
            raise _error(
                f"the angle of {name} stays at{end} {at:.3f} rad for {fraction:.0%} of the time in which it is "
                f"commanded to move; at most {MAX_STUCK_FRACTION:.0%}: check the encoder, and whether something blocks "
                "the leg"
            )
        maximum = float(np.abs(torque[fitted]).max())
        saturated = driven[:, motor] & (np.abs(torque) > maximum - _TORQUE_RESOLUTION)
        saturated &= _run_lengths(torque, _TORQUE_RESOLUTION) >= _SATURATED_STATES
        fraction = saturated.sum() / max(driven[:, motor].sum(), 1)
        if fraction > MAX_STUCK_FRACTION and maximum > _MIN_SATURATION_TORQUE:
            raise _error(
                f"the torque of {name} is saturated at {maximum:.3f} N m for {fraction:.0%} of the time in which it is "
                f"driven; at most {MAX_STUCK_FRACTION:.0%}: raise the current limit"
            )


def _driven_motors(recording: Recording) -> tuple[Mask, Mask]:
    """Return masks (T, M) of the states in which each motor is moved by its servo, and is driven by servo or duty."""
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
    """Return for each value (T,) the length of the run of equal neighbours that it belongs to."""
    starts = np.concatenate([[True], np.abs(np.diff(values)) > within])
    run = np.cumsum(starts) - 1
    lengths: NDArray[np.int64] = np.bincount(run)[run]
    return lengths
