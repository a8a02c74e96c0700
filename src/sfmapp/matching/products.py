"""The two largest dot products of every descriptor of one image with those of another.

SIFT descriptors are whole numbers, so their products are exact: the same on every machine and in every order of
summation. They come in small tiles, which stay in registers and the first cache: the matrix of all products is never
written to memory.
"""

from __future__ import annotations

import threading
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.simd.i16x32 import DIMS, GROUPS, LANES, ROWS, tile

Ints = NDArray[np.int32]

_GROUPS_IN_CACHE = 16  # 256 descriptors of image 2, 64 kB, stay in the cache while image 1 passes by


class Best(NamedTuple):
    """The two largest products of each descriptor of an image (N) so far.

    Attributes:
        first, second: (N,) int32.
        partner: (N,) int32 position of the first, -1 where there is none.
    """

    first: Ints
    second: Ints
    partner: Ints

    @staticmethod
    def of_none(num: int) -> Best:
        return Best(*(np.full(num, fill, np.int32) for fill in (0, 0, -1)))


class TileRoom(NamedTuple):
    """What a tile writes to: sums (ROWS, GROUPS * LANES) int32, masks (ROWS,) uint32."""

    sums: Ints
    masks: NDArray[np.uint32]

    @staticmethod
    def make() -> TileRoom:
        return TileRoom(np.empty((ROWS, GROUPS * LANES), np.int32), np.empty(ROWS, np.uint32))


@numba.njit(cache=True, nogil=True)
def _scan(a: NDArray[np.int16], packed: NDArray[np.int16], rows: Best, columns: Best, room: TileRoom) -> None:
    best1, second1, arg1 = rows
    best2, second2, arg2 = columns
    sums, masks = room
    for block in range(0, packed.shape[0], _GROUPS_IN_CACHE):
        for row in range(0, a.shape[0], ROWS):
            for group in range(block, min(block + _GROUPS_IN_CACHE, packed.shape[0]), GROUPS):
                tile(a, packed, sums, masks, second1, second2, row, group)
                for r in range(ROWS):
                    if masks[r] != 0:
                        for q in range(GROUPS * LANES):
                            if (masks[r] >> np.uint32(q)) & np.uint32(1):
                                i, j = row + r, group * LANES + q
                                keep_two_largest(best1, second1, arg1, i, j, sums[r, q])
                                keep_two_largest(best2, second2, arg2, j, i, sums[r, q])


@numba.njit(cache=True, nogil=True, inline="always")
def keep_two_largest(best: Ints, second: Ints, arg: Ints, i: int, j: int, value: int) -> None:
    """Enter value, from partner j, into the two largest of i."""
    if value > best[i]:
        second[i] = best[i]
        best[i] = value
        arg[i] = j
    elif value > second[i]:
        second[i] = value


@numba.njit(cache=True, nogil=True)
def _fill_rows(descriptors: NDArray[np.uint8], order: NDArray[np.int64], out: NDArray[np.int16]) -> None:
    for i in range(len(order)):
        source, target = descriptors[order[i]], out[i]
        for k in range(DIMS):
            target[k] = source[k]
    for i in range(len(order), len(out)):
        target = out[i]
        for k in range(DIMS):
            target[k] = 0


@numba.njit(cache=True, nogil=True)
def _fill_groups(descriptors: NDArray[np.uint8], order: NDArray[np.int64], out: NDArray[np.int16]) -> None:
    for i in range(len(order)):
        source, target, lane = descriptors[order[i]], out[i // LANES], i % LANES
        for k in range(DIMS // 2):
            target[k, lane, 0], target[k, lane, 1] = source[2 * k], source[2 * k + 1]
    for i in range(len(order), out.shape[0] * LANES):
        target, lane = out[i // LANES], i % LANES
        for k in range(DIMS // 2):
            target[k, lane, 0], target[k, lane, 1] = 0, 0


class _Buffers(threading.local):
    """Megabytes that every pair needs for a moment: asking the system for them anew costs as much as the matching."""

    def __init__(self) -> None:
        self.rows, self.groups = np.empty(0, np.int16), np.empty(0, np.int16)


_BUFFERS = _Buffers()


def pack_rows(descriptors: NDArray[np.uint8], order: NDArray[np.int64]) -> NDArray[np.int16]:
    """The rows ``order`` (N,) as the tile reads image 1: (N', 128) int16, N' a multiple of ROWS, zeros at the end.

    The result is overwritten by the next call in the same thread.
    """
    shape = (-(-len(order) // ROWS) * ROWS, DIMS)
    if len(_BUFFERS.rows) < shape[0] * DIMS:
        _BUFFERS.rows = np.empty(shape[0] * DIMS, np.int16)
    out = _BUFFERS.rows[: shape[0] * DIMS].reshape(shape)
    _fill_rows(np.ascontiguousarray(descriptors), order, out)
    return out


def pack_groups(descriptors: NDArray[np.uint8], order: NDArray[np.int64]) -> NDArray[np.int16]:
    """The rows ``order`` (M,) as the tile reads image 2: (G, 64, LANES, 2) int16, G a multiple of GROUPS.

    The result is overwritten by the next call in the same thread.
    """
    num_groups = -(-len(order) // (LANES * GROUPS)) * GROUPS
    size = num_groups * LANES * DIMS
    if len(_BUFFERS.groups) < size:
        _BUFFERS.groups = np.empty(size, np.int16)
    out = _BUFFERS.groups[:size].reshape(num_groups, DIMS // 2, LANES, 2)
    _fill_groups(np.ascontiguousarray(descriptors), order, out)
    return out


def largest_products(descriptors1: NDArray[np.uint8], descriptors2: NDArray[np.uint8]) -> tuple[Best, Best]:
    """The best partner by dot product of each descriptor, in both directions; the first of equals wins.

    Args:
        descriptors1, descriptors2: (N, 128) and (M, 128) uint8.

    Returns:
        Of (N,) and of (M,); products are 0 where there is none, and no partner has a product that is not positive.
    """
    n, m = len(descriptors1), len(descriptors2)
    a, packed = pack_rows(descriptors1, np.arange(n)), pack_groups(descriptors2, np.arange(m))
    rows, columns = Best.of_none(len(a)), Best.of_none(len(packed) * LANES)
    _scan(a, packed, rows, columns, TileRoom.make())
    return Best(*(array[:n] for array in rows)), Best(*(array[:m] for array in columns))


@numba.njit(cache=True, nogil=True)
def _scan_background(
    a: NDArray[np.int16], packed: NDArray[np.int16], xy: NDArray[np.float64], sample: NDArray[np.int64],
    radius: NDArray[np.float64], best: Ints, unbounded: Ints, room: TileRoom,
) -> None:  # fmt: skip
    sums, masks = room
    for row in range(0, a.shape[0], ROWS):
        for group in range(0, packed.shape[0], GROUPS):
            tile(a, packed, sums, masks, best, unbounded, row, group)
            for r in range(ROWS):
                if masks[r] == 0:
                    continue
                i = row + r
                for q in range(GROUPS * LANES):
                    if (masks[r] >> np.uint32(q)) & np.uint32(1) and sums[r, q] > best[i]:
                        j = sample[group * LANES + q]
                        dx, dy = xy[i, 0] - xy[j, 0], xy[i, 1] - xy[j, 1]
                        if dx * dx + dy * dy > radius[i] * radius[i]:
                            best[i] = sums[r, q]


def background_products(
    descriptors: NDArray[np.uint8], xy: NDArray[np.float64], radius: NDArray[np.float64], sample_size: int
) -> Ints:
    """How like each feature some unrelated one looks: the largest product with a sample of its own image.

    Args:
        descriptors: (N, 128) uint8.
        xy: (N, 2) pixels.
        radius: (N,) pixels around each feature in which the others show the same thing and do not count.
        sample_size: features at equal steps through the image's list, so from all scales.
    """
    n = len(descriptors)
    sample = np.unique(np.linspace(0, max(n - 1, 0), min(n, sample_size)).astype(np.int64))
    a, packed = pack_rows(descriptors, np.arange(n)), pack_groups(descriptors, sample)
    best = np.zeros(len(a), np.int32)
    unbounded = np.full(len(packed) * LANES, np.iinfo(np.int32).max, np.int32)
    _scan_background(a, packed, xy, sample, radius, best, unbounded, TileRoom.make())
    return best[:n]
