"""Configuration of a task's terrain: one ground for all robots, or a field of tiles."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from surefoot.configuration import Within, check_bounds
from surefoot.errors import SurefootError, suggest
from surefoot.seeding import generator
from surefoot.task.height_scan import ScanConfig
from surefoot.world.ground import Ground
from surefoot.world.terrain import HALF_SIDE, TerrainField, check_size, make_field, make_terrain

MAX_TILES = 400
"""Tiles of the largest field."""
Sizes = dict[str, tuple[float, float]]


@dataclass(frozen=True)
class TerrainConfig:
    """Ground of a task: flat, one terrain, or a field of tiles with a curriculum (Rudin et al. 2022)."""

    ground: str = "flat"
    """What all robots stand on: flat, KIND:SIZE, such as stairs:0.10, or the path of a map (.npz, .png)."""
    sizes: Sizes = field(default_factory=dict)
    """Kinds of a field's tiles, with the sizes of difficulty 0 and 1; robots then stand on tiles, not on `ground`."""
    shares: Annotated[dict[str, float], Within(0, 1e6)] = field(default_factory=dict)
    """Shares of the kinds in the field; 1, if not given, and 0 for those that are not there."""
    levels: Annotated[int, Within(1, 50)] = 10
    """Levels of difficulty, from 0 to 1: rows of tiles."""
    columns: Annotated[int, Within(1, 100)] = 12
    """Tiles in a row."""
    tile: Annotated[float, Within(4, 40)] = 8.0
    """Side of a tile [m]."""
    start_level: Annotated[int, Within(0, 49)] = 2
    """Robots begin at levels up to this one."""
    heading: Annotated[float, Within(0, 180)] = 0.0
    """Greatest angle [deg] to either side that robots are turned by at their start."""
    friction: Annotated[tuple[float, float], Within(0, 10)] = (1.0, 1.0)
    """Least and greatest factor on the feet's coefficient of friction; each patch of the ground draws its own."""
    friction_patch: Annotated[float, Within(0.05, 10)] = 0.5
    """Side of a patch [m]."""
    scan: ScanConfig = field(default_factory=ScanConfig)
    """Errors of the map of heights that the observation `height_scan` has."""
    curriculum: bool = True
    """Robots that have kept up rise a level, and go back one after a fall or less than half of the commanded way;
    beyond the last level any one follows. Without it their levels stay."""

    def __post_init__(self) -> None:
        """Refuse kinds that do not exist, sizes out of bounds, and a field that is too large."""
        check_bounds(self, "terrain")
        for name, sizes in self.sizes.items():
            for size in sizes:
                check_size(name, size)
        if self.friction[0] > self.friction[1]:
            raise SurefootError(f"terrain.friction is {self.friction}; the least factor must come first")
        for name in self.shares:
            if name not in self.sizes:
                raise SurefootError(
                    f"terrain.shares.{name} is not a kind of terrain.sizes; {suggest(name, self.sizes)}"
                )
        kinds = sum(self.shares.get(name, 1.0) > 0.0 for name in self.sizes)
        if self.sizes and not kinds:
            raise SurefootError("terrain.shares are all 0; one must be more")
        if self.sizes and not kinds <= self.columns <= MAX_TILES // self.levels:
            raise SurefootError(
                f"terrain.columns is {self.columns}; it must be {kinds}, the kinds, to "
                f"{MAX_TILES // self.levels}, {MAX_TILES} tiles"
            )
        if self.start_level >= self.levels and self.sizes:
            raise SurefootError(
                f"terrain.start_level is {self.start_level}; it must be less than levels, {self.levels}"
            )

    @property
    def name(self) -> str:
        """What a trace calls it: flat, KIND:SIZE, the name of a map's file, or field."""
        return "field" if self.sizes else Path(self.ground).name

    @property
    def is_flat(self) -> bool:
        """Whether robots stand on the plane z = 0."""
        return not self.sizes and self.ground == "flat"

    def build(self, seed: int) -> TerrainField:
        """Return what robots stand on: the field of tiles, or one ground without any."""
        if self.sizes:
            tiles = make_field(self.sizes, self.shares, self.levels, self.columns, self.tile, seed)
        else:
            tiles = TerrainField(make_terrain(self.ground, seed))
        return tiles if self.friction == (1.0, 1.0) else replace(tiles, ground=self._with_friction(tiles.ground, seed))

    def _with_friction(self, ground: Ground, seed: int) -> Ground:
        """Return a ground with friction by place, out to its border; a plane as far as a terrain."""
        sides = 2 * HALF_SIDE if ground.is_flat else np.array(ground.corners.shape[:2]) * ground.cell
        count = np.ceil(np.broadcast_to(sides, 2) / self.friction_patch).astype(int)
        factors = generator(seed, "friction").uniform(*self.friction, count)
        return replace(ground, friction=factors, patch=self.friction_patch)
