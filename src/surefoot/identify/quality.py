"""Whether a recording is good enough to be fitted: what is missing, which clock jumps, which reading can't be true."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.deploy.messages import Mode
from surefoot.errors import SurefootError
from surefoot.identify.recording import STILL, Recording
from surefoot.robot import RobotDescription

Mask = NDArray[np.bool_]

LEAST = 2.0
"""Shortest recording [s]."""
COVERED = 0.5
"""Share of a phase of which there must be states."""
LOST = 0.05
"""Share of states, or of frames, that may be lost."""
TOLD_LOST = 0.01
"""Share of lost states that is worth a note."""
GAP = 1.5
"""Periods between two states beyond which one is lost."""
JUMP = 0.1
"""How far robot's and host's clocks may be from drifting evenly apart [s]."""
FALSE = 0.1
"""Share of the time in which a motor is moved for which a reading may stand still."""
_STANDS = 0.02
"""Time [s] for which an angle must not change to count as standing still: a few readings are equal at every turn."""
_ASKED = 0.5
"""Speed [rad/s] of the target from which a motor counts as being moved."""
_TORQUES = 3
"""Equal torques in a row that count as a ceiling."""
_WIRE = 6e-4
"""Half of the resolution of torques in states [N m], and a little."""
_LEVEL = 0.2
"""Torque [N m] below which nothing is a ceiling."""


def check_recording(recording: Recording, robot: RobotDescription) -> tuple[str, ...]:
    """Look for what would make a fit of a whole experiment wrong; return notes on what is wrong and can be borne.

    Raises:
        SurefootError: what is wrong, with the number and the rule.
    """
    _finite(recording, robot)
    _whole(recording)
    _clocks(recording)
    lost = _lost(recording)
    _readings(recording, robot)
    return (*lost, *_still(recording, robot))


def _bad(text: str) -> SurefootError:
    return SurefootError(f"the recording can't be fitted: {text}")


def _finite(recording: Recording, robot: RobotDescription) -> None:
    for name in ("time", "host_time", "sent_time", "roll_pitch_yaw", "angular_velocity_base", "voltage"):
        if not np.isfinite(getattr(recording, name)).all():
            raise _bad(f"{name} has values that are not finite; all must be")
    for name in ("motor_angle", "motor_velocity", "motor_torque", "temperature", "sent_value"):
        bad = ~np.isfinite(getattr(recording, name)).all(axis=0)
        if bad.any():
            motor = robot.motor_names[int(np.argmax(bad))]
            raise _bad(f"{name} of {motor} has values that are not finite; all must be")


def _whole(recording: Recording) -> None:
    if recording.duration < LEAST:
        raise _bad(f"it has {recording.duration:.1f} s of states; at least {LEAST:g}")
    phases = recording.meta["phases"]
    for k in recording.phases("fit", "check"):
        states = recording.phase_states(k)
        share = (states.stop - states.start) / (float(phases[k]["duration"]) / recording.period)
        if share < COVERED:
            raise _bad(
                f"phase '{phases[k]['name']}' ({k + 1} of {len(phases)}) has {share:.0%} of its states; "
                f"at least {COVERED:.0%}"
            )


def _clocks(recording: Recording) -> None:
    for name, whose in (("time", "robot's"), ("host_time", "host's"), ("sent_time", "host's")):
        steps = np.diff(getattr(recording, name))
        if len(steps) and steps.min() < 0:
            at = getattr(recording, name)[int(np.argmin(steps))]
            raise _bad(f"the {whose} clock goes back by {-steps.min():.3f} s at {at:.3f} s; it must not")
    # Two quartzes drift evenly apart; what is left is how long states took, and jumps.
    time, offset = recording.time - recording.time[0], recording.host_time - recording.time
    left = offset - np.polyval(np.polyfit(time, offset, 1), time)
    if np.ptp(left) > JUMP:
        jumps = np.diff(offset)
        worst = int(np.argmax(np.abs(jumps)))
        raise _bad(
            f"the clocks of robot and host shift by {np.ptp(left):.3f} s against each other, by {jumps[worst]:+.3f} s "
            f"at once at {recording.time[worst]:.3f} s of the robot's; at most {JUMP:g}"
        )


def _lost(recording: Recording) -> tuple[str, ...]:
    frames = recording.meta["frames"]
    gone = int(frames["missing"]) + int(frames["damaged"])
    share = gone / max(int(frames["received"]) + gone, 1)
    if share > LOST:
        raise _bad(f"{gone} frames, {share:.1%}, were lost or damaged on the link; at most {LOST:.0%}")
    lost, states = 0, 0
    for k in recording.phases("fit", "check"):
        gaps = np.diff(recording.time[recording.phase_states(k)]) / recording.period
        lost += int(np.sum(np.maximum(np.round(gaps[gaps > GAP]) - 1, 0)))
        states += len(gaps)
    share = lost / max(states + lost, 1)
    if share > LOST:
        raise _bad(f"{lost} states, {share:.1%}, are missing between others; at most {LOST:.0%}")
    return (f"{lost} states, {share:.1%}, are missing between others",) if share > TOLD_LOST else ()


def _still(recording: Recording, robot: RobotDescription) -> tuple[str, ...]:
    still = sorted(recording.still_motors)
    if len(still) == recording.num_motors:
        raise _bad(f"no motor moves by more than {1e3 * STILL:g} mrad; are the motors powered?")
    return tuple(
        f"{robot.motor_names[motor]} never moves (its angle varies by less than {1e3 * STILL:g} mrad): "
        "nothing of it can be told"
        for motor in still
    )


def _readings(recording: Recording, robot: RobotDescription) -> None:
    """Readings that stand still while their motor moves, or is asked to."""
    moved, worked = _asked(recording)
    phases = [recording.phase_states(k) for k in recording.phases("fit", "check")]
    fitted = np.concatenate([np.arange(part.start, part.stop) for part in phases]) if phases else np.arange(0)
    for motor in sorted(set(range(recording.num_motors)) - recording.still_motors):
        name, angle = robot.motor_names[motor], recording.motor_angle[:, motor]
        for what, unit in (("velocity", "rad/s"), ("torque", "N m")):
            values = getattr(recording, f"motor_{what}")[fitted, motor]
            if len(values) and np.ptp(values) == 0:
                raise _bad(f"{name} moves, and its {what} is {values[0]:g} {unit} all the time")
        stands = moved[:, motor] & (_run_lengths(angle) > _STANDS / recording.period)
        share = stands.sum() / max(moved[:, motor].sum(), 1)
        if share > FALSE:
            at = float(np.median(angle[stands]))
            raise _bad(
                f"the angle of {name} stands still{_end(at, angle[fitted])} at {at:.3f} rad for {share:.0%} of the "
                f"time in which it is moved; at most {FALSE:.0%}: encoder, or something in the way"
            )
        torque = recording.motor_torque[:, motor]
        ceiling = float(np.abs(torque[fitted]).max())
        high = worked[:, motor] & (np.abs(torque) > ceiling - _WIRE) & (_run_lengths(torque, _WIRE) >= _TORQUES)
        share = high.sum() / max(worked[:, motor].sum(), 1)
        if share > FALSE and ceiling > _LEVEL:
            raise _bad(
                f"the torque of {name} is at a ceiling of {ceiling:.3f} N m for {share:.0%} of the time in which it "
                f"works; at most {FALSE:.0%}: raise the limit of the current"
            )


def _end(at: float, angles: Array) -> str:
    if np.isclose(at, angles.max()):
        return ", at its greatest,"
    return ", at its least," if np.isclose(at, angles.min()) else ""


def _asked(recording: Recording) -> tuple[Mask, Mask]:
    """In which states each motor is asked to move by its servo, and in which it works, also by its duty (T, M)."""
    moved = np.zeros_like(recording.motor_angle, np.bool_)
    worked = moved.copy()
    back = max(round(_STANDS / recording.period), 1)
    for k in recording.phases("fit", "check"):
        states = recording.phase_states(k)
        order = np.searchsorted(recording.arrival, recording.time[states], side="right") - 1
        value = recording.sent_value[np.clip(order, 0, None)]
        if recording.meta["phases"][k]["mode"] == Mode.PWM:
            worked[states] = np.abs(value) > 0
            continue
        earlier = value[np.maximum(np.arange(len(value)) - back, 0)]
        moved[states] = np.abs(value - earlier) > _ASKED * _STANDS
    return moved, worked | moved


def _run_lengths(values: Array, within: float = 0.0) -> NDArray[np.int64]:
    """How many equal neighbours each value is among, itself counted (T,)."""
    starts = np.concatenate([[True], np.abs(np.diff(values)) > within])
    run = np.cumsum(starts) - 1
    lengths: NDArray[np.int64] = np.bincount(run)[run]
    return lengths
