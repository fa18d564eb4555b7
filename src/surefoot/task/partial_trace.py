"""Partial trace files: rows written one by one during a run, from which the trace of an interrupted run is recovered.

A partial file is a line of JSON (columns and meta of the trace, the state at its start, and its robot unless that ships
with surefoot), followed by rows of little-endian 64-bit floats. An incomplete last row is ignored.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from surefoot.arrays import Array
from surefoot.columns import RowLayout, columns_of
from surefoot.configuration import Within, from_mapping
from surefoot.errors import SurefootError, describe_os_errors, prefix_errors
from surefoot.files import check_readable
from surefoot.task.trace import EpisodeTrace, trace_sizes

SUFFIX = ".partial"
"""Suffix appended to the full name of the trace file."""
MEASURED_COLUMNS = (
    *("time", "roll_pitch_yaw", "angular_velocity_base", "motor_angle", "motor_velocity", "motor_torque"),
    *("observation", "feedback", "target", "energy"),
)
"""Trace columns that every robot measures."""
_KIND = "surefoot-partial-trace"
_VERSION = 2


def row_layout(names: tuple[str, ...], sizes: Mapping[str, int]) -> RowLayout:
    """Return the layout of one row of the named trace columns; `sizes` as returned by `trace_sizes`."""
    columns, one_row = columns_of(EpisodeTrace), {**sizes, "T": 1, "T+1": 1}
    return RowLayout({name: math.prod(columns[name].shape_for(one_row)) for name in names})


@dataclass(frozen=True)
class TraceHeader:
    """Header of a partial trace: everything except its rows, one per control step."""

    layout: RowLayout
    """Columns of the rows. Columns that traces do not have are dropped from the trace."""
    meta: dict[str, Any]
    """Meta of the trace, as far as known at the start."""
    start: Mapping[str, Array] = field(default_factory=dict)
    """Initial values (n,) of columns that include the start of the episode, by name."""
    robot_archive: bytes = b""
    """Archive of the robot's folder, see `EpisodeTrace`."""

    @classmethod
    def of_robot(
        cls, meta: dict[str, Any], actions: int, robot_archive: bytes, commands: bool, accelerometer: bool = False
    ) -> TraceHeader:
        """Return the header of a robot's trace.

        Args:
            meta: meta of the trace.
            actions: number of feedback columns.
            robot_archive: archive of the robot's folder.
            commands: whether the robot follows commands.
            accelerometer: whether the robot has an accelerometer.
        """
        optional = {"command": commands, "accelerometer": accelerometer, "height_map": bool(meta.get("height_map"))}
        names = (*MEASURED_COLUMNS, *(name for name, exists in optional.items() if exists))
        return cls(row_layout(names, trace_sizes(0, (actions,), meta)), meta, robot_archive=robot_archive)

    def line(self) -> bytes:
        """Return the first line of a partial file."""
        head = {
            "kind": _KIND,
            "version": _VERSION,
            "columns": self.layout.widths,
            "start": {name: values.tolist() for name, values in self.start.items()},
            "meta": self.meta,
            "robot": base64.b64encode(self.robot_archive).decode(),
        }
        return json.dumps(head).encode() + b"\n"

    def trace(self, rows: Array, meta: Mapping[str, Any], truth: Mapping[str, Array] | None = None) -> EpisodeTrace:
        """Return the trace.

        Args:
            rows: rows of the partial file (T, width).
            meta: more entries of its meta.
            truth: more columns, such as externally measured base and feet.

        Raises:
            SurefootError: no rows, or rows that do not fit the columns of a trace.
        """
        if not len(rows):
            raise SurefootError("no control step was done; there is nothing to save")
        columns = {}
        for name, values in self.layout.columns(rows).items():
            if (declared := columns_of(EpisodeTrace).get(name)) is None:
                continue
            rest, width = declared.shape.split(", ")[1:], self.layout.widths[name]
            try:
                if declared.shape.startswith("T+1"):
                    values = np.vstack([self.start.get(name, np.full(width, np.nan)), values])
                columns[name] = values.reshape(len(values), *(int(size) if size.isdigit() else -1 for size in rest))
            except ValueError:
                raise SurefootError(f"column {name} ({declared.shape}) has {width} numbers in a row") from None
        merged = {**self.meta, **meta}
        return EpisodeTrace(**{**columns, **(truth or {})}, meta=merged, robot_archive=self.robot_archive)


@dataclass(frozen=True)
class _FirstLine:
    """Entries of the first line of a partial file."""

    version: int
    columns: dict[str, Annotated[int, Within(0, 100_000)]]
    start: dict[str, tuple[float, ...]]

    def __post_init__(self) -> None:
        if self.version != _VERSION:
            raise SurefootError(f"is of version {self.version}; surefoot reads versions 1 and {_VERSION}")


def row_bytes(rows: Array) -> bytes:
    """Encode rows (n, width) for the file."""
    return rows.astype("<f8").tobytes()


def recover(path: str | Path) -> EpisodeTrace:
    """Recover the trace of an interrupted run from its partial file, with `ended` set to fault.

    Raises:
        SurefootError: no such file, another kind of file, or a file without a complete row.
    """
    path = Path(path)
    with describe_os_errors(f"partial trace {path}"):
        check_readable(path)
        line, _, body = path.read_bytes().partition(b"\n")
    with prefix_errors(f"partial trace {path}"):
        try:
            entries = json.loads(line)
            kind, meta = entries.pop("kind"), dict(entries.pop("meta"))
            robot = base64.b64decode(entries.pop("robot", ""), validate=True)
            if kind == _KIND and "version" not in entries:
                entries = _from_version_1(entries)
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
            raise SurefootError(f"is not a partial trace file: {' '.join(str(error).split())}") from error
        if kind != _KIND:
            raise SurefootError("is not a partial trace file: it is of another kind")
        first = from_mapping(_FirstLine, entries)
        start = {name: np.array(values) for name, values in first.start.items()}
        head = TraceHeader(RowLayout(first.columns), meta, start, robot)
        width = head.layout.width
        steps = len(body) // (8 * width) if width else 0
        if not steps:
            raise SurefootError("holds no complete control step")
        rows = np.frombuffer(body, "<f8", steps * width).reshape(steps, width).astype(float)
        return head.trace(rows, {"ended": "fault", "reason": "cut off"})


def _from_version_1(entries: dict[str, Any]) -> dict[str, Any]:
    """Convert the first line of a version 1 file, which has counts, and the robot's clock as the second column."""
    counts = {
        size: entries[name] for size, name in zip("MLOA", ("motors", "legs", "observations", "actions"), strict=True)
    }
    names = (*MEASURED_COLUMNS, "command") if entries.get("commands") else MEASURED_COLUMNS
    row = row_layout(names, counts).widths
    return {"version": _VERSION, "columns": {"time": row.pop("time"), "robot_time": 1, **row}, "start": {}}
