"""Terrain: slopes, stairs, blocks and rough ground by kind and size, maps from files, and fields of many tiles.

Every kind is a square around a level place where a robot starts. Slopes, stairs and gaps are rings around that place,
so that they are met whichever way the robot goes.
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

START = 1.0
"""Half the side [m] of the level place where robots start."""
HALF_SIDE = 10.0
"""Half the side [m] of a terrain that is not a tile of a field."""
TREAD_DEPTH = 0.3
"""Depth [m] of a step of stairs."""
ROUGH_SPACING = 0.2
"""Distance [m] of the points of rough ground, as in legged_gym."""
BLOCK = 0.4
"""Side [m] of a block."""
GAP_SPACING = 0.6
"""Ground [m] between gaps."""
GAP = 0.1
"""Distance [m] of stepping stones."""
MAX_GAP_DEPTH = 1.0
"""Greatest depth [m] of gaps, which are twice as deep as wide, and of the ground between stones."""
MAX_DEPTH_STONE_SIDE = 0.25
"""Side [m] of the stones between which the ground is that deep; between larger ones it is less, by the square."""
GRID = 0.05
"""Widths of gaps and sides of stones are whole multiples of this [m]."""
CELL = 0.1
"""Side [m] of a cell; half of it where there are gaps or stones."""
MAX_POINTS = 4_000_000
"""Points of the largest map."""
MAX_MAP_SPACING = 0.5
"""Distance [m] of the points of the coarsest map: about a robot's length."""
MAX_HEIGHT = 100.0
"""Greatest height or depth [m] in a map."""
MAX_START_STEP = 0.05
"""Greatest distance of heights [m] from a plane in a map, within `START_RADIUS` of the place where the robot starts."""
START_RADIUS = 0.5
"""See above [m]."""
PNG_UNIT, PNG_SPACING = 0.001, 0.05
"""Height [m] of one unit of a picture's grey, and distance [m] of its pixels."""

Heights = tuple[Array, Array]
"""Corners (n, n, 2, 2) of cells and their course (n, n)."""


@dataclass(frozen=True)
class Kind:
    """A kind of terrain that a size makes easy or difficult."""

    unit: str
    meaning: str
    """What the size is."""
    range: tuple[float, float]
    """Least and greatest size."""
    make: Callable[[float, float, float, np.random.Generator], Heights]
    """Makes it of a size, half the side [m], the side of a cell [m], and a generator."""
    multiple: float = 0.0
    """The size must be a whole multiple of this; 0: any."""


def _cell_centers(half: float, cell: float) -> tuple[Array, Array]:
    """Return x and y [m] of the middles of cells, (n, n) each."""
    along = (np.arange(round(2 * half / cell)) + 0.5) * cell - half
    x, y = np.meshgrid(along, along, indexing="ij")
    return x, y


def _distance(half: float, cell: float) -> Array:
    """Return how far the middles of cells are from the level place, along x or y, whichever is more (n, n) [m]."""
    x, y = _cell_centers(half, cell)
    distance: Array = np.maximum(np.abs(x), np.abs(y)) - START
    return distance


def _level_cells(tops: Array) -> Array:
    return np.broadcast_to(tops[..., None, None], (*tops.shape, 2, 2)).copy()


def _stairs(size: float, half: float, cell: float, _: np.random.Generator) -> Heights:
    distance = _distance(half, cell)
    steps = np.ceil(np.round(np.maximum(distance, 0.0) / TREAD_DEPTH, 6))
    course: Array = size * np.where(distance > 0, distance / TREAD_DEPTH + 0.5, 0.0)
    return _level_cells(size * steps), course


def _slope(size: float, half: float, cell: float, _: np.random.Generator) -> Heights:
    points = np.arange(round(2 * half / cell) + 1) * cell - half
    distance = np.maximum(np.maximum(np.abs(points)[:, None], np.abs(points)[None, :]) - START, 0.0)
    ground = Ground.from_points(np.tan(np.radians(size)) * distance, cell)
    return ground.corners, ground.course


def _rough(size: float, half: float, cell: float, rng: np.random.Generator) -> Heights:
    count = round(2 * half / ROUGH_SPACING) + 1
    points = np.arange(count) * ROUGH_SPACING - half
    far = np.maximum(np.abs(points)[:, None], np.abs(points)[None, :]) > START
    coarse = Ground.from_points(size * (rng.random((count, count)) - 0.5) * far, ROUGH_SPACING)
    # Smaller cells have parts of the same triangles.
    fine = np.arange(round(2 * half / cell) + 1) * cell - half
    heights = coarse.height(np.stack(np.meshgrid(fine, fine, indexing="ij"), axis=-1))
    return Ground.from_points(heights, cell).corners, np.zeros((len(fine) - 1,) * 2)


def _blocks(size: float, half: float, cell: float, rng: np.random.Generator) -> Heights:
    x, y = _cell_centers(half, cell)
    i, j = (np.floor(np.round((one + half) / BLOCK, 6)).astype(np.int64) for one in (x, y))
    tops = rng.random((i.max() + 1, j.max() + 1))[i, j] * size
    far = _distance(half, cell) > 0
    return _level_cells(tops * far), np.where(far, 0.5 * size, 0.0)


def _gaps(size: float, half: float, cell: float, _: np.random.Generator) -> Heights:
    distance = _distance(half, cell)
    # The first gap is at the edge of the level place.
    gap = (distance > 0) & (np.round(distance % (size + GAP_SPACING), 6) < size)
    return _level_cells(np.where(gap, -min(MAX_GAP_DEPTH, 2 * size), 0.0)), np.zeros_like(distance)


def _stones(size: float, half: float, cell: float, _: np.random.Generator) -> Heights:
    x, y = _cell_centers(half, cell)
    # The way ahead of the start is from stone to stone.
    shift = np.floor(np.round(size / 2 / GRID, 6)) * GRID
    on_stone = [np.round((one + shift) % (size + GAP), 6) < size for one in (x, y)]
    far = _distance(half, cell) > 0
    depth = MAX_GAP_DEPTH * min(1.0, MAX_DEPTH_STONE_SIDE / size) ** 2
    return _level_cells(np.where(far & ~(on_stone[0] & on_stone[1]), -depth, 0.0)), np.zeros_like(x)


def _downward(make: Callable[[float, float, float, np.random.Generator], Heights]) -> Callable[..., Heights]:
    def made(size: float, half: float, cell: float, rng: np.random.Generator) -> Heights:
        corners, course = make(size, half, cell, rng)
        return -corners, -course

    return made


KINDS: dict[str, Kind] = {
    "stairs": Kind("m", "height of a step, upward; treads of .3 m", (0.01, 0.4), _stairs),
    "stairs_down": Kind("m", "height of a step, downward", (0.01, 0.4), _downward(_stairs)),
    "slope": Kind("deg", "angle, upward", (0.5, 45.0), _slope),
    "slope_down": Kind("deg", "angle, downward", (0.5, 45.0), _downward(_slope)),
    "rough": Kind("m", "between the lowest and the highest point; points .2 m apart", (0.005, 0.5), _rough),
    "blocks": Kind("m", "between the lowest and the highest top of blocks of .4 m", (0.005, 0.5), _blocks),
    "gaps": Kind("m", "width of gaps, .6 m apart", (0.05, 1.0), _gaps, GRID),
    "stones": Kind("m", "side of stepping stones, .1 m apart", (0.1, 1.0), _stones, GRID),
}
"""Every kind of terrain."""


def check_size(name: str, size: float) -> Kind:
    """Return a kind of terrain by name; refuse a kind that does not exist, and a size that it does not have."""
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
    """Return whether a terrain is the path of a map."""
    return Path(text).suffix.lower() in (".npz", ".png")


def make_terrain(text: str, seed: int = 0) -> Ground:
    """Return the terrain KIND:SIZE, or that of a map's file, around (0, 0), where robots start on the height 0.

    Args:
        text: `flat`, such as `stairs:0.10`, or the path of a map, see `read_map`.
        seed: of kinds that are drawn.

    Raises:
        SurefootError: no such terrain, or a map that no robot can stand on.
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
    # The coarsest cells that have the terrain's edges between them.
    cell = {"rough": ROUGH_SPACING, "slope": START, "slope_down": START}.get(name, GRID if kind.multiple else CELL)
    corners, course = kind.make(size, HALF_SIDE, cell, np.random.default_rng(seed))
    return Ground(corners, cell, course=course)


def read_map(path: Path) -> Ground:
    """Return the ground of a map of heights; its middle is where robots start.

    NPZ: `heights` (X, Y) [m] at points along x and y, and `cell`, their distance [m]. PNG: grey, 8 or 16 bits, one
    millimetre a unit, pixels 5 cm apart; the picture's top is ahead of the robot, its left on the left.

    Raises:
        SurefootError: a map that is too large, too coarse, not finite, too high, or too uneven at the start.
    """
    if path.suffix.lower() == ".png":
        heights, cell = _read_image(path), PNG_SPACING
    else:
        with prefix_errors(path):
            arrays = read_npz(path)
        if missing := {"heights", "cell"} - set(arrays):
            raise SurefootError(f"{path}: {choices(sorted(missing))} is not there; a map has heights (X, Y) and cell")
        heights, step = np.asarray(arrays["heights"]), np.asarray(arrays["cell"])
        if step.size != 1 or not np.issubdtype(step.dtype, np.number) or not np.issubdtype(heights.dtype, np.number):
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
    return Ground.from_points(heights - float(ground.height(np.zeros(2))), cell, course=_smooth(ground))


def _smooth(ground: Ground) -> Array:
    """Return the mean of heights around each cell, over a robot's length, with that of the middle as 0."""
    reach = max(round(0.25 / ground.cell), 1)
    course = ground.corners.mean(axis=(2, 3)) - float(ground.height(np.zeros(2)))
    for axis in (0, 1):
        padded = np.pad(course, [(reach, reach) if k == axis else (0, 0) for k in (0, 1)], mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=axis)
        course = windows.mean(axis=-1)
    return course


def _read_image(path: Path) -> Array:
    from PIL import Image

    with describe_os_errors(path):
        check_readable(path)
    try:
        # PIL warns of large pictures and odd properties; what matters is checked here.
        with warnings.catch_warnings(action="ignore"), Image.open(path) as picture:
            if picture.width * picture.height > MAX_POINTS:
                raise SurefootError(
                    f"{path}: it has {picture.width} x {picture.height} pixels; at most {MAX_POINTS} in all"
                )
            if picture.mode not in ("L", "I;16", "I"):
                raise SurefootError(f"{path}: its mode is {picture.mode}; it must be grey with 8 or 16 bits")
            rows = np.asarray(picture, dtype=float)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise SurefootError(f"{path}: it is not a picture: {error}") from None
    # Rows of pixels go from ahead to behind, columns from the left to the right.
    return PNG_UNIT * rows[::-1, ::-1]


@dataclass(frozen=True, eq=False)
class TerrainField:
    """Tiles of terrain side by side, more difficult along x: one place for all robots of a training."""

    ground: Ground
    starts: Array = field(default_factory=lambda: np.zeros((0, 0, 2)))
    """Middles of the tiles, where robots start, (levels, columns, 2) [m]; without tiles at (0, 0)."""
    kinds: tuple[str, ...] = ()
    """Kind of each column."""


def make_field(
    sizes: Mapping[str, tuple[float, float]],
    shares: Mapping[str, float],
    levels: int,
    columns: int,
    tile: float,
    seed: int,
) -> TerrainField:
    """Return a field whose columns are kinds of terrain, and whose rows grow more difficult.

    The borders of all tiles are level with each other: a robot that leaves its tile gets to another one. The middle of
    the easiest tile of the first column is at (0, 0).

    Args:
        sizes: of the easiest and of the most difficult tile, by kind; a kind's `flat` has none.
        shares: of the columns, by kind; 1, if not given; one or more over 0.
        levels: rows.
        columns: of the field.
        tile: side of a tile [m].
        seed: of kinds that are drawn.
    """
    cell = GRID if any(KINDS[name].multiple for name in sizes) else CELL
    weights = np.array([shares.get(name, 1.0) for name in sizes])
    # The column's middle falls into a kind's part of [0, 1].
    ends = np.cumsum(weights) / weights.sum()
    kinds = tuple(list(sizes)[int(np.searchsorted(ends, (k + 0.5) / columns))] for k in range(columns))
    rows, rng = [], np.random.default_rng(seed)
    for level in range(levels):
        share = level / max(levels - 1, 1)
        made = [
            _tile(name, sizes[name][0] + share * (sizes[name][1] - sizes[name][0]), tile, cell, rng) for name in kinds
        ]
        rows.append([np.concatenate(parts, axis=1) for parts in zip(*made, strict=True)])
    corners, course = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    center = (0.5 * (levels - 1) * tile, 0.5 * (columns - 1) * tile)
    places = np.stack(np.meshgrid(np.arange(levels), np.arange(columns), indexing="ij"), axis=-1)
    starts: Array = (tile * places).astype(np.float64)
    return TerrainField(Ground(corners, cell, center, course), starts, kinds)


def _tile(name: str, size: float, tile: float, cell: float, rng: np.random.Generator) -> Heights:
    kind = KINDS[name]
    if kind.multiple:
        size = max(round(size / kind.multiple), 1) * kind.multiple
    corners, course = kind.make(size, tile / 2, cell, rng)
    border = corners[0, 0, 0, 0] if name.startswith(("stairs", "slope")) else 0.0
    return corners - border, course - border
