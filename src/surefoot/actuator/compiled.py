"""How kernels with arrays are compiled: into their caller, without counting references.

numba counts a reference, an atomic operation, whenever an array is taken out of a named tuple or sliced; the loop over
servo steps had some 500 places that do. Without numba's runtime there are none, and a kernel that would allocate memory
in an inner loop does not compile. Whoever calls from Python owns the arrays. Division is IEEE's: a check for a zero
divisor would be an exception to raise, and a branch in every kernel. Both together took the world of 64 to 256 robots
from .83 of MuJoCo's bare speed to over .9; which of them does how much was not measured.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile a function for inner loops, which takes arrays or named tuples of them and allocates nothing."""
    return cast(Function, njit(cache=True, forceinline=True, error_model="numpy", _nrt=False)(function))
