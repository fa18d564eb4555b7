"""Detection of the feet of an imported robot: position and rolling radius."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np
from mujoco import mjtGeom
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.robot.importing.foot_sphere import fit_sphere, sole_sphere
from surefoot.robot.importing.shapes import BodyShapes

_FOOT_NAMES = re.compile(r"foot|toe|tip|sole|ankle", re.IGNORECASE)
_SPHERE_SOURCE = "the last link's sphere"
_MIN_FOOT_DISTANCE = 0.9
"""Minimum distance from the knee that a sphere must reach to be the foot, relative to the last link's farthest
point."""
_MIN_NAMED_DISTANCE = 1.02
"""Distance from the knee beyond which a link named as a foot has no shape, relative to the farthest point of shapes."""
_MIN_SOLE_DISTANCE = 0.95
"""Minimum distance of sole points from the knee, relative to the farthest point."""


class Foot(NamedTuple):
    """A sphere that approximates a foot."""

    centre: Array
    radius: float
    source: str
    """Description of how the foot was detected."""


def find_foot(shapes: BodyShapes, body: int, knee: Array) -> Foot | None:
    """Detect the foot of a leg: a sphere of the last link, else a sphere fitted to its shapes, else a guess.

    The end of the leg is at a link with the name of a foot, else at the point of the last link that is farthest from
    the knee. Return None if there is neither a shape nor such a link.

    Args:
        shapes: shapes of the robot.
        body: last body of the leg that a joint moves.
        knee: position (3,) of the knee.
    """
    model, data, geoms = shapes.model, shapes.data, shapes.geom_ids(body)
    points = shapes.surface_points(geoms) if geoms.size else shapes.visual_points(body)
    away = np.linalg.norm(points - knee, axis=1)
    reach = away.max(initial=0.0)
    spheres = geoms[model.geom_type[geoms] == mjtGeom.mjGEOM_SPHERE]
    if spheres.size:
        distances = np.linalg.norm(data.geom_xpos[spheres] - knee, axis=1)
        last = spheres[np.argmax(distances)]
        if distances.max() + model.geom_size[last, 0] >= _MIN_FOOT_DISTANCE * reach:  # else it is no foot
            return Foot(data.geom_xpos[last], float(model.geom_size[last, 0]), _SPHERE_SOURCE)
    named = [b for b in np.flatnonzero(shapes.group == body) if _FOOT_NAMES.search(model.body(int(b)).name)]
    if not len(points) and not named:
        return None
    if not len(points) or (named and np.linalg.norm(data.xpos[named[-1]] - knee) > _MIN_NAMED_DISTANCE * reach):
        end = data.xpos[named[-1]].copy()
        return Foot(end, _thickness(shapes, geoms, end, knee), "a link with the name of a foot")
    end = data.xpos[named[-1]] if named else points[np.argmax(away)]
    if (sphere := fit_sphere(points, knee, end)) is not None:
        return Foot(*sphere, "a sphere fitted to the end of the last link's shapes")
    end = data.xpos[named[-1]] if named else points[away > _MIN_SOLE_DISTANCE * reach].mean(axis=0)
    return Foot(*sole_sphere(points, knee, end), "a sphere with the lowest point of the last link's shapes")


def _thickness(shapes: BodyShapes, geoms: NDArray[np.int64], foot: Array, knee: Array) -> float:
    """Estimate the radius [m] of a foot without a shape: half the width of the nearest shape.

    Without any shape it is a tenth of the shank length, which is typical of robots.
    """
    typical = 0.1 * max(float(np.linalg.norm(foot - knee)), 0.05)
    if not geoms.size:
        return typical
    nearest = geoms[np.argmin(np.linalg.norm(shapes.data.geom_xpos[geoms] - foot, axis=1))]
    return float(np.clip(shapes.model.geom_aabb[nearest, 3:].min(), 0.3 * typical, typical))


def pair_feet(feet: list[Foot]) -> list[Foot]:
    """Return the feet, in the order of `LEGS`, with equal radii left and right if both are estimates."""
    for left, right in ((0, 1), (2, 3)):
        if _SPHERE_SOURCE not in (feet[left].source, feet[right].source):
            radius = (feet[left].radius + feet[right].radius) / 2
            feet[left], feet[right] = feet[left]._replace(radius=radius), feet[right]._replace(radius=radius)
    return feet
