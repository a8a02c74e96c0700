"""Nearest neighbours among descriptors of any kind under the Euclidean distance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Indices = NDArray[np.int32]

# Products that lie in memory at a time: 64 MB.
_BLOCK_PRODUCTS = 1 << 24


def match_euclidean(descriptors1: Floats, descriptors2: Floats, max_ratio: float, max_distance: float) -> Indices:
    """Mutual nearest neighbours that pass the ratio test from both sides.

    Args:
        descriptors1, descriptors2: (N, D) and (M, D) float32.
        max_ratio: bound on the best distance over the second best.
        max_distance: bound on the distance, in units of the root mean square length of all descriptors (1 where they
            are unit vectors).

    Returns:
        (K, 2) int32 positions in both, ascending; no position occurs twice.
    """
    num1, num2 = len(descriptors1), len(descriptors2)
    if not num1 or not num2 or not descriptors1.shape[1]:
        return np.zeros((0, 2), np.int32)
    squares1, squares2 = ((d.astype(np.float64) ** 2).sum(1) for d in (descriptors1, descriptors2))
    unit2 = float((squares1.sum() + squares2.sum()) / (num1 + num2)) or 1.0
    row_best, row_second, row_arg = np.empty(num1), np.empty(num1), np.empty(num1, np.int64)
    column_two = np.full((2, num2), np.inf)
    column_arg = np.zeros(num2, np.int64)
    step = max(1, _BLOCK_PRODUCTS // num2)
    for start in range(0, num1, step):
        block = slice(start, min(start + step, num1))
        products = (descriptors1[block] @ descriptors2.T).astype(np.float64)
        distance2 = np.maximum(squares1[block, None] + squares2 - 2.0 * products, 0.0)
        row_arg[block] = distance2.argmin(1)
        row_best[block], row_second[block] = _two_smallest(distance2)
        nearest = distance2.argmin(0)
        is_nearer = distance2[nearest, np.arange(num2)] < column_two[0]
        column_arg[is_nearer] = start + nearest[is_nearer]
        column_two = np.stack(_two_smallest(np.concatenate([column_two.T, distance2.T], 1)))
    limit2 = max_distance**2 * unit2
    good1 = (row_best <= limit2) & (row_best < max_ratio**2 * row_second)
    good2 = (column_two[0] <= limit2) & (column_two[0] < max_ratio**2 * column_two[1])
    rows = np.flatnonzero(good1)
    columns = row_arg[rows]
    keep = good2[columns] & (column_arg[columns] == rows)
    return np.stack([rows[keep], columns[keep]], 1).astype(np.int32)


def _two_smallest(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Smallest and second smallest of each row (infinite where there is none)."""
    if values.shape[1] == 1:
        return values[:, 0], np.full(len(values), np.inf)
    two = np.partition(values, 1, axis=1)
    return two[:, 0], two[:, 1]
