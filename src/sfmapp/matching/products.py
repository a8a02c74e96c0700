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

from sfmapp.simd.bits import first_bit
from sfmapp.simd.dots import (
    BLOCK,
    DIMS,
    GROUP_TYPE,
    GROUPS,
    LANES,
    OFFSET,
    PER_SUM,
    ROW_TYPE,
    ROWS,
    tile,
    tile_of_best,
    two_largest_lanes,
)

Ints = NDArray[np.int32]
# descriptors as the tile reads them
Packed = NDArray[np.integer]


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
def _scan(
    a: Packed, packed: Packed, rows: Best, columns: Best, row_span: tuple[int, int], group_span: tuple[int, int]
) -> None:
    """Products of a span of rows with one of groups, by blocks of BLOCK x BLOCK: half of one stays in the first cache
    while the other passes by."""
    best1, best2 = np.empty((ROWS, 2, LANES), np.int32), np.empty((BLOCK // LANES, 2, LANES), np.int32)
    for first_group in range(group_span[0], group_span[1], BLOCK // LANES):
        last_group = min(first_group + BLOCK // LANES, group_span[1])
        for first_row in range(row_span[0], row_span[1], BLOCK):
            best2[:] = 0
            for row in range(first_row, min(first_row + BLOCK, row_span[1]), ROWS):
                best1[:] = 0
                for group in range(first_group, last_group, GROUPS):
                    tile_of_best(a, packed, row, group, best1, best2, row - first_row + BLOCK * (group - first_group))
                for r in range(ROWS):
                    first, second = two_largest_lanes(best1, r)
                    _merge_block(rows, row + r, first, second, first_group * LANES)
            for group in range(first_group, last_group):
                for q in range(LANES):
                    of_column = best2[group - first_group, :, q]
                    _merge_block(columns, group * LANES + q, of_column[0], of_column[1], first_row)


@numba.njit(cache=True, nogil=True, inline="always")
def _merge_block(best: Best, i: int, first: int, second: int, start: int) -> None:
    """Enter the two largest of a block, which begins with partner ``start``, into those of i; see ``tile_of_best``."""
    value = first >> 8
    if value > best.first[i]:
        best.second[i] = max(best.first[i], second >> 8)
        best.first[i] = value
        best.partner[i] = start + BLOCK - 1 - (first & (BLOCK - 1))
    elif value > best.second[i]:
        best.second[i] = value


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
def _fill_rows(descriptors: NDArray[np.uint8], order: NDArray[np.int64], out: Packed, starts: Ints) -> None:
    """Fill out (N', DIMS + PER_SUM); starts is the same memory as int32, whose last column the sums begin with."""
    for i in range(len(order)):
        source, target, total = descriptors[order[i]], out[i], np.int32(0)
        for k in range(DIMS):
            target[k] = source[k]
            total += np.int32(source[k])
        starts[i, DIMS // PER_SUM] = OFFSET * total
    for i in range(len(order), len(out)):
        target = starts[i]
        for k in range(DIMS // PER_SUM + 1):
            target[k] = 0


@numba.njit(cache=True, nogil=True)
def _fill_groups(descriptors: NDArray[np.uint8], order: NDArray[np.int64], words: NDArray[np.uint32]) -> None:
    """Fill words (G, 128 / PER_SUM, LANES), the numbers that one sum takes up at a time; zeros less OFFSET at the end.

    Less 128 a byte has its highest bit turned.
    """
    nothing = np.uint32(0)
    for part in range(PER_SUM):
        nothing |= np.uint32(OFFSET) << np.uint32(32 // PER_SUM * part)
    for i in range(len(order)):
        source, target, lane = descriptors[order[i]], words[i // LANES], i % LANES
        for k in range(DIMS // PER_SUM):
            word = np.uint32(0)
            for part in range(PER_SUM):
                word |= np.uint32(source[PER_SUM * k + part]) << np.uint32(32 // PER_SUM * part)
            target[k, lane] = word ^ nothing
    for i in range(len(order), words.shape[0] * LANES):
        for k in range(DIMS // PER_SUM):
            words[i // LANES, k, i % LANES] = nothing


class _Buffers(threading.local):
    """Megabytes that every pair needs for a moment: asking the system for them anew costs as much as the matching."""

    def __init__(self) -> None:
        self.rows, self.groups = np.empty(0, ROW_TYPE), np.empty(0, GROUP_TYPE)


_BUFFERS = _Buffers()


def pack_rows(descriptors: NDArray[np.uint8], order: NDArray[np.int64]) -> Packed:
    """The rows ``order`` (N,) as the tile reads image 1: (N', 128 + PER_SUM), N' a multiple of ROWS, zeros at the end.

    The result is overwritten by the next call in the same thread.
    """
    shape = (-(-len(order) // ROWS) * ROWS, DIMS + PER_SUM)
    size = shape[0] * shape[1]
    if len(_BUFFERS.rows) < size:
        _BUFFERS.rows = np.empty(size, ROW_TYPE)
    out = _BUFFERS.rows[:size].reshape(shape)
    _fill_rows(np.ascontiguousarray(descriptors), order, out, out.view(np.int32))
    return out


def pack_groups(descriptors: NDArray[np.uint8], order: NDArray[np.int64]) -> Packed:
    """The rows ``order`` (M,) as the tile reads image 2: (G, 128 / PER_SUM, LANES, PER_SUM), G a multiple of GROUPS.

    The result is overwritten by the next call in the same thread.
    """
    num_groups = -(-len(order) // (LANES * GROUPS)) * GROUPS
    size = num_groups * LANES * DIMS
    if len(_BUFFERS.groups) < size:
        _BUFFERS.groups = np.empty(size, GROUP_TYPE)
    out = _BUFFERS.groups[:size].reshape(num_groups, DIMS // PER_SUM, LANES, PER_SUM)
    _fill_groups(np.ascontiguousarray(descriptors), order, out.view(np.uint32)[..., 0])
    return out


class ProductSearch:
    """The search for the best partners among the first so many descriptors of two images, which can be carried on.

    Products that it has had are not computed again, so that a look at a few costs nothing where all are compared.
    """

    def __init__(self, descriptors1: NDArray[np.uint8], descriptors2: NDArray[np.uint8]) -> None:
        """(N, 128) and (M, 128) uint8."""
        self._descriptors = descriptors1, descriptors2
        self._rows = Best.of_none(_whole_tiles(len(descriptors1)))
        self._columns = Best.of_none(_whole_tiles(len(descriptors2)))
        self._done = 0, 0

    def among_first(self, size: int) -> tuple[Best, Best]:
        """The best partner by dot product of each descriptor, in both directions; the first of equals wins.

        Args:
            size: how many descriptors of each image, rounded up to whole tiles; no fewer than in earlier calls.

        Returns:
            Of those of image 1 and of those of image 2; products are 0 where there is none, and no partner has a
            product that is not positive. Overwritten by the next call.
        """
        n, m = (min(_whole_tiles(size), len(each)) for each in self._descriptors)
        if (n, m) != self._done:
            a, packed = (
                pack(each, np.arange(num))
                for pack, each, num in zip((pack_rows, pack_groups), self._descriptors, (n, m), strict=True)
            )
            # to the right of what is done, then below: partners come in ascending order
            row, group = min(_whole_tiles(self._done[0]), len(a)), _whole_tiles(self._done[1]) // LANES
            _scan(a, packed, self._rows, self._columns, (0, row), (group, len(packed)))
            _scan(a, packed, self._rows, self._columns, (row, len(a)), (0, len(packed)))
            self._done = n, m
        return Best(*(array[:n] for array in self._rows)), Best(*(array[:m] for array in self._columns))


def _whole_tiles(num: int) -> int:
    return -(-num // (GROUPS * LANES)) * GROUPS * LANES


def largest_products(descriptors1: NDArray[np.uint8], descriptors2: NDArray[np.uint8]) -> tuple[Best, Best]:
    """:class:`ProductSearch` among all, (N, 128) and (M, 128) uint8."""
    return ProductSearch(descriptors1, descriptors2).among_first(max(len(descriptors1), len(descriptors2)))


@numba.njit(cache=True, nogil=True)
def _scan_background(
    a: Packed, packed: Packed, xy: NDArray[np.float64], sample: NDArray[np.int64],
    radius: NDArray[np.float64], best: Ints, unbounded: Ints, room: TileRoom,
) -> None:  # fmt: skip
    sums, masks = room
    for row in range(0, a.shape[0], ROWS):
        for group in range(0, packed.shape[0], GROUPS):
            if not tile(a, packed, row, group, sums, masks, best, unbounded):
                continue
            for r in range(ROWS):
                i, left = row + r, masks[r]
                while left != 0:
                    q = first_bit(np.uint64(left))
                    left &= left - np.uint32(1)
                    if sums[r, q] > best[i]:
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
