"""Nearest neighbours among descriptors, checked from both sides.

SIFT descriptors are compared by their dot products in whole numbers: exact, so the same on every machine and in every
order, and a vector instruction that multiplies 16-bit numbers and adds pairs beats a float matrix product that would
have to be written to memory and read again.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

# RootSIFT times 512 has a squared norm of 512^2, up to rounding
_SIFT_NORM2 = 512 * 512

Descriptors = NDArray[np.int16]
Indices = NDArray[np.int32]


@numba.njit(cache=True, nogil=True)
def _scan_products(
    a: Descriptors, b: Descriptors, best1: Indices, second1: Indices, arg1: Indices,
    best2: Indices, second2: Indices, arg2: Indices,
) -> None:  # fmt: skip
    """Two largest dot products of every row of a over b and of every row of b over a; the first of equals wins."""
    dims = a.shape[1]
    for i in range(a.shape[0]):
        best, second, arg = best1[i], second1[i], arg1[i]
        for j in range(b.shape[0]):
            total = np.int32(0)
            for k in range(dims):  # every sum is cast back: numba would widen to 64 bits and halve the speed
                total = np.int32(total + np.int32(np.int32(a[i, k]) * np.int32(b[j, k])))
            if total > second:
                if total > best:
                    second = best
                    best = total
                    arg = j
                else:
                    second = total
            if total > second2[j]:
                if total > best2[j]:
                    second2[j] = best2[j]
                    best2[j] = total
                    arg2[j] = i
                else:
                    second2[j] = total
        best1[i], second1[i], arg1[i] = best, second, arg


def match_sift(
    descriptors1: NDArray[np.uint8], descriptors2: NDArray[np.uint8], max_ratio: float, max_distance: float
) -> Indices:
    """Mutual nearest neighbours that pass the ratio test from both sides.

    Args:
        descriptors1, descriptors2: (N, 128) and (M, 128) uint8 RootSIFT times 512.
        max_ratio: bound on the best distance over the second best.
        max_distance: bound on the distance between unit descriptors.

    Returns:
        (K, 2) int32 positions in both, ascending; no position occurs twice.
    """
    a, b = descriptors1.astype(np.int16), descriptors2.astype(np.int16)
    n, m = len(a), len(b)
    best1, second1, arg1 = (np.full(n, fill, np.int32) for fill in (0, 0, -1))
    best2, second2, arg2 = (np.full(m, fill, np.int32) for fill in (0, 0, -1))
    _scan_products(a, b, best1, second1, arg1, best2, second2, arg2)
    good1 = (arg1 >= 0) & _passes(best1, second1, max_ratio, max_distance)
    good2 = (arg2 >= 0) & _passes(best2, second2, max_ratio, max_distance)
    rows = np.flatnonzero(good1)
    columns = arg1[rows]
    keep = good2[columns] & (arg2[columns] == rows)
    return np.stack([rows[keep], columns[keep]], 1).astype(np.int32)


def _passes(best: Indices, second: Indices, max_ratio: float, max_distance: float) -> NDArray[np.bool_]:
    d_best = np.sqrt(np.maximum(2.0 - best * (2.0 / _SIFT_NORM2), 0.0))
    d_second = np.sqrt(np.maximum(2.0 - second * (2.0 / _SIFT_NORM2), 0.0))
    return (d_best < max_ratio * d_second) & (d_best <= max_distance)


def match_binary(
    descriptors1: NDArray[np.uint8], descriptors2: NDArray[np.uint8], max_ratio: float, max_distance: float
) -> Indices:
    """The same for packed bits (N, B) and (M, B) uint8 under the Hamming distance; max_distance is a share of bits."""
    import cv2

    if len(descriptors1) == 0 or len(descriptors2) == 0:
        return np.empty((0, 2), np.int32)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    forward = _nearest_binary(matcher, descriptors1, descriptors2, max_ratio, max_distance)
    backward = _nearest_binary(matcher, descriptors2, descriptors1, max_ratio, max_distance)
    rows = np.flatnonzero(forward >= 0)
    keep = backward[forward[rows]] == rows
    return np.stack([rows[keep], forward[rows[keep]]], 1).astype(np.int32)


def _nearest_binary(
    matcher: object, query: NDArray[np.uint8], train: NDArray[np.uint8], max_ratio: float, max_distance: float
) -> NDArray[np.int64]:
    nearest = np.full(len(query), -1, np.int64)
    limit = max_distance * 8 * query.shape[1]
    for i, found in enumerate(matcher.knnMatch(query, train, k=2)):  # type: ignore[attr-defined]
        if not found or found[0].distance > limit:
            continue
        if len(found) == 1 or found[0].distance < max_ratio * found[1].distance:
            nearest[i] = found[0].trainIdx
    return nearest
