"""Rendering of uneven ground: parts of the ground, clipped triangles, and pixels computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("PIL.Image")
pytest.importorskip("numba")

from surefoot.report.drawing.ground_part import ground_around, step_edges
from surefoot.report.drawing.mesh import Mesh
from surefoot.report.drawing.renderer import Camera, View, draw
from surefoot.report.drawing.uneven_ground import clip, height_tint
from surefoot.robot.appearance import Appearance, triangulate_shape
from surefoot.robot.urdf import Shape
from surefoot.world.ground import FLAT, Ground
from surefoot.world.terrain import make_terrain

BOX = Mesh(Appearance((triangulate_shape(Shape("box", "box", (0.1, 0.1, 0.1), np.eye(4), (230, 30, 30))),)), ["box"])


def step(height: float, axis: int = 1, course: float = 1.0) -> Ground:
    """Return a ground with a step at x = 0 or y = 0, and a ground slope that rises by a fraction of it."""
    corners = np.zeros((4, 4, 2, 2))
    np.moveaxis(corners, axis, 0)[2:] = height
    return Ground(corners, 1.0, smooth_heights=course * corners.mean(axis=(2, 3)))


def picture(ground: Ground, camera: Camera, place: tuple[float, float], box: tuple[float, float, float]) -> np.ndarray:
    """Return the image (200, 200, 3) of a red box on a ground."""
    pose = np.eye(4)
    pose[:3, 3] = box
    return np.asarray(draw(BOX, pose[None], View(camera, place, (200, 200), ground)), float)


def red(pixels: np.ndarray) -> np.ndarray:
    return pixels[..., 0] > 1.8 * pixels[..., 1:].max(axis=-1)


@pytest.mark.parametrize("text", ["stairs:0.10", "slope_down:20", "rough:0.12", "blocks:0.12"])
def test_a_part_has_the_grounds_heights_and_is_extended_beyond_its_border(text: str):
    ground, place = make_terrain(text), np.array([7.0, -3.0])
    part = ground_around(ground, place)
    assert ground_around(ground, place + 0.9) is part
    points = place + np.random.default_rng(1).uniform(-12.0, 12.0, (2000, 2))
    assert (np.abs(points) > 10.0).any()
    np.testing.assert_allclose(part.height(points), ground.height(points), atol=1e-9)
    inside = points[(np.abs(points) < 9.9).all(axis=1)]
    np.testing.assert_allclose(part.smooth_height(inside), ground.smooth_height(inside), atol=1e-9)


def test_fine_cells_of_a_part_are_merged():
    x, y = np.meshgrid(*2 * (0.005 * np.arange(2001) - 5.0,), indexing="ij")
    ground = Ground.from_points(0.1 * x + 0.2 * y, 0.005)
    part = ground_around(ground, np.zeros(2))
    assert part.corners.shape[0] <= 600
    points = np.random.default_rng(1).uniform(-4.8, 4.8, (100, 2))
    np.testing.assert_allclose(part.height(points), ground.height(points), atol=1e-9)


def test_edges_are_where_the_ground_steps_down():
    edges = step_edges(step(0.1, axis=0))
    assert np.argwhere(edges).tolist() == [[2, j, 0, 0] for j in range(4)]
    assert np.argwhere(step_edges(step(-0.1))).tolist() == [[i, 1, 1, 1] for i in range(4)]
    assert not step_edges(step(0.01)).any()


def test_triangles_are_clipped_in_front_of_the_camera():
    corners = np.array([(0.0, 0.0, 3.0), (4.0, 0.0, 3.0), (0.0, 2.0, -1.0)])
    for turned in (corners, corners[[1, 2, 0]], corners[[2, 0, 1]]):
        pieces, owner = clip(turned[None], 1.0)
        assert owner.tolist() == [0, 0]
        assert pieces[..., 2].min() == pytest.approx(1.0)
        # Clipping half way to the corner behind the camera removes a quarter of the area.
        area = np.linalg.norm(np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0]), axis=1).sum()
        assert area == pytest.approx(0.75 * np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])))
    two_behind = corners * [1.0, 1.0, -1.0] + [0.0, 0.0, 2.0]
    (piece,), _ = clip(two_behind[None], 1.0)
    assert piece.tolist() == [[0.0, 2.0, 3.0], [0.0, 1.0, 1.0], [2.0, 1.0, 1.0]]
    assert not len(clip(corners[None] - [0.0, 0.0, 9.0], 1.0)[0])


def test_a_wall_covers_its_pixels_and_hides_the_background():
    # The eye is 1 m above the lower ground and 3 m in front of a 2 m high wall; a pixel on the wall is 3 cm.
    camera, wall = Camera(offset=(0.0, -3.0, 0.0), height=1.0, field_of_view=90.0), step(2.0, course=0.0)
    before, behind = (picture(wall, camera, (0.0, -1e-6), (0.0, side, 0.1)) for side in (-1.0, 1.0))
    assert red(before).any()
    assert not red(behind).any()
    # Squares below have another red, which the tint does not change, and the sky above is blue.
    red_there, _, blue_there = behind[:, 40].T
    rows = np.flatnonzero((np.abs(red_there - red_there[100]) < 2) & (blue_there - red_there < 9))
    assert rows.min() == pytest.approx(100 * (1 - 1 / 3), abs=1)
    assert rows.max() == pytest.approx(100 * (1 + 1 / 3) - 1, abs=1)
    assert len(rows) == np.ptp(rows) + 1


def test_a_robot_on_a_step_is_drawn_higher_with_its_shadow_on_the_step():
    camera = Camera(offset=(0.0, -1.5, 1.0), height=0.1, field_of_view=40.0)
    # In both images the camera is on the upper ground, and the box 1 m from the edge.
    low = picture(step(0.0), camera, (0.0, 1.0), (0.0, 1.0, 0.1))
    high = picture(step(0.3), camera, (0.0, 1.0), (0.0, 1.0, 0.4))
    # Pixels on the box's outline are blended with the ground behind it.
    assert (red(low) != red(high)).sum() < 0.02 * red(low).sum()
    sunk = picture(step(0.3), camera, (0.0, 1.0), (0.0, 1.0, 0.35))
    assert 0 < red(sunk).sum() < red(high).sum()
    aloft = picture(step(0.3), camera, (0.0, 1.0), (0.0, 1.0, 9.0))
    darker = (aloft - high)[..., 0] > 20
    bare, flat = (picture(FLAT, camera, (0.0, 1.0), (0.0, 1.0, z)) for z in (9.0, 0.1))
    shadow, expected = darker & ~red(high), ((bare - flat)[..., 0] > 20) & ~red(flat)
    assert shadow.sum() == pytest.approx(expected.sum(), rel=0.3)
    assert expected.sum() > 100


def test_ground_is_sand_above_zero_and_blue_below():
    assert height_tint(0.0) == (1.0, 1.0, 1.0)
    assert height_tint(0.3) == pytest.approx((1.0, 0.9, 0.75))
    np.testing.assert_allclose(height_tint(np.array([-0.3, 0.9])), [[0.8, 1.0], [0.925, 0.85], [1.0, 0.625]])
    camera = Camera(offset=(0.0, -1.5, 1.0), height=0.1, field_of_view=40.0)
    low, level, high = (picture(step(z), camera, (0.0, 1.0), (0.0, 1.0, 9.0))[100, 100] for z in (-0.3, 0.0, 0.3))
    blue = [one[2] / one[0] for one in (low, level, high)]
    assert blue[0] > 1.2 * blue[1] > 1.3 * blue[2]


def test_squares_agree_with_flat_ground():
    camera = Camera(offset=(0.0, -1.5, 1.0), height=0.1, field_of_view=40.0)
    level = Ground(np.zeros((2, 2, 2, 2)), 1.0, smooth_heights=np.zeros((2, 2)))
    pictures = [picture(ground, camera, (0.3, 0.2), (0.0, 0.0, 0.1)) for ground in (level, FLAT)]
    assert np.abs(pictures[0] - pictures[1])[60:].mean() < 3.0


def test_the_eye_stays_above_a_slope_that_rises_towards_it():
    camera, ground = Camera(), make_terrain("slope:40")
    place = np.array([4.0, 0.0])
    view = View(camera, place, (200, 200), ground)
    assert view.eye[2] > ground.smooth_height(view.eye[:2]) + 0.2
    pixel, depth = view.project(np.array([*place, ground.smooth_height(place) + camera.height]))
    np.testing.assert_allclose(pixel, [100.0, 100.0], atol=1e-6)
    assert depth > 1.0
