"""Sixteen bilinear samples at a time, from an image of bytes or from one that is packed so that one load fetches four.

A packed image holds a 32-bit word for each pixel (x, y): ``I(x, y)``, ``I(x + 1, y)``, ``I(x, y + 1)`` and ``I(x + 1, y
+ 1)`` from its lowest byte to its highest. It takes four times the memory, so it is for images that are sampled often.
Both interpolate along x first, with the same roundings.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from sfmapp.simd import llvm
from sfmapp.simd.f32x16 import FLOATS, INTS, WIDTH, row

_PLACES = ir.VectorType(llvm.I64, WIDTH)


def pack_quads(gray: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """(H, W) words of an image (H, W); what would lie beyond the last column and row is zero."""
    quads = gray.astype(np.uint32)
    right, below = quads[:, 1:].copy(), quads[1:].copy()
    quads[:, :-1] |= right << 8
    quads[:-1] |= below << 16
    quads[:-1, :-1] |= below[:, 1:] << 24
    return quads


def _byte(builder: Any, words: Any, number: int) -> Any:
    """Byte ``number`` of each word, the lowest first, as floats."""
    if number:
        words = builder.lshr(words, llvm.constant(INTS, 8 * number))
    if number < 3:
        words = builder.and_(words, llvm.constant(INTS, 255))
    return builder.sitofp(words, FLOATS)


def _lerp(builder: Any, fraction: Any, first: Any, second: Any) -> Any:
    return llvm.fma(builder, fraction, builder.fsub(second, first), first)


@intrinsic
def sample_bytes(typingctx: Any, base: Any, step: Any, u: Any, v: Any) -> Any:
    """Bilinear samples at columns u and rows v (16 floats each) of uint8 pixels about a pointer, rows step bytes apart.

    Two pixels of a row come with one 32-bit word: three bytes beyond the last pixel are read.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        base, step, u, v = args
        left, top = (llvm.intrinsic(builder, "floor", FLOATS, [value]) for value in (u, v))
        here = llvm.splat(builder, builder.ptrtoint(base, llvm.I64), _PLACES)
        steps = llvm.splat(builder, step, _PLACES)
        above = builder.add(here, builder.fptosi(left, _PLACES))
        above = builder.add(above, builder.mul(builder.fptosi(top, _PLACES), steps))
        rows = []
        for place in (above, builder.add(above, steps)):
            pair = _gather_instruction(builder, place)
            rows.append(_lerp(builder, builder.fsub(u, left), _byte(builder, pair, 0), _byte(builder, pair, 1)))
        return _lerp(builder, builder.fsub(v, top), *rows)

    return row(base, types.intp, u, v), codegen


def _gather_instruction(builder: Any, addresses: Any) -> Any:
    """32-bit words at 16 addresses, which need not be aligned."""
    pointers, mask = ir.VectorType(llvm.I32.as_pointer(), WIDTH), ir.VectorType(ir.IntType(1), WIDTH)
    kind = ir.FunctionType(INTS, [pointers, llvm.I32, mask, INTS])
    gather = cgutils.get_or_insert_function(builder.module, kind, "llvm.masked.gather.v16i32.v16p0")
    every, none = llvm.constant(mask, 1), ir.Constant(INTS, ir.Undefined)
    return builder.call(gather, [builder.inttoptr(addresses, pointers), ir.Constant(llvm.I32, 1), every, none])


def _gather_singly(builder: Any, base: Any, index: Any) -> Any:
    """Words at 16 places. Single loads: on most processors they are no slower than the gather instruction."""
    words = ir.Constant(INTS, ir.Undefined)
    for lane in range(WIDTH):
        number = ir.Constant(llvm.I32, lane)
        word = builder.load(builder.gep(base, [builder.extract_element(index, number)]))
        words = builder.insert_element(words, word, number)
    return words


def _words_at(builder: Any, base: Any, width: Any, left: Any, top: Any) -> Any:
    place = builder.add(builder.mul(top, llvm.splat(builder, width, INTS)), left)
    return _gather_singly(builder, base, place)


def _interpolate(builder: Any, args: Any) -> tuple[Any, Any, Any]:
    """Value and both slopes at columns ``args[2]`` and rows ``args[3]``, which are not negative, of packed words."""
    base, width, x, y = args
    left, top = builder.fptosi(x, INTS), builder.fptosi(y, INTS)
    fx, fy = builder.fsub(x, builder.sitofp(left, FLOATS)), builder.fsub(y, builder.sitofp(top, FLOATS))
    words = _words_at(builder, base, width, left, top)
    p00, p10, p01, p11 = (_byte(builder, words, number) for number in range(4))
    above, below = _lerp(builder, fx, p00, p10), _lerp(builder, fx, p01, p11)
    dx = _lerp(builder, fy, builder.fsub(p10, p00), builder.fsub(p11, p01))
    return _lerp(builder, fy, above, below), dx, builder.fsub(below, above)


@intrinsic
def sample_quads(typingctx: Any, base: Any, width: Any, x: Any, y: Any) -> Any:
    """Bilinear samples (16) at columns x and rows y (index coordinates, inside) of packed words, ``width`` to a row."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _interpolate(builder, args)[0]

    return row(base, types.int32, x, y), codegen


@intrinsic
def sample_quads_with_slopes(typingctx: Any, base: Any, width: Any, x: Any, y: Any) -> Any:
    """As :func:`sample_quads`, and the derivatives along x and y of the bilinear surface there: three rows."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return context.make_tuple(builder, signature.return_type, _interpolate(builder, args))

    return types.UniTuple(row, 3)(base, types.int32, x, y), codegen


@intrinsic
def quad_pixels(typingctx: Any, base: Any, width: Any, dx: Any, dy: Any) -> Any:
    """Pixels (16) at whole offsets dx, dy (rows of floats) from the word that ``base`` points to."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        base, width, dx, dy = args
        words = _words_at(builder, base, width, builder.fptosi(dx, INTS), builder.fptosi(dy, INTS))
        return _byte(builder, words, 0)

    return row(base, types.int32, dx, dy), codegen
