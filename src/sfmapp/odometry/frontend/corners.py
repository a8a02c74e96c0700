"""Corners to track: Shi and Tomasi's score (CVPR 1994), spread over the image, and none where noise alone makes them.

The score of a pixel is the smaller eigenvalue of the sums, over 7 x 7 pixels, of products of differences I(+1) - I(-1).
The sums are whole numbers, exact in any order, so rows enter and leave them as the pass moves down the image.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.odometry.frontend.pyramid import Bytes, Pyramid, build_pyramid

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Ints = NDArray[np.int32]
Longs = NDArray[np.int64]

_HALF = 3  # of the window of sums
_WINDOW = 2 * _HALF + 1
# patches of 15 pixels need 7.5 on each side, their gradients one more; a corner is within half a pixel of its maximum
_BORDER = 9
# a corner has to be located to this by its 7 x 7 pixels, given the noise of the sensor
_MAX_SIGMA_PX = 0.2
# the score this takes, by the square of the noise in grey levels: what noise alone makes, and more; a difference of two
# pixels has the variance 2 noise^2 and is twice the gradient
_FLOOR = 2.0 * _WINDOW**2 + 4.0 * 2.0 / _MAX_SIGMA_PX**2
# Noise grows with the light, so it is judged for each range of grey, in two ways, of which the lower counts. The lowest
# tenth of the scores are taken for plain surfaces, and noise peaks at four times that, or six to ten where compression
# has correlated it. Even texture without plain surfaces is told from noise by its second differences in both
# directions: it is smooth, and noise is rough, though compression takes away up to two thirds of their variance.
_ABOVE_PLAIN, _ABOVE_ROUGH = 6.0, 3.0
# grey levels between which plain surfaces are believed: rounding alone makes 0.3, and what varies by more is texture
_MIN_NOISE, _MAX_NOISE = 0.6, 3.0
_SAMPLED = 4  # of so many rows and columns one enters the histogram
_MIN_SAMPLES = 100
# of the strongest corner of a cell: what is weaker beside it is as likely its own blur or ringing
_WEAKEST_IN_CELL = 0.02


@numba.njit(cache=True, nogil=True)
def _count_scores(scores: Floats, grey: Bytes, counts: Longs, num: int) -> None:
    """Histogram of a row's scores, a quarter of an octave to a bin, for each of 16 ranges of grey."""
    bits = scores.view(np.int32)
    for k in range(0, num, _SAMPLED):
        octave = (bits[k] >> 21) - (127 << 2)
        counts[grey[k] >> 4, min(max(octave, 0), counts.shape[1] - 1)] += 1


@numba.njit(cache=True, nogil=True)
def _count_roughness(data: Bytes, layout: Longs, counts: Longs) -> None:
    """Histogram, for each of 16 ranges of grey, of second differences in both directions (Immerkaer, 1996)."""
    start, step, height, width = layout
    for r in range(1, height - 1, _SAMPLED):
        for p in range(start + r * step + 1, start + r * step + width - 1, _SAMPLED):
            edges = int(data[p - step]) + int(data[p + step]) + int(data[p - 1]) + int(data[p + 1])
            corners = int(data[p - step - 1]) + int(data[p - step + 1]) + int(data[p + step - 1])
            value = abs(corners + int(data[p + step + 1]) - 2 * edges + 4 * int(data[p]))
            counts[data[p] >> 4, min(value, counts.shape[1] - 1)] += 1


def _quantile_bins(counts: Longs, share: float) -> Doubles:
    """(16,) bins, with fractions, below which a share of each histogram lies."""
    total, below = counts.sum(axis=1), np.cumsum(counts, axis=1)
    k = (below >= share * total[:, None]).argmax(axis=1)
    rows = np.arange(len(counts))
    place: Doubles = k + (share * total - below[rows, k] + counts[rows, k]) / np.maximum(counts[rows, k], 1)
    return place


def _floors(scores: Longs, roughness: Longs) -> Floats:
    """(16,) least score of a corner for each range of grey, from the histograms."""
    plain = 2.0 ** (0.25 * _quantile_bins(scores, 0.1))
    # whole numbers are the middles of their bins; of noise of 1 the differences have a standard deviation of 6
    noise = np.maximum(_quantile_bins(roughness, 0.5) - 0.5, 0.0) / (0.6745 * 6.0)
    floors = np.minimum(_ABOVE_PLAIN * plain, _ABOVE_ROUGH * _FLOOR * noise**2)
    floors[np.minimum(scores.sum(axis=1), roughness.sum(axis=1)) < _MIN_SAMPLES] = 0.0
    return np.clip(floors, _FLOOR * _MIN_NOISE**2, _FLOOR * _MAX_NOISE**2).astype(np.float32)


@numba.njit(cache=True, nogil=True)
def _products(up: Bytes, line: Bytes, down: Bytes, out: Ints, num: int) -> None:
    """Products of differences at columns 1..num of a row."""
    for c in range(num):
        gx = np.int32(line[c + 2]) - np.int32(line[c])
        gy = np.int32(down[c + 1]) - np.int32(up[c + 1])
        out[0, c] = gx * gx
        out[1, c] = gx * gy
        out[2, c] = gy * gy


@numba.njit(cache=True, nogil=True)
def _add_line(sums: Ints, line: Ints, num: int) -> None:
    for c in range(num):
        sums[c] += line[c] + line[c + 1] + line[c + 2] + line[c + 3] + line[c + 4] + line[c + 5] + line[c + 6]


@numba.njit(cache=True, nogil=True)
def _take_line(sums: Ints, line: Ints, num: int) -> None:
    for c in range(num):
        sums[c] -= line[c] + line[c + 1] + line[c + 2] + line[c + 3] + line[c + 4] + line[c + 5] + line[c + 6]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _scores(sums: Ints, out: Floats, num: int) -> None:
    a, b, c = sums[0], sums[1], sums[2]
    half = np.float32(0.5)
    for k in range(num):
        xx, xy, yy = np.float32(a[k]), np.float32(b[k]), np.float32(c[k])
        s = half * (xx - yy)
        out[k] = half * (xx + yy) - np.sqrt(s * s + xy * xy)


@numba.njit(cache=True, nogil=True)
def _flag(up: Floats, line: Floats, down: Floats, floor: np.float32, flags: Bytes, num: int) -> None:
    """Pixels that nothing in the 3 x 3 about them exceeds; of equals the last counts."""
    for k in range(num):
        v = line[k + 1]
        flags[k] = (
            (v > floor) & (v >= up[k]) & (v >= up[k + 1]) & (v >= up[k + 2]) & (v >= line[k])
            & (v > line[k + 2]) & (v > down[k]) & (v > down[k + 1]) & (v > down[k + 2])
        )  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _refine(up: Floats, line: Floats, down: Floats, k: int, out: Doubles) -> None:
    """Summit of the quadratic through the 3 x 3 scores about k, by least squares, relative to it."""
    a, b, c = float(up[k - 1]), float(up[k]), float(up[k + 1])
    d, e, f = float(line[k - 1]), float(line[k]), float(line[k + 1])
    g, h, i = float(down[k - 1]), float(down[k]), float(down[k + 1])
    gx, gy = (c + f + i - a - d - g) / 6.0, (g + h + i - a - b - c) / 6.0
    hxx = (a + c + d + f + g + i - 2.0 * (b + e + h)) / 3.0
    hyy = (a + b + c + g + h + i - 2.0 * (d + e + f)) / 3.0
    hxy = (a + i - c - g) / 4.0
    determinant = hxx * hyy - hxy * hxy
    out[0], out[1] = 0.0, 0.0
    if hxx < 0.0 and determinant > 0.0:
        out[0] = min(max((hxy * gy - hyy * gx) / determinant, -0.5), 0.5)
        out[1] = min(max((hxy * gx - hxx * gy) / determinant, -0.5), 0.5)


@numba.njit(cache=True, nogil=True)
def _find_maxima(
    data: Bytes, layout: Longs, floor: float, counts: Longs, xy: Doubles, value: Floats, grey: Bytes
) -> int:
    """Local maxima of the score above a floor: places, scores, greys and how many; those beyond the arrays are dropped.

    counts (16, B) gets the histogram of scores.
    """
    start, step, height, width = layout
    num = width - 2 * _BORDER + 2  # columns with a score: one more on each side than may hold a corner
    wide = num + _WINDOW - 1
    ring = np.zeros((_WINDOW, 3, wide), np.int32)
    sums = np.zeros((3, num), np.int32)
    scores = np.zeros((3, num), np.float32)
    flags = np.zeros(-(-num // 8) * 8, np.uint8)
    eights = flags.view(np.uint64)
    shift = np.empty(2)
    count = 0
    first = _BORDER - 1 - _HALF
    for r in range(first, height - first):
        slot = ring[r % _WINDOW]
        if r >= first + _WINDOW:
            for k in range(3):
                _take_line(sums[k], slot[k], num)
        place = start + r * step + first - 1
        _products(data[place - step :], data[place:], data[place + step :], slot, wide)
        for k in range(3):
            _add_line(sums[k], slot[k], num)
        if r < first + _WINDOW - 1:
            continue
        _scores(sums, scores[r % 3], num)
        if r % _SAMPLED == 0:
            _count_scores(scores[r % 3], data[start + (r - _HALF) * step + _BORDER - 1 :], counts, num)
        if r < first + _WINDOW + 1:
            continue
        up, line, down = scores[(r - 2) % 3], scores[(r - 1) % 3], scores[r % 3]
        _flag(up, line, down, np.float32(floor), flags, num - 2)
        for eight in range(eights.shape[0]):
            if eights[eight] == 0:
                continue
            for c in range(8 * eight, 8 * eight + 8):
                if flags[c] and count < value.shape[0]:
                    _refine(up, line, down, c + 1, shift)
                    xy[count, 0], xy[count, 1] = c + _BORDER + 0.5 + shift[0], r - _HALF - 1 + 0.5 + shift[1]
                    value[count] = line[c + 1]
                    grey[count] = data[start + (r - _HALF - 1) * step + c + _BORDER]
                    count += 1
    return count


@numba.njit(cache=True, nogil=True)
def _is_free(xy: Doubles, x: float, y: float, heads: Longs, after: Longs, bucket: float, radius: float) -> bool:
    """Whether no point in the buckets is within a radius, which is at most a bucket's side."""
    rows, cols = heads.shape
    row, col = int(y / bucket), int(x / bucket)
    for r in range(max(row - 1, 0), min(row + 2, rows)):
        for c in range(max(col - 1, 0), min(col + 2, cols)):
            k = heads[r, c]
            while k >= 0:
                dx, dy = xy[k, 0] - x, xy[k, 1] - y
                if dx * dx + dy * dy < radius * radius:
                    return False
                k = after[k]
    return True


@numba.njit(cache=True, nogil=True)
def _rank(
    xy: Doubles, value: Floats, order: Longs, num_occupied: int, radius: float, heads: Longs, after: Longs,
    bucket: float, cell: float, held: Longs, best: Floats, rank: Longs,
) -> None:  # fmt: skip
    """For each point its place in the queue of its cell, behind the tracks there and stronger corners; -1 if too near.

    Args:
        xy: (N, 2) tracks, then corners.
        order: corners from strong to weak.
    """
    for i in range(num_occupied):
        heads_row, heads_col = int(xy[i, 1] / bucket), int(xy[i, 0] / bucket)
        after[i] = heads[heads_row, heads_col]
        heads[heads_row, heads_col] = i
        held[int(xy[i, 1] / cell), int(xy[i, 0] / cell)] += 1
    for k in range(order.shape[0]):
        i = order[k]
        x, y = xy[i, 0], xy[i, 1]
        row, col = int(y / cell), int(x / cell)
        best[row, col] = max(best[row, col], value[i])
        if value[i] < _WEAKEST_IN_CELL * best[row, col] or not _is_free(xy, x, y, heads, after, bucket, radius):
            rank[i] = -1
            continue
        heads_row, heads_col = int(y / bucket), int(x / bucket)
        after[i] = heads[heads_row, heads_col]
        heads[heads_row, heads_col] = i
        rank[i] = held[row, col]
        held[row, col] += 1


def find_corners(
    image: Pyramid | Bytes, occupied_xy: Doubles, max_new: int, *, min_distance_px: float,
    mask: NDArray[np.bool_] | None = None,
) -> Doubles:  # fmt: skip
    """New corners, first where there are few tracks, the strongest first in each place.

    Args:
        image: (H, W) uint8 or its pyramid.
        occupied_xy: (M, 2) float64 pixels, the tracks that there are.
        max_new: most corners to return.
        min_distance_px: to tracks and between corners.
        mask: (H, W), true where corners may lie; None: anywhere.

    Returns:
        (K, 2) float64 pixels, in the order of need: any first part of them is the best choice of that many.
    """
    pyramid = image if isinstance(image, Pyramid) else build_pyramid(image, 1)
    height, width = pyramid.shape
    if max_new < 1 or min(height, width) < 2 * _BORDER + 3:
        return np.empty((0, 2))
    layout = pyramid.layout[0]
    capacity = height * width // 16
    places, value, grey = np.empty((capacity, 2)), np.empty(capacity, np.float32), np.empty(capacity, np.uint8)
    scores, roughness = np.zeros((16, 88), np.int64), np.zeros((16, 512), np.int64)
    _count_roughness(pyramid.data, layout, roughness)
    count = _find_maxima(pyramid.data, layout, _FLOOR * _MIN_NOISE**2, scores, places, value, grey)
    is_corner = value[:count] >= _floors(scores, roughness)[grey[:count] >> 4]
    places, value = places[:count][is_corner], value[:count][is_corner]
    if mask is not None:
        allowed = np.asarray(mask)[places[:, 1].astype(np.int64), places[:, 0].astype(np.int64)] != 0
        places, value = places[allowed], value[allowed]
    tracks = np.asarray(occupied_xy, np.float64).reshape(-1, 2)
    tracks = tracks[((tracks >= 0) & (tracks < (width, height))).all(axis=1)]
    return _select(places, value, tracks, max_new, min_distance_px, (height, width))


def _select(
    places: Doubles, value: Floats, tracks: Doubles, max_new: int, min_distance_px: float, shape: tuple[int, int]
) -> Doubles:
    height, width = shape
    num = len(tracks)
    xy = np.concatenate([tracks, places])
    value = np.concatenate([np.zeros(num, np.float32), value])
    # four of all that are wanted share a cell
    cell = max(2.0 * np.sqrt(height * width / (num + max_new)), 1.0)
    bucket = max(min_distance_px, 4.0)
    order = num + np.argsort(-value[num:], kind="stable")
    cells = (int(height / cell) + 1, int(width / cell) + 1)
    rank = np.full(len(xy), -1, np.int64)
    _rank(
        xy, value, order, num, min_distance_px, np.full((int(height / bucket) + 1, int(width / bucket) + 1), -1),
        np.full(len(xy), -1), bucket, cell, np.zeros(cells, np.int64), np.zeros(cells, np.float32), rank,
    )  # fmt: skip
    chosen = order[rank[order] >= 0]
    return np.ascontiguousarray(xy[chosen[np.argsort(rank[chosen], kind="stable")[:max_new]]])


def compile_kernels() -> None:
    """Compile, or load from the cache, what this module runs."""
    find_corners(np.zeros((40, 40), np.uint8), np.empty((0, 2)), 1, min_distance_px=5.0)
