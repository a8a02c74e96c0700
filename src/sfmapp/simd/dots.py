"""Dot products of whole numbers below 256, many at a time.

Processors have an instruction that multiplies neighbouring numbers of two vectors and adds these products to 32-bit
sums: four bytes a sum (vpdpbusd, where there is VNNI), or two 16-bit numbers (pmaddwd, vpdpwssd, smlal). Numba's own
loops find neither, so the innermost tile of a product of two matrices is written here: by bytes where the processor
that numba compiles for has them, otherwise by 16-bit numbers in the one pattern that every back end knows. Either way
the sums are exact, so neither the instruction nor the order of summation matters to the result.

The instruction for bytes takes signed ones on one side. The second matrix is therefore stored less 128, and the sums of
a row of the first begin with 128 times the sum of the row: it lies behind its numbers.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from sfmapp.simd.llvm import BYTE, I16, I32, constant, data, int64, load, processor_features, splat, store
from sfmapp.simd.llvm import intrinsic as intrinsic_of

DIMS = 128  # numbers of a row
BLOCK = 256  # rows of either matrix that eight bits tell apart
LANES = 16  # rows of the second matrix that share a vector of 32-bit sums
_SUMS, _PRODUCTS = ir.VectorType(I32, LANES), ir.VectorType(I32, 2 * LANES)
_PAIRS = ir.VectorType(I16, 2 * LANES)
_SUM_BYTES, _VECTOR_BYTES = 4, 4 * LANES


# 512 bits at a time, or 256; 0: the processor has no products of bytes
_BYTES_WIDTH = 512 if "+avx512vnni" in processor_features() else 256 if "+avxvnni" in processor_features() else 0
# rows of the first matrix, and groups of LANES of the second, in a tile: as many vectors of sums as stay in registers
ROWS, GROUPS = 8 if "+avx512f" in processor_features() else 2, 2
# the form of both matrices in which the tile is the fastest here, and what the second is stored less
ROW_TYPE: Any
GROUP_TYPE: Any
ROW_TYPE, GROUP_TYPE, OFFSET = (np.uint8, np.int8, 128) if _BYTES_WIDTH else (np.int16, np.int16, 0)
PER_SUM = _SUM_BYTES // np.dtype(ROW_TYPE).itemsize  # numbers that one 32-bit sum takes up at a time


def _add_products_of_pairs(builder: Any, total: Any, line: Any, column: Any) -> Any:
    undefined = ir.Constant(_PRODUCTS, ir.Undefined)
    halves = [ir.Constant(_SUMS, [2 * lane + odd for lane in range(LANES)]) for odd in (0, 1)]
    pairs = [builder.sext(builder.bitcast(side, _PAIRS), _PRODUCTS) for side in (line, column)]
    products = builder.mul(*pairs, flags=("nsw",))
    return builder.add(total, builder.add(*(builder.shuffle_vector(products, undefined, half) for half in halves)))


def _add_products_of_bytes(builder: Any, total: Any, line: Any, column: Any) -> Any:
    # in the types of LLVM up to 21, which later ones translate
    lanes = _BYTES_WIDTH // 32
    kind, undefined = ir.VectorType(I32, lanes), ir.Constant(_SUMS, ir.Undefined)
    declared = ir.FunctionType(kind, [kind] * 3)
    dot = cgutils.get_or_insert_function(builder.module, declared, f"llvm.x86.avx512.vpdpbusd.{_BYTES_WIDTH}")
    if lanes == LANES:
        return builder.call(dot, [total, line, column])
    parts = []
    for first in (0, lanes):
        places = ir.Constant(ir.VectorType(I32, lanes), list(range(first, first + lanes)))
        parts.append(builder.call(dot, [builder.shuffle_vector(v, undefined, places) for v in (total, line, column)]))
    return builder.shuffle_vector(*parts, ir.Constant(ir.VectorType(I32, LANES), list(range(LANES))))


def _sums_of_tile(context: Any, builder: Any, signature: Any, args: Any) -> list[list[Any]]:
    """Slots with the products of a tile, by row and group; the first four of args are a, packed, row and group."""
    by_bytes = signature.args[1].dtype == types.int8
    number_bytes, add_products = (1, _add_products_of_bytes) if by_bytes else (2, _add_products_of_pairs)
    row_bytes, num_steps = DIMS * number_bytes + _SUM_BYTES, DIMS * number_bytes // _SUM_BYTES
    p_a, p_packed = (builder.bitcast(data(context, builder, signature, args, k), BYTE.as_pointer()) for k in (0, 1))
    lines = [builder.gep(p_a, [builder.mul(builder.add(args[2], int64(r)), int64(row_bytes))]) for r in range(ROWS)]
    columns = [
        builder.gep(p_packed, [builder.mul(builder.add(args[3], int64(g)), int64(num_steps * _VECTOR_BYTES))])
        for g in range(GROUPS)
    ]
    totals = [[cgutils.alloca_once(builder, _SUMS) for _ in range(GROUPS)] for _ in range(ROWS)]
    for line, slots in zip(lines, totals, strict=True):
        first = splat(builder, load(builder, builder.gep(line, [int64(DIMS * number_bytes)]), I32, 2), _SUMS)
        for slot in slots:
            builder.store(first, slot)
    with cgutils.for_range(builder, int64(num_steps)) as loop:
        place = builder.mul(loop.index, int64(_VECTOR_BYTES))
        vectors = [load(builder, builder.gep(column, [place]), _SUMS, 2) for column in columns]
        for line, slots in zip(lines, totals, strict=True):
            at = builder.gep(line, [builder.mul(loop.index, int64(_SUM_BYTES))])
            repeated = splat(builder, load(builder, at, I32, 2), _SUMS)
            for vector, slot in zip(vectors, slots, strict=True):
                builder.store(add_products(builder, builder.load(slot), repeated, vector), slot)
    return totals


@intrinsic
def tile(
    typingctx: Any, a: Any, packed: Any, row: Any, group: Any, sums: Any, masks: Any, second1: Any, second2: Any
) -> Any:
    """Products of rows ``row..row + ROWS`` of a with groups ``group..group + GROUPS`` of packed that exceed a bound.

    Row q of the second matrix is ``packed[q // LANES, :, q % LANES]``. Either a is (N, DIMS + 2) int16 and packed
    (G, DIMS / 2, LANES, 2) int16, or, with VNNI, a is (N, DIMS + 4) uint8 and packed (G, DIMS / 4, LANES, 4) int8 less
    OFFSET. What lies behind the DIMS numbers of a row of a is OFFSET times their sum, as one int32.

    masks (ROWS,) uint32 gets a bit for each product that exceeds the bound of its row, second1 (N,) int32, or that of
    its column, second2 (G * LANES,) int32. In a search for the best, whose bounds rise, that is rare after a while.

    Returns:
        Whether there is any. Only then the products stand in sums (ROWS, GROUPS * LANES) int32, and the bits in masks.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        totals = _sums_of_tile(context, builder, signature, args)
        p_sums, p_masks, p_second1, p_second2 = (
            builder.bitcast(data(context, builder, signature, args, k), I32.as_pointer()) for k in (4, 5, 6, 7)
        )
        row, group = args[2:4]
        bounds2 = [
            load(builder, builder.gep(p_second2, [builder.mul(builder.add(group, int64(g)), int64(LANES))]), _SUMS, 4)
            for g in range(GROUPS)
        ]
        found, any_bit = [], ir.Constant(I32, 0)
        for r, slots in enumerate(totals):
            at = builder.gep(p_second1, [builder.add(row, int64(r))])
            bound1 = splat(builder, load(builder, at, I32, 4), _SUMS)
            mask = ir.Constant(I32, 0)
            for g, slot in enumerate(slots):
                total = builder.load(slot)
                above = builder.or_(
                    builder.icmp_signed(">", total, bound1), builder.icmp_signed(">", total, bounds2[g])
                )
                bits = builder.zext(builder.bitcast(above, ir.IntType(LANES)), I32)
                mask = builder.or_(mask, builder.shl(bits, ir.Constant(I32, LANES * g)))
            found.append(mask)
            any_bit = builder.or_(any_bit, mask)
        is_any = builder.icmp_unsigned("!=", any_bit, ir.Constant(I32, 0))
        with builder.if_then(is_any, likely=False):
            for r, slots in enumerate(totals):
                builder.store(found[r], builder.gep(p_masks, [int64(r)]))
                for g, slot in enumerate(slots):
                    store(builder, builder.load(slot), builder.gep(p_sums, [int64((r * GROUPS + g) * LANES)]), 4)
        return is_any

    return types.boolean(a, packed, row, group, sums, masks, second1, second2), codegen


def _keep_two(builder: Any, two: tuple[Any, Any], others: tuple[Any, ...]) -> tuple[Any, Any]:
    """The two largest of each lane of two vectors, the first above the second, and of one or two others alike."""
    largest = intrinsic_of(builder, "smax", _SUMS, [two[0], others[0]])
    second = intrinsic_of(builder, "smin", _SUMS, [two[0], others[0]])
    for each in (two[1], *others[1:]):
        second = intrinsic_of(builder, "smax", _SUMS, [second, each])
    return largest, second


@intrinsic
def tile_of_best(
    typingctx: Any, a: Any, packed: Any, row: Any, group: Any, best1: Any, best2: Any, row_at: Any, at: Any
) -> Any:
    """Enter products of rows ``row..row + ROWS`` of a with groups ``group..group + GROUPS`` of packed into the two
    largest of each row and column of a block of BLOCK by BLOCK, without a branch.

    A product stands above eight bits that tell its partner: BLOCK - 1 less the position of that within the block, so
    that the first of equals is the largest.

    Args:
        a, packed: see :func:`tile`; no number above 255.
        best1: (N, 2, LANES) int32, the two largest of each row among the columns of each lane.
        best2: (BLOCK / LANES, 2, LANES) int32, the two largest of each column of the block.
        row_at: position of row in best1.
        at: position of row and group within the block, one after the other in an int64: row + BLOCK * group.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        totals = _sums_of_tile(context, builder, signature, args)
        p_best1, p_best2 = (
            builder.bitcast(data(context, builder, signature, args, k), I32.as_pointer()) for k in (4, 5)
        )
        in_block = builder.trunc(builder.and_(args[7], int64(BLOCK - 1)), I32)
        group_at = builder.udiv(args[7], int64(BLOCK))

        def places(base: Any, n: Any) -> list[Any]:
            first = builder.mul(n, int64(2 * LANES))
            return [builder.gep(base, [builder.add(first, int64(k * LANES))]) for k in (0, 1)]

        of_columns = [places(p_best2, builder.add(group_at, int64(g))) for g in range(GROUPS)]
        columns = [tuple(load(builder, place, _SUMS, 4) for place in both) for both in of_columns]
        first_column = builder.trunc(builder.mul(group_at, int64(LANES)), I32)
        column_ids = [
            builder.sub(
                ir.Constant(_SUMS, [BLOCK - 1 - g * LANES - lane for lane in range(LANES)]),
                splat(builder, first_column, _SUMS),
            )
            for g in range(GROUPS)
        ]
        for r, slots in enumerate(totals):
            of_row = places(p_best1, builder.add(args[6], int64(r)))
            two: Any = tuple(load(builder, place, _SUMS, 4) for place in of_row)
            row_id = splat(builder, builder.sub(ir.Constant(I32, BLOCK - 1 - r), in_block), _SUMS)
            for g, slot in enumerate(slots):
                raised = builder.shl(builder.load(slot), constant(_SUMS, 8))
                two = _keep_two(builder, two, (builder.or_(raised, column_ids[g]),))
                columns[g] = _keep_two(builder, columns[g], (builder.or_(raised, row_id),))
            for place, vector in zip(of_row, two, strict=True):
                store(builder, vector, place, 4)
        for both, vectors in zip(of_columns, columns, strict=True):
            for place, vector in zip(both, vectors, strict=True):
                store(builder, vector, place, 4)
        return context.get_dummy_value()

    return types.void(a, packed, row, group, best1, best2, row_at, at), codegen


@intrinsic
def two_largest_lanes(typingctx: Any, best: Any, index: Any) -> Any:
    """The two largest numbers of ``best[index]`` (2, LANES) int32, the first row of which is above the second."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        base = builder.bitcast(data(context, builder, signature, args, 0), I32.as_pointer())
        first = builder.mul(args[1], int64(2 * LANES))
        two: Any = tuple(
            load(builder, builder.gep(base, [builder.add(first, int64(k * LANES))]), _SUMS, 4) for k in (0, 1)
        )
        undefined, apart = ir.Constant(_SUMS, ir.Undefined), LANES // 2
        while apart:
            lanes = ir.Constant(_SUMS, [(lane + apart) % LANES for lane in range(LANES)])
            two = _keep_two(builder, two, tuple(builder.shuffle_vector(v, undefined, lanes) for v in two))
            apart //= 2
        values = [builder.extract_element(v, ir.Constant(I32, 0)) for v in two]
        return context.make_tuple(builder, signature.return_type, values)

    return types.UniTuple(types.int32, 2)(best, types.intp), codegen
