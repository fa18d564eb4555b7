"""Recorded runs and emulated robots in MuJoCo's viewer, in which every link is a mocap body."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.report.drawing.ground_part import ground_around
from surefoot.report.drawing.mesh import link_meshes
from surefoot.report.drawing.scene import poses, trace_poses
from surefoot.robot import RobotDescription
from surefoot.robot.appearance import Appearance
from surefoot.rotations import matrix_quat
from surefoot.task.trace import EpisodeTrace
from surefoot.world.ground import FLAT, Ground
from surefoot.world.terrain import make_terrain

if TYPE_CHECKING:
    from surefoot.emulator.plant import Plant

_MIN_AREA = 1e-9
"""Minimum area of a mesh that is shown [m²]: MuJoCo rejects meshes without area, or with fewer than 4 points."""
_PERIOD = 33_000
"""Time between two poses of an emulated robot [µs]."""
_BASE = 7
"""Number of values of a base pose: position and quaternion."""


def has_display() -> bool:
    """Return whether a window can be opened."""
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def build_stage(appearance: Appearance, ground: Ground = FLAT) -> mujoco.MjModel:
    """Return a MuJoCo model with ground, light and a mocap body for every visible link."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_light(pos=[0, 0, 4], dir=[0, 0, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    visual: dict[str, Any] = {"contype": 0, "conaffinity": 0}
    ground_visual = {"rgba": [0.8, 0.82, 0.84, 1], **visual}
    if ground.is_flat:
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.5], **ground_visual)
    else:
        corners = ground_around(ground, np.zeros(2)).triangles().reshape(-1, 3)
        mesh = spec.add_mesh(name="ground", uservert=corners.ravel(), userface=np.arange(len(corners), dtype=np.int32))
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, **ground_visual)
    links = dict.fromkeys(part.link for part in appearance.parts)
    bodies = {name: spec.worldbody.add_body(name=name, mocap=True) for name in links}
    for number, (link, color, points, faces) in enumerate(link_meshes(appearance)):
        corners = points[faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
        if len(points) < 4 or area < _MIN_AREA:
            continue
        mesh = spec.add_mesh(name=f"mesh{number}", uservert=points.ravel(), userface=faces.ravel())
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # open surfaces have no volume
        rgba = [*(channel / 255 for channel in color), 1]
        bodies[link].add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, rgba=rgba, **visual)
    return spec.compile()


def set_stage(model: mujoco.MjModel, data: mujoco.MjData, poses: Mapping[str, Array], step: int) -> None:
    """Move every body to its pose at one step; `poses` are transforms (T, 4, 4) by body."""
    for name, pose in poses.items():
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        if body >= 0:
            row = model.body_mocapid[body]
            data.mocap_pos[row], data.mocap_quat[row] = pose[step, :3, 3], matrix_quat(pose[step, :3, :3])
    mujoco.mj_kinematics(model, data)


def replay(robot: RobotDescription, trace: EpisodeTrace, ground: Ground = FLAT) -> None:
    """Show a recorded run on a ground in real time, in a loop until the window is closed."""
    recorded_poses, times, start = trace_poses(robot, trace), trace.time, time.perf_counter()

    def now() -> tuple[Mapping[str, Array], int]:
        played = (time.perf_counter() - start) % float(times[-1])
        return recorded_poses, min(int(np.searchsorted(times, played)), len(times) - 1)

    _show(robot, ground, now)


def _show(robot: RobotDescription, ground: Ground, now: Callable[[], tuple[Mapping[str, Array], int]]) -> None:
    """Show a robot until the window is closed; `now` returns poses (T, 4, 4) by body, and the step to show."""
    import mujoco.viewer

    model = build_stage(robot.appearance(), ground)
    data = mujoco.MjData(model)
    with mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False) as viewer:
        viewer.cam.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        viewer.cam.trackbodyid = model.body(robot.base).id
        viewer.cam.distance, viewer.cam.azimuth, viewer.cam.elevation = 1.4, 120, -15
        while viewer.is_running():
            with contextlib.suppress(SurefootError):  # keep the last pose if a leg can't close its loop
                set_stage(model, data, *now())
            viewer.sync()
            time.sleep(1 / 60)


class EmulateViewer:
    """Window that shows an emulated robot, in a separate process so that it can't delay the emulator.

    Args:
        robot: name or folder of the robot.
        plant: simulated body of the robot.
        terrain: terrain, see `make_terrain`.
        seed: seed of the terrain.
    """

    def __init__(self, robot: str, plant: Plant, terrain: str = "flat", seed: int = 0) -> None:
        self._plant = plant
        context = multiprocessing.get_context("spawn")
        # Without a lock: at worst a half-written pose is drawn for 1/60 s.
        self._shared = context.RawArray("d", _BASE + plant.robot.num_motors)
        self._next = 0
        self._write()
        self._process = context.Process(target=_show_shared, args=(robot, self._shared, terrain, seed), daemon=True)
        self._process.start()

    def update(self, now: int) -> None:
        """Show the state at the end of a servo step at time `now` [µs], if an update is due."""
        if now >= self._next:
            self._next = now + _PERIOD
            self._write()

    def _write(self) -> None:
        base = self._plant.capture()
        self._shared[:] = [*base.position, *base.quat, *self._plant.vitals().motor_angle]

    def close(self) -> None:
        """Close the window."""
        self._process.terminate()
        self._process.join()


def pose_of(robot: RobotDescription, numbers: Any) -> dict[str, Array]:
    """Return transforms (1, 4, 4) by link, from a row with base position, quaternion and motor angles."""
    row = np.array(numbers)
    return poses(robot, row[:3], row[3:_BASE], row[_BASE:])


def _show_shared(name: str, shared: Any, terrain: str, seed: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # on Ctrl-C the emulator closes the window
    robot = RobotDescription.load(name)
    _show(robot, make_terrain(terrain, seed), lambda: (pose_of(robot, shared), 0))
