"""Terrain configuration of a task: one ground for all robots, or a field of tiles with a curriculum."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from surefoot.configuration import Within, check_bounds
from surefoot.errors import SurefootError, suggest
from surefoot.seeding import generator
from surefoot.task.height_scan import ScanConfig
from surefoot.world.ground import Ground
from surefoot.world.terrain import HALF_SIDE, ROUGH_SPACING, TerrainField, check_size, is_map, make_field, make_terrain

MAX_TILES = 400
"""Maximum number of tiles of a field."""
Sizes = dict[str, tuple[float, float]]


@dataclass(frozen=True)
class TerrainConfig:
    """Terrain of a task: flat, one terrain for all, or a field of tiles with a curriculum (Rudin et al. 2022)."""

    ground: str = "flat"
    """Terrain for all robots: flat, KIND:SIZE, such as stairs:0.10, or the path of a height map (.npz, .png)."""
    sizes: Sizes = field(default_factory=dict)
    """Field of tiles instead of `ground`: for each kind of terrain the sizes at difficulty 0 and 1."""
    shares: Annotated[dict[str, float], Within(0, 1e6)] = field(default_factory=dict)
    """Relative numbers of tiles of each kind. Defaults to 1 for each kind; 0 excludes a kind."""
    levels: Annotated[int, Within(1, 50)] = 10
    """Number of difficulty levels from 0 to 1 (rows of tiles)."""
    columns: Annotated[int, Within(1, 100)] = 12
    """Number of tiles per level."""
    tile: Annotated[float, Within(4, 40)] = 8.0
    """Side length of a tile [m]."""
    start_level: Annotated[int, Within(0, 49)] = 2
    """Maximum level at which robots start their first episode."""
    heading: Annotated[float, Within(0, 180)] = 0.0
    """Maximum random initial heading to either side [deg]."""
    friction: Annotated[tuple[float, float], Within(0, 10)] = (1.0, 1.0)
    """Minimum and maximum factor on the friction coefficient of the feet, drawn for each patch of the ground."""
    friction_patch: Annotated[float, Within(0.05, 10)] = 0.5
    """Side length of a friction patch [m]."""
    scan: ScanConfig = field(default_factory=ScanConfig)
    """Errors of the map of terrain heights, for the observation `height_scan`."""
    curriculum: bool = True
    """Terrain curriculum: robots move up a level if they cover 0.7 to 1.25 of the commanded distance without a fall,
    and down a level if they fall or cover less than half of it. After the last level they continue at a random one."""

    @property
    def map_file(self) -> Path | None:
        """Path of the height map that is the terrain for all robots, or None."""
        return Path(self.ground) if is_map(self.ground) else None

    def __post_init__(self) -> None:
        """Reject kinds that do not exist, sizes out of bounds, and fields that are too large."""
        check_bounds(self, "terrain")
        for name, sizes in self.sizes.items():
            for size in sizes:
                check_size(name, size)
        if self.sizes and not math.isclose(self.tile, ROUGH_SPACING * round(self.tile / ROUGH_SPACING), abs_tol=1e-9):
            raise SurefootError(f"terrain.tile is {self.tile:g}; it must be a multiple of {ROUGH_SPACING:g} m")
        if self.friction[0] > self.friction[1]:
            raise SurefootError(f"terrain.friction is {self.friction}; the smaller factor must come first")
        for name in self.shares:
            if name not in self.sizes:
                raise SurefootError(
                    f"terrain.shares.{name} is not a kind of terrain.sizes; {suggest(name, self.sizes)}"
                )
        kinds = sum(self.shares.get(name, 1.0) > 0.0 for name in self.sizes)
        if self.sizes and not kinds:
            raise SurefootError("terrain.shares are all 0; at least one must be above 0")
        if self.sizes and not kinds <= self.columns <= MAX_TILES // self.levels:
            raise SurefootError(
                f"terrain.columns is {self.columns}; it must be {kinds} (the number of kinds) to "
                f"{MAX_TILES // self.levels} ({MAX_TILES} tiles in all)"
            )
        if self.start_level >= self.levels and self.sizes:
            raise SurefootError(
                f"terrain.start_level is {self.start_level}; it must be less than levels, {self.levels}"
            )

    @property
    def name(self) -> str:
        """Name of the terrain in traces: flat, KIND:SIZE, the file name of a map, or field."""
        return "field" if self.sizes else Path(self.ground).name

    @property
    def is_flat(self) -> bool:
        """Whether the ground is the plane z = 0."""
        return not self.sizes and self.ground == "flat"

    def build(self, seed: int) -> TerrainField:
        """Build the terrain: a field of tiles, or a field that is a single ground without tiles."""
        if self.sizes:
            tiles = make_field(self.sizes, self.shares, self.levels, self.columns, self.tile, seed)
        else:
            tiles = TerrainField(make_terrain(self.ground, seed))
        return tiles if self.friction == (1.0, 1.0) else replace(tiles, ground=self._with_friction(tiles.ground, seed))

    def _with_friction(self, ground: Ground, seed: int) -> Ground:
        """Return a ground with random friction patches, up to its border or, for a plane, as far as a terrain."""
        sides = 2 * HALF_SIDE if ground.is_flat else np.array(ground.corners.shape[:2]) * ground.cell
        count = np.ceil(np.broadcast_to(sides, 2) / self.friction_patch).astype(int)
        factors = generator(seed, "friction").uniform(*self.friction, count)
        return replace(ground, friction=factors, patch=self.friction_patch)
