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

WIDTH = 8

_DOUBLE, _LANES = ir.DoubleType(), ir.VectorType(ir.DoubleType(), WIDTH)
_I32, _I64 = ir.IntType(32), ir.IntType(64)


@intrinsic
def pointer(typingctx, array):  # type: ignore[no-untyped-def]
    """Pointer to the first element of an array that the caller keeps alive.

    Handed to another kernel, an array costs two atomic operations for its reference count, on every call, and indexing
    it looks at the sign of the index; a pointer does neither. A local array must be used again after its last pointer.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return context.make_array(signature.args[0])(context, builder, args[0]).data

    return types.CPointer(array.dtype)(array), codegen


@intrinsic
def offset(typingctx, base, count):  # type: ignore[no-untyped-def]
    """The pointer ``count`` elements further on."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.gep(args[0], [args[1]])

    return base(base, types.intp), codegen


def _data(context: Any, builder: Any, signature: Any, args: Any, n: int) -> Any:
    kind = signature.args[n]
    return args[n] if isinstance(kind, types.CPointer) else context.make_array(kind)(context, builder, args[n]).data


def _load(builder: Any, pointer: Any) -> Any:
    value = builder.load(builder.bitcast(pointer, _LANES.as_pointer()))
    value.align = 8
    return value


def _store(builder: Any, value: Any, pointer: Any) -> None:
    store = builder.store(value, builder.bitcast(pointer, _LANES.as_pointer()))
    store.align = 8


def _fma(builder: Any, a: Any, b: Any, c: Any) -> Any:
    kind = ir.FunctionType(_LANES, [_LANES] * 3)
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, "llvm.fma.v8f64"), [a, b, c])


def _splat(builder: Any, scalar: Any) -> Any:
    empty = ir.Constant(_LANES, ir.Undefined)
    one = builder.insert_element(empty, scalar, ir.Constant(_I32, 0))
    return builder.shuffle_vector(one, empty, ir.Constant(ir.VectorType(_I32, WIDTH), [0] * WIDTH))


def _update(depth: int, mode: str) -> Callable[..., Any]:
    """The code generator of one update: ``depth`` terms in the sum, mode ``add``, ``subtract`` or ``assign``."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def data(n: int) -> Any:
            return _data(context, builder, signature, args, n)

        target = builder.gep(data(0), [args[1]])
        left = builder.gep(data(2), [args[3]])
        right = builder.gep(data(4), [args[5]])
        rows = [_load(builder, builder.gep(right, [ir.Constant(_I64, WIDTH * k)])) for k in range(depth)]
        if mode == "subtract":
            rows = [builder.fneg(row) for row in rows]
        with cgutils.for_range(builder, args[6]) as loop:
            place = builder.gep(target, [builder.mul(loop.index, ir.Constant(_I64, WIDTH))])
            total = ir.Constant(_LANES, None) if mode == "assign" else _load(builder, place)
            for k in range(depth):
                scalar = builder.load(builder.gep(left, [builder.add(loop.index, ir.Constant(_I64, WIDTH * k))]))
                total = _fma(builder, _splat(builder, scalar), rows[k], total)
            _store(builder, total, place)
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


@intrinsic
def store8(typingctx, C, c, v0, v1, v2, v3, v4, v5, v6, v7):  # type: ignore[no-untyped-def]
    """``C[c : c + 8] = v0..v7`` in one store: a vector load soon after waits long for eight single stores."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        row = ir.Constant(_LANES, ir.Undefined)
        for k in range(WIDTH):
            row = builder.insert_element(row, args[2 + k], ir.Constant(_I32, k))
        _store(builder, row, builder.gep(_data(context, builder, signature, args, 0), [args[1]]))
        return context.get_dummy_value()

    return types.void(C, types.intp, *[types.float64] * WIDTH), codegen


@intrinsic
def spread(typingctx, C, c, base, A, a, slots, units, first, last):  # type: ignore[no-untyped-def]
    """Two rows ``C[c + 8 x :] = base[8 x :] + sum_n A[a + 2 slots[n] + x] units[8 n :]`` for first <= n < last."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def data(n: int) -> Any:
            return _data(context, builder, signature, args, n)

        target, left, slot, unit = builder.gep(data(0), [args[1]]), builder.gep(data(3), [args[4]]), data(5), data(6)
        sums = []
        for x in range(2):
            total = cgutils.alloca_once(builder, _LANES)
            builder.store(_load(builder, builder.gep(data(2), [ir.Constant(_I64, WIDTH * x)])), total)
            sums.append(total)
        with cgutils.for_range_slice(builder, args[7], args[8], ir.Constant(_I64, 1), inc=True) as (n, _):
            row = _load(builder, builder.gep(unit, [builder.mul(n, ir.Constant(_I64, WIDTH))]))
            place = builder.mul(builder.load(builder.gep(slot, [n])), ir.Constant(_I64, 2))
            for x in range(2):
                scalar = builder.load(builder.gep(left, [builder.add(place, ir.Constant(_I64, x))]))
                builder.store(_fma(builder, _splat(builder, scalar), row, builder.load(sums[x])), sums[x])
        for x in range(2):
            _store(builder, builder.load(sums[x]), builder.gep(target, [ir.Constant(_I64, WIDTH * x)]))
        return context.get_dummy_value()

    i = types.intp
    return types.void(C, i, base, A, i, slots, units, i, i), codegen
