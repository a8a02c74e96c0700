"""Outlines to a fraction of a pixel, and the signed distance of each pixel to them.

A picture of coverage, 0 outside and 1 inside, has the outline where it crosses a half: marching squares between the
centres of pixels (Lorensen and Cline, 1987), straight pieces of which each pixel's nearest is found by sweeps that hand
the nearest piece on from pixel to pixel (Danielsson, "Euclidean Distance Mapping", 1980).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

Coverage = NDArray[np.float32]


@dataclass(frozen=True)
class Silhouette:
    """The object's outline in one photograph.

    Attributes:
        distance: (H, W) float32 pixels from the centre of each pixel to the outline, positive inside, to a fraction of
            a pixel near it; +inf everywhere if there is no outside, -inf if there is no object.
        known: (H, W) bool, False where the picture cannot tell (a hand in front, a hole in the lens's field): nothing
            is carved there; None for everywhere. Beyond the picture nothing is ever known.
        outline_sigma_px: standard deviation of the outline's place, pixels.
        source: how it was found, in a word for reports: ``alpha``, ``mask``, ``background``, ...
    """

    distance: NDArray[np.float32]
    known: NDArray[np.bool_] | None = None
    outline_sigma_px: float = 0.5
    source: str = "mask"

    @property
    def inside(self) -> NDArray[np.bool_]:
        """(H, W) pixels whose centre shows the object."""
        return np.asarray(self.distance > 0.0)


@numba.njit(cache=True, nogil=True)
def _segments(coverage: Coverage, out: NDArray[np.float32]) -> int:
    """Pieces of the outline (S, 4), x y x y in pixels whose first has its centre at (0, 0); the number of them."""
    count = 0
    points = np.empty((4, 2), np.float32)
    for y in range(coverage.shape[0] - 1):
        for x in range(coverage.shape[1] - 1):
            a, b = coverage[y, x] - 0.5, coverage[y, x + 1] - 0.5
            c, d = coverage[y + 1, x] - 0.5, coverage[y + 1, x + 1] - 0.5
            num = 0
            # around the cell: top, right, bottom, left
            if (a > 0.0) != (b > 0.0):
                points[num, 0], points[num, 1] = x + a / (a - b), y
                num += 1
            if (b > 0.0) != (d > 0.0):
                points[num, 0], points[num, 1] = x + 1, y + b / (b - d)
                num += 1
            if (c > 0.0) != (d > 0.0):
                points[num, 0], points[num, 1] = x + c / (c - d), y + 1
                num += 1
            if (a > 0.0) != (c > 0.0):
                points[num, 0], points[num, 1] = x, y + a / (a - c)
                num += 1
            if num == 0:
                continue
            first = 1
            if num == 4 and (a + b + c + d > 0.0) != (a > 0.0):
                first = 3  # a saddle whose middle is not on the side of its first corner: that corner is cut off
            for k in range(0, num, 2):
                i, j = k, k + 1
                if num == 4 and first == 3:
                    i, j = (0, 3) if k == 0 else (1, 2)
                out[count, 0], out[count, 1] = points[i, 0], points[i, 1]
                out[count, 2], out[count, 3] = points[j, 0], points[j, 1]
                count += 1
    return count


@numba.njit(cache=True, nogil=True)
def _squared_distance(pieces: NDArray[np.float32], k: int, x: float, y: float) -> float:
    ax, ay = pieces[k, 0], pieces[k, 1]
    dx, dy = pieces[k, 2] - ax, pieces[k, 3] - ay
    length = dx * dx + dy * dy
    t = 0.0
    if length > 0.0:
        t = min(1.0, max(0.0, ((x - ax) * dx + (y - ay) * dy) / length))
    ex, ey = ax + t * dx - x, ay + t * dy - y
    return float(ex * ex + ey * ey)


@numba.njit(cache=True, nogil=True)
def _relax(
    pieces: NDArray[np.float32], nearest: NDArray[np.int32], square: NDArray[np.float32], y: int, x: int, k: int
) -> None:
    """Let pixel (y, x) take piece k if that is nearer than its own."""
    if k >= 0 and k != nearest[y, x]:
        d = np.float32(_squared_distance(pieces, k, x, y))
        if d < square[y, x]:
            square[y, x] = d
            nearest[y, x] = k


@numba.njit(cache=True, nogil=True)
def _sweep(pieces: NDArray[np.float32], nearest: NDArray[np.int32], square: NDArray[np.float32]) -> None:
    """Hand the nearest pieces on: down and up, in each row to the right and to the left."""
    height, width = nearest.shape
    for k in range(pieces.shape[0]):
        x0 = int(min(pieces[k, 0], pieces[k, 2]))
        y0 = int(min(pieces[k, 1], pieces[k, 3]))
        for y in range(max(y0, 0), min(y0 + 2, height)):
            for x in range(max(x0, 0), min(x0 + 2, width)):
                _relax(pieces, nearest, square, y, x, k)
    for down in range(2):
        for i in range(height):
            y = i if down == 0 else height - 1 - i
            before = y - 1 if down == 0 else y + 1
            if 0 <= before < height:
                for x in range(width):
                    # neighbours mostly have one piece in common, which is not asked twice
                    asked = nearest[y, x]
                    for n in range(max(x - 1, 0), min(x + 2, width)):
                        k = nearest[before, n]
                        if k != asked:
                            _relax(pieces, nearest, square, y, x, k)
                            asked = k
            for x in range(1, width):
                _relax(pieces, nearest, square, y, x, nearest[y, x - 1])
            for x in range(width - 2, -1, -1):
                _relax(pieces, nearest, square, y, x, nearest[y, x + 1])


def outline_pieces(coverage: Coverage) -> NDArray[np.float32]:
    """Straight pieces (S, 4) of the outline of coverage (H, W) in 0 to 1: ends x y x y in pixels, centres at a half."""
    # a piece needs two crossings, and a cell has at most four
    inside = coverage > 0.5
    crossings = np.count_nonzero(inside[:, 1:] != inside[:, :-1]) + np.count_nonzero(inside[1:] != inside[:-1])
    out = np.empty((2 * crossings + 2, 4), np.float32)
    return np.asarray(out[: _segments(coverage, out)] + np.float32(0.5))


def signed_distance(coverage: Coverage) -> NDArray[np.float32]:
    """(H, W) float32 pixels from pixel centres to the outline, positive where coverage (H, W) is above a half; +inf or
    -inf everywhere if it crosses a half nowhere."""
    coverage = np.ascontiguousarray(coverage, np.float32)
    inside = coverage > 0.5
    pieces = outline_pieces(coverage) - np.float32(0.5)
    nearest = np.full(coverage.shape, -1, np.int32)
    square = np.full(coverage.shape, np.inf, np.float32)
    _sweep(pieces, nearest, square)
    return np.asarray(np.where(inside, np.sqrt(square), -np.sqrt(square)), np.float32)


# a mask of two values has steps of a pixel: smoothed by this many pixels, the outline is nearest to the true one
_STEPS_SIGMA = 0.7
# the outline may move so far from where a mask has it, pixels
_REACH = 2
# colours to either side are averaged over a window of this side, pixels
_WINDOW = 15
# outside and inside have to differ by so many standard deviations of their own colours for a picture to tell shares
_CONTRAST = 2.0


def coverage_of_mask(mask: NDArray[np.bool_]) -> Coverage:
    """Coverage (H, W) of a mask of whole pixels (H, W), its steps smoothed."""
    import cv2

    return np.asarray(cv2.GaussianBlur(mask.astype(np.float32), (0, 0), _STEPS_SIGMA))


def refined_coverage(picture: NDArray[np.uint8], mask: NDArray[np.bool_]) -> Coverage:
    """Coverage (H, W) of a mask (H, W) found in a photograph (H, W, 3): near its edge, what share of each pixel's
    colour is the object's.

    A pixel on the edge mixes the colour inside with that outside, both of which are taken from where it is not mixed,
    a little further off. Where they hardly differ the mask is kept as it is.
    """
    import cv2

    plain = coverage_of_mask(mask)
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return plain
    cut = np.s_[
        max(rows[0] - _WINDOW, 0) : rows[-1] + _WINDOW + 1, max(columns[0] - _WINDOW, 0) : columns[-1] + _WINDOW + 1
    ]
    whole, picture, mask, plain = plain, picture[cut], mask[cut], plain[cut]
    square = np.ones((2 * _REACH + 1,) * 2, np.uint8)
    core = cv2.erode(mask.astype(np.uint8), square)
    outer = 1 - cv2.dilate(mask.astype(np.uint8), square)
    color = picture.astype(np.float32)
    (inner_mean, inner_spread, near_core), (outer_mean, outer_spread, near_outer) = (
        _local_colors(color, core), _local_colors(color, outer)
    )  # fmt: skip
    across = inner_mean - outer_mean
    length = np.einsum("hwc,hwc->hw", across, across)
    share = np.einsum("hwc,hwc->hw", color - outer_mean, across) / np.maximum(length, 1e-6)
    tells = near_core & near_outer & (length > _CONTRAST**2 * (inner_spread + outer_spread)) & (core + outer == 0)
    whole[cut] = np.where(tells, np.clip(share, 0.0, 1.0), plain)
    return whole


def _local_colors(
    color: NDArray[np.float32], where: NDArray[np.uint8]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Means (H, W, 3) and variances (H, W), of the three channels together, of the pixels near each one that are in
    ``where``, and whether there are enough of them."""
    import cv2

    window = (_WINDOW, _WINDOW)
    weight = cv2.boxFilter(where.astype(np.float32), -1, window)
    scale = 1.0 / np.maximum(weight, 1e-6)
    chosen = color * where[..., None]
    mean = cv2.boxFilter(chosen, -1, window) * scale[..., None]
    square = cv2.boxFilter(np.einsum("hwc,hwc->hw", chosen, chosen), -1, window) * scale
    spread = np.maximum(square - np.einsum("hwc,hwc->hw", mean, mean), 0.0)
    return mean, spread, weight * _WINDOW**2 >= 4.0
