"""Software renderer for robots, without OpenGL and without a window.

Triangles are rasterized with a depth buffer; the sun casts shadows on ground and robot. World frame: x forward, y left,
z up. Lengths are in m.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageFilter

from surefoot.arrays import Array
from surefoot.report.drawing.ground_part import faces, ground_around, step_edges
from surefoot.report.drawing.mesh import Mesh
from surefoot.report.drawing.raster import Light, SurfaceArrays, paint_faces, paint_ground, rasterize
from surefoot.report.drawing.uneven_ground import GroundStyle, VisibleGround, clip, paint_uneven
from surefoot.world.ground import FLAT, Ground

TILE = 0.25
"""Side of a square of the ground's checker pattern [m]."""
_PARTS = 2
"""Subpixels per pixel along each side, for antialiasing."""
_FAR, _HAZY = 11.0, 13.0
"""Distances at which squares have faded out, and over which haze increases, relative to the camera's height."""
_NEAR = 0.1
"""Minimum distance from the camera that is drawn [m]."""
_TO_SUN = np.array([0.24, -0.44, 0.86]) / np.linalg.norm([0.24, -0.44, 0.86])
_SKY, _HAZE, _GROUND = np.array([(150, 184, 216), (232, 238, 243), (208, 213, 216)]) / 255.0
_DARK = 0.24
"""Relative reduction of the linear color in a dark square."""
_SHADOW = 0.62
"""Relative reduction of the ground's linear color in full shadow."""
_TEXELS = 300
"""Grid points of the shadow along its longer side."""
_CLEARANCE = 0.4
"""Minimum height of the eye above the ground's slope, relative to its height above level ground."""
_SPREAD = 0.03
"""Distance over which heights of shadow casters are averaged [m]."""
_EXTENT = 0.8737
"""Extent of a robot that fills the image of the default camera [m]."""


@dataclass(frozen=True)
class Camera:
    """Camera that follows the smoothed path of a body over the ground, without rotating.

    Attributes:
        offset: vector in the world frame from the target point to the camera [m]; by default right and slightly ahead.
        height: height of the target point above the ground [m].
        field_of_view: vertical field of view [deg].
        smoothing: standard deviation of the Gaussian that smooths the path [s].
    """

    offset: tuple[float, float, float] = (0.62, -1.20, 0.40)
    height: float = 0.13
    field_of_view: float = 32.0
    smoothing: float = 0.3

    @classmethod
    def for_robot(cls, extent: float) -> Camera:
        """Return a camera whose distance and height fit a robot of a given extent [m], see `scene.extent`."""
        scale = round(extent / _EXTENT, 3)
        x, y, z = (scale * part for part in cls.offset)
        return cls(offset=(x, y, z), height=scale * cls.height)


class View:
    """Pinhole camera that looks at a position (2,) [m] on a ground; image axes: x right, y down [px], depth [m]."""

    def __init__(self, camera: Camera, place: ArrayLike, size: tuple[int, int], ground: Ground = FLAT) -> None:
        offset = np.array(camera.offset, dtype=np.float64)
        at = np.asarray(place, dtype=np.float64)
        self.place, self.above = at, camera.height + offset[2]
        """Position it looks at, and height of the eye above level ground [m]."""
        self.ground = ground
        level = float(ground.smooth_height(at))
        if not ground.is_flat:
            # Raise the camera above a slope that rises towards it.
            rise = float(ground.smooth_height(at + offset[:2])) - level
            offset[2] += max(rise - (1.0 - _CLEARANCE) * self.above, 0.0)
        self.eye = np.array([*at, level + camera.height]) + offset
        axis = -offset / np.linalg.norm(offset)
        right = np.cross(axis, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self.axes = np.stack([right, np.cross(axis, right), axis])
        self.width, self.height = size
        self.focal = 0.5 * self.height / np.tan(np.radians(camera.field_of_view) / 2)

    def project(self, points: Array) -> tuple[Array, Array]:
        """Project points (..., 3) in the world frame to pixels (..., 2) and depth (...) [m]."""
        local = (points - self.eye) @ self.axes.T
        depth = local[..., 2]
        pixel = self.focal * local[..., :2] / np.maximum(depth, _NEAR)[..., None]
        return pixel + np.array([self.width / 2, self.height / 2]), depth

    def rays(self, corner: Array, parts: int) -> Array:
        """Return the matrix (3, 3) that maps (column, row, 1) to a ray with depth 1.

        Column and row are in subpixels (`parts` per pixel), relative to the pixel `corner` (column, row).
        """
        to_camera = np.zeros((3, 3))
        to_camera[0, 0] = to_camera[1, 1] = 1.0 / (parts * self.focal)
        to_camera[2] = [*(corner - np.array([self.width / 2, self.height / 2])) / self.focal, 1.0]
        matrix: Array = to_camera @ self.axes
        return matrix


def draw(mesh: Mesh, poses: Array, view: View) -> Image.Image:
    """Draw sky, ground, shadows and a mesh with link poses (L, 4, 4)."""
    points, normals = mesh.place(poses)
    pixels, depth = view.project(points)
    # Heights are relative to the lowest point, because the shadow requires non-negative heights.
    base = 0.0 if view.ground.is_flat else float(points[:, 2].min())
    points[:, 2] -= base
    light = _light(mesh, points)
    eye = (view.eye - [0.0, 0.0, base]).astype(np.float32)
    sky, ground = _backdrop(view.width, view.height, view.focal, float(view.above), tuple(view.axes.flat))
    picture = sky.copy()
    in_front = None
    if view.ground.is_flat:
        paint_ground(picture, ground, eye, TILE, light, _SHADOW)
    else:
        in_front = _paint_ground(picture, view, light, base)
    seen = depth > _NEAR
    if seen.any():
        x, y = pixels[seen].T.copy()
        size = np.array([view.width, view.height])
        low = np.clip(np.floor([x.min(), y.min()]).astype(int), 0, size)
        high = np.clip(np.ceil([x.max(), y.max()]).astype(int), low, size)
        columns, rows = _PARTS * (high - low)
        nearest, face_at = np.zeros((rows, columns), np.float32), np.full((rows, columns), -1, np.int32)
        if in_front is not None:
            (left, top), (right, bottom) = _PARTS * low, _PARTS * high
            nearest = in_front[top:bottom, left:right].copy()
        flat = np.column_stack([_PARTS * (pixels - low), np.where(seen, 1.0 / np.maximum(depth, _NEAR), 0.0)])
        surface = SurfaceArrays(flat.astype(np.float32), normals, mesh.faces, mesh.color**2)
        rasterize(surface.pixels, mesh.faces, nearest, face_at)
        rays = view.rays(low, _PARTS).astype(np.float32)
        paint_faces(picture, low[::-1].copy(), face_at, _PARTS, surface, eye, rays, light)
    return Image.fromarray(picture)


def _paint_ground(picture: NDArray[np.uint8], view: View, light: Light, base: float) -> NDArray[np.float32]:
    """Paint uneven ground; return its depth buffer in subpixels, see `rasterize`.

    Args:
        picture: (H, W, 3) image of the sky.
        view: camera and ground.
        light: sunlight, with heights relative to `base` [m].
        base: reference height of `light` [m].
    """
    part = ground_around(view.ground, view.place)
    triangles, normals = faces(part)
    local, owner = clip((triangles - view.eye) @ view.axes.T, _NEAR)
    depth = local[..., 2]
    pixels = view.focal * local[..., :2] / depth[..., None] + np.array([view.width / 2, view.height / 2])
    size = np.array([view.width, view.height])
    seen = ((pixels.max(axis=1) > 0) & (pixels.min(axis=1) < size)).all(axis=1)
    points = np.concatenate([_PARTS * pixels[seen], 1.0 / depth[seen, :, None]], axis=-1).reshape(-1, 3)
    columns, rows = _PARTS * size
    nearest, face_at = np.zeros((rows, columns), np.float32), np.full((rows, columns), -1, np.int32)
    rasterize(points, np.arange(len(points), dtype=np.int32).reshape(-1, 3), nearest, face_at)
    normals = normals[owner[seen]]
    away = ((triangles[owner[seen], 0] - view.eye) * normals).sum(axis=1)
    highest, radius = max(float(light.occluder.max()), 1e-6), _SPREAD / light.texel
    cover = np.maximum(_blur(light.occluder > 0.0, radius, 1.0), 0.02)
    top = highest * _blur(light.occluder, radius, highest) / cover
    ground = VisibleGround(
        np.column_stack([normals, away]), step_edges(part), part.smooth_heights, part.grid, top, base
    )
    color, haze = 255.0 * _GROUND, 255.0 * _HAZE
    style = GroundStyle(color, haze, TILE, _DARK, _SHADOW, float(_FAR * view.above), float(_HAZY * view.above))
    rays = view.rays(np.zeros(2), _PARTS)
    paint_uneven(picture, face_at, _PARTS, ground, view.eye, rays, light, style)
    return nearest


def _light(mesh: Mesh, points: Array) -> Light:
    """Return the sunlight and the shadow of a mesh with points (P, 3) and non-negative heights."""
    height = points[:, 2]
    slant = height / _TO_SUN[2]
    # Separate columns: numpy computes their minimum and maximum much faster.
    x, y = points[:, 0] - _TO_SUN[0] * slant, points[:, 1] - _TO_SUN[1] * slant
    low, high = np.array([x.min(), y.min()]), np.array([x.max(), y.max()])
    span = float((high - low).max())
    texel = max(span, 0.01) / _TEXELS
    # Soft edges extend beyond the shadow.
    margin = 0.08 * span
    low = low - margin
    columns, rows = np.ceil((high + margin - low) / texel).astype(int) + 2
    occluder, face_at = np.zeros((rows, columns), np.float32), np.full((rows, columns), -1, np.int32)
    flat = np.column_stack([(x - low[0]) / texel, (y - low[1]) / texel, np.maximum(height, 1e-6)])
    rasterize(flat.astype(np.float32), mesh.faces, occluder, face_at)
    shadow = _soften(occluder, texel)
    return Light(_TO_SUN.astype(np.float32), occluder, shadow, low.astype(np.float32), texel)


def _soften(occluder: NDArray[np.float32], texel: float) -> NDArray[np.float32]:
    """Return the darkness (H, W), 0 to 1, of the shadow of objects with given heights; high ones have soft shadows."""
    top = max(float(occluder.max()), 1e-6)
    cover, radius = occluder > 0.0, 0.05 * top / texel
    sharp, soft = _blur(cover, 1.0, 1.0), _blur(cover, radius, 1.0)
    # Mean height of the surrounding objects, relative to the maximum.
    softness = np.clip(1.6 * _blur(occluder, radius, top) / np.maximum(soft, 0.02), 0.0, 1.0)
    shadow: NDArray[np.float32] = (sharp + softness * (soft - sharp)).astype(np.float32)
    return shadow


def _blur(values: NDArray[Any], radius: float, top: float) -> NDArray[np.float32]:
    """Blur values (H, W) from 0 to `top` with a radius in grid points; return them relative to `top`."""
    image = Image.fromarray((255.0 / top * values).astype(np.uint8)).filter(ImageFilter.GaussianBlur(radius))
    return np.asarray(image, np.float32) / np.float32(255.0)


@functools.lru_cache(maxsize=4)
def _backdrop(
    width: int, height: int, focal: float, above: float, axes: tuple[float, ...]
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return an image (H, W, 3) of the sky, and the ground in its last rows, see `paint_ground`.

    They depend only on the camera's height [m], direction and focal length [px], which are the same for all frames.
    """
    matrix = np.array(axes).reshape(3, 3)
    column, row = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = (np.stack([column, row, np.full_like(row, focal)], axis=-1) / focal) @ matrix
    length = np.linalg.norm(rays, axis=-1)
    up = rays[..., 2] / length
    sky = _HAZE + np.clip(2.2 * up, 0.0, 1.0)[..., None] * (_SKY - _HAZE)
    first = int(np.argmax((up < -1e-3).all(axis=1))) if (up[-1] < -1e-3).all() else height
    rays, length, up = rays[first:], length[first:], up[first:]
    distance = above / -up
    place = (distance / length)[..., None] * rays[..., :2]
    # Extent of a pixel on the ground, from the differences between neighbouring positions along rows and columns.
    reach = np.maximum(*(np.abs(np.gradient(place, axis=k)) for k in (0, 1))) if len(rays) > 1 else place * 0 + 1.0
    haze = 1.0 - np.exp(-((distance / (_HAZY * above)) ** 1.5))
    color = 255.0 * (_GROUND + haze[..., None] * (_HAZE - _GROUND))
    dark = _DARK * np.clip(1.0 - distance / (_FAR * above), 0.0, 1.0) ** 0.8
    ground = np.concatenate([place, np.maximum(reach, 1e-4), color, dark[..., None]], axis=-1)
    return (255.0 * sky).astype(np.uint8), np.ascontiguousarray(ground, np.float32)
