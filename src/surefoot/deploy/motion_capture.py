"""What somebody else saw of the robot: a motion capture system's file, read into the rows of a trace.

The file is CSV with the header time,x,y,z,qw,qx,qy,qz and, if there are foot switches, contact_LEG for each leg. Time
is on the robot's clock [s], places in metres, orientations unit quaternions.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices
from surefoot.files import check_readable
from surefoot.rotations import quat_yaw

COLUMNS = ("time", "x", "y", "z", "qw", "qx", "qy", "qz")
MARGIN = 0.05
"""Time [s] by which a file may begin late or end early; the nearest row counts there."""


def read_capture(path: Path) -> dict[str, Array]:
    """The columns of a motion capture file, by name; rows out of order or cut off are left out.

    Raises:
        SurefootError: no such file, or one without the columns or with less than two rows.
    """
    try:
        check_readable(path)
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "is not text"
        raise SurefootError(f"motion capture {path}: can't be read: {reason}") from error
    names = [name.strip() for name in lines[0].split(",")] if lines else []
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        raise SurefootError(f"motion capture {path}: has no column {missing[0]}; it needs {choices(COLUMNS)}")
    rows: list[list[float]] = []
    for line in lines[1:]:
        # The last line of a file that is still written may be cut anywhere.
        try:
            numbers = [float(word) for word in line.split(",")]
        except ValueError:
            continue
        fits = len(numbers) == len(names) and np.isfinite(numbers).all()
        if fits and (not rows or numbers[names.index("time")] > rows[-1][names.index("time")]):
            rows.append(numbers)
    if len(rows) < 2:
        raise SurefootError(f"motion capture {path}: has {len(rows)} whole rows; it needs 2 or more")
    table = np.array(rows)
    return {name: table[:, index] for index, name in enumerate(names)}


def base_and_feet(
    capture: dict[str, Array], start: float, control_step: float, steps: int, legs: tuple[str, ...]
) -> dict[str, Array]:
    """Base and feet at the rows of a trace, turned and shifted so that the run starts at x = y = 0 with yaw 0.

    Args:
        capture: see `read_capture`.
        start: the run's start on the robot's clock [s].
        control_step: time between rows [s].
        steps: T.
        legs: names of the legs, for their switches.

    Returns:
        base_position_world (T+1, 3), base_quat_world (T+1, 4) and foot_contact (T, L), NaN for legs without a switch.

    Raises:
        SurefootError: the file does not cover the run.
    """
    times, at = capture["time"], start + control_step * np.arange(steps + 1)
    if times[0] > at[0] + MARGIN or times[-1] < at[-1] - MARGIN:
        raise SurefootError(
            f"motion capture covers {times[0]:.3f} to {times[-1]:.3f} s on the robot's clock; "
            f"the run took place from {at[0]:.3f} to {at[-1]:.3f} s"
        )
    position = np.stack([np.interp(at, times, capture[name]) for name in ("x", "y", "z")], axis=1)
    quat = _same_side(np.stack([capture[name] for name in ("qw", "qx", "qy", "qz")], axis=1))
    turned = np.stack([np.interp(at, times, quat[:, k]) for k in range(4)], axis=1)
    norms = np.linalg.norm(turned, axis=1, keepdims=True)
    if np.any(norms < 0.5):
        raise SurefootError("motion capture: its quaternions are not of length 1")
    position, turned = _from_origin(position, turned / norms)
    contact = [
        np.clip(np.interp(at[1:], times, capture[f"contact_{leg}"]), 0.0, 1.0)
        if f"contact_{leg}" in capture
        else np.full(steps, np.nan)
        for leg in legs
    ]
    return {"base_position_world": position, "base_quat_world": turned, "foot_contact": np.stack(contact, axis=1)}


def _same_side(quat: Array) -> Array:
    """The same orientations, with signs such that neighbours are near each other: q and -q mean the same."""
    flips = np.sum(quat[1:] * quat[:-1], axis=1) < 0.0
    sign = np.where(np.cumsum(np.concatenate([[0], flips])) % 2, -1.0, 1.0)
    return quat * sign[:, None]


def _from_origin(position: Array, quat: Array) -> tuple[Array, Array]:
    """Shift and turn about z so that row 0 has x = y = 0 and yaw 0; heights stay."""
    yaw = float(quat_yaw(quat[0]))
    cos, sin = np.cos(-yaw), np.sin(-yaw)
    moved = position - [*position[0, :2], 0.0]
    x, y = cos * moved[:, 0] - sin * moved[:, 1], sin * moved[:, 0] + cos * moved[:, 1]
    w, z = np.cos(-yaw / 2), np.sin(-yaw / 2)
    qw, qx, qy, qz = quat.T
    # The turn about z, (w, 0, 0, z), times the orientation.
    turned = np.stack([w * qw - z * qz, w * qx - z * qy, w * qy + z * qx, w * qz + z * qw], axis=1)
    return np.stack([x, y, moved[:, 2]], axis=1), turned
