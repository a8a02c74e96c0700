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
    at = find(np.stack([x.ravel(), y.ravel()], 1)).reshape(*x.shape, 2)
    along_x, along_y = _slopes(at, 1)[1:-1], _slopes(at, 0)[:, 1:-1]
    at = np.ascontiguousarray(at[1:-1, 1:-1])
    cover = _cover(at, along_x, along_y, (width, height))
    is_seen = cover > 0.0
    if not is_seen.any():
        return None
    reach = 0.5 * (np.abs(along_x) + np.abs(along_y))[is_seen] + 2.0
    low = np.clip(np.floor((at[is_seen] - reach).min(0)), 0, (width - 1, height - 1)).astype(int)
    high = np.clip(np.ceil((at[is_seen] + reach).max(0)), low + 1, (width, height)).astype(int)
    part = source[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    if part.shape[2] == 4:
        part[..., :3] *= part[..., 3:] / np.float32(np.iinfo(source.dtype).max)
    values = np.zeros((*cover.shape, part.shape[2]), np.float32)
    _average(np.ascontiguousarray(part), at - low, np.ascontiguousarray(along_x), np.ascontiguousarray(along_y),
             is_seen, values)  # fmt: skip
    return Tile(rows, columns, values, cover)


def _slopes(at: Array, axis: int) -> Array:
    """Derivatives along an axis, central, one-sided at the edge of what is seen; shorter by the rim along that axis."""
    at = np.moveaxis(at, axis, 0)
    ahead, behind = at[2:] - at[1:-1], at[1:-1] - at[:-2]
    slope = np.where(np.isnan(ahead), behind, np.where(np.isnan(behind), ahead, 0.5 * (ahead + behind)))
    return np.moveaxis(slope, 0, axis)


def _cover(at: Array, along_x: Array, along_y: Array, size: tuple[int, int]) -> Floats:
    """(h, w) share of each pixel inside the source: along each axis, by how far its sides are from the middle of the
    pixel, in pixels of the result."""
    cover = np.ones(at.shape[:2])
    for axis in (0, 1):
        width = np.maximum(np.hypot(along_x[..., axis], along_y[..., axis]), 1e-12)
        low, high = at[..., axis] / width, (size[axis] - at[..., axis]) / width
        cover *= np.clip(np.clip(low + 0.5, 0.0, 1.0) + np.clip(high + 0.5, 0.0, 1.0) - 1.0, 0.0, 1.0)
    return np.nan_to_num(cover).astype(np.float32)


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
