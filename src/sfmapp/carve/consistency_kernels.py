"""How many views say that a place is empty, and the least number of them along each pixel's ray."""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.views import project_point

Array = NDArray[np.float64]

# more views than this that say empty are not told apart
MOST = 3


class Fields(NamedTuple):
    """Views and their silhouettes on coarse grids, as arrays.

    Attributes:
        rows: (V, 29) of :mod:`sfmapp.carve.views`.
        sizes: (V, 3) rows and columns of each grid, and pixels between its points.
        starts: (V,) place of each grid's first point in ``distance``.
        distance: (P,) float32 signed distances in pixels; NaN where the picture cannot tell.
        scales: (V,) pixels to a unit of the world at depth 1.
    """

    rows: Array
    sizes: NDArray[np.int64]
    starts: NDArray[np.int64]
    distance: NDArray[np.float32]
    scales: Array


@numba.njit(cache=True, nogil=True)
def place_on_grid(fields: Fields, view: int, x: float, y: float, z: float) -> tuple[int, int, float]:
    """Row and column of a place in the grid of a view, -1 where it is not in its picture, and pixels to a unit."""
    u, v, depth = project_point(fields.rows[view], x, y, z)
    step = fields.sizes[view, 2]
    if not (depth > 0.0 and u >= 0.0 and v >= 0.0):
        return -1, -1, 0.0
    i, j = int(v) // step, int(u) // step
    if i >= fields.sizes[view, 0] or j >= fields.sizes[view, 1]:
        return -1, -1, 0.0
    return i, j, fields.scales[view] / depth


@numba.njit(cache=True, nogil=True)
def count_misses(
    fields: Fields, margin: float, low: Array, cell: float, num: int, first: int, last: int,
    places: NDArray[np.int16], missed_by: NDArray[np.int16],
) -> int:  # fmt: skip
    """Cells of layers ``first`` to ``last`` along x that at most ``MOST`` views call empty and two or more see.

    Args:
        margin: pixels that a cell has to be outside, beyond its own radius, for a view to call it empty.
        num: cells a side of the cube at ``low``.
        places, missed_by: (M, 3) their places, and which views call them empty, -1 behind the last.

    Returns:
        How many there are.
    """
    found = 0
    radius = 0.5 * math.sqrt(3.0) * cell
    for ix in range(first, last):
        for iy in range(num):
            for iz in range(num):
                x, y, z = low[0] + (ix + 0.5) * cell, low[1] + (iy + 0.5) * cell, low[2] + (iz + 0.5) * cell
                seen = misses = 0
                for view in range(fields.rows.shape[0]):
                    i, j, scale = place_on_grid(fields, view, x, y, z)
                    if i < 0:
                        continue
                    d = fields.distance[fields.starts[view] + i * fields.sizes[view, 1] + j]
                    if math.isnan(d):
                        continue
                    seen += 1
                    if d < -(margin + radius * scale + fields.sizes[view, 2]):
                        if misses < MOST:
                            missed_by[found, misses] = view
                        misses += 1
                        if misses > MOST:
                            break
                if misses <= MOST and seen >= 2:
                    for k in range(misses, MOST):
                        missed_by[found, k] = -1
                    places[found, 0], places[found, 1], places[found, 2] = ix, iy, iz
                    found += 1
    return found


@numba.njit(cache=True, nogil=True)
def see_cells(
    fields: Fields, view: int, low: Array, cell: float, places: NDArray[np.int16], missed_by: NDArray[np.int16],
    least: NDArray[np.uint8], depth: NDArray[np.float32],
) -> None:  # fmt: skip
    """What the other views say along the rays of a view.

    Args:
        least: (rows, columns) of its grid, the fewest other views that call a cell empty there, ``MOST + 1`` to begin.
        depth: (rows, columns) cells, one behind the other, that no other view calls empty, 0 to begin.
    """
    height, width = least.shape
    for k in range(places.shape[0]):
        x = low[0] + (places[k, 0] + 0.5) * cell
        y = low[1] + (places[k, 1] + 0.5) * cell
        z = low[2] + (places[k, 2] + 0.5) * cell
        i, j, scale = place_on_grid(fields, view, x, y, z)
        if i < 0:
            continue
        others = 0
        for m in range(MOST):
            if missed_by[k, m] >= 0 and missed_by[k, m] != view:
                others += 1
        # a cell is as wide as this many points of the grid
        across = cell * scale / fields.sizes[view, 2]
        reach = int(0.5 * across + 0.5)
        # so that one layer of cells adds up to one, whatever their size in the picture
        weight = across * across / (2 * reach + 1) ** 2
        for a in range(max(i - reach, 0), min(i + reach + 1, height)):
            for b in range(max(j - reach, 0), min(j + reach + 1, width)):
                least[a, b] = min(least[a, b], others)
                if others == 0:
                    depth[a, b] += weight


@numba.njit(cache=True, nogil=True)
def free_depth(
    fields: Fields, view: int, margin: float, origin: Array, rays: Array, near: float, far: float, num: int, out: Array
) -> None:
    """Length (N,) of each ray (N, 3) of a view, between ``near`` and ``far``, that no other view calls empty.

    Distances are read between the points of grids, so that this is finer than cells are.
    """
    step = (far - near) / num
    for k in range(rays.shape[0]):
        free = 0
        for n in range(num):
            t = near + (n + 0.5) * step
            x, y, z = origin[0] + t * rays[k, 0], origin[1] + t * rays[k, 1], origin[2] + t * rays[k, 2]
            is_empty, is_seen = False, False
            for other in range(fields.rows.shape[0]):
                if other == view:
                    continue
                d = _reading(fields, other, x, y, z)
                if not math.isnan(d):
                    is_seen = True
                    if d < -margin:
                        is_empty = True
                        break
            if is_seen and not is_empty:
                free += 1
        out[k] = free * step


@numba.njit(cache=True, nogil=True)
def _reading(fields: Fields, view: int, x: float, y: float, z: float) -> float:
    """Signed distance in a view at a place, by lines between the points of its grid; NaN where it cannot tell."""
    u, v, depth = project_point(fields.rows[view], x, y, z)
    height, width, step = fields.sizes[view, 0], fields.sizes[view, 1], fields.sizes[view, 2]
    # the first point of the grid is the centre of pixel step // 2
    a, b = (v - 0.5 - step // 2) / step, (u - 0.5 - step // 2) / step
    if not (depth > 0.0 and a > -0.5 and b > -0.5 and a < height - 0.5 and b < width - 0.5):
        return math.nan
    a, b = min(max(a, 0.0), height - 1.0), min(max(b, 0.0), width - 1.0)
    i, j = min(int(a), max(height - 2, 0)), min(int(b), max(width - 2, 0))
    a, b = a - i, b - j
    at = fields.starts[view] + i * width + j
    down, right = width * min(1, height - 1), min(1, width - 1)
    top = fields.distance[at] * (1.0 - b) + fields.distance[at + right] * b
    bottom = fields.distance[at + down] * (1.0 - b) + fields.distance[at + down + right] * b
    return float(top * (1.0 - a) + bottom * a)
