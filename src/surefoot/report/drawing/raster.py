"""Compiled loops of the renderer: rasterization of triangles, lighting of surfaces, and the ground.

Pixels are counted from the top left; the centre of pixel 0 is at 0.5. Colors are linear, the squares of the image's
values.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numba import njit

Function = TypeVar("Function", bound=Callable[..., Any])
SKY, UP, SUN = 0.34, 0.16, 0.72
"""Lighting: ambient light, its increase from below to above, and sunlight."""
_SHINE, _RIM = 0.22, 0.10
"""Reflections: of the sun on a glossy surface, and of the sky at grazing angles."""


def compiled(function: Function) -> Function:
    """Compile a loop of the renderer."""
    # Without numba's runtime, references to arrays in tuples are not counted; see actuator/compiled.py.
    options = {"cache": True, "nogil": True, "forceinline": True, "error_model": "numpy", "fastmath": True}
    return cast(Function, njit(**options, _nrt=False)(function))


@compiled
def rasterize(points: Any, faces: Any, nearest: Any, face_at: Any) -> None:
    """Find the face in front at each pixel (depth buffer).

    Args:
        points: (P, 3) column and row in pixels, and proximity: a value that is larger for nearer points and linear over
            a triangle in the image, such as the inverse depth. Faces with a corner whose proximity is not positive are
            skipped.
        faces: (F, 3) point indices.
        nearest: (H, W) largest proximity so far; updated.
        face_at: (H, W) face in front; updated.
    """
    height, width = nearest.shape
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        xa, ya, za = points[a, 0], points[a, 1], points[a, 2]
        xb, yb, zb = points[b, 0], points[b, 1], points[b, 2]
        xc, yc, zc = points[c, 0], points[c, 1], points[c, 2]
        area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
        if area == 0.0 or not (za > 0.0 and zb > 0.0 and zc > 0.0):
            continue
        top = max(int(np.ceil(min(ya, yb, yc) - 0.5)), 0)
        bottom = min(int(np.floor(max(ya, yb, yc) - 0.5)), height - 1)
        # The barycentric coordinates of corners b and c (all three sum to 1) change linearly along a row.
        step_b, step_c = (yc - ya) / area, (ya - yb) / area
        step_a = -step_b - step_c
        step = step_b * (zb - za) + step_c * (zc - za)
        per_a = 1.0 / step_a if step_a != 0.0 else 0.0
        per_b = 1.0 / step_b if step_b != 0.0 else 0.0
        per_c = 1.0 / step_c if step_c != 0.0 else 0.0
        row_b, row_c = -(xc - xa) / area, (xb - xa) / area
        first, last = min(xa, xb, xc) - xa, max(xa, xb, xc) - xa
        for row in range(top, bottom + 1):
            y = row + 0.5 - ya
            start_b, start_c = y * row_b, y * row_c
            low, high = first, last
            for start, per in ((1.0 - start_b - start_c, per_a), (start_b, per_b), (start_c, per_c)):
                if per > 0.0:
                    low = max(low, -start * per)
                elif per < 0.0:
                    high = min(high, -start * per)
            left, right = max(int(np.ceil(xa + low - 0.5)), 0), min(int(np.floor(xa + high - 0.5)), width - 1)
            x = left + 0.5 - xa
            z = za + (start_b + x * step_b) * (zb - za) + (start_c + x * step_c) * (zc - za)
            for column in range(left, right + 1):
                if z > nearest[row, column]:
                    nearest[row, column] = z
                    face_at[row, column] = f
                z += step


class Light(NamedTuple):
    """Sunlight and shadow, on a grid of ground positions to which objects are projected along the light."""

    direction: Any
    """Unit vector towards the sun (3,)."""
    occluder: Any
    """Maximum height of objects that block the light to each ground position (H, W) [m], rows along y."""
    shadow: Any
    """Darkness of the ground at each position (H, W), 0 to 1."""
    low: Any
    """Position of the first grid corner (2,) [m]."""
    texel: float
    """Grid spacing [m]."""


@compiled
def sunlit_fraction(light: Light, x: float, y: float, z: float) -> float:
    """Return the fraction of sunlight that reaches a point at height z [m] on the light ray to (x, y) on the ground."""
    height, width = light.occluder.shape
    column, row = (x - light.low[0]) / light.texel - 1.0, (y - light.low[1]) / light.texel - 1.0
    if not (column >= 0.0 and row >= 0.0 and column < width - 2 and row < height - 2):
        return 1.0
    j, i = int(column), int(row)
    u, v = column - j, row - i
    # Average over a square of two texels around the position: objects above the point block its light.
    fraction = 0.0
    for di in range(3):
        tall = 1.0 - v if di == 0 else (v if di == 2 else 1.0)
        for dj in range(3):
            if light.occluder[i + di, j + dj] <= z:
                fraction += tall * (1.0 - u if dj == 0 else (u if dj == 2 else 1.0))
    return 0.25 * fraction


@compiled
def dark_fraction(x: float, y: float, reach_x: float, reach_y: float, tile: float) -> float:
    """Return the fraction of dark squares in a pixel with a given extent along x and y around a position [m]."""
    # Product of square waves (+1, -1) along x and y, each averaged over the pixel.
    wide_x, wide_y = 0.5 * reach_x / tile, 0.5 * reach_y / tile
    ax, ay = 0.5 * (x / tile - wide_x), 0.5 * (y / tile - wide_y)
    bx, by = ax + wide_x, ay + wide_y
    wave_x = (abs(ax - np.floor(ax) - 0.5) - abs(bx - np.floor(bx) - 0.5)) / wide_x
    wave_y = (abs(ay - np.floor(ay) - 0.5) - abs(by - np.floor(by) - 0.5)) / wide_y
    return 0.5 + 0.5 * wave_x * wave_y


@compiled
def shadow_fraction(light: Light, x: float, y: float) -> float:
    """Return the darkness of the shadow at a ground position [m], 0 to 1."""
    rows, columns = light.shadow.shape
    column, row = (x - light.low[0]) / light.texel - 0.5, (y - light.low[1]) / light.texel - 0.5
    if not (column >= 0.0 and row >= 0.0 and column < columns - 1 and row < rows - 1):
        return 0.0
    c, r = int(column), int(row)
    u, v = column - c, row - r
    above = (1.0 - u) * light.shadow[r, c] + u * light.shadow[r, c + 1]
    below = (1.0 - u) * light.shadow[r + 1, c] + u * light.shadow[r + 1, c + 1]
    return (1.0 - v) * above + v * below


@compiled
def paint_ground(picture: Any, ground: Any, eye: Any, tile: float, light: Light, dim: float) -> None:
    """Paint flat ground, which fills the last rows of an image.

    Args:
        picture: (H, W, 3) image, uint8.
        ground: (R, W, 8), for each pixel of the last R rows: where its ray meets the ground relative to the point below
            the eye, and the pixel's extent there, both along x and y [m]; color of a bright square, 0 to 255; and the
            relative reduction of the linear color in a dark square.
        eye: (3,) position of the eye [m].
        tile: side of a square [m].
        light: sunlight.
        dim: relative reduction of the linear color in full shadow.
    """
    first = len(picture) - len(ground)
    for i in range(ground.shape[0]):
        for j in range(ground.shape[1]):
            x, y = eye[0] + ground[i, j, 0], eye[1] + ground[i, j, 1]
            brightness = 1.0 - ground[i, j, 7] * dark_fraction(x, y, ground[i, j, 2], ground[i, j, 3], tile)
            brightness *= 1.0 - dim * shadow_fraction(light, x, y)
            brightness = np.sqrt(brightness)
            for k in range(3):
                picture[first + i, j, k] = np.uint8(ground[i, j, 4 + k] * brightness)


class SurfaceArrays(NamedTuple):
    """Triangles to paint."""

    pixels: Any
    """Column, row (in subpixels of the region) and inverse depth of points (P, 3)."""
    normals: Any
    """Normals at points (P, 3)."""
    faces: Any
    """Point indices of faces (F, 3)."""
    colors: Any
    """Linear colors of faces (F, 3)."""


@compiled
def _color(
    x: float, y: float, f: int, surface: SurfaceArrays, eye: Any, rays: Any, light: Light
) -> tuple[float, float, float]:
    """Return the linear color of face f at its intersection with the ray through (x, y)."""
    a, b, c = surface.faces[f, 0], surface.faces[f, 1], surface.faces[f, 2]
    xa, ya, za = surface.pixels[a, 0], surface.pixels[a, 1], surface.pixels[a, 2]
    xb, yb, zb = surface.pixels[b, 0] - xa, surface.pixels[b, 1] - ya, surface.pixels[b, 2]
    xc, yc, zc = surface.pixels[c, 0] - xa, surface.pixels[c, 1] - ya, surface.pixels[c, 2]
    area = xb * yc - xc * yb
    weight_b, weight_c = ((x - xa) * yc - (y - ya) * xc) / area, ((y - ya) * xb - (x - xa) * yb) / area
    weight_a = 1.0 - weight_b - weight_c
    depth = 1.0 / (weight_a * za + weight_b * zb + weight_c * zc)
    rx = rays[0, 0] * x + rays[1, 0] * y + rays[2, 0]
    ry = rays[0, 1] * x + rays[1, 1] * y + rays[2, 1]
    rz = rays[0, 2] * x + rays[1, 2] * y + rays[2, 2]
    nx = weight_a * surface.normals[a, 0] + weight_b * surface.normals[b, 0] + weight_c * surface.normals[c, 0]
    ny = weight_a * surface.normals[a, 1] + weight_b * surface.normals[b, 1] + weight_c * surface.normals[c, 1]
    nz = weight_a * surface.normals[a, 2] + weight_b * surface.normals[b, 2] + weight_c * surface.normals[c, 2]
    ray, length = np.sqrt(rx * rx + ry * ry + rz * rz), max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-9)
    facing = -(nx * rx + ny * ry + nz * rz) / (ray * length)
    if facing < 0.0:  # a surface seen from behind is lit like one that faces the eye
        facing, length = -facing, -length
    nx, ny, nz = nx / length, ny / length, nz / length
    lx, ly, lz = light.direction[0], light.direction[1], light.direction[2]
    lit, sun = nx * lx + ny * ly + nz * lz, 0.0
    if lit > 0.0:
        # Offset from the surface by two texels, or else it would shade itself in slanted light.
        off = 2.0 * light.texel
        z = eye[2] + depth * rz + off * nz
        slant = z / lz
        sun = sunlit_fraction(
            light, eye[0] + depth * rx + off * nx - lx * slant, eye[1] + depth * ry + off * ny - ly * slant, z
        )
    # Specular reflection: largest if the normal bisects the directions to the sun and the eye.
    hx, hy, hz = lx - rx / ray, ly - ry / ray, lz - rz / ray
    shine = max(nx * hx + ny * hy + nz * hz, 0.0) / max(np.sqrt(hx * hx + hy * hy + hz * hz), 1e-9)
    for _ in range(5):
        shine *= shine
    diffuse = SKY + UP * nz + SUN * max(lit, 0.0) * sun
    gloss = _SHINE * shine * sun + _RIM * (0.6 + 0.4 * nz) * (1.0 - facing) ** 3
    red, green, blue = surface.colors[f, 0], surface.colors[f, 1], surface.colors[f, 2]
    return red * diffuse + gloss, green * diffuse + gloss, blue * diffuse + gloss


@compiled
def paint_faces(
    picture: Any, corner: Any, face_at: Any, parts: int, surface: SurfaceArrays, eye: Any, rays: Any, light: Light
) -> None:
    """Paint faces over a region of an image; pixels at edges are blended with the background.

    Args:
        picture: (H, W, 3) image, uint8.
        corner: row and column of the region's first pixel.
        face_at: (parts R, parts C) face in front at each subpixel, or -1.
        parts: subpixels per pixel along each side.
        surface: faces to paint.
        eye: (3,) position of the eye [m].
        rays: (3, 3) matrix; (column, row, 1) in subpixels times this matrix is the ray with depth 1.
        light: sunlight.
    """
    for i in range(face_at.shape[0] // parts):
        for j in range(face_at.shape[1] // parts):
            red, green, blue, count, last = 0.0, 0.0, 0.0, 0, -1
            color = (0.0, 0.0, 0.0)
            for row in range(i * parts, (i + 1) * parts):
                for column in range(j * parts, (j + 1) * parts):
                    f = face_at[row, column]
                    if f >= 0:
                        # Within a pixel, the color is computed again only for another face, at every other subpixel.
                        if f != last and (count == 0 or (row + column) % 2 == 0):
                            color = _color(column + 0.5, row + 0.5, f, surface, eye, rays, light)
                            last = f
                        red, green, blue, count = red + color[0], green + color[1], blue + color[2], count + 1
            if count > 0:
                coverage = count / (parts * parts)
                for k, total in enumerate((red, green, blue)):
                    behind = picture[corner[0] + i, corner[1] + j, k]
                    own = 255.0 * np.sqrt(min(max(total / count, 0.0), 1.0))
                    picture[corner[0] + i, corner[1] + j, k] = np.uint8(behind + coverage * (own - behind))
