"""The inner loops of SIFT's detector (Lowe, IJCV 2004): blurs, the extrema of the scale space, their refinement.

Pixels here are those of an octave, with the centre of the top-left one at (0, 0). Level l of an octave, of 0 to
5, has a blur of ``SIGMA * 2 ** (l / 3)`` of its pixels.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.simd.f32x16 import (
    WIDTH,
    larger,
    load,
    smaller,
    splat,
    store,
    subtract,
    where_above,
    where_at_least,
)
from sfmapp.simd.pointers import Pointer, pointer

NUM_LAYERS = 3
NUM_LEVELS = NUM_LAYERS + 3
NUM_DIFFERENCES = NUM_LEVELS - 1
SIGMA = 1.6
# pixels at the edge of an octave where nothing is detected: the blurs have mirrored the image there
BORDER = 5
# columns that are scanned together, so that the rows at work stay in the cache, and floats from one row to the next
TILE = 512
PITCH = TILE + 2 * WIDTH
# rows at work: three of each difference, then their extremes
_EXTREMES = 3 * NUM_DIFFERENCES
NUM_ROWS_AT_WORK = _EXTREMES + 2 * NUM_DIFFERENCES
# moves of a keypoint while it is refined
_NUM_ROUNDS = 5

Floats = NDArray[np.float32]


@numba.njit(cache=True, nogil=True)
def _taps_0_to_4(
    out: Floats, k: Floats, m: Floats, a1: Floats, b1: Floats, a2: Floats, b2: Floats, a3: Floats,
    b3: Floats, a4: Floats, b4: Floats, num: int,
) -> None:  # fmt: skip
    k0, k1, k2, k3, k4 = k[0], k[1], k[2], k[3], k[4]
    for c in range(num):
        near = k0 * m[c] + k1 * (a1[c] + b1[c]) + k2 * (a2[c] + b2[c])
        out[c] = near + (k3 * (a3[c] + b3[c]) + k4 * (a4[c] + b4[c]))


@numba.njit(cache=True, nogil=True)
def _two_taps(out: Floats, k: Floats, a1: Floats, b1: Floats, a2: Floats, b2: Floats, num: int) -> None:
    k1, k2 = k[0], k[1]
    for c in range(num):
        out[c] += k1 * (a1[c] + b1[c]) + k2 * (a2[c] + b2[c])


@numba.njit(cache=True, nogil=True)
def blur(
    source: Floats, k: Floats, line: Floats, target: Floats, rows: tuple[int, int, int], tops: tuple[int, int]
) -> None:
    """Convolve columns, then rows, with a symmetric kernel; the image is mirrored at the centres of its outer pixels.

    A quarter to a half faster than OpenCV's, and the same to the last bit on any processor, as no multiplication is
    fused with an addition, and for any division of the image into rows.

    Args:
        source: (R, W) float32, rows of an image (H, W) with H and W at least N: those to blur and N - 1 on either
            side, where the image has them.
        k: (N,) float32, the kernel from its middle outwards; N is odd and at least 5.
        line: (W + 2 N,) float32, working memory.
        target: (T, W) float32, the rows to blur are filled; not the source.
        rows: first row of the image to blur, the one behind the last, and H.
        tops: which rows of the image the first ones of source and target are.
    """
    first, last, h = rows
    top, target_top = tops
    w = source.shape[1]
    n = k.shape[0] - 1
    s = source
    for r in range(first, last):
        column, out = line[n : n + w], target[r - target_top]
        up, down = r, 2 * h - 2 - r
        _taps_0_to_4(
            column, k, s[r - top],
            s[abs(up - 1) - top], s[min(r + 1, down - 1) - top], s[abs(up - 2) - top], s[min(r + 2, down - 2) - top],
            s[abs(up - 3) - top], s[min(r + 3, down - 3) - top], s[abs(up - 4) - top], s[min(r + 4, down - 4) - top], w,
        )  # fmt: skip
        for i in range(5, n, 2):
            _two_taps(
                column, k[i:], s[abs(up - i) - top], s[min(r + i, down - i) - top],
                s[abs(up - i - 1) - top], s[min(r + i + 1, down - i - 1) - top], w,
            )  # fmt: skip
        for i in range(1, n + 1):
            line[n - i] = line[n + i]
            line[n + w - 1 + i] = line[n + w - 1 - i]
        _taps_0_to_4(
            out, k, column, line[n - 1 :], line[n + 1 :], line[n - 2 :], line[n + 2 :],
            line[n - 3 :], line[n + 3 :], line[n - 4 :], line[n + 4 :], w,
        )  # fmt: skip
        for i in range(5, n, 2):
            _two_taps(out, k[i:], line[n - i :], line[n + i :], line[n - i - 1 :], line[n + i + 1 :], w)


@numba.njit(cache=True, nogil=True)
def _differences(levels: tuple[Pointer, ...], at: int, rows: Pointer, middle: int, num: int) -> None:
    """Fill the row after ``middle`` of the five differences, and the largest and smallest of their last three rows."""
    new, old = (middle + 1) % 3 * PITCH, (middle + 2) % 3 * PITCH
    for c in range(0, num, WIDTH):
        lower = load(levels[0], at + c)
        for d in range(NUM_DIFFERENCES):
            upper = load(levels[d + 1], at + c)
            value, ring, extremes = subtract(upper, lower), 3 * d * PITCH + c, (_EXTREMES + 2 * d) * PITCH + c
            store(rows, ring + new, value)
            a, b = load(rows, ring + old), load(rows, ring + middle * PITCH)
            store(rows, extremes, larger(larger(a, b), value))
            store(rows, extremes + PITCH, smaller(smaller(a, b), value))
            lower = upper


@numba.njit(cache=True, nogil=True)
def _around(rows: Pointer, at: int) -> tuple[Any, Any]:
    """The largest and smallest of 3 x 3 values of a difference, whose extremes of columns begin at a place."""
    most = larger(larger(load(rows, at), load(rows, at + 1)), load(rows, at + 2))
    at += PITCH
    return most, smaller(smaller(load(rows, at), load(rows, at + 1)), load(rows, at + 2))


@numba.njit(cache=True, nogil=True)
def _mark_extremes(rows: Pointer, middle: int, low: Any, high: Any, marks: Pointer, num: int) -> None:
    """Marks (C, 3): of every 16 pixels and each layer the bits of those that are extremes and far enough from zero."""
    for c in range(0, num, WIDTH):
        at = _EXTREMES * PITCH + c
        near = (
            _around(rows, at), _around(rows, at + 2 * PITCH), _around(rows, at + 4 * PITCH),
            _around(rows, at + 6 * PITCH), _around(rows, at + 8 * PITCH),
        )  # fmt: skip
        for layer in range(1, NUM_LAYERS + 1):
            v = load(rows, (3 * layer + middle) * PITCH + c + 1)
            most = larger(larger(near[layer - 1][0], near[layer][0]), near[layer + 1][0])
            least = smaller(smaller(near[layer - 1][1], near[layer][1]), near[layer + 1][1])
            peaks = where_at_least(v, most) & where_above(v, low)
            marks[c // WIDTH * NUM_LAYERS + layer - 1] = peaks | (where_at_least(least, v) & where_above(high, v))


@numba.njit(cache=True, nogil=True)
def find_extrema(
    levels: tuple[Floats, ...], span: tuple[int, int, int], threshold: float, rows: Floats, marks: NDArray[np.int64],
    place: NDArray[np.int32], value: Floats,
) -> int:  # fmt: skip
    """Pixels whose difference of Gaussians is the largest or smallest of its 26 neighbours and exceeds the threshold.

    Args:
        levels: the six levels of an octave, (R, W) float32 each, with at least 16 floats behind the last row, which
            are read and do not matter.
        span: which row of the octave they begin with, the first row to search, and the one behind the last.
        threshold: grey levels.
        rows: (25, PITCH) float32 and marks: (PITCH,) int64, working memory: the last three rows of the five
            differences, then of each the largest and the smallest of three.
        place: (C, 4) int32 and value: (C,) float32, filled with layer, row, column, the rounds of refinement that it
            may have, and the absolute difference.

    Returns:
        How many there are; those beyond C are counted only.
    """
    top, first, last = span
    width = levels[0].shape[1]
    pointers = (
        pointer(levels[0]), pointer(levels[1]), pointer(levels[2]), pointer(levels[3]), pointer(levels[4]),
        pointer(levels[5]),
    )  # fmt: skip
    at_work, marked = pointer(rows), pointer(marks)
    low, high = splat(np.float32(threshold)), splat(np.float32(-threshold))
    count = 0
    for left in range(BORDER, width - BORDER, TILE):
        n = min(TILE, width - BORDER - left)
        for r in range(first - 1, last + 1):
            middle = (r - 1) % 3
            _differences(pointers, (r - top) * width + left - 1, at_work, middle, n + 2)
            if r < first + 1:
                continue
            _mark_extremes(at_work, middle, low, high, marked, n)
            for m in range(NUM_LAYERS * ((n + WIDTH - 1) // WIDTH)):
                if marks[m] == 0:
                    continue
                layer, start = m % NUM_LAYERS + 1, m // NUM_LAYERS * WIDTH
                for c in range(start, min(start + WIDTH, n)):
                    if marks[m] >> (c - start) & 1:
                        if count < place.shape[0]:
                            place[count, 0], place[count, 1], place[count, 2] = layer, r - 1, left + c
                            place[count, 3] = _NUM_ROUNDS
                            value[count] = abs(rows[3 * layer + middle, c + 1])
                        count += 1
    return count


@numba.njit(cache=True, nogil=True)
def _locate(d: NDArray[np.float64], ds: float, edge_threshold: float, out: NDArray[np.float64]) -> bool:
    """Place and height of the summit at a given scale.

    The fit over place and scale at once takes the curvature in the plane to be the same at all scales, though it falls
    with the scale: that alone moves the summit by up to a tenth of a pixel. So the differences are first interpolated
    to the scale, and the place is found among those nine.

    Args:
        d: (3, 3, 3) differences by layer, row, column; ds: scale in layers from the middle one.
        out: filled with column and row from the middle one, and at 3 with the absolute height.

    Returns:
        Whether it is a summit, within a pixel, and not on an edge.
    """
    p = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            slope = 0.5 * (d[2, i, j] - d[0, i, j])
            p[i, j] = d[1, i, j] + ds * (slope + 0.5 * ds * (d[2, i, j] + d[0, i, j] - 2.0 * d[1, i, j]))
    gx, gy = 0.5 * (p[1, 2] - p[1, 0]), 0.5 * (p[2, 1] - p[0, 1])
    xx, yy = p[1, 2] + p[1, 0] - 2.0 * p[1, 1], p[2, 1] + p[0, 1] - 2.0 * p[1, 1]
    xy = 0.25 * (p[2, 2] - p[2, 0] - p[0, 2] + p[0, 0])
    trace, det = xx + yy, xx * yy - xy * xy
    if det <= 0.0 or trace * trace * edge_threshold >= (edge_threshold + 1.0) ** 2 * det:
        return False
    dx, dy = (xy * gy - yy * gx) / det, (xy * gx - xx * gy) / det
    out[0], out[1], out[3] = dx, dy, abs(p[1, 1] + 0.5 * (gx * dx + gy * dy))
    return abs(dx) < 1.0 and abs(dy) < 1.0


@numba.njit(cache=True, nogil=True)
def refine_extremum(
    levels: tuple[Floats, ...], origin: tuple[int, int], shape: tuple[int, int], place: NDArray[np.int32],
    edge_threshold: float, out: NDArray[np.float64],
) -> bool:  # fmt: skip
    """Fit a parabola to the 27 differences around a pixel (Brown and Lowe, BMVC 2002), moving on while it lies outside.

    Args:
        levels: the six levels of an octave, (R, C) float32 each.
        origin: row and column of the octave that they begin with; shape: (H, W) of the octave.
        place: (4,) layer, row, column and rounds that are left, which are more than 0 afterwards only if it moved out
            of the levels: then it can go on there with others.
        edge_threshold: largest ratio of the principal curvatures.
        out: (4,) float64, filled with column, row, layer (all with fractions) and absolute difference there.

    Returns:
        Whether the fit settled and the place does not lie on an edge.
    """
    height, width = shape
    num_rows, num_cols = levels[0].shape
    layer, row, col, rounds = place[0], place[1], place[2], place[3]
    place[3] = 0
    d = np.empty((3, 3, 3))
    while rounds > 0:
        top, left = row - 1 - origin[0], col - 1 - origin[1]
        if top < 0 or left < 0 or top + 3 > num_rows or left + 3 > num_cols:
            place[0], place[1], place[2], place[3] = layer, row, col, rounds
            return False
        rounds -= 1
        for k in range(3):
            for i in range(3):
                for j in range(3):
                    d[k, i, j] = levels[layer + k][top + i, left + j] - levels[layer + k - 1][top + i, left + j]
        v = d[1, 1, 1]
        gx = 0.5 * (d[1, 1, 2] - d[1, 1, 0])
        gy = 0.5 * (d[1, 2, 1] - d[1, 0, 1])
        gs = 0.5 * (d[2, 1, 1] - d[0, 1, 1])
        xx = d[1, 1, 2] + d[1, 1, 0] - 2.0 * v
        yy = d[1, 2, 1] + d[1, 0, 1] - 2.0 * v
        ss = d[2, 1, 1] + d[0, 1, 1] - 2.0 * v
        xy = 0.25 * (d[1, 2, 2] - d[1, 2, 0] - d[1, 0, 2] + d[1, 0, 0])
        xs = 0.25 * (d[2, 1, 2] - d[2, 1, 0] - d[0, 1, 2] + d[0, 1, 0])
        ys = 0.25 * (d[2, 2, 1] - d[2, 0, 1] - d[0, 2, 1] + d[0, 0, 1])
        # Cramer's rule for the symmetric system
        c0 = yy * ss - ys * ys
        c1 = xs * ys - xy * ss
        c2 = xy * ys - xs * yy
        det = xx * c0 + xy * c1 + xs * c2
        if det == 0.0:
            return False
        dx = -(gx * c0 + gy * c1 + gs * c2) / det
        dy = -(gx * c1 + gy * (xx * ss - xs * xs) + gs * (xy * xs - xx * ys)) / det
        ds = -(gx * c2 + gy * (xy * xs - xx * ys) + gs * (xx * yy - xy * xy)) / det
        if abs(dx) < 0.6 and abs(dy) < 0.6 and abs(ds) < 0.6:
            if not _locate(d, ds, edge_threshold, out):
                return False
            out[0] += col
            out[1] += row
            out[2] = layer + ds
            return True
        if not (abs(dx) < 1e3 and abs(dy) < 1e3 and abs(ds) < 1e3):
            return False
        col += round(dx)
        row += round(dy)
        layer += round(ds)
        if layer < 1 or layer > NUM_LAYERS or not (BORDER <= col < width - BORDER and BORDER <= row < height - BORDER):
            return False
    return False


@numba.njit(cache=True, nogil=True)
def refine_all(
    levels: tuple[Floats, ...], origin: tuple[int, int], shape: tuple[int, int], place: NDArray[np.int32],
    edge_threshold: float, out: NDArray[np.float64],
) -> None:  # fmt: skip
    """:func:`refine_extremum` of every place (N, 4); rows of out (N, 4) that fail become NaN."""
    for n in range(place.shape[0]):
        if not refine_extremum(levels, origin, shape, place[n], edge_threshold, out[n]):
            out[n, :] = np.nan
