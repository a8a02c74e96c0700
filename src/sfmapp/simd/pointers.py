"""Pointers in kernels.

Handed to another kernel, an array costs two atomic operations for its reference count, on every call, and indexing it
looks at the sign of the index; a pointer does neither. It does not keep the array alive: a local array must be used
again after its last pointer.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numba import types
from numba.extending import intrinsic

from sfmapp.simd.llvm import data

# numba's pointer to numbers of one type; it reads and writes as a flat array does, without bounds
Pointer: TypeAlias = Any
# a place in an array: counted, or read from an array of such
Index: TypeAlias = int | np.signedinteger[Any]


@intrinsic
def pointer(typingctx: Any, array: Any) -> Any:
    """Pointer to the first element of an array that the caller keeps alive."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return data(context, builder, signature, args, 0)

    return types.CPointer(array.dtype)(array), codegen


@intrinsic
def offset(typingctx: Any, base: Any, count: Any) -> Any:
    """The pointer ``count`` elements further on."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.gep(args[0], [args[1]])

    return base(base, types.intp), codegen
