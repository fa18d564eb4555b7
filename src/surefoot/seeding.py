"""One seed in, named generators out."""

from __future__ import annotations

import zlib

import numpy as np


def generator(seed: int, name: str, index: int = 0) -> np.random.Generator:
    """Return the random generator of one purpose and one robot; the same three always give the same stream.

    Streams of different names or indices are independent, so a robot draws the same in any batch.
    """
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, zlib.crc32(name.encode()), index])))


def generators(seed: int, name: str, count: int) -> list[np.random.Generator]:
    """Return the generators of one purpose for robots 0 to `count` - 1."""
    return [generator(seed, name, index) for index in range(count)]
