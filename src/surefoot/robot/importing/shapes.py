"""Collision and visual shapes of a compiled model, and points on them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence

import mujoco
import numpy as np
from mujoco import mjtGeom
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.robot.importing.foot_sphere import surface_points
from surefoot.robot.importing.visuals import Visual


class BodyShapes:
    """Shapes of a MuJoCo model, as points in the frame of `data`.

    Args:
        model: the model.
        data: its kinematic state, which may change between calls.
        group: for each body, the body whose joint moves it.
        visuals: visual surfaces of the model.
    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, group: NDArray[np.int64], visuals: Sequence[Visual]
    ) -> None:
        self.model, self.data, self.group, self.visuals = model, data, group, visuals

    def geom_ids(self, mover: int) -> NDArray[np.int64]:
        """Return the ids of the collision geoms that move with a body."""
        return np.flatnonzero(self.group[self.model.geom_bodyid] == mover)

    def hull_points(self, geoms: Iterable[int]) -> Array:
        """Return points (p, 3) whose convex hull encloses geoms: mesh vertices, or corners of bounding boxes."""
        return np.concatenate([np.empty((0, 3)), *map(self._corners, geoms)])

    def surface_points(self, geoms: Iterable[int]) -> Array:
        """Return points (p, 3) on the surfaces of geoms."""
        return np.concatenate([np.empty((0, 3)), *map(self._surface, geoms)])

    def visual_points(self, mover: int) -> Array:
        """Return the vertices (p, 3) of visual surfaces that move with a body."""
        return np.concatenate([np.empty((0, 3)), *self._visual_vertices(mover)])

    def _visual_vertices(self, mover: int) -> Iterator[Array]:
        for visual in self.visuals:
            body = self.model.body(visual.body).id
            if self.group[body] == mover:
                placed = visual.surface.place(visual.frame).vertices @ self.data.xmat[body].reshape(3, 3).T
                yield placed + self.data.xpos[body]

    def _corners(self, geom: int) -> Array:
        model = self.model
        if model.geom_type[geom] == mjtGeom.mjGEOM_MESH:
            # A mesh's bounding box is along its principal axes; the bounding box of that box would be too large.
            first = model.mesh_vertadr[model.geom_dataid[geom]]
            points = model.mesh_vert[first : first + model.mesh_vertnum[model.geom_dataid[geom]]].astype(float)
        else:
            signs = np.array(list(itertools.product((-1, 1), repeat=3)))
            points = model.geom_aabb[geom, :3] + model.geom_aabb[geom, 3:] * signs
        return self._place(geom, points)

    def _surface(self, geom: int) -> Array:
        kind = int(self.model.geom_type[geom])
        if kind == mjtGeom.mjGEOM_MESH:
            return self._corners(geom)
        return self._place(geom, surface_points(kind, self.model.geom_size[geom]))

    def _place(self, geom: int, points: Array) -> Array:
        placed: Array = self.data.geom_xpos[geom] + points @ self.data.geom_xmat[geom].reshape(3, 3).T
        return placed
