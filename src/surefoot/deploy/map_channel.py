"""UDP channel for the height maps of a perceptive policy, which another program sends.

The channel listens on this computer's loopback address. A datagram is one JSON object. `heights` [m] are ground heights
relative to the origin of the base, with z up: one list per row of the grid, from behind to ahead, and each row from
right to left; null where the height is unknown. `age` [s] is the age of the map and defaults to 0. The grid, in the
heading frame, is in the policy's contract. A datagram may state its grid as `ahead` and `left` [m], which must then be
the policy's. Other datagrams are counted and ignored.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from surefoot.arrays import Array
from surefoot.configuration import is_number
from surefoot.deploy.channel import Channel, send
from surefoot.deploy.map_check import check_grid
from surefoot.errors import SurefootError
from surefoot.policy.contract import HeightMap
from surefoot.task.height_scan import MAX_RELATIVE_HEIGHT

MAX_DELAY = 0.3
"""Maximum age of a map in excess of its age in training [s]; with an older map, the robot stands until the next one."""
_MAX_BYTES = 16384
_MAX_AGE = 10.0


@dataclass(frozen=True)
class _Map:
    heights: Array
    """Heights (K,) [m], clipped to the range of training."""
    unclipped: Array
    """Heights (K,) [m] as they were sent, with unknown ones filled."""
    age: float
    """Age of the map when it was sent [s]."""


class MapChannel(Channel[_Map]):
    """Height maps from another program, by UDP on the loopback address.

    Args:
        port: port to listen on; 0 lets the system choose one.
        grid: grid of the policy's height map.
        clock: returns the time that determines the age of maps [s].

    Raises:
        SurefootError: the port is in use.
    """

    def __init__(self, port: int, grid: HeightMap, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__("height_map", port, self._parse_or_explain, _MAX_BYTES, clock)
        self.grid, self._max_age = grid, grid.age + MAX_DELAY
        self.last_error = ""
        """Why the last map did not match the policy's grid; "" if all did."""
        self.age = np.inf
        """Age of the newest map at the last `read` [s]."""

    def _parse_or_explain(self, values: Any) -> _Map | None:
        try:
            return _parse_map(values, self.grid)
        except SurefootError as error:
            self.last_error = str(error)
            raise

    def read(self) -> Array | None:
        """Return the heights (K,) of the newest map [m]; None before the first one."""
        since, newest = self.receive(), self.newest
        self.age = np.inf if newest is None else newest.age + since
        return None if newest is None else newest.heights

    @property
    def is_fresh(self) -> bool:
        """Whether the map of the last `read` is recent enough to walk."""
        return bool(self.age < self._max_age)


def _parse_map(values: Any, grid: HeightMap) -> _Map | None:
    """Return the map in the JSON value of a datagram, or None if it is not a map, or has no known height.

    Raises:
        SurefootError: the map has another grid.
    """
    if (
        not isinstance(values, dict)
        or "heights" not in values
        or not set(values) <= {"heights", "age", "ahead", "left"}
    ):
        return None
    rows, age = values["heights"], values.get("age", 0.0)
    if not is_number(age) or not 0 <= age <= _MAX_AGE or not isinstance(rows, list):
        return None
    if not all(isinstance(row, list) for row in rows):
        return None
    check_grid(values, grid)
    shape = len(rows), len(rows[0]) if rows else 0
    if shape != (len(grid.ahead), len(grid.left)) or any(len(row) != shape[1] for row in rows):
        raise SurefootError(
            f"the map has {shape[0]} x {shape[1]} points, the policy {len(grid.ahead)} x {len(grid.left)}"
        )
    if not all(height is None or is_number(height) for row in rows for height in row):
        return None
    heights = np.array(rows, float).ravel()
    finite = np.isfinite(heights)
    if not finite.any():
        return None
    # As in training, unknown heights get the height under the base.
    distance = np.hypot(*np.meshgrid(grid.ahead, grid.left, indexing="ij")).ravel()
    heights[~finite] = heights[np.argmin(np.where(finite, distance, np.inf))]
    return _Map(np.clip(heights, -MAX_RELATIVE_HEIGHT, MAX_RELATIVE_HEIGHT), heights, float(age))


def send_map(
    port: int, heights: Sequence[Sequence[float | None]], age: float = 0.0, grid: HeightMap | None = None
) -> None:
    """Send a height map [m], `age` [s] old, to the channel on this computer, in the order that the module describes.

    `grid` states the positions of its points.
    """
    positions = {} if grid is None else {"ahead": list(grid.ahead), "left": list(grid.left)}
    send(port, {"heights": heights, "age": age, **positions})
