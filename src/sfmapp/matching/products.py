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
# Rows of image 1 that are compared with one pair of groups after the other: they, what they have found and that pair
# take 20 kB of a first cache, of which processors have 32 and more. Row pair by row pair, all groups of a block, 64 kB,
# would come from the second cache for each.
STRIP = 32


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
    """Products of a span of rows with one of groups, by blocks of BLOCK x BLOCK, and in these by strips of rows: a
    strip and what it has found stay in the first cache while the groups of the block pass by, once for all its rows."""
    best1, best2 = np.empty((STRIP, 2, LANES), np.int32), np.empty((BLOCK // LANES, 2, LANES), np.int32)
    for first_group in range(group_span[0], group_span[1], BLOCK // LANES):
        last_group = min(first_group + BLOCK // LANES, group_span[1])
        for first_row in range(row_span[0], row_span[1], BLOCK):
            best2[:] = 0
            last_row = min(first_row + BLOCK, row_span[1])
            for strip in range(first_row, last_row, STRIP):
                best1[:] = 0
                end = min(strip + STRIP, last_row)
                for group in range(first_group, last_group, GROUPS):
                    column = BLOCK * (group - first_group)
                    for row in range(strip, end, ROWS):
                        tile_of_best(a, packed, row, group, best1, best2, row - strip, row - first_row + column)
                for row in range(strip, end):
                    first, second = two_largest_lanes(best1, row - strip)
                    _merge_block(rows.first, rows.second, rows.partner, row, first, second, first_group * LANES)
            for group in range(first_group, last_group):
                of_group = best2[group - first_group]
                for q in range(LANES):
                    _merge_block(
                        columns.first, columns.second, columns.partner, group * LANES + q, of_group[0, q],
                        of_group[1, q], first_row,
                    )  # fmt: skip


@numba.njit(cache=True, nogil=True, inline="always")
def _merge_block(best1: Ints, best2: Ints, partner: Ints, i: int, first: int, second: int, start: int) -> None:
    """Enter the two largest of a block, which begins with partner ``start``, into those of i; see ``tile_of_best``."""
    value = first >> 8
    if value > best1[i]:
        best2[i] = max(best1[i], second >> 8)
        best1[i] = value
        partner[i] = start + BLOCK - 1 - (first & (BLOCK - 1))
    elif value > best2[i]:
        best2[i] = value


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

    Args:
        descriptors1, descriptors2: (N, 128) and (M, 128) uint8.
        is_dark1, is_dark2: (N,) and (M,) bool; only descriptors that agree are compared. None: all are.
    """

    def __init__(
        self,
        descriptors1: NDArray[np.uint8],
        descriptors2: NDArray[np.uint8],
        is_dark1: NDArray[np.bool_] | None = None,
        is_dark2: NDArray[np.bool_] | None = None,
    ) -> None:
        self._descriptors = descriptors1, descriptors2
        if is_dark1 is None or is_dark2 is None:
            self._parts = [_PartSearch(np.arange(len(descriptors1)), np.arange(len(descriptors2)))]
        else:
            kinds = (is_dark1, is_dark2), (~is_dark1, ~is_dark2)
            self._parts = [_PartSearch(*(np.flatnonzero(which) for which in kind)) for kind in kinds]

    def among_first(self, size: int) -> tuple[Best, Best]:
        """The best partner by dot product of each descriptor, in both directions; the first of equals wins.

        Args:
            size: how many descriptors of each image, rounded up to whole tiles; no fewer than in earlier calls.

        Returns:
            Of those of image 1 and of those of image 2; products are 0 where there is none, and no partner has a
            product that is not positive.
        """
        for part in self._parts:
            part.go_on(self._descriptors, _whole_tiles(size))
        best = tuple(Best.of_none(max(part.end(side) for part in self._parts)) for side in (0, 1))
        for part in self._parts:
            part.enter(best)
        return best[0], best[1]


class _PartSearch:
    """The search among descriptors at ascending positions (K,) and (L,) of two images."""

    def __init__(self, positions1: NDArray[np.int64], positions2: NDArray[np.int64]) -> None:
        self._positions = positions1, positions2
        self._best = Best.of_none(_whole_tiles(len(positions1))), Best.of_none(_whole_tiles(len(positions2)))
        self._done = 0, 0

    def go_on(self, descriptors: tuple[NDArray[np.uint8], NDArray[np.uint8]], size: int) -> None:
        """Compare those at positions below a size, and some behind it that fill the last tile."""
        firsts = [min(_whole_tiles(int(np.searchsorted(each, size))), len(each)) for each in self._positions]
        n, m = firsts
        if (n, m) != self._done:
            a, packed = (
                pack(each, positions[:num])
                for pack, each, positions, num in zip(
                    (pack_rows, pack_groups), descriptors, self._positions, (n, m), strict=True
                )
            )
            # to the right of what is done, then below: partners come in ascending order
            row, group = min(_whole_tiles(self._done[0]), len(a)), _whole_tiles(self._done[1]) // LANES
            _scan(a, packed, *self._best, (0, row), (group, len(packed)))
            _scan(a, packed, *self._best, (row, len(a)), (0, len(packed)))
            self._done = n, m

    def end(self, side: int) -> int:
        """The position behind the last one of an image that was compared."""
        return int(self._positions[side][self._done[side] - 1]) + 1 if self._done[side] else 0

    def enter(self, best: tuple[Best, ...]) -> None:
        """Put what was found where it belongs among all descriptors of the images."""
        for side, (all_, mine) in enumerate(zip(best, self._best, strict=True)):
            num = self._done[side]
            at, partner = self._positions[side][:num], mine.partner[:num]
            others = self._positions[1 - side]
            all_.first[at], all_.second[at] = mine.first[:num], mine.second[:num]
            if len(others):
                all_.partner[at] = np.where(partner >= 0, others[partner], -1)


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
    descriptors: NDArray[np.uint8],
    xy: NDArray[np.float64],
    radius: NDArray[np.float64],
    sample_size: int,
    is_dark: NDArray[np.bool_] | None = None,
) -> Ints:
    """How like each feature some unrelated one looks: the largest product with a sample of its own image.

    Args:
        descriptors: (N, 128) uint8.
        xy: (N, 2) pixels.
        radius: (N,) pixels around each feature in which the others show the same thing and do not count.
        sample_size: features at equal steps through the image's list, so from all scales.
        is_dark: (N,) bool; only those that agree are compared. None: all are.
    """
    n = len(descriptors)
    is_sample = np.zeros(n, bool)
    is_sample[np.linspace(0, max(n - 1, 0), min(n, sample_size)).astype(np.int64)] = True
    found = np.zeros(n, np.int32)
    for kind in [np.ones(n, bool)] if is_dark is None else [is_dark, ~is_dark]:
        mine = np.flatnonzero(kind)
        sample = np.flatnonzero(is_sample[mine])
        a, packed = pack_rows(descriptors, mine), pack_groups(descriptors, mine[sample])
        best = np.zeros(len(a), np.int32)
        unbounded = np.full(len(packed) * LANES, np.iinfo(np.int32).max, np.int32)
        _scan_background(a, packed, xy[mine], sample, radius[mine], best, unbounded, TileRoom.make())
        found[mine] = best[: len(mine)]
    return found
