"""Compilation of kernels with arrays: inlined into their caller, without reference counts.

numba counts references, an atomic operation, whenever an array is taken out of a named tuple or sliced; the loop over
servo steps had some 500 such places. Without numba's runtime there are none, and a kernel that would allocate memory
in an inner loop does not compile. The Python caller owns the arrays. Division is IEEE's, without a branch for a zero
divisor in every kernel. Both together took the world of 64 to 256 robots from .83 of MuJoCo's bare speed to over .9.

numba caches compiled functions beside their source and checks only that file's age. A loop that inlines a law of
another module would keep the old law after an edit. So all caches are deleted whenever a source has changed.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

from numba import njit

Function = TypeVar("Function", bound=Callable[..., Any])

_PACKAGE = Path(__file__).parents[1]
_FOLDERS = [_PACKAGE / "actuator", _PACKAGE / "world"]
"""Folders with compiled kernels."""


def kernel(function: Function) -> Function:
    """Compile a function for inner loops, which takes arrays or named tuples of them and allocates nothing."""
    return cast(Function, njit(cache=True, forceinline=True, error_model="numpy", _nrt=False)(function))


def kernel_sources() -> list[Path]:
    """Return the files that kernels are compiled from, or take constants and functions from."""
    folders = [_PACKAGE, *(_PACKAGE / name for name in ("actuator", "robot", "world"))]
    return sorted(path for folder in folders for path in folder.glob("*.py"))


def drop_stale_caches() -> None:
    """Delete the caches beside the kernels if the sources differ from those that they were compiled from."""
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in kernel_sources())).hexdigest()
    stamp = _FOLDERS[0] / "__pycache__" / "kernels.sha256"
    # Where the folder can't be written, the package is installed and its sources do not change.
    with contextlib.suppress(OSError):
        if stamp.is_file() and stamp.read_text() == digest:
            return
        for folder in _FOLDERS:
            for pattern in ("*.nbi", "*.nbc"):
                for path in (folder / "__pycache__").glob(pattern):
                    path.unlink(missing_ok=True)
        stamp.parent.mkdir(exist_ok=True)
        stamp.write_text(digest)
