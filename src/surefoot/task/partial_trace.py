"""File of rows that a recorder writes during a run; if the run is cut off, a trace can be made from it.

A partial file is a line of JSON (layout and meta of the trace, and its robot if that does not ship) and then rows of
little-endian 64-bit floats. A row that was cut off is left out when it is read.
"""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from surefoot.arrays import Array
from surefoot.configuration import Within, from_mapping
from surefoot.errors import SurefootError, describe_os_errors, prefix_errors
from surefoot.files import check_readable
from surefoot.task.trace import EpisodeTrace

SUFFIX = ".partial"
"""Behind the whole name of the trace's file."""
_KIND = "surefoot-partial-trace"


Count = Annotated[int, Within(0, 100_000)]


@dataclass(frozen=True)
class RowLayout:
    """Columns of the quantities in a row of numbers."""

    motors: Count
    """M"""
    legs: Count
    """L"""
    observations: Count
    """O"""
    actions: Count
    """A"""
    commands: Count = 0
    """Commands to a policy that is steered, 3; else 0."""

    @property
    def widths(self) -> dict[str, int]:
        """Number of values of each quantity, in the row's order; `robot_time` is the robot's clock at the state [s]."""
        return {
            "time": 1,
            "robot_time": 1,
            "roll_pitch_yaw": 3,
            "angular_velocity_base": 3,
            "motor_angle": self.motors,
            "motor_velocity": self.motors,
            "motor_torque": self.motors,
            "observation": self.observations,
            "feedback": self.actions,
            "target": self.motors,
            "energy": 1,
            **({"command": self.commands} if self.commands else {}),
        }

    @property
    def width(self) -> int:
        """Numbers in a row."""
        return sum(self.widths.values())

    def columns(self, rows: Array) -> dict[str, Array]:
        """Return the rows (T, width) as arrays by name, (T,) or (T, n)."""
        parts = np.split(rows, np.cumsum(list(self.widths.values()))[:-1], axis=1)
        return {
            name: part[:, 0] if width == 1 else part
            for (name, width), part in zip(self.widths.items(), parts, strict=True)
        }


def make_trace(
    layout: RowLayout,
    rows: Array,
    meta: dict[str, Any],
    truth: dict[str, Array] | None = None,
    robot_archive: bytes = b"",
) -> EpisodeTrace:
    """Return the trace of rows (T, width), one a control step, with its meta; refuse rows that are none.

    Quantities that the robot does not measure are NaN, unless `truth` has them: base and feet, measured externally.
    """
    steps = len(rows)
    if not steps:
        raise SurefootError("no control step was done; there is nothing to save")
    columns = layout.columns(rows)
    columns.pop("robot_time")
    unknown = {
        "base_position_world": np.full((steps + 1, 3), np.nan),
        "base_quat_world": np.full((steps + 1, 4), np.nan),
        "foot_contact": np.full((steps, layout.legs), np.nan),
    }
    return EpisodeTrace(**columns, **(unknown | (truth or {})), meta=meta, robot_archive=robot_archive)


def head_line(layout: RowLayout, meta: dict[str, Any], robot_archive: bytes = b"") -> bytes:
    """Return the first line of a partial file."""
    robot = {"robot": base64.b64encode(robot_archive).decode()} if robot_archive else {}
    return json.dumps({"kind": _KIND, **vars(layout), "meta": meta, **robot}).encode() + b"\n"


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
        layout = from_mapping(RowLayout, head)
        steps = len(body) // (8 * layout.width)
        if not steps:
            raise SurefootError("holds no whole control step")
        rows = np.frombuffer(body, "<f8", steps * layout.width).reshape(steps, layout.width).astype(float)
        return make_trace(layout, rows, {**meta, "ended": "fault", "reason": "cut off"}, robot_archive=robot)
