"""Feet of a robot's legs: where they are and how they roll."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np
from mujoco import mjtGeom
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.robot.importing.foot import fit_sphere, sole_sphere
from surefoot.robot.importing.shapes import BodyShapes

_NAMES = re.compile(r"foot|toe|tip|sole|ankle", re.IGNORECASE)
_SPHERE_SOURCE = "the last link's sphere"
_MIN_FOOT_DISTANCE = 0.9
"""How far from the knee a sphere must reach to be the foot, over the farthest point of the last link."""
_MIN_NAMED_DISTANCE = 1.02
"""How far a link that is named as a foot is from the knee, over the farthest shape, if the foot has no shape."""
_MIN_SOLE_DISTANCE = 0.95
"""How far from the knee points of the sole are, over the farthest one."""


class Foot(NamedTuple):
    """A sphere that stands in for a foot."""

    centre: Array
    radius: float
    source: str
    """How it was recognized."""


def find_foot(shapes: BodyShapes, body: int, knee: Array) -> Foot | None:
    """Return a leg's foot: the last link's sphere, else a sphere that stands in for its shapes, else a guess.

    The end is at a link that is named so, else where the last link's shapes are farthest from the knee. None if there
    is neither a shape nor such a link.

    Args:
        shapes: of the robot.
        body: the last body of the leg that a joint moves.
        knee: place (3,) of the knee.
    """
    model, data, geoms = shapes.model, shapes.data, shapes.of(body)
    points = shapes.surface(geoms) if geoms.size else shapes.drawn(body)
    away = np.linalg.norm(points - knee, axis=1)
    reach = away.max(initial=0.0)
    spheres = geoms[model.geom_type[geoms] == mjtGeom.mjGEOM_SPHERE]
    if spheres.size:
        distances = np.linalg.norm(data.geom_xpos[spheres] - knee, axis=1)
        last = spheres[np.argmax(distances)]
        if distances.max() + model.geom_size[last, 0] >= _MIN_FOOT_DISTANCE * reach:  # else it is no foot
            return Foot(data.geom_xpos[last], float(model.geom_size[last, 0]), _SPHERE_SOURCE)
    named = [b for b in np.flatnonzero(shapes.group == body) if _NAMES.search(model.body(int(b)).name)]
    if not len(points) and not named:
        return None
    if not len(points) or (named and np.linalg.norm(data.xpos[named[-1]] - knee) > _MIN_NAMED_DISTANCE * reach):
        end = data.xpos[named[-1]].copy()
        return Foot(end, _thickness(shapes, geoms, end, knee), "a link named so")
    end = data.xpos[named[-1]] if named else points[np.argmax(away)]
    if (sphere := fit_sphere(points, knee, end)) is not None:
        return Foot(*sphere, "a sphere fitted to the end of the last link's shapes")
    end = data.xpos[named[-1]] if named else points[away > _MIN_SOLE_DISTANCE * reach].mean(axis=0)
    return Foot(*sole_sphere(points, knee, end), "a sphere with the lowest point of the last link's shapes")


def _thickness(shapes: BodyShapes, geoms: NDArray[np.int64], place: Array, knee: Array) -> float:
    """Return a radius [m] for a foot: half of the width of the shape that is nearest to it.

    Without a shape it is a tenth of the shank, as robots' feet are.
    """
    usual = 0.1 * max(float(np.linalg.norm(place - knee)), 0.05)
    if not geoms.size:
        return usual
    nearest = geoms[np.argmin(np.linalg.norm(shapes.data.geom_xpos[geoms] - place, axis=1))]
    return float(np.clip(shapes.model.geom_aabb[nearest, 3:].min(), 0.3 * usual, usual))


def pair_feet(feet: list[Foot]) -> list[Foot]:
    """Return the feet, by `LEGS`, with one radius left and right where both are estimates."""
    for left, right in ((0, 1), (2, 3)):
        if _SPHERE_SOURCE not in (feet[left].source, feet[right].source):
            radius = (feet[left].radius + feet[right].radius) / 2
            feet[left], feet[right] = feet[left]._replace(radius=radius), feet[right]._replace(radius=radius)
    return feet
