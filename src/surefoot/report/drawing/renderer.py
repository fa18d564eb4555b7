"""Solids drawn in software: no OpenGL and no window.

Boxes, cylinders and spheres are shaded flat, sorted back to front and filled with Pillow. World frame: x forward,
y left, z up. Lengths in m.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFilter

from surefoot.arrays import Array
from surefoot.robot.appearance import solid
from surefoot.robot.urdf import Shape
from surefoot.world.ground import FLAT

SUPERSAMPLE = 2
TILE = 0.25  # m, side of a square of the ground
FAR = 6.0  # m from the camera where the squares have faded out
NEAR = 0.1  # m from the camera; what is nearer is not drawn
TO_LIGHT = np.array([-0.30, -0.42, 0.86]) / np.linalg.norm([-0.30, -0.42, 0.86])
SKY, HAZE, GROUND, SQUARE = np.array([(150, 184, 216), (232, 238, 243), (208, 213, 216), (184, 191, 197)], float)
SHADOW = (52, 58, 66)
_EXTENT = 0.8856
"""Extent [m] of a robot that fills the picture of a camera as it stands."""


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

    @classmethod
    def for_robot(cls, extent: float) -> Camera:
        """Return a camera at the distance and height for a robot of this size [m], corner to corner at rest."""
        scale = round(extent / _EXTENT, 3)
        x, y, z = (scale * part for part in cls.offset)
        return cls(offset=(x, y, z), height=scale * cls.height)


class Mesh:
    """All shapes as flat faces, in the frames of their bodies."""

    def __init__(self, shapes: Sequence[Shape], bodies: list[str]) -> None:
        solids = [solid(shape.kind, shape.size) for shape in shapes]
        start = np.cumsum([0] + [len(points) for points, _ in solids])
        corner = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        self.half = np.array([np.abs(points).max(axis=0) for points, _ in solids])  # (S, 3) of the bounding boxes
        self.axes = np.array([shape.rotation for shape in shapes])
        self.place = np.array([shape.position for shape in shapes])
        self.body = np.array([bodies.index(shape.link) for shape in shapes])
        placed = zip(solids, self.axes, self.place, strict=True)
        self.points = np.concatenate([points @ turn.T + place for (points, _), turn, place in placed])
        self.point_body = np.repeat(self.body, np.diff(start))
        self.corners = np.einsum("sij,skj->ski", self.axes, corner * self.half[:, None]) + self.place[:, None]
        self.faces = [tuple(a + i for i in f) for (_, fs), a in zip(solids, start[:-1], strict=True) for f in fs]
        self.owner = np.repeat(np.arange(len(shapes)), [len(faces) for _, faces in solids])
        self.centres = np.array([self.points[list(face)].mean(axis=0) for face in self.faces])
        self.normals = np.array([_normal(self.points[list(face)]) for face in self.faces])
        self.color = np.array([shape.color for shape in shapes], float)[self.owner]

    def place_points(self, poses: Array) -> Array:
        """Return all points (P, 3) of bodies with these poses (B, 4, 4), in the poses' world."""
        frames = poses[self.point_body]
        points: Array = np.einsum("pij,pj->pi", frames[:, :3, :3], self.points) + frames[:, :3, 3]
        return points


class View:
    """A pinhole camera: x right, y down, depth along its axis, in pixels of the picture to be drawn."""

    def __init__(self, camera: Camera, aim: Array, size: tuple[int, int]) -> None:
        offset = np.array(camera.offset, dtype=np.float64)
        self.eye = aim + offset
        axis = -offset / np.linalg.norm(offset)
        right = np.cross(axis, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self.axes = np.stack([right, np.cross(axis, right), axis])
        self.width, self.height = size[0] * SUPERSAMPLE, size[1] * SUPERSAMPLE
        self.focal = 0.5 * self.height / np.tan(np.radians(camera.field_of_view) / 2)

    def project(self, points: Array) -> tuple[Array, Array]:
        """Return pixels (..., 2) and depth (...) in m of points (..., 3) in the world."""
        local = (points - self.eye) @ self.axes.T
        depth = local[..., 2]
        pixel = self.focal * local[..., :2] / np.maximum(depth, NEAR)[..., None]
        return pixel + np.array([self.width / 2, self.height / 2]), depth


def draw(mesh: Mesh, poses: Array, view: View) -> Image.Image:
    """Draw sky, ground, shadows and shapes, back to front, and shrink the picture to its size."""
    # Sky and ground depend only on the camera's height and direction, which are the same in every frame.
    picture = _backdrop(view.width, view.height, view.focal, float(view.eye[2]), tuple(view.axes[:, 2])).copy()
    pen = ImageDraw.Draw(picture)
    for polygon, fill in _squares(view):
        pen.polygon(polygon, fill=fill)

    turn, place = poses[:, :3, :3], poses[:, :3, 3]
    points = mesh.place_points(poses)
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


def _back_to_front(mesh: Mesh, turn: Array, place: Array, view: View) -> list[int]:
    """Order the shapes so that none is drawn over one that is in front of it.

    Two convex solids are separated by a plane, mostly a face of a bounding box; the one on the camera's side
    is in front. The face that separates them most decides, also for solids that overlap.
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


def _squares(view: View) -> Iterator[tuple[list[tuple[float, float]], tuple[int, ...]]]:
    """Yield the dark squares of the ground as polygons with their colours, faded with distance."""
    reach = int(np.ceil(FAR / TILE))
    near = np.floor(view.eye[:2] / TILE).astype(int)
    column, row = np.meshgrid(*(np.arange(c - reach, c + reach) for c in near), indexing="ij")
    dark = (column + row) % 2 == 0
    low = np.stack([column[dark], row[dark]], axis=-1) * TILE
    step = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * TILE
    corners = low[:, None] + step
    ground = np.concatenate([corners, FLAT.height(corners)[..., None]], axis=-1)
    pixels, depth = view.project(ground)
    distance = np.linalg.norm(ground.mean(axis=1) - view.eye, axis=-1)
    inside = np.all((pixels.max(axis=1) > 0) & (pixels.min(axis=1) < [view.width, view.height]), axis=-1)
    seen = inside & (depth.min(axis=1) > NEAR) & (distance < FAR)
    strength = np.clip(1.0 - distance[seen] / FAR, 0.0, 1.0)[:, None] ** 0.8
    fills = _ground_color(distance[seen]) - strength * (GROUND - SQUARE)
    for corners, fill in zip(pixels[seen].tolist(), fills.astype(int).tolist(), strict=True):
        yield list(map(tuple, corners)), tuple(fill)


def _ground_color(distance: Array) -> Array:
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


def _shadow(picture: Image.Image, view: View, points: Array, faces: list[tuple[int, ...]]) -> None:
    """Draw a soft shadow of the faces on the ground."""
    above = points[:, 2:] - FLAT.height(points[:, :2])[:, None]
    ground = points - TO_LIGHT * (np.maximum(above, 0.0) / TO_LIGHT[2])
    ground[:, 2] = FLAT.height(ground[:, :2])
    pixels, depth = view.project(ground)
    margin = 24
    low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - margin, 0)
    high = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + margin, [view.width, view.height])
    if np.any(high <= low) or depth.min() <= NEAR:
        return
    # A soft shadow needs only a quarter of the pixels.
    small = ((high - low) // 2 + 1).tolist()
    mask = Image.new("L", tuple(small), 0)
    pen = ImageDraw.Draw(mask)
    corners = list(map(tuple, ((pixels - low) / 2).tolist()))
    for face in faces:
        pen.polygon([corners[i] for i in face], fill=105)
    mask = mask.filter(ImageFilter.GaussianBlur(0.004 * view.height)).resize((small[0] * 2, small[1] * 2))
    picture.paste(SHADOW, tuple(low.tolist()), mask)


def _normal(corners: Array) -> Array:
    """Return the unit normal of a flat face (K, 3) of counter-clockwise corners (Newell's method)."""
    normal: Array = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)
    return normal / np.linalg.norm(normal)
