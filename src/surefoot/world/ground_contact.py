"""Where a sphere, the end of a foot, is deepest in the ground: exact for slopes, for edges and for walls of steps.

A foot beside a step touches two things: what it stands on, and the wall. So there are two contacts of a sphere: the
deepest one that can carry it, and the deepest one at a wall. The ground is solid downward from its surface; a contact
is where the surface is nearer to the centre of the sphere than around that place. So edges that cells share without a
step or a ridge are no obstacles, whatever the sides of cells.

A sphere whose centre is in the ground has the nearest way out as its contact; beside it, a wall that stands free above
the surface over the centre: the riser before a foot that has sunk into a tread.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from surefoot.arrays import Array
from surefoot.world.contact import WALL_NORMAL_Z

_function = njit(cache=True, error_model="numpy", _nrt=False)
"""As `kernel`, but not inlined: this code is long, and most of it is not run at most steps."""

_EDGE = 1e-9
"""Height [m] by which an edge must stand out to be one."""
_STEP = 1e-6
"""Length [cells] of a step to a side of an edge."""
PARTS = 4
"""Of a sphere around a part of a rod, see `shape_clearance`."""
_WALL_SLOPE = 10.0
"""Slope from which a step down to a side of an edge is a wall."""

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
def triangle_planes(corners: Array, cell: float, middle: Array, points: Array, planes: Array) -> None:
    """Compute height and slope along x and y of the triangles at points.

    Args:
        corners: those of the `Ground`, (X, Y, 2, 2), with cells.
        cell: side of a cell [m].
        middle: of the field (2,) [m].
        points: where (P, 2) [m].
        planes: output (P, 3): [m], then slopes, 0 beyond the field.
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
    """Return the height of the cell that a step from a place (u, v) leads to, after a share `go` of that step.

    Places count cells from the field's corner.
    """
    i = min(max(math.floor(u + step_u), 0), corners.shape[0] - 1)
    j = min(max(math.floor(v + step_v), 0), corners.shape[1] - 1)
    return _cell_height(corners[i, j], _clip(u + go * step_u - i), _clip(v + go * step_v - j))


@_function
def _is_closest_surface(corners: Array, u: float, v: float, z: float, normal: Vector, side: float) -> bool:
    """Return whether the surface around a place (u, v) of an edge at height z is behind the plane with a normal there.

    Around any place it is flat between rays along the sides and diagonals of cells, but for walls. A ray along a wall
    is looked at on both sides.
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
        rise = _height(corners, u, v, _STEP * step_u, _STEP * step_v, 1.0) - z
        along = _STEP * side * (step_u * normal[0] + step_v * normal[1])
        if rise > -_WALL_SLOPE * _STEP * side and rise * normal[2] + along > 1e-3 * _STEP * side:
            return False
    return True


@_function
def _triangle(
    first: float, second: float, third: float, x: float, y: float, z: float, side: float, bound: float
) -> tuple[float, float, float, float, bool]:
    """Return the distance of a point from a triangle, infinite where it is not within the bound.

    And the direction from the triangle's nearest point to it, and whether that is within the triangle, not on its
    border. Within the triangle, the direction is its normal, and the distance negative below it.

    Args:
        first: height over (0, 0) [m].
        second: height over (side, 0) [m].
        third: height over (0, side) [m].
        x: of the point [m].
        y: as x.
        z: as x.
        side: of the triangle [m].
        bound: greatest distance [m] from a triangle that can carry; of others it is not bounded.
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
    # The nearest point of the border: from each corner in turn along the side to the next.
    least, dx, dy, dz = np.inf, 0.0, 0.0, 1.0
    from_x, from_y, from_z = 0.0, 0.0, first
    for corner in range(3):
        to_x, to_y, to_z = 0.0, 0.0, first
        if corner == 0:
            to_x, to_z = side, second
        elif corner == 1:
            to_y, to_z = side, third
        along_x, along_y, along_z = to_x - from_x, to_y - from_y, to_z - from_z
        share = (x - from_x) * along_x + (y - from_y) * along_y + (z - from_z) * along_z
        share = _clip(share / (along_x * along_x + along_y * along_y + along_z * along_z))
        off_x, off_y, off_z = x - from_x - share * along_x, y - from_y - share * along_y, z - from_z - share * along_z
        distance = off_x * off_x + off_y * off_y + off_z * off_z
        if distance < least:
            least, dx, dy, dz = distance, off_x, off_y, off_z
        from_x, from_y, from_z = to_x, to_y, to_z
    least = math.sqrt(least)
    if least < _EDGE:
        return 0.0, -slope_x * upright, -slope_y * upright, upright, True
    return least, dx / least, dy / least, dz / least, False


@_function
def _half_contact(
    cell: Array, low: bool, x: float, y: float, z: float, side: float, bound: float
) -> tuple[float, float, float, float, bool]:
    """Return what `_triangle` does for one of the triangles of a cell.

    Args:
        cell: heights of the corners (2, 2).
        low: the triangle at low x and y, or the other one.
        x: of the point from the cell's corner at low x and y [m].
        y: as x.
        z: as in `_triangle`.
        side: of the cell [m].
        bound: as in `_triangle`.
    """
    # In a frame with its origin below the triangle's right angle, and the other corners over the axes.
    if low:
        return _triangle(cell[0, 0], cell[1, 0], cell[0, 1], x, y, z, side, bound)
    distance, dx, dy, dz, within = _triangle(cell[1, 1], cell[0, 1], cell[1, 0], side - x, side - y, z, side, bound)
    return distance, -dx, -dy, dz, within


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
        # Most often the deepest: what is no nearer is left out soon.
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
            # The cell's place that is nearest from above.
            at_u, at_v = min(max(u, other_i), other_i + 1.0), min(max(v, other_j), other_j + 1.0)
            du, dv = u - at_u, v - at_v
            level = math.sqrt(du * du + dv * dv)
            if level == 0.0:
                # On the cell, or exactly at its border, where a wall faces away from its middle.
                du, dv = u - other_i - 0.5, v - other_j - 0.5
                du, dv = (du, 0.0) if abs(du) > abs(dv) else (0.0, dv)
            if level >= reach:
                continue
            edge = _cell_height(other, at_u - other_i, at_v - other_j)
            if z < edge and (other_i != i or other_j != j):
                length = math.hypot(du, dv)
                du, dv = du / length, dv / length
                beside = _height(corners, at_u, at_v, _STEP * du, _STEP * dv, 0.0)
                if edge > beside + _EDGE and (buried or beside <= z):
                    # Where the centre is below the ground, the nearest part of the wall that stands free is above it.
                    depth = radius - math.hypot(level * side, min(z - beside, 0.0))
                    wall = _deeper(wall, depth, du, dv, 0.0)
                if not buried:
                    continue
            elif buried and level > 0.0 and edge < z and level * side < least:
                # The way out through a wall to a lower cell.
                least, nx, ny, nz = level * side, -du / level, -dv / level, 0.0
            for half in range(2):
                best = np.inf if buried else (radius - max(carrying[0], 0.0)) * (1.0 - _EDGE)
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
    """Return the factor on the coefficient of friction at a place [m].

    Args:
        friction: that of the `Ground`, (P, Q).
        grid: its `patch_grid`.
        x: of the place in the world [m].
        y: as x.
    """
    if friction.shape[0] == 0:
        return 1.0
    i, j = math.floor((x - grid[0]) / grid[2]), math.floor((y - grid[1]) / grid[2])
    return float(friction[min(max(i, 0), friction.shape[0] - 1), min(max(j, 0), friction.shape[1] - 1)])


@_function
def _max_height(points: Array, grid: Array, x: float, y: float, wide: float, deep: float) -> float:
    """Return the greatest height [m] of a continuous ground in a rectangle, or of points just beside it.

    Args:
        points: heights at points (X, Y), a cell apart [m].
        grid: that of the `Ground`.
        x: middle of the rectangle [m].
        y: as x.
        wide: half of its side along x [m].
        deep: half of its side along y [m].
    """
    side, last_i, last_j = grid[2], points.shape[0] - 1, points.shape[1] - 1
    x, y, top = x - grid[0], y - grid[1], -np.inf
    # Beyond the field its border goes on.
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
    """Return the distance of a point over the ground from a cell, or the bound, whichever is less.

    Args:
        points: as in `_max_height`.
        i: number of the cell along x.
        j: number of the cell along y.
        u: of the point along x [cells].
        v: of the point along y [cells].
        z: height of the point [m].
        side: of the cell [m].
        bound: see above [m].
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
    """Return the distance [m] of a point from the ground, 0 below its surface, or the bound, whichever is less.

    Args:
        points: as in `_max_height`.
        grid: as in `_max_height`.
        x: of the point in the world [m].
        y: as x.
        z: as x.
        bound: see above [m].
    """
    side, last_i, last_j = grid[2], points.shape[0] - 2, points.shape[1] - 2
    # Beyond the field its border goes on.
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
    """Return how far [m] a rod or a box is from a continuous ground at least, or 0 if that may be no more than needed.

    It is as far as the bound at most.

    Args:
        points: as in `_max_height`; none of the plane z = 0.
        grid: as in `_max_height`.
        middle: of the shape [m].
        reach: half of the sides of a box along the world's axes around each part of the shape [m].
        offset: from the middle of each part along the shape to that of the next one [m].
        count: of the parts.
        radius: of the rod; of a box, half of the diagonal across it [m].
        is_box: whether it is a box.
        need: see above [m].
        bound: see above [m].
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
    cover, fine = math.sqrt(radius * radius + square), math.sqrt(radius * radius + square / PARTS**2)
    # From the lowest part on.
    for k in range(count):
        share = k - spread
        x, y, z = middle[0] + share * dx, middle[1] + share * dy, middle[2] + share * dz
        if z - reach[2] - top >= least:
            break
        far = -np.inf
        if is_box:
            far = min(least, z - reach[2] - _max_height(points, grid, x, y, reach[0] + least, reach[1] + least))
        if not far > need:
            far = point_clearance(points, grid, x, y, z, least + cover) - cover
        if not is_box and not far > need:
            # Smaller spheres around the parts of this one.
            far = least
            for n in range(PARTS):
                part = (n + 0.5) / PARTS - 0.5
                at_x, at_y, at_z = x + part * dx, y + part * dy, z + part * dz
                far = min(far, point_clearance(points, grid, at_x, at_y, at_z, far + fine) - fine)
                if not far > need:
                    break
        if not far > need:
            return 0.0
        least = min(least, far)
    return least
