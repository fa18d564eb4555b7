"""Where a sphere, the end of a foot, is deepest in the ground: exact for slopes, for edges and for walls of steps.

A foot beside a step touches two things: what it stands on, and the wall. So there are two contacts of a sphere: the
deepest one that can carry it, and the deepest one at a wall. The ground is solid downward from its surface; a contact is
at the point of the surface that is nearest to the centre of the sphere. A neighbouring cell counts where its own surface
is nearest, or where its edge stands out above the cell under the sphere: edges that cells share are no obstacles.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from surefoot.arrays import Array

_function = njit(cache=True, error_model="numpy", _nrt=False)
"""As `kernel`, but not inlined: this code is long, and most of it is not run at most steps."""

STEEP = 0.5
"""Vertical part of a unit normal below which a contact is one at a wall, steeper than 60 degrees."""
_EDGE = 1e-9
"""Height [m] by which an edge must stand out to be one."""

Contact = tuple[float, float, float, float]
"""How deep a sphere is in the ground [m], negative above it, and the unit normal where it is deepest."""

Vector = tuple[float, float, float]

NO_CONTACT = (-1.0, 0.0, 0.0, 1.0)


@_function
def _clip(share: float) -> float:
    """Return a place in a cell, from 0 to 1."""
    return min(max(share, 0.0), 1.0)


@_function
def _cell_height(cell: Array, u: float, v: float) -> float:
    """Return the height of a cell (2, 2) at a place, from 0 to 1 along x and y."""
    if u + v <= 1.0:
        return float(cell[0, 0] + u * (cell[1, 0] - cell[0, 0]) + v * (cell[0, 1] - cell[0, 0]))
    return float(cell[1, 1] + (1.0 - u) * (cell[0, 1] - cell[1, 1]) + (1.0 - v) * (cell[1, 0] - cell[1, 1]))


@_function
def _segment_point(p: Vector, a: Vector, b: Vector) -> tuple[float, Vector]:
    """Return the square of the distance from `p` to a segment, and the nearest point of it."""
    bx, by, bz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    share = ((p[0] - a[0]) * bx + (p[1] - a[1]) * by + (p[2] - a[2]) * bz) / (bx * bx + by * by + bz * bz)
    share = _clip(share)
    x, y, z = a[0] + share * bx, a[1] + share * by, a[2] + share * bz
    return (p[0] - x) ** 2 + (p[1] - y) ** 2 + (p[2] - z) ** 2, (x, y, z)


@_function
def _triangle_point(p: Vector, side: float, heights: Vector) -> tuple[bool, Vector]:
    """Return whether the point of a triangle that is nearest to `p` is inside, not on the border, and that point.

    Args:
        p: a point, in the frame of a triangle whose first corner is above the origin, with the others above the axes x
            and y.
        side: how far away they are.
        heights: of the three corners.
    """
    first, second, third = heights
    slope_x, slope_y = (second - first) / side, (third - first) / side
    over = (p[2] - first - slope_x * p[0] - slope_y * p[1]) / (1.0 + slope_x * slope_x + slope_y * slope_y)
    x, y = p[0] + slope_x * over, p[1] + slope_y * over
    if x > 0.0 and y > 0.0 and x + y < side:
        return True, (x, y, p[2] - over)
    a, b, c = (0.0, 0.0, first), (side, 0.0, second), (0.0, side, third)
    least, nearest = _segment_point(p, a, b)
    distance, point = _segment_point(p, b, c)
    if distance < least:
        least, nearest = distance, point
    distance, point = _segment_point(p, c, a)
    if distance < least:
        least, nearest = distance, point
    return False, nearest


@_function
def _exit(corners: Array, i: int, j: int, u: float, v: float, z: float) -> Contact:
    """Return how far a point inside the cell (i, j) is behind the nearest wall to a lower cell, and the wall's normal.

    The distance counts cells; it is infinite if no wall stands out where the point is.
    """
    nearest, nx, ny = np.inf, 0.0, 0.0
    own = corners[i, j]
    for side in range(4):
        step = 1 - 2 * (side % 2)
        if side < 2:
            other_i, other_j, edge_u, edge_v = i + step, j, 0.5 + 0.5 * step, v
            distance = abs(edge_u - u)
        else:
            other_i, other_j, edge_u, edge_v = i, j + step, u, 0.5 + 0.5 * step
            distance = abs(edge_v - v)
        if not (0 <= other_i < corners.shape[0] and 0 <= other_j < corners.shape[1]):
            continue
        there_u, there_v = (1.0 - edge_u, v) if side < 2 else (u, 1.0 - edge_v)
        beyond = _cell_height(corners[other_i, other_j], there_u, there_v)
        if beyond < z and beyond < _cell_height(own, edge_u, edge_v) - _EDGE and distance < nearest:
            nearest = distance
            nx, ny = (float(step), 0.0) if side < 2 else (0.0, float(step))
    return nearest, nx, ny, 0.0


@_function
def _deeper(contact: Contact, depth: float, x: float, y: float, z: float) -> Contact:
    """Return the deeper one of a contact and another one."""
    return (depth, x, y, z) if depth > contact[0] else contact


@_function
def sphere_contacts(
    corners: Array, grid: Array, x: float, y: float, z: float, radius: float
) -> tuple[Contact, Contact]:
    """Return the deepest contact of a sphere that can carry it, and the deepest one at a wall; see `Contact`.

    Args:
        corners: those of the `Ground`, (X, Y, 2, 2); none of the plane z = 0.
        grid: that of the `Ground`.
        x: centre of the sphere in the world [m].
        y: as x.
        z: as x.
        radius: [m].
    """
    if corners.shape[0] == 0:
        return (radius - z, 0.0, 0.0, 1.0), NO_CONTACT
    cell = grid[2]
    u, v = (x - grid[0]) / cell, (y - grid[1]) / cell
    columns, rows = corners.shape[0], corners.shape[1]
    i, j = min(max(int(math.floor(u)), 0), columns - 1), min(max(int(math.floor(v)), 0), rows - 1)
    u, v = u - i, v - j
    own = corners[i, j]
    if not (0.0 <= u <= 1.0 and 0.0 <= v <= 1.0):
        height = _cell_height(own, _clip(u), _clip(v))
        return (radius - z + height, 0.0, 0.0, 1.0), NO_CONTACT
    near = u + v <= 1.0
    sign = 1.0 if near else -1.0
    first = own[0, 0] if near else own[1, 1]
    slope_x = sign * ((own[1, 0] if near else own[0, 1]) - first) / cell
    slope_y = sign * ((own[0, 1] if near else own[1, 0]) - first) / cell
    above = z - _cell_height(own, u, v)
    upright = 1.0 / math.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
    carrying, wall = NO_CONTACT, NO_CONTACT
    leaves = False
    if above * upright < radius:
        depth = radius - above * upright
        if above < 0.0:
            out, nx, ny, _ = _exit(corners, i, j, u, v, z)
            if out * cell < -above * upright:
                leaves = True
                wall = (radius + out * cell, nx, ny, 0.0)
        if not leaves:
            if upright >= STEEP:
                carrying = (depth, -slope_x * upright, -slope_y * upright, upright)
            else:
                wall = (depth, -slope_x * upright, -slope_y * upright, upright)
    reach = radius / cell
    if u > reach and v > reach and 1.0 - u > reach and 1.0 - v > reach and _is_level(own):
        return carrying, wall
    for other_i in range(max(i + int(math.floor(u - reach)), 0), min(i + int(math.floor(u + reach)), columns - 1) + 1):
        for other_j in range(max(j + int(math.floor(v - reach)), 0), min(j + int(math.floor(v + reach)), rows - 1) + 1):
            other = corners[other_i, other_j]
            if max(other[0, 0], other[0, 1], other[1, 0], other[1, 1]) <= z - radius:
                continue
            # Place of the other cell that is nearest from above, its height there, and that of the cell under the sphere.
            at_u, at_v = min(max(u + i - other_i, 0.0), 1.0), min(max(v + j - other_j, 0.0), 1.0)
            edge = _cell_height(other, at_u, at_v)
            if z < edge:
                beside = _cell_height(own, _clip(at_u + other_i - i), _clip(at_v + other_j - j))
                if edge > beside + _EDGE and not leaves:
                    dx, dy = (u + i - other_i - at_u) * cell, (v + j - other_j - at_v) * cell
                    flat = math.hypot(dx, dy)
                    if flat > 0.0:
                        # A sphere whose centre is below the ground touches the wall where that stands free.
                        depth = radius - math.hypot(flat, min(z - beside, 0.0))
                        wall = _deeper(wall, depth, dx / flat, dy / flat, 0.0)
                continue
            for part in range(2):
                low = part == 0
                if other_i == i and other_j == j and (low == near or _is_level(own)):
                    continue
                turn = 1.0 if low else -1.0
                corner_x = grid[0] + cell * (other_i if low else other_i + 1)
                corner_y = grid[1] + cell * (other_j if low else other_j + 1)
                heights = (other[0, 0], other[1, 0], other[0, 1])
                if not low:
                    heights = (other[1, 1], other[0, 1], other[1, 0])
                inside, point = _triangle_point((turn * (x - corner_x), turn * (y - corner_y), z), cell, heights)
                place_x, place_y = corner_x + turn * point[0], corner_y + turn * point[1]
                if not (inside or leaves):
                    place_u, place_v = (place_x - grid[0]) / cell - i, (place_y - grid[1]) / cell - j
                    if point[2] <= _cell_height(own, _clip(place_u), _clip(place_v)) + _EDGE:
                        continue
                dx, dy, dz = x - place_x, y - place_y, z - point[2]
                distance = math.sqrt(dx * dx + dy * dy + dz * dz)
                if 0.0 < distance < radius:
                    nx, ny, nz = dx / distance, dy / distance, dz / distance
                    if nz >= STEEP:
                        carrying = _deeper(carrying, radius - distance, nx, ny, nz)
                    elif not leaves and nz >= 0.0:
                        wall = _deeper(wall, radius - distance, nx, ny, nz)
    return carrying, wall


@_function
def highest(corners: Array, grid: Array, x: float, y: float, reach_x: float, reach_y: float) -> float:
    """Return the greatest height [m] of the cells that a rectangle around (x, y) touches."""
    if corners.shape[0] == 0:
        return 0.0
    cell, columns, rows = grid[2], corners.shape[0], corners.shape[1]
    top = -np.inf
    first_i = min(max(int(math.floor((x - reach_x - grid[0]) / cell)), 0), columns - 1)
    last_i = min(max(int(math.floor((x + reach_x - grid[0]) / cell)), 0), columns - 1)
    first_j = min(max(int(math.floor((y - reach_y - grid[1]) / cell)), 0), rows - 1)
    last_j = min(max(int(math.floor((y + reach_y - grid[1]) / cell)), 0), rows - 1)
    for i in range(first_i, last_i + 1):
        for j in range(first_j, last_j + 1):
            for k in range(4):
                top = max(top, corners[i, j, k // 2, k % 2])
    return top


@_function
def _is_level(cell: Array) -> bool:
    """Return whether all four corners of a cell have the same height."""
    return bool(cell[0, 0] == cell[0, 1] == cell[1, 0] == cell[1, 1])
