"""Access to MuJoCo's C functions and arrays from loops compiled by numba.

A MuJoCo step of a small robot takes some 15 microseconds, less than a few Python calls. Compiled loops that call MuJoCo
by address do not hold the interpreter lock, so that threads run in parallel.
"""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import mujoco
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

_MAX_STRUCT_SIZE = 1 << 20


def function_address(name: str) -> int:
    """Return the address of a C function in the MuJoCo library of the `mujoco` package."""
    folder = Path(mujoco.__file__).parent
    patterns = ("libmujoco.so.*", "libmujoco.*.dylib", "mujoco.dll")
    library = next(path for pattern in patterns for path in sorted(folder.glob(pattern)))
    function = getattr(ctypes.CDLL(str(library)), name)
    address = ctypes.cast(function, ctypes.c_void_p).value
    if address is None:
        raise OSError(f"{library}: has no function {name}")
    return address


@intrinsic
def call_step(typing_context: Any, function: Any, model: Any, data: Any) -> Any:
    """Call the C function `void function(model, data)`; all three arguments are addresses."""
    signature = types.void(types.int64, types.int64, types.int64)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, cgutils.voidptr_t])
        callee = builder.inttoptr(args[0], ir.PointerType(kind))
        builder.call(callee, [builder.inttoptr(arg, cgutils.voidptr_t) for arg in args[1:]])
        return context.get_dummy_value()

    return signature, codegen


def struct_offset(struct: int, pointer: int) -> int:
    """Return the offset [bytes] of a pointer in the C struct at an address.

    Raises:
        OSError: the struct does not contain the pointer.
    """
    for offset in range(0, _MAX_STRUCT_SIZE, 8):
        if ctypes.c_uint64.from_address(struct + offset).value == pointer:
            return offset
    raise OSError("MuJoCo's data does not contain the array's address")


def _array_at(element: Any) -> Any:
    @intrinsic
    def array(typing_context: Any, address: Any) -> Any:
        signature = types.CPointer(element)(types.int64)

        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.inttoptr(args[0], context.get_value_type(signature.return_type))

        return signature, codegen

    return array


pointers = _array_at(types.int64)
"""Return the array of C pointers at an address, as integers, without bounds checks."""
doubles = _array_at(types.float64)
"""Return the array of C doubles at an address, without bounds checks."""

ints = _array_at(types.int32)
"""Return the array of 32-bit C ints at an address, without bounds checks."""


@intrinsic
def fetch_and_increment(typing_context: Any, address: Any) -> Any:
    """Atomically increment the counter (int64) at an address, and return its previous value."""
    signature = types.int64(types.int64)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        counter = builder.inttoptr(args[0], ir.PointerType(ir.IntType(64)))
        return builder.atomic_rmw("add", counter, ir.Constant(ir.IntType(64), 1), "monotonic")

    return signature, codegen
