"""Rasterization, light and ground, compared with values computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("numba")

from surefoot.report.drawing.raster import Light, SurfaceArrays, paint_faces, paint_ground, rasterize, sunlit_fraction


def fill(points: list[tuple[float, float, float]], faces: list[tuple[int, int, int]]) -> tuple[np.ndarray, np.ndarray]:
    """Return the face in front (6, 8), and its proximity."""
    nearest, face_at = np.zeros((6, 8), np.float32), np.full((6, 8), -1, np.int32)
    rasterize(np.array(points, np.float32), np.array(faces, np.int32), nearest, face_at)
    return face_at, nearest


def light(occluder: np.ndarray, shadow: float = 0.0, direction: tuple[float, float, float] = (0, 0, 1)) -> Light:
    """Return a sun whose grid has a spacing of 1 and starts at the origin."""
    occluder = np.asarray(occluder, np.float32)
    dark = np.full(occluder.shape, shadow, np.float32)
    return Light(np.array(direction, np.float32), occluder, dark, np.zeros(2, np.float32), 1.0)


def test_a_triangle_covers_the_pixels_whose_centres_are_inside():
    for order in ((0, 1, 2), (2, 1, 0)):
        face_at, nearest = fill([(1.0, 1.0, 0.5), (5.0, 1.0, 0.5), (1.0, 5.1, 0.5)], [order])
        rows = ["".join("." if face < 0 else "#" for face in row) for row in face_at]
        assert rows == ["........", ".####...", ".###....", ".##.....", ".#......", "........"]
        assert nearest[1, 1] == pytest.approx(0.5)


def test_nearer_faces_hide_others_in_any_order():
    points = [(0, 0, 0.2), (8, 0, 0.2), (0, 6, 0.2), (8, 6, 0.2), (0, 0, 0.1), (8, 0, 0.3), (0, 6, 0.1), (8, 6, 0.3)]
    flat, slanted = [(0, 1, 2), (1, 3, 2)], [(4, 5, 6), (5, 7, 6)]
    face_at, nearest = fill(points, flat + slanted)
    # The slanted square is in front for 0.1 + 0.2 x / 8 > 0.2, in the right half.
    assert (face_at[:, :4] < 2).all()
    assert (face_at[:, 4:] >= 2).all()
    np.testing.assert_allclose(nearest[2], np.maximum(0.2, 0.1 + 0.2 * (np.arange(8) + 0.5) / 8), rtol=1e-5)
    other, _ = fill(points, slanted + flat)
    assert ((other < 2) == (face_at >= 2)).all()


def test_neighbours_share_an_edge_without_gaps():
    points = [(0, 0, 1.0), (8, 0, 1.0), (8, 6, 1.0), (0, 6, 1.0), (3.3, 2.7, 1.0)]
    face_at, _ = fill(points, [(0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)])
    assert set(face_at.flat) == {0, 1, 2, 3}


def test_faces_behind_the_camera_outside_or_without_area_draw_nothing():
    points = [(0, 0, 0.0), (8, 0, 1.0), (0, 6, 1.0), (-9, -9, 1.0), (-1, -9, 1.0), (-9, -1, 1.0)]
    face_at, nearest = fill(points, [(0, 1, 2), (3, 4, 5), (1, 1, 2)])
    assert (face_at == -1).all()
    assert (nearest == 0.0).all()


def test_light_is_blocked_by_objects_above_a_point():
    heights = np.zeros((8, 8))
    heights[:, 4:] = 0.5
    sun = light(heights)
    assert sunlit_fraction(sun, 2.0, 4.0, 0.1) == 1.0
    assert sunlit_fraction(sun, 6.0, 4.0, 0.1) == 0.0
    assert sunlit_fraction(sun, 6.0, 4.0, 0.6) == 1.0  # on top of it
    assert sunlit_fraction(sun, 4.0, 4.0, 0.1) == pytest.approx(0.5)  # at the edge
    assert sunlit_fraction(sun, 90.0, 4.0, 0.0) == 1.0


def test_squares_of_the_ground_alternate_and_fade_to_their_mean():
    picture = np.zeros((2, 4, 3), np.uint8)
    ground = np.zeros((1, 4, 8), np.float32)
    ground[0, :, 0], ground[0, :, 1] = [0.5, 1.5, 2.5, 2.5], 0.5
    ground[0, :, 2:4], ground[0, 3, 2] = 0.01, 2.0  # the last pixel covers a bright and a dark square
    ground[..., 4:7], ground[..., 7] = 200.0, 0.36
    paint_ground(picture, ground, np.zeros(3, np.float32), 1.0, light(np.zeros((2, 2))), 0.5)
    assert (picture[0] == 0).all()
    dark, mean = 200 * np.sqrt(1 - 0.36), 200 * np.sqrt(1 - 0.18)
    np.testing.assert_allclose(picture[1, :, 0], [dark, 200, dark, mean], atol=1.0)


def test_shadow_darkens_the_ground_by_its_darkness():
    picture = np.zeros((1, 1, 3), np.uint8)
    ground = np.array([[[4.0, 4.0, 0.1, 0.1, 200.0, 200.0, 200.0, 0.0]]], np.float32)
    paint_ground(picture, ground, np.zeros(3, np.float32), 1.0, light(np.zeros((8, 8)), shadow=0.5), 0.72)
    assert picture[0, 0, 0] == int(200 * np.sqrt(1 - 0.36))


def painted(normal: tuple[float, float, float], occluder: float, behind: int = 200) -> np.ndarray:
    """Return two pixels, one fully and one half covered by a grey surface seen from above, 1 m away."""
    picture = np.full((1, 2, 3), behind, np.uint8)
    corners = np.array([(0, 0, 1), (30, 0, 1), (0, 30, 1)], np.float32)
    surface = SurfaceArrays(
        corners, np.array([normal] * 3, np.float32), np.array([(0, 1, 2)], np.int32), np.full((1, 3), 0.25, np.float32)
    )
    face_at = np.array([[0, 0, 0, -1], [0, 0, 0, -1]], np.int32)
    eye, rays = np.array([4.0, 4.0, 2.0], np.float32), np.array([(0, 0, 0), (0, 0, 0), (0, 0, -1)], np.float32)
    paint_faces(picture, np.zeros(2, np.int64), face_at, 2, surface, eye, rays, light(np.full((8, 8), occluder)))
    return picture[0, :, 0].astype(float)


def test_surfaces_are_lit_by_sky_and_sun_and_mixed_at_edges():
    # Towards the sun: 0.34 + 0.16 + 0.72 of the color, plus a reflection of 0.22; no reflection of the sky.
    whole, half = painted((0, 0, 1), occluder=0.0)
    assert whole == pytest.approx(255 * np.sqrt(0.25 * 1.22 + 0.22), abs=1.0)
    assert half == pytest.approx((whole + 200) / 2, abs=1.0)
    in_shadow, _ = painted((0, 0, 1), occluder=9.0)
    assert in_shadow == pytest.approx(255 * np.sqrt(0.25 * 0.5), abs=1.0)
    # A surface seen from behind is lit like one that faces the eye.
    assert painted((0, 0, -1), occluder=0.0)[0] == whole
