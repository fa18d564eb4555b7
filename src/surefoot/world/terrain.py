"""Terrain generation: slopes, stairs, blocks and rough ground by kind and size, height maps, and fields of tiles.

Every kind of terrain is a square around a level area where a robot starts. Slopes, stairs and gaps are rings around
this area, so that robots meet them in every direction.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices, describe_os_errors, prefix_errors, suggest
from surefoot.files import check_readable
from surefoot.npz import read_npz
from surefoot.world.ground import FLAT, Ground

START_HALF_SIDE = 1.0
"""Half the side [m] of the level start area."""
HALF_SIDE = 10.0
"""Half the side [m] of a terrain that is not a tile of a field."""
TREAD_DEPTH = 0.3
"""Depth [m] of a tread of stairs."""
ROUGH_SPACING = 0.2
"""Distance [m] between the points of rough ground, as in legged_gym."""
BLOCK_SIDE = 0.4
"""Side [m] of a block."""
GAP_SPACING = 0.6
"""Width [m] of the ground between gaps."""
STONE_GAP = 0.1
"""Distance [m] between stepping stones."""
MAX_GAP_DEPTH = 1.0
"""Maximum depth [m] of gaps, which are twice as deep as wide, and of the ground between stones."""
MAX_DEPTH_STONE_SIDE = 0.25
"""Maximum side [m] of stones with the maximum depth between them; with larger stones it decreases with the square."""
SIZE_STEP = 0.05
"""Widths of gaps and sides of stones are multiples of this [m]."""
CELL_SIDE = 0.1
"""Side [m] of a cell; half of it for terrain with gaps or stones."""
MAX_POINTS = 4_000_000
"""Maximum number of points of a map."""
MAX_MAP_SPACING = 0.5
"""Maximum distance [m] between points of a map: about a robot's length."""
MAX_HEIGHT = 100.0
"""Maximum height or depth [m] in a map."""
MAX_START_STEP = 0.05
"""Maximum deviation [m] of a map from a plane within `START_RADIUS` of the robot's start."""
START_RADIUS = 0.5
"""Radius [m] around the robot's start in which a map must be nearly plane."""
PNG_UNIT, PNG_SPACING = 0.001, 0.05
"""Height [m] of one grey level of an image, and distance [m] between its pixels."""

Heights = tuple[Array, Array]
"""Corners of cells (n, n, 2, 2) and heights of the smoothed ground (n, n) [m], see `Ground`."""


@dataclass(frozen=True)
class Kind:
    """Kind of terrain, whose size determines its difficulty."""

    unit: str
    """Unit of the size."""
    meaning: str
    """Meaning of the size."""
    range: tuple[float, float]
    """Minimum and maximum size."""
    make: Callable[[float, float, float, np.random.Generator], Heights]
    """Function that generates the terrain from its size, half the side [m], the side of a cell [m], and a generator."""
    multiple: float = 0.0
    """Step of the size, which must be a multiple of it; 0: any size."""


def _cell_centers(half: float, cell: float) -> tuple[Array, Array]:
    """Return x and y of the cell centres [m], (n, n) each."""
    along = (np.arange(round(2 * half / cell)) + 0.5) * cell - half
    x, y = np.meshgrid(along, along, indexing="ij")
    return x, y


def _distance(half: float, cell: float) -> Array:
    """Return the distance of cell centres from the level start area, the maximum along x and y (n, n) [m]."""
    x, y = _cell_centers(half, cell)
    distance: Array = np.maximum(np.abs(x), np.abs(y)) - START_HALF_SIDE
    return distance


def _level_cells(tops: Array) -> Array:
    return np.broadcast_to(tops[..., None, None], (*tops.shape, 2, 2)).copy()


def _stairs(size: float, half: float, cell: float, _: np.random.Generator) -> Heights:
    distance = _distance(half, cell)
    steps = np.ceil(np.round(np.maximum(distance, 0.0) / TREAD_DEPTH, 6))
    smooth_heights: Array = size * np.where(distance > 0, distance / TREAD_DEPTH + 0.5, 0.0)
    return _level_cells(size * steps), smooth_heights


def _slope(size: float, half: float, cell: float, _: np.random.Generator) -> Heights:
    points = np.arange(round(2 * half / cell) + 1) * cell - half
    distance = np.maximum(np.maximum(np.abs(points)[:, None], np.abs(points)[None, :]) - START_HALF_SIDE, 0.0)
    ground = Ground.from_points(np.tan(np.radians(size)) * distance, cell)
    return ground.corners, ground.smooth_heights


def _rough(size: float, half: float, cell: float, rng: np.random.Generator) -> Heights:
    count = round(2 * half / ROUGH_SPACING) + 1
    points = np.arange(count) * ROUGH_SPACING - half
    far = np.maximum(np.abs(points)[:, None], np.abs(points)[None, :]) > START_HALF_SIDE
    coarse = Ground.from_points(size * (rng.random((count, count)) - 0.5) * far, ROUGH_SPACING)
    # Subdivide the triangles into smaller cells.
    fine = np.arange(round(2 * half / cell) + 1) * cell - half
    heights = coarse.height(np.stack(np.meshgrid(fine, fine, indexing="ij"), axis=-1))
    return Ground.from_points(heights, cell).corners, np.zeros((len(fine) - 1,) * 2)


def _blocks(size: float, half: float, cell: float, rng: np.random.Generator) -> Heights:
    x, y = _cell_centers(half, cell)
    i, j = (np.floor(np.round((one + half) / BLOCK_SIDE, 6)).astype(np.int64) for one in (x, y))
    tops = rng.random((i.max() + 1, j.max() + 1))[i, j] * size
    far = _distance(half, cell) > 0
    return _level_cells(tops * far), np.where(far, 0.5 * size, 0.0)


def _gaps(size: float, half: float, cell: float, _: np.random.Generator) -> Heights:
    distance = _distance(half, cell)
    # The first gap is at the edge of the level start area.
    gap = (distance > 0) & (np.round(distance % (size + GAP_SPACING), 6) < size)
    return _level_cells(np.where(gap, -min(MAX_GAP_DEPTH, 2 * size), 0.0)), np.zeros_like(distance)


def _stones(size: float, half: float, cell: float, _: np.random.Generator) -> Heights:
    x, y = _cell_centers(half, cell)
    # Shift the pattern, so that stones are straight ahead of the start.
    shift = np.floor(np.round(size / 2 / SIZE_STEP, 6)) * SIZE_STEP
    on_stone = [np.round((one + shift) % (size + STONE_GAP), 6) < size for one in (x, y)]
    far = _distance(half, cell) > 0
    depth = MAX_GAP_DEPTH * min(1.0, MAX_DEPTH_STONE_SIDE / size) ** 2
    return _level_cells(np.where(far & ~(on_stone[0] & on_stone[1]), -depth, 0.0)), np.zeros_like(x)


def _downward(make: Callable[[float, float, float, np.random.Generator], Heights]) -> Callable[..., Heights]:
    def inverted(size: float, half: float, cell: float, rng: np.random.Generator) -> Heights:
        corners, smooth_heights = make(size, half, cell, rng)
        return -corners, -smooth_heights

    return inverted


KINDS: dict[str, Kind] = {
    "stairs": Kind("m", "height of a step, upward; treads of 0.3 m", (0.01, 0.4), _stairs),
    "stairs_down": Kind("m", "height of a step, downward", (0.01, 0.4), _downward(_stairs)),
    "slope": Kind("deg", "angle, upward", (0.5, 45.0), _slope),
    "slope_down": Kind("deg", "angle, downward", (0.5, 45.0), _downward(_slope)),
    "rough": Kind("m", "height range of random points, 0.2 m apart", (0.005, 0.5), _rough),
    "blocks": Kind("m", "height range of blocks of 0.4 m by 0.4 m", (0.005, 0.5), _blocks),
    "gaps": Kind("m", "width of gaps, 0.6 m apart", (0.05, 1.0), _gaps, SIZE_STEP),
    "stones": Kind("m", "side of stepping stones, 0.1 m apart", (0.1, 1.0), _stones, SIZE_STEP),
}
"""Kinds of terrain by name."""


def check_size(name: str, size: float) -> Kind:
    """Return the kind of terrain of a name, after checking that it has the size.

    Raises:
        SurefootError: an unknown kind, or a size out of its range.
    """
    kind = KINDS.get(name)
    if kind is None:
        raise SurefootError(f"terrain '{name}' does not exist; {suggest(name, KINDS)}")
    low, high = kind.range
    if not low <= size <= high:
        raise SurefootError(f"terrain {name}: size is {size:g} {kind.unit}; it must be {low:g} to {high:g}")
    if kind.multiple and abs(size / kind.multiple - round(size / kind.multiple)) > 1e-6:
        raise SurefootError(f"terrain {name}: size is {size:g} {kind.unit}; it must be a multiple of {kind.multiple:g}")
    return kind


def is_map(text: str) -> bool:
    """Return whether the name of a terrain is the path of a height map."""
    return Path(text).suffix.lower() in (".npz", ".png")


def make_terrain(text: str, seed: int = 0) -> Ground:
    """Make a single terrain around (0, 0), where robots start at height 0.

    Args:
        text: `flat`, KIND:SIZE such as `stairs:0.10`, or the path of a height map, see `read_map`.
        seed: seed of random kinds.

    Raises:
        SurefootError: no such terrain, or a map on which no robot can stand.
    """
    if text == "flat":
        return FLAT
    name, colon, number = text.partition(":")
    if is_map(text):
        return read_map(Path(text))
    if not colon:
        raise SurefootError(
            f"terrain is '{text}'; it must be flat, KIND:SIZE with one of {choices(KINDS)}, or a map (.npz, .png)"
        )
    try:
        size = float(number)
    except ValueError:
        raise SurefootError(f"terrain is '{text}'; the size must be a number") from None
    kind = check_size(name, size)
    # The coarsest cells whose borders include the terrain's edges.
    cell = {"rough": ROUGH_SPACING, "slope": START_HALF_SIDE, "slope_down": START_HALF_SIDE}.get(
        name, SIZE_STEP if kind.multiple else CELL_SIDE
    )
    corners, smooth_heights = kind.make(size, HALF_SIDE, cell, np.random.default_rng(seed))
    return Ground(corners, cell, smooth_heights=smooth_heights)


def read_map(path: Path) -> Ground:
    """Read a height map, in whose middle robots start.

    NPZ: `heights` (X, Y) [m] at points along x and y, and `cell`, their distance [m]. PNG: grey image with 8 or 16
    bits, 1 mm per grey level, and pixels 5 cm apart; the top of the image is ahead of the robot, its left side on the
    left.

    Raises:
        SurefootError: a map that is too large, too coarse, not finite, too high, or too uneven at the start.
    """
    if path.suffix.lower() == ".png":
        heights, cell = _read_image(path), PNG_SPACING
    else:
        with prefix_errors(path):
            arrays = read_npz(path)
        if missing := {"heights", "cell"} - set(arrays):
            raise SurefootError(f"{path}: {choices(sorted(missing))} is missing; a map has heights (X, Y) and cell")
        heights, step = np.asarray(arrays["heights"]), np.asarray(arrays["cell"])
        if step.size != 1 or step.dtype.kind not in "iuf" or heights.dtype.kind not in "iuf":
            raise SurefootError(f"{path}: heights and cell must be numbers")
        heights, cell = heights.astype(float), float(step.reshape(()))
    if heights.ndim != 2 or min(heights.shape) < 2 or heights.size > MAX_POINTS:
        raise SurefootError(
            f"{path}: heights have the shape {heights.shape}; it must be (X, Y), 2 or more each, {MAX_POINTS} in all"
        )
    if not 0.005 <= cell <= MAX_MAP_SPACING:
        raise SurefootError(f"{path}: cell is {cell:g} m; it must be 0.005 to {MAX_MAP_SPACING:g}")
    if not (np.abs(heights) <= MAX_HEIGHT).all():
        raise SurefootError(f"{path}: heights must be finite, and within {MAX_HEIGHT:g} m of 0")
    ground = Ground.from_points(heights, cell)
    x, y = np.meshgrid(*2 * (np.linspace(-START_RADIUS, START_RADIUS, 21),))
    near, plane = (
        ground.height(np.stack([x, y], axis=-1)).ravel(),
        np.column_stack([x.ravel(), y.ravel(), x.size * [1.0]]),
    )
    off = np.abs(near - plane @ np.linalg.lstsq(plane, near, rcond=None)[0]).max()
    if off > MAX_START_STEP:
        raise SurefootError(
            f"{path}: heights are up to {off:.2f} m off a plane within {START_RADIUS:g} m of the middle, where the "
            f"robot starts; at most {MAX_START_STEP:g}"
        )
    return Ground.from_points(heights - float(ground.height(np.zeros(2))), cell, smooth_heights=_moving_average(ground))


def _moving_average(ground: Ground) -> Array:
    """Return the moving average of heights over a robot's length at each cell, relative to the middle of the map."""
    reach = max(round(0.25 / ground.cell), 1)
    smooth_heights = ground.corners.mean(axis=(2, 3)) - float(ground.height(np.zeros(2)))
    for axis in (0, 1):
        padded = np.pad(smooth_heights, [(reach, reach) if k == axis else (0, 0) for k in (0, 1)], mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=axis)
        smooth_heights = windows.mean(axis=-1)
    return smooth_heights


def _read_image(path: Path) -> Array:
    from PIL import Image

    with describe_os_errors(path):
        check_readable(path)
    try:
        # Ignore PIL's warnings about large images and unusual properties, which are checked here if they matter.
        with warnings.catch_warnings(action="ignore"), Image.open(path) as picture:
            if picture.width * picture.height > MAX_POINTS:
                raise SurefootError(
                    f"{path}: it has {picture.width} x {picture.height} pixels; at most {MAX_POINTS} in all"
                )
            if picture.mode not in ("L", "I;16", "I"):
                raise SurefootError(f"{path}: its mode is {picture.mode}; it must be grey with 8 or 16 bits")
            rows = np.asarray(picture, dtype=float)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise SurefootError(f"{path}: it is not an image: {error}") from None
    # Rows of pixels go from front to back, columns from left to right.
    return PNG_UNIT * rows[::-1, ::-1]


@dataclass(frozen=True, eq=False)
class TerrainField:
    """Terrain of a training: a field of tiles that become more difficult along x, or a single ground without tiles."""

    ground: Ground
    starts: Array = field(default_factory=lambda: np.zeros((0, 0, 2)))
    """Centres of the tiles, where robots start (levels, columns, 2) [m]; without tiles robots start at (0, 0)."""
    kinds: tuple[str, ...] = ()
    """Kind of terrain of each column."""


def make_field(
    sizes: Mapping[str, tuple[float, float]],
    shares: Mapping[str, float],
    levels: int,
    columns: int,
    tile: float,
    seed: int,
) -> TerrainField:
    """Make a field of tiles, with a kind of terrain per column, and rows of increasing difficulty.

    The borders of all tiles have the same height, so that a robot can walk from its tile to the next. The centre of the
    easiest tile of the first column is at (0, 0).

    Args:
        sizes: sizes of the easiest and the most difficult tile, by kind.
        shares: relative numbers of columns by kind, at least one above 0. Defaults to 1 for each kind.
        levels: number of levels of difficulty (rows).
        columns: number of columns.
        tile: side length of a tile [m].
        seed: seed of random kinds.
    """
    cell = SIZE_STEP if any(KINDS[name].multiple for name in sizes) else CELL_SIDE
    weights = np.array([shares.get(name, 1.0) for name in sizes])
    # Each kind has an interval of [0, 1], and each column the kind in whose interval its middle is.
    ends = np.cumsum(weights) / weights.sum()
    kinds = tuple(list(sizes)[int(np.searchsorted(ends, (k + 0.5) / columns))] for k in range(columns))
    rows, rng = [], np.random.default_rng(seed)
    for level in range(levels):
        difficulty = level / max(levels - 1, 1)
        tiles = [
            _tile(name, sizes[name][0] + difficulty * (sizes[name][1] - sizes[name][0]), tile, cell, rng)
            for name in kinds
        ]
        rows.append([np.concatenate(parts, axis=1) for parts in zip(*tiles, strict=True)])
    corners, smooth_heights = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    center = (0.5 * (levels - 1) * tile, 0.5 * (columns - 1) * tile)
    places = np.stack(np.meshgrid(np.arange(levels), np.arange(columns), indexing="ij"), axis=-1)
    starts: Array = (tile * places).astype(np.float64)
    return TerrainField(Ground(corners, cell, center, smooth_heights), starts, kinds)


def _tile(name: str, size: float, tile: float, cell: float, rng: np.random.Generator) -> Heights:
    kind = KINDS[name]
    if kind.multiple:
        size = max(round(size / kind.multiple), 1) * kind.multiple
    corners, smooth_heights = kind.make(size, tile / 2, cell, rng)
    border = corners[0, 0, 0, 0] if name.startswith(("stairs", "slope")) else 0.0
    return corners - border, smooth_heights - border
