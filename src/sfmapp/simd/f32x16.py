"""Sixteen floats at a time: a numba type for one row of an image patch.

Kernels over patches of up to 16 pixels a side keep each row in one vector and say so in their own code, since LLVM may
not reorder the sums of a scalar loop and so leaves them scalar. The type is LLVM's portable vector: AVX-512 holds it in
one register, AVX2 in two, NEON in four. Every multiply-add is one fused, correctly rounded operation and sums are
folded in a fixed order: the same bits on any machine.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

WIDTH = 16

_F32, _I32, _I64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_ROW = ir.VectorType(_F32, WIDTH)
_INTS = ir.VectorType(_I32, WIDTH)


class Row(types.Type):
    """Numba's type of a vector of 16 floats."""

    def __init__(self) -> None:
        super().__init__(name="Row16xFloat32")


row = Row()


@register_model(Row)
class _RowModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _ROW)


def _splat(builder: Any, scalar: Any) -> Any:
    empty = ir.Constant(_ROW, ir.Undefined)
    return builder.shuffle_vector(
        builder.insert_element(empty, scalar, ir.Constant(_I32, 0)), empty, ir.Constant(_INTS, [0] * WIDTH)
    )


def _fma(builder: Any, a: Any, b: Any, c: Any) -> Any:
    kind = ir.FunctionType(_ROW, [_ROW] * 3)
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, "llvm.fma.v16f32"), [a, b, c])


def _place(builder: Any, args: Any, kind: Any) -> Any:
    return builder.bitcast(builder.gep(args[0], [args[1]]), kind.as_pointer())


@intrinsic
def load(typingctx, base, index):  # type: ignore[no-untyped-def]
    """``base[index : index + 16]`` of a pointer to float32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = builder.load(_place(builder, args, _ROW))
        value.align = 4
        return value

    return row(base, types.intp), codegen


@intrinsic
def load_bytes(typingctx, base, index):  # type: ignore[no-untyped-def]
    """``base[index : index + 16]`` of a pointer to uint8, as floats."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = builder.load(_place(builder, args, ir.VectorType(ir.IntType(8), WIDTH)))
        value.align = 1
        return builder.sitofp(builder.zext(value, _INTS), _ROW)

    return row(base, types.intp), codegen


@intrinsic
def sample(typingctx, base, step, u, v):  # type: ignore[no-untyped-def]
    """Bilinear samples at columns u and rows v (16 floats each) of uint8 pixels about a pointer, rows step bytes apart.

    Two pixels of a row come with one 32-bit word: three bytes beyond the last pixel are read.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        words, places = ir.VectorType(_I32, WIDTH), ir.VectorType(_I64, WIDTH)
        pointers = ir.VectorType(_I32.as_pointer(), WIDTH)
        mask = ir.VectorType(ir.IntType(1), WIDTH)
        floor = cgutils.get_or_insert_function(builder.module, ir.FunctionType(_ROW, [_ROW]), "llvm.floor.v16f32")
        gather = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(words, [pointers, _I32, mask, words]), "llvm.masked.gather.v16i32.v16p0"
        )
        left, top = (builder.call(floor, [value]) for value in args[2:])
        fx, fy = builder.fsub(args[2], left), builder.fsub(args[3], top)
        empty, first = ir.Constant(places, ir.Undefined), ir.Constant(_I32, 0)
        here = builder.insert_element(empty, builder.ptrtoint(args[0], _I64), first)
        steps = builder.insert_element(empty, args[1], first)
        here, steps = (builder.shuffle_vector(value, empty, ir.Constant(_INTS, [0] * WIDTH)) for value in (here, steps))
        place = builder.add(here, builder.fptosi(left, places))
        place = builder.add(place, builder.mul(builder.fptosi(top, places), steps))
        rows = []
        for at in (place, builder.add(place, steps)):
            every, none = ir.Constant(mask, [1] * WIDTH), ir.Constant(words, ir.Undefined)
            pair = builder.call(gather, [builder.inttoptr(at, pointers), ir.Constant(_I32, 1), every, none])
            byte, eight = (ir.Constant(words, [value] * WIDTH) for value in (255, 8))
            one = builder.sitofp(builder.and_(pair, byte), _ROW)
            two = builder.sitofp(builder.and_(builder.lshr(pair, eight), byte), _ROW)
            rows.append(_fma(builder, fx, builder.fsub(two, one), one))
        return _fma(builder, fy, builder.fsub(rows[1], rows[0]), rows[0])

    return row(base, types.intp, u, v), codegen


@intrinsic
def store(typingctx, base, index, value):  # type: ignore[no-untyped-def]
    """``base[index : index + 16] = value`` of a pointer to float32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[2], _place(builder, args, _ROW)).align = 4
        return context.get_dummy_value()

    return types.void(base, types.intp, value), codegen


@intrinsic
def splat(typingctx, scalar):  # type: ignore[no-untyped-def]
    """The same float32 in all lanes."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _splat(builder, args[0])

    return row(types.float32), codegen


@intrinsic
def ramp(typingctx, first, most):  # type: ignore[no-untyped-def]
    """``min(first + lane, most)`` of two float32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        steps = ir.Constant(_ROW, [float(lane) for lane in range(WIDTH)])
        value, most = builder.fadd(_splat(builder, args[0]), steps), _splat(builder, args[1])
        return builder.select(builder.fcmp_ordered("<", value, most), value, most)

    return row(types.float32, types.float32), codegen


@intrinsic
def fma(typingctx, a, b, c):  # type: ignore[no-untyped-def]
    """``a * b + c`` with one rounding."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _fma(builder, *args)

    return row(a, b, c), codegen


def _binary(operation: str) -> Callable[..., Any]:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return getattr(builder, operation)(*args)

    return codegen


@intrinsic
def add(typingctx, a, b):  # type: ignore[no-untyped-def]
    """``a + b``."""
    return row(a, b), _binary("fadd")


@intrinsic
def subtract(typingctx, a, b):  # type: ignore[no-untyped-def]
    """``a - b``."""
    return row(a, b), _binary("fsub")


@intrinsic
def multiply(typingctx, a, b):  # type: ignore[no-untyped-def]
    """``a * b``."""
    return row(a, b), _binary("fmul")


@intrinsic
def divide(typingctx, a, b):  # type: ignore[no-untyped-def]
    """``a / b``."""
    return row(a, b), _binary("fdiv")


@intrinsic
def total(typingctx, value):  # type: ignore[no-untyped-def]
    """Sum of the lanes, halves folded onto each other."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value, width = args[0], WIDTH
        while width > 1:
            width //= 2
            kind = ir.VectorType(_I32, width)
            halves = [ir.Constant(kind, list(range(first, first + width))) for first in (0, width)]
            value = builder.fadd(*(builder.shuffle_vector(value, value, half) for half in halves))
        return builder.extract_element(value, ir.Constant(_I32, 0))

    return types.float32(value), codegen
