"""Model (GLB) of uneven ground for the 3D views of pages: its surface with a checker pattern, and its walls."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from surefoot.report.drawing.ground_part import faces, step_edges
from surefoot.report.drawing.uneven_ground import height_tint
from surefoot.world.ground import Ground

_TILE = 0.25
"""Side of a square of the checker pattern [m]."""
_SQUARES, _EDGE, _WALL = ((150, 156, 160), (122, 128, 132)), (60, 66, 72), (104, 110, 115)
"""Colors of squares, of lines along the edges of steps, and of walls; they appear brighter in the light of the view."""
_EDGE_WIDTH = 0.03
"""Width of lines along edges [m]."""
_DEPTH, _DEPTH_DARK = 0.25, 0.5
"""Depth below the ground slope over which the ground is darkened [m], and the maximum relative reduction."""
_PIXELS = 2048
"""Size of the surface's texture along each side [px]."""
_WALL_PIXELS = 256
"""Height of the walls' texture [px]."""


@functools.lru_cache(maxsize=4)
def ground_model(part: Ground) -> bytes:
    """Return the model of a ground, in the world frame."""
    triangles, normals = faces(part)
    is_wall = np.abs(normals[:, 2]) < 1e-6
    sides = part.cell * np.array(part.corners.shape[:2])
    low, high = float(part.corners.min()), float(part.corners.max())
    scene = trimesh.Scene()
    textures: list[tuple[str, Any, Image.Image]] = [
        ("surface", ~is_wall, _surface_texture(part)),
        ("walls", is_wall, _wall_texture(low, high)),
    ]
    for name, rows, texture in textures:
        if not rows.any():
            continue
        corners = triangles[rows].reshape(-1, 3)
        # Merge coincident corners, because the viewer computes normals from shared points.
        _, first, index = np.unique(np.round(corners, 6), axis=0, return_index=True, return_inverse=True)
        points = corners[first]
        material = PBRMaterial(metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True, baseColorTexture=texture)
        uv = (points[:, :2] - part.grid[:2]) / sides
        if name == "walls":
            uv = np.column_stack([np.full(len(points), 0.5), (points[:, 2] - low) / (high - low)])
        visual = TextureVisuals(uv=uv, material=material)
        scene.add_geometry(trimesh.Trimesh(points, index.reshape(-1, 3), visual=visual, process=False), geom_name=name)
    return bytes(scene.export(file_type="glb"))


def _wall_texture(low: float, high: float) -> Image.Image:
    """Return the texture of walls between two heights [m], with `high` at the top."""
    tint = np.stack(height_tint(np.linspace(high, low, _WALL_PIXELS)), axis=-1)
    return Image.fromarray((tint[:, None] * _WALL).repeat(2, axis=1).astype(np.uint8))


def _surface_texture(part: Ground) -> Image.Image:
    """Return the texture of a ground from above (x right, y up): squares, and lines along edges."""
    at = (np.arange(_PIXELS) + 0.5) * part.cell * len(part.corners) / _PIXELS
    x, y = (np.floor((at + low) / _TILE).astype(int) for low in part.grid[:2])
    picture = np.array(_SQUARES, np.uint8)[(x[:, None] + y) % 2]
    cell, within = np.divmod(at / part.cell, 1.0)
    index, width, edges = cell.astype(int), _EDGE_WIDTH / part.cell, step_edges(part)
    for end, near in enumerate((within < width, within > 1.0 - width)):
        picture[edges[index][:, index, 0, end] & near[:, None]] = _EDGE
        picture[edges[index][:, index, 1, end] & near] = _EDGE
    below = np.maximum(part.smooth_heights - part.corners.mean(axis=(2, 3)), 0.0)
    bright = 1.0 - _DEPTH_DARK * (1.0 - np.exp(-below / _DEPTH))
    tint = np.stack(height_tint(part.corners.mean(axis=(2, 3))), axis=-1) * bright[..., None]
    picture = (picture * tint[index][:, index]).astype(np.uint8)
    return Image.fromarray(picture.transpose(1, 0, 2)[::-1])
