"""Nearest neighbours among SIFT descriptors, checked from both sides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.matching.products import Best, largest_products

# RootSIFT times 512 has a squared norm of 512^2, up to rounding
_SIFT_NORM2 = 512 * 512

Indices = NDArray[np.int32]


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
    return mutual_neighbors(*largest_products(descriptors1, descriptors2), max_ratio, max_distance)


def mutual_neighbors(best1: Best, best2: Best, max_ratio: float, max_distance: float) -> Indices:
    """(K, 2) int32 positions, ascending in the first, of those that are each other's best and pass the ratio test."""
    good1 = (best1.partner >= 0) & _passes_ratio(best1, max_ratio, max_distance)
    good2 = (best2.partner >= 0) & _passes_ratio(best2, max_ratio, max_distance)
    rows = np.flatnonzero(good1)
    columns = best1.partner[rows]
    keep = good2[columns] & (best2.partner[columns] == rows)
    return np.stack([rows[keep], columns[keep]], 1).astype(np.int32)


@dataclass(frozen=True)
class NeighborSteps:
    """What each test leaves of the nearest neighbours of the keypoints of image 1 in image 2.

    Attributes:
        nearest: (N, 2) int32 positions, before any test. ratio: (K, 2) after the ratio test and the bound on the
            distance. mutual: (M, 2) after the same from the other side, each the other's nearest: what is matched.
        is_unknown: the descriptors are of a kind whose neighbours were not looked at.
    """

    nearest: Indices
    ratio: Indices
    mutual: Indices
    is_unknown: bool = False

    @classmethod
    def unknown(cls) -> NeighborSteps:
        """Nothing is known."""
        nothing = np.zeros((0, 2), np.int32)
        return cls(nothing, nothing, nothing, True)


def neighbor_steps(
    descriptors1: NDArray[np.uint8], descriptors2: NDArray[np.uint8], max_ratio: float, max_distance: float
) -> NeighborSteps:
    """:func:`match_sift`, with what it had on the way."""
    best1, best2 = largest_products(descriptors1, descriptors2)
    has_one = best1.partner >= 0
    good = has_one & _passes_ratio(best1, max_ratio, max_distance)
    positions = np.stack([np.arange(len(has_one)), best1.partner], 1).astype(np.int32)
    return NeighborSteps(positions[has_one], positions[good], mutual_neighbors(best1, best2, max_ratio, max_distance))


def _passes_ratio(best: Best, max_ratio: float, max_distance: float) -> NDArray[np.bool_]:
    """Whether best matches, given as inner products like the second best, pass Lowe's ratio and the distance."""
    d_best = np.sqrt(np.maximum(2.0 - best.first * (2.0 / _SIFT_NORM2), 0.0))
    d_second = np.sqrt(np.maximum(2.0 - best.second * (2.0 / _SIFT_NORM2), 0.0))
    passes: NDArray[np.bool_] = (d_best < max_ratio * d_second) & (d_best <= max_distance)
    return passes
