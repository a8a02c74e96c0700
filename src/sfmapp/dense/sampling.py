"""Sixteen bilinear samples at a time, with their slopes, from images packed so that one load fetches four pixels.

The word of pixel (x, y) holds ``I(x, y)``, ``I(x + 1, y)``, ``I(x, y + 1)`` and ``I(x + 1, y + 1)`` from its lowest
byte to its highest. All views of a level lie in one array of words, one after the other.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from sfmapp.simd.f32x16 import WIDTH, row

_F32, _I32 = ir.FloatType(), ir.IntType(32)
_ROW, _INTS = ir.VectorType(_F32, WIDTH), ir.VectorType(_I32, WIDTH)


def pack_quads(gray: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """(H, W) words of an image (H, W); what would lie beyond the last column and row is zero."""
    quads = gray.astype(np.uint32)
    right, below = quads[:, 1:].copy(), quads[1:].copy()
    quads[:, :-1] |= right << 8
    quads[:-1] |= below << 16
    quads[:-1, :-1] |= below[:, 1:] << 24
    return quads


def _splat_int(builder: Any, scalar: Any) -> Any:
    empty = ir.Constant(_INTS, ir.Undefined)
    one = builder.insert_element(empty, scalar, ir.Constant(_I32, 0))
    return builder.shuffle_vector(one, empty, ir.Constant(_INTS, [0] * WIDTH))


def _gather(builder: Any, base: Any, index: Any) -> Any:
    """Words at 16 places. Single loads: on most processors they are no slower than the gather instruction."""
    words = ir.Constant(_INTS, ir.Undefined)
    for lane in range(WIDTH):
        number = ir.Constant(_I32, lane)
        word = builder.load(builder.gep(base, [builder.extract_element(index, number)]))
        words = builder.insert_element(words, word, number)
    return words


def _fma(builder: Any, a: Any, b: Any, c: Any) -> Any:
    kind = ir.FunctionType(_ROW, [_ROW] * 3)
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, "llvm.fma.v16f32"), [a, b, c])


def _byte(builder: Any, words: Any, number: int) -> Any:
    if number:
        words = builder.lshr(words, ir.Constant(_INTS, [8 * number] * WIDTH))
    if number < 3:
        words = builder.and_(words, ir.Constant(_INTS, [255] * WIDTH))
    return builder.sitofp(words, _ROW)


def _bilinear(builder: Any, args: Any) -> tuple[Any, Any, Any]:
    """Value and both slopes at columns ``args[2]`` and rows ``args[3]``, which are not negative."""
    base, width, x, y = args
    left, top = builder.fptosi(x, _INTS), builder.fptosi(y, _INTS)
    fx, fy = builder.fsub(x, builder.sitofp(left, _ROW)), builder.fsub(y, builder.sitofp(top, _ROW))
    words = _gather(builder, base, builder.add(builder.mul(top, _splat_int(builder, width)), left))
    p00, p10, p01, p11 = (_byte(builder, words, number) for number in range(4))
    slope0, slope1 = builder.fsub(p10, p00), builder.fsub(p11, p01)
    above, below = _fma(builder, fx, slope0, p00), _fma(builder, fx, slope1, p01)
    dy = builder.fsub(below, above)
    dx = _fma(builder, fy, builder.fsub(slope1, slope0), slope0)
    return _fma(builder, fy, dy, above), dx, dy


@intrinsic
def sample(typingctx, base, width, x, y):  # type: ignore[no-untyped-def]
    """Bilinear samples (16) at columns x and rows y (index coordinates, inside) of packed words, ``width`` to a row."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _bilinear(builder, args)[0]

    return row(base, types.int32, x, y), codegen


@intrinsic
def sample_with_slopes(typingctx, base, width, x, y):  # type: ignore[no-untyped-def]
    """As :func:`sample`, and the derivatives along x and y of the bilinear surface there: three rows."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return context.make_tuple(builder, signature.return_type, _bilinear(builder, args))

    return types.UniTuple(row, 3)(base, types.int32, x, y), codegen


@intrinsic
def pixels(typingctx, base, width, dx, dy):  # type: ignore[no-untyped-def]
    """Pixels (16) at whole offsets dx, dy (rows of floats) from the word that ``base`` points to."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        base, width, dx, dy = args
        left, top = builder.fptosi(dx, _INTS), builder.fptosi(dy, _INTS)
        words = _gather(builder, base, builder.add(builder.mul(top, _splat_int(builder, width)), left))
        return _byte(builder, words, 0)

    return row(base, types.int32, dx, dy), codegen
