"""The recording of an experiment: every command that was sent and every state that came, in a file with a digest."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.configuration import is_number
from surefoot.errors import SurefootError, choices, prefix_errors
from surefoot.npz import pack_bytes, pop_bytes, pop_meta, read_npz, write_npz
from surefoot.robot import ROBOT, RobotDescription, carried_robot

SCHEMA = 1
STILL = 0.002
"""Standard deviation of an angle [rad] below which a motor does not move: a few steps of its encoder."""
CLOCK_RESOLUTION = 2e-5
"""Twice the resolution of the times in states [s]."""
COMPLETE = "complete"
_MAX_COMMAND_AGE = 0.6
"""Greatest age of a command [s] that a state can hold."""
_META = (
    *("schema", "experiment", "robot", "motor_names", "rack", "phases", "mode_changes", "ended", "period", "lead"),
    *("servo_period", "resting_states", "frames", "date", "digest"),
)


@dataclass(frozen=True, eq=False)
class Recording:
    """An experiment with C commands and T states of a robot with M motors. Robot times are on the robot's clock."""

    sent_number: Array
    """Numbers of the frames that carried the commands (C,)."""
    sent_time: Array
    """When they were sent, on the host's clock (C,) [s]."""
    sent_phase: Array
    """Index of each command's phase (C,)."""
    sent_value: Array
    """Motor angles [rad] or duties (C, M), by the phase's mode."""
    time: Array
    """When the robot sent each state (T,) [s]."""
    host_time: Array
    """When it arrived, on the host's clock (T,) [s]."""
    mode: Array
    """The robot's mode (T,)."""
    command: Array
    """Number of the command in effect (T,)."""
    command_age: Array
    """Time since that arrived at the robot (T,) [s]."""
    motor_angle: Array
    """(T, M) [rad], delayed by the control latency."""
    motor_velocity: Array
    """(T, M) [rad/s], equally delayed."""
    motor_torque: Array
    """(T, M) [N m], from the currents of the last servo step."""
    roll_pitch_yaw: Array
    """(T, 3) [rad], delayed as angles are."""
    angular_velocity_base: Array
    """(T, 3) [rad/s], equally delayed."""
    voltage: Array
    """Of the battery, without delay (T,) [V]."""
    temperature: Array
    """Of the motors (T, M) [degC]."""
    meta: dict[str, Any]
    """Schema, experiment, robot, firmware, motor_names, rack, phases (name, mode, use, duration), mode_changes (the
    host's time [s] and the mode of all arming and disarming), ended (`COMPLETE`, or why not), period, lead and
    servo_period [s], resting_states (count before arming), frames (received, missing, damaged), date, digest."""
    robot_archive: bytes = b""
    """The robot's folder as `RobotDescription.archive` has it; empty for a robot that ships."""

    @property
    def num_motors(self) -> int:
        """Number of motors M."""
        return self.sent_value.shape[1]

    @property
    def period(self) -> float:
        """Time between two commands, and between two states [s]."""
        return float(self.meta["period"])

    @property
    def resting(self) -> slice:
        """States before motors were armed; at least the first one."""
        return slice(0, max(int(self.meta["resting_states"]), 1))

    def phases(self, *uses: str) -> list[int]:
        """Return the indices of the phases of some uses: fit, check or transition."""
        return [k for k, phase in enumerate(self.meta["phases"]) if phase["use"] in uses]

    def servo_step(self, times: Array) -> NDArray[np.int64]:
        """Return the number of the first servo step that begins at times [s] of the robot's clock or later."""
        return np.ceil((times - CLOCK_RESOLUTION) / float(self.meta["servo_period"])).astype(np.int64)

    @property
    def duration(self) -> float:
        """Robot time from the first state to the last [s]."""
        return float(self.time[-1] - self.time[0]) if len(self.time) else 0.0

    @property
    def digest(self) -> str:
        """SHA-256 over all arrays."""
        return str(self.meta["digest"])

    @cached_property
    def clock_offset(self) -> float:
        """Median of a command's arrival on the robot's clock less its sending on the host's [s]."""
        offsets = self._reported_arrival - self.sent_time
        return float(np.nanmedian(offsets)) if np.isfinite(offsets).any() else 0.0

    @cached_property
    def arrival(self) -> Array:
        """When each command arrived at the robot (C,) [s]: as states report, else by the clocks' offset."""
        reported = self._reported_arrival
        return np.where(np.isfinite(reported), reported, self.sent_time + self.clock_offset)

    @cached_property
    def _reported_arrival(self) -> Array:
        """When each command arrived at the robot (C,) [s], as states report; NaN where none does."""
        arrival = np.full(len(self.sent_number), np.nan)
        place = np.searchsorted(self.sent_number, self.command)
        inside = (place < len(self.sent_number)) & (self.command_age < _MAX_COMMAND_AGE)
        inside[inside] &= self.sent_number[place[inside]] == self.command[inside]
        # The first state after a command has its age best: the age has a resolution of 10 us.
        for index in np.flatnonzero(inside)[::-1]:
            arrival[place[index]] = self.time[index] - self.command_age[index]
        return arrival

    @cached_property
    def still_motors(self) -> frozenset[int]:
        """Motors whose angles hardly change in the fitted phases: their parameters are not identifiable."""
        driven = np.zeros(len(self.time), np.bool_)
        for k in self.phases("fit"):
            driven[self.phase_states(k)] = True
        spread = self.motor_angle[driven].std(axis=0) if driven.any() else np.zeros(self.num_motors)
        return frozenset(np.flatnonzero(spread < STILL).tolist())

    def phase_states(self, phase: int) -> slice:
        """Return the states that were sent while commands of a phase were in effect."""
        sent = np.flatnonzero(self.sent_phase == phase)
        if not len(sent):
            return slice(0, 0)
        begin, last = self.arrival[sent[0]], self.arrival[sent[-1]]
        following = sent[-1] + 1
        end = self.arrival[following] if following < len(self.arrival) else last + 0.1
        return slice(*np.searchsorted(self.time, [begin, max(end, last)]).tolist())

    def save(self, path: Path) -> Path:
        """Write an .npz file, whole or not at all."""
        arrays = {name: getattr(self, name) for name in recorded_arrays()}
        write_npz(path, arrays | pack_bytes(ROBOT, self.robot_archive), self.meta)
        return path


def read_at(moments: Array, times: Array, values: Array) -> Array:
    """Interpolate the columns of values (T, n) of times (T,) linearly at other moments (K,); returns (K, n)."""
    return np.stack([np.interp(moments, times, column) for column in values.T], axis=1)


def digest_of(arrays: dict[str, Array]) -> str:
    """Return the SHA-256 over arrays, by name."""
    total = hashlib.sha256()
    for name in sorted(arrays):
        total.update(name.encode())
        total.update(np.ascontiguousarray(arrays[name], "<f8").tobytes())
    return total.hexdigest()


def _first_invalid(arrays: dict[str, Any], meta: dict[str, Any], motors: int) -> str:
    """Return the name of an array or entry of the wrong shape or type; empty if there is none."""
    commands, states = np.shape(arrays["sent_number"])[:1], np.shape(arrays["time"])[:1]
    widths = dict.fromkeys(("sent_value", "motor_angle", "motor_velocity", "motor_torque", "temperature"), (motors,))
    widths |= dict.fromkeys(("roll_pitch_yaw", "angular_velocity_base"), (3,))
    for name, array in arrays.items():
        rows = commands if name.startswith("sent_") else states
        if len(rows) != 1 or array.shape != (*rows, *widths.get(name, ())) or array.dtype != np.float64:
            return name

    def is_phase(phase: Any) -> bool:
        keys = {"name": str, "use": str, "mode": float, "duration": float}
        return isinstance(phase, dict) and all(is_kind(phase.get(key), kind) for key, kind in keys.items())

    def is_kind(value: Any, kind: type) -> bool:
        return is_number(value) if kind is float else isinstance(value, kind)

    phases, changes, frames = (meta[name] for name in ("phases", "mode_changes", "frames"))
    counts = [frames.get(key) for key in ("received", "missing", "damaged")] if isinstance(frames, dict) else [None]
    valid = {
        "phases": isinstance(phases, list) and all(map(is_phase, phases)),
        "mode_changes": isinstance(changes, list)
        and all(isinstance(change, list) and len(change) == 2 and all(map(is_number, change)) for change in changes),
        "frames": all(map(is_number, counts)),
        "resting_states": isinstance(meta["resting_states"], int) and 0 <= meta["resting_states"] < 10**9,
        "lead": is_number(meta["lead"]),
    }
    valid |= {name: is_number(meta[name]) and meta[name] > 0 for name in ("period", "servo_period")}
    valid |= {name: isinstance(meta[name], str) for name in ("experiment", "ended", "date", "digest")}
    return next((f"meta.{name}" for name, right in valid.items() if not right), "")


def recorded_arrays() -> list[str]:
    """Return the names of a recording's arrays, in order."""
    return [item.name for item in fields(Recording) if item.name not in ("meta", "robot_archive")]


def recorded_robot(path: Path) -> RobotDescription:
    """Return the robot that a recording carries, else the one of its name that ships.

    Raises:
        SurefootError: the file can't be read, or neither is there.
    """
    with prefix_errors(f"recording {path}"):
        arrays = read_npz(path)
        return carried_robot(pop_bytes(arrays, ROBOT), (pop_meta(arrays) or {}).get("robot"))


def load_recording(path: Path, robot: RobotDescription, experiment: str | None = None) -> Recording:
    """Read a recording.

    Raises:
        SurefootError: no such file, cut off, damaged, changed, of another schema, robot or experiment, or an experiment
            that did not come to its end.
    """
    with prefix_errors(f"recording {path}"):
        arrays = read_npz(path)
        meta = pop_meta(arrays) or {}
        if meta.get("schema") != SCHEMA:
            raise SurefootError(f"has schema {meta.get('schema')}; surefoot reads schema {SCHEMA}")
        archive = pop_bytes(arrays, ROBOT)
        if missing := [key for key in _META if key not in meta] + sorted(set(recorded_arrays()) ^ set(arrays)):
            raise SurefootError(f"missing or unknown: {choices(missing)}")
        if meta["robot"] != robot.name or meta["motor_names"] != list(robot.motor_names):
            raise SurefootError(f"is of robot '{meta['robot']}', not of '{robot.name}' with its motors")
        if experiment is not None and meta["experiment"] != experiment:
            raise SurefootError(f"is of experiment {meta['experiment']}, not {experiment}")
        if name := _first_invalid(arrays, meta, robot.num_motors):
            raise SurefootError(f"{name} does not fit; it must be what surefoot wrote")
        if digest_of(arrays) != meta["digest"]:
            raise SurefootError("was changed after it was made: its digest does not fit")
        if meta["ended"] != COMPLETE:
            raise SurefootError(f"did not come to its end: {meta['ended']}")
        return Recording(**arrays, meta=meta, robot_archive=archive)
