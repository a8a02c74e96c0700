"""Frames that show what the last one shows: told from single steps of Lucas and Kanade (IJCAI 1981) at the tracked
points, which cost a hundredth of looking for these points."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.odometry.frontend.pyramid import Pyramid

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

# Half the side of the squares around points.
_HALF = 4
# Fewest points that tell.
_MIN_POINTS = 30
# How much of what a square shows may have changed, for half of the squares: two tenths are a correlation of 0.9. Beyond
# half a pixel a single step tells nothing, and is small where squares have nothing in common.
_MAX_CHANGED = 0.2


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _steps(first: Bytes, second: Bytes, xy: Array, normal: Array, right: Array, changed: Array) -> None:
    """Normal equations of a shift of each point: normal (N, 3) with xx, xy and yy, right (N, 2); changed (N,) is the
    sum of squared differences over that of what the square shows.

    A change of brightness of a square as a whole is none. Squares that leave the image stay at zero.
    """
    height, width = first.shape
    for n in range(xy.shape[0]):
        normal[n], right[n], changed[n] = 0.0, 0.0, 0.0
        c0, r0 = int(np.floor(xy[n, 0])), int(np.floor(xy[n, 1]))
        if not (_HALF < c0 < width - _HALF - 1 and _HALF < r0 < height - _HALF - 1):
            continue
        mean, change = 0.0, 0.0
        for r in range(r0 - _HALF, r0 + _HALF):
            for c in range(c0 - _HALF, c0 + _HALF):
                mean += float(first[r, c])
                change += float(second[r, c]) - float(first[r, c])
        mean, change = mean / (4.0 * _HALF * _HALF), change / (4.0 * _HALF * _HALF)
        shown = 0.0
        for r in range(r0 - _HALF, r0 + _HALF):
            for c in range(c0 - _HALF, c0 + _HALF):
                gx = 0.5 * (float(first[r, c + 1]) - float(first[r, c - 1]))
                gy = 0.5 * (float(first[r + 1, c]) - float(first[r - 1, c]))
                e = change - (float(second[r, c]) - float(first[r, c]))
                shown += (float(first[r, c]) - mean) ** 2
                changed[n] += e * e
                normal[n, 0] += gx * gx
                normal[n, 1] += gx * gy
                normal[n, 2] += gy * gy
                right[n, 0] += gx * e
                right[n, 1] += gy * e
        changed[n] = changed[n] / shown if shown > 0.0 else np.inf


def is_twin(reference: Pyramid, pyramid: Pyramid, xy: Array, point_px: float, together_px: float) -> bool:
    """Whether an image differs from another by less than a pose that was measured there is known by.

    Args:
        reference: the other, in which points were tracked to xy (N, 2) pixels. pyramid: of the image.
        point_px: standard deviation of the place of one point, a coordinate.
        together_px: what that makes of the places where the pose puts the points.

    Half of the points look as they did and moved by less than their own places are known by, and all of them together,
    as an affine flow, by less than the pose puts them anywhere.
    """
    if len(xy) < _MIN_POINTS or reference.shape != pyramid.shape:
        return False
    normal, right, changed = np.empty((len(xy), 3)), np.empty((len(xy), 2)), np.empty(len(xy))
    _steps(reference.level(0), pyramid.level(0), np.ascontiguousarray(xy), normal, right, changed)
    xx, mixed, yy = normal.T
    determinant = xx * yy - mixed**2
    told = determinant > 1e-6 * (xx + yy) ** 2
    if told.sum() < _MIN_POINTS or np.median(changed[told]) > _MAX_CHANGED:
        return False
    xx, mixed, yy, right, determinant = xx[told], mixed[told], yy[told], right[told], determinant[told]
    moved = np.column_stack([yy * right[:, 0] - mixed * right[:, 1], xx * right[:, 1] - mixed * right[:, 0]])
    if np.median(np.abs(moved / determinant[:, None])) > point_px:
        return False
    place = np.column_stack([np.ones(len(xx)), xy[told] / max(pyramid.shape)])
    square = np.einsum("n,ni,nj->ij", xx, place, place), np.einsum("n,ni,nj->ij", yy, place, place)
    across = np.einsum("n,ni,nj->ij", mixed, place, place)
    try:
        flow = np.linalg.solve(np.block([[square[0], across], [across, square[1]]]), (right.T @ place).ravel())
    except np.linalg.LinAlgError:
        return False
    return bool(np.sqrt(np.mean((place @ flow.reshape(2, 3).T) ** 2)) <= together_px)


def compile_kernels() -> None:
    """Compile the kernel of this module, or load it from numba's cache."""
    image = np.zeros((16, 16), np.uint8)
    _steps(image, image, np.zeros((1, 2)), np.empty((1, 3)), np.empty((1, 2)), np.empty(1))
