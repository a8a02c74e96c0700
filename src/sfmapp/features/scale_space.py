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
    SUMS_WIDTH,
    WIDTH,
    larger,
    load,
    smaller,
    splat,
    store,
    subtract,
    summing_along,
    summing_down,
    where_above,
    where_at_least,
)
from sfmapp.simd.pointers import Pointer, offset, pointer

NUM_LAYERS = 3
NUM_LEVELS = NUM_LAYERS + 3
NUM_DIFFERENCES = NUM_LEVELS - 1
SIGMA = 1.6
# pixels at the edge of an octave where nothing is detected: the blurs have mirrored the image there
BORDER = 5
# columns that are scanned together, so that the rows at work stay in the cache, and floats from one row to the next
TILE = 512
PITCH = TILE + 2 * WIDTH
# rows at work: three of each difference, then the extremes of each layer
_EXTREMES = 3 * NUM_DIFFERENCES
NUM_ROWS_AT_WORK = _EXTREMES + 2 * NUM_LAYERS
# kernels read whole vectors, and with the last of a row what lies behind it: floats behind the last row of a level
SLACK = 3 * WIDTH
# rows that are blurred together, and sums along a row of so many pixels on either side
ROWS_AT_ONCE = 4
_SHORT, _LONG = 6, 10
_sum_along_short, _sum_along_long = summing_along(_SHORT), summing_along(_LONG)
_sum_down = summing_down(ROWS_AT_ONCE)
# moves of a keypoint while it is refined
_NUM_ROUNDS = 5

Floats = NDArray[np.float32]


def empty_level(shape: tuple[int, int]) -> Floats:
    """Memory for a level (H, W), with what kernels read behind its last row."""
    return np.empty(shape[0] * shape[1] + SLACK, np.float32)[: shape[0] * shape[1]].reshape(shape)


def empty_lines(width: int) -> Floats:
    """Memory for rows that :func:`blur` has at work."""
    # zeros, as what lies beside a row of it is multiplied by zero
    return np.zeros((ROWS_AT_ONCE, (width // WIDTH + 4) * WIDTH), np.float32)


@numba.njit(cache=True, nogil=True)
def _sum_down_narrow(
    source: Pointer, weights: Pointer, steps: Pointer, width: int, target: Pointer, to: int, pitch: int, num: int
) -> None:
    """As ``_sum_down`` where a row has no 32 pixels."""
    for r in range(ROWS_AT_ONCE):
        for c in range(width):
            value = np.float32(0.0)
            for j in range(num):
                value += weights[j + ROWS_AT_ONCE - 1 - r] * source[steps[j] + c]
            target[to + r * pitch + c] = value


@numba.njit(cache=True, nogil=True)
def _sum_along(line: Pointer, weights: Pointer, reach: int, width: int, target: Pointer, to: int) -> None:
    """Fill a row with weighted sums of what is left and right of each pixel; a line begins WIDTH before its first."""
    for c in range(0, width, WIDTH):
        if reach <= _SHORT:
            value = _sum_along_short(line, WIDTH + c, weights)
        else:
            value = _sum_along_long(line, WIDTH + c, weights)
        if c + WIDTH <= width:
            store(target, to + c, value)
        else:
            store(line, 0, value)
            for i in range(width - c):
                target[to + c + i] = line[i]


@numba.njit(cache=True, nogil=True)
def blur(
    source: Floats, k: Floats, lines: Floats, target: Floats, rows: tuple[int, int, int], tops: tuple[int, int]
) -> None:
    """Convolve columns, then rows, with a symmetric kernel; the image is mirrored at the centres of its outer pixels.

    The same to the last bit for any division of the image into rows.

    Args:
        source: (R, W) float32, rows of an image (H, W) with H and W at least N: those to blur and N - 1 on either
            side, where the image has them.
        k: (N,) float32, the kernel from its middle outwards; N is at most 11.
        lines: (ROWS_AT_ONCE, at least W + 4 WIDTH) float32, working memory.
        target: (T, W) float32, the rows to blur are filled; not the source.
        rows: first row of the image to blur, the one behind the last, and H.
        tops: which rows of the image the first ones of source and target are.
    """
    first, last, h = rows
    top, target_top = tops
    w, n, pitch = source.shape[1], k.shape[0] - 1, lines.shape[1]
    pixels, line, out = pointer(source), pointer(lines), pointer(target)
    # the taps, with zeros beside: for rows that are not a pixel's own, and for the longer sums along rows
    reach = _SHORT if n <= _SHORT else _LONG
    taps = np.zeros(2 * (reach + ROWS_AT_ONCE) - 1, np.float32)
    middle = reach + ROWS_AT_ONCE - 1
    for i in range(n + 1):
        taps[middle - i] = taps[middle + i] = k[i]
    num = 2 * n + ROWS_AT_ONCE
    places = np.empty(num, np.int64)
    weights, steps = pointer(taps), pointer(places)
    for start in range(first, last, ROWS_AT_ONCE):
        for j in range(num):
            # rows behind the last are no pixel's own
            r = min(start - n + j, last - 1 + n)
            places[j] = (min(abs(r), 2 * h - 2 - r) - top) * w
        down = offset(weights, reach - n)
        if w < 2 * WIDTH:  # on every machine, as these sums are rounded otherwise
            _sum_down_narrow(pixels, down, steps, w, line, WIDTH, pitch, num)
        else:
            for c in range(0, w, SUMS_WIDTH):
                # the last ones once more, in place of pixels that are not there
                c = min(c, w - SUMS_WIDTH)
                _sum_down(pixels, down, steps, c, num, line, WIDTH + c, pitch)
        for r in range(start, min(start + ROWS_AT_ONCE, last)):
            row = (r - start) * pitch + WIDTH
            for i in range(1, n + 1):
                line[row - i] = line[row + i]
                line[row + w - 1 + i] = line[row + w - 1 - i]
            beside = offset(weights, ROWS_AT_ONCE - 1)
            _sum_along(offset(line, row - WIDTH), beside, n, w, out, (r - target_top) * w)
    # the pointers are used up
    taps[0] = lines[0, 0] = places[0]


@numba.njit(cache=True, nogil=True)
def _differences(levels: tuple[Pointer, ...], at: int, rows: Pointer, middle: int, num: int) -> None:
    """Fill the row after ``middle`` of the five differences, and for each layer the largest and smallest of the last
    three rows of its own difference and those beside it."""
    new, old = (middle + 1) % 3 * PITCH, (middle + 2) % 3 * PITCH
    for c in range(0, num, WIDTH):
        lower = load(levels[0], at + c)
        most = least = most_of_two = least_of_two = lower
        for d in range(NUM_DIFFERENCES):
            upper = load(levels[d + 1], at + c)
            value, ring = subtract(upper, lower), 3 * d * PITCH + c
            store(rows, ring + new, value)
            a, b = load(rows, ring + old), load(rows, ring + middle * PITCH)
            high, low = larger(larger(a, b), value), smaller(smaller(a, b), value)
            if d > 1:
                extremes = (_EXTREMES + 2 * (d - 2)) * PITCH + c
                store(rows, extremes, larger(most_of_two, high))
                store(rows, extremes + PITCH, smaller(least_of_two, low))
            most_of_two, least_of_two = larger(most, high), smaller(least, low)
            most, least, lower = high, low, upper


@numba.njit(cache=True, nogil=True)
def _mark_extremes(rows: Pointer, middle: int, low: Any, high: Any, marks: Pointer, num: int) -> None:
    """Marks (C, 3): of every 16 pixels and each layer the bits of those that are extremes and far enough from zero."""
    for c in range(0, num, WIDTH):
        for layer in range(1, NUM_LAYERS + 1):
            at = (_EXTREMES + 2 * (layer - 1)) * PITCH + c
            most = larger(larger(load(rows, at), load(rows, at + 1)), load(rows, at + 2))
            at += PITCH
            least = smaller(smaller(load(rows, at), load(rows, at + 1)), load(rows, at + 2))
            v = load(rows, (3 * layer + middle) * PITCH + c + 1)
            peaks = where_at_least(v, most) & where_above(v, low)
            marks[c // WIDTH * NUM_LAYERS + layer - 1] = peaks | (where_at_least(least, v) & where_above(high, v))


@numba.njit(cache=True, nogil=True)
def find_extrema(
    levels: tuple[Floats, ...], span: tuple[int, int, int], threshold: float, rows: Floats, marks: NDArray[np.int64],
    place: NDArray[np.int32], value: Floats,
) -> int:  # fmt: skip
    """Pixels whose difference of Gaussians is the largest or smallest of its 26 neighbours and exceeds the threshold.

    Args:
        levels: the six levels of an octave, (R, W) float32 each, with SLACK floats behind the last row, which are
            read and do not matter.
        span: which row of the octave they begin with, the first row to search, and the one behind the last.
        threshold: grey levels.
        rows: (21, PITCH) float32 and marks: (PITCH,) int64, working memory: the last three rows of the five
            differences, then for each layer the largest and the smallest of nine.
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
def _locate(
    d: NDArray[np.float64], p: NDArray[np.float64], ds: float, edge_threshold: float, out: NDArray[np.float64]
) -> bool:
    """Place and height of the summit at a given scale.

    The fit over place and scale at once takes the curvature in the plane to be the same at all scales, though it falls
    with the scale: that alone moves the summit by up to a tenth of a pixel. So the differences are first interpolated
    to the scale, and the place is found among those nine.

    Args:
        d: (3, 3, 3) differences by layer, row, column; p: (3, 3), working memory.
        ds: scale in layers from the middle one.
        out: filled with column and row from the middle one, at 3 with the absolute height, and at 4 with its sign.

    Returns:
        Whether it is a summit, within a pixel, and not on an edge.
    """
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
    height = p[1, 1] + 0.5 * (gx * dx + gy * dy)
    # more blur makes the middle of what is dark brighter
    out[0], out[1], out[3], out[4] = dx, dy, abs(height), 1.0 if height > 0.0 else -1.0
    return abs(dx) < 1.0 and abs(dy) < 1.0


@numba.njit(cache=True, nogil=True)
def refine_extremum(
    levels: tuple[Floats, ...], origin: tuple[int, int], shape: tuple[int, int], place: NDArray[np.int32],
    edge_threshold: float, d: NDArray[np.float64], out: NDArray[np.float64],
) -> bool:  # fmt: skip
    """Fit a parabola to the 27 differences around a pixel (Brown and Lowe, BMVC 2002), moving on while it lies outside.

    Args:
        levels: the six levels of an octave, (R, C) float32 each.
        origin: row and column of the octave that they begin with; shape: (H, W) of the octave.
        place: (4,) layer, row, column and rounds that are left, which are more than 0 afterwards only if it moved out
            of the levels: then it can go on there with others.
        edge_threshold: largest ratio of the principal curvatures.
        d: (4, 3, 3), working memory.
        out: (5,) float64, filled with column, row, layer (all with fractions), absolute difference there and its sign.

    Returns:
        Whether the fit settled and the place does not lie on an edge.
    """
    height, width = shape
    num_rows, num_cols = levels[0].shape
    layer, row, col, rounds = place[0], place[1], place[2], place[3]
    place[3] = 0
    while rounds > 0:
        top, left = row - 1 - origin[0], col - 1 - origin[1]
        if top < 0 or left < 0 or top + 3 > num_rows or left + 3 > num_cols:
            place[0], place[1], place[2], place[3] = layer, row, col, rounds
            return False
        rounds -= 1
        # once each: looking a level up copies what is known of all of them
        finest, fine, coarse, coarsest = levels[layer - 1], levels[layer], levels[layer + 1], levels[layer + 2]
        for i in range(3):
            for j in range(3):
                r, c = top + i, left + j
                d[0, i, j] = fine[r, c] - finest[r, c]
                d[1, i, j] = coarse[r, c] - fine[r, c]
                d[2, i, j] = coarsest[r, c] - coarse[r, c]
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
            if not _locate(d, d[3], ds, edge_threshold, out):
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
    """:func:`refine_extremum` of every place (N, 4); rows of out (N, 5) that fail become NaN."""
    d = np.empty((4, 3, 3))
    for n in range(place.shape[0]):
        if not refine_extremum(levels, origin, shape, place[n], edge_threshold, d, out[n]):
            out[n, :] = np.nan
