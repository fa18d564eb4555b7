"""What an experiment recorded: every command that was sent and every state that came, in one file with a digest."""

from __future__ import annotations

import hashlib
import json
import zipfile
import zlib
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.configuration import is_number
from surefoot.errors import SurefootError, choices
from surefoot.files import check_readable
from surefoot.npz import write_npz
from surefoot.robot import RobotDescription

SCHEMA = 1
STILL = 0.002
"""Standard deviation of an angle [rad] below which a motor has not moved: a few steps of its encoder."""
CLOCK = 2e-5
"""Resolution of the times in states [s], twice."""
COMPLETE = "complete"
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
    """Index of the phase to which each belongs (C,)."""
    sent_value: Array
    """Motor angles [rad] or duties (C, M), as the phase's mode says."""
    time: Array
    """When each state was sent by the robot (T,) [s]."""
    host_time: Array
    """When it came, on the host's clock (T,) [s]."""
    mode: Array
    """The robot's mode (T,)."""
    command: Array
    """Number of the command that the robot obeyed (T,)."""
    command_age: Array
    """Time since that came to the robot (T,) [s]."""
    motor_angle: Array
    """(T, M) [rad], as old as readings are."""
    motor_velocity: Array
    """(T, M) [rad/s], equally old."""
    motor_torque: Array
    """(T, M) [N m], from the currents of the last servo step."""
    roll_pitch_yaw: Array
    """(T, 3) [rad], as old as readings are."""
    angular_velocity_base: Array
    """(T, 3) [rad/s], equally old."""
    voltage: Array
    """Of the battery (T,) [V], of now."""
    temperature: Array
    """Of the motors (T, M) [degC]."""
    meta: dict[str, Any]
    """What can be written as JSON: schema, experiment, robot, firmware, motor_names, rack, phases (name, mode, use,
    duration), mode_changes (the host's time [s] of sending, and mode, of all arming and disarming), ended (`COMPLETE`,
    or why not), period and lead (s), servo_period (s), resting_states (how many came before motors were armed), frames
    (received, missing, damaged), date, digest."""

    @property
    def num_motors(self) -> int:
        """Number of motors M."""
        return self.sent_value.shape[1]

    @property
    def period(self) -> float:
        """Time between two commands, and between two states [s]."""
        return float(self.meta["period"])

    def phases(self, *uses: str) -> list[int]:
        """Indices of the phases of some uses: fit, check or way."""
        return [k for k, phase in enumerate(self.meta["phases"]) if phase["use"] in uses]

    def servo_step(self, times: Array) -> NDArray[np.int64]:
        """Number of the first servo step that begins at times [s] or later, by the robot's clock."""
        return np.ceil((times - CLOCK) / float(self.meta["servo_period"])).astype(np.int64)

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
        """Usual difference of a command's coming, on the robot's clock, and its sending, on the host's [s]."""
        told = self._told - self.sent_time
        return float(np.nanmedian(told)) if np.isfinite(told).any() else 0.0

    @cached_property
    def arrival(self) -> Array:
        """When each command came to the robot (C,) [s]: what states tell, else as long after sending as usual."""
        return np.where(np.isfinite(self._told), self._told, self.sent_time + self.clock_offset)

    @cached_property
    def _told(self) -> Array:
        """When each command came to the robot (C,) [s], as states tell; NaN where none does."""
        told = np.full(len(self.sent_number), np.nan)
        place = np.searchsorted(self.sent_number, self.command)
        inside = (place < len(self.sent_number)) & (self.command_age < 0.6)
        inside[inside] &= self.sent_number[place[inside]] == self.command[inside]
        # The first state after a command tells its age best: the age has a resolution of 10 us.
        for index in np.flatnonzero(inside)[::-1]:
            told[place[index]] = self.time[index] - self.command_age[index]
        return told

    @cached_property
    def still_motors(self) -> frozenset[int]:
        """Motors whose angles hardly change while they are experimented with: nothing can be told of them."""
        driven = np.zeros(len(self.time), np.bool_)
        for k in self.phases("fit"):
            driven[self.phase_states(k)] = True
        spread = self.motor_angle[driven].std(axis=0) if driven.any() else np.zeros(self.num_motors)
        return frozenset(np.flatnonzero(spread < STILL).tolist())

    def phase_states(self, phase: int) -> slice:
        """States that were sent while commands of a phase held."""
        mine = np.flatnonzero(self.sent_phase == phase)
        if not len(mine):
            return slice(0, 0)
        begin, last = self.arrival[mine[0]], self.arrival[mine[-1]]
        following = mine[-1] + 1
        end = self.arrival[following] if following < len(self.arrival) else last + 0.1
        return slice(*np.searchsorted(self.time, [begin, max(end, last)]).tolist())

    def save(self, path: Path) -> Path:
        """Write it to an .npz file, whole or not at all."""
        arrays = {item.name: getattr(self, item.name) for item in fields(self) if item.name != "meta"}
        write_npz(path, arrays, self.meta)
        return path


def read_at(moments: Array, times: Array, values: Array) -> Array:
    """Return the columns of values (T, n) of times (T,) at other moments (K,), on straight lines between (K, n)."""
    return np.stack([np.interp(moments, times, column) for column in values.T], axis=1)


def digest_of(arrays: dict[str, Array]) -> str:
    """SHA-256 over arrays, by name."""
    total = hashlib.sha256()
    for name in sorted(arrays):
        total.update(name.encode())
        total.update(np.ascontiguousarray(arrays[name], "<f8").tobytes())
    return total.hexdigest()


def _misfit(arrays: dict[str, Any], meta: dict[str, Any], motors: int) -> str:
    """What does not fit a recording in shape or type: name of an array or of an entry; empty if all do."""
    commands, states = np.shape(arrays["sent_number"])[:1], np.shape(arrays["time"])[:1]
    widths = dict.fromkeys(("sent_value", "motor_angle", "motor_velocity", "motor_torque", "temperature"), (motors,))
    widths |= dict.fromkeys(("roll_pitch_yaw", "angular_velocity_base"), (3,))
    for name, array in arrays.items():
        rows = commands if name.startswith("sent_") else states
        if len(rows) != 1 or array.shape != (*rows, *widths.get(name, ())) or array.dtype != np.float64:
            return name

    def numbers(*values: Any) -> bool:
        return all(map(is_number, values))

    phases, changes, frames = (meta[name] for name in ("phases", "mode_changes", "frames"))
    right = {
        "phases": isinstance(phases, list)
        and all(
            isinstance(phase, dict)
            and all(isinstance(phase.get(key), str) for key in ("name", "use"))
            and numbers(phase.get("mode"), phase.get("duration"))
            for phase in phases
        ),
        "mode_changes": isinstance(changes, list)
        and all(isinstance(change, list) and len(change) == 2 and numbers(*change) for change in changes),
        "frames": isinstance(frames, dict) and numbers(*(frames.get(x) for x in ("received", "missing", "damaged"))),
        "resting_states": isinstance(meta["resting_states"], int) and 0 <= meta["resting_states"] < 10**9,
        "lead": numbers(meta["lead"]),
    }
    right |= {name: numbers(meta[name]) and meta[name] > 0 for name in ("period", "servo_period")}
    right |= {name: isinstance(meta[name], str) for name in ("experiment", "ended", "date", "digest")}
    return next((f"meta.{name}" for name, fits in right.items() if not fits), "")


def load_recording(path: Path, robot: RobotDescription, experiment: str | None = None) -> Recording:
    """Read a recording.

    Raises:
        SurefootError: no such file, cut off, damaged, changed, of another schema, robot or experiment, or an experiment
            that did not come to its end.
    """
    names = {item.name for item in fields(Recording)} - {"meta"}
    try:
        check_readable(path)
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        meta = json.loads(str(arrays.pop("meta")))
    except OSError as error:
        raise SurefootError(f"recording {path}: can't be read: {error.strerror or 'it is no recording'}") from error
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
        raise SurefootError(f"recording {path}: cut off or damaged: {error}") from error
    except (KeyError, ValueError, TypeError) as error:
        raise SurefootError(f"recording {path}: is none: {' '.join(str(error).split())}") from error
    if not isinstance(meta, dict) or meta.get("schema") != SCHEMA:
        found = meta.get("schema") if isinstance(meta, dict) else None
        raise SurefootError(f"recording {path}: has schema {found}; surefoot reads schema {SCHEMA}")
    missing = [key for key in _META if key not in meta] + sorted(names ^ set(arrays))
    if missing:
        raise SurefootError(f"recording {path}: missing or unknown: {choices(missing)}")
    if meta["robot"] != robot.name or meta["motor_names"] != list(robot.motor_names):
        raise SurefootError(f"recording {path}: is of robot '{meta['robot']}', not of '{robot.name}' with its motors")
    if experiment is not None and meta["experiment"] != experiment:
        raise SurefootError(f"recording {path}: is of experiment {meta['experiment']}, not {experiment}")
    if odd := _misfit(arrays, meta, robot.num_motors):
        raise SurefootError(f"recording {path}: {odd} does not fit; it must be what surefoot wrote")
    if digest_of(arrays) != meta["digest"]:
        raise SurefootError(f"recording {path}: was changed after it was made: its digest does not fit")
    if meta["ended"] != COMPLETE:
        raise SurefootError(f"recording {path}: did not come to its end: {meta['ended']}")
    return Recording(**arrays, meta=meta)
