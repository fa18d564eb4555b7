"""Compiled loops of the renderer for uneven ground: colors of its triangles.

The ground has the same squares as flat ground, and dark lines along the edges of steps. It casts no shadow; instead it
is darkened with its depth below the ground slope, and tinted by its height.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.report.drawing.raster import SKY, SUN, UP, Light, compiled, dark_fraction, shadow_fraction

_LINE, _LINE_DARK = 0.015, 0.55
"""Width of the line along the edge of a step [m], and relative reduction of its linear color."""
_DEPTH, _DEPTH_DARK = 0.25, 0.75
"""Depth below the ground slope over which the ground is darkened [m], and the maximum relative reduction."""
_TINT_HEIGHT = 0.3
"""Height at which the tint has half of its maximum strength [m]."""
_HIGH_TINT, _LOW_TINT = (0.0, 0.2, 0.5), (0.4, 0.15, 0.0)
"""Fractions of red, green and blue that the maximum tint removes above, and below, z = 0."""
_WALL = 0.1
"""Vertical component of the unit normal below which a face is a wall, without squares."""


def clip(points: Array, near: float) -> tuple[Array, NDArray[np.int64]]:
    """Clip triangles (T, 3, 3) (x right, y down, depth) at a minimum depth; also return the original index of each."""
    inside = points[..., 2] > near
    count = inside.sum(axis=1)
    pieces, owners = [points[count == 3]], [np.flatnonzero(count == 3)]
    for corners in (1, 2):
        rows = np.flatnonzero(count == corners)
        # Rotate the corners so that the one that is alone on its side comes first.
        single = np.argmax(inside[rows] == (corners == 1), axis=1)
        a, b, c = (points[rows, (single + k) % 3] for k in range(3))
        ab, ac = (a + ((near - a[:, 2]) / (one[:, 2] - a[:, 2]))[:, None] * (one - a) for one in (b, c))
        whole = [(a, ab, ac)] if corners == 1 else [(ab, b, c), (ab, c, ac)]
        pieces += [np.stack(triangle, axis=1) for triangle in whole]
        owners += [rows] * len(whole)
    return np.concatenate(pieces), np.concatenate(owners)


class GroundStyle(NamedTuple):
    """Colors and distances for painting the ground."""

    color: Any
    """Red, green and blue (3,) of a bright square, 0 to 255."""
    haze: Any
    """Red, green and blue (3,) of the haze, 0 to 255."""
    tile: float
    """Side of a square [m]."""
    dark: float
    """Relative reduction of the linear color in a dark square."""
    dim: float
    """Relative reduction of the linear color of level ground in full shadow."""
    far: float
    """Distance from the eye at which squares have faded out [m]."""
    hazy: float
    """Distance over which haze increases [m]."""


class VisibleGround(NamedTuple):
    """Visible part of a ground; see `Ground`."""

    planes: Any
    """Unit normals of faces, and their distances from the eye along the normals [m], (F, 4)."""
    edges: Any
    """Sides of cells at which the ground steps down (X, Y, 2, 2); see `step_edges`."""
    course: Any
    """Heights of the ground slope at the centres of cells (X, Y) [m]."""
    grid: Any
    """Minimum x, minimum y and side of a cell (3,) [m]."""
    shadow_top: Any
    """Height of the shadow caster at each of the light's grid points (H, W) [m]."""
    base: float
    """Reference height of `shadow_top` and of the light's heights [m]."""


def height_tint(z: Any) -> tuple[Any, Any, Any]:
    """Return the factors for red, green and blue of ground at heights z [m]: sand above z = 0, blue below."""
    high, low = np.maximum(z, 0.0), np.maximum(-z, 0.0)
    high, low = high / (high + _TINT_HEIGHT), low / (low + _TINT_HEIGHT)
    return (
        1.0 - _HIGH_TINT[0] * high - _LOW_TINT[0] * low,
        1.0 - _HIGH_TINT[1] * high - _LOW_TINT[1] * low,
        1.0 - _HIGH_TINT[2] * high - _LOW_TINT[2] * low,
    )


_tint = compiled(height_tint)


@compiled
def _line_fraction(x: float, y: float, reach_x: float, reach_y: float, edges: Any, grid: Any) -> float:
    """Return the fraction of a pixel around a position that is on the line along the edge of a step down."""
    place_x, place_y = (x - grid[0]) / grid[2], (y - grid[1]) / grid[2]
    i = min(max(int(np.floor(place_x)), 0), len(edges) - 1)
    j = min(max(int(np.floor(place_y)), 0), edges.shape[1] - 1)
    fraction = 0.0
    for axis in range(2):
        within, reach = (place_y - j, reach_y) if axis else (place_x - i, reach_x)
        for end in range(2):
            if edges[i, j, axis, end]:
                distance = grid[2] * (1.0 - within if end else within)
                on_line = min(distance + 0.5 * reach, _LINE) - max(distance - 0.5 * reach, 0.0)
                fraction = max(fraction, on_line / reach)
    return fraction


@compiled
def _level(x: float, y: float, course: Any, grid: Any) -> float:
    """Return the height of the ground slope at a position, as `Ground.smooth_height` does."""
    place_x = min(max((x - grid[0]) / grid[2] - 0.5, 0.0), len(course) - 1.001)
    place_y = min(max((y - grid[1]) / grid[2] - 0.5, 0.0), course.shape[1] - 1.001)
    i, j = int(place_x), int(place_y)
    u, v = place_x - i, place_y - j
    low = (1.0 - v) * course[i, j] + v * course[i, j + 1]
    return (1.0 - u) * low + u * ((1.0 - v) * course[i + 1, j] + v * course[i + 1, j + 1])


@compiled
def _shade(
    column: float,
    row: float,
    parts: int,
    f: int,
    seen: VisibleGround,
    eye: Any,
    rays: Any,
    light: Light,
    look: GroundStyle,
) -> tuple[float, float, float]:
    """Return the color of the ground, 0 to 255, where the ray through a subpixel meets the plane of a face."""
    rx = rays[0, 0] * column + rays[1, 0] * row + rays[2, 0]
    ry = rays[0, 1] * column + rays[1, 1] * row + rays[2, 1]
    rz = rays[0, 2] * column + rays[1, 2] * row + rays[2, 2]
    px, py, pz = seen.planes[f, 0], seen.planes[f, 1], seen.planes[f, 2]
    facing = px * rx + py * ry + pz * rz
    depth = seen.planes[f, 3] / facing
    x, y, z = eye[0] + depth * rx, eye[1] + depth * ry, eye[2] + depth * rz
    away = -1.0 if facing > 0.0 else 1.0
    nx, ny, nz = away * px, away * py, away * pz
    brightness = 1.0 - 0.5 * look.dark
    distance = depth * np.sqrt(rx * rx + ry * ry + rz * rz)
    if nz > _WALL:
        reach_x = reach_y = 1e-4
        for k in range(2):
            # Distance along the plane between the ray's intersections of neighbouring pixels.
            slant = (px * rays[k, 0] + py * rays[k, 1] + pz * rays[k, 2]) / facing
            reach_x = max(reach_x, abs(parts * depth * (rays[k, 0] - slant * rx)))
            reach_y = max(reach_y, abs(parts * depth * (rays[k, 1] - slant * ry)))
        dark = look.dark * max(1.0 - distance / look.far, 0.0)
        brightness = 1.0 - dark * dark_fraction(x, y, reach_x, reach_y, look.tile)
        brightness *= 1.0 - _LINE_DARK * _line_fraction(x, y, reach_x, reach_y, seen.edges, seen.grid)
    below = _level(x, y, seen.course, seen.grid) - z
    if below > 0.0:
        brightness *= 1.0 - _DEPTH_DARK * (1.0 - np.exp(-below / _DEPTH))
    lx, ly, lz = light.direction[0], light.direction[1], light.direction[2]
    slant = (z - seen.base) / lz
    shadow_x, shadow_y = x - lx * slant, y - ly * slant
    shadow = shadow_fraction(light, shadow_x, shadow_y)
    if shadow > 0.0:
        c, r = int((shadow_x - light.low[0]) / light.texel), int((shadow_y - light.low[1]) / light.texel)
        # Ground above the part of the robot that casts the shadow is not in the shadow.
        shadow *= min(max((seen.shadow_top[r, c] - (z - seen.base)) / 0.02, 0.0), 1.0)
    level_sun = SUN * lz
    bright = SKY + UP + level_sun
    sun = SUN * max(nx * lx + ny * ly + nz * lz, 0.0) * (1.0 - shadow * look.dim * bright / level_sun)
    brightness = np.sqrt(max(brightness * (SKY + UP * nz + sun) / bright, 0.0))
    haze = 1.0 - np.exp(-((distance / look.hazy) ** 1.5))
    tint = _tint(z)
    red, green, blue = (
        brightness * tint[0] * look.color[0],
        brightness * tint[1] * look.color[1],
        brightness * tint[2] * look.color[2],
    )
    return (
        red + haze * (look.haze[0] - red),
        green + haze * (look.haze[1] - green),
        blue + haze * (look.haze[2] - blue),
    )


@compiled
def paint_uneven(
    picture: Any, face_at: Any, parts: int, seen: VisibleGround, eye: Any, rays: Any, light: Light, look: GroundStyle
) -> None:
    """Paint the faces of uneven ground over an image.

    Args:
        picture: (H, W, 3) image, uint8.
        face_at: (parts H, parts W) face in front at each subpixel, or -1.
        parts: subpixels per pixel along each side.
        seen: visible ground.
        eye: (3,) position of the eye [m].
        rays: (3, 3) matrix; (column, row, 1) in subpixels times this matrix is the ray with depth 1.
        light: sunlight.
        look: colors and distances.
    """
    for i in range(len(picture)):
        for j in range(picture.shape[1]):
            red, green, blue, count, last = 0.0, 0.0, 0.0, 0, -1
            color = (0.0, 0.0, 0.0)
            for row in range(i * parts, (i + 1) * parts):
                for column in range(j * parts, (j + 1) * parts):
                    f = face_at[row, column]
                    if f >= 0:
                        if f != last:
                            color = _shade(column + 0.5, row + 0.5, parts, f, seen, eye, rays, light, look)
                            last = f
                        red, green, blue, count = red + color[0], green + color[1], blue + color[2], count + 1
            if count > 0:
                coverage = count / (parts * parts)
                for k, total in enumerate((red, green, blue)):
                    behind = picture[i, j, k]
                    picture[i, j, k] = np.uint8(behind + coverage * (total / count - behind))
