"""A page that replays traces: robots in 3D, a time line, and plots that follow it, without a server behind it.

The page holds all that it shows: viser's client, the robots at rest in its format, and the traces' numbers at an even
rate. Its script moves the robots' frames. So the same page is served from a port and written to a file.
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from typing import Any

import numpy as np
import viser

from surefoot.arrays import Array
from surefoot.errors import SurefootError, prefix_errors
from surefoot.evaluate.foot_forces import foot_forces
from surefoot.evaluate.tracking import motion
from surefoot.report.drawing.scene import extent, poses, scene
from surefoot.report.pages.html import document
from surefoot.report.pages.view import add_ground, add_shape, bare_viewer, quiet_server
from surefoot.robot import RobotDescription
from surefoot.robot.urdf import GREY
from surefoot.rotations import in_heading_frame, matrix_quat, quat_yaw, rpy_quat
from surefoot.task.trace import EpisodeTrace

LAYOUTS = {"side": "side by side", "over": "laid over each other", "one": "one at a time"}
MOST_RUNS = 16
RATE = 50.0
"""Rows a second of the page; fewer where traces are so long that it would be too large."""
_MOST_ROWS = 20_000
_LONGEST = 3600.0
_GREATEST = 1e6
_SMOOTH = 0.25
"""Time over which plotted speeds and powers are means [s]."""
_WEIGHT_ARROW = 0.8
"""Length of an arrow as large as the robot's weight, over the robot's extent."""
_COLORS = (
    (59, 110, 168),
    (208, 102, 43),
    (75, 154, 87),
    (138, 95, 176),
    (179, 134, 58),
    (58, 158, 165),
    (184, 71, 107),
)
_FORCE, _PUSH = (230, 150, 30), (179, 38, 30)
_MISSING = -32768


@dataclass(frozen=True)
class Recording:
    """A trace that is shown."""

    name: str
    robot: RobotDescription
    trace: EpisodeTrace

    def __post_init__(self) -> None:
        """Refuse a trace of another robot, or one that is too long to be shown."""
        robot, meta = self.robot, self.trace.meta
        if (meta["robot"], *meta["motor_names"]) != (robot.name, *robot.motor_names):
            raise SurefootError(
                f"{self.name} is of robot '{meta['robot']}', not of '{robot.name}' with its motors' names"
            )
        if self.seconds > _LONGEST:
            raise SurefootError(f"{self.name} is {self.seconds:g} s long; at most {_LONGEST:g} s are shown")

    @property
    def clock(self) -> Array:
        """Times of the rows (T,) [s] since the start, which logs do not tell: their first row is at 0."""
        return self.trace.time - (self.trace.time[0] if self.trace.imported else 0.0)

    @property
    def seconds(self) -> float:
        """Length [s]."""
        return float(self.clock[-1])


def recording_page(recordings: Sequence[Recording], layout: str = "side") -> str:
    """Return the page (HTML) that shows some recordings, in one of `LAYOUTS` to begin with.

    Raises:
        SurefootError: none or too many, or values that can't be shown.
    """
    if not 1 <= len(recordings) <= MOST_RUNS:
        raise SurefootError(f"{len(recordings)} traces are given; a page shows 1 to {MOST_RUNS}")
    rate = min(RATE, _MOST_ROWS / max(sum(one.seconds for one in recordings), 1.0))
    runs = []
    for number, one in enumerate(recordings):
        with prefix_errors(one.name):
            runs.append(_run(one, rate, f"/world/r{number}"))
    size = max(run["size"] for run, _ in runs)
    for number, (run, _) in enumerate(runs):
        run["color"] = "#{:02x}{:02x}{:02x}".format(*_COLORS[number % len(_COLORS)])
    tinted = len(runs) > 1 and layout != "one"
    data = {"layout": layout, "rate": rate, "size": size, "runs": [run for run, _ in runs]}
    data["last"] = f"/world/r{len(runs) - 1}/last"
    page = document("show.html").replace("<head>", f"<head>\n<!--\n{_notice()}\n-->", 1)
    return page.replace(
        "DATA = null, VIEWER = null",
        f"DATA = {_script(data)},\n  VIEWER = {_script(_viewer(recordings, runs, size, tinted))}",
        1,
    )


def _script(value: Any) -> str:
    """Return a value as a script of a page takes it: what traces hold can't end the script."""
    return json.dumps(value, allow_nan=False).replace("<", "\\u003c")


def _notice() -> str:
    """Return the license of viser's client, a copy of which is in the page."""
    texts = [file.read_text("utf-8") for file in metadata.files("viser") or () if file.name == "LICENSE"]
    return "\n".join(["This page holds a copy of viser's client.", *texts]).replace("--", "- -")


def _run(one: Recording, rate: float, node: str) -> tuple[dict[str, Any], Array]:
    """Return what the page's script takes of a trace, and where its base went, (T, 3) [m]."""
    trace, robot = one.trace, one.robot
    clock = np.arange(int(one.seconds * rate + 1e-6) + 1) / rate
    angles, said = _angles(trace, robot)
    # A leg whose loop can't close at the angles that were read moves as before and after.
    joints = {name: _filled(values[:, None])[:, 0] for name, values in robot.joint_angles(angles).items()}
    if not np.isfinite([*joints.values()]).all():
        raise SurefootError("a leg can't close its loop at any of the motor angles")
    feet = robot.leg_mounts + robot.leg_geometry.foot_position(angles[:, robot.leg_motor_index])
    position, quat, notes = _base(trace, feet)
    forces = foot_forces(robot, angles, trace.motor_torque)
    forces[np.isfinite(forces[..., 2]) & ((trace.foot_contact < 0.5) | (forces[..., 2] < 0.0))] = 0.0
    speed, power = _speed(trace), trace.energy / np.diff(trace.time, prepend=0.0).clip(1e-4)
    count = max(round(_SMOOTH / float(trace.meta["control_step"])), 1)
    paths, size = _paths(robot, f"{node}/base"), extent(robot)
    rows = len(trace.time)
    columns = {
        "pose": np.column_stack([position, quat]),
        "joint": np.column_stack([*joints.values()]),
        "foot": _filled(feet.reshape(rows, -1)),
        "force": forces.reshape(rows, -1),
        "push": in_heading_frame(trace.push_force_world, np.full(rows, _start(trace)[1])),
        "speed": _mean(speed, count),
        "command": trace.command,
        "torque": trace.motor_torque,
        "angle": trace.motor_angle,
        "target": trace.target,
        "power": _mean(power[:, None], count),
        "contact": trace.foot_contact,
    }
    known = {name: values for name, values in columns.items() if np.isfinite(values).any()}
    for name, values in known.items():
        if np.nanmax(np.abs(values)) > _GREATEST:
            raise SurefootError(
                f"its {name} is up to {np.nanmax(np.abs(values)):g}; nothing over {_GREATEST:g} is shown"
            )
    ended = {"time": "", "fall": ", fell", "fault": ", ended by a fault", "stopped": ", stopped"}[trace.meta["ended"]]
    what = f"{robot.name} in {str(trace.meta['world'])[:60]}, {one.seconds:.2f} s{ended}"
    run = {
        "name": one.name,
        "node": node,
        "notes": [what, *notes, *said],
        "legs": [name.replace("_", " ") for name in robot.leg_names],
        "motors": list(robot.motor_names),
        "size": size,
        "newton": _WEIGHT_ARROW * size / robot.weight,
        "rows": len(clock),
        "columns": {name: _packed(_at(clock, one.clock, values)) for name, values in known.items()},
        "joints": [
            {"node": paths[joint.child], "fixed": matrix_quat(joint.frame[:3, :3]).tolist(), "axis": list(joint.axis)}
            for joint in map(robot.urdf.joints.__getitem__, joints)
        ],
    }
    return run, position


def _start(trace: EpisodeTrace) -> tuple[Array, float]:
    """Return where the base was first seen, (2,) [m], and its yaw then [rad]; zeros where it was never seen."""
    seen = np.isfinite(trace.base_position_world).all(axis=1) & np.isfinite(trace.base_quat_world).all(axis=1)
    if not seen.any():
        return np.zeros(2), 0.0
    first = int(np.argmax(seen))
    return trace.base_position_world[first, :2], float(quat_yaw(trace.base_quat_world[first]))


def _base(trace: EpisodeTrace, feet: Array) -> tuple[Array, Array, list[str]]:
    """Return the base (T, 3) [m] and (T, 4), from the origin on and heading along x first, and what is to be said.

    Where it was never measured, it is as high as its feet (T, L, 3) [m], seen from the base, mostly reach down.
    """
    position, quat = trace.base_position_world[1:], trace.base_quat_world[1:]
    seen = np.asarray(np.isfinite(position).all(axis=1) & np.isfinite(quat).all(axis=1))
    if not seen.any():
        attitude = np.nan_to_num(_filled(trace.roll_pitch_yaw))
        attitude[:, 2] -= attitude[0, 2]
        place = np.tile([0.0, 0.0, -np.nanmedian(np.min(feet[..., 2], axis=1))], (len(seen), 1))
        turned = "turned as its IMU says" if np.isfinite(trace.roll_pitch_yaw).any() else "level"
        told = f"the base was not measured: it is held at standing height, {turned}"
        return place, _continuous(np.array([rpy_quat(*row) for row in attitude])), [told]
    said = [] if seen.all() else [f"the base was not measured in {100 * (1 - seen.mean()):.1f} % of the rows"]
    at, yaw = _start(trace)
    position, quat = (_filled(np.where(seen[:, None], values, np.nan)) for values in (position, _continuous(quat)))
    moved = in_heading_frame(position - [*at, 0.0], np.full(len(position), yaw))
    cos, sin = np.cos(yaw / 2), np.sin(yaw / 2)
    w, x, y, z = quat.T
    rolled = np.column_stack([cos * w + sin * z, cos * x + sin * y, cos * y - sin * x, cos * z - sin * w])
    return moved, rolled, said


def _angles(trace: EpisodeTrace, robot: RobotDescription) -> tuple[Array, list[str]]:
    """Return the motors' angles (T, M) [rad]: true ones, else those that were read, else commands; and what to say."""
    if np.isfinite(trace.true_motor_angle).all():
        return trace.true_motor_angle, []
    read = np.asarray(np.isfinite(trace.motor_angle).any(axis=0))
    angles = np.where(read, _filled(trace.motor_angle), trace.target)
    if read.all():
        return angles, []
    return angles, [f"{np.sum(~read)} of {len(read)} motors were not read: their commands are shown"]


def _speed(trace: EpisodeTrace) -> Array:
    """Return speeds forward and to the left [m/s] and yaw rate [rad/s] (T, 3); NaN where times repeat."""
    with np.errstate(divide="ignore", invalid="ignore"):
        speed = motion(trace)
    speed[~np.isfinite(speed)] = np.nan
    return speed


def _continuous(quat: Array) -> Array:
    """Return quaternions (T, 4) whose signs do not jump, so that they can be interpolated."""
    turns = np.where(np.nansum(quat[1:] * quat[:-1], axis=1) < 0.0, -1.0, 1.0)
    return quat * np.concatenate([[1.0], np.cumprod(turns)])[:, None]


def _filled(values: Array) -> Array:
    """Return columns (T, k) with what is missing interpolated; a column without any value stays NaN."""
    filled, rows = values.copy(), np.arange(len(values))
    for column in filled.T:
        known = np.isfinite(column)
        if known.any():
            column[~known] = np.interp(rows[~known], rows[known], column[known])
    return filled


def _mean(values: Array, count: int) -> Array:
    """Return the means (T, k) of what is known in `count` rows up to each; fewer at the start."""
    ends = np.arange(1, len(values) + 1)
    begins = np.maximum(ends - count, 0)

    def sums(parts: Array) -> Array:
        total = np.cumsum(np.concatenate([np.zeros((1, parts.shape[1])), parts]), axis=0)
        return np.asarray(total[ends] - total[begins])

    with np.errstate(invalid="ignore"):
        return sums(np.nan_to_num(values)) / sums(1.0 * np.isfinite(values))


def _at(clock: Array, time: Array, values: Array) -> Array:
    """Return columns (T, k) at other times."""
    return np.column_stack([np.interp(clock, time, column) for column in values.T])


def _packed(values: Array) -> dict[str, Any]:
    """Return columns (N, k) as 16-bit steps from each column's least value to its greatest; what is missing too."""
    known = np.isfinite(values)
    low = np.min(values, axis=0, initial=np.inf, where=known)
    high = np.max(values, axis=0, initial=-np.inf, where=known)
    low, high = np.where(known.any(axis=0), low, 0.0), np.where(known.any(axis=0), high, 0.0)
    step = (high - low) / 65534
    steps = np.round((values - low) / np.where(step > 0.0, step, 1.0)) - 32767
    whole = np.where(known, steps, _MISSING).astype("<i2")
    return {"low": low.tolist(), "step": step.tolist(), "data": base64.b64encode(whole.T.tobytes()).decode()}


def _paths(robot: RobotDescription, base: str) -> dict[str, str]:
    """Return the name of each link's frame in the scene: joints are nested from the root on, which the base holds."""
    paths = {robot.urdf.root: f"{base}/root"}
    for joint in robot.urdf.tree:
        paths[joint.child] = f"{paths[joint.parent]}/l{len(paths)}"
    return paths


def _viewer(
    recordings: Sequence[Recording], runs: Sequence[tuple[dict[str, Any], Array]], size: float, tinted: bool
) -> str:
    """Return viser's page with the robots at rest, each `tinted` by a color of its own."""
    server = quiet_server()
    try:
        stage = server.scene
        stage.set_up_direction("+z")
        stage.add_frame("/world", show_axes=False)
        add_ground(stage, "/world/ground", size)
        for number, (one, (run, track)) in enumerate(zip(recordings, runs, strict=True)):
            _add_robot(stage, one.robot, run, track, _COLORS[number % len(_COLORS)] if tinted else None)
        # The page sets the distance, so that it fits the robots that are shown.
        server.initial_camera.position = (1.1 * size, -1.5 * size, 0.7 * size)
        server.initial_camera.look_at = (0.0, 0.0, 0.15 * size)
        data = base64.b64encode(server.get_scene_serializer().serialize()).decode()
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
    return bare_viewer().replace("</head>", f'<script>window.__VISER_EMBED_DATA__="{data}"</script></head>', 1)


def _add_robot(
    stage: viser.SceneApi, robot: RobotDescription, run: dict[str, Any], track: Array, tint: tuple[int, int, int] | None
) -> None:
    """Add a robot at rest, with its path over the ground and its arrows; half of its color is a tint, if given."""
    node, size = run["node"], run["size"]
    stage.add_frame(node, show_axes=False)
    stage.add_frame(f"{node}/base", show_axes=False)
    paths = _paths(robot, f"{node}/base")
    level = poses(robot, np.zeros(3), [1.0, 0.0, 0.0, 0.0], robot.resting_angles)
    frames = {robot.urdf.root: level[robot.urdf.root][0]}
    frames |= {joint.child: joint.frame for joint in robot.urdf.joints.values()}
    for link, path in paths.items():
        frame = frames[link]
        stage.add_frame(path, show_axes=False, position=frame[:3, 3], wxyz=matrix_quat(frame[:3, :3]))
    for number, shape in enumerate(scene(robot)):
        if tint is not None:
            red, green, blue = ((own + other) // 2 for own, other in zip(shape.color, tint, strict=True))
            shape = replace(shape, color=(red, green, blue))
        add_shape(stage, f"{paths[shape.link]}/s{number}", shape)
    arrows = [(f"base/force{leg}", _FORCE) for leg in range(len(robot.legs))] if "force" in run["columns"] else []
    for name, color in [*arrows, *([("push", _PUSH)] if "push" in run["columns"] else [])]:
        up = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
        stage.add_arrows(f"{node}/{name}", up, color, shaft_radius=0.028, head_radius=0.07, head_length=0.22)
    far = np.floor(
        np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(track[:, :2], axis=0), axis=1))]) / (0.05 * size)
    )
    line = track[np.unique(far, return_index=True)[1]] * [1.0, 1.0, 0.0] + [0.0, 0.0, 0.004]
    if len(line) > 1:
        stage.add_line_segments(f"{node}/path", np.stack([line[:-1], line[1:]], axis=1), tint or GREY, thickness=0.008)
    stage.add_frame(f"{node}/last", show_axes=False)
