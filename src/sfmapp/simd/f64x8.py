"""Eight doubles at a time: the one arithmetic form that the whole adjustment spends its time in.

Everything between cameras lives in tiles of 8 x 8 doubles. Linearising, eliminating the points and factorising the
reduced system are then all updates ``C[x, :] (+|-)= sum_k A[k, x] B[k, :]`` with rows of eight. LLVM does not find this
in scalar loops (aliasing, wrap-around of indices), which costs a factor of five, so the vectors are written out here.
Every multiply-add is one fused, correctly rounded operation in a fixed order: the same bits on any machine.

The updates take flat, C-contiguous float64 arrays, or pointers to such, and offsets into them:
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

from sfmapp.simd.llvm import F64, I32, data, fma, int64, load, splat, store

WIDTH = 8

_LANES = ir.VectorType(F64, WIDTH)


def _load(builder: Any, pointer: Any) -> Any:
    return load(builder, pointer, _LANES, 8)


def _update(depth: int, mode: str) -> Callable[..., Any]:
    """The code generator of one update: ``depth`` terms in the sum, mode ``add``, ``subtract`` or ``assign``."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def place_of(n: int) -> Any:
            return data(context, builder, signature, args, n)

        target = builder.gep(place_of(0), [args[1]])
        left = builder.gep(place_of(2), [args[3]])
        right = builder.gep(place_of(4), [args[5]])
        rows = [_load(builder, builder.gep(right, [int64(WIDTH * k)])) for k in range(depth)]
        if mode == "subtract":
            rows = [builder.fneg(row) for row in rows]
        with cgutils.for_range(builder, args[6]) as loop:
            place = builder.gep(target, [builder.mul(loop.index, int64(WIDTH))])
            total = ir.Constant(_LANES, None) if mode == "assign" else _load(builder, place)
            for k in range(depth):
                scalar = builder.load(builder.gep(left, [builder.add(loop.index, int64(WIDTH * k))]))
                total = fma(builder, splat(builder, scalar, _LANES), rows[k], total)
            store(builder, total, place, 8)
        return context.get_dummy_value()

    return codegen


def _signature(c: Any, a: Any, b: Any) -> Any:
    i = types.intp
    return types.void(c, i, a, i, b, i, i)


@intrinsic
def add2(typingctx: Any, C: Any, c: Any, A: Any, a: Any, B: Any, b: Any, rows: Any) -> Any:
    """``C += A^T B``, two terms."""
    return _signature(C, A, B), _update(2, "add")


@intrinsic
def add8(typingctx: Any, C: Any, c: Any, A: Any, a: Any, B: Any, b: Any, rows: Any) -> Any:
    """``C += A^T B``, eight terms."""
    return _signature(C, A, B), _update(8, "add")


@intrinsic
def subtract3(typingctx: Any, C: Any, c: Any, A: Any, a: Any, B: Any, b: Any, rows: Any) -> Any:
    """``C -= A^T B``, three terms."""
    return _signature(C, A, B), _update(3, "subtract")


@intrinsic
def assign3(typingctx: Any, C: Any, c: Any, A: Any, a: Any, B: Any, b: Any, rows: Any) -> Any:
    """``C = A^T B``, three terms."""
    return _signature(C, A, B), _update(3, "assign")


@intrinsic
def subtract8(typingctx: Any, C: Any, c: Any, A: Any, a: Any, B: Any, b: Any, rows: Any) -> Any:
    """``C -= A^T B``, eight terms."""
    return _signature(C, A, B), _update(8, "subtract")


@intrinsic
def assign8(typingctx: Any, C: Any, c: Any, A: Any, a: Any, B: Any, b: Any, rows: Any) -> Any:
    """``C = A^T B``, eight terms."""
    return _signature(C, A, B), _update(8, "assign")


@intrinsic
def store8(
    typingctx: Any, C: Any, c: Any, v0: Any, v1: Any, v2: Any, v3: Any, v4: Any, v5: Any, v6: Any, v7: Any
) -> Any:
    """``C[c : c + 8] = v0..v7`` in one store: a vector load soon after waits long for eight single stores."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        row = ir.Constant(_LANES, ir.Undefined)
        for k in range(WIDTH):
            row = builder.insert_element(row, args[2 + k], ir.Constant(I32, k))
        store(builder, row, builder.gep(data(context, builder, signature, args, 0), [args[1]]), 8)
        return context.get_dummy_value()

    return types.void(C, types.intp, *[types.float64] * WIDTH), codegen


@intrinsic
def spread(
    typingctx: Any, C: Any, c: Any, base: Any, A: Any, a: Any, slots: Any, units: Any, first: Any, last: Any
) -> Any:
    """Two rows ``C[c + 8 x :] = base[8 x :] + sum_n A[a + 2 slots[n] + x] units[8 n :]`` for first <= n < last.

    slots: int64.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def place_of(n: int) -> Any:
            return data(context, builder, signature, args, n)

        target, left = builder.gep(place_of(0), [args[1]]), builder.gep(place_of(3), [args[4]])
        slot, unit = place_of(5), place_of(6)
        sums = []
        for x in range(2):
            total = cgutils.alloca_once(builder, _LANES)
            builder.store(_load(builder, builder.gep(place_of(2), [int64(WIDTH * x)])), total)
            sums.append(total)
        with cgutils.for_range_slice(builder, args[7], args[8], int64(1), inc=True) as (n, _):
            row = _load(builder, builder.gep(unit, [builder.mul(n, int64(WIDTH))]))
            place = builder.mul(builder.load(builder.gep(slot, [n])), int64(2))
            for x in range(2):
                scalar = builder.load(builder.gep(left, [builder.add(place, int64(x))]))
                builder.store(fma(builder, splat(builder, scalar, _LANES), row, builder.load(sums[x])), sums[x])
        for x in range(2):
            store(builder, builder.load(sums[x]), builder.gep(target, [int64(WIDTH * x)]), 8)
        return context.get_dummy_value()

    i = types.intp
    return types.void(C, i, base, A, i, slots, units, i, i), codegen
