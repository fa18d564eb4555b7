"""PyBullet, imported and called without what it prints."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType


@contextmanager
def quiet() -> Iterator[None]:
    """Nothing that C code prints reaches the user's stdout or stderr."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()
    saved = [os.dup(descriptor) for descriptor in (1, 2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for descriptor in (1, 2):
            os.dup2(nowhere, descriptor)
        yield
    finally:
        ctypes.CDLL(None).fflush(None)  # C keeps what it prints to a pipe until later
        for descriptor, was in zip((1, 2), saved, strict=True):
            os.dup2(was, descriptor)
            os.close(was)
        os.close(nowhere)


def import_pybullet() -> ModuleType:
    """PyBullet, without its greeting.

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    if "pybullet" in sys.modules:
        return sys.modules["pybullet"]
    with quiet():
        import pybullet
    module: ModuleType = pybullet
    return module
