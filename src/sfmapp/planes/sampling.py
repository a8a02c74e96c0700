"""Pictures seen through any smooth map, without steps where they grow and without moire where they shrink.

A pixel of the result is the mean over its footprint: the parallelogram that it covers in the source. The source's own
pixels are as wide as one already, so that the footprint is taken narrower by that, in squares: nothing is blurred where
the picture keeps its size, and the change from growing to shrinking is nowhere to be seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.simd.cubic import cubic_weights

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Region = tuple[int, int, int, int]
"""x0, y0, x1, y1 in pixels, the last two exclusive."""

_TILE = 256
# along a side of a footprint; a picture of 30,000 pixels on the last pixel before the horizon needs no more
_MOST_SAMPLES = 512


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
        find: pixels (N, 2) of the result to those (N, 2) of the source; NaN for nowhere.
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
    height, width = source.shape[:2]
    # with a rim of one pixel, for the slopes
    y, x = np.mgrid[rows.start - 1 : rows.stop + 1, columns.start - 1 : columns.stop + 1] + 0.5
    found = find(np.stack([x.ravel(), y.ravel()], 1)).reshape(*x.shape, 2)
    at, along_x, along_y = (np.empty((x.shape[0] - 2, x.shape[1] - 2, 2)) for _ in range(3))
    cover = np.zeros(at.shape[:2], np.float32)
    reach = _look(found, width, height, at, along_x, along_y, cover)
    is_seen = cover > 0.0
    if not reach[0] < math.inf:
        return None
    low = np.clip(np.floor(reach[:2]) - 2.0, 0, (width - 1, height - 1)).astype(int)
    high = np.clip(np.ceil(reach[2:]) + 2.0, low + 1, (width, height)).astype(int)
    part = source[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    if part.shape[2] == 4:
        part[..., :3] *= part[..., 3:] / np.float32(np.iinfo(source.dtype).max)
    values = np.zeros((*cover.shape, part.shape[2]), np.float32)
    _average(np.ascontiguousarray(part), at - low, along_x, along_y, is_seen, values)
    return Tile(rows, columns, values, cover)


@numba.njit(cache=True, nogil=True)
def _look(
    found: Array, width: int, height: int, at: Array, along_x: Array, along_y: Array, cover: Floats
) -> Array:  # fmt: skip
    """Where pixels look in a source, how that changes from pixel to pixel, and what share of each the source covers.

    Args:
        found: (h + 2, w + 2, 2) with a rim of one pixel, NaN for nowhere.
        at, along_x, along_y: (h, w, 2) to fill: slopes are central, one-sided at the edge of what is seen.
        cover: (h, w) zeros; filled, along each axis, by how far the source's sides are from the middle of a pixel, in
            pixels of the result.

    Returns:
        Least x and y and greatest x and y of all footprints that the source covers; the first infinite without any.
    """
    reach = np.array([np.inf, np.inf, -np.inf, -np.inf])
    slope = np.empty((2, 2))
    for r in range(at.shape[0]):
        for c in range(at.shape[1]):
            share = 1.0
            for n in range(2):
                middle = found[r + 1, c + 1, n]
                ahead, behind = found[r + 1, c + 2, n] - middle, middle - found[r + 1, c, n]
                below, above = found[r + 2, c + 1, n] - middle, middle - found[r, c + 1, n]
                slope[0, n] = behind if math.isnan(ahead) else ahead if math.isnan(behind) else 0.5 * (ahead + behind)
                slope[1, n] = above if math.isnan(below) else below if math.isnan(above) else 0.5 * (below + above)
                at[r, c, n], along_x[r, c, n], along_y[r, c, n] = middle, slope[0, n], slope[1, n]
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
                reach[n] = min(reach[n], at[r, c, n] - half)
                reach[2 + n] = max(reach[2 + n], at[r, c, n] + half)
    return reach


@numba.njit(cache=True, nogil=True)
def _width_and_samples(slope_x: float, slope_y: float) -> tuple[float, int]:
    """Of a side of a footprint: its share that is averaged over, and in how many samples, a source pixel apart."""
    length = math.hypot(slope_x, slope_y)
    if not length > 1.0:
        return 0.0, 1
    share = math.sqrt(1.0 - 1.0 / (length * length))
    return share, min(max(math.ceil(length * share), 1), _MOST_SAMPLES)


@numba.njit(cache=True, nogil=True)
def _average(
    source: Floats, at: Array, along_x: Array, along_y: Array, is_seen: NDArray[np.bool_], out: Floats
) -> None:
    """Means (h, w, C) over the footprints of pixels, of cubic interpolation; the source's border is carried on."""
    for row in range(at.shape[0]):
        for column in range(at.shape[1]):
            if not is_seen[row, column]:
                continue
            ax, ay = along_x[row, column, 0], along_x[row, column, 1]
            bx, by = along_y[row, column, 0], along_y[row, column, 1]
            wide, num_a = _width_and_samples(ax, ay)
            high, num_b = _width_and_samples(bx, by)
            unit = 1.0 / (num_a * num_b)
            for m in range(num_b):
                b = high * ((m + 0.5) / num_b - 0.5)
                for n in range(num_a):
                    a = wide * ((n + 0.5) / num_a - 0.5)
                    x = at[row, column, 0] + a * ax + b * bx - 0.5
                    y = at[row, column, 1] + a * ay + b * by - 0.5
                    _add(source, x, y, unit, out[row, column])


@numba.njit(cache=True, nogil=True, inline="always")
def _add(source: Floats, x: float, y: float, unit: float, out: Floats) -> None:
    """Add to (C,) the colour at a place, the centre of the first pixel being (0, 0)."""
    height, width, channels = source.shape
    # beyond the border, nothing changes any more
    x, y = min(max(x, -1.0), width + 0.0), min(max(y, -1.0), height + 0.0)
    i, j = math.floor(x), math.floor(y)
    w0, w1, w2, w3 = cubic_weights(x - i)
    rows = cubic_weights(y - j)
    u0, u1 = min(max(i - 1, 0), width - 1), min(max(i, 0), width - 1)
    u2, u3 = min(max(i + 1, 0), width - 1), min(max(i + 2, 0), width - 1)
    for p in range(4):
        line, weight = source[min(max(j + p - 1, 0), height - 1)], rows[p] * unit
        for c in range(channels):
            out[c] += weight * (w0 * line[u0, c] + w1 * line[u1, c] + w2 * line[u2, c] + w3 * line[u3, c])
