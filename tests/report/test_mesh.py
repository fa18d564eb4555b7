"""Meshes for rendering: round surfaces are smooth, edges stay sharp, and positions are unchanged."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.report.drawing.mesh import Mesh, link_meshes, smooth
from surefoot.robot.appearance import Appearance, VisualPart, triangulate_shape
from surefoot.robot.urdf import Shape


def part(kind: str, size: tuple[float, ...], link: str = "a", color: tuple[int, int, int] = (255, 0, 0)) -> VisualPart:
    return triangulate_shape(Shape(link, kind, size, np.eye(4), color))


def test_a_box_has_three_normals_at_each_corner():
    box = part("box", (1.0, 2.0, 3.0))
    points, normals, faces = smooth(box.vertices, box.faces)
    assert len(points) == 24
    assert sorted(map(tuple, np.rint(normals).astype(int))) == sorted(
        tuple(sign * np.eye(3, dtype=int)[k]) for k in range(3) for sign in (-1, 1) for _ in range(4)
    )
    np.testing.assert_allclose(points[faces], box.vertices[box.faces])


def test_a_cylinder_is_smooth_around_and_sharp_at_its_ends():
    cylinder = part("cylinder", (0.5, 2.0))
    points, normals, _ = smooth(cylinder.vertices, cylinder.faces)
    assert len(points) == 80  # 20 corners at each end, duplicated for the side and the end face
    side = np.abs(normals[:, 2]) < 0.5
    np.testing.assert_allclose(normals[side], points[side] * [2.0, 2.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(normals[~side], np.sign(points[~side]) * [0.0, 0.0, 1.0], atol=1e-6)


def test_two_triangles_are_smooth_up_to_forty_degrees():
    for degrees, points in ((39.0, 4), (41.0, 6)):
        angle = np.radians(degrees)
        vertices = np.array([(0, 0, 0), (0, 1, 0), (-1, 0, 0), (np.cos(angle), 0, -np.sin(angle))], np.float32)
        assert len(smooth(vertices, np.array([(0, 1, 2), (0, 3, 1)], np.int32))[0]) == points


def test_a_degenerate_triangle_does_not_affect_normals():
    vertices = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0.5, 0, 0)], np.float32)
    points, normals, faces = smooth(vertices, np.array([(0, 1, 2), (0, 1, 3)], np.int32))
    np.testing.assert_allclose(normals[faces[0]], [[0, 0, 1]] * 3)
    assert np.isfinite(points).all()
    assert np.isfinite(normals).all()


def test_parts_of_the_same_link_and_color_are_joined():
    looks = Appearance(
        (
            part("box", (1, 1, 1)),
            part("sphere", (1,), "b"),
            part("box", (2, 2, 2)),
            part("box", (3, 3, 3), "a", (0, 0, 255)),
        )
    )
    meshes = {(link, color): (points, faces) for link, color, points, faces in link_meshes(looks)}
    assert sorted(meshes) == [("a", (0, 0, 255)), ("a", (255, 0, 0)), ("b", (255, 0, 0))]
    points, faces = meshes["a", (255, 0, 0)]
    assert (points.shape, faces.shape) == ((48, 3), (24, 3))
    assert np.abs(points[faces[:12]]).max() == 1
    assert np.abs(points[faces[12:]]).min() == 2


def test_points_and_normals_move_with_their_links():
    mesh = Mesh(Appearance((part("box", (1, 1, 1), "b", (51, 102, 153)),)), ["a", "b"])
    assert mesh.color.tolist() == pytest.approx(np.tile([0.2, 0.4, 0.6], (12, 1)))
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3] = [[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7]]
    points, normals = mesh.place(poses)
    k = int(np.argmax((mesh.points @ [4, 2, 1]) + mesh.normals[:, 0]))  # corner (1, 1, 1) of the face forward
    np.testing.assert_allclose(points[k], [4, 7, 8])
    np.testing.assert_allclose(normals[k], [0, 1, 0])
