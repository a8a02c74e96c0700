"""Which cells a camera and mixtures of its lamps vouch for: kernels of :mod:`sfmapp.carve.lamp_mixtures`."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.cell_grid import Cells
from sfmapp.carve.views import project_point

Array = NDArray[np.float64]
Levels = NDArray[np.float32]

# what cells of the window may be
EMPTY, HELD, FREE = 0, 1, 2
# ways are looked along from outside of the cell that they begin in, in steps, cells
_START, _STEP = 0.9, 0.6
# lamps are in one plane with a place below this volume of the parallelepiped of their directions
_FLAT = 1e-4


@numba.njit(cache=True, nogil=True, error_model="numpy")
def hold_unproven(
    row: Array, camera: Array, lamps: Array, most: Levels, limit: float, low: Array, cell: float,
    places: NDArray[np.int32], state: Cells,
) -> int:  # fmt: skip
    """Hold the free cells that a camera and its lamps do not prove to be empty, as things stand; how many these were.

    Args:
        row: (29,) of the view. camera: (3,) its place. lamps: (L, 3).
        most: (L, H, W) greatest quotient of each pixel under each lamp, inf where nothing is known.
        limit: share of the camera's light that a mixture of lamps shows at least.
        low, cell: corner (3,) of the window, side of its cells.
        places: (N, 3) cells, those first that are nearest to the camera.
        state: (X, Y, Z) EMPTY, HELD or FREE, changed.
    """
    count = lamps.shape[0]
    height, width = most.shape[1], most.shape[2]
    toward, shown, is_open = np.empty((count, 3)), np.empty(count), np.empty(count, np.bool_)
    held = 0
    for n in range(places.shape[0]):
        i, j, k = places[n]
        if state[i, j, k] != FREE:
            continue
        state[i, j, k] = HELD
        held += 1
        x, y, z = low[0] + (i + 0.5) * cell, low[1] + (j + 0.5) * cell, low[2] + (k + 0.5) * cell
        u, v, depth = project_point(row, x, y, z)
        if not (depth > 0.0 and u >= 0.0 and v >= 0.0 and u < width and v < height):
            continue
        cx, cy, cz = camera[0] - x, camera[1] - y, camera[2] - z
        far = math.sqrt(cx * cx + cy * cy + cz * cz)
        cx, cy, cz = cx / far, cy / far, cz / far
        some = False
        for m in range(count):
            shown[m] = most[m, int(v), int(u)]
            some |= shown[m] < math.inf
        if not some or not _is_open(state, i, j, k, cx, cy, cz):
            continue
        for m in range(count):
            dx, dy, dz = lamps[m, 0] - x, lamps[m, 1] - y, lamps[m, 2] - z
            away = math.sqrt(dx * dx + dy * dy + dz * dz)
            dx, dy, dz = dx / away, dy / away, dz / away
            is_open[m] = _is_open(state, i, j, k, dx, dy, dz)
            fall = (far / away) ** 2
            toward[m, 0], toward[m, 1], toward[m, 2] = dx * fall, dy * fall, dz * fall
        if least_mixture(toward, shown, is_open, cx, cy, cz) < limit:
            state[i, j, k] = FREE
            held -= 1
    return held


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _is_open(state: Cells, i: int, j: int, k: int, dx: float, dy: float, dz: float) -> bool:
    """Whether no held cell is on the way from the middle of a cell in a direction, unit, as far as the window goes."""
    nx, ny, nz = state.shape
    t = _START
    while True:
        x, y, z = i + 0.5 + t * dx, j + 0.5 + t * dy, k + 0.5 + t * dz
        if not (0.0 <= x < nx and 0.0 <= y < ny and 0.0 <= z < nz):
            return True
        if state[int(x), int(y), int(z)] == HELD:
            return False
        t += _STEP


@numba.njit(cache=True, nogil=True, error_model="numpy")
def least_mixture(toward: Array, shown: Array, is_open: NDArray[np.bool_], cx: float, cy: float, cz: float) -> float:
    """Least brightness under three open lamps whose light together comes from the camera's direction, at its strength;
    inf if no three have the camera among them."""
    best = math.inf
    for a in range(toward.shape[0]):
        if not is_open[a] or not shown[a] < 1.0:
            continue
        for b in range(toward.shape[0]):
            if b == a or not is_open[b]:
                continue
            # normal of the plane through both
            px = toward[a, 1] * toward[b, 2] - toward[a, 2] * toward[b, 1]
            py = toward[a, 2] * toward[b, 0] - toward[a, 0] * toward[b, 2]
            pz = toward[a, 0] * toward[b, 1] - toward[a, 1] * toward[b, 0]
            for d in range(b):
                if d == a or not is_open[d]:
                    continue
                volume = px * toward[d, 0] + py * toward[d, 1] + pz * toward[d, 2]
                if abs(volume) < _FLAT:
                    continue
                share_d = (px * cx + py * cy + pz * cz) / volume
                # c x d against the other two, by Cramer's rule
                qx = cy * toward[d, 2] - cz * toward[d, 1]
                qy = cz * toward[d, 0] - cx * toward[d, 2]
                qz = cx * toward[d, 1] - cy * toward[d, 0]
                share_a = (qx * toward[b, 0] + qy * toward[b, 1] + qz * toward[b, 2]) / -volume
                share_b = (qx * toward[a, 0] + qy * toward[a, 1] + qz * toward[a, 2]) / volume
                if share_a >= 0.0 and share_b >= 0.0 and share_d >= 0.0:
                    best = min(best, share_a * shown[a] + share_b * shown[b] + share_d * shown[d])
    return best
