"""A robot's run as an MP4, drawn in software.

No OpenGL and no window: boxes, cylinders and spheres are shaded flat, sorted back to front and filled with
Pillow, then encoded as H.264 by the ffmpeg that comes with imageio-ffmpeg. World frame: x forward, y left, z
up, ground at z = 0. Lengths in m.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFilter, ImageFont

from surefoot.errors import SurefootError, choices

FloatArray = NDArray[np.float64]
Overlay = Sequence[str] | Callable[[float], str] | None

KINDS = ("box", "cylinder", "sphere")
SUPERSAMPLE = 2
TILE = 0.25  # m, side of a square of the ground
FAR = 6.0  # m from the camera where the squares have faded out
NEAR = 0.1  # m from the camera; what is nearer is not drawn
SEGMENTS = 20  # of a circle
TO_LIGHT = np.array([-0.30, -0.42, 0.86]) / np.linalg.norm([-0.30, -0.42, 0.86])
SKY, HAZE, GROUND, SQUARE = np.array([(150, 184, 216), (232, 238, 243), (208, 213, 216), (184, 191, 197)], float)
SHADOW, INK, PANEL = (52, 58, 66), (34, 39, 46), (255, 255, 255, 190)


@dataclass(frozen=True, eq=False)
class Shape:
    """One solid of the robot.

    Attributes:
        body: whose pose it follows.
        kind: one of `KINDS`.
        size: box: half extents x, y, z; cylinder: radius and half length along z; sphere: radius. In m.
        position: (3,) m, centre in the body's frame.
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
            rule = f"a {self.kind} has {need} sizes above 0 m"
            raise SurefootError(f"shape of {self.body}: size {tuple(self.size)}; {rule}")
        if np.shape(self.position) != (3,) or np.shape(self.rotation) != (3, 3):
            raise SurefootError(f"shape of {self.body}: position must be (3,) and rotation (3, 3)")


@dataclass(frozen=True)
class Camera:
    """Where the picture is taken from; it follows a body's path over the ground, smoothed, and never turns.

    Attributes:
        offset: m in the world from the point looked at to the camera: from the right and a little ahead.
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
        overlay: text at the top left: one for each of `times`, or a function of time (s); may have lines.
        fps: frames a second; poses between two times are interpolated.
        size: width and height in pixels, even.
        seconds: length at most; all of `times` when left out.
        camera: where to look from.
        follow: body that the camera follows; "base", or else the first one, when left out.
        quality: H.264 constant rate factor: smaller is better and larger.
    """
    import imageio_ffmpeg

    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise SurefootError(f"video {path}: the name must end in .mp4")
    if fps <= 0 or min(size) <= 0 or size[0] % 2 or size[1] % 2:
        raise SurefootError(f"video: {size[0]} x {size[1]} at {fps} fps; sides must be even, all above 0")
    film = _Film(shapes, poses, times, overlay, camera or Camera(), follow)
    length = film.times[-1] - film.times[0]
    length = length if seconds is None else min(seconds, length)
    clock = film.times[0] + np.arange(max(int(length * fps + 1e-6), 1)) / fps
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
        output_params=["-crf", str(quality), "-preset", "veryfast", "-movflags", "+faststart"],
    )
    try:
        # Where no file can be made, ffmpeg would say so by its whole command.
        temporary.touch()
        writer.send(None)
        for frame in film.frames(clock, size):
            writer.send(frame.tobytes())
        writer.close()
        os.replace(temporary, path)
    except OSError as error:
        raise SurefootError(f"video {path}: can't be written: {error.strerror or 'ffmpeg failed'}") from error
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
    """Draw one picture; the pose of each body is (4, 4)."""
    still = {body: np.asarray(pose, dtype=np.float64)[None] for body, pose in poses.items()}
    film = _Film(shapes, still, [0.0], [text], camera or Camera(), follow)
    return next(film.frames(np.zeros(1), size))


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
    """Draw `count` pictures from `start` to `end` (s) side by side, each of `size`; see `render_video`."""
    if count < 1:
        raise SurefootError(f"filmstrip: {count} pictures; it needs 1 or more")
    film = _Film(shapes, poses, times, overlay, camera or Camera(), follow)
    first = film.times[0] if start is None else start
    last = film.times[-1] if end is None else end
    strip = Image.new("RGB", (count * size[0] + (count - 1) * gap, size[1]), "white")
    for index, frame in enumerate(film.frames(np.linspace(first, last, count), size)):
        strip.paste(frame, (index * (size[0] + gap), 0))
    return strip


class _Film:
    """Shapes, their poses over time, text and camera: checked, and ready to be drawn at any time."""

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
        if not shapes:
            raise SurefootError("video: needs at least one shape")
        bodies = list(poses)
        follow = follow or ("base" if "base" in poses else bodies[0] if bodies else "")
        missing = sorted({*(s.body for s in shapes), follow} - set(bodies))
        if missing:
            raise SurefootError(f"video: no poses of {choices(missing)}; there are {choices(bodies) or 'none'}")
        for body in bodies:
            pose = np.asarray(poses[body], dtype=np.float64)
            if pose.shape != (len(self.times), 4, 4) or not np.all(np.isfinite(pose)):
                raise SurefootError(f"video: poses of {body} {pose.shape} must be {len(self.times)} finite 4 x 4")
        if overlay is not None and not callable(overlay) and len(overlay) != len(self.times):
            raise SurefootError(f"video: {len(overlay)} overlay texts for {len(self.times)} times; one each")
        self.poses = np.stack([np.asarray(poses[body], dtype=np.float64) for body in bodies], axis=1)
        self.overlay, self.camera, self.mesh = overlay, camera, _Mesh(shapes, bodies)
        path = self.poses[:, bodies.index(follow), :2, 3]
        self.path_times, self.path = _glide(self.times, path, camera.smoothing)

    def frames(self, clock: FloatArray, size: tuple[int, int]) -> Iterator[Image.Image]:
        """Draw a picture at each time of clock (s)."""
        for now in clock:
            aim = np.array([*(np.interp(now, self.path_times, p) for p in self.path.T), self.camera.height])
            picture = _draw(self.mesh, self.poses_at(now), _View(self.camera, aim, size))
            if self.overlay is not None:
                nearest = int(np.abs(self.times - now).argmin())
                _write(picture, self.overlay(float(now)) if callable(self.overlay) else self.overlay[nearest])
            yield picture

    def poses_at(self, now: float) -> FloatArray:
        """Interpolate the poses (B, 4, 4): each number linearly, then the axes made orthonormal."""
        after = min(max(int(np.searchsorted(self.times, now)), 1), len(self.times) - 1)
        before = max(after - 1, 0)
        span = self.times[after] - self.times[before]
        part = float(np.clip((now - self.times[before]) / span, 0.0, 1.0)) if span > 0 else 0.0
        pose: FloatArray = (1.0 - part) * self.poses[before] + part * self.poses[after]
        x = pose[:, :3, 0] / np.linalg.norm(pose[:, :3, 0], axis=1, keepdims=True)
        z = np.cross(x, pose[:, :3, 1])
        z /= np.linalg.norm(z, axis=1, keepdims=True)
        pose[:, :3, :3] = np.stack([x, np.cross(z, x), z], axis=-1)
        return pose


class _Mesh:
    """All shapes as flat faces, in the frames of their bodies."""

    def __init__(self, shapes: Sequence[Shape], bodies: list[str]) -> None:
        solids = [_solid(s.kind, tuple(s.size)) for s in shapes]
        turn = [np.asarray(s.rotation, dtype=np.float64) for s in shapes]
        place = [np.asarray(s.position, dtype=np.float64) for s in shapes]
        start = np.cumsum([0] + [len(points) for points, _ in solids])
        body = np.array([bodies.index(s.body) for s in shapes])
        corner = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
        self.half = np.array([np.abs(points).max(axis=0) for points, _ in solids])  # (S, 3) of the bounding boxes
        self.axes, self.place, self.body = np.array(turn), np.array(place), body
        self.points = np.concatenate([p @ r.T + t for (p, _), r, t in zip(solids, turn, place, strict=True)])
        self.point_body = np.repeat(body, np.diff(start))
        self.corners = np.einsum("sij,skj->ski", self.axes, corner * self.half[:, None]) + self.place[:, None]
        self.faces = [tuple(a + i for i in f) for (_, fs), a in zip(solids, start[:-1], strict=True) for f in fs]
        self.owner = np.repeat(np.arange(len(shapes)), [len(faces) for _, faces in solids])
        self.centres = np.array([self.points[list(f)].mean(axis=0) for f in self.faces])
        self.normals = np.array([_normal(self.points[list(f)]) for f in self.faces])
        self.color = np.array([s.color for s in shapes], dtype=np.float64)[self.owner]


class _View:
    """A pinhole camera: x right, y down, depth along its axis, in pixels of the picture to be drawn."""

    def __init__(self, camera: Camera, aim: FloatArray, size: tuple[int, int]) -> None:
        offset = np.array(camera.offset, dtype=np.float64)
        self.eye = aim + offset
        axis = -offset / np.linalg.norm(offset)
        right = np.cross(axis, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self.axes = np.stack([right, np.cross(axis, right), axis])
        self.width, self.height = size[0] * SUPERSAMPLE, size[1] * SUPERSAMPLE
        self.focal = 0.5 * self.height / np.tan(np.radians(camera.field_of_view) / 2)

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return pixels (..., 2) and depth (...) in m of points (..., 3) in the world."""
        local = (points - self.eye) @ self.axes.T
        depth = local[..., 2]
        pixel = self.focal * local[..., :2] / np.maximum(depth, NEAR)[..., None]
        return pixel + np.array([self.width / 2, self.height / 2]), depth


def _draw(mesh: _Mesh, poses: FloatArray, view: _View) -> Image.Image:
    """Draw sky, ground, shadows and shapes, back to front, and shrink the picture to its size."""
    # Sky and ground hang only on the camera's height and direction, which are the same in every frame.
    picture = _backdrop(view.width, view.height, view.focal, float(view.eye[2]), tuple(view.axes[:, 2])).copy()
    pen = ImageDraw.Draw(picture)
    for polygon, fill in _squares(view):
        pen.polygon(polygon, fill=fill)

    turn, place = poses[:, :3, :3], poses[:, :3, 3]
    points = np.einsum("pij,pj->pi", turn[mesh.point_body], mesh.points) + place[mesh.point_body]
    face_body = mesh.body[mesh.owner]
    normals = np.einsum("fij,fj->fi", turn[face_body], mesh.normals)
    centres = np.einsum("fij,fj->fi", turn[face_body], mesh.centres) + place[face_body]
    lit = normals @ TO_LIGHT
    _shadow(picture, view, points, [mesh.faces[i] for i in np.flatnonzero(lit > 0.0)])

    pixels, depth = view.project(points)
    shade = 0.62 + 0.42 * np.maximum(lit, 0.0) + 0.06 * normals[:, 2]
    fills = np.clip(mesh.color * shade[:, None], 0.0, 255.0).astype(int)
    facing = np.einsum("fi,fi->f", normals, view.eye - centres) > 0.0
    rank = np.empty(len(mesh.body), dtype=int)
    rank[_back_to_front(mesh, turn, place, view)] = np.arange(len(mesh.body))
    corners, fills = list(map(tuple, pixels.tolist())), list(map(tuple, fills.tolist()))
    hidden = set(np.flatnonzero(depth <= NEAR).tolist())
    for i in sorted(np.flatnonzero(facing), key=lambda i: rank[mesh.owner[i]]):
        if not hidden or not hidden.intersection(mesh.faces[i]):
            pen.polygon([corners[j] for j in mesh.faces[i]], fill=fills[i])
    return picture.reduce(SUPERSAMPLE)


def _back_to_front(mesh: _Mesh, turn: FloatArray, place: FloatArray, view: _View) -> list[int]:
    """Order the shapes so that none is drawn over one that is in front of it.

    Two convex solids apart are parted by a plane, mostly a face of a bounding box; the one on the camera's
    side is in front. The face that parts them best decides, which also serves solids that overlap.
    """
    axes = turn[mesh.body] @ mesh.axes
    centre = np.einsum("sij,sj->si", turn[mesh.body], mesh.place) + place[mesh.body]
    corners = np.einsum("sij,skj->ski", turn[mesh.body], mesh.corners) + place[mesh.body][:, None]
    # Along the axes of shape i: where the corners of j lie (i, j, 8, 3), and the camera.
    along = np.einsum("ijkx,ixa->ijka", corners[None] - centre[:, None, None], axes)
    gap = np.concatenate([along.min(axis=2), -along.max(axis=2)], axis=-1) - np.tile(mesh.half, 2)[:, None]
    eye = np.einsum("ix,ixa->ia", view.eye - centre, axes)
    beyond = np.concatenate([eye, -eye], axis=-1) > np.tile(mesh.half, 2)  # camera outside this face of i
    best = gap.argmax(axis=-1)
    width = np.take_along_axis(gap, best[..., None], axis=-1)[..., 0]
    i_first = np.take_along_axis(beyond, best, axis=1)  # then j, beyond the face with the camera, hides i
    behind = np.where(width >= width.T, i_first, ~i_first.T)  # behind[i, j]: i is drawn before j
    flat, depth = view.project(corners)
    low, high = flat.min(axis=1), flat.max(axis=1)
    touch = np.all((low[:, None] < high[None]) & (low[None] < high[:, None]), axis=-1)
    np.fill_diagonal(touch, False)
    behind &= touch

    far = np.argsort(-depth.mean(axis=1))
    waiting = behind.sum(axis=0)
    left = np.ones(len(far), dtype=bool)
    order: list[int] = []
    while len(order) < len(far):
        ready = [i for i in far if left[i] and waiting[i] == 0]
        chosen = ready or [next(i for i in far if left[i])]  # a circle of overlaps: start with the farthest
        for i in chosen:
            order.append(int(i))
            left[i] = False
            waiting -= behind[i]
    return order


def _squares(view: _View) -> Iterator[tuple[list[tuple[float, float]], tuple[int, ...]]]:
    """Yield the dark squares of the ground as polygons with their colours, faded with distance."""
    reach = int(np.ceil(FAR / TILE))
    near = np.floor(view.eye[:2] / TILE).astype(int)
    column, row = np.meshgrid(*(np.arange(c - reach, c + reach) for c in near), indexing="ij")
    dark = (column + row) % 2 == 0
    low = np.stack([column[dark], row[dark]], axis=-1) * TILE
    step = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * TILE
    ground = np.concatenate([low[:, None] + step, np.zeros((len(low), 4, 1))], axis=-1)
    pixels, depth = view.project(ground)
    distance = np.linalg.norm(ground.mean(axis=1) - view.eye, axis=-1)
    inside = np.all((pixels.max(axis=1) > 0) & (pixels.min(axis=1) < [view.width, view.height]), axis=-1)
    seen = inside & (depth.min(axis=1) > NEAR) & (distance < FAR)
    strength = np.clip(1.0 - distance[seen] / FAR, 0.0, 1.0)[:, None] ** 0.8
    fills = _ground_color(distance[seen]) - strength * (GROUND - SQUARE)
    for corners, fill in zip(pixels[seen].tolist(), fills.astype(int).tolist(), strict=True):
        yield list(map(tuple, corners)), tuple(fill)


def _ground_color(distance: FloatArray) -> FloatArray:
    """Return the colour (..., 3) of the bare ground at a distance (...) in m from the camera."""
    haze = 1.0 - np.exp(-((distance / 7.0) ** 1.5))
    return GROUND + haze[..., None] * (HAZE - GROUND)


@functools.lru_cache(maxsize=4)
def _backdrop(width: int, height: int, focal: float, above: float, slope: tuple[float, float, float]) -> Image.Image:
    """Paint sky and bare ground, row by row; slope is the world's z along the view's axes."""
    ray = (np.arange(height) + 0.5 - height / 2) / focal * slope[1] + slope[2]
    length = np.sqrt(1.0 + ((np.arange(height) + 0.5 - height / 2) / focal) ** 2)
    down = -ray / length
    ground = _ground_color(above / np.maximum(down, 1e-3))
    sky = HAZE + np.clip(-down * 2.2, 0.0, 1.0)[:, None] * (SKY - HAZE)
    rows = np.where(down[:, None] > 1e-3, ground, sky).astype(np.uint8)
    return Image.fromarray(np.ascontiguousarray(np.broadcast_to(rows[:, None], (height, width, 3))))


def _shadow(picture: Image.Image, view: _View, points: FloatArray, faces: list[tuple[int, ...]]) -> None:
    """Darken the ground where the light's way is barred, softly."""
    ground = points - TO_LIGHT * (np.maximum(points[:, 2:], 0.0) / TO_LIGHT[2])
    ground[:, 2] = 0.0
    pixels, depth = view.project(ground)
    margin = 24
    low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - margin, 0)
    high = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + margin, [view.width, view.height])
    if np.any(high <= low) or depth.min() <= NEAR:
        return
    # A quarter of the area is enough for something soft.
    small = ((high - low) // 2 + 1).tolist()
    mask = Image.new("L", tuple(small), 0)
    pen = ImageDraw.Draw(mask)
    corners = list(map(tuple, ((pixels - low) / 2).tolist()))
    for face in faces:
        pen.polygon([corners[i] for i in face], fill=105)
    mask = mask.filter(ImageFilter.GaussianBlur(0.004 * view.height)).resize((small[0] * 2, small[1] * 2))
    picture.paste(SHADOW, tuple(low.tolist()), mask)


def _write(picture: Image.Image, text: str) -> None:
    """Write lines of text on a light panel at the top left."""
    if not text:
        return
    unit = picture.height / 540
    font = _font(max(round(19 * unit), 11))
    pen = ImageDraw.Draw(picture, "RGBA")
    margin, padding = 14 * unit, 10 * unit
    box = pen.multiline_textbbox((margin + padding, margin + padding), text, font=font, spacing=5 * unit)
    pen.rounded_rectangle(
        (box[0] - padding, box[1] - padding, box[2] + padding, box[3] + padding), radius=7 * unit, fill=PANEL
    )
    pen.multiline_text((margin + padding, margin + padding), text, fill=INK, font=font, spacing=5 * unit)


@functools.lru_cache(maxsize=8)
def _font(size: int) -> Any:
    """Return Pillow's own font, which is there on every machine."""
    return ImageFont.load_default(size)


def _glide(times: FloatArray, path: FloatArray, smoothing: float) -> tuple[FloatArray, FloatArray]:
    """Return times and positions (K, 2) of a camera that glides along a path (T, 2).

    Local linear regression with Gaussian weights: unlike a mean, it does not lag at the ends.
    """
    if smoothing <= 0 or len(times) < 3:
        return times, path
    clock = np.linspace(times[0], times[-1], max(int((times[-1] - times[0]) * 20), 2))
    rough = np.stack([np.interp(clock, times, p) for p in path.T], axis=-1)
    lag = clock[None] - clock[:, None]
    weight = np.exp(-0.5 * (lag / smoothing) ** 2)
    m0, m1, m2 = ((weight * lag**k).sum(axis=1)[:, None] for k in range(3))
    return clock, (m2 * (weight @ rough) - m1 * ((weight * lag) @ rough)) / (m0 * m2 - m1**2)


def _normal(corners: FloatArray) -> FloatArray:
    """Return the unit normal of a flat face (K, 3) of counter-clockwise corners (Newell's method)."""
    normal: FloatArray = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)
    return normal / np.linalg.norm(normal)


def _solid(kind: str, size: tuple[float, ...]) -> tuple[FloatArray, list[tuple[int, ...]]]:
    """Return points (P, 3) about the centre and faces (indices, counter-clockwise seen from outside)."""
    if kind == "box":
        corner = np.array([[x, y, z] for z in (-1, 1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))], float)
        sides: list[tuple[int, ...]] = [
            (0, 1, 5, 4),
            (1, 2, 6, 5),
            (2, 3, 7, 6),
            (3, 0, 4, 7),
            (3, 2, 1, 0),
            (4, 5, 6, 7),
        ]
        return corner * np.array(size), sides
    angle = 2 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    # A sphere as a stack of rings, a cylinder as two: each ring has a radius and a height.
    tilt = np.linspace(-0.44, 0.44, SEGMENTS // 2 - 2) * np.pi
    sphere = [(size[0] * np.cos(t), size[0] * np.sin(t)) for t in tilt]
    rings = sphere if kind == "sphere" else [(size[0], -size[1]), (size[0], size[1])]
    points = np.array([(r * np.cos(a), r * np.sin(a), z) for r, z in rings for a in angle])
    faces: list[tuple[int, ...]] = []
    for ring in range(len(rings) - 1):
        for i in range(SEGMENTS):
            a, b = ring * SEGMENTS + i, ring * SEGMENTS + (i + 1) % SEGMENTS
            faces.append((a, b, b + SEGMENTS, a + SEGMENTS))
    top = (len(rings) - 1) * SEGMENTS
    return points, [*faces, tuple(reversed(range(SEGMENTS))), tuple(range(top, top + SEGMENTS))]
