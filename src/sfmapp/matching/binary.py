"""Nearest neighbours among packed bits under the Hamming distance."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.simd.bits import count_bits

Words = NDArray[np.uint64]
Indices = NDArray[np.int32]


@numba.njit(cache=True, nogil=True)
def _nearest(a: Words, b: Words, rows: Indices, columns: Indices) -> None:
    """Best distance, second best and place of the best, (3, N) for the rows of a and (3, M) for those of b."""
    num_words = a.shape[1]
    for i in range(a.shape[0]):
        best, second, place = rows[0, i], rows[1, i], -1
        for j in range(b.shape[0]):
            distance = np.int32(0)
            for k in range(num_words):
                distance += np.int32(count_bits(a[i, k] ^ b[j, k]))
            if distance < second:
                if distance < best:
                    best, second, place = distance, best, j
                else:
                    second = distance
            if distance < columns[1, j]:
                if distance < columns[0, j]:
                    columns[0, j], columns[1, j], columns[2, j] = distance, columns[0, j], i
                else:
                    columns[1, j] = distance
        rows[0, i], rows[1, i], rows[2, i] = best, second, place


def match_binary(
    descriptors1: NDArray[np.uint8], descriptors2: NDArray[np.uint8], max_ratio: float, max_distance: float
) -> Indices:
    """Mutual nearest neighbours that pass the ratio test from both sides.

    Args:
        descriptors1, descriptors2: (N, B) and (M, B) uint8 packed bits.
        max_ratio: bound on the best distance over the second best.
        max_distance: bound on the share of bits that differ.

    Returns:
        (K, 2) int32 positions in both, ascending; no position occurs twice.
    """
    num_bits = 8 * descriptors1.shape[1]
    sides = [np.full((3, len(d)), num_bits + 1, np.int32) for d in (descriptors1, descriptors2)]
    for side in sides:
        side[2] = -1
    _nearest(_words(descriptors1), _words(descriptors2), *sides)
    good = [(side[2] >= 0) & (side[0] <= max_distance * num_bits) & (side[0] < max_ratio * side[1]) for side in sides]
    rows = np.flatnonzero(good[0])
    columns = sides[0][2][rows]
    keep = good[1][columns] & (sides[1][2][columns] == rows)
    return np.stack([rows[keep], columns[keep]], 1).astype(np.int32)


def _words(descriptors: NDArray[np.uint8]) -> Words:
    """(N, ceil(B / 8)) uint64, the last word filled up with zeros."""
    padded = np.zeros((len(descriptors), -(-descriptors.shape[1] // 8) * 8), np.uint8)
    padded[:, : descriptors.shape[1]] = descriptors
    return padded.view(np.uint64)
