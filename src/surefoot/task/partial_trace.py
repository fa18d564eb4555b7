"""Rows of a trace that are written one by one while it is recorded; if the run is cut off, a trace is made from them.

A partial file is a line of JSON (columns and meta of the trace, the state at its start, and its robot if that does not
ship) and then rows of little-endian 64-bit floats. A row that was cut off is left out when it is read.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from surefoot.arrays import Array
from surefoot.columns import RowLayout, columns_of
from surefoot.configuration import Within, from_mapping
from surefoot.errors import SurefootError, describe_os_errors, prefix_errors
from surefoot.files import check_readable
from surefoot.task.trace import EpisodeTrace, trace_sizes

SUFFIX = ".partial"
"""Behind the whole name of the trace's file."""
MEASURED = (
    *("time", "roll_pitch_yaw", "angular_velocity_base", "motor_angle", "motor_velocity", "motor_torque"),
    *("observation", "feedback", "target", "energy"),
)
"""Columns that every robot measures."""
_KIND = "surefoot-partial-trace"
_Count = Annotated[int, Within(0, 100_000)]


@dataclass(frozen=True)
class _Head:
    """What the first line of a file says of its rows."""

    columns: dict[str, _Count]
    start: dict[str, tuple[float, ...]] = field(default_factory=dict)
    version: Literal[2] = 2

    @property
    def layout(self) -> RowLayout:
        return RowLayout(self.columns)


@dataclass(frozen=True)
class _FormerHead:
    """The same of version 1, whose rows had the robot's clock too."""

    motors: _Count
    legs: _Count
    observations: _Count
    actions: _Count
    commands: _Count = 0

    @property
    def layout(self) -> RowLayout:
        row = row_layout((*MEASURED, *(("command",) if self.commands else ())), vars(self)).widths
        return RowLayout({"time": row.pop("time"), "robot_time": 1, **row})

    @property
    def start(self) -> dict[str, tuple[float, ...]]:
        return {}


def row_layout(names: tuple[str, ...], sizes: Mapping[str, int]) -> RowLayout:
    """Return the layout of rows of a trace's columns; `sizes` are those of `trace_sizes`."""
    columns = columns_of(EpisodeTrace)
    return RowLayout({name: math.prod(columns[name].sized({**sizes, "steps": 1, "states": 1})) for name in names})


def measured_layout(meta: Mapping[str, Any], actions: int, commands: bool) -> RowLayout:
    """Return the layout of rows of a robot, with commands if its policy is steered."""
    names = (*MEASURED, "command") if commands else MEASURED
    return row_layout(names, trace_sizes(0, (actions,), meta))


def make_trace(
    layout: RowLayout,
    rows: Array,
    meta: Mapping[str, Any],
    start: Mapping[str, Any] | None = None,
    truth: Mapping[str, Array] | None = None,
    robot_archive: bytes = b"",
) -> EpisodeTrace:
    """Return the trace of rows (T, width), one a control step, with its meta; refuse rows that are none.

    Args:
        layout: the rows' columns.
        rows: one a control step.
        meta: the trace's.
        start: values at the start of columns that have them, (n,) by name.
        truth: further columns, such as base and feet that were measured externally.
        robot_archive: the trace's.
    """
    if not len(rows):
        raise SurefootError("no control step was done; there is nothing to save")
    columns = {}
    for name, values in layout.columns(rows).items():
        if (declared := columns_of(EpisodeTrace).get(name)) is None:
            continue
        width, shape = layout.widths[name], [-1 if isinstance(size, str) else size for size in declared.shape[1:]]
        try:
            if declared.shape[0] == "states":
                values = np.vstack([(start or {}).get(name, np.full(width, np.nan)), values])
            columns[name] = values.reshape(len(values), *shape)
        except ValueError:
            raise SurefootError(
                f"column {name} has rows of {width} numbers; one has shape {declared.shape[1:]}"
            ) from None
    return EpisodeTrace(**{**columns, **(truth or {})}, meta=dict(meta), robot_archive=robot_archive)


def head_line(
    layout: RowLayout, meta: Mapping[str, Any], start: Mapping[str, Array] | None = None, robot_archive: bytes = b""
) -> bytes:
    """Return the first line of a partial file."""
    head = {
        "kind": _KIND,
        "version": _Head.version,
        "columns": layout.widths,
        "start": {name: values.tolist() for name, values in (start or {}).items()},
        "meta": meta,
        **({"robot": base64.b64encode(robot_archive).decode()} if robot_archive else {}),
    }
    return json.dumps(head).encode() + b"\n"


def row_bytes(rows: Array) -> bytes:
    """Return rows (n, width) as bytes of the file."""
    return rows.astype("<f8").tobytes()


def recover(path: str | Path) -> EpisodeTrace:
    """Return the trace of a run that was cut off, from its partial file; `ended` is a fault.

    Raises:
        SurefootError: no such file, another kind of file, or one without a whole row.
    """
    path = Path(path)
    with describe_os_errors(f"partial trace {path}"):
        check_readable(path)
        line, _, body = path.read_bytes().partition(b"\n")
    with prefix_errors(f"partial trace {path}"):
        try:
            head = json.loads(line)
            kind, meta = head.pop("kind"), dict(head.pop("meta"))
            robot = base64.b64decode(head.pop("robot", ""), validate=True)
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
            raise SurefootError(f"is not one: {' '.join(str(error).split())}") from error
        if kind != _KIND:
            raise SurefootError("is not one: it is of another kind")
        rows_of = from_mapping(_Head, head) if "version" in head else from_mapping(_FormerHead, head)
        width = rows_of.layout.width
        steps = len(body) // (8 * width) if width else 0
        if not steps:
            raise SurefootError("holds no whole control step")
        rows = np.frombuffer(body, "<f8", steps * width).reshape(steps, width).astype(float)
        meta |= {"ended": "fault", "reason": "cut off"}
        return make_trace(rows_of.layout, rows, meta, rows_of.start, robot_archive=robot)
