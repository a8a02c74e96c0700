"""Kernels that others reach through a pointer: compiled once, and loaded when one is called for the first time.

numba copies whatever a kernel calls into its machine code. Where a dozen kernels call something large that they seldom
need, that is a dozen copies to compile, to keep and to load. What is shared stands in its own place; the others hold
the name of a cell, in which its address is written at the first call.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from typing import Any, TypeAlias

import numba
from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from sfmapp.simd.llvm import F64, data
from sfmapp.simd.pointers import Pointer

# what is shared takes pointers to numbers: those of its object, those that it is given, and those that it fills in
Kernel: TypeAlias = Callable[[Pointer, Pointer, Pointer], None]
_NUMBERS = types.CPointer(types.float64)
_SIGNATURE = types.void(_NUMBERS, _NUMBERS, _NUMBERS)
_TYPE = ir.FunctionType(ir.VoidType(), [F64.as_pointer()] * 3)
_Callback = ctypes.CFUNCTYPE(None, *[ctypes.POINTER(ctypes.c_double)] * 3)
# cells and callbacks, which machine code points to
_KEPT: list[Any] = []


def _provide(name: str, kernel: Kernel) -> None:
    """Give the cell of a kernel an address: that of a callback which compiles it, or loads it, and puts it there."""

    def first_call(*pointers: Any) -> None:
        for n in range(3):
            pointers[2][n] = math.nan  # an exception cannot leave a callback
        compiled = numba.cfunc(_SIGNATURE, cache=True)(kernel)
        _KEPT.append(compiled)
        cell.value = compiled.address
        compiled.ctypes(*pointers)

    callback = _Callback(first_call)
    cell = ctypes.c_void_p(ctypes.cast(callback, ctypes.c_void_p).value)
    _KEPT.append((cell, callback))
    binding.add_symbol(name, ctypes.addressof(cell))


def _call(builder: Any, name: str, pointers: list[Any]) -> None:
    """Call what the cell of a name points to."""
    cell = builder.module.globals.get(name) or ir.GlobalVariable(builder.module, _TYPE.as_pointer(), name)
    builder.call(builder.load(cell), [builder.bitcast(pointer, F64.as_pointer()) for pointer in pointers])


def _are_numbers(*kinds: Any) -> bool:
    """Whether types are pointers to doubles, or arrays of such without gaps."""
    return all(
        kind.dtype == types.float64 and getattr(kind, "layout", "C") == "C"
        for kind in kinds
        if isinstance(kind, types.Array | types.CPointer)
    )


def shared_function(name: str, kernel: Kernel) -> Any:
    """An intrinsic (array, x, y, z) -> (a, b, c) that calls a kernel (array, (x, y, z), (a, b, c)) which all share.

    Args:
        name: of its cell; cached machine code knows it by that, so it stays the same for good.
        kernel: a Python function of three pointers.
    """
    _provide(name, kernel)

    @intrinsic
    def reach(typingctx: Any, array: Any, x: Any, y: Any, z: Any) -> Any:
        if not _are_numbers(array):
            return None

        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            given, found = (cgutils.alloca_once(builder, ir.ArrayType(F64, 3)) for _ in range(2))
            for n in range(3):
                builder.store(args[1 + n], cgutils.gep_inbounds(builder, given, 0, n))
            _call(builder, name, [data(context, builder, signature, args, 0), given, found])
            values = [builder.load(cgutils.gep_inbounds(builder, found, 0, n)) for n in range(3)]
            return context.make_tuple(builder, signature.return_type, values)

        return types.UniTuple(types.float64, 3)(array, types.float64, types.float64, types.float64), codegen

    return reach


def shared_filler(name: str, kernel: Kernel) -> Any:
    """As :func:`shared_function`, of an intrinsic (array, x, y, z, out) that has an array filled."""
    _provide(name, kernel)

    @intrinsic
    def reach(typingctx: Any, array: Any, x: Any, y: Any, z: Any, out: Any) -> Any:
        if not _are_numbers(array, out):
            return None

        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            given = cgutils.alloca_once(builder, ir.ArrayType(F64, 3))
            for n in range(3):
                builder.store(args[1 + n], cgutils.gep_inbounds(builder, given, 0, n))
            filled = data(context, builder, signature, args, 4)
            _call(builder, name, [data(context, builder, signature, args, 0), given, filled])
            return context.get_dummy_value()

        return types.void(array, types.float64, types.float64, types.float64, out), codegen

    return reach
