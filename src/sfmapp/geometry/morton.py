"""Codes of places in a grid that interleave the bits of their coordinates, x in bit 0, y in bit 1, z in bit 2.

What lies in a cell of twice the size follows each other, and has its code but for the last three bits (Morton, 1966).
"""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def spread_bits(v: np.uint64) -> np.uint64:
    """The lowest 21 bits of a number with two zeros between each and the next."""
    v = np.uint64(v) & np.uint64(0x1FFFFF)
    v = (v | (v << np.uint64(32))) & np.uint64(0x1F00000000FFFF)
    v = (v | (v << np.uint64(16))) & np.uint64(0x1F0000FF0000FF)
    v = (v | (v << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
    v = (v | (v << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
    return (v | (v << np.uint64(2))) & np.uint64(0x1249249249249249)


@numba.njit(cache=True, nogil=True)
def gather_bits(v: np.uint64) -> np.uint64:
    """Every third bit of a number, the inverse of :func:`spread_bits`."""
    v = np.uint64(v) & np.uint64(0x1249249249249249)
    v = (v ^ (v >> np.uint64(2))) & np.uint64(0x10C30C30C30C30C3)
    v = (v ^ (v >> np.uint64(4))) & np.uint64(0x100F00F00F00F00F)
    v = (v ^ (v >> np.uint64(8))) & np.uint64(0x1F0000FF0000FF)
    v = (v ^ (v >> np.uint64(16))) & np.uint64(0x1F00000000FFFF)
    return (v ^ (v >> np.uint64(32))) & np.uint64(0x1FFFFF)
