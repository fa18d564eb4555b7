"""A recorded run in MuJoCo's viewer: every link is a mocap body at its recorded pose."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from surefoot.report.drawing import Shape
from surefoot.rotations import matrix_quat

Array = NDArray[np.float64]
_KINDS = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
}


def build_stage(shapes: Sequence[Shape]) -> mujoco.MjModel:
    """Return a model with the ground, a light and a mocap body, by its name, for every body that has shapes."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_light(pos=[0, 0, 4], dir=[0, 0, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 0.5],
        rgba=[0.8, 0.82, 0.84, 1],
        contype=0,
        conaffinity=0,
    )
    bodies = {name: spec.worldbody.add_body(name=name, mocap=True) for name in dict.fromkeys(s.body for s in shapes)}
    for shape in shapes:
        bodies[shape.body].add_geom(
            type=_KINDS[shape.kind],
            size=[*shape.size, 0, 0][:3],
            pos=np.asarray(shape.position),
            quat=matrix_quat(np.asarray(shape.rotation, float)),
            rgba=[*(channel / 255 for channel in shape.color), 1],
            contype=0,
            conaffinity=0,
        )
    return spec.compile()


def set_stage(model: mujoco.MjModel, data: mujoco.MjData, poses: Mapping[str, Array], step: int) -> None:
    """Move every body to its pose at one step of `poses` (T, 4, 4)."""
    for name, pose in poses.items():
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        if body >= 0:
            row = model.body_mocapid[body]
            data.mocap_pos[row], data.mocap_quat[row] = pose[step, :3, 3], matrix_quat(pose[step, :3, :3])
    mujoco.mj_kinematics(model, data)


def replay(shapes: Sequence[Shape], poses: Mapping[str, Array], times: Array, follow: str) -> None:
    """Show a run in real time, repeatedly, until the window is closed.

    Args:
        shapes: what to draw.
        poses: by body, (T, 4, 4).
        times: (T,) s.
        follow: body that the camera follows.
    """
    import mujoco.viewer

    model = build_stage(shapes)
    data = mujoco.MjData(model)
    with mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False) as viewer:
        viewer.cam.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        viewer.cam.trackbodyid = model.body(follow).id
        viewer.cam.distance, viewer.cam.azimuth, viewer.cam.elevation = 1.4, 120, -15
        start = time.perf_counter()
        while viewer.is_running():
            now = (time.perf_counter() - start) % float(times[-1])
            set_stage(model, data, poses, min(int(np.searchsorted(times, now)), len(times) - 1))
            viewer.sync()
            time.sleep(1 / 60)
