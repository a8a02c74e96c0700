"""What eliminating the points takes off the tiles of the reduced system: products of blocks that meet in a point.

A tile of a large system is far from the last one that the same point touched, and in no cache. Points are therefore
looked at once for each few rows of tiles, as supernodal methods gather updates (Ng and Peyton 1993): the rows ``Z_a``
of blocks that are neighbours times ``Z_b`` of all blocks behind them that see the same point, some columns at a time.
No two threads write to the same tile, and each takes its products in the order of the points.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.kernels import ImageArrays, Int32s, Ints, LensArrays, Meetings, PointArrays
from sfmapp.simd.f64x8 import subtract3
from sfmapp.simd.pointers import offset, pointer

Array = NDArray[np.float64]

# Rows of tiles that are done together, and so many columns of them at once: what lies in them, 256 kB, stays near.
GROUP, COLUMNS = 16, 32


class TileRows(NamedTuple):
    """Where tiles are: those of row a at ``ptr[a] : ptr[a + 1]``, ascending by column. (B + 1,), (N,) int64."""

    ptr: Ints
    column: Ints


class Runs(NamedTuple):
    """In which points the blocks of a group appear, which are neighbours among the entries of :class:`Meetings`.

    Attributes:
        ptr: (K G + 1,) int64, those of batch k and group g of G, by point, at ``ptr[k G + g] : ptr[k G + g + 1]``.
        first, last: (R,) int32 entries.
    """

    ptr: Ints
    first: Int32s
    last: Int32s


@numba.njit(cache=True, nogil=True, error_model="numpy")
def find_meetings(
    points: PointArrays, images: ImageArrays, lenses: LensArrays, num_blocks: int
) -> tuple[Ints, Int32s, Int32s]:
    """``ptr``, ``block`` and ``partners`` of :class:`Meetings`.

    Points that are eliminated make products of all pairs of blocks that see them; those that are blocks themselves, the
    last of their entries, one with each.
    """
    point_ptr, obs_image = points.ptr, points.image
    num_points = point_ptr.shape[0] - 1
    mark = np.full(num_blocks, -1, np.int64)
    ptr = np.zeros(num_points + 1, np.int64)
    block = np.empty(3 * obs_image.shape[0] + num_points, np.int32)
    n = 0
    for p in range(num_points):
        first = n
        if not points.is_constant[p]:
            for turn in range(3):  # poses are numbered before cameras: nearly sorted
                for o in range(point_ptr[p], point_ptr[p + 1]):
                    i = obs_image[o]
                    c = images.camera[i]
                    b = images.block[i] if turn == 0 else lenses.block[c] if turn == 1 else lenses.second[c]
                    if b < 0 or mark[b] == p:
                        continue
                    mark[b] = p
                    at = n
                    while at > first and block[at - 1] > b:
                        block[at] = block[at - 1]
                        at -= 1
                    block[at] = b
                    n += 1
            if points.block[p] >= 0:
                block[n] = points.block[p]
                n += 1
        ptr[p + 1] = n
    partners = np.zeros((n, 2), np.int32)
    for p in range(num_points):
        is_kept = points.block[p] >= 0
        for e in range(ptr[p], ptr[p + 1] - is_kept):
            partners[e, 0] = ptr[p + 1] - 1 if is_kept else e
            partners[e, 1] = ptr[p + 1]
    return ptr, block[:n].copy(), partners


@numba.njit(cache=True, nogil=True, error_model="numpy")
def find_runs(meetings: Meetings, batches: Ints) -> tuple[Ints, Int32s, Int32s]:
    """Fill :class:`Runs`; batches (K + 1,): first point of each."""
    block, partners = meetings.block, meetings.partners
    num, num_groups = batches.shape[0] - 1, -(-meetings.dim.shape[0] // GROUP)
    ptr, place = np.zeros(num * num_groups + 1, np.int64), np.zeros(num * num_groups, np.int64)
    first, last = np.empty(0, np.int32), np.empty(0, np.int32)
    for turn in range(2):  # count, then fill
        for k in range(num):
            for p in range(batches[k], batches[k + 1]):
                e, end = meetings.ptr[p], meetings.ptr[p + 1]
                while e < end and partners[e, 1] > 0:
                    begin, group = e, block[e] // GROUP
                    while e < end and block[e] // GROUP == group and partners[e, 1] > 0:
                        e += 1
                    n = k * num_groups + group
                    if turn == 1:
                        first[ptr[n] + place[n]], last[ptr[n] + place[n]] = begin, e
                    place[n] += 1
        if turn == 0:
            for n in range(num * num_groups):
                ptr[n + 1] = ptr[n] + place[n]
                place[n] = 0
            first, last = np.empty(ptr[-1], np.int32), np.empty(ptr[-1], np.int32)
    return ptr, first, last


@numba.njit(cache=True, nogil=True, error_model="numpy")
def mark_pairs(meetings: Meetings, pairs: NDArray[np.bool_]) -> None:
    """Set pairs[a, b], (B, B) bool, for all blocks a <= b that meet in a point."""
    block = meetings.block
    for e in range(block.shape[0]):
        for m in range(meetings.partners[e, 0], meetings.partners[e, 1]):
            pairs[block[e], block[m]] = True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def subtract_products(
    part: tuple[int, int], batch: int, meetings: Meetings, runs: Runs, rows: Array, first_entry: int,
    tile_rows: TileRows, tiles: Array,
) -> None:  # fmt: skip
    """Take the products ``Z_a Z_b^T`` of a batch off the rows of tiles of groups ``part[0]`` to ``part[1]``; the first
    batch begins with zeros.

    Args:
        rows: ``Z`` of the batch, as :func:`sfmapp.adjust.kernels.reduce_points` leaves it. first_entry: of the batch.
        tiles: (N * 64,).
    """
    block, partners, dim = meetings.block, meetings.partners, meetings.dim
    num_blocks = dim.shape[0]
    num_groups = -(-num_blocks // GROUP)
    slot = np.zeros(num_blocks * GROUP, np.int64)
    is_used = np.zeros(num_blocks // COLUMNS + 1, np.bool_)
    longest = 0
    for n in range(batch * num_groups + part[0], batch * num_groups + part[1]):
        longest = max(longest, runs.ptr[n + 1] - runs.ptr[n])
    cursor = np.empty(longest, np.int32)
    Z, tile = offset(pointer(rows), -24 * first_entry), pointer(tiles)
    for group in range(part[0], part[1]):
        low, high = group * GROUP, min(num_blocks, (group + 1) * GROUP)
        is_used[:] = False
        for a in range(low, high):
            for t in range(tile_rows.ptr[a], tile_rows.ptr[a + 1]):
                slot[tile_rows.column[t] * GROUP + a - low] = t * 64
                is_used[tile_rows.column[t] // COLUMNS] = True
        if batch == 0:
            for n in range(tile_rows.ptr[low] * 64, tile_rows.ptr[high] * 64):
                tiles[n] = 0.0
        begin, end = runs.ptr[batch * num_groups + group], runs.ptr[batch * num_groups + group + 1]
        for q in range(begin, end):
            cursor[q - begin] = partners[runs.first[q], 0]
        for window in range(low // COLUMNS, is_used.shape[0]):
            if not is_used[window]:
                continue
            limit = (window + 1) * COLUMNS
            for q in range(begin, end):
                first, last = runs.first[q], runs.last[q]
                m, stop = cursor[q - begin], partners[first, 1]
                while m < stop and block[m] < limit:
                    to = block[m] * GROUP - low
                    for e in range(first, min(last, m + 1)):
                        subtract3(tile, slot[to + block[e]], Z, e * 24, Z, m * 24, dim[block[e]])
                    m += 1
                cursor[q - begin] = m


@numba.njit(cache=True, nogil=True, error_model="numpy")
def find_tile(tile_rows: TileRows, a: int, b: int) -> int:
    """Number of the tile of blocks a, b; -1 where there is none."""
    low, high = tile_rows.ptr[a], tile_rows.ptr[a + 1]
    while low < high:
        middle = (low + high) // 2
        if tile_rows.column[middle] < b:
            low = middle + 1
        else:
            high = middle
    return low if low < tile_rows.ptr[a + 1] and tile_rows.column[low] == b else -1
