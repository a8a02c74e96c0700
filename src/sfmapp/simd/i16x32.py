"""Integer products: a processor multiplies 32 16-bit numbers at a time and adds neighbouring pairs of products.

One instruction (pmaddwd, vpdpwssd, smlal) does so, at twice the rate of floats. Numba's own loops do not find it, so
the innermost tile of a product of two matrices of whole numbers is written here, in the one pattern that every back end
knows. The sums are exact, so the order of summation does not matter.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from sfmapp.simd.llvm import I16, I32, data, int64, load, splat, store

DIMS = 128  # numbers of a row
LANES = 16  # rows of the second matrix that share a vector of 32-bit sums
ROWS, GROUPS = 4, 2  # rows of the first matrix, and groups of LANES of the second, in a tile: 8 vectors of sums

_SUMS, _PRODUCTS = ir.VectorType(I32, LANES), ir.VectorType(I32, 2 * LANES)
_PAIRS = ir.VectorType(I16, 2 * LANES)


def _add_pairs(builder: Any, products: Any) -> Any:
    undefined = ir.Constant(_PRODUCTS, ir.Undefined)
    halves = [ir.Constant(_SUMS, [2 * lane + odd for lane in range(LANES)]) for odd in (0, 1)]
    return builder.add(*(builder.shuffle_vector(products, undefined, half) for half in halves))


@intrinsic
def tile(
    typingctx: Any, a: Any, packed: Any, sums: Any, masks: Any, second1: Any, second2: Any, row: Any, group: Any
) -> Any:
    """Products of rows ``row..row + ROWS`` of a with groups ``group..group + GROUPS`` of packed.

    a is (N, DIMS) int16, packed (G, DIMS / 2, LANES, 2) int16: row q of the second matrix is ``packed[q // LANES, :,
    q % LANES]``. The products go to sums (ROWS, GROUPS * LANES) int32; masks (ROWS,) uint32 gets a bit for each that
    exceeds the bound of its row, second1 (N,) int32, or that of its column, second2 (G * LANES,) int32. In a search for
    the best, whose bounds rise, that is rare after a while.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def pointer(k: int, kind: Any) -> Any:
            return builder.bitcast(data(context, builder, signature, args, k), kind.as_pointer())

        p_a, p_packed = pointer(0, I16), pointer(1, I16)
        p_sums, p_masks, p_second1, p_second2 = (pointer(k, I32) for k in (2, 3, 4, 5))
        row, group = args[6], args[7]
        zero = ir.Constant(_SUMS, None)
        totals = [[cgutils.alloca_once_value(builder, zero) for _ in range(GROUPS)] for _ in range(ROWS)]
        for slot in (slot for line in totals for slot in line):  # alloca_once initialises at the function's entry only
            builder.store(zero, slot)
        with cgutils.for_range(builder, int64(DIMS // 2)) as loop:
            columns = []
            for g in range(GROUPS):
                start = builder.mul(builder.add(group, int64(g)), int64(DIMS * LANES))
                place = builder.gep(p_packed, [builder.add(start, builder.mul(loop.index, int64(2 * LANES)))])
                columns.append(builder.sext(load(builder, place, _PAIRS, 2), _PRODUCTS))
            for r in range(ROWS):
                start = builder.mul(builder.add(row, int64(r)), int64(DIMS))
                place = builder.gep(p_a, [builder.add(start, builder.mul(loop.index, int64(2)))])
                pair = splat(builder, load(builder, place, I32, 2), _SUMS)
                line = builder.sext(builder.bitcast(pair, _PAIRS), _PRODUCTS)
                for g in range(GROUPS):
                    products = builder.mul(line, columns[g], flags=("nsw",))
                    total = builder.add(builder.load(totals[r][g]), _add_pairs(builder, products))
                    builder.store(total, totals[r][g])
        for r in range(ROWS):
            at = builder.gep(p_second1, [builder.add(row, int64(r))])
            bound1 = splat(builder, load(builder, at, I32, 4), _SUMS)
            mask = ir.Constant(I32, 0)
            for g in range(GROUPS):
                total = builder.load(totals[r][g])
                store(builder, total, builder.gep(p_sums, [int64((r * GROUPS + g) * LANES)]), 4)
                column = builder.gep(p_second2, [builder.mul(builder.add(group, int64(g)), int64(LANES))])
                bound2 = load(builder, column, _SUMS, 4)
                above = builder.or_(builder.icmp_signed(">", total, bound1), builder.icmp_signed(">", total, bound2))
                bits = builder.zext(builder.bitcast(above, ir.IntType(LANES)), I32)
                mask = builder.or_(mask, builder.shl(bits, ir.Constant(I32, LANES * g)))
            builder.store(mask, builder.gep(p_masks, [int64(r)]))
        return context.get_dummy_value()

    return types.void(a, packed, sums, masks, second1, second2, row, group), codegen
