"""Motion capture files, resampled at the rows of a trace.

The file is CSV with the header time,x,y,z,qw,qx,qy,qz and, with foot switches, contact_LEG for each leg. Times are on
the robot's clock [s], positions in metres, orientations unit quaternions.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices, describe_os_errors
from surefoot.files import check_readable
from surefoot.rotations import quat_yaw

COLUMNS = ("time", "x", "y", "z", "qw", "qx", "qy", "qz")
MAX_MISSING_TIME = 0.05
"""Maximum time by which a file may begin late or end early, where the nearest row is used, and of gaps within it, which
are interpolated, unless it has few rows anyway [s]."""


def read_capture(path: Path) -> dict[str, Array]:
    """Return the columns of a motion capture file, by name; incomplete rows and rows out of order are skipped.

    Raises:
        SurefootError: no such file, missing columns, or fewer than two rows.
    """
    try:
        with describe_os_errors(f"motion capture {path}"):
            check_readable(path)
            lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise SurefootError(f"motion capture {path} can't be read: it is not text") from error
    names = [name.strip() for name in lines[0].split(",")] if lines else []
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        raise SurefootError(f"motion capture {path}: has no column {missing[0]}; it needs {choices(COLUMNS)}")
    time = names.index("time")
    rows: list[list[float]] = []
    for line in lines[1:]:
        # The last line of a file that is still being written may be incomplete.
        try:
            row = [float(word) for word in line.split(",")]
        except ValueError:
            continue
        if len(row) == len(names) and np.isfinite(row).all() and (not rows or row[time] > rows[-1][time]):
            rows.append(row)
    if len(rows) < 2:
        raise SurefootError(f"motion capture {path}: has {len(rows)} complete rows; it needs 2 or more")
    return dict(zip(names, np.array(rows).T, strict=True))


def base_and_feet(
    capture: dict[str, Array], start: float, control_step: float, steps: int, legs: tuple[str, ...]
) -> dict[str, Array]:
    """Return motion of base and feet at the rows of a trace, transformed to start at x = y = 0 with yaw 0.

    Args:
        capture: columns from `read_capture`.
        start: start of the run on the robot's clock [s].
        control_step: period of the rows [s].
        steps: number of rows T.
        legs: names of the L legs.

    Returns:
        base_position_world (T+1, 3) [m], base_quat_world (T+1, 4) and foot_contact (T, L), NaN for legs without a
        switch.

    Raises:
        SurefootError: the file does not cover the run, or has a gap in it.
    """
    times, at = capture["time"], start + control_step * np.arange(steps + 1)
    if times[0] > at[0] + MAX_MISSING_TIME or times[-1] < at[-1] - MAX_MISSING_TIME:
        raise SurefootError(
            f"motion capture covers {times[0]:.3f} to {times[-1]:.3f} s on the robot's clock; "
            f"the run lasted from {at[0]:.3f} to {at[-1]:.3f} s"
        )
    steps_between = np.diff(times)
    allowed = max(MAX_MISSING_TIME, 3 * float(np.median(steps_between)))
    gaps = np.flatnonzero((steps_between > allowed) & (times[:-1] < at[-1]) & (times[1:] > at[0]))
    if len(gaps):
        first, last = times[gaps[0]], times[gaps[0] + 1]
        raise SurefootError(
            f"motion capture has no rows from {first:.3f} to {last:.3f} s on the robot's clock, within the run; it may "
            f"miss at most {allowed:.3g} s"
        )
    position = np.stack([np.interp(at, times, capture[name]) for name in ("x", "y", "z")], axis=1)
    samples = np.stack([capture[name] for name in ("qw", "qx", "qy", "qz")], axis=1)
    # q and -q are the same orientation; choose signs so that consecutive quaternions are close.
    flips = np.sum(samples[1:] * samples[:-1], axis=1) < 0.0
    samples *= np.where(np.cumsum(np.concatenate([[0], flips])) % 2, -1.0, 1.0)[:, None]
    quat = np.stack([np.interp(at, times, samples[:, k]) for k in range(4)], axis=1)
    norms = np.linalg.norm(quat, axis=1, keepdims=True)
    if np.any(norms < 0.5):
        raise SurefootError("motion capture: its quaternions are not of length 1")
    position, quat = _from_origin(position, quat / norms)
    contact = [
        np.clip(np.interp(at[1:], times, capture[f"contact_{leg}"]), 0.0, 1.0)
        if f"contact_{leg}" in capture
        else np.full(steps, np.nan)
        for leg in legs
    ]
    return {"base_position_world": position, "base_quat_world": quat, "foot_contact": np.stack(contact, axis=1)}


def _from_origin(position: Array, quat: Array) -> tuple[Array, Array]:
    """Translate and rotate about z so that row 0 has x = y = 0 and yaw 0; heights are unchanged."""
    yaw = float(quat_yaw(quat[0]))
    cos, sin = np.cos(-yaw), np.sin(-yaw)
    x, y = (position[:, :2] - position[0, :2]).T
    w, z = np.cos(-yaw / 2), np.sin(-yaw / 2)
    qw, qx, qy, qz = quat.T
    # The rotation about z, (w, 0, 0, z), times the orientation.
    rotated = np.stack([w * qw - z * qz, w * qx - z * qy, w * qy + z * qx, w * qz + z * qw], axis=1)
    return np.stack([cos * x - sin * y, sin * x + cos * y, position[:, 2]], axis=1), rotated
