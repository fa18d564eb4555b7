"""Recording of an experiment: all commands sent and all states received, in a file with a digest."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.columns import column, columns_of
from surefoot.configuration import Positive, Within, typed_entries
from surefoot.errors import SurefootError, choices, prefix_errors
from surefoot.npz import pack_bytes, pop_bytes, pop_meta, read_npz, write_npz
from surefoot.robot import ROBOT_ARRAY, RobotDescription, load_embedded_robot

SCHEMA = 1
STILL_DEVIATION = 0.002
"""Standard deviation of an angle [rad] below which a motor counts as still: a few encoder steps."""
CLOCK_RESOLUTION = 2e-5
"""Twice the time resolution of states [s]."""
COMPLETE = "complete"
_MAX_COMMAND_AGE = 0.6
"""Maximum command age [s] that a state can represent."""


@dataclass(frozen=True)
class RecordedPhase:
    """A phase of the plan, as stored in a recording."""

    name: str
    mode: float
    """Mode of the robot."""
    use: str
    """What its readings are used for: fit, check or transition."""
    duration: Positive
    """Duration [s]."""


@dataclass(frozen=True)
class RecordedFrames:
    """Numbers of frames on the link."""

    received: float
    missing: float
    damaged: float


@dataclass(frozen=True)
class RecordingMeta:
    """Metadata of a recording."""

    experiment: str
    """Name of the experiment."""
    robot: str
    """Name of the robot."""
    motor_names: tuple[str, ...]
    """Names of the M motors, in the order of their columns."""
    rack: bool
    """Whether the robot hung on a rack."""
    phases: tuple[RecordedPhase, ...]
    """Phases of the plan: name, mode, use (fit, check or transition) and duration [s]."""
    mode_changes: tuple[tuple[float, float], ...]
    """Time on the host's clock [s] and new mode of each arming and disarming."""
    ended: str
    """`COMPLETE`, or why the experiment stopped early."""
    period: Positive
    """Time between two commands, and between two states [s]."""
    lead: float
    """Time by which the robot sends a state before the host uses it [s]."""
    servo_period: Positive
    """Time between two servo steps [s]."""
    resting_states: Annotated[int, Within(0, 1e9)]
    """Number of states before arming."""
    frames: RecordedFrames
    """Numbers of frames on the link: received, missing and damaged."""
    date: str
    """Date of the recording."""
    digest: str
    """SHA-256 over all arrays."""
    firmware: str = ""
    """Firmware of the robot."""
    gains: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """Servo gains of each motor, as reported by the robot."""
    schema: Literal[1] = 1
    """Version of the file format."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """Recorded experiment: C commands and T states of a robot with M motors."""

    sent_number: Array = column("C", "1", "number of the frame with the command")
    sent_time: Array = column("C", "s", "time of sending the command, on the host's clock")
    sent_phase: Array = column("C", "1", "index of the command's phase")
    sent_value: Array = column("C, M", "rad or 1", "motor angle or duty, depending on the mode of the phase")
    time: Array = column("T", "s", "time of sending the state, on the robot's clock")
    host_time: Array = column("T", "s", "time of its arrival, on the host's clock")
    mode: Array = column("T", "1", "mode of the robot")
    command: Array = column("T", "1", "number of the command in effect")
    command_age: Array = column("T", "s", "time since this command arrived at the robot")
    motor_angle: Array = column("T, M", "rad", "angle, delayed by the control latency")
    motor_velocity: Array = column("T, M", "rad/s", "velocity, with the same delay")
    motor_torque: Array = column("T, M", "N m", "torque, from the currents of the last servo step")
    roll_pitch_yaw: Array = column("T, 3", "rad", "orientation, with the same delay", "world")
    angular_velocity_base: Array = column("T, 3", "rad/s", "angular velocity, with the same delay", "base")
    voltage: Array = column("T", "V", "battery voltage, without delay")
    temperature: Array = column("T, M", "degC", "temperature of the motor")
    meta: dict[str, Any] = field(default_factory=dict)
    """Metadata with the entries of `RecordingMeta`."""
    robot_archive: bytes = b""
    """Folder of the robot description, as in `RobotDescription.archive`; empty for a built-in robot."""

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
        """States before the motors were armed; at least the first state."""
        return slice(0, max(int(self.meta["resting_states"]), 1))

    def phases(self, *uses: str) -> list[int]:
        """Return the indices of the phases with the given uses: fit, check or transition."""
        return [k for k, phase in enumerate(self.meta["phases"]) if phase["use"] in uses]

    def require_phases(self, use: str) -> list[int]:
        """Return the indices of the phases with a use, one or more.

        Raises:
            SurefootError: there is none.
        """
        if not (phases := self.phases(use)):
            raise SurefootError(f"the recording has no phase with the use '{use}'; it is not of this experiment")
        return phases

    def servo_step(self, times: Array) -> NDArray[np.int64]:
        """Return the index of the first servo step that begins at or after times [s] on the robot's clock."""
        return np.ceil((times - CLOCK_RESOLUTION) / float(self.meta["servo_period"])).astype(np.int64)

    @property
    def duration(self) -> float:
        """Time from the first to the last state on the robot's clock [s]."""
        return float(self.time[-1] - self.time[0]) if len(self.time) else 0.0

    @property
    def digest(self) -> str:
        """SHA-256 over all arrays."""
        return str(self.meta["digest"])

    @cached_property
    def clock_offset(self) -> float:
        """Median of the arrival time of commands (robot's clock) minus their sending time (host's clock) [s]."""
        offsets = self._reported_arrival - self.sent_time
        return float(np.nanmedian(offsets)) if np.isfinite(offsets).any() else 0.0

    @cached_property
    def arrival(self) -> Array:
        """Arrival time of each command on the robot's clock (C,) [s]: as states report, else from `clock_offset`."""
        reported = self._reported_arrival
        return np.where(np.isfinite(reported), reported, self.sent_time + self.clock_offset)

    @cached_property
    def _reported_arrival(self) -> Array:
        """Arrival time of each command (C,) [s] as reported by states; NaN where no state reports it."""
        arrival = np.full(len(self.sent_number), np.nan)
        place = np.searchsorted(self.sent_number, self.command)
        inside = (place < len(self.sent_number)) & (self.command_age < _MAX_COMMAND_AGE)
        inside[inside] &= self.sent_number[place[inside]] == self.command[inside]
        # The first state after a command reports its age most accurately: the age has a resolution of 10 us.
        for index in np.flatnonzero(inside)[::-1]:
            arrival[place[index]] = self.time[index] - self.command_age[index]
        return arrival

    @cached_property
    def still_motors(self) -> frozenset[int]:
        """Indices of motors that hardly move in the fitted phases, so that their parameters are not identifiable."""
        driven = np.zeros(len(self.time), np.bool_)
        for k in self.phases("fit"):
            driven[self.phase_states(k)] = True
        spread = self.motor_angle[driven].std(axis=0) if driven.any() else np.zeros(self.num_motors)
        return frozenset(np.flatnonzero(spread < STILL_DEVIATION).tolist())

    def phase_states(self, phase: int) -> slice:
        """Return the slice of states sent while commands of a phase were in effect."""
        sent = np.flatnonzero(self.sent_phase == phase)
        if not len(sent):
            return slice(0, 0)
        begin, last = self.arrival[sent[0]], self.arrival[sent[-1]]
        following = sent[-1] + 1
        end = self.arrival[following] if following < len(self.arrival) else last + 0.1
        return slice(*np.searchsorted(self.time, [begin, max(end, last)]).tolist())

    def save(self, path: Path) -> Path:
        """Write the recording to an .npz file atomically."""
        arrays = {name: getattr(self, name) for name in columns_of(Recording)}
        write_npz(path, arrays | pack_bytes(ROBOT_ARRAY, self.robot_archive), self.meta)
        return path


def interpolate_columns(moments: Array, times: Array, values: Array) -> Array:
    """Interpolate the columns of `values` (T, n), sampled at `times` (T,), linearly at `moments` (K,) -> (K, n)."""
    return np.stack([np.interp(moments, times, column) for column in values.T], axis=1)


def digest_arrays(arrays: dict[str, Array]) -> str:
    """Return the SHA-256 over named arrays, in the order of their names."""
    total = hashlib.sha256()
    for name in sorted(arrays):
        total.update(name.encode())
        total.update(np.ascontiguousarray(arrays[name], "<f8").tobytes())
    return total.hexdigest()


def recorded_robot(path: Path) -> RobotDescription:
    """Return the robot description stored in a recording, or else the built-in robot of the recorded name.

    Raises:
        SurefootError: the file can't be read, or has neither a description nor the name of a built-in robot.
    """
    with prefix_errors(f"recording {path}"):
        arrays = read_npz(path)
        return load_embedded_robot(pop_bytes(arrays, ROBOT_ARRAY), (pop_meta(arrays) or {}).get("robot"))


def load_recording(path: Path, robot: RobotDescription, experiment: str | None = None) -> Recording:
    """Read a recording.

    Raises:
        SurefootError: the file is missing, truncated, damaged, changed, or of another schema, robot or experiment, or
            the experiment stopped early.
    """
    with prefix_errors(f"recording {path}"):
        arrays = read_npz(path)
        meta = pop_meta(arrays) or {}
        if meta.get("schema") != SCHEMA:
            raise SurefootError(f"has schema {meta.get('schema')}; surefoot reads schema {SCHEMA}")
        archive = pop_bytes(arrays, ROBOT_ARRAY)
        columns = columns_of(Recording)
        if odd := set(columns) ^ set(arrays):
            raise SurefootError(f"missing or unknown: {choices(sorted(odd))}")
        typed_entries(RecordingMeta, meta, "meta")
        if meta["robot"] != robot.name or meta["motor_names"] != list(robot.motor_names):
            raise SurefootError(f"is of robot '{meta['robot']}', not of '{robot.name}' with its motors")
        if experiment is not None and meta["experiment"] != experiment:
            raise SurefootError(f"is of experiment {meta['experiment']}, not {experiment}")
        sizes = {"C": arrays["sent_number"].size, "T": arrays["time"].size, "M": robot.num_motors}
        arrays = {name: declared.validate(name, arrays[name], sizes) for name, declared in columns.items()}
        if digest_arrays(arrays) != meta["digest"]:
            raise SurefootError("was changed after it was recorded: its digest does not match")
        if meta["ended"] != COMPLETE:
            raise SurefootError(f"stopped early: {meta['ended']}")
        return Recording(**arrays, meta=meta, robot_archive=archive)
