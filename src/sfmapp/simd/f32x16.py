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

from sfmapp.simd import llvm

WIDTH = 16

FLOATS, INTS = ir.VectorType(llvm.F32, WIDTH), ir.VectorType(llvm.I32, WIDTH)
_BYTES = ir.VectorType(llvm.BYTE, WIDTH)
# a vector is one register, and instructions take any lanes of two
_IS_ONE_REGISTER = "+avx512f" in llvm.processor_features()
# vectors side by side that four rows of sums can have in registers
SUMS_WIDTH = WIDTH * (2 if _IS_ONE_REGISTER else 1)


class Row(types.Type):  # type: ignore[misc]
    """Numba's type of a vector of 16 floats."""

    def __init__(self) -> None:
        super().__init__(name="Row16xFloat32")


row = Row()


@register_model(Row)
class _RowModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, FLOATS)


@intrinsic
def load(typingctx: Any, base: Any, index: Any) -> Any:
    """``base[index : index + 16]`` of a pointer to float32."""
    return row(base, types.intp), llvm.loading(FLOATS, 4)


@intrinsic
def load_every_second(typingctx: Any, base: Any, index: Any) -> Any:
    """``base[index : index + 32 : 2]`` of a pointer to float32; all 32 are read."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        base, index = args
        after = builder.add(index, llvm.int64(WIDTH))
        parts = [llvm.load(builder, builder.gep(base, [place]), FLOATS, 4) for place in (index, after)]
        return builder.shuffle_vector(*parts, ir.Constant(INTS, list(range(0, 2 * WIDTH, 2))))

    return row(base, types.intp), codegen


@intrinsic
def load_bytes(typingctx: Any, base: Any, index: Any) -> Any:
    """``base[index : index + 16]`` of a pointer to uint8, as floats."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = llvm.load(builder, builder.gep(args[0], [args[1]]), _BYTES, 1)
        return builder.sitofp(builder.zext(value, INTS), FLOATS)

    return row(base, types.intp), codegen


@intrinsic
def store(typingctx: Any, base: Any, index: Any, value: Any) -> Any:
    """``base[index : index + 16] = value`` of a pointer to float32."""
    return types.void(base, types.intp, value), llvm.storing(4)


@intrinsic
def splat(typingctx: Any, scalar: Any) -> Any:
    """The same float32 in all lanes."""
    return row(types.float32), llvm.splatting(FLOATS)


@intrinsic
def ramp(typingctx: Any, first: Any, most: Any) -> Any:
    """``min(first + lane, most)`` of two float32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        first, most = (llvm.splat(builder, value, FLOATS) for value in args)
        value = builder.fadd(first, ir.Constant(FLOATS, [float(lane) for lane in range(WIDTH)]))
        return builder.select(builder.fcmp_ordered("<", value, most), value, most)

    return row(types.float32, types.float32), codegen


@intrinsic
def fma(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """``a * b + c`` with one rounding."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return llvm.fma(builder, *args)

    return row(a, b, c), codegen


def summing_along(reach: int) -> Any:
    """An intrinsic (base, index, weights) -> row: the sums of ``weights[n] * base[index + n - reach + lane]`` over all
    n up to 2 reach; base and weights are pointers to float32, and reach is at most 16.

    Loads that begin between lines of the cache cost twice as much as others, so where instructions take any lanes of
    two vectors neighbours come out of three.
    """

    @intrinsic
    def sum_along(typingctx: Any, base: Any, index: Any, weights: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            base, index, weights = args

            def at(step: int) -> Any:
                return llvm.load(builder, builder.gep(base, [builder.add(index, llvm.int64(step))]), FLOATS, 4)

            before, here, after = (at(step) for step in (-WIDTH, 0, WIDTH)) if _IS_ONE_REGISTER else (None,) * 3
            value = llvm.constant(FLOATS, 0.0)
            for n in range(-reach, reach + 1):
                if _IS_ONE_REGISTER:
                    pair, first = ((before, here), WIDTH + n) if n < 0 else ((here, after), n)
                    moved = builder.shuffle_vector(*pair, ir.Constant(INTS, list(range(first, first + WIDTH))))
                else:
                    moved = at(n)
                weight = builder.load(builder.gep(weights, [llvm.int64(n + reach)]))
                value = llvm.fma(builder, llvm.splat(builder, weight, FLOATS), moved, value)
            return value

        return row(base, types.intp, weights), codegen

    return sum_along


def summing_down(num_rows: int) -> Any:
    """An intrinsic (base, weights, steps, at, num, target, to, pitch) that fills SUMS_WIDTH floats in each of so many
    rows of target, ``pitch`` apart from ``to`` on: row r has the sums of ``weights[j + num_rows - 1 - r] *
    base[steps[j] + at + lane]`` over j up to num, so that each row read adds to all of them; ``steps`` is a pointer to
    int64, the others are to float32.
    """

    @intrinsic
    def sum_down(
        typingctx: Any, base: Any, weights: Any, steps: Any, at: Any, num: Any, target: Any, to: Any, pitch: Any
    ) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            base, weights, steps, at, num, target, to, pitch = args
            columns = [llvm.int64(c) for c in range(0, SUMS_WIDTH, WIDTH)]
            sums = [[cgutils.alloca_once(builder, FLOATS) for _ in columns] for _ in range(num_rows)]
            for slot in (slot for slots in sums for slot in slots):
                builder.store(llvm.constant(FLOATS, 0.0), slot)
            with cgutils.for_range(builder, num) as loop:
                place = builder.add(builder.load(builder.gep(steps, [loop.index])), at)
                pixels = [llvm.load(builder, builder.gep(base, [builder.add(place, c)]), FLOATS, 4) for c in columns]
                for r, slots in enumerate(sums):
                    number = builder.add(loop.index, llvm.int64(num_rows - 1 - r))
                    weight = llvm.splat(builder, builder.load(builder.gep(weights, [number])), FLOATS)
                    for pixel, slot in zip(pixels, slots, strict=True):
                        builder.store(llvm.fma(builder, weight, pixel, builder.load(slot)), slot)
            for r, slots in enumerate(sums):
                line = builder.add(to, builder.mul(pitch, llvm.int64(r)))
                for c, slot in zip(columns, slots, strict=True):
                    llvm.store(builder, builder.load(slot), builder.gep(target, [builder.add(line, c)]), 4)
            return context.get_dummy_value()

        places = types.intp, types.intp
        return types.void(base, weights, steps, *places, target, *places), codegen

    return sum_down


def _binary(operation: str) -> Callable[..., Any]:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return getattr(builder, operation)(*args)

    return codegen


@intrinsic
def add(typingctx: Any, a: Any, b: Any) -> Any:
    """``a + b``."""
    return row(a, b), _binary("fadd")


@intrinsic
def subtract(typingctx: Any, a: Any, b: Any) -> Any:
    """``a - b``."""
    return row(a, b), _binary("fsub")


@intrinsic
def multiply(typingctx: Any, a: Any, b: Any) -> Any:
    """``a * b``."""
    return row(a, b), _binary("fmul")


@intrinsic
def divide(typingctx: Any, a: Any, b: Any) -> Any:
    """``a / b``."""
    return row(a, b), _binary("fdiv")


@intrinsic
def total(typingctx: Any, value: Any) -> Any:
    """Sum of the lanes, halves folded onto each other."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value, width = args[0], WIDTH
        while width > 1:
            width //= 2
            kind = ir.VectorType(llvm.I32, width)
            halves = [ir.Constant(kind, list(range(first, first + width))) for first in (0, width)]
            value = builder.fadd(*(builder.shuffle_vector(value, value, half) for half in halves))
        return builder.extract_element(value, ir.Constant(llvm.I32, 0))

    return types.float32(value), codegen


def _chosen(comparison: str) -> Callable[..., Any]:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(comparison, *args), *args)

    return codegen


@intrinsic
def larger(typingctx: Any, a: Any, b: Any) -> Any:
    """``a if a > b else b`` of each lane."""
    return row(a, b), _chosen(">")


@intrinsic
def smaller(typingctx: Any, a: Any, b: Any) -> Any:
    """``a if a < b else b`` of each lane."""
    return row(a, b), _chosen("<")


def _lanes_where(comparison: str) -> Callable[..., Any]:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        bits = builder.bitcast(builder.fcmp_ordered(comparison, *args), ir.IntType(WIDTH))
        return builder.zext(bits, llvm.I64)

    return codegen


@intrinsic
def where_above(typingctx: Any, a: Any, b: Any) -> Any:
    """Whole number with bit n set where lane n has ``a > b``."""
    return types.intp(a, b), _lanes_where(">")


@intrinsic
def where_at_least(typingctx: Any, a: Any, b: Any) -> Any:
    """Whole number with bit n set where lane n has ``a >= b``."""
    return types.intp(a, b), _lanes_where(">=")
