"""Compiled loops of the renderer for a ground that is not flat: what colors its triangles.

Squares of the flat ground's size lie on it; edges of steps have dark lines. It has no shadow of its own: instead it is
darker the further it is below its course, and tinted by its height.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.report.drawing.raster import SKY, SUN, UP, Light, compiled, dark_fraction, shadow_fraction

_LINE, _LINE_DARK = 0.015, 0.55
"""Width [m] of the line along the edge of a step, and how much darker it is, as a share."""
_DEPTH, _DEPTH_DARK = 0.25, 0.75
"""Depth below the course [m] over which the ground grows darker, and how much darker it becomes, as a share."""
_TINT_HEIGHT = 0.3
"""Height [m] at which the tint is half as strong as it becomes."""
_HIGH_TINT, _LOW_TINT = (0.0, 0.2, 0.5), (0.4, 0.15, 0.0)
"""Fractions of red, green and blue that the strongest tint takes from what is above, and below, z = 0."""
_WALL = 0.1
"""Vertical part of the unit normal below which a face is a wall, without squares."""


def clip(points: Array, near: float) -> tuple[Array, NDArray[np.int64]]:
    """Return triangles (T, 3, 3), x right, y down and depth, without what is nearer; and which one each is of."""
    inside = points[..., 2] > near
    count = inside.sum(axis=1)
    pieces, owners = [points[count == 3]], [np.flatnonzero(count == 3)]
    for corners in (1, 2):
        rows = np.flatnonzero(count == corners)
        # The corner that is alone on its side comes first.
        alone = np.argmax(inside[rows] == (corners == 1), axis=1)
        a, b, c = (points[rows, (alone + k) % 3] for k in range(3))
        ab, ac = (a + ((near - a[:, 2]) / (one[:, 2] - a[:, 2]))[:, None] * (one - a) for one in (b, c))
        whole = [(a, ab, ac)] if corners == 1 else [(ab, b, c), (ab, c, ac)]
        pieces += [np.stack(triangle, axis=1) for triangle in whole]
        owners += [rows] * len(whole)
    return np.concatenate(pieces), np.concatenate(owners)


class GroundStyle(NamedTuple):
    """What the ground looks like."""

    color: Any
    """Red, green and blue (3,) of a bright square, 0 to 255."""
    haze: Any
    """Those of the haze (3,)."""
    tile: float
    """Side of a square [m]."""
    dark: float
    """How much darker a dark square is, as a share of its linear color."""
    dim: float
    """How much darker level ground is in full shadow, as a share."""
    far: float
    """Distance from the eye at which squares have faded out [m]."""
    hazy: float
    """Distance over which haze grows [m]."""


class VisibleGround(NamedTuple):
    """What there is of a ground in a picture; see `Ground`."""

    planes: Any
    """Unit normals of faces, and how far they are from the eye along them [m], (F, 4)."""
    edges: Any
    """Sides of cells at which it steps down (X, Y, 2, 2); see `step_edges`."""
    course: Any
    """Heights of the course at their middles (X, Y) [m]."""
    grid: Any
    """Low x, low y and side of a cell [m], (3,)."""
    shadow_top: Any
    """Height of what casts the shadow at each of the light's places (H, W) [m]."""
    base: float
    """Height from which the light counts heights [m]."""


def height_tint(z: Any) -> tuple[Any, Any, Any]:
    """Return the factors on red, green and blue of the ground at heights z [m]: sand above z = 0, blue below it."""
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
    """Return the share of a pixel around a place that is on the line along the edge of a step down."""
    place_x, place_y = (x - grid[0]) / grid[2], (y - grid[1]) / grid[2]
    i = min(max(int(np.floor(place_x)), 0), len(edges) - 1)
    j = min(max(int(np.floor(place_y)), 0), edges.shape[1] - 1)
    share = 0.0
    for axis in range(2):
        within, reach = (place_y - j, reach_y) if axis else (place_x - i, reach_x)
        for end in range(2):
            if edges[i, j, axis, end]:
                distance = grid[2] * (1.0 - within if end else within)
                on_line = min(distance + 0.5 * reach, _LINE) - max(distance - 0.5 * reach, 0.0)
                share = max(share, on_line / reach)
    return share


@compiled
def _level(x: float, y: float, course: Any, grid: Any) -> float:
    """Return the height of the course at a place, as `Ground.level` does."""
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
    """Return the color of the ground, 0 to 255, where the ray through a part of a pixel meets a face's plane."""
    rx = rays[0, 0] * column + rays[1, 0] * row + rays[2, 0]
    ry = rays[0, 1] * column + rays[1, 1] * row + rays[2, 1]
    rz = rays[0, 2] * column + rays[1, 2] * row + rays[2, 2]
    px, py, pz = seen.planes[f, 0], seen.planes[f, 1], seen.planes[f, 2]
    facing = px * rx + py * ry + pz * rz
    depth = seen.planes[f, 3] / facing
    x, y, z = eye[0] + depth * rx, eye[1] + depth * ry, eye[2] + depth * rz
    away = -1.0 if facing > 0.0 else 1.0
    nx, ny, nz = away * px, away * py, away * pz
    share = 1.0 - 0.5 * look.dark
    distance = depth * np.sqrt(rx * rx + ry * ry + rz * rz)
    if nz > _WALL:
        reach_x = reach_y = 1e-4
        for k in range(2):
            # How far the ray's place moves along the plane from one pixel to the next.
            slant = (px * rays[k, 0] + py * rays[k, 1] + pz * rays[k, 2]) / facing
            reach_x = max(reach_x, abs(parts * depth * (rays[k, 0] - slant * rx)))
            reach_y = max(reach_y, abs(parts * depth * (rays[k, 1] - slant * ry)))
        dark = look.dark * max(1.0 - distance / look.far, 0.0)
        share = 1.0 - dark * dark_fraction(x, y, reach_x, reach_y, look.tile)
        share *= 1.0 - _LINE_DARK * _line_fraction(x, y, reach_x, reach_y, seen.edges, seen.grid)
    below = _level(x, y, seen.course, seen.grid) - z
    if below > 0.0:
        share *= 1.0 - _DEPTH_DARK * (1.0 - np.exp(-below / _DEPTH))
    lx, ly, lz = light.direction[0], light.direction[1], light.direction[2]
    slant = (z - seen.base) / lz
    shadow_x, shadow_y = x - lx * slant, y - ly * slant
    shadow = shadow_fraction(light, shadow_x, shadow_y)
    if shadow > 0.0:
        c, r = int((shadow_x - light.low[0]) / light.texel), int((shadow_y - light.low[1]) / light.texel)
        # What is above the parts of the robot that are in the light's way there is not in their shadow.
        shadow *= min(max((seen.shadow_top[r, c] - (z - seen.base)) / 0.02, 0.0), 1.0)
    level_sun = SUN * lz
    bright = SKY + UP + level_sun
    sun = SUN * max(nx * lx + ny * ly + nz * lz, 0.0) * (1.0 - shadow * look.dim * bright / level_sun)
    share = np.sqrt(max(share * (SKY + UP * nz + sun) / bright, 0.0))
    haze = 1.0 - np.exp(-((distance / look.hazy) ** 1.5))
    tint = _tint(z)
    red, green, blue = share * tint[0] * look.color[0], share * tint[1] * look.color[1], share * tint[2] * look.color[2]
    return (
        red + haze * (look.haze[0] - red),
        green + haze * (look.haze[1] - green),
        blue + haze * (look.haze[2] - blue),
    )


@compiled
def paint_uneven(
    picture: Any, face_at: Any, parts: int, seen: VisibleGround, eye: Any, rays: Any, light: Light, look: GroundStyle
) -> None:
    """Paint the faces of a ground over a picture.

    Args:
        picture: (H, W, 3) uint8.
        face_at: (parts H, parts W) face in front at each part of a pixel; -1 for none.
        parts: of a pixel along each side.
        seen: the ground.
        eye: (3,) m.
        rays: (3, 3); column and row in parts, and 1, times this is the ray with a depth of 1.
        light: the sun.
        look: colors.
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
                share = count / (parts * parts)
                for k, total in enumerate((red, green, blue)):
                    behind = picture[i, j, k]
                    picture[i, j, k] = np.uint8(behind + share * (total / count - behind))
