"""The recording of an experiment: every command that was sent and every state that came, in a file with a digest."""

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
from surefoot.robot import ROBOT, RobotDescription, load_embedded_robot

SCHEMA = 1
STILL = 0.002
"""Standard deviation of an angle [rad] below which a motor does not move: a few steps of its encoder."""
CLOCK_RESOLUTION = 2e-5
"""Twice the resolution of the times in states [s]."""
COMPLETE = "complete"
_MAX_COMMAND_AGE = 0.6
"""Greatest age of a command [s] that a state can hold."""


@dataclass(frozen=True)
class RecordedPhase:
    """A phase of the plan."""

    name: str
    mode: float
    """The robot's mode."""
    use: str
    """Fit, check or transition."""
    duration: float
    """Length [s]."""


@dataclass(frozen=True)
class RecordedFrames:
    """Counts of frames on the link."""

    received: float
    missing: float
    damaged: float


@dataclass(frozen=True)
class RecordingMeta:
    """Entries of every recording's meta."""

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
    """The host's time [s] and the mode of all arming and disarming."""
    ended: str
    """`COMPLETE`, or why not."""
    period: Positive
    """Time between two commands, and between two states [s]."""
    lead: float
    """Time by which states are requested before they are needed [s]."""
    servo_period: Positive
    """Time between two servo steps [s]."""
    resting_states: Annotated[int, Within(0, 1e9)]
    """Number of states before arming."""
    frames: RecordedFrames
    """Counts of frames on the link: received, missing and damaged."""
    date: str
    """When it was recorded."""
    digest: str
    """SHA-256 over all arrays."""
    firmware: str = ""
    """What runs on the robot."""
    gains: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """The servos' gains of each motor, as the robot states them."""
    schema: Literal[1] = 1
    """Version of the format."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """An experiment with C commands and T states of a robot with M motors. Robot times are on the robot's clock."""

    sent_number: Array = column("C", "1", "number of the frame that carried the command")
    sent_time: Array = column("C", "s", "when it was sent, on the host's clock")
    sent_phase: Array = column("C", "1", "index of the command's phase")
    sent_value: Array = column("C, M", "rad or 1", "motor angle or duty, by the phase's mode")
    time: Array = column("T", "s", "when the robot sent the state")
    host_time: Array = column("T", "s", "when it arrived, on the host's clock")
    mode: Array = column("T", "1", "the robot's mode")
    command: Array = column("T", "1", "number of the command in effect")
    command_age: Array = column("T", "s", "time since that arrived at the robot")
    motor_angle: Array = column("T, M", "rad", "angle, delayed by the control latency")
    motor_velocity: Array = column("T, M", "rad/s", "velocity, equally delayed")
    motor_torque: Array = column("T, M", "N m", "torque, from the currents of the last servo step")
    roll_pitch_yaw: Array = column("T, 3", "rad", "orientation, delayed as angles are", "world")
    angular_velocity_base: Array = column("T, 3", "rad/s", "angular velocity, equally delayed", "base")
    voltage: Array = column("T", "V", "voltage of the battery, without delay")
    temperature: Array = column("T, M", "degC", "temperature of the motor")
    meta: dict[str, Any] = field(default_factory=dict)
    """The entries of `RecordingMeta`."""
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
        arrays = {name: getattr(self, name) for name in columns_of(Recording)}
        write_npz(path, arrays | pack_bytes(ROBOT, self.robot_archive), self.meta)
        return path


def read_at(moments: Array, times: Array, values: Array) -> Array:
    """Interpolate the columns of values (T, n) of times (T,) linearly at other moments (K,); returns (K, n)."""
    return np.stack([np.interp(moments, times, column) for column in values.T], axis=1)


def digest_arrays(arrays: dict[str, Array]) -> str:
    """Return the SHA-256 over arrays, by name."""
    total = hashlib.sha256()
    for name in sorted(arrays):
        total.update(name.encode())
        total.update(np.ascontiguousarray(arrays[name], "<f8").tobytes())
    return total.hexdigest()


def recorded_robot(path: Path) -> RobotDescription:
    """Return the robot that a recording carries, else the one of its name that ships.

    Raises:
        SurefootError: the file can't be read, or neither is there.
    """
    with prefix_errors(f"recording {path}"):
        arrays = read_npz(path)
        return load_embedded_robot(pop_bytes(arrays, ROBOT), (pop_meta(arrays) or {}).get("robot"))


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
        columns = columns_of(Recording)
        if odd := set(columns) ^ set(arrays):
            raise SurefootError(f"missing or unknown: {choices(sorted(odd))}")
        typed_entries(RecordingMeta, meta, "meta")
        if meta["robot"] != robot.name or meta["motor_names"] != list(robot.motor_names):
            raise SurefootError(f"is of robot '{meta['robot']}', not of '{robot.name}' with its motors")
        if experiment is not None and meta["experiment"] != experiment:
            raise SurefootError(f"is of experiment {meta['experiment']}, not {experiment}")
        sizes = {"C": arrays["sent_number"].size, "T": arrays["time"].size, "M": robot.num_motors}
        arrays = {name: declared.checked(name, arrays[name], sizes) for name, declared in columns.items()}
        if digest_arrays(arrays) != meta["digest"]:
            raise SurefootError("was changed after it was made: its digest does not fit")
        if meta["ended"] != COMPLETE:
            raise SurefootError(f"did not come to its end: {meta['ended']}")
        return Recording(**arrays, meta=meta, robot_archive=archive)
