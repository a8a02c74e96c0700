"""Counting and finding bits."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic


@intrinsic
def count_bits(typingctx: Any, word: Any) -> Any:
    """How many bits of a uint64 are set, as uint64: one instruction, and vectors of them where loops allow."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.ctpop(args[0])

    return types.uint64(types.uint64), codegen


@intrinsic
def first_bit(typingctx: Any, word: Any) -> Any:
    """Position of the lowest bit of a uint64 that is set, 64 if none is."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 0))

    return types.int64(types.uint64), codegen
