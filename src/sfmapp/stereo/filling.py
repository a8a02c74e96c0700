"""What stands for pixels that were not matched: the surfaces beside them, carried on as planes.

A hole in a row has a disparity at either end. Where these are of one surface, it spans the hole. Otherwise one side is
in front and hides what is behind it from the other camera: the farther surface goes on behind it, for as many pixels as
the disparities differ by, as no more can be hidden; what is wider than that was seen and not matched, and belongs to
the nearer of its ends. At a picture's border there is one side alone.

A surface is a plane of disparity fitted to matched pixels beside the end. Its slope is held towards zero, as errors of
neighbours are alike and a few of them make a slope of nothing, and it goes on for no more pixels than it was told by.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.stereo.checks import fill_holes

Floats = NDArray[np.float32]

# pixels beside an end that tell its plane: so many columns, and as many rows above and below
COLUMNS, ROWS = 40, 2
# what is off by more is of another surface, pixels; before there is a slope it may be as steep as this, px per px
SAME_PLANE_PX, STEEPEST = 1.0, 0.05
# of the slopes' prior: variance of a disparity over that of a slope (0.03 px per px). Errors have 0.5 px, and some 25
# neighbours, the window of the costs, share one
SLOPE_PRIOR = 8000.0
# ends that differ by less are of one surface: so many pixels, and more by STEEPEST for each pixel between them
SAME_SURFACE_PX = 1.0
# edges of surfaces are found to so many pixels: what is wider than can be hidden by more was not hidden
EDGE_PX = 4.0
# rows are filled one by one: the median of so many pixels and rows takes the streaks out
FILL_WINDOW = 5


class _Plane(NamedTuple):
    """Beside a hole: the disparity at its end, pixels per pixel away from it, and how many pixels told them."""

    value: float
    slope: float
    reach: float


@numba.njit(cache=True, nogil=True)
def _plane_beside(disparity: Floats, y: int, end: int, side: int) -> _Plane:
    """Plane through pixels from column ``end`` on, to the left (-1) or to the right (1)."""
    height, width = disparity.shape
    first = np.float64(disparity[y, end])
    value, along, down, count = first, 0.0, 0.0, 0.0
    for turn in range(3):
        count = 0.0
        su, sv, sz, suu, svv, suv, suz, svz = 0.0, 0.0, 0.0, SLOPE_PRIOR, SLOPE_PRIOR, 0.0, 0.0, 0.0
        for row in range(max(y - ROWS, 0), min(y + ROWS, height - 1) + 1):
            v = np.float64(row - y)
            for n in range(COLUMNS):
                column = end + side * n
                if column < 0 or column >= width:
                    break
                z, u = disparity[row, column], np.float64(n)
                room = SAME_PLANE_PX + (STEEPEST * (u + abs(v)) if turn == 0 else 0.0)
                if not abs(z - (value + along * u + down * v)) <= room:  # so it is of NaN
                    continue
                z -= first
                count += 1.0
                su, sv, sz = su + u, sv + v, sz + z
                suu, svv, suv, suz, svz = suu + u * u, svv + v * v, suv + u * v, suz + u * z, svz + v * z
        if count < 4.0:
            return _Plane(value, 0.0, 0.0)
        suu, svv, suv = suu - su * su / count, svv - sv * sv / count, suv - su * sv / count
        suz, svz = suz - su * sz / count, svz - sv * sz / count
        determinant = suu * svv - suv * suv
        along, down = (svv * suz - suv * svz) / determinant, (suu * svz - suv * suz) / determinant
        value = first + (sz - along * su - down * sv) / count
    return _Plane(value, along, count / (2 * ROWS + 1))


@numba.njit(cache=True, nogil=True)
def _carried(plane: _Plane, pixels: int) -> float:
    """Disparity so many pixels beyond the end of a plane."""
    return plane.value - plane.slope * min(float(pixels), plane.reach)


@numba.njit(cache=True, nogil=True)
def fill_rows(disparity: Floats, out: Floats) -> None:
    """Fill the holes (NaN) of disparities (H, W) row by row; rows without any stay as they are."""
    height, width = disparity.shape
    none = _Plane(np.inf, 0.0, 0.0)
    for y in range(height):
        x = 0
        while x < width:
            out[y, x] = disparity[y, x]
            if not np.isnan(disparity[y, x]):
                x += 1
                continue
            start = x
            while x < width and np.isnan(disparity[y, x]):
                out[y, x] = disparity[y, x]
                x += 1
            if start == 0 and x == width:
                break
            before = _plane_beside(disparity, y, start - 1, -1) if start > 0 else none
            behind = _plane_beside(disparity, y, x, 1) if x < width else none
            hidden = np.inf
            is_one = False
            if start > 0 and x < width:
                hidden = abs(np.float64(disparity[y, x]) - disparity[y, start - 1])
                is_one = hidden < SAME_SURFACE_PX + STEEPEST * (x - start)
            is_before = x == width or (start > 0 and disparity[y, start - 1] <= disparity[y, x])
            for k in range(start, x):
                past, left = k - start + 1, x - k
                a, b = _carried(before, past), _carried(behind, left)
                if is_one:
                    out[y, k] = (a * left + b * past) / (past + left)
                elif (left if is_before else past) > hidden + EDGE_PX:
                    out[y, k] = a if past <= left else b
                else:
                    out[y, k] = a if is_before else b


def fill_by_planes(disparity: Floats) -> Floats:
    """Disparities (H, W) float32 with their holes (NaN) filled; the others as they are."""
    full = np.empty_like(disparity)
    fill_rows(np.ascontiguousarray(disparity), full)
    full = fill_holes(full)
    return np.where(np.isnan(disparity), cv2.medianBlur(full, FILL_WINDOW), disparity)
