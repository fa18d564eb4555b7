"""The map of the ground's heights that another program sends to a policy with the observation `height_scan`.

The channel is UDP on this computer's loopback address. A datagram is one JSON object: `heights` [m], of the ground over
the base's origin, a list for each place of the grid ahead of it, from behind to ahead, each from the right to the left;
null where a height isn't known. `age` [s] is how old they are, 0 if left out. The contract of the policy has the grid,
in the heading frame. A datagram may state its own, as `ahead` and `left` [m], which must be the policy's. Other
datagrams are counted and ignored.
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

FRESH = 0.3
"""Time [s] over the age in training up to which a map is one to walk by; then the robot stands until the next one."""
_MAX_BYTES = 16384
_MAX_AGE = 10.0


@dataclass(frozen=True)
class _Map:
    heights: Array
    """(K,) [m], within the range of training."""
    sent: Array
    """The same as they were sent."""
    age: float
    """When it was sent [s]."""


class MapChannel(Channel[_Map]):
    """Maps of heights of another program, by UDP on the loopback address.

    Args:
        port: to listen on; 0 lets the system choose.
        grid: the policy's.
        clock: gives the time [s] by which maps age.

    Raises:
        SurefootError: the port is taken.
    """

    def __init__(self, port: int, grid: HeightMap, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__("height_map", port, self._parse_or_explain, _MAX_BYTES, clock)
        self.grid, self._limit = grid, grid.age + FRESH
        self.why = ""
        """Why the last datagram that was refused is no map of the policy's; empty, if it was not even a map."""
        self.age = np.inf
        """Age of the newest map [s], as of the last `read`."""

    def _parse_or_explain(self, values: Any) -> _Map | None:
        try:
            return _parse_map(values, self.grid)
        except SurefootError as error:
            self.why = str(error)
            raise

    def read(self) -> Array | None:
        """Return the newest map's heights (K,) [m]; None before the first one."""
        since, newest = self.receive(), self.newest
        self.age = np.inf if newest is None else newest.age + since
        return None if newest is None else newest.heights

    @property
    def is_fresh(self) -> bool:
        """Whether the map of the last `read` is one to walk by."""
        return bool(self.age < self._limit)


def _parse_map(values: Any, grid: HeightMap) -> _Map | None:
    """Return the map of a datagram's JSON; None if it is none, or has no height at all.

    Raises:
        SurefootError: a map of another grid.
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
    # As in training, what isn't known is as high as what is under the base.
    distance = np.hypot(*np.meshgrid(grid.ahead, grid.left, indexing="ij")).ravel()
    heights[~finite] = heights[np.argmin(np.where(finite, distance, np.inf))]
    return _Map(np.clip(heights, -MAX_RELATIVE_HEIGHT, MAX_RELATIVE_HEIGHT), heights, float(age))


def send_map(
    port: int, heights: Sequence[Sequence[float | None]], age: float = 0.0, grid: HeightMap | None = None
) -> None:
    """Send a map of heights [m], `age` [s] old, to the channel on this computer; see the module for its order.

    `grid` states where its points are.
    """
    places = {} if grid is None else {"ahead": list(grid.ahead), "left": list(grid.left)}
    send(port, {"heights": heights, "age": age, **places})
