"""The inner loops of SIFT's descriptor (Lowe, IJCV 2004): orientations of keypoints and what lies around them.

Pixels are those of an octave, with the centre of the top-left one at (0, 0), as in :mod:`scale_space`.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.features.scale_space import NUM_LAYERS, SIGMA
from sfmapp.simd.bits import count_bits, first_bit
from sfmapp.simd.f32x16 import (
    WIDTH,
    add,
    fma,
    load,
    load_every_second,
    multiply,
    smaller,
    splat,
    store,
    subtract,
    total,
    where_above,
)
from sfmapp.simd.pointers import Pointer, pointer

# distance of the gradients that orientations and descriptors sample: the levels are so smooth that every second one
# gives the same matches for a quarter of the time
STRIDE = 2
_NUM_ORIENTATION_BINS = 36
# a second orientation must reach this share of the strongest
_PEAK_RATIO = 0.8
# width of a cell of the descriptor in sigmas of the keypoint
_CELL_SIGMAS = 3.0
# squared distances are looked up in a table of the Gaussian, up to where its value is 4e-6
_EXP_MAX = 12.5
_EXP_SIZE = 2048
_EXP_TABLE = np.exp(-np.arange(_EXP_SIZE + 1) * (_EXP_MAX / _EXP_SIZE)).astype(np.float32)
# gradients of one descriptor at most: the turned square of 5 x 5 cells at the largest scale of an octave, and what the
# last vector has too many
_MAX_SAMPLES = int((5.0 * _CELL_SIGMAS * SIGMA * 2.0 ** (4.0 / 3.0) / STRIDE + 2.0) ** 2 * 1.2) + WIDTH
# working memory, in floats: places and gradients of the samples, then of the columns that they lie in, then a histogram
# of 5 x 5 squares between the centres of cells, of which each has 8 directions at its four corners
_U, _V, _GX, _GY = 0, _MAX_SAMPLES, 2 * _MAX_SAMPLES, 3 * _MAX_SAMPLES
_SQUARE, _DIRECTION, _WEIGHT = 4 * _MAX_SAMPLES, 5 * _MAX_SAMPLES, 6 * _MAX_SAMPLES
_MAX_COLUMNS = 4 * WIDTH
_COLUMN_U, _COLUMN_V = 7 * _MAX_SAMPLES, 7 * _MAX_SAMPLES + _MAX_COLUMNS
_HISTOGRAM = 7 * _MAX_SAMPLES + 2 * _MAX_COLUMNS
_PER_SQUARE = 2 * WIDTH
_CELLS = _HISTOGRAM + 25 * _PER_SQUARE
ROOM = _CELLS + 128
# a place that is in no window
_AWAY = np.float32(1e9)
# of each direction, where it stands among those of two cells, and what the next one has more
_ONE_HOT = np.tile(np.eye(8, dtype=np.float32), 2)
_TO_NEXT = np.roll(_ONE_HOT, -1, axis=0) - _ONE_HOT
# of two cells side by side the left one, and what the right one has more
_LEFT = np.repeat(np.array([1.0, 0.0], np.float32), 8)
_TO_RIGHT = np.repeat(np.array([-1.0, 1.0], np.float32), 8)

Floats = NDArray[np.float32]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _polar(gx: Floats, gy: Floats, num: int) -> None:
    """Replace gradients by their lengths and directions in [0, 2 pi], to 1e-5 (Abramowitz and Stegun 4.4.49).

    Written so that it becomes vector instructions; the check of Python's division would prevent that.
    """
    half_pi, pi, two_pi = np.float32(0.5 * math.pi), np.float32(math.pi), np.float32(2.0 * math.pi)
    zero, tiny = np.float32(0.0), np.float32(1e-30)
    c1, c3, c5 = np.float32(0.9998660), np.float32(-0.3302995), np.float32(0.1801410)
    c7, c9 = np.float32(-0.0851330), np.float32(0.0208351)
    for n in range(num):
        x, y = gx[n], gy[n]
        ax, ay = abs(x), abs(y)
        is_steep = ay > ax
        less, more = ax if is_steep else ay, ay if is_steep else ax
        a = less / (more + tiny)
        s = a * a
        t = a * (c1 + s * (c3 + s * (c5 + s * (c7 + s * c9))))
        t = half_pi - t if is_steep else t
        t = pi - t if x < zero else t
        t = two_pi - t if y < zero else t
        gx[n] = np.sqrt(x * x + y * y)
        gy[n] = t


@numba.njit(cache=True, nogil=True)
def _find_peaks(hist: NDArray[np.float64], max_num: int, out: NDArray[np.float64]) -> int:
    """Smooth the histogram in the first row and fill out with the angles of its highest peaks; returns how many."""
    num = _NUM_ORIENTATION_BINS
    for turn in range(6):
        source, target = hist[turn % 2], hist[(turn + 1) % 2]
        for b in range(num):
            target[b] = (source[b - 1] + source[b] + source[b + 1 if b + 1 < num else 0]) / 3.0
    smooth = hist[0]
    most = smooth[0]
    for b in range(1, num):
        most = max(most, smooth[b])
    limit = _PEAK_RATIO * most
    found = 0
    for _ in range(max_num):
        best, best_b = 0.0, -1
        for b in range(num):
            v = smooth[b]
            if v > best and v >= limit and v > smooth[b - 1] and v > smooth[b + 1 if b + 1 < num else 0]:
                taken = False
                for f in range(found):
                    taken |= hist[1, f] == b
                if not taken:
                    best, best_b = v, b
        if best_b < 0:
            break
        before, after = smooth[best_b - 1], smooth[best_b + 1 if best_b + 1 < num else 0]
        peak = best_b + 0.5 * (before - after) / (before + after - 2.0 * best)
        hist[1, found] = best_b
        out[found] = (peak * (2.0 * math.pi / num)) % (2.0 * math.pi)
        found += 1
    return found


@numba.njit(cache=True, nogil=True)
def _gradients(pixels: Pointer, at: int, width: int) -> tuple[Any, Any]:
    """Twice the gradients (x, y) at 16 pixels of a row, at a distance of STRIDE, from one on."""
    gx = subtract(load_every_second(pixels, at + 1), load_every_second(pixels, at - 1))
    return gx, subtract(load_every_second(pixels, at + width), load_every_second(pixels, at - width))


@numba.njit(cache=True, nogil=True)
def _spread(samples: Pointer, first: int, x: float, num: int, u: Any, v: Any) -> None:
    """Fill what columns add to u and v: a factor each for the distance from x; none of those behind them is near."""
    end = (num + WIDTH - 1) // WIDTH * WIDTH
    for j in range(end):
        dx = np.float32(first + STRIDE * j - x)
        samples[_COLUMN_U + j] = u * dx if j < num else _AWAY
        samples[_COLUMN_V + j] = v * dx if j < num else _AWAY


@numba.njit(cache=True, nogil=True)
def _sample_circle(level: Floats, x: float, y: float, radius: int, scale: Any, room: Floats) -> int:
    """Fill room with gradients, weighted by the table at so many squared pixels; returns how many."""
    height, width = level.shape
    pixels, samples = pointer(level), pointer(room)
    xi, yi = round(x), round(y)
    first, last = max(1, xi - radius), min(width - 1, xi + radius + 1)
    columns = max(0, (last - first + STRIDE - 1) // STRIDE)
    one = np.float32(1.0)
    _spread(samples, first, x, columns, one, one)
    factor, size = splat(scale), splat(np.float32(_EXP_SIZE))
    num: Any = np.int64(0)  # a literal would have _polar compiled twice
    for r in range(max(1, yi - radius), min(height - 1, yi + radius + 1), STRIDE):
        dy = np.float32(r - y)
        dy2 = splat(dy * dy)
        inside = np.int64(0)
        for j in range(0, columns, WIDTH):
            dx = load(samples, _COLUMN_U + j)
            near = multiply(add(multiply(dx, dx), dy2), factor)
            store(samples, _COLUMN_V + j, near)
            inside |= where_above(size, near) << j
        if inside == 0:
            continue
        # they lie side by side
        start, count = first_bit(np.uint64(inside)), np.int64(count_bits(np.uint64(inside)))
        for j in range(0, count, WIDTH):
            gx, gy = _gradients(pixels, r * width + first + STRIDE * (start + j), width)
            store(samples, _GX + num + j, gx)
            store(samples, _GY + num + j, gy)
        for j in range(count):
            weight = _EXP_TABLE[np.uint32(samples[_COLUMN_V + start + j])]
            samples[_GX + num + j] *= weight
            samples[_GY + num + j] *= weight
        num += count
    return int(num)


@numba.njit(cache=True, nogil=True)
def find_orientations(
    level: Floats, x: float, y: float, sigma: float, max_num: int, room: Floats, hist: NDArray[np.float64],
    out: NDArray[np.float64],
) -> int:  # fmt: skip
    """Peaks of the histogram of gradient directions around a keypoint, strongest first.

    Args:
        level: (H, W) float32, the level of the scale space that the keypoint was found in, with at least SLACK floats
            behind the last row, which are read and do not matter.
        x, y, sigma: of the keypoint, pixels.
        room: (ROOM,) float32 and hist: (2, 36) float64, working memory.
        out: (max_num,) float64, filled with angles in radians in [0, 2 pi), from x towards y.

    Returns:
        Number of angles, at most max_num.
    """
    num = _NUM_ORIENTATION_BINS
    window = 1.5 * sigma
    scale = np.float32(_EXP_SIZE / (_EXP_MAX * 2.0 * window * window))
    num_samples = _sample_circle(level, x, y, int(3.0 * window), scale, room)
    length, direction = room[_GX:], room[_GY:]
    _polar(length, direction, num_samples)
    hist[:] = 0.0
    for n in range(num_samples):
        position = direction[n] * (num / (2.0 * math.pi))
        b = int(position)
        part = length[n] * (position - b)
        hist[0, b if b < num else b - num] += length[n] - part
        hist[0, b + 1 if b + 1 < num else 0] += part
    return _find_peaks(hist, max_num, out)


@numba.njit(cache=True, nogil=True)
def _sample_cells(level: Floats, x: float, y: float, sigma: float, angle: float, room: Floats) -> int:
    """Fill room with places in cells from the corner of the 6 x 6 (u, v) and gradients (x, y), weighted by a Gaussian
    with a sigma of two cells; returns how many."""
    height, width = level.shape
    pixels, samples = pointer(level), pointer(room)
    cell = _CELL_SIGMAS * sigma
    cos, sin = np.float32(math.cos(angle) / cell), np.float32(math.sin(angle) / cell)
    reach = int(2.5 * cell * (abs(math.cos(angle)) + abs(math.sin(angle)))) + 1
    xi, yi = round(x), round(y)
    first, last = max(1, xi - reach), min(width - 1, xi + reach + 1)
    columns = max(0, (last - first + STRIDE - 1) // STRIDE)
    _spread(samples, first, x, columns, cos, sin)
    half, minus_half = splat(np.float32(2.5)), splat(np.float32(-2.5))
    num = 0
    for r in range(max(1, yi - reach), min(height - 1, yi + reach + 1), STRIDE):
        dy = np.float32(r - y)
        row_u, row_v = splat(sin * dy), splat(cos * dy)
        inside = np.int64(0)
        for j in range(0, columns, WIDTH):
            u, v = add(load(samples, _COLUMN_U + j), row_u), subtract(row_v, load(samples, _COLUMN_V + j))
            near = where_above(half, u) & where_above(u, minus_half)
            inside |= (near & where_above(half, v) & where_above(v, minus_half)) << j
        if inside == 0:
            continue
        # they lie side by side
        start, count = first_bit(np.uint64(inside)), int(count_bits(np.uint64(inside)))
        for j in range(0, count, WIDTH):
            at = start + j
            u, v = add(load(samples, _COLUMN_U + at), row_u), subtract(row_v, load(samples, _COLUMN_V + at))
            gx, gy = _gradients(pixels, r * width + first + STRIDE * at, width)
            weight = _gaussian(multiply(splat(np.float32(1.0 / 32.0)), fma(u, u, multiply(v, v))))
            store(samples, _U + num + j, add(u, half))
            store(samples, _V + num + j, add(v, half))
            store(samples, _GX + num + j, multiply(weight, gx))
            store(samples, _GY + num + j, multiply(weight, gy))
        num += count
    return num


@numba.njit(cache=True, nogil=True)
def _gaussian(quarter: Any) -> Any:
    """exp(-4 q) of rows of numbers in [0, 0.4], to 2e-5: the fourth power of five terms of the series."""
    value = fma(quarter, splat(np.float32(-1.0 / 120.0)), splat(np.float32(1.0 / 24.0)))
    value = fma(quarter, value, splat(np.float32(-1.0 / 6.0)))
    value = fma(quarter, value, splat(np.float32(0.5)))
    value = fma(quarter, value, splat(np.float32(-1.0)))
    value = fma(quarter, value, splat(np.float32(1.0)))
    value = multiply(value, value)
    return multiply(value, value)


@numba.njit(cache=True, nogil=True)
def _share_out(samples: Pointer, start: Any, num: int) -> None:
    """Replace places by how far they are from the left of their square and gradients (length, direction) by what the
    upper and the lower cells get, and fill in square, direction (places of their vectors) and what the next gets."""
    to_eighths = np.float32(8.0 / (2.0 * math.pi))
    for n in range(num):
        u, v, weight = samples[_U + n], samples[_V + n], samples[_GX + n]
        turn = start - samples[_GY + n] * to_eighths
        # what is less than five before it is rounded may be five afterwards
        iu, iv, it = min(np.int32(u), np.int32(4)), min(np.int32(v), np.int32(4)), np.int32(turn)
        below = weight * (v - np.float32(iv))
        samples[_U + n] = u - np.float32(iu)
        samples[_V + n] = turn - np.float32(it)
        samples[_GX + n] = weight - below
        samples[_GY + n] = below
        samples[_SQUARE + n] = np.float32((np.int32(5) * iv + iu) * np.int32(_PER_SQUARE))
        samples[_DIRECTION + n] = np.float32((it & np.int32(7)) * np.int32(WIDTH))


@numba.njit(cache=True, nogil=True)
def _fill_histogram(samples: Pointer, num: int) -> None:
    """Enter what :func:`_share_out` has made of the samples."""
    one_hot, to_next = pointer(_ONE_HOT), pointer(_TO_NEXT)
    left, to_right = load(pointer(_LEFT), 0), load(pointer(_TO_RIGHT), 0)
    zero = splat(np.float32(0.0))
    for n in range(0, 25 * _PER_SQUARE, WIDTH):
        store(samples, _HISTOGRAM + n, zero)
    for n in range(num):
        direction, above = int(samples[_DIRECTION + n]), _HISTOGRAM + int(samples[_SQUARE + n])
        share = fma(splat(samples[_V + n]), load(to_next, direction), load(one_hot, direction))
        share = multiply(share, fma(splat(samples[_U + n]), to_right, left))
        store(samples, above, fma(share, splat(samples[_GX + n]), load(samples, above)))
        below = above + WIDTH
        store(samples, below, fma(share, splat(samples[_GY + n]), load(samples, below)))


@numba.njit(cache=True, nogil=True)
def _join_squares(samples: Pointer) -> None:
    """Fill the 4 x 4 cells inside, each a corner of four squares."""
    to = _CELLS
    for i in range(1, 5):
        for j in range(1, 5):
            # upper left corner of its own square, upper right of that to the left, and so on
            here = _HISTOGRAM + (5 * i + j) * _PER_SQUARE
            above = here - 5 * _PER_SQUARE + WIDTH
            for k in range(8):
                upper = samples[here + k] + samples[here - _PER_SQUARE + 8 + k]
                samples[to + k] = upper + (samples[above + k] + samples[above - _PER_SQUARE + 8 + k])
            to += 8


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _root(samples: Pointer, out: NDArray[np.uint8]) -> None:
    """RootSIFT of the histogram, times 512; no single gradient may dominate (Lowe, section 6.1)."""
    square = splat(np.float32(0.0))
    for n in range(_CELLS, _CELLS + 128, WIDTH):
        value = load(samples, n)
        square = fma(value, value, square)
    limit = splat(np.float32(0.2) * np.sqrt(total(square)))
    length = splat(np.float32(0.0))
    for n in range(_CELLS, _CELLS + 128, WIDTH):
        value = smaller(load(samples, n), limit)
        store(samples, n, value)
        length = add(length, value)
    scale = np.float32(512.0 * 512.0) / (total(length) + np.float32(1e-30))
    to = pointer(out)
    for n in range(128):
        to[n] = np.uint8(min(np.sqrt(samples[_CELLS + n] * scale) + np.float32(0.5), np.float32(255.0)))


@numba.njit(cache=True, nogil=True)
def describe(
    level: Floats, x: float, y: float, sigma: float, angle: float, room: Floats, out: NDArray[np.uint8]
) -> None:  # fmt: skip
    """RootSIFT descriptor: 4 x 4 cells of 8 directions, in the order of COLMAP's.

    Args:
        level: (H, W) float32, the level of the scale space that the keypoint was found in, with at least SLACK floats
            behind the last row, which are read and do not matter.
        x, y, sigma: of the keypoint, pixels; angle: radians, from x towards y.
        room: (ROOM,) float32, working memory.
        out: (128,) uint8, filled.
    """
    num = _sample_cells(level, x, y, sigma, angle, room)
    _polar(room[_GX:], room[_GY:], num)
    samples = pointer(room)
    _share_out(samples, np.float32(angle * 8.0 / (2.0 * math.pi) + 8.0), num)
    _fill_histogram(samples, num)
    _join_squares(samples)
    _root(samples, out)


@numba.njit(cache=True, nogil=True)
def orient_all(
    levels: tuple[Floats, ...], top: int, found: NDArray[np.float64], max_num: int, angles: NDArray[np.float64]
) -> None:
    """Orientations of the keypoints of an octave.

    Args:
        levels: levels 1 to 3 of the octave.
        top: row of the octave that they begin with; even, so that halves are rounded as in the whole octave.
        found: (N, >= 3) float64 column, row, layer.
        angles: (N, max_num) float64, filled, strongest first; NaN where there are fewer.
    """
    hist = np.empty((2, _NUM_ORIENTATION_BINS))
    room = np.empty(ROOM, np.float32)
    angles[:] = np.nan
    for n in range(found.shape[0]):
        layer = min(max(round(found[n, 2]), 1), NUM_LAYERS)
        sigma = SIGMA * 2.0 ** (found[n, 2] / NUM_LAYERS)
        x, y = found[n, 0], found[n, 1] - top
        find_orientations(levels[layer - 1], x, y, sigma, max_num, room, hist, angles[n])


@numba.njit(cache=True, nogil=True)
def describe_all(
    levels: tuple[Floats, ...], top: int, found: NDArray[np.float64], angle: NDArray[np.float64],
    out: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Descriptors of the keypoints of an octave.

    Args:
        levels, top: as in :func:`orient_all`.
        found: (N, >= 3) float64 column, row, layer; angle: (N,) radians.
        out: (N, 128) uint8, filled.
    """
    room = np.empty(ROOM, np.float32)
    for n in range(found.shape[0]):
        layer = min(max(round(found[n, 2]), 1), NUM_LAYERS)
        sigma = SIGMA * 2.0 ** (found[n, 2] / NUM_LAYERS)
        describe(levels[layer - 1], found[n, 0], found[n, 1] - top, sigma, angle[n], room, out[n])
