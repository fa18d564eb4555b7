"""Conversion between episode traces and recorded motion, and reading of their files."""

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

_READINGS = ("motor_angle", "motor_velocity", "motor_torque", "roll_pitch_yaw", "angular_velocity_base")


def deployed_motion(name: str, trace: EpisodeTrace) -> RecordedMotion:
    """Return the motion of a trace recorded by surefoot, in which the command of a row was sent one row earlier."""
    sent = np.concatenate([[max(trace.time[0] - trace.meta["control_step"], 0.0)], trace.time[:-1]])
    return _motion(name, trace, sent, trace.time)


def motion_from_trace(name: str, trace: EpisodeTrace) -> RecordedMotion:
    """Return the motion of a trace for replay; from an imported trace, the longest part with targets.

    Raises:
        SurefootError: there are no two consecutive rows with targets, or the motion can't be replayed.
    """
    if not trace.is_imported:
        motion = deployed_motion(name, trace)
        # The row before a missed step holds the readings of a later one.
        late = np.isin(np.arange(trace.num_steps) + 1, trace.meta.get("missed_steps", ()))[:, None]
        kept: dict[str, Any] = {reading: np.where(late, np.nan, getattr(motion, reading)) for reading in _READINGS}
        return replace(motion, **kept).require_replayable()
    rows = _longest_run(np.asarray(np.isfinite(trace.target).all(axis=1)))
    if rows.stop - rows.start < 2:
        raise SurefootError("has no two consecutive rows with commands; replay and identification need commands")
    motion = _motion(name, trace, trace.time, trace.time if trace.meta.get("read_at_row") else np.empty(0))
    return replace(motion.rows(rows), gains=param_table(trace.meta["params"], "meta.params")).require_replayable()


def _motion(name: str, trace: EpisodeTrace, sent: Array, read: Array) -> RecordedMotion:
    readings = trace.motor_angle, trace.motor_velocity, trace.motor_torque
    attitude = trace.roll_pitch_yaw, trace.angular_velocity_base
    return RecordedMotion(name, sent, trace.target, read, *readings, *attitude, meta=trace.meta)


def _longest_run(rows: NDArray[np.bool_]) -> slice:
    """Return the longest run of true values in a mask (T,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], rows.astype(np.int8), [0]]))).reshape(-1, 2)
    first, last = max(edges.tolist(), key=lambda part: part[1] - part[0], default=(0, 0))
    return slice(first, last)


def trace_from_motion(motion: RecordedMotion, robot: RobotDescription) -> EpisodeTrace:
    """Return a log as a trace of the world `IMPORTED_LOG`; missing values are NaN.

    Raises:
        SurefootError: the log has values that a trace can't hold, such as infinite ones.
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
    """Read a trace, or an .npz file with arrays `time` (T,), `command` and `motor_angle` (T, M), and `imu` (T, 4).

    One of `motor_angle` and `imu` may be missing.

    Raises:
        SurefootError: the file is missing, damaged, has other arrays, is of another robot, or can't be replayed.
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
            f"has no {' and no '.join(lacks)}; a log needs time, command, and motor_angle or imu. It has "
            f"{choices(sorted(arrays)[:20])}; with other names: surefoot identify import --map MAPPING.yaml"
        )
    steps, motors = np.shape(arrays["time"])[:1] or (0,), robot.num_motors
    shapes = {"time": steps, "command": (*steps, motors), "motor_angle": (*steps, motors), "imu": (*steps, len(IMU))}
    columns: dict[str, Any] = {}
    for key, shape in shapes.items():
        array = arrays.get(key, np.full(shape, np.nan))
        if array.dtype.kind not in "iuf":
            raise SurefootError(f"{key} has type {array.dtype}; it must hold numbers")
        if array.shape != shape:
            rule = f"{robot.name} has {motors} motors" if key in ("command", "motor_angle") else "one row per time"
            raise SurefootError(f"{key} has shape {array.shape}; it must have {shape}: {rule}")
        columns[key] = array.astype(float)
    # Yaw and its rate are not in the file.
    columns["roll_pitch_yaw"], columns["angular_velocity_base"] = (
        np.pad(part, ((0, 0), (0, 1)), constant_values=np.nan) for part in np.split(columns.pop("imu"), 2, axis=1)
    )
    return RecordedMotion(name, **columns).require_replayable()
