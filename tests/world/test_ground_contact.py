"""Contacts of spheres with the ground, compared with the nearest points of triangles, and worked by hand."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.arrays import Array
from surefoot.world.ground import FLAT, Ground
from surefoot.world.ground_contact import (
    WALL_NORMAL_Z,
    friction_factor,
    point_clearance,
    shape_clearance,
    sphere_contacts,
)
from surefoot.world.mujoco_model import body_heights

RADIUS, ERROR = 0.02, 1e-6
CELL, COUNT = 0.05, 4


def level_cells(tops: Array) -> Ground:
    """Return a ground of blocks with level tops at heights (X, Y)."""
    return Ground(np.broadcast_to(tops[..., None, None], (*tops.shape, 2, 2)).copy(), CELL)


def random_ground(kind: str, rng: np.random.Generator) -> Ground:
    """Return a random ground of a few cells with slopes below 50 degrees, except for walls."""
    shape = (COUNT, COUNT)
    if kind == "rough":
        return Ground.from_points(rng.uniform(0.0, 0.03, (COUNT + 1, COUNT + 1)), CELL)
    if kind == "slope":
        x, y = np.meshgrid(*2 * (CELL * np.arange(COUNT + 1),), indexing="ij")
        return Ground.from_points(np.array([x, y]).T @ rng.uniform(-0.7, 0.7, 2), CELL)
    if kind == "blocks":
        return level_cells(rng.choice([0.0, 0.01, 0.03, 0.06], shape))
    if kind == "fine":
        # Cells smaller than the sphere.
        return Ground.from_points(rng.uniform(0.0, 0.006, (17, 17)), 0.0125)
    # Steps of 1 cm or more between sloping tops.
    tops = 0.02 * ((np.arange(COUNT)[:, None] + 2 * np.arange(COUNT)) % 4)
    return Ground(level_cells(tops).corners + rng.uniform(0, 0.01, (*shape, 2, 2)), CELL)


def nearest(triangles: Array, point: Array) -> Array:
    """Return the nearest points (T, 3) of triangles (T, 3, 3) to a point, on their sides or in their interior."""
    starts, sides = triangles, np.roll(triangles, -1, axis=1) - triangles
    shares = np.einsum("tsk,tsk->ts", point - starts, sides) / np.einsum("tsk,tsk->ts", sides, sides)
    places = starts + np.clip(shares, 0.0, 1.0)[..., None] * sides
    normals = np.cross(sides[:, 0], sides[:, 1])
    share = np.einsum("tk,tk->t", point - triangles[:, 0], normals) / np.einsum("tk,tk->t", normals, normals)
    feet = point - share[:, None] * normals
    inward = np.cross(normals[:, None], sides)
    within = (np.einsum("tsk,tsk->ts", feet[:, None] - starts, inward) >= 0).all(axis=1)
    places = np.concatenate([places, np.where(within, feet.T, np.inf).T[:, None]], axis=1)
    return places[np.arange(len(triangles)), np.argmin(np.linalg.norm(places - point, axis=2), axis=1)]


def contacts(ground: Ground, centre: Array) -> tuple[Array, Array]:
    """Return the supporting contact and the wall contact, (4,) each."""
    both = sphere_contacts(ground.corners, ground.grid, *centre.tolist(), RADIUS)
    return np.array(both[0]), np.array(both[1])


def least_distances(ground: Ground, triangles: Array, centre: Array) -> tuple[float, float]:
    """Return the minimum distances to local minima on supporting surfaces and on walls."""
    places = nearest(triangles, centre)
    distance = np.linalg.norm(places - centre, axis=1)
    least = [np.inf, np.inf]
    for k in np.flatnonzero(distance < RADIUS):
        joined = np.linalg.norm(nearest(triangles, places[k]) - places[k], axis=1) < 10 * ERROR
        free = places[k] + 1e-3 * (centre - places[k])
        if distance[k] <= distance[joined].min() + ERROR and ground.height(free[:2]) < free[2]:
            number = int(centre[2] - places[k, 2] < WALL_NORMAL_Z * distance[k])
            least[number] = min(least[number], distance[k])
    return least[0], least[1]


@pytest.mark.parametrize("kind", ["rough", "slope", "blocks", "fine", "steps"])
def test_contacts_are_at_local_minima_of_the_distance(kind: str):
    rng = np.random.default_rng(3)
    for _ in range(100):
        ground = random_ground(kind, rng)
        place = rng.uniform(-0.07, 0.07, 2)
        over = rng.uniform(-RADIUS, 1.1 * RADIUS)
        centre = np.array([*place, ground.height(place) + over])
        triangles = ground.triangles()
        around = triangles - centre
        triangles = triangles[((around.min(axis=1) < 2 * RADIUS) & (around.max(axis=1) > -2 * RADIUS)).all(axis=1)]
        carrying, wall = both = contacts(ground, centre)
        if over < 0:
            # The nearest exit; in addition, a wall may rise freely next to it.
            both = (carrying if carrying[0] > 0 else wall,)
            expected = RADIUS + np.linalg.norm(nearest(triangles, centre) - centre, axis=1).min(keepdims=True)
        else:
            expected = RADIUS - np.array(least_distances(ground, triangles, centre))
        for (depth, *normal), other in zip(both, expected, strict=True):
            assert max(depth, 0.0) == pytest.approx(max(other, 0.0), abs=ERROR), (centre, both, expected)
            assert np.linalg.norm(normal) == pytest.approx(1.0)
            if depth > 0:
                touch = centre - (RADIUS - depth) * np.array(normal)
                assert np.linalg.norm(nearest(triangles, touch) - touch, axis=1).min() < ERROR, (centre, both)


def test_a_step_has_a_top_a_wall_and_an_edge():
    # A step of 6 cm at x = 0; the sphere is 15 mm above the tread, or next to the wall.
    ground = level_cells(np.array([[0.0] * 4] * 2 + [[0.06] * 4] * 2))
    cases = {
        (-0.05, 0.0, 0.015): ([0.005, 0, 0, 1], None),
        (0.05, 0.0, 0.075): ([0.005, 0, 0, 1], None),
        (-0.012, 0.0, 0.04): (None, [0.008, -1, 0, 0]),
        # In the corner: both.
        (-0.012, 0.0, 0.015): ([0.005, 0, 0, 1], [0.008, -1, 0, 0]),
        # At the edge, from above and from the side: 3-4-5 triangles of 3 mm.
        (-0.009, 0.0, 0.072): ([0.005, -0.6, 0, 0.8], None),
        (-0.012, 0.0, 0.069): ([0.005, -0.8, 0, 0.6], None),
        (-0.0144, 0.0, 0.0642): (None, [0.005, -0.96, 0, 0.28]),
        # Above the step, close to its edge: there is no edge contact from above.
        (0.001, 0.0, 0.075): ([0.005, 0, 0, 1], None),
        # Sunk into the tread ahead of the riser by 3 mm: exit through the tread; the riser from its foot up.
        (-0.004, 0.0, -0.003): ([0.023, 0, 0, 1], [0.015, -1, 0, 0]),
        # Behind the wall by 2 mm: exit through the wall.
        (0.002, 0.0, 0.03): (None, [0.022, -1, 0, 0]),
        (-0.05, 0.0, 0.03): (None, None),
    }
    for centre, both in cases.items():
        for contact, expected in zip(contacts(ground, np.array(centre)), both, strict=True):
            if expected is None:
                assert contact[0] <= 0, centre
            else:
                np.testing.assert_allclose(contact, expected, atol=1e-9, err_msg=str(centre))


def test_edges_without_a_step_are_no_obstacles():
    # On a plane, level or sloped, every contact has the plane's normal and depth, at any depth.
    for slope in (np.zeros(2), np.array([0.3, -0.2])):
        at = CELL * np.arange(COUNT + 1) - CELL * COUNT / 2
        ground = Ground.from_points(slope[0] * at[:, None] + slope[1] * at, CELL)
        normal = np.array([*-slope, 1.0]) / np.sqrt(1.0 + slope @ slope)
        for x in np.linspace(-0.06, 0.06, 49):
            for depth in (0.001, 0.015, 0.0199, 0.03):
                centre = np.array([x, 0.4 * x, slope @ [x, 0.4 * x]]) + (RADIUS - depth) * normal
                carrying, wall = contacts(ground, centre)
                np.testing.assert_allclose(carrying, [depth, *normal], atol=1e-9)
                assert wall[0] <= 0


def test_a_sphere_rolls_over_a_ridge_and_over_the_edge_of_a_block_without_a_jump():
    # At a fixed height, the depth is maximal over the top and decreases continuously beyond its edge.
    block = level_cells(np.array([[0.06] * 4] * 2 + [[0.0] * 4] * 2))
    depths = [contacts(block, np.array([x, 0.013, 0.075]))[0][0] for x in np.linspace(-0.02, 0.013, 100)]
    assert depths[0] == pytest.approx(0.005)
    assert (np.diff(depths) <= 1e-12).all()
    assert np.diff(depths).min() > -5e-4


def test_beyond_the_field_its_border_continues_and_the_plane_has_no_wall():
    ground = level_cells(np.full((COUNT, COUNT), 0.03))
    assert contacts(ground, np.array([0.5, 0.0, 0.045]))[0].tolist() == pytest.approx([0.005, 0.0, 0.0, 1.0])
    carrying, wall = contacts(FLAT, np.array([3.0, -1.0, 0.015]))
    assert carrying.tolist() == pytest.approx([0.005, 0.0, 0.0, 1.0])
    assert wall[0] < 0


@pytest.mark.parametrize("kind", ["rough", "slope", "blocks", "fine", "steps"])
def test_a_clearance_is_a_lower_bound_of_the_distance(kind: str):
    rng, bound, radius = np.random.default_rng(4), 0.03, 0.01
    for _ in range(100):
        walls = random_ground(kind, rng)
        heights, cell = body_heights(walls)
        ground, points = Ground.from_points(heights, cell), heights.astype(np.float32)
        triangles = ground.triangles()
        middle = np.array([*rng.uniform(-0.05, 0.05, 2), 0.0])
        middle[2] = ground.height(middle[:2]) + rng.uniform(0.01, 0.08)
        distance = np.linalg.norm(nearest(triangles, middle) - middle, axis=1).min()
        assert point_clearance(points, ground.grid, *middle, bound) == pytest.approx(min(distance, bound), abs=ERROR)
        # A cylinder of four parts contains balls along its axis.
        offset = rng.uniform(-0.01, 0.01, 3)
        half = np.linalg.norm(offset) / 2
        balls = middle + np.linspace(-1, 1, 33)[:, None] * max(4 * half - radius, 0.0) * offset / (2 * half)
        if (ground.height(balls[:, :2]) > balls[:, 2]).any():
            continue
        distance = min(np.linalg.norm(nearest(triangles, one) - one, axis=1).min() for one in balls) - radius
        reach = np.abs(offset) / 2 + radius
        for need in (0.0, 0.005):
            clearance = shape_clearance(
                points, ground.grid, tuple(middle), tuple(reach), tuple(offset), 4, radius, False, need, bound
            )
            assert clearance <= max(min(distance, bound), 0.0) + ERROR
            assert clearance > need or distance <= need + radius
        sides = rng.uniform(0.005, 0.02, 3)
        corners = middle + sides * np.array([[a, b, -1] for a in (-1, 0, 1) for b in (-1, 0, 1)])
        box = (tuple(middle), tuple(sides), (0.0, 0.0, 0.0), 1, float(np.linalg.norm(sides)), True, 0.0, bound)
        over = np.min(corners[:, 2] - ground.height(corners[:, :2]))
        assert shape_clearance(points, ground.grid, *box) <= max(min(over, bound), 0.0) + ERROR


def test_clearances_worked_by_hand():
    plane, middle = (np.zeros((0, 0), np.float32), FLAT.grid), (0.0, 0.0, 0.1)
    upright = ((0.01, 0.01, 0.01), (0.0, 0.0, -0.02), 2, 0.01, False, 0.0)
    assert shape_clearance(*plane, middle, *upright, 0.5) == pytest.approx(0.08)
    assert shape_clearance(*plane, middle, *upright, 0.03) == 0.03
    # A wall of 1 m is a slope from x = 0 to 5 cm. A post of two parts of 10 cm, 1 cm thick, is 4 cm before it, and 4 cm
    # over the ground. Spheres around quarters of the lower part: the lowest is at a height of 5.25 cm.
    ground = level_cells(np.array([[0.0] * 4] * 2 + [[1.0] * 4] * 2))
    heights, cell = body_heights(ground)
    assert cell == CELL
    points, post = heights.astype(np.float32), ((0.01, 0.01, 0.05), (0.0, 0.0, 0.1), 2, 0.01, False)
    expected = (20 * 0.04 + 0.0525) / np.sqrt(401) - np.hypot(0.01, 0.0125)
    for need in (0.01, 0.03):
        clearance = shape_clearance(points, ground.grid, (-0.04, 0.0, 0.14), *post, need, 0.05)
        assert clearance == pytest.approx(expected if expected > need else 0.0, abs=ERROR)


def test_friction_is_that_of_the_nearest_patch():
    ground = Ground(friction=np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]), patch=0.5, center=(1.0, 0.0))
    places = {(0.6, -0.7): 0.1, (0.6, 0.0): 0.2, (1.4, 0.7): 0.6, (-9.0, 0.3): 0.3, (9.0, -9.0): 0.4}
    for place, factor in places.items():
        assert friction_factor(ground.friction, ground.patch_grid, *place) == factor
    assert friction_factor(FLAT.friction, FLAT.patch_grid, 0.0, 0.0) == 1.0
