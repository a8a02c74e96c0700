"""Depth maps of several views held against each other: what others see at a place, and what they see behind it."""

from __future__ import annotations

from collections.abc import Sequence

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.plane_sweep import SweptDepth
from sfmapp.dense.scene import DenseView
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Map = NDArray[np.float32]

# two maps tell the same where they are within a plane of the wider step, as the two sides of a pair are a pixel apart
MOST_APART = 1.0


def confirm(
    view: DenseView, swept: SweptDepth, others: Sequence[tuple[DenseView, SweptDepth]]
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """How many other maps tell the same depth, and how many see through the place that it tells.

    Maps in which the place is hidden, out of the picture or not told say nothing.

    Args:
        view, swept: the reference and its map (H, W).
        others: views with their maps, of any sizes.

    Returns:
        (H, W) uint8 each; 0 where there is no depth.
    """
    agree, against = np.zeros((2, *swept.depth.shape), np.uint8)
    for other, its in others:
        relative = rigid3.compose(other.cam_from_world, rigid3.inverse(view.cam_from_world))
        step = max(swept.planes.step, its.planes.step)
        _hold_against(
            swept.depth, view.k, rigid3.rotation_matrix(relative), relative[4:].copy(), other.k, its.depth,
            MOST_APART * step, agree, against,
        )  # fmt: skip
    return agree, against


@numba.njit(cache=True, nogil=True)
def _hold_against(
    depth: Map, k: Array, rotation: Array, shift: Array, other_k: Array, other: Map, apart: float,
    agree: NDArray[np.uint8], against: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Count one other map in; of the four pixels of it about a place the one that is nearest to it in depth counts."""
    height, width = depth.shape
    rows, columns = other.shape
    for y in range(height):
        for x in range(width):
            z = float(depth[y, x])
            if not z > 0.0 or z == np.inf:
                continue
            a, b = (x + 0.5 - k[2]) / k[0] * z, (y + 0.5 - k[3]) / k[1] * z
            far = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * z + shift[2]
            if far <= 0.0:
                continue
            u = (rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * z + shift[0]) / far * other_k[0]
            v = (rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * z + shift[1]) / far * other_k[1]
            left, top = int(np.floor(u + other_k[2] - 0.5)), int(np.floor(v + other_k[3] - 0.5))
            if left < 0 or top < 0 or left + 1 >= columns or top + 1 >= rows:
                continue
            least = np.inf
            for j in range(top, top + 2):
                for i in range(left, left + 2):
                    if other[j, i] > 0.0:
                        off = 1.0 / far - 1.0 / other[j, i]
                        if abs(off) < abs(least):
                            least = off
            if abs(least) <= apart:
                agree[y, x] += np.uint8(1)
            elif least < np.inf and least > apart:
                against[y, x] += np.uint8(1)
