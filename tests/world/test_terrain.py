"""Kinds of terrain, height maps and fields, at points worked by hand."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.npz import write_npz
from surefoot.world.ground import FLAT
from surefoot.world.terrain import KINDS, make_field, make_terrain


def heights(ground, *points) -> list[float]:
    return ground.height(np.array(points, float)).round(6).tolist()


def test_stairs_are_rings_of_treads_around_a_level_area():
    stairs = make_terrain("stairs:0.10")
    assert heights(stairs, (0.9, -0.9), (1.05, 0.0), (1.25, 0.5), (1.35, 0.0), (-1.35, 0.2), (0.0, 3.95)) == [
        *(0.0, 0.1, 0.1, 0.2, 0.2, 1.0)
    ]
    # The smoothed ground passes through the middles of the treads, at 18.4 degrees.
    assert stairs.smooth_height(np.array([[1.15, 0.0], [2.35, 0.0], [0.0, 0.0]])).round(3).tolist() == [0.1, 0.5, 0.0]
    roll, pitch = stairs.tilt(np.array([3.0, 0.0]), np.array(0.0))
    assert (float(roll), float(pitch)) == pytest.approx((0.0, -np.arctan2(0.1, 0.3)))
    down = make_terrain("stairs_down:0.10")
    np.testing.assert_array_equal(down.corners, -stairs.corners)


def test_a_slope_has_its_angle_in_every_direction():
    slope = make_terrain("slope:20")
    for point, normal in (((3.5, 0.2), (-1, 0)), ((0.2, -3.5), (0, 1))):
        np.testing.assert_allclose(
            slope.normal(np.array(point))[:2], np.sin(np.radians(20)) * np.array(normal), atol=1e-9
        )
    # Heading left where the ground rises along the world's x axis: the right side is higher.
    roll, pitch = slope.tilt(np.array([3.5, 0.0]), np.array(np.pi / 2))
    assert (float(roll), float(pitch)) == pytest.approx((-np.radians(20), 0.0), abs=1e-6)


@pytest.mark.parametrize("kind", ["rough", "blocks"])
def test_rough_ground_and_blocks_fill_their_range_around_a_level_area(kind):
    ground = make_terrain(f"{kind}:0.12", seed=3)
    assert np.ptp(ground.corners) == pytest.approx(0.12, rel=0.02)
    assert not ground.height(np.random.default_rng(0).uniform(-0.9, 0.9, (50, 2))).any()
    assert ground.smooth_height(np.array([5.0, 5.0])) == pytest.approx(
        0.5 * (ground.corners.max() + ground.corners.min()), abs=2e-3
    )
    np.testing.assert_array_equal(ground.corners, make_terrain(f"{kind}:0.12", seed=3).corners)
    assert (ground.corners != make_terrain(f"{kind}:0.12", seed=4).corners).any()


def test_gaps_and_stones_have_their_widths():
    gaps, x = make_terrain("gaps:0.25"), np.arange(1.0, 4.0, 0.05) + 0.025
    deep = gaps.height(np.stack([x, np.zeros_like(x)], axis=-1)) < 0
    assert "".join("_" if one else "#" for one in deep).startswith("_____############_____############_____")
    stones = make_terrain("stones:0.25")
    deep = stones.height(np.stack([x, np.zeros_like(x)], axis=-1)) < 0
    assert set(map(len, "".join("_" if one else "#" for one in deep).strip("_").split("__")[1:-1])) == {5}
    # Gaps are twice as deep as wide, up to 1 m; the depth between stones depends on the square of their side.
    for text, depth in (
        *(("gaps:0.1", 0.2), ("gaps:0.6", 1.0)),
        *(("stones:0.25", 1.0), ("stones:0.2", 1.0), ("stones:0.5", 0.25)),
    ):
        assert make_terrain(text).corners.min() == pytest.approx(-depth)


def test_surface_of_triangles_has_the_heights_of_the_ground():
    for text in ("blocks:0.10", "slope:15", "rough:0.10"):
        ground = make_terrain(text)
        triangles = ground.triangles()
        normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        top = triangles[np.abs(normal[:, 2]) > 1e-12]
        assert (np.cross(top[:, 1] - top[:, 0], top[:, 2] - top[:, 0])[:, 2] > 0).all()
        area = 0.5 * np.abs(np.cross(top[:, 1] - top[:, 0], top[:, 2] - top[:, 0])[:, 2]).sum()
        assert area == pytest.approx(400.0)
        np.testing.assert_allclose(top[:, :, 2].mean(axis=1), ground.height(top[:, :, :2].mean(axis=1)), atol=1e-9)


def test_tiles_of_a_field_become_more_difficult_and_have_level_borders():
    sizes = {"stairs": (0.02, 0.12), "slope_down": (5.0, 25.0), "rough": (0.02, 0.10)}
    field = make_field(sizes, {"stairs": 2.0}, 3, 4, 8.0, 0)
    assert field.kinds == ("stairs", "stairs", "slope_down", "rough")
    assert field.starts[2, 3].tolist() == [16.0, 24.0]
    # Robots start 10 steps below the border of stairs, and 3 m of slope above it.
    np.testing.assert_allclose(field.ground.height(field.starts)[:, 0], [-0.2, -0.7, -1.2])
    np.testing.assert_allclose(field.ground.height(field.starts)[:, 2], 3 * np.tan(np.radians([5, 15, 25])))
    border = np.stack([np.linspace(-3.9, 19.9, 50), np.full(50, 12.0 - 1e-6)], axis=-1)
    np.testing.assert_allclose(field.ground.height(border), 0.0, atol=1e-5)


def test_a_map_has_height_0_in_its_middle_and_continues_at_its_border(tmp_path):
    points = 0.1 * np.arange(41)[:, None] * np.ones(21)
    write_npz(tmp_path / "hill.npz", {"heights": np.round(points * 0.2, 9), "cell": 0.1}, {})
    hill = make_terrain(str(tmp_path / "hill.npz"))
    # 4 m by 2 m, with a slope of 0.2, and 0 in the middle.
    assert heights(hill, (0.0, 0.0), (1.0, 0.5), (-2.0, 0.0), (3.0, 9.0)) == [0.0, 0.2, -0.4, 0.4]
    assert hill.smooth_height(np.array([1.0, 0.0])) == pytest.approx(0.2, abs=0.01)


def test_the_top_of_an_image_is_ahead_in_the_map(tmp_path):
    image = pytest.importorskip("PIL.Image")
    grey = np.zeros((81, 61), np.uint16)
    grey[:20, :] = 50  # ahead
    grey[:, :10] += 30  # left
    image.fromarray(grey).save(tmp_path / "map.png")
    ground = make_terrain(str(tmp_path / "map.png"))
    assert heights(ground, (0.0, 0.0), (1.5, 0.0), (0.0, 1.3), (-1.5, -1.3)) == [0.0, 0.05, 0.03, 0.0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stair:0.1", "terrain 'stair' does not exist; did you mean stairs"),
        ("stairs", "it must be flat, KIND:SIZE with one of stairs, "),
        ("stairs:high", "the size must be a number"),
        ("stairs:2", r"size is 2 m; it must be 0.01 to 0.4"),
        ("slope:nan", "size is nan deg"),
        ("gaps:0.23", "it must be a multiple of 0.05"),
        ("nowhere.npz", "nowhere.npz: can't be read"),
        ("nowhere.png", "nowhere.png: can't be read"),
    ],
)
def test_a_terrain_that_does_not_exist_is_rejected_in_one_line(text, message):
    with pytest.raises(SurefootError, match=message) as error:
        make_terrain(text)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"heights": np.zeros((3, 3))}, "cell is missing"),
        ({"heights": np.zeros(9), "cell": 0.1}, r"the shape \(9,\)"),
        ({"heights": np.full((9, 9), np.nan), "cell": 0.1}, "must be finite"),
        ({"heights": np.zeros((9, 9)), "cell": 2.0}, "cell is 2 m; it must be 0.005 to 0.5"),
        ({"heights": np.zeros((9, 9)), "cell": "x"}, "must be numbers"),
        ({"heights": np.zeros((2001, 2000)), "cell": 0.1}, "4000000 in all"),
        ({"heights": np.diag(np.ones(21)), "cell": 0.1}, "m off a plane within 0.5 m of the middle"),
    ],
)
def test_an_unsuitable_map_is_rejected(tmp_path, arrays, message):
    write_npz(tmp_path / "map.npz", arrays, {})
    with pytest.raises(SurefootError, match=message):
        make_terrain(str(tmp_path / "map.npz"))


def test_every_kind_has_its_minimum_and_maximum_size():
    for name, kind in KINDS.items():
        for size in kind.range:
            assert np.isfinite(make_terrain(f"{name}:{size:g}").corners).all()
    assert make_terrain("flat") is FLAT


@pytest.mark.filterwarnings("error")
def test_an_image_with_too_many_pixels_is_rejected_without_a_warning_of_pil(tmp_path):
    """PIL warns above 90 million pixels, before other output."""
    path = tmp_path / "map.png"
    chunk = b"IHDR" + struct.pack(">IIBBBBB", 10_000, 10_000, 8, 0, 0, 0, 0)
    data = [b"\x89PNG\r\n\x1a\n", struct.pack(">I", 13), chunk, struct.pack(">I", zlib.crc32(chunk))]
    data += [struct.pack(">I", 0), b"IDAT", struct.pack(">I", zlib.crc32(b"IDAT"))]
    path.write_bytes(b"".join(data))
    with pytest.raises(SurefootError, match=r"map\.png: it has 10000 x 10000 pixels"):
        make_terrain(str(path))
