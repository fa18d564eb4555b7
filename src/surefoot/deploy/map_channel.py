"""The map of the ground's heights that another program sends to a policy with the observation `height_scan`.

The channel is UDP on this computer's loopback address. A datagram is one JSON object: `heights` [m], of the ground over
the base's origin, a list for each place of the grid ahead of it, from behind to ahead, each from the right to the left;
null where a height isn't known. `age` [s] is how old they are, 0 if left out. The contract of the policy has the grid,
in the heading frame. Other datagrams are counted and ignored.
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
from surefoot.policy.contract import HeightMap
from surefoot.task.height_scan import RANGE

FRESH = 0.3
"""Time [s] over the age in training up to which a map is one to walk by; then the robot stands until the next one."""
_MAX_BYTES = 16384
_MAX_AGE = 10.0


@dataclass(frozen=True)
class _Map:
    heights: Array
    """(K,) [m]"""
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
        super().__init__("height_map", port, lambda values: _parse_map(values, grid), _MAX_BYTES, clock)
        self._limit = grid.age + FRESH
        self.age = np.inf
        """Age of the newest map [s], as of the last `read`."""

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
    """Return the map of a datagram's JSON; None if it is none of this grid, or has no height at all."""
    if not isinstance(values, dict) or "heights" not in values or not set(values) <= {"heights", "age"}:
        return None
    rows, age = values["heights"], values.get("age", 0.0)
    if not is_number(age) or not 0 <= age <= _MAX_AGE or not isinstance(rows, list) or len(rows) != len(grid.ahead):
        return None
    if not all(isinstance(row, list) and len(row) == len(grid.left) for row in rows):
        return None
    if not all(height is None or is_number(height) for row in rows for height in row):
        return None
    heights = np.array(rows, float).ravel()
    finite = np.isfinite(heights)
    if not finite.any():
        return None
    # As in training, what isn't known is as high as what is under the base.
    distance = np.hypot(*np.meshgrid(grid.ahead, grid.left, indexing="ij")).ravel()
    heights[~finite] = heights[np.argmin(np.where(finite, distance, np.inf))]
    return _Map(np.clip(heights, -RANGE, RANGE), float(age))


def send_map(port: int, heights: Sequence[Sequence[float | None]], age: float = 0.0) -> None:
    """Send a map of heights [m], `age` [s] old, to the channel on this computer; see the module for its order."""
    send(port, {"heights": heights, "age": age})
