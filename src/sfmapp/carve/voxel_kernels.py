"""Kernel of :mod:`sfmapp.carve.voxel_coloring`: the first full cell on the ray of each pixel."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera import lens
from sfmapp.carve.cell_grid import Cells

Array = NDArray[np.float64]
Shown = NDArray[np.int64]

# what a pixel shows that was not looked for yet, and one that shows no cell
STALE, NOTHING = -2, -1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def first_cells(filled: Cells, low: Array, cell: float, camera: tuple[Array, Array, Array], shown: Shown) -> None:
    """Go on along the rays of pixels whose cell is gone, from cell to cell (Amanatides and Woo, "A fast voxel traversal
    algorithm for ray tracing", Eurographics 1987).

    Args:
        filled: (X, Y, Z), 0 where empty. low, cell: corner (3,) and side.
        camera: row (29,) of the view, inverse (3, 3) of the left part of its matrix, its place (3,).
        shown: (H, W) numbers of cells in the order of ``filled.ravel()``, or NOTHING; in place.
    """
    row, turn, center = camera
    shape, flat = filled.shape, filled.reshape(-1)
    direction, at, step = np.empty(3), np.empty(3, np.int64), np.empty(3, np.int64)
    reach = np.empty(3)
    for v in range(shown.shape[0]):
        for u in range(shown.shape[1]):
            before = shown[v, u]
            if before == NOTHING or (before >= 0 and flat[before] != 0):
                continue
            shown[v, u] = NOTHING
            a, b, c = lens.unproject(row[12:], u + 0.5, v + 0.5)
            near, far = 0.0, np.inf
            for axis in range(3):
                along = turn[axis, 0] * a + turn[axis, 1] * b + turn[axis, 2] * c
                direction[axis] = along if abs(along) > 1e-12 else 1e-12
                first = (low[axis] - center[axis]) / direction[axis]
                last = (low[axis] + shape[axis] * cell - center[axis]) / direction[axis]
                near, far = max(near, min(first, last)), min(far, max(first, last))
            if not near < far:  # not a number counts as well
                continue
            for axis in range(3):
                place = (center[axis] + near * direction[axis] - low[axis]) / cell
                at[axis] = min(max(int(np.floor(place)), 0), shape[axis] - 1)
                step[axis] = 1 if direction[axis] > 0.0 else -1
                edge = low[axis] + (at[axis] + (step[axis] > 0)) * cell
                reach[axis] = (edge - center[axis]) / direction[axis]
            while True:
                number = (at[0] * shape[1] + at[1]) * shape[2] + at[2]
                if flat[number] != 0:
                    shown[v, u] = number
                    break
                axis = 0
                if reach[1] < reach[axis]:
                    axis = 1
                if reach[2] < reach[axis]:
                    axis = 2
                at[axis] += step[axis]
                if at[axis] < 0 or at[axis] >= shape[axis]:
                    break
                reach[axis] += cell / abs(direction[axis])
