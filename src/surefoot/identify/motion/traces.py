"""Traces as recorded motion, and recorded motion as a trace; files of either."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices, prefix_errors
from surefoot.identify.motion.recorded import IMU, RecordedMotion
from surefoot.npz import read_npz
from surefoot.robot import RobotDescription
from surefoot.robot.params_file import param_table
from surefoot.task.trace import IMPORTED_LOG, EpisodeTrace, robot_meta


def deployed_motion(name: str, trace: EpisodeTrace) -> RecordedMotion:
    """Return the motion of a trace that surefoot recorded: each row's command was sent a row before."""
    sent = np.concatenate([[max(trace.time[0] - trace.meta["control_step"], 0.0)], trace.time[:-1]])
    return _motion(name, trace, sent, trace.time)


def motion_from_trace(name: str, trace: EpisodeTrace) -> RecordedMotion:
    """Return the motion of a trace, to be replayed; of an imported one the longest part with targets.

    Raises:
        SurefootError: fewer than two rows in a row with targets, or what `RecordedMotion.checked` refuses.
    """
    if not trace.imported:
        return deployed_motion(name, trace).checked()
    rows = _longest_run(np.asarray(np.isfinite(trace.target).all(axis=1)))
    if rows.stop - rows.start < 2:
        raise SurefootError("has no two rows in a row with commands; a log to replay or to identify from has commands")
    motion = _motion(name, trace, trace.time, trace.time if trace.meta.get("read_at_row") else np.empty(0))
    return replace(motion.rows(rows), gains=param_table(trace.meta["params"], "meta.params")).checked()


def _motion(name: str, trace: EpisodeTrace, sent: Array, read: Array) -> RecordedMotion:
    readings = trace.motor_angle, trace.motor_velocity, trace.motor_torque
    attitude = trace.roll_pitch_yaw, trace.angular_velocity_base
    return RecordedMotion(name, sent, trace.target, read, *readings, *attitude, meta=trace.meta)


def _longest_run(rows: NDArray[np.bool_]) -> slice:
    """Return the longest run of rows (T,) that are true."""
    ends = np.flatnonzero(np.diff(np.concatenate([[0], rows.astype(np.int8), [0]]))).reshape(-1, 2)
    first, last = max(ends.tolist(), key=lambda part: part[1] - part[0], default=(0, 0))
    return slice(first, last)


def trace_from_motion(motion: RecordedMotion, robot: RobotDescription) -> EpisodeTrace:
    """Return the rows of a log as a trace of the world `IMPORTED_LOG`; what nobody recorded is NaN.

    Raises:
        SurefootError: numbers that a trace does not take, such as infinite ones.
    """
    step = motion.control_step
    power = np.abs(np.sum(motion.motor_torque * motion.motor_velocity, axis=1))
    with prefix_errors(f"log {motion.name}"):
        return EpisodeTrace(
            time=motion.time,
            roll_pitch_yaw=motion.roll_pitch_yaw,
            angular_velocity_base=motion.angular_velocity_base,
            motor_angle=motion.motor_angle,
            motor_velocity=motion.motor_velocity,
            motor_torque=motion.motor_torque,
            target=motion.command,
            energy=power * np.diff(motion.time, prepend=motion.time[:1] - step),
            meta={
                **robot_meta(robot),
                "world": IMPORTED_LOG,
                "observation_names": [],
                "ended": "time",
                "max_steps": round(float(np.ptp(motion.time)) / step) + 1,
                "source": motion.name,
                "params": motion.gains,
                **({"read_at_row": True} if motion.read_at_row else {}),
                **motion.meta,
                "control_step": step,
            },
            robot_archive=robot.archive,
        )


def read_motion(path: Path, robot: RobotDescription) -> RecordedMotion:
    """Read a trace (.npz), or an .npz file with arrays `time` (T,), `command`, `motor_angle` (T, M) and `imu` (T, 4).

    `motor_angle` or `imu` may be missing.

    Raises:
        SurefootError: no such file, a damaged one, one with other arrays, of another robot, or one that can't be
            replayed.
    """
    with prefix_errors(f"log {path}"):
        arrays = read_npz(path)
        if "meta" in arrays:
            trace = EpisodeTrace.load(path)
            if trace.meta["robot"] != robot.name or tuple(trace.meta["motor_names"]) != robot.motor_names:
                raise SurefootError(f"is of robot '{trace.meta['robot']}', not of '{robot.name}' with its motors")
            return motion_from_trace(path.name, trace)
        return _motion_from_arrays(path.name, arrays, robot)


def _motion_from_arrays(name: str, arrays: dict[str, NDArray[Any]], robot: RobotDescription) -> RecordedMotion:
    missing = [key for key in ("time", "command") if key not in arrays]
    if missing or not {"motor_angle", "imu"} & set(arrays):
        lacks = missing or ["motor_angle and imu"]
        raise SurefootError(
            f"has no {' and no '.join(lacks)}; a log has time, command, and motor_angle or imu. It has "
            f"{choices(sorted(arrays)[:20])}; with other names: surefoot identify import --map MAPPING.yaml"
        )
    steps, motors = np.shape(arrays["time"])[:1] or (0,), robot.num_motors
    shapes = {"time": steps, "command": (*steps, motors), "motor_angle": (*steps, motors), "imu": (*steps, len(IMU))}
    columns: dict[str, Any] = {}
    for key, shape in shapes.items():
        array = arrays.get(key, np.full(shape, np.nan))
        if array.dtype.kind not in "iuf":
            raise SurefootError(f"{key} holds {array.dtype}; it must hold numbers")
        if array.shape != shape:
            rule = f"{robot.name} has {motors} motors" if key in ("command", "motor_angle") else "a row for each time"
            raise SurefootError(f"{key} has shape {array.shape}; it must have {shape}: {rule}")
        columns[key] = array.astype(float)
    # Yaw and its rate are not among the channels.
    columns["roll_pitch_yaw"], columns["angular_velocity_base"] = (
        np.pad(part, ((0, 0), (0, 1)), constant_values=np.nan) for part in np.split(columns.pop("imu"), 2, axis=1)
    )
    return RecordedMotion(name, **columns).checked()
