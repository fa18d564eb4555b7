"""Compilation of kernels that take arrays: inlined into their caller, without reference counting.

numba counts references, with an atomic operation, whenever an array is taken out of a named tuple or sliced; the loop
over servo steps had some 500 such places. Without numba's runtime there are none, and a kernel that would allocate
memory in an inner loop does not compile. The Python caller owns the arrays. Division follows IEEE 754, without a branch
for a zero divisor. Together this raised the speed of a world of 64 to 256 robots from 0.83 to over 0.9 of MuJoCo's
bare speed.

numba caches compiled functions next to their source and checks only the age of that file. A loop that inlines a kernel
of another module would keep the old kernel after an edit, and a cache that names a class which was renamed can't be
read. Therefore, all caches are deleted whenever a source changes.
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
_FOLDERS = [_PACKAGE / name for name in ("actuator", "world", "emulator", "report/drawing")]
"""Folders with compiled kernels."""


def kernel(function: Function) -> Function:
    """Compile a function for inner loops, which takes arrays or named tuples of arrays and allocates no memory."""
    return cast(Function, njit(cache=True, forceinline=True, error_model="numpy", _nrt=False)(function))


def kernel_sources() -> list[Path]:
    """Return the source files of the kernels, and of the constants and functions that they use."""
    return sorted(path for folder in (_PACKAGE, _PACKAGE / "robot", *_FOLDERS) for path in folder.glob("*.py"))


def drop_stale_caches() -> None:
    """Delete the cached kernels if their sources have changed since they were compiled."""
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in kernel_sources())).hexdigest()
    stamp = _FOLDERS[0] / "__pycache__" / "kernels.sha256"
    # If the folder is not writable, the package is installed and its sources do not change.
    with contextlib.suppress(OSError):
        if stamp.is_file() and stamp.read_text() == digest:
            return
        for folder in _FOLDERS:
            for pattern in ("*.nbi", "*.nbc"):
                for path in (folder / "__pycache__").glob(pattern):
                    path.unlink(missing_ok=True)
        stamp.parent.mkdir(exist_ok=True)
        stamp.write_text(digest)
