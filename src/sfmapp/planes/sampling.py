"""Pictures seen through any smooth map, without steps where they grow and without moire where they shrink.

A pixel is the mean of what it saw over its square. So the picture is taken for the cubic spline whose means over the
source's pixels are what the source says (a histospline: Schoenberg, "Splines and histograms", 1973; as a filter and
sums of B-splines, Unser, IEEE Signal Processing Magazine 1999), and a pixel of the result is the mean of that spline
over its footprint, the parallelogram that it covers in the source. One rule serves all sizes: where a picture keeps its
size, it is interpolation by quartic splines, and where it grows, it takes back what the source's pixels averaged.

Where it shrinks, pixels of the source are first put together in squares of 2, 4, 8 ..., which are means themselves.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Counts = NDArray[np.int64]
Region = tuple[int, int, int, int]
"""x0, y0, x1, y1 in pixels, the last two exclusive."""

_TILE = 256
# along a side of a footprint; a picture of 30,000 pixels on the last pixel before the horizon needs no more
_MOST_SAMPLES = 512
# A footprint is at least so many squares wide after pixels were put together in them
_LEAST_PIXELS = 2.0
# of a source pixel, which one sample is the mean of: weights are exact at zero and one, and less so beyond
_WIDEST_SAMPLE = 1.25
# The same squared, at least. Narrower ones make noise larger by a fifth where it is finest (1.6 times the source's, not
# 1.3), edges ring more, and the error less by 0.4 % at most (five pictures, grown to 2.4)
_LEAST_SQUARE = 0.5
# beyond the source's border, in pixels, after which nothing changes any more
_RIM = 6
# pixels to each side that the spline through means hangs on: 0.36^8 is the first weight that is left out
_REACH = 7


def _spline_filter() -> Floats:
    """(_REACH + 1,) from means over pixels to coefficients of cubic B-splines, from the middle to one side: the inverse
    of the quartic B-spline at whole numbers, [1, 76, 230, 76, 1] / 384."""
    angle = 2.0 * np.pi * np.arange(64) / 64.0
    weights = np.fft.ifft(384.0 / (230.0 + 152.0 * np.cos(angle) + 2.0 * np.cos(2.0 * angle))).real[: _REACH + 1]
    return np.asarray(weights / (weights[0] + 2.0 * weights[1:].sum()), np.float32)


_FILTER = _spline_filter()
# pixels whose weights are computed side by side
_STRIP = 64
# of one precision, so that they are
_NONE, _HALF, _ONE, _FOUR = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(4.0)
_SIXTH, _LAST = np.float32(1.0 / 6.0), np.float32(1.0 / 24.0)
_ODD, _EVEN = np.float32(11.0 / 24.0), (np.float32(19.0 / 96.0), np.float32(0.25))


@dataclass(frozen=True)
class Tile:
    """A part of a result.

    Attributes:
        rows, columns: where it lies.
        values: (h, w, C) of the source's own scale, where something is covered.
        cover: (h, w) from 0 to 1: the share of each pixel that the source covers.
    """

    rows: slice
    columns: slice
    values: Floats
    cover: Floats


def resampled(source: NDArray[Any], find: Callable[[Array], Array], region: Region) -> Iterator[Tile]:
    """What a map shows of a picture, tile by tile; tiles that it does not reach are left out.

    Args:
        source: (H, W, C), uint8 or uint16. With four channels the last is alpha, and ``values`` are multiplied by it.
        find: pixels (N, 2) of the result, a rectangle of them row by row, to those (N, 2) of the source; NaN for
            nowhere.
        region: of the result.
    """
    x0, y0, x1, y1 = region
    for top in range(y0, y1, _TILE):
        for left in range(x0, x1, _TILE):
            rows, columns = slice(top, min(top + _TILE, y1)), slice(left, min(left + _TILE, x1))
            tile = _tile(source, find, rows, columns)
            if tile is not None:
                yield tile


def _tile(source: NDArray[Any], find: Callable[[Array], Array], rows: slice, columns: slice) -> Tile | None:
    height, width, channels = source.shape
    # with a rim of one pixel, for the slopes
    y, x = np.mgrid[rows.start - 1 : rows.stop + 1, columns.start - 1 : columns.stop + 1] + 0.5
    found = find(np.stack([x.ravel(), y.ravel()], 1)).reshape(*x.shape, 2)
    cover = np.zeros((x.shape[0] - 2, x.shape[1] - 2), np.float32)
    reach = _look(found, width, height, cover)
    if not reach[0] < math.inf:
        return None
    side = 2 ** max(0, math.floor(math.log2(max(reach[4] / _LEAST_PIXELS, 1.0))))
    low, high = np.floor(reach[:2] / side).astype(int) - 3, np.ceil(reach[2:4] / side).astype(int) + 3
    ends = -(-np.array([width, height]) // side)
    low, high = np.clip(low, -_RIM, ends), np.clip(high, 0, ends + _RIM)
    means = np.empty((channels, high[1] - low[1] + 2 * _REACH, high[0] - low[0] + 2 * _REACH), np.float32)
    _put_together(source, low[0] - _REACH, low[1] - _REACH, side, float(np.iinfo(source.dtype).max), means)
    values = np.zeros((*cover.shape, channels), np.float32)
    _average(means, _coefficients(means), found, low.astype(np.float64), float(side), cover, values)
    if channels == 4:  # nothing is brighter than white of its own alpha
        np.clip(values[..., :3], 0.0, values[..., 3:], out=values[..., :3])
    return Tile(rows, columns, values, cover)


@numba.njit(cache=True, nogil=True, inline="always")
def _slope(behind: float, middle: float, ahead: float) -> float:
    """Central, one-sided at the edge of what is seen, NaN where nothing is."""
    if math.isnan(ahead):
        return middle - behind
    return ahead - middle if math.isnan(behind) else 0.5 * (ahead - behind)


@numba.njit(cache=True, nogil=True)
def _look(found: Array, width: int, height: int, cover: Floats) -> Array:
    """What share of each pixel a source covers, and what of the source is looked at.

    Args:
        found: (h + 2, w + 2, 2) with a rim of one pixel, NaN for nowhere.
        cover: (h, w) zeros; filled, along each axis, by how far the source's sides are from the middle of a pixel, in
            pixels of the result.

    Returns:
        Least x and y and greatest x and y of all footprints that the source covers, and the least width of them in
        their narrowest direction; the first infinite without any.
    """
    reach = np.array([np.inf, np.inf, -np.inf, -np.inf, np.inf])
    slope = np.empty((2, 2))
    for r in range(cover.shape[0]):
        for c in range(cover.shape[1]):
            share = 1.0
            for n in range(2):
                middle = found[r + 1, c + 1, n]
                slope[0, n] = _slope(found[r + 1, c, n], middle, found[r + 1, c + 2, n])
                slope[1, n] = _slope(found[r, c + 1, n], middle, found[r + 2, c + 1, n])
                room = min(middle, (width if n == 0 else height) - middle)
                if room >= 0.5 * (abs(slope[0, n]) + abs(slope[1, n])):  # by far the most, and NaN is not among them
                    continue
                if math.isnan(middle + slope[0, n] + slope[1, n]):
                    share = 0.0
                    continue
                pixel = max(math.hypot(slope[0, n], slope[1, n]), 1e-12)
                low, high = middle / pixel + 0.5, ((width if n == 0 else height) - middle) / pixel + 0.5
                share *= max(min(low, 1.0) + min(high, 1.0) - 1.0, 0.0)
            if share == 0.0:
                continue
            cover[r, c] = share
            for n in range(2):
                half = 0.5 * (abs(slope[0, n]) + abs(slope[1, n]))
                reach[n] = min(reach[n], found[r + 1, c + 1, n] - half)
                reach[2 + n] = max(reach[2 + n], found[r + 1, c + 1, n] + half)
            # the lesser singular value, squared
            total = slope[0, 0] ** 2 + slope[0, 1] ** 2 + slope[1, 0] ** 2 + slope[1, 1] ** 2
            area = slope[0, 0] * slope[1, 1] - slope[0, 1] * slope[1, 0]
            narrow = 0.5 * (total - math.sqrt(max(total * total - 4.0 * area * area, 0.0)))
            reach[4] = min(reach[4], narrow)
    reach[4] = math.sqrt(max(reach[4], 0.0))
    return reach


@numba.njit(cache=True, nogil=True)
def _put_together(source: NDArray[Any], left: int, top: int, side: int, full: float, out: Floats) -> None:
    """Means (C, h, w) over squares of so many source pixels, the first of which is the square (left, top); the source's
    border is carried on. The fourth channel, where full is opaque, multiplies the others."""
    height, width, channels = source.shape
    unit = np.float32(1.0 / (side * side))
    opaque = np.float32(unit / full)
    for r in range(out.shape[1]):
        for c in range(channels):
            out[c, r, :] = np.float32(0.0)
        for dy in range(side):
            line = source[min(max((top + r) * side + dy, 0), height - 1)]
            for column in range(out.shape[2]):
                for dx in range(side):
                    x = min(max((left + column) * side + dx, 0), width - 1)
                    weight = unit
                    if channels == 4:
                        out[3, r, column] += unit * np.float32(line[x, 3])
                        weight = opaque * np.float32(line[x, 3])
                    for c in range(min(channels, 3)):
                        out[c, r, column] += weight * np.float32(line[x, c])


@numba.njit(cache=True, nogil=True)
def _coefficients(means: Floats) -> Floats:
    """(C, h, w) of the cubic B-splines whose means over pixels these are, (C, h + 2 _REACH, w + 2 _REACH)."""
    channels, rows, columns = means.shape[0], means.shape[1] - 2 * _REACH, means.shape[2] - 2 * _REACH
    out, across = np.empty((channels, rows, columns), np.float32), np.empty(means.shape[2], np.float32)
    for channel in range(channels):
        for r in range(rows):
            for c in range(means.shape[2]):
                total = _FILTER[0] * means[channel, r + _REACH, c]
                for k in range(1, _REACH + 1):
                    above, below = means[channel, r + _REACH - k, c], means[channel, r + _REACH + k, c]
                    total += _FILTER[k] * (above + below)
                across[c] = total
            for c in range(columns):
                total = _FILTER[0] * across[c + _REACH]
                for k in range(1, _REACH + 1):
                    total += _FILTER[k] * (across[c + _REACH - k] + across[c + _REACH + k])
                out[channel, r, c] = total
    return out


@numba.njit(cache=True, nogil=True, inline="always")
def _square(a: float, b: float) -> float:
    """Of the length along an axis that varies as a parallelogram does, whose sides are a and b long along it."""
    return min(max(a * a + b * b, _LEAST_SQUARE), _WIDEST_SAMPLE * _WIDEST_SAMPLE)


@numba.njit(cache=True, nogil=True)
def _footprints(found: Array, cover: Floats, row: int, begin: int, side: float, feet: Array, counts: Counts) -> None:
    """Of a strip of pixels in a row, from column begin.

    Args:
        feet: (8, n) to fill: x and y where a pixel looks, sides of a sample of its footprint (ax, ay, bx, by), squares
            of how long that is along x and y; in squares of so many source pixels a side. Where cover is zero, anything
            finite.
        counts: (2, n) to fill: samples along both sides, zero where cover is.
    """
    unit, r = 1.0 / side, row + 1
    for n in range(counts.shape[1]):
        c = begin + n + 1
        counts[:, n] = 0
        feet[:, n] = 0.0
        if cover[row, begin + n] == 0.0:
            continue
        for k in range(2):
            middle = found[r, c, k]
            feet[k, n] = unit * middle
            feet[2 + k, n] = unit * _slope(found[r, c - 1, k], middle, found[r, c + 1, k])
            feet[4 + k, n] = unit * _slope(found[r - 1, c, k], middle, found[r + 1, c, k])
        for k in range(2):
            length = math.sqrt(feet[2 + 2 * k, n] ** 2 + feet[3 + 2 * k, n] ** 2)
            counts[k, n] = min(max(math.ceil(length / _WIDEST_SAMPLE), 1), _MOST_SAMPLES)
            feet[2 + 2 * k, n] /= counts[k, n]
            feet[3 + 2 * k, n] /= counts[k, n]
        feet[6, n] = _square(feet[2, n], feet[4, n])
        feet[7, n] = _square(feet[3, n], feet[5, n])


@numba.njit(cache=True, nogil=True)
def _weigh(places: Array, squares: Array, low: float, high: float, at: Counts, weights: Floats) -> None:
    """First of the five splines in a row that make the mean over a length about each place, and their weights.

    Between a length of zero, which is the cubic B-spline, and one, the quartic one, they are mixed: right to the second
    order.

    Args:
        places: (n,), the centre of the first spline being 0. squares: (n,) of the lengths. low, high: of places, beyond
            which nothing changes any more.
        at: (n,), weights: (5, n), to fill.
    """
    for n in range(at.size):
        place = min(max(places[n], low), high)
        whole = math.floor(place + 0.5)
        t, square = np.float32(place - whole), np.float32(squares[n])
        keep, t2 = _ONE - square, t * t
        ahead, behind = max(t, _NONE), max(-t, _NONE)
        ahead, behind = keep * ahead * ahead * ahead * _SIXTH, keep * behind * behind * behind * _SIXTH
        # B-splines at -2, -1 ... 2 less t (Unser): cubic, to the sides of the middle, and quartic
        left, right = _ONE - t, _ONE + t
        below, above = _HALF - t, _HALF + t
        odd, even = t * (_ODD - t2 * _SIXTH), _EVEN[0] + t2 * (_EVEN[1] - t2 * _SIXTH)
        below, above = below * below, above * above
        at[n] = np.int64(whole) - 2
        weights[0, n] = behind + square * below * below * _LAST
        weights[1, n] = keep * left * left * left * _SIXTH - _FOUR * behind + square * (even - odd)
        weights[3, n] = keep * right * right * right * _SIXTH - _FOUR * ahead + square * (even + odd)
        weights[4, n] = ahead + square * above * above * _LAST
        weights[2, n] = _ONE - weights[0, n] - weights[1, n] - weights[3, n] - weights[4, n]


@numba.njit(cache=True, nogil=True)
def _average(
    means: Floats, splines: Floats, found: Array, first: Array, side: float, cover: Floats, out: Floats
) -> None:  # fmt: skip
    """Means over the footprints of pixels: of samples, each the mean over a part of it that is no wider than a pixel.

    Args:
        means: (C, h' + 2 _REACH, w' + 2 _REACH) over squares of so many pixels a side. splines: (C, h', w') their
            coefficients, from the square first, (x, y).
        found: (h + 2, w + 2, 2) where pixels look, with a rim of one. cover: (h, w) zero where nothing is asked.
        out: (h, w, C) zeros, to fill.
    """
    feet, counts = np.empty((8, _STRIP)), np.empty((2, _STRIP), np.int64)
    places, at = np.empty((2, _STRIP)), np.empty((2, _STRIP), np.int64)
    weights = np.empty((2, 5, _STRIP), np.float32)
    for row in range(cover.shape[0]):
        for begin in range(0, cover.shape[1], _STRIP):
            size = min(_STRIP, cover.shape[1] - begin)
            _footprints(found, cover, row, begin, side, feet[:, :size], counts[:, :size])
            for m in range(counts[1, :size].max()):
                for k in range(counts[0, :size].max()):
                    for axis in range(2):
                        for n in range(size):
                            a, b = k - 0.5 * (counts[0, n] - 1), m - 0.5 * (counts[1, n] - 1)
                            shift = a * feet[2 + axis, n] + b * feet[4 + axis, n]
                            places[axis, n] = feet[axis, n] + shift - first[axis] - 0.5
                        high = splines.shape[2 - axis] - 3.0
                        _weigh(places[axis, :size], feet[6 + axis, :size], 2.0, high, at[axis, :size], weights[axis])
                    for n in range(size):
                        if k < counts[0, n] and m < counts[1, n]:
                            share = np.float32(1.0 / (counts[0, n] * counts[1, n]))
                            _add(means, splines, at[:, n], weights[:, :, n], share, out[row, begin + n])


@numba.njit(cache=True, nogil=True, inline="always")
def _add(
    means: Floats, splines: Floats, at: Counts, weights: Floats, share: np.float32, out: Floats
) -> None:  # fmt: skip
    """Add to (C,) a share of the sum of 5 x 5 splines from a place on; weights: (2, 5) along x and y. With alpha, it
    stays between the means nearby: what is cut out has no second outline beside its own."""
    x, y, step = np.uint64(at[0]), np.uint64(at[1]), np.uint64(_REACH + 1)
    for channel in range(splines.shape[0]):
        total = np.float32(0.0)
        for k in range(5):
            across = np.float32(0.0)
            for n in range(5):
                across += weights[0, n] * splines[channel, y + np.uint64(k), x + np.uint64(n)]
            total += weights[1, k] * across
        if splines.shape[0] == 4:
            least = most = means[channel, y + step, x + step]
            for k in range(3):
                for n in range(3):
                    value = means[channel, y + step + np.uint64(k), x + step + np.uint64(n)]
                    least, most = min(least, value), max(most, value)
            total = min(max(total, least), most)
        out[channel] += share * total
