"""Contacts of spheres (feet) and distances of other shapes from the ground, exact for slopes, edges and walls.

A foot next to a step touches both the tread and the wall. Hence a sphere has up to two contacts: the deepest supporting
contact, and the deepest wall contact. The ground is solid below its surface. A contact is a point of the surface that
is a local minimum of the distance to the centre of the sphere, so edges between cells without a step or ridge are no
obstacles, for any size of cells.

If the centre of a sphere is below the surface, its contact is at the nearest exit point. In addition, it can touch a
wall that rises above the surface over the centre, such as the riser ahead of a foot that has sunk into a tread.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from surefoot.arrays import Array
from surefoot.world.contact import WALL_NORMAL_Z

_function = njit(cache=True, error_model="numpy", _nrt=False)
"""Decorator like `kernel`, but without inlining: this code is long, and most steps execute little of it."""

_MIN_EDGE_HEIGHT = 1e-9
"""Minimum height [m] by which an edge must stand out."""
_PROBE_STEP = 1e-6
"""Distance [cells] at which the ground next to an edge is sampled."""
SUBSPHERES = 4
"""Number of smaller spheres that replace the bounding sphere of a part of a rod, see `shape_clearance`."""
_WALL_SLOPE = 10.0
"""Downward slope next to an edge above which it is a wall."""

Contact = tuple[float, float, float, float]
"""Penetration depth of a sphere [m], negative above the ground, and unit normal at the deepest point."""

Vector = tuple[float, float, float]

NO_CONTACT = (-1.0, 0.0, 0.0, 1.0)


@_function
def _clip(value: float) -> float:
    """Clip a cell coordinate to 0 to 1."""
    return min(max(value, 0.0), 1.0)


@_function
def _cell_height(cell: Array, u: float, v: float) -> float:
    """Return the height of a cell with corner heights (2, 2) at coordinates u, v from 0 to 1 along x and y."""
    if u + v <= 1.0:
        return float(cell[0, 0] + u * (cell[1, 0] - cell[0, 0]) + v * (cell[0, 1] - cell[0, 0]))
    return float(cell[1, 1] + (1.0 - u) * (cell[0, 1] - cell[1, 1]) + (1.0 - v) * (cell[1, 0] - cell[1, 1]))


@_function
def triangle_planes(corners: Array, cell: float, middle: Array, points: Array, planes: Array) -> None:
    """Compute height and slopes of the triangles at points.

    Args:
        corners: corners of the `Ground` (X, Y, 2, 2), not empty.
        cell: side length of a cell [m].
        middle: centre of the field (2,) [m].
        points: points (P, 2) [m].
        planes: output (P, 3): height [m], and slopes along x and y, which are 0 beyond the field.
    """
    count_x, count_y = corners.shape[:2]
    for k in range(len(points)):
        u, v = (points[k, 0] - middle[0]) / cell + count_x / 2, (points[k, 1] - middle[1]) / cell + count_y / 2
        i, j = min(max(math.floor(u), 0), count_x - 1), min(max(math.floor(v), 0), count_y - 1)
        own, along, across = corners[i, j], _clip(u - i), _clip(v - j)
        near = along + across <= 1.0
        planes[k, 0] = _cell_height(own, along, across)
        planes[k, 1] = (own[1, 0] - own[0, 0] if near else own[1, 1] - own[0, 1]) / cell * (0.0 <= u <= count_x)
        planes[k, 2] = (own[0, 1] - own[0, 0] if near else own[1, 1] - own[1, 0]) / cell * (0.0 <= v <= count_y)


@_function
def _height(corners: Array, u: float, v: float, step_u: float, step_v: float, go: float) -> float:
    """Return the height of the cell at (u + step_u, v + step_v), evaluated after a fraction `go` of the step.

    Coordinates are in cells from the field's corner.
    """
    i = min(max(math.floor(u + step_u), 0), corners.shape[0] - 1)
    j = min(max(math.floor(v + step_v), 0), corners.shape[1] - 1)
    return _cell_height(corners[i, j], _clip(u + go * step_u - i), _clip(v + go * step_v - j))


@_function
def _is_closest_surface(corners: Array, u: float, v: float, z: float, normal: Vector, side: float) -> bool:
    """Return whether the surface around a point (u, v) of an edge at height z is below the plane with a normal there.

    Around any point, the surface is flat between rays along the sides and diagonals of cells, except for walls. Rays
    along the sides are therefore sampled on both sides.
    """
    for ray in range(10):
        step_u, step_v = 0.0, 0.0
        sign, across = 1.0 - 2.0 * (ray % 2), 0.01 - 0.02 * (ray // 2 % 2)
        if ray < 4:
            step_u, step_v = sign, across
        elif ray < 8:
            step_u, step_v = across, sign
        else:
            step_u, step_v = sign, -sign
        rise = _height(corners, u, v, _PROBE_STEP * step_u, _PROBE_STEP * step_v, 1.0) - z
        along = _PROBE_STEP * side * (step_u * normal[0] + step_v * normal[1])
        if rise > -_WALL_SLOPE * _PROBE_STEP * side and rise * normal[2] + along > 1e-3 * _PROBE_STEP * side:
            return False
    return True


@_function
def _triangle(
    first: float, second: float, third: float, x: float, y: float, z: float, side: float, bound: float
) -> tuple[float, float, float, float, bool]:
    """Return distance and direction from the nearest point of a triangle to a point.

    The triangle has a right angle at (0, 0) and corners at (side, 0) and (0, side).

    Args:
        first: height at (0, 0) [m].
        second: height at (side, 0) [m].
        third: height at (0, side) [m].
        x: coordinate of the point [m].
        y: coordinate of the point [m].
        z: coordinate of the point [m].
        side: side length of the triangle [m].
        bound: maximum distance of interest [m]; applies only to triangles that are not as steep as walls.

    Returns:
        Distance [m], infinite beyond the bound; unit direction (3 numbers); and whether the nearest point is in the
        interior of the triangle. In the interior, the direction is the normal, and the distance is negative below.
    """
    slope_x, slope_y = (second - first) / side, (third - first) / side
    square = 1.0 + slope_x * slope_x + slope_y * slope_y
    over = z - first - slope_x * x - slope_y * y
    if over > 0.0 and over * over >= bound * bound * square and square * WALL_NORMAL_Z * WALL_NORMAL_Z <= 1.0:
        return np.inf, 0.0, 0.0, 1.0, False
    at_x, at_y = x + slope_x * over / square, y + slope_y * over / square
    upright = 1.0 / math.sqrt(square)
    if at_x > 0.0 and at_y > 0.0 and at_x + at_y < side:
        return over * upright, -slope_x * upright, -slope_y * upright, upright, True
    # The nearest point of the border, edge by edge.
    least, dx, dy, dz = np.inf, 0.0, 0.0, 1.0
    from_x, from_y, from_z = 0.0, 0.0, first
    for corner in range(3):
        to_x, to_y, to_z = 0.0, 0.0, first
        if corner == 0:
            to_x, to_z = side, second
        elif corner == 1:
            to_y, to_z = side, third
        along_x, along_y, along_z = to_x - from_x, to_y - from_y, to_z - from_z
        fraction = (x - from_x) * along_x + (y - from_y) * along_y + (z - from_z) * along_z
        fraction = _clip(fraction / (along_x * along_x + along_y * along_y + along_z * along_z))
        off_x, off_y, off_z = (
            x - from_x - fraction * along_x,
            y - from_y - fraction * along_y,
            z - from_z - fraction * along_z,
        )
        distance = off_x * off_x + off_y * off_y + off_z * off_z
        if distance < least:
            least, dx, dy, dz = distance, off_x, off_y, off_z
        from_x, from_y, from_z = to_x, to_y, to_z
    least = math.sqrt(least)
    if least < _MIN_EDGE_HEIGHT:
        return 0.0, -slope_x * upright, -slope_y * upright, upright, True
    return least, dx / least, dy / least, dz / least, False


@_function
def _half_contact(
    cell: Array, low: bool, x: float, y: float, z: float, side: float, bound: float
) -> tuple[float, float, float, float, bool]:
    """Return the result of `_triangle` for one of the two triangles of a cell.

    Args:
        cell: heights of the corners (2, 2) [m].
        low: whether to use the triangle at low x and y, or the other one.
        x: coordinate of the point, relative to the corner at low x and y [m].
        y: coordinate of the point, relative to the corner at low x and y [m].
        z: coordinate of the point [m].
        side: side length of the cell [m].
        bound: see `_triangle`.
    """
    # In a frame with its origin at the right angle and the other corners along the axes.
    if low:
        return _triangle(cell[0, 0], cell[1, 0], cell[0, 1], x, y, z, side, bound)
    distance, dx, dy, dz, within = _triangle(cell[1, 1], cell[0, 1], cell[1, 0], side - x, side - y, z, side, bound)
    return distance, -dx, -dy, dz, within


@_function
def _deeper(contact: Contact, depth: float, x: float, y: float, z: float) -> Contact:
    """Return the deeper of two contacts."""
    return (depth, x, y, z) if depth > contact[0] else contact


@_function
def sphere_contacts(
    corners: Array, grid: Array, x: float, y: float, z: float, radius: float
) -> tuple[Contact, Contact]:
    """Return the deepest supporting contact and the deepest wall contact of a sphere; see `Contact`.

    Args:
        corners: corners of the `Ground` (X, Y, 2, 2), empty for the plane z = 0.
        grid: grid of the `Ground`.
        x: coordinate of the centre in the world [m].
        y: coordinate of the centre in the world [m].
        z: coordinate of the centre in the world [m].
        radius: radius of the sphere [m].
    """
    if corners.shape[0] == 0:
        return (radius - z, 0.0, 0.0, 1.0), NO_CONTACT
    side = grid[2]
    u, v, reach = (x - grid[0]) / side, (y - grid[1]) / side, radius / side
    last_i, last_j = corners.shape[0] - 1, corners.shape[1] - 1
    i, j = min(max(math.floor(u), 0), last_i), min(max(math.floor(v), 0), last_j)
    height = _cell_height(corners[i, j], _clip(u - i), _clip(v - j))
    if not (0.0 <= u <= last_i + 1 and 0.0 <= v <= last_j + 1):
        return (radius - z + height, 0.0, 0.0, 1.0), NO_CONTACT
    buried = z < height
    carrying, wall = NO_CONTACT, NO_CONTACT
    least, nx, ny, nz = np.inf, 0.0, 0.0, 1.0
    if not buried:
        # Start with the triangle below the centre, usually the deepest contact, so that others are skipped early.
        distance, ex, ey, ez, within = _half_contact(
            corners[i, j], u - i + v - j <= 1.0, (u - i) * side, (v - j) * side, z, side, radius
        )
        if within and ez >= WALL_NORMAL_Z:
            carrying = _deeper(carrying, radius - distance, ex, ey, ez)
    for other_i in range(max(math.floor(u - reach), 0), min(math.floor(u + reach), last_i) + 1):
        for other_j in range(max(math.floor(v - reach), 0), min(math.floor(v + reach), last_j) + 1):
            other = corners[other_i, other_j]
            if not buried and z - radius >= max(max(other[0, 0], other[0, 1]), max(other[1, 0], other[1, 1])):
                continue
            # The nearest point of the cell in plan view.
            at_u, at_v = min(max(u, other_i), other_i + 1.0), min(max(v, other_j), other_j + 1.0)
            du, dv = u - at_u, v - at_v
            level = math.sqrt(du * du + dv * dv)
            if level == 0.0:
                # The centre is over the cell, or exactly at its border, where a wall faces away from the cell's middle.
                du, dv = u - other_i - 0.5, v - other_j - 0.5
                du, dv = (du, 0.0) if abs(du) > abs(dv) else (0.0, dv)
            if level >= reach:
                continue
            edge = _cell_height(other, at_u - other_i, at_v - other_j)
            if z < edge and (other_i != i or other_j != j):
                length = math.hypot(du, dv)
                du, dv = du / length, dv / length
                beside = _height(corners, at_u, at_v, _PROBE_STEP * du, _PROBE_STEP * dv, 0.0)
                if edge > beside + _MIN_EDGE_HEIGHT and (buried or beside <= z):
                    # If the centre is below the neighbouring ground, the nearest free part of the wall is above it.
                    depth = radius - math.hypot(level * side, min(z - beside, 0.0))
                    wall = _deeper(wall, depth, du, dv, 0.0)
                if not buried:
                    continue
            elif buried and level > 0.0 and edge < z and level * side < least:
                # Exit through a wall to a lower cell.
                least, nx, ny, nz = level * side, -du / level, -dv / level, 0.0
            for half in range(2):
                best = np.inf if buried else (radius - max(carrying[0], 0.0)) * (1.0 - _MIN_EDGE_HEIGHT)
                distance, ex, ey, ez, within = _half_contact(
                    other, half == 0, (u - other_i) * side, (v - other_j) * side, z, side, best
                )
                if buried:
                    if within and distance <= 0.0 and -distance < least:
                        least, nx, ny, nz = -distance, ex, ey, ez
                    elif not within and distance < least:
                        least, nx, ny, nz = distance, -ex, -ey, -ez
                elif distance < radius:
                    place_u, place_v = u - distance * ex / side, v - distance * ey / side
                    if within or _is_closest_surface(corners, place_u, place_v, z - distance * ez, (ex, ey, ez), side):
                        if ez >= WALL_NORMAL_Z:
                            carrying = _deeper(carrying, radius - distance, ex, ey, ez)
                        else:
                            wall = _deeper(wall, radius - distance, ex, ey, ez)
    if buried:
        if nz < WALL_NORMAL_Z:
            return NO_CONTACT, (radius + least, nx, ny, nz)
        carrying = (radius + least, nx, ny, nz)
    return carrying, wall


@_function
def friction_factor(friction: Array, grid: Array, x: float, y: float) -> float:
    """Return the factor on the friction coefficient at a point.

    Args:
        friction: factors of the `Ground` (P, Q).
        grid: `patch_grid` of the `Ground`.
        x: coordinate of the point in the world [m].
        y: coordinate of the point in the world [m].
    """
    if friction.shape[0] == 0:
        return 1.0
    i, j = math.floor((x - grid[0]) / grid[2]), math.floor((y - grid[1]) / grid[2])
    return float(friction[min(max(i, 0), friction.shape[0] - 1), min(max(j, 0), friction.shape[1] - 1)])


@_function
def _max_height(points: Array, grid: Array, x: float, y: float, wide: float, deep: float) -> float:
    """Return the maximum height [m] of the points in a rectangle of a continuous ground, and next to it.

    Args:
        points: heights at grid points (X, Y), one cell apart [m].
        grid: grid of the `Ground`.
        x: centre of the rectangle [m].
        y: centre of the rectangle [m].
        wide: half its side along x [m].
        deep: half its side along y [m].
    """
    side, last_i, last_j = grid[2], points.shape[0] - 1, points.shape[1] - 1
    x, y, top = x - grid[0], y - grid[1], -np.inf
    # Heights of the border continue beyond the field.
    first_j = min(max(math.floor((y - deep) / side), 0), last_j)
    end_j = min(max(math.ceil((y + deep) / side), 0), last_j) + 1
    for i in range(
        min(max(math.floor((x - wide) / side), 0), last_i), min(max(math.ceil((x + wide) / side), 0), last_i) + 1
    ):
        for j in range(first_j, end_j):
            top = max(top, float(points[i, j]))
    return top


@_function
def _cell_distance(points: Array, i: int, j: int, u: float, v: float, z: float, side: float, bound: float) -> float:
    """Return the distance of a point above the ground from a cell, at most `bound`.

    Args:
        points: heights at grid points, see `_max_height`.
        i: index of the cell along x.
        j: index of the cell along y.
        u: coordinate of the point along x [cells].
        v: coordinate of the point along y [cells].
        z: height of the point [m].
        side: side length of the cell [m].
        bound: upper bound of the result [m].
    """
    first, second = float(points[i, j]), float(points[i + 1, j])
    third, fourth = float(points[i, j + 1]), float(points[i + 1, j + 1])
    top = max(max(first, second), max(third, fourth))
    du, dv, over = max(max(i - u, u - i - 1.0), 0.0), max(max(j - v, v - j - 1.0), 0.0), max(z - top, 0.0)
    square = (du * du + dv * dv) * side * side + over * over
    if square >= bound * bound:
        return bound
    if first == second == third == fourth:
        return math.sqrt(square)
    x, y = (u - i) * side, (v - j) * side
    bound = min(bound, abs(_triangle(first, second, third, x, y, z, side, bound)[0]))
    return min(bound, abs(_triangle(fourth, third, second, side - x, side - y, z, side, bound)[0]))


@_function
def point_clearance(points: Array, grid: Array, x: float, y: float, z: float, bound: float) -> float:
    """Return the distance [m] of a point from the ground, 0 below its surface, at most `bound`.

    Args:
        points: heights at grid points, see `_max_height`.
        grid: grid of the `Ground`.
        x: coordinate of the point in the world [m].
        y: coordinate of the point in the world [m].
        z: coordinate of the point in the world [m].
        bound: upper bound of the result [m].
    """
    side, last_i, last_j = grid[2], points.shape[0] - 2, points.shape[1] - 2
    # Heights of the border continue beyond the field.
    u, v = min(max((x - grid[0]) / side, 0.0), last_i + 1.0), min(max((y - grid[1]) / side, 0.0), last_j + 1.0)
    i, j = min(max(math.floor(u), 0), last_i), min(max(math.floor(v), 0), last_j)
    first, second = float(points[i, j]), float(points[i + 1, j])
    third, fourth = float(points[i, j + 1]), float(points[i + 1, j + 1])
    if u - i + v - j <= 1.0:
        height = first + (u - i) * (second - first) + (v - j) * (third - first)
    else:
        height = fourth + (i + 1.0 - u) * (third - fourth) + (j + 1.0 - v) * (second - fourth)
    if z <= height:
        return 0.0
    least = _cell_distance(points, i, j, u, v, z, side, bound)
    reach = least / side
    for other_i in range(max(math.floor(u - reach), 0), min(math.floor(u + reach), last_i) + 1):
        for other_j in range(max(math.floor(v - reach), 0), min(math.floor(v + reach), last_j) + 1):
            if other_i != i or other_j != j:
                least = _cell_distance(points, other_i, other_j, u, v, z, side, least)
    return least


@_function
def shape_clearance(
    points: Array,
    grid: Array,
    middle: Vector,
    reach: Vector,
    offset: Vector,
    count: int,
    radius: float,
    is_box: bool,
    need: float,
    bound: float,
) -> float:
    """Return a lower bound of the distance [m] between a rod or box and a continuous ground.

    The result is at most `bound`, and 0 if the distance may be less than `need`. The shape is divided along its axis
    into parts with bounding boxes and bounding spheres.

    Args:
        points: heights at grid points, see `_max_height`; empty for the plane z = 0.
        grid: grid of the `Ground`.
        middle: centre of the shape [m].
        reach: half sides of the axis-aligned bounding box of each part [m].
        offset: vector from the centre of each part to the centre of the next [m].
        count: number of parts.
        radius: radius of the rod, or half the diagonal across a box [m].
        is_box: whether the shape is a box.
        need: required distance [m].
        bound: upper bound of the result [m].
    """
    spread = 0.5 * (count - 1)
    dx, dy, dz = offset
    if dz < 0.0:
        dx, dy, dz = -dx, -dy, -dz
    lowest = middle[2] - spread * dz - reach[2]
    if points.shape[0] == 0:
        return min(lowest, bound)
    wide, deep = reach[0] + spread * abs(dx) + bound, reach[1] + spread * abs(dy) + bound
    top = _max_height(points, grid, middle[0], middle[1], wide, deep)
    if lowest - top >= bound:
        return bound
    least, square = bound, 0.25 * (dx * dx + dy * dy + dz * dz)
    cover, fine = math.sqrt(radius * radius + square), math.sqrt(radius * radius + square / SUBSPHERES**2)
    # From the lowest part up.
    for k in range(count):
        index = k - spread
        x, y, z = middle[0] + index * dx, middle[1] + index * dy, middle[2] + index * dz
        if z - reach[2] - top >= least:
            break
        far = -np.inf
        if is_box:
            far = min(least, z - reach[2] - _max_height(points, grid, x, y, reach[0] + least, reach[1] + least))
        if not far > need:
            far = point_clearance(points, grid, x, y, z, least + cover) - cover
        if not is_box and not far > need:
            # Refine the bounding sphere of this part by smaller spheres.
            far = least
            for n in range(SUBSPHERES):
                part = (n + 0.5) / SUBSPHERES - 0.5
                at_x, at_y, at_z = x + part * dx, y + part * dy, z + part * dz
                far = min(far, point_clearance(points, grid, at_x, at_y, at_z, far + fine) - fine)
                if not far > need:
                    break
        if not far > need:
            return 0.0
        least = min(least, far)
    return least
