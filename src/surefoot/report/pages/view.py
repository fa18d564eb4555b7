"""3D view of robots in a browser with viser: links, ground and trail.

The scene is in one frame that follows the robot over the ground, so that a browser's camera stays with the robot.
"""

from __future__ import annotations

import contextlib
import io
import logging
import time
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.report.drawing.ground_part import ground_around
from surefoot.report.drawing.mesh import link_meshes
from surefoot.report.drawing.scene import extent, poses
from surefoot.report.pages.ground_model import ground_model
from surefoot.robot import RobotDescription
from surefoot.robot.appearance import Appearance
from surefoot.robot.urdf import GREY, Color
from surefoot.rotations import in_heading_frame, matrix_quat, quat_yaw
from surefoot.world.ground import Ground

_TRAIL_POINTS = 300
_FOLLOW = 0.4
"""Fraction of the distance to the robot by which the scene's frame moves in each update."""
_GHOST_COLOR, _GHOST_OPACITY = (208, 102, 43), 0.4
WEIGHT_ARROW = 0.8
"""Length of the arrow of a force equal to the robot's weight, relative to the robot's extent."""
PUSH_COLOR = (179, 38, 30)
_PUSH_SCALE = 1.5
"""Ratio of the length of a push's arrow to another force's: pushes are small compared with the weight."""
_ARROW_TIME = 0.3
"""Minimum time for which the arrow of a push is shown [s]: many pushes last only three frames."""
_STYLE = """<style>
.mantine-Paper-root, .mantine-Notifications-root { display: none !important; }
canvas[data-engine] { background: linear-gradient(#96b8d8, #e8eef3 45%); }
</style>"""
"""Style that hides viser's panel and notifications, which would cover a small view, and adds the sky of videos."""


def bare_viewer() -> str:
    """Return viser's page without its controls."""
    return (Path(viser.__file__).parent / "client" / "build" / "index.html").read_text("utf-8") + _STYLE


class _GarbageFilter(logging.Filter):
    """Log filter that replaces tracebacks about invalid input to viser's servers by one line per process."""

    def __init__(self) -> None:
        super().__init__()
        self.ports: set[int] = set()
        """Ports of viser's servers."""
        self._was_reported = False

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a log record of a web socket server is printed."""
        connection = getattr(record, "websocket", None)
        if not record.exc_info or connection is None or connection.local_address[1] not in self.ports:
            return True
        first, self._was_reported = not self._was_reported, True
        record.msg, record.args, record.exc_info = "surefoot: %s", (_INVALID_INPUT,), None
        return first


_INVALID_INPUT = "the port of the 3D view received invalid input, not from a browser; it is ignored, also in future"
_garbage_filter = _GarbageFilter()


def quiet_server() -> viser.ViserServer:
    """Start viser's server on a free local port, without its banner and tracebacks."""
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    _garbage_filter.ports.add(server.get_port())
    logging.getLogger("websockets.server").addFilter(_garbage_filter)
    return server


def add_world(scene: viser.SceneApi) -> viser.FrameHandle:
    """Add the world frame and lights; return the frame."""
    scene.set_up_direction("+z")
    world = scene.add_frame("/world", show_axes=False)
    # Light from all sides shows the shape of dark robots on a bright ground.
    scene.add_light_hemisphere("/light", sky_color=(255, 255, 255), ground_color=(190, 195, 200), intensity=1.6)
    return world


def add_ground(scene: viser.SceneApi, name: str, size: float, ground: Ground) -> None:
    """Add a ground for robots of a given size [m]: flat, or a part from `ground_around`."""
    if not ground.is_flat:
        add_ground_model(scene, name, ground_model(ground))
        return
    scene.add_grid(
        name,
        infinite_grid=True,
        cell_size=0.25,
        section_size=1.0,
        fade_distance=15.0 * size,
        cell_color=(190, 197, 202),
        section_color=(150, 158, 166),
        plane_color=(208, 213, 216),
        plane_opacity=1.0,
        shadow_opacity=0.4,
    )


def add_ground_model(scene: viser.SceneApi, name: str, model: bytes) -> None:
    """Add a model from `ground_model`; it replaces a node of the same name."""
    scene.add_glb(name, model, cast_shadow=False, receive_shadow=0.4)


def add_path(scene: viser.SceneApi, name: str, points: Array, color: tuple[int, int, int]) -> None:
    """Add a path through points (N, 3) [m]; with fewer than two points nothing is added."""
    if len(points) > 1:
        scene.add_line_segments(name, np.stack([points[:-1], points[1:]], axis=1), color, thickness=0.008)


def add_robot(
    scene: viser.SceneApi,
    appearance: Appearance,
    frames: Mapping[str, str],
    tint: Color | None = None,
    opacity: float | None = None,
) -> None:
    """Add a robot's meshes in the frames of their links (scene paths by link); `tint` is blended with their colors."""
    for number, (link, color, points, faces) in enumerate(link_meshes(appearance)):
        if tint is not None:
            red, green, blue = ((own + other) // 2 for own, other in zip(color, tint, strict=True))
            color = (red, green, blue)
        scene.add_mesh_simple(f"{frames[link]}/m{number}", points, faces, color=color, side="double", opacity=opacity)


class GroundParts:
    """Parts of uneven ground that are drawn: the one around the robot, and the one around which it was before.

    A browser needs some time to load a part, so the previous one stays until another is needed; and computing the model
    of a part takes most of a second, so it is done in a thread.
    """

    def __init__(self, scene: viser.SceneApi, ground: Ground) -> None:
        self._scene, self._ground = scene, ground
        self._parts = [ground_around(ground, np.zeros(2))] * 2
        self._current = 0
        """Index of the part around the robot, which is drawn or being computed."""
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="ground")
        self._model: Future[bytes] | None = None
        """Model of the current part while it is computed."""
        self._add(ground_model(self._parts[0]))

    def _add(self, model: bytes) -> None:
        add_ground_model(self._scene, f"/world/ground{self._current}", model)

    def follow(self, place: Array) -> None:
        """Draw the part around a position (2,) [m]; it appears in a later call if its model has to be computed."""
        if self._model is not None:
            if self._model.done():
                self._add(self._model.result())
                self._model = None
            return
        part, other = ground_around(self._ground, place), 1 - self._current
        if part is self._parts[self._current]:
            return
        self._current = other
        if part is not self._parts[other]:
            self._parts[other] = part
            self._model = self._thread.submit(ground_model, part)

    def stop(self) -> None:
        """End the thread."""
        self._thread.shutdown(wait=False, cancel_futures=True)


@dataclass(frozen=True)
class _DrawnRobot:
    robot: RobotDescription
    links: dict[str, viser.FrameHandle]


class RobotView:
    """3D view on a local port, which pages forward."""

    def __init__(self) -> None:
        self._server = quiet_server()
        self.port = self._server.get_port()
        self.frames = 0
        """Number of updates sent."""
        self._parts: GroundParts | None = None

    def show(self, ground: Ground, robot: RobotDescription, ghost: RobotDescription | None = None) -> None:
        """Show a new robot on a ground, with a new trail, and optionally a transparent second robot (ghost)."""
        size, server = extent(robot), self._server
        self._trail: deque[Array] = deque(maxlen=_TRAIL_POINTS)
        self._at, self._size, self._base, self._yaw = np.zeros(3), size, np.zeros(3), 0.0
        self._ground = ground
        self._end_parts()
        self._arrow: viser.ArrowsHandle | None = None
        self._arrow_until, self._push = 0.0, np.zeros(3)
        with server.atomic():
            server.scene.reset()
            self._world = add_world(server.scene)
            if ground.is_flat:
                add_ground(server.scene, "/world/ground", size, ground)
            else:
                self._parts = GroundParts(server.scene, ground)
            self._robots = [self._add_robot("/world", robot)]
            if ghost is not None:
                self._robots.append(self._add_robot("/world/ghost", ghost, tint=_GHOST_COLOR, opacity=_GHOST_OPACITY))
            server.initial_camera.position = (0.85 * size, -1.15 * size, 0.5 * size)
            server.initial_camera.look_at = (0.0, 0.0, 0.2 * size)

    def _add_robot(self, node: str, robot: RobotDescription, **style: Any) -> _DrawnRobot:
        appearance = robot.appearance()
        frames = {part.link: f"{node}/{part.link}" for part in appearance.parts}
        links = {link: self._server.scene.add_frame(name, show_axes=False) for link, name in frames.items()}
        add_robot(self._server.scene, appearance, frames, **style)
        return _DrawnRobot(robot, links)

    def move(self, *states: tuple[ArrayLike, ArrayLike, ArrayLike]) -> None:
        """Move the robot, and the ghost if there is one.

        Each state consists of base position (3,) [m], orientation (4,) w x y z and motor angles (M,) [rad].
        """
        with contextlib.suppress(SurefootError), self._server.atomic():  # a diverged state is not drawn
            placed = [poses(one.robot, *state) for one, state in zip(self._robots, states, strict=True)]
            at, ground = np.asarray(states[0][0], float), self._ground
            under = np.array([*at[:2], ground.smooth_height(at[:2])])
            far = np.linalg.norm((under - self._at)[:2]) > 2 * self._size
            self._at = under if far else self._at + _FOLLOW * (under - self._at)
            self._world.position = -self._at
            if self._parts is not None:
                self._parts.follow(at[:2])
            for one, frames in zip(self._robots, placed, strict=True):
                for name, link in one.links.items():
                    pose = frames[name][0]
                    link.position, link.wxyz = pose[:3, 3], matrix_quat(pose[:3, :3])
            self._yaw = float(quat_yaw(np.asarray(states[0][1], float)))
            self._base = at
            if self._arrow is not None:
                self._arrow.position = at
            if far:
                self._trail.clear()
            if not self._trail or np.linalg.norm(at[:2] - self._trail[-1][:2]) > 0.05 * self._size:
                self._trail.append(np.array([*at[:2], ground.height(at[:2]) + 0.004]))
                add_path(self._server.scene, "/world/trail", np.array(self._trail), GREY)
        self.frames += 1

    def show_push(self, force_world: Array) -> None:
        """Show a force (3,) [N] on the base as an arrow that ends at the body; zero removes it after a minimum time."""
        size, now = float(np.linalg.norm(force_world)), time.monotonic()
        if size == 0.0:
            if self._arrow is not None and now > self._arrow_until:
                self._arrow.remove()
                self._arrow = None
            return
        if self._arrow is None or not np.array_equal(force_world, self._push):
            robot, self._push = self._robots[0].robot, force_world.copy()
            along, length = force_world / size, _PUSH_SCALE * WEIGHT_ARROW * self._size * size / robot.weight
            # The arrow ends at a box around the body, which extends to the legs' mounts.
            half = np.array([robot.body_length / 2, np.abs(robot.leg_mounts[:, 1]).max()])
            heading = in_heading_frame(along[None], np.array([self._yaw]))[0, :2]
            tip = -along * np.min(half / np.abs(heading).clip(1e-6))
            points = np.array([[tip - along * length, tip]])
            thick = 0.022 * self._size
            self._arrow = self._server.scene.add_arrows(
                "/world/push",
                points,
                PUSH_COLOR,
                shaft_radius=thick,
                head_radius=2.4 * thick,
                head_length=min(6 * thick, 0.6 * length),
                position=self._base,
            )
        self._arrow_until = now + _ARROW_TIME

    def _end_parts(self) -> None:
        if self._parts is not None:
            self._parts.stop()
        self._parts = None

    def stop(self) -> None:
        """Close the port."""
        self._end_parts()
        self._server.stop()
