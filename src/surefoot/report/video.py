"""A robot's run as an MP4, drawn in software.

No OpenGL and no window: boxes, cylinders and spheres are shaded flat, sorted back to front and filled with Pillow,
then encoded as H.264 by the ffmpeg that comes with imageio-ffmpeg. World frame: x forward, y left, z up, ground
at z = 0. Lengths in m.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFilter, ImageFont

from surefoot.errors import SurefootError, choices

FloatArray = NDArray[np.float64]
Overlay = Sequence[str] | Callable[[float], str] | None

KINDS = ("box", "cylinder", "sphere")
SUPERSAMPLE = 2
TILE = 0.25  # m, side of a square of the ground
FAR = 6.0  # m from the camera where the ground's squares have faded out
NEAR = 0.1  # m, what is nearer to the camera is not drawn
TO_LIGHT = np.array([-0.30, -0.42, 0.86]) / np.linalg.norm([-0.30, -0.42, 0.86])
SKY, HAZE, GROUND, SQUARE = (np.array(c, float) for c in ((150, 184, 216), (232, 238, 243), *[(208, 213, 216), (182, 190, 196)]))
SHADOW, INK, PANEL = (52, 58, 66), (34, 39, 46), (255, 255, 255, 190)


@dataclass(frozen=True, eq=False)
class Shape:
    """One solid of the robot.

    Attributes:
        body: whose pose it follows.
        kind: one of `KINDS`.
        size: box: half extents x, y, z; cylinder: radius and half length along z; sphere: radius.
        position: (3,) centre in the body's frame.
        rotation: (3, 3) from the shape's axes to the body's.
        color: red, green, blue, 0 to 255.
    """

    body: str
    kind: str
    size: Sequence[float]
    position: ArrayLike = (0.0, 0.0, 0.0)
    rotation: ArrayLike = field(default_factory=lambda: np.eye(3))
    color: tuple[int, int, int] = (120, 130, 140)

    def __post_init__(self) -> None:
        """Check kind and sizes."""
        if self.kind not in KINDS:
            raise SurefootError(f"shape of {self.body}: kind {self.kind!r} is not one of {choices(KINDS)}")
        need = {"box": 3, "cylinder": 2, "sphere": 1}[self.kind]
        if len(self.size) != need or not all(s > 0 for s in self.size):
            raise SurefootError(f"shape of {self.body}: a {self.kind} has {need} sizes above 0 m, not {self.size}")
        if np.shape(self.position) != (3,) or np.shape(self.rotation) != (3, 3):
            raise SurefootError(f"shape of {self.body}: position must be (3,) and rotation (3, 3)")


@dataclass(frozen=True)
class Camera:
    """Where the picture is taken from; the camera follows a body's path, smoothed, and never turns.

    Attributes:
        offset: m from the point looked at to the camera, in the world: from the right and a little ahead.
        height: m above the ground of the point looked at.
        field_of_view: degrees from the picture's top to its bottom.
        smoothing: s, standard deviation of the Gaussian that smooths the path.
    """

    offset: tuple[float, float, float] = (0.62, -1.20, 0.40)
    height: float = 0.13
    field_of_view: float = 32.0
    smoothing: float = 0.3


def render_video(
    shapes: Sequence[Shape],
    poses: Mapping[str, ArrayLike],
    times: ArrayLike,
    path: str | Path,
    *,
    overlay: Overlay = None,
    fps: int = 50,
    size: tuple[int, int] = (960, 540),
    seconds: float | None = None,
    camera: Camera | None = None,
    follow: str | None = None,
    quality: int = 23,
) -> Path:
    """Write an MP4 (H.264, yuv420p) of the bodies' motion in real time.

    Args:
        shapes: what to draw.
        poses: by body, (T, 4, 4) transforms from the body's frame to the world at `times`.
        times: (T,) s, strictly increasing.
        path: .mp4 to write; it appears whole or not at all.
        overlay: text at the top left, lines parted by newlines: one a time of `times`, or a function of time (s).
        fps: frames a second; poses are interpolated.
        size: width and height in pixels, even.
        seconds: length at most; all of `times` when left out.
        camera: where to look from.
        follow: body that the camera follows; "base" or else the first one when left out.
        quality: H.264 constant rate factor: smaller is better and larger.
    """
    import imageio_ffmpeg

    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise SurefootError(f"video {path}: the name must end in .mp4")
    if fps <= 0 or min(size) <= 0 or size[0] % 2 or size[1] % 2:
        raise SurefootError(f"video: {size[0]} x {size[1]} at {fps} fps: both sides must be even, all above 0")
    motion = _Motion(shapes, poses, times, overlay, camera or Camera(), follow)
    length = motion.length if seconds is None else min(seconds, motion.length)
    clock = motion.times[0] + np.arange(max(int(length * fps + 1e-6), 1)) / fps
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.mp4")
    writer = imageio_ffmpeg.write_frames(
        str(temporary),
        size,
        fps=fps,
        codec="libx264",
        pix_fmt_out="yuv420p",
        quality=None,
        macro_block_size=2,
        ffmpeg_log_level="error",
        output_params=["-crf", str(quality), "-preset", "medium", "-movflags", "+faststart"],
    )
    try:
        writer.send(None)
        for frame in motion.frames(clock, size):
            writer.send(frame.tobytes())
        writer.close()
        os.replace(temporary, path)
    finally:
        writer.close()
        temporary.unlink(missing_ok=True)
    return path


def render_frame(
    shapes: Sequence[Shape],
    poses: Mapping[str, ArrayLike],
    *,
    text: str = "",
    size: tuple[int, int] = (960, 540),
    camera: Camera | None = None,
    follow: str | None = None,
) -> Image.Image:
    """Draw one picture; poses by body are (4, 4)."""
    still = {body: np.asarray(pose, dtype=np.float64)[None] for body, pose in poses.items()}
    motion = _Motion(shapes, still, [0.0], [text] if text else None, camera or Camera(), follow)
    return next(motion.frames(np.zeros(1), size))


def filmstrip(
    shapes: Sequence[Shape],
    poses: Mapping[str, ArrayLike],
    times: ArrayLike,
    *,
    count: int = 6,
    start: float | None = None,
    end: float | None = None,
    overlay: Overlay = None,
    size: tuple[int, int] = (320, 240),
    gap: int = 4,
    camera: Camera | None = None,
    follow: str | None = None,
) -> Image.Image:
    """Draw `count` pictures from `start` to `end` (s) side by side, each of `size` pixels; see `render_video`."""
    if count < 1:
        raise SurefootError(f"filmstrip: {count} pictures; must be 1 or more")
    motion = _Motion(shapes, poses, times, overlay, camera or Camera(), follow)
    first = motion.times[0] if start is None else start
    last = motion.times[-1] if end is None else end
    strip = Image.new("RGB", (count * size[0] + (count - 1) * gap, size[1]), "white")
    for index, frame in enumerate(motion.frames(np.linspace(first, last, count), size)):
        strip.paste(frame, (index * (size[0] + gap), 0))
    return strip


class _Motion:
    """Shapes, poses over time and text, checked and ready to be drawn at any time."""

    def __init__(
        self,
        shapes: Sequence[Shape],
        poses: Mapping[str, ArrayLike],
        times: ArrayLike,
        overlay: Overlay,
        camera: Camera,
        follow: str | None,
    ) -> None:
        self.times = np.asarray(times, dtype=np.float64)
        if self.times.ndim != 1 or not self.times.size or np.any(np.diff(self.times) <= 0):
            raise SurefootError("video: times must be strictly increasing, one or more")
        self.length = float(self.times[-1] - self.times[0])
        if not shapes:
            raise SurefootError("video: needs at least one shape")
        missing = sorted({s.body for s in shapes} - set(poses))
        if missing:
            raise SurefootError(f"video: no poses for {choices(missing)}; there are {choices(poses)}")
        bodies = list(poses)
        for body in bodies:
            pose = np.asarray(poses[body], dtype=np.float64)
            if pose.shape != (len(self.times), 4, 4) or not np.all(np.isfinite(pose)):
                raise SurefootError(f"video: poses of {body} {pose.shape} must be {len(self.times)} finite 4 x 4")
        self.poses = np.stack([np.asarray(poses[body], dtype=np.float64) for body in bodies], axis=1)
        self.follow = follow or ("base" if "base" in bodies else bodies[0])
        if self.follow not in bodies:
            raise SurefootError(f"video: cannot follow {self.follow!r}; the bodies are {choices(bodies)}")
        if overlay is not None and not callable(overlay) and len(overlay) != len(self.times):
            raise SurefootError(f"video: {len(overlay)} overlay texts for {len(self.times)} times; one each")
        self.overlay, self.camera = overlay, camera
        self.mesh = _Mesh(shapes, bodies)
        self.path = self._smooth_path(self.poses[:, bodies.index(self.follow), :2, 3])

    def frames(self, clock: FloatArray, size: tuple[int, int]) -> Iterator[Image.Image]:
        """Draw a picture at each time of clock (s)."""
        for now in clock:
            target = np.array([*(np.interp(now, self.times, p) for p in self.path.T), self.camera.height])
            view = _View(self.camera, target, size)
            picture = _draw(self.mesh, self.poses_at(now), view)
            if self.overlay is not None:
                nearest = int(np.abs(self.times - now).argmin())
                _write(picture, self.overlay(float(now)) if callable(self.overlay) else self.overlay[nearest])
            yield picture

    def poses_at(self, now: float) -> FloatArray:
        """Interpolate the poses (B, 4, 4) at a time: positions linearly, rotations likewise, made orthonormal."""
        after = int(np.clip(np.searchsorted(self.times, now), 1, max(len(self.times) - 1, 1)))
        before, after = after - 1, min(after, len(self.times) - 1)
        part = np.clip((now - self.times[before]) / max(self.times[after] - self.times[before], 1e-12), 0.0, 1.0)
        pose: FloatArray = (1.0 - part) * self.poses[before] + part * self.poses[after]
        x = pose[:, :3, 0] / np.linalg.norm(pose[:, :3, 0], axis=1, keepdims=True)
        z = np.cross(x, pose[:, :3, 1])
        z /= np.linalg.norm(z, axis=1, keepdims=True)
        pose[:, :3, :3] = np.stack([x, np.cross(z, x), z], axis=-1)
        return pose

    def _smooth_path(self, path: FloatArray) -> FloatArray:
        """Smooth (T, 2) positions over time with a Gaussian, so that the camera glides."""
        if self.camera.smoothing <= 0 or len(path) < 3:
            return path
        lag = self.times[:, None] - self.times[None, :]
        weight = np.exp(-0.5 * (lag / self.camera.smoothing) ** 2)
        # A straight line is kept straight to its very ends: fit one locally instead of averaging.
        moment = [(weight * lag**k).sum(axis=1)[:, None] for k in range(3)]
        mean, slope = weight @ path, (weight * lag) @ path
        smooth: FloatArray = (moment[2] * mean - moment[1] * slope) / (moment[0] * moment[2] - moment[1] ** 2)
        return smooth


class _Mesh:
    """All shapes as flat faces, in the frames of their bodies."""

    def __init__(self, shapes: Sequence[Shape], bodies: list[str]) -> None:
        points, faces, normals, centres, owner, corners = [], [], [], [], [], []
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
        count = 0
        for index, shape in enumerate(shapes):
            local, polygons = _SOLIDS[shape.kind](*shape.size)
            turn, place = np.asarray(shape.rotation, float), np.asarray(shape.position, float)
            middle = np.array([local[list(f)].mean(axis=0) for f in polygons])
            outward = np.array([_normal(local[list(f)]) for f in polygons])
            points.append(local @ turn.T + place)
            centres.append(middle @ turn.T + place)
            normals.append(outward @ turn.T)
            faces += [tuple(count + i for i in f) for f in polygons]
            owner += [index] * len(polygons)
            corners.append(signs * np.abs(local).max(axis=0) @ turn.T + place)
            count += len(local)
        self.points, self.centres, self.normals = (np.concatenate(a) for a in (points, centres, normals))
        self.faces, self.owner, self.corners = faces, np.array(owner), np.array(corners)
        self.bounds = np.array([np.abs(c - c.mean(axis=0)) @ np.eye(3) for c in corners])
        self.body = np.array([bodies.index(s.body) for s in shapes])
        self.axes = np.array([np.asarray(s.rotation, float) for s in shapes])
        self.half = np.array([np.abs(_SOLIDS[s.kind](*s.size)[0]).max(axis=0) for s in shapes])
        self.color = np.array([shapes[i].color for i in owner], dtype=np.float64)
        self.point_body = np.repeat(self.body, [len(p) for p in points])
        self.flat_edges = np.array([shapes[i].kind == "box" for i in owner])
