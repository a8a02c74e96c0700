"""Sixty-four bytes at a time: a numba type for costs of neighbouring disparities.

Sums saturate at 255 and differences at 0, which is what costs want: what is dear already may not become cheap. The type
is LLVM's portable vector: AVX-512 holds it in one register, AVX2 in two, NEON in four.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

from sfmapp.simd import llvm

WIDTH = 64

_BYTES, _SHORTS = ir.VectorType(llvm.BYTE, WIDTH), ir.VectorType(llvm.I16, WIDTH)


class Bytes(types.Type):  # type: ignore[misc]
    """Numba's type of a vector of 64 bytes."""

    def __init__(self) -> None:
        super().__init__(name="Bytes64")


vector = Bytes()


@register_model(Bytes)
class _BytesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _BYTES)


def _call(builder: Any, name: str, result: Any, args: list[Any]) -> Any:
    declared = ir.FunctionType(result, [arg.type for arg in args])
    return builder.call(cgutils.get_or_insert_function(builder.module, declared, name), args)


def _binary(name: str) -> Callable[..., Any]:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return llvm.intrinsic(builder, name, _BYTES, list(args))

    return codegen


@intrinsic
def load(typingctx: Any, base: Any, index: Any) -> Any:
    """``base[index : index + 64]`` of a pointer to uint8."""
    return vector(base, types.intp), llvm.loading(_BYTES, 1)


@intrinsic
def store(typingctx: Any, base: Any, index: Any, value: Any) -> Any:
    """``base[index : index + 64] = value`` of a pointer to uint8."""
    return types.void(base, types.intp, value), llvm.storing(1)


@intrinsic
def splat(typingctx: Any, scalar: Any) -> Any:
    """The same byte in all lanes."""
    return vector(types.uint8), llvm.splatting(_BYTES)


@intrinsic
def add(typingctx: Any, a: Any, b: Any) -> Any:
    """``min(a + b, 255)``."""
    return vector(a, b), _binary("uadd.sat")


@intrinsic
def subtract(typingctx: Any, a: Any, b: Any) -> Any:
    """``max(a - b, 0)``."""
    return vector(a, b), _binary("usub.sat")


@intrinsic
def minimum(typingctx: Any, a: Any, b: Any) -> Any:
    """``min(a, b)``."""
    return vector(a, b), _binary("umin")


@intrinsic
def maximum(typingctx: Any, a: Any, b: Any) -> Any:
    """``max(a, b)``."""
    return vector(a, b), _binary("umax")


@intrinsic
def mean(typingctx: Any, a: Any, b: Any) -> Any:
    """``(a + b + 1) // 2``."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        total = builder.add(*(builder.zext(arg, _SHORTS) for arg in args))
        total = builder.add(total, llvm.constant(_SHORTS, 1))
        return builder.trunc(builder.lshr(total, llvm.constant(_SHORTS, 1)), _BYTES)

    return vector(a, b), codegen


@intrinsic
def select_equal(typingctx: Any, a: Any, b: Any, equal: Any, other: Any) -> Any:
    """``equal`` where a == b, and ``other`` elsewhere."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(builder.icmp_unsigned("==", args[0], args[1]), args[2], args[3])

    return vector(a, b, equal, other), codegen


def _shifted(first: int) -> Callable[..., Any]:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        lanes = [lane if 0 <= lane < WIDTH else WIDTH for lane in range(first, first + WIDTH)]
        beyond = ir.Constant(_BYTES, [255] * WIDTH)
        return builder.shuffle_vector(args[0], beyond, ir.Constant(ir.VectorType(llvm.I32, WIDTH), lanes))

    return codegen


@intrinsic
def shift_up(typingctx: Any, a: Any) -> Any:
    """Lane k of ``a`` in lane k + 1; 255 comes in below."""
    return vector(a), _shifted(-1)


@intrinsic
def shift_down(typingctx: Any, a: Any) -> Any:
    """Lane k + 1 of ``a`` in lane k; 255 comes in above."""
    return vector(a), _shifted(1)


@intrinsic
def count_differences(typingctx: Any, word: Any, base: Any, index: Any) -> Any:
    """How many bits of a uint64 differ from each of the words ``base[index : index + 64]`` of a pointer to uint64."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        words = ir.VectorType(llvm.I64, WIDTH)
        others = llvm.load(builder, builder.gep(args[1], [args[2]]), words, 8)
        differing = builder.xor(others, llvm.splat(builder, args[0], words))
        return builder.trunc(_call(builder, f"llvm.ctpop.v{WIDTH}i64", words, [differing]), _BYTES)

    return vector(types.uint64, base, types.intp), codegen


@intrinsic
def keep_lower(typingctx: Any, value: Any, label: Any, values: Any, labels: Any, index: Any) -> Any:
    """Where a lane is below ``values[index : index + 64]`` (pointer to uint8) put it there, and ``label`` plus the
    lane's number into ``labels`` (pointer to int16)."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value, label, values, labels, index = args
        to, to_label = builder.gep(values, [index]), builder.gep(labels, [index])
        old, old_label = llvm.load(builder, to, _BYTES, 1), llvm.load(builder, to_label, _SHORTS, 2)
        numbers = ir.Constant(_SHORTS, list(range(WIDTH)))
        lower = builder.icmp_unsigned("<", value, old)
        new_label = builder.add(llvm.splat(builder, label, _SHORTS), numbers)
        llvm.store(builder, builder.select(lower, value, old), to, 1)
        llvm.store(builder, builder.select(lower, new_label, old_label), to_label, 2)
        return context.get_dummy_value()

    return types.void(value, types.int16, values, labels, types.intp), codegen


@intrinsic
def lowest(typingctx: Any, a: Any) -> Any:
    """The least lane."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _call(builder, f"llvm.vector.reduce.umin.v{WIDTH}i8", llvm.BYTE, [args[0]])

    return types.uint8(a), codegen


@intrinsic
def lanes_equal(typingctx: Any, a: Any, b: Any) -> Any:
    """A uint64 with a bit for each lane in which the two are equal."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(builder.icmp_unsigned("==", args[0], args[1]), llvm.I64)

    return types.uint64(a, b), codegen


@intrinsic
def hide(typingctx: Any, a: Any, lane: Any) -> Any:
    """``a`` with 255 in a lane and in those beside it."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        numbers = ir.Constant(_BYTES, list(range(1, WIDTH + 1)))
        apart = builder.sub(numbers, llvm.splat(builder, builder.trunc(args[1], llvm.BYTE), _BYTES))
        hidden = builder.icmp_unsigned("<=", apart, llvm.constant(_BYTES, 2))
        return builder.select(hidden, llvm.constant(_BYTES, 255), args[0])

    return vector(a, types.int64), codegen


@intrinsic
def within(typingctx: Any, a: Any, first: Any, last: Any, other: Any) -> Any:
    """``a`` in the lanes first to last - 1, ``other`` in the rest; first and last int64, from -2**31 to 2**31 - 1."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.VectorType(llvm.I32, WIDTH)
        numbers = ir.Constant(kind, list(range(WIDTH)))
        low, high = (llvm.splat(builder, builder.trunc(arg, llvm.I32), kind) for arg in args[1:3])
        inside = builder.and_(builder.icmp_signed(">=", numbers, low), builder.icmp_signed("<", numbers, high))
        return builder.select(inside, args[0], args[3])

    return vector(a, types.int64, types.int64, other), codegen
