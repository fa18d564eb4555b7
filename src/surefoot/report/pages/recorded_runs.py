"""Self-contained page that replays traces: robots in 3D, a time line, and synchronized plots.

The page contains viser's client, the robots at rest in viser's format, and the traces resampled at a constant rate; its
script moves the robots' frames. It needs no server, so the same page can be served from a port or written to a file.
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import viser

from surefoot.arrays import Array
from surefoot.errors import SurefootError, prefix_errors
from surefoot.evaluation.foot_forces import foot_forces
from surefoot.evaluation.recorded import ground_for_trace
from surefoot.evaluation.tracking import measured_velocity
from surefoot.report.drawing.ground_part import ground_around
from surefoot.report.drawing.scene import extent, poses
from surefoot.report.pages.html import document
from surefoot.report.pages.view import (
    PUSH_COLOR,
    WEIGHT_ARROW,
    add_ground,
    add_path,
    add_robot,
    add_world,
    bare_viewer,
    quiet_server,
)
from surefoot.robot import RobotDescription
from surefoot.robot.urdf import GREY
from surefoot.rotations import in_heading_frame, matrix_quat, quat_yaw, rpy_quat
from surefoot.task.trace import EpisodeTrace
from surefoot.world.ground import Ground

MAX_TRACES = 16
RATE = 50.0
"""Rows per second on the page; fewer if all traces together have more than `_MAX_ROWS`."""
_MAX_ROWS = 20_000
_MAX_DURATION = 3600.0
_MAX_VALUE = 1e6
_MEAN_TIME = 0.25
"""Averaging time of plotted speeds and powers [s]."""
_COLORS = (
    (59, 110, 168),
    (208, 102, 43),
    (75, 154, 87),
    (138, 95, 176),
    (179, 134, 58),
    (58, 158, 165),
    (184, 71, 107),
)
_FORCE_COLOR = (230, 150, 30)
_MISSING = -32768
_PATH_HEIGHT = 0.004
"""Height of drawn paths above the ground [m]."""


@dataclass(frozen=True)
class ShownTrace:
    """Trace to show, with its name and robot."""

    name: str
    robot: RobotDescription
    trace: EpisodeTrace
    map_file: Path | None = None
    """File of the height map, see `ground_for_trace`."""

    def __post_init__(self) -> None:
        """Reject a trace of another robot, and one that is too long."""
        robot, meta = self.robot, self.trace.meta
        if (meta["robot"], *meta["motor_names"]) != (robot.name, *robot.motor_names):
            raise SurefootError(
                f"{self.name} was recorded on robot '{meta['robot']}', not on '{robot.name}' with its motors"
            )
        if self.duration > _MAX_DURATION:
            raise SurefootError(f"{self.name} is {self.duration:g} s long; the maximum is {_MAX_DURATION:g} s")

    @property
    def time(self) -> Array:
        """Times of the rows (T,) since the start [s]; the first row of an imported log is at 0."""
        return self.trace.time - (self.trace.time[0] if self.trace.is_imported else 0.0)

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return float(self.time[-1])


def recording_page(traces: Sequence[ShownTrace], layout: str = "side") -> str:
    """Return the page (HTML) that replays traces; `layout` is side (by side), over (each other) or one (at a time).

    Raises:
        SurefootError: there is no trace or too many, or values can't be shown.
    """
    if not 1 <= len(traces) <= MAX_TRACES:
        raise SurefootError(f"{len(traces)} traces are given; a page shows 1 to {MAX_TRACES}")
    rate = min(RATE, _MAX_ROWS / max(sum(one.duration for one in traces), 1.0))
    runs, paths, grounds = [], [], list[Ground]()
    for number, one in enumerate(traces):
        with prefix_errors(one.name):
            ground = ground_for_trace(one.trace, one.map_file)
            run, path = _run(one, rate, f"/world/r{number}", ground)
        if ground not in grounds:
            grounds.append(ground)
        run["ground"] = f"/world/ground{grounds.index(ground)}"
        run["color"] = "#{:02x}{:02x}{:02x}".format(*_COLORS[number % len(_COLORS)])
        runs.append(run)
        paths.append(path)
    size = max(run["size"] for run in runs)
    if layout == "side" and not all(ground.is_flat for ground in grounds):
        layout = "over"  # robots can't be moved sideways on uneven ground
    data = {"layout": layout, "rate": rate, "size": size, "runs": runs, "last": f"/world/r{len(runs) - 1}/last"}
    viewer = _viewer(traces, runs, paths, grounds, size, tinted=len(runs) > 1 and layout != "one")
    page = document("show.html").replace("<head>", f"<head>\n<!--\n{_license()}\n-->", 1)
    return page.replace("DATA = null, VIEWER = null", f"DATA = {_script(data)},\n  VIEWER = {_script(viewer)}", 1)


def _script(value: Any) -> str:
    """Return a value as JSON for a page's script, escaped so that no text in it can end the script."""
    return json.dumps(value, allow_nan=False).replace("<", "\\u003c")


def _license() -> str:
    """Return the license of viser's client, which the page contains."""
    texts = [file.read_text("utf-8") for file in metadata.files("viser") or () if file.name == "LICENSE"]
    return "\n".join(["This page holds a copy of viser's client.", *texts]).replace("--", "- -")


def _run(shown: ShownTrace, rate: float, node: str, ground: Ground) -> tuple[dict[str, Any], Array]:
    """Return a trace's data for the page's script, and the path of its base on the ground (T, 3) [m]."""
    trace, robot = shown.trace, shown.robot
    time = np.arange(int(shown.duration * rate + 1e-6) + 1) / rate
    angles, angle_notes = _angles(trace)
    # If a leg can't close its loop at the measured angles, its joints are interpolated from other rows.
    joints = {name: _interpolate(values[:, None])[:, 0] for name, values in robot.joint_angles(angles).items()}
    if not np.isfinite([*joints.values()]).all():
        raise SurefootError("a leg can't close its loop at any of the motor angles")
    feet = robot.foot_positions(angles)
    # On flat ground all runs start at the same place; on uneven ground they keep their position.
    start = _start(trace) if ground.is_flat else (np.zeros(2), 0.0)
    position, quat, base_notes = _base(trace, feet, start)
    forces = foot_forces(robot, angles, trace.motor_torque)
    forces[np.isfinite(forces[..., 2]) & ((trace.foot_contact < 0.5) | (forces[..., 2] < 0.0))] = 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        speed = measured_velocity(trace)
    speed[~np.isfinite(speed)] = np.nan  # if times repeat
    power = trace.energy / np.diff(trace.elapsed, prepend=0.0).clip(1e-4)
    count = max(round(_MEAN_TIME / float(trace.meta["control_step"])), 1)
    rows, size, frames = len(trace.time), extent(robot), _link_frames(robot, f"{node}/base")
    columns = {
        "pose": np.column_stack([position, quat]),
        "joint": np.column_stack([*joints.values()]),
        "foot": _interpolate(feet.reshape(rows, -1)),
        "force": forces.reshape(rows, -1),
        "push": in_heading_frame(trace.push_force_world, np.full(rows, start[1])),
        "speed": pd.DataFrame(speed).rolling(count, min_periods=1).mean().to_numpy(),
        "command": trace.command,
        "torque": trace.motor_torque,
        "angle": trace.motor_angle,
        "target": trace.target,
        "power": pd.DataFrame(power).rolling(count, min_periods=1).mean().to_numpy(),
        "contact": trace.foot_contact,
    }
    if not ground.is_flat:
        columns["level"] = ground.smooth_height(position[:, :2])[:, None]
    columns = {name: values for name, values in columns.items() if np.isfinite(values).any()}
    for name, values in columns.items():
        if (maximum := np.nanmax(np.abs(values))) > _MAX_VALUE:
            raise SurefootError(f"its {name} is up to {maximum:g}; the maximum is {_MAX_VALUE:g}")
    ended = {"time": "", "fall": ", fell", "fault": ", ended by a fault", "stopped": ", stopped"}[trace.meta["ended"]]
    place = str(trace.meta["world"])[:60] + ("" if ground.is_flat else f" on {trace.meta['terrain']}")
    title = f"{robot.name} in {place}, {shown.duration:.2f} s{ended}"
    run = {
        "name": shown.name,
        "node": node,
        "notes": [title, *base_notes, *angle_notes],
        "legs": [name.replace("_", " ") for name in robot.leg_names],
        "motors": list(robot.motor_names),
        "size": size,
        "newton": WEIGHT_ARROW * size / robot.weight,
        "rows": len(time),
        "columns": {name: _pack(time, shown.time, values) for name, values in columns.items()},
        "joints": [
            {"node": frames[joint.child], "fixed": matrix_quat(joint.frame[:3, :3]).tolist(), "axis": list(joint.axis)}
            for joint in map(robot.urdf.joints.__getitem__, joints)
        ],
    }
    return run, np.column_stack([position[:, :2], ground.height(position[:, :2]) + _PATH_HEIGHT])


def _start(trace: EpisodeTrace) -> tuple[Array, float]:
    """Return the first measured position (2,) [m] and yaw [rad] of the base; zeros if it was never measured."""
    measured = np.isfinite(trace.base_position_world).all(axis=1) & np.isfinite(trace.base_quat_world).all(axis=1)
    if not measured.any():
        return np.zeros(2), 0.0
    first = int(np.argmax(measured))
    return trace.base_position_world[first, :2], float(quat_yaw(trace.base_quat_world[first]))


def _base(trace: EpisodeTrace, feet: Array, start: tuple[Array, float]) -> tuple[Array, Array, list[str]]:
    """Return position (T, 3) [m] and quaternion (T, 4) of the base relative to a start (position, yaw), and notes.

    If the base was never measured, its height is the median depth of the lowest foot; `feet` (T, L, 3) [m] are in the
    base frame.
    """
    position, quat = trace.base_position_world[1:], trace.base_quat_world[1:]
    measured = np.asarray(np.isfinite(position).all(axis=1) & np.isfinite(quat).all(axis=1))
    if not measured.any():
        attitude = np.nan_to_num(_interpolate(trace.roll_pitch_yaw))
        attitude[:, 2] -= attitude[0, 2]
        place = np.tile([0.0, 0.0, -np.nanmedian(np.min(feet[..., 2], axis=1))], (len(measured), 1))
        orientation = "oriented as the IMU measured" if np.isfinite(trace.roll_pitch_yaw).any() else "level"
        note = f"the base was not measured: it is shown at standing height, {orientation}"
        return place, _continuous(np.array([rpy_quat(*row) for row in attitude])), [note]
    notes = [] if measured.all() else [f"the base was not measured in {100 * (1 - measured.mean()):.1f} % of the rows"]
    origin, yaw = start
    quat = _continuous(quat)
    position, quat = (_interpolate(np.where(measured[:, None], values, np.nan)) for values in (position, quat))
    position = in_heading_frame(position - [*origin, 0.0], np.full(len(position), yaw))
    cos, sin = np.cos(yaw / 2), np.sin(yaw / 2)
    w, x, y, z = quat.T
    return (
        position,
        np.column_stack([cos * w + sin * z, cos * x + sin * y, cos * y - sin * x, cos * z - sin * w]),
        notes,
    )


def _angles(trace: EpisodeTrace) -> tuple[Array, list[str]]:
    """Return motor angles (T, M) [rad] (true angles, or else readings, or else commands), and notes."""
    if np.isfinite(trace.true_motor_angle).all():
        return trace.true_motor_angle, []
    was_read = np.asarray(np.isfinite(trace.motor_angle).any(axis=0))
    angles = np.where(was_read, _interpolate(trace.motor_angle), trace.target)
    return angles, [] if was_read.all() else [
        f"{np.sum(~was_read)} of {len(was_read)} motors were not read: their commands are shown"
    ]


def _continuous(quat: Array) -> Array:
    """Return quaternions (T, 4) with continuous signs, so that they can be interpolated."""
    signs = np.where(np.nansum(quat[1:] * quat[:-1], axis=1) < 0.0, -1.0, 1.0)
    return quat * np.concatenate([[1.0], np.cumprod(signs)])[:, None]


def _interpolate(values: Array) -> Array:
    """Interpolate missing values of columns (T, k) over the rows; a column without any value stays NaN."""
    return np.array(pd.DataFrame(values).interpolate(limit_direction="both"))


def _pack(time: Array, times: Array, values: Array) -> dict[str, Any]:
    """Resample columns (T, k) at times (N,), and quantize each to 16 bits between its minimum and maximum."""
    values = np.column_stack([np.interp(time, times, column) for column in values.T])
    is_finite = np.isfinite(values)
    values[:, ~is_finite.any(axis=0)] = 0.0
    low, high = np.nanmin(values, axis=0), np.nanmax(values, axis=0)
    step = (high - low) / 65534
    steps = np.round((values - low) / np.where(step > 0.0, step, 1.0)) - 32767
    packed = np.where(is_finite, steps, _MISSING).astype("<i2")
    return {"low": low.tolist(), "step": step.tolist(), "data": base64.b64encode(packed.T.tobytes()).decode()}


def _link_frames(robot: RobotDescription, base: str) -> dict[str, str]:
    """Return the scene path of each link's frame; links are nested like the joints, below the base."""
    frames = {robot.urdf.root: f"{base}/root"}
    for joint in robot.urdf.tree:
        frames[joint.child] = f"{frames[joint.parent]}/l{len(frames)}"
    return frames


def _viewer(
    traces: Sequence[ShownTrace],
    runs: Sequence[dict[str, Any]],
    paths: Sequence[Array],
    grounds: Sequence[Ground],
    size: float,
    tinted: bool,
) -> str:
    """Return viser's page with grounds and robots in their resting poses; if `tinted`, each robot has its own color."""
    server = quiet_server()
    try:
        stage = server.scene
        add_world(stage)
        for number, ground in enumerate(grounds):
            node = f"/world/ground{number}"
            if not ground.is_flat:
                there = np.concatenate([p[:, :2] for p, run in zip(paths, runs, strict=True) if run["ground"] == node])
                ground = ground_around(ground, (there.min(axis=0) + there.max(axis=0)) / 2)
            add_ground(stage, node, size, ground)
        for number, (one, run, path) in enumerate(zip(traces, runs, paths, strict=True)):
            _add_robot(stage, one.robot, run, path, _COLORS[number % len(_COLORS)] if tinted else None)
        # The page later sets the distance to fit the robots that are shown.
        server.initial_camera.position = (0.85 * size, -1.15 * size, 0.5 * size)
        server.initial_camera.look_at = (0.0, 0.0, 0.15 * size)
        data = base64.b64encode(server.get_scene_serializer().serialize()).decode()
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
    return bare_viewer().replace("</head>", f'<script>window.__VISER_EMBED_DATA__="{data}"</script></head>', 1)


def _add_robot(
    stage: viser.SceneApi, robot: RobotDescription, run: dict[str, Any], path: Array, tint: tuple[int, int, int] | None
) -> None:
    """Add a robot at rest, its path on the ground and its arrows; its color is blended with `tint`, if given."""
    node, size = run["node"], run["size"]
    stage.add_frame(node, show_axes=False)
    stage.add_frame(f"{node}/base", show_axes=False)
    frames = _link_frames(robot, f"{node}/base")
    level = poses(robot, np.zeros(3), [1.0, 0.0, 0.0, 0.0], robot.resting_angles)
    offsets = {robot.urdf.root: level[robot.urdf.root][0]}
    offsets |= {joint.child: joint.frame for joint in robot.urdf.joints.values()}
    for link, frame in frames.items():
        offset = offsets[link]
        stage.add_frame(frame, show_axes=False, position=offset[:3, 3], wxyz=matrix_quat(offset[:3, :3]))
    add_robot(stage, robot.appearance(), frames, tint)
    arrows = [(f"base/force{leg}", _FORCE_COLOR) for leg in range(len(robot.legs)) if "force" in run["columns"]]
    for name, color in [*arrows, *([("push", PUSH_COLOR)] if "push" in run["columns"] else [])]:
        up = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
        stage.add_arrows(f"{node}/{name}", up, color, shaft_radius=0.028, head_radius=0.07, head_length=0.22)
    length = np.cumsum(np.linalg.norm(np.diff(path[:, :2], axis=0, prepend=path[:1, :2]), axis=1))
    corners = np.unique(np.floor(length / (0.05 * size)), return_index=True)[1]
    add_path(stage, f"{node}/path", path[corners], tint or GREY)
    stage.add_frame(f"{node}/last", show_axes=False)  # the page waits for this frame
