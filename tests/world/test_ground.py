"""Heights, normals and smoothed heights of grounds, at points worked by hand."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.world.ground import FLAT, Ground, uneven_floor

POINTS = np.array([[0.0, 0.0], [3.0, -1.0]])


def test_flat_ground_is_the_plane_at_zero():
    assert FLAT.height(POINTS).tolist() == FLAT.smooth_height(POINTS).tolist() == [0.0, 0.0]
    assert FLAT.normal(POINTS).tolist() == [[0.0, 0.0, 1.0]] * 2


def test_a_ramp_has_its_slope_and_its_border_continues():
    # Heights 0.25 x at x from -1 to 1, around (2, 0).
    ramp = Ground.from_points(0.25 * np.arange(-2, 3)[:, None] * np.ones(5), cell=1.0, center=(2.0, 0.0))
    points = np.array([[2.0, 0.3], [3.5, 1.9], [1.25, -1.0], [9.0, 0.0], [2.0, -2.5]])
    np.testing.assert_allclose(ramp.height(points), [0.0, 0.375, -0.1875, 0.5, 0.0])
    # Smoothed heights are given at the cell centres.
    np.testing.assert_allclose(ramp.smooth_height(points), [0.0, 0.375, -0.1875, 0.375, 0.0])
    normal = np.array([-0.25, 0.0, 1.0]) / np.hypot(0.25, 1.0)
    np.testing.assert_allclose(ramp.normal(points), [*[normal] * 3, [0.0, 0.0, 1.0], normal])


def test_a_cell_has_two_triangles():
    corner = Ground.from_points(np.array([[0.0, 0.0], [0.0, 1.0]]), cell=1.0, center=(0.5, 0.5))
    points = np.array([[0.25, 0.25], [0.5, 0.5], [0.75, 0.75], [1.0, 1.0]])
    np.testing.assert_allclose(corner.height(points), [0.0, 0.0, 0.5, 1.0])


def test_an_uneven_floor_is_rough_around_level_ground_and_flat_at_the_start():
    floor = uneven_floor(0.002)
    x, y = np.meshgrid(0.1 * np.arange(10, 60) + 0.05, 0.1 * np.arange(-58, -8) + 0.05)
    points = np.stack([x, y], -1)
    assert floor.height(points).std() == pytest.approx(0.002, rel=0.1)
    assert not floor.smooth_height(points).any()
    assert not floor.height(np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2))).any()
    np.testing.assert_array_equal(floor.corners, uneven_floor(0.002).corners)
    assert uneven_floor(0.0) is FLAT


def test_bullet_has_the_same_heights_under_each_foot(make_world):
    pybullet = pytest.importorskip("pybullet")
    (model,) = make_world(1, engine="bullet", floor_unevenness=0.004).engine.models
    for x, y in np.random.default_rng(1).uniform([-3.9, -5.9], [23.8, 5.9], (20, 2)):
        pybullet.resetBasePositionAndOrientation(model.body, [x, y, 0.3], [0, 0, 0, 1], model.client)
        model.place_planes()
        feet = model.foot_positions()[:, :2]
        for foot, plane in zip(feet, model.planes, strict=True):
            (*_, height), quat = pybullet.getBasePositionAndOrientation(plane, model.client)
            normal = np.array(pybullet.getMatrixFromQuaternion(quat))[2::3]
            floor = uneven_floor(0.004)
            np.testing.assert_allclose(normal, floor.normal(foot), atol=1e-9)
            assert height - normal[:2] @ foot / normal[2] == pytest.approx(floor.height(foot), abs=1e-9)
