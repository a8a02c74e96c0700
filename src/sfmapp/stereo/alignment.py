"""Matches of a rectified pair to hundredths of a pixel, along rows and across them.

A window about the left end is laid on the right picture, moved and sheared along the row: the disparity of a slanted
surface changes linearly over it, which a window that is only moved takes for a move across the rows as well (0.003 to
0.008 degrees of turn on rendered streets and halls). Gauss and Newton's steps on zero-mean, gain-corrected differences,
with the slopes of the left window (Baker and Matthews, "Lucas-Kanade 20 years on", IJCV 2004).
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.simd.cubic import cubic_weights
from sfmapp.stereo.sparse_matches import PairMatches

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]
Floats = NDArray[np.float32]

# half the side of a window; steps at most; a step that is none, pixels
_HALF, _ROUNDS, _STILL_PX = 8, 12, 2e-3
# What cubics do to fine detail hangs on the place between pixels, and is the same in both pictures where rows agree:
# that pulls rows together, by 2 to 6 per cent of their difference with detail of 3 and 2 pixels. After this, by 0.2.
_SMOOTH_PX = 1.0
# correlation that the two windows have to reach; how far a keypoint's match may be moved, pixels; and how much
# disparity may change from one pixel to the next before a surface is seen from its edge
_LEAST_CORRELATION, _FARTHEST_PX, _STEEPEST = 0.9, 3.0, 0.6


def aligned_matches(left: Pixels, right: Pixels, matches: PairMatches) -> PairMatches:
    """Matches whose right ends are moved to where the window about the left one fits best; those that do not are left
    out.

    Args:
        left, right: (H, W) uint8 grey pictures of a rectified pair.
    """
    import cv2

    ends = np.empty((len(matches), 2))
    first, second = (cv2.GaussianBlur(one.astype(np.float32), (0, 0), _SMOOTH_PX) for one in (left, right))
    _align_all(first, second, np.ascontiguousarray(matches.left), np.ascontiguousarray(matches.right), ends)
    kept = np.isfinite(ends).all(1)
    return PairMatches(matches.left[kept], ends[kept])


@numba.njit(cache=True, nogil=True)
def _align_all(left: Floats, right: Floats, xy_left: Array, xy_right: Array, out: Array) -> None:
    """Fill out (N, 2) with the right ends, NaN where there is none."""
    side = 2 * _HALF + 1
    window, seen = np.empty((side, side)), np.empty((side, side))
    rim = np.empty((side + 2, side + 2))
    slopes, inverse = np.empty((4, side, side)), np.empty((4, 4))
    for n in range(len(xy_left)):
        out[n, 0] = out[n, 1] = math.nan
        _sample(left, xy_left[n, 0], xy_left[n, 1], 0.0, 0.0, rim)
        if math.isnan(rim[0, 0]) or not _take_window(rim, window, slopes, inverse):
            continue
        _align(right, xy_right[n, 0], xy_right[n, 1], window, slopes, inverse, seen, out[n])


@numba.njit(cache=True, nogil=True)
def _sample(picture: Floats, x: float, y: float, stretch: float, shear: float, out: Array) -> None:
    """Fill out (S, S) with a window centred on a pixel, its x stretched and sheared along rows; NaN at the first place
    where the picture does not hold it."""
    height, width = picture.shape
    half = out.shape[0] // 2
    top = y - 0.5 - half
    i = math.floor(top)
    reach = half * (1.0 + abs(stretch) + abs(shear)) + 3.0
    if i < 1 or i + out.shape[0] + 2 >= height or x - reach < 0.0 or x + reach >= width:
        out[0, 0] = math.nan
        return
    rows = cubic_weights(top - i)
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            at = x - 0.5 + (1.0 + stretch) * (c - half) + shear * (r - half)
            j = math.floor(at)
            columns = cubic_weights(at - j)
            total = 0.0
            for a in range(4):
                line = picture[i + r - 1 + a]
                total += rows[a] * (
                    columns[0] * line[j - 1]
                    + columns[1] * line[j]
                    + columns[2] * line[j + 1]
                    + columns[3] * line[j + 2]
                )
            out[r, c] = total


@numba.njit(cache=True, nogil=True)
def _take_window(rim: Array, window: Array, slopes: Array, inverse: Array) -> bool:
    """The left window at zero mean, its slopes by move along and across rows, stretch and shear, each at zero mean, and
    the inverse of their normal matrix; whether it has one."""
    side = window.shape[0]
    half = side // 2
    for r in range(side):
        for c in range(side):
            window[r, c] = rim[r + 1, c + 1]
            gx = 0.5 * (rim[r + 1, c + 2] - rim[r + 1, c])
            slopes[0, r, c], slopes[1, r, c] = gx, 0.5 * (rim[r + 2, c + 1] - rim[r, c + 1])
            slopes[2, r, c], slopes[3, r, c] = gx * (c - half), gx * (r - half)
    _take_off_mean(window)
    for k in range(4):
        _take_off_mean(slopes[k])
    normal = np.empty((4, 4))
    for a in range(4):
        for b in range(4):
            normal[a, b] = _product(slopes[a], slopes[b])
    return _inverted(normal, inverse)


# by hand: what numba brings for whole arrays takes seconds to compile
@numba.njit(cache=True, nogil=True)
def _take_off_mean(values: Array) -> None:
    total = 0.0
    for r in range(values.shape[0]):
        for c in range(values.shape[1]):
            total += values[r, c]
    mean = total / values.size
    for r in range(values.shape[0]):
        for c in range(values.shape[1]):
            values[r, c] -= mean


@numba.njit(cache=True, nogil=True)
def _product(a: Array, b: Array) -> float:
    """Sum of the products of numbers in the same place."""
    total = 0.0
    for r in range(a.shape[0]):
        for c in range(a.shape[1]):
            total += a[r, c] * b[r, c]
    return total


@numba.njit(cache=True, nogil=True)
def _inverted(normal: Array, inverse: Array) -> bool:
    """Gauss and Jordan's inverse of a positive definite matrix; False where it has none that can be trusted."""
    size = normal.shape[0]
    scale = normal[0, 0] + normal[1, 1]
    for a in range(size):
        for b in range(size):
            inverse[a, b] = 1.0 if a == b else 0.0
    for k in range(size):
        pivot = normal[k, k]
        if not pivot > 1e-4 * scale or not scale > 0.0:
            return False
        for b in range(size):
            normal[k, b] /= pivot
            inverse[k, b] /= pivot
        for a in range(size):
            if a != k:
                factor = normal[a, k]
                for b in range(size):
                    normal[a, b] -= factor * normal[k, b]
                    inverse[a, b] -= factor * inverse[k, b]
    return True


@numba.njit(cache=True, nogil=True)
def _align(
    right: Floats, x: float, y: float, window: Array, slopes: Array, inverse: Array, seen: Array, out: Array
) -> None:
    """Move and shear until nothing moves; out (2,) is left NaN where that leads astray or windows do not agree."""
    u = v = stretch = shear = 0.0
    correlation = 0.0
    energy = _product(window, window)
    step, left = np.empty(4), np.empty(window.shape)
    for _ in range(_ROUNDS):
        _sample(right, x + u, y + v, stretch, shear, seen)
        if math.isnan(seen[0, 0]):
            return
        _take_off_mean(seen)
        product, other = _product(window, seen), _product(seen, seen)
        if not product > 0.0:
            return
        correlation = product / math.sqrt(energy * other)
        gain = product / other
        for r in range(window.shape[0]):
            for c in range(window.shape[1]):
                left[r, c] = window[r, c] - gain * seen[r, c]
        for k in range(4):
            step[k] = _product(slopes[k], left)
        move = inverse @ step
        u, v, stretch, shear = u + move[0], v + move[1], stretch + move[2], shear + move[3]
        if math.hypot(u, v) > _FARTHEST_PX or max(abs(stretch), abs(shear)) > _STEEPEST:
            return
        if abs(move[0]) + abs(move[1]) < _STILL_PX:
            if correlation >= _LEAST_CORRELATION:
                out[0], out[1] = x + u, y + v
            return
