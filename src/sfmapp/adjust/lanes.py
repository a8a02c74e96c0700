"""Eight doubles at a time: the one arithmetic form that the whole adjustment spends its time in.

Everything between cameras lives in tiles of 8 x 8 doubles. Linearising, eliminating the points and factorising the
reduced system are then all updates ``C[x, :] (+|-)= sum_k A[k, x] B[k, :]`` with rows of eight. LLVM does not find this
in scalar loops (aliasing, wrap-around of indices), which costs a factor of five, so the vectors are written out here.
Products and sums are separate, correctly rounded operations in a fixed order on any machine: no fused multiply-add.

All functions take flat, C-contiguous float64 arrays and offsets into them:
``f(C, c, A, a, B, b, rows)`` updates ``C[c + 8 x : c + 8 x + 8]`` for x < rows from ``A[a + 8 k + x]`` and
``B[b + 8 k : b + 8 k + 8]``. B is read before C is written, so they may coincide.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

WIDTH = 8

_DOUBLE, _LANES = ir.DoubleType(), ir.VectorType(ir.DoubleType(), WIDTH)
_I32, _I64 = ir.IntType(32), ir.IntType(64)


def _load(builder: Any, pointer: Any) -> Any:
    value = builder.load(builder.bitcast(pointer, _LANES.as_pointer()))
    value.align = 8
    return value


def _splat(builder: Any, scalar: Any) -> Any:
    empty = ir.Constant(_LANES, ir.Undefined)
    one = builder.insert_element(empty, scalar, ir.Constant(_I32, 0))
    return builder.shuffle_vector(one, empty, ir.Constant(ir.VectorType(_I32, WIDTH), [0] * WIDTH))


def _update(depth: int, mode: str) -> Callable[..., Any]:
    """The code generator of one update: ``depth`` terms in the sum, mode ``add``, ``subtract`` or ``assign``."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def data(n: int) -> Any:
            return context.make_array(signature.args[n])(context, builder, args[n]).data

        target = builder.gep(data(0), [args[1]])
        left = builder.gep(data(2), [args[3]])
        right = builder.gep(data(4), [args[5]])
        rows = [_load(builder, builder.gep(right, [ir.Constant(_I64, WIDTH * k)])) for k in range(depth)]
        with cgutils.for_range(builder, args[6]) as loop:
            total = None
            for k in range(depth):
                scalar = builder.load(builder.gep(left, [builder.add(loop.index, ir.Constant(_I64, WIDTH * k))]))
                term = builder.fmul(_splat(builder, scalar), rows[k])
                total = term if total is None else builder.fadd(total, term)
            place = builder.gep(target, [builder.mul(loop.index, ir.Constant(_I64, WIDTH))])
            if mode != "assign":
                old = _load(builder, place)
                total = builder.fadd(old, total) if mode == "add" else builder.fsub(old, total)
            store = builder.store(total, builder.bitcast(place, _LANES.as_pointer()))
            store.align = 8
        return context.get_dummy_value()

    return codegen


def _signature(c: Any, a: Any, b: Any) -> Any:
    i = types.intp
    return types.void(c, i, a, i, b, i, i)


@intrinsic
def add2(typingctx, C, c, A, a, B, b, rows):  # type: ignore[no-untyped-def]
    """``C += A^T B``, two terms."""
    return _signature(C, A, B), _update(2, "add")


@intrinsic
def subtract3(typingctx, C, c, A, a, B, b, rows):  # type: ignore[no-untyped-def]
    """``C -= A^T B``, three terms."""
    return _signature(C, A, B), _update(3, "subtract")


@intrinsic
def assign3(typingctx, C, c, A, a, B, b, rows):  # type: ignore[no-untyped-def]
    """``C = A^T B``, three terms."""
    return _signature(C, A, B), _update(3, "assign")


@intrinsic
def subtract8(typingctx, C, c, A, a, B, b, rows):  # type: ignore[no-untyped-def]
    """``C -= A^T B``, eight terms."""
    return _signature(C, A, B), _update(8, "subtract")


@intrinsic
def assign8(typingctx, C, c, A, a, B, b, rows):  # type: ignore[no-untyped-def]
    """``C = A^T B``, eight terms."""
    return _signature(C, A, B), _update(8, "assign")
