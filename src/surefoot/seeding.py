"""Independent random generators by name, derived from one seed."""

from __future__ import annotations

import zlib

import numpy as np


def generator(seed: int, name: str, index: int = 0) -> np.random.Generator:
    """Return the random generator for a purpose (`name`) and a robot (`index`).

    The same three arguments always give the same stream; streams of different names or indices are independent.
    Therefore a robot's random numbers do not depend on the size of the batch.
    """
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, zlib.crc32(name.encode()), index])))


def generators(seed: int, name: str, count: int) -> list[np.random.Generator]:
    """Return the generators for a purpose, one per robot 0 to `count` - 1."""
    return [generator(seed, name, index) for index in range(count)]
