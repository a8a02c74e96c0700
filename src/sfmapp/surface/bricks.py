"""A hierarchy of sparse grids around samples: bricks of 4 x 4 x 4 nodes, of the finest cells only near dense samples.

A level has cells twice as large as the finer one. Its leaf bricks are those whose cells it answers for, wherever the
finer level has none; beside them it keeps the bricks that hold the far corners of these cells. Bricks are known by
Morton codes of their places, in ascending order, so that the eight that lie in a coarser one follow each other, and so
do the samples in each brick of any level once they are in the order of the finest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Events
from sfmapp.executor import Threads
from sfmapp.geometry.morton import gather_bits, spread_bits

Codes = NDArray[np.int64]
Ids = NDArray[np.int32]
Flags = NDArray[np.bool_]
Values = NDArray[np.float32]
Points = NDArray[np.float32]

SIDE = 4  # nodes; kernels have its powers of two written out
# bricks that a thread is given at a time: 4 MB of values, and few enough that what lies beside them, which some work is
# done for once more, is a few percent
PART = 1 << 14
COARSEST_DEPTH = 5  # the coarsest level fills the box: 32 cells a side


def in_parts(work: Callable[[int, int], None], count: int, threads: int) -> None:
    """Do some work for all of so many bricks: threads call it with the first of a part and what comes behind it."""
    parts = [(low, min(low + PART, count)) for low in range(0, count, PART)]
    for _ in Threads(threads).run(lambda part: work(*part), parts):
        pass


@dataclass(frozen=True)
class Level:
    """One of the grids, of B bricks; node n of a brick is ``x + 4 y + 16 z``.

    Attributes:
        num: cells along each side of the box.
        codes: (B,) Morton codes of the bricks' places, ascending.
        is_leaf: (B,) whether the level answers for the brick's cells; the others only hold corners of them.
        around: (B, 27) the bricks around each and itself, ``x + 3 y + 9 z`` from the lowest on, -1 for none.
        parent: (B,) brick of the coarser level that each lies in; of the coarsest nobody asks.
        child: (B, 8) leaf bricks of the finer level that lie in each, ``x + 2 y + 4 z``, -1 for none.
    """

    num: int
    codes: Codes
    is_leaf: Flags
    around: Ids
    parent: Ids
    child: Ids


@numba.njit(cache=True, nogil=True)
def code_of(x: int, y: int, z: int) -> np.int64:
    """The Morton code of a place, each number below 2^21."""
    bits = spread_bits(np.uint64(x)) | (spread_bits(np.uint64(y)) << np.uint64(1))
    return np.int64(bits | (spread_bits(np.uint64(z)) << np.uint64(2)))


@numba.njit(cache=True, nogil=True)
def place_of(code: int, place: Codes) -> None:
    """Write the place (3,) of a Morton code."""
    for axis in range(3):
        place[axis] = np.int64(gather_bits(np.uint64(code) >> np.uint64(axis)))


@numba.njit(cache=True, nogil=True)
def load_window(values: Values, around: Ids, b: int, window: NDArray[np.float64], missing: float) -> None:
    """The nodes, or cells, of a brick, with one more before and as many behind as the window (K, K, K) has room for;
    ``missing`` where there is none."""
    for z in range(window.shape[0]):
        for y in range(window.shape[1]):
            for x in range(window.shape[2]):
                other = around[b, (x + 3 >> 2) + 3 * (y + 3 >> 2) + 9 * (z + 3 >> 2)]
                if other >= 0:
                    window[z, y, x] = values[other, (x + 3 & 3) + 4 * (y + 3 & 3) + 16 * (z + 3 & 3)]
                else:
                    window[z, y, x] = missing


@numba.njit(cache=True, nogil=True)
def _fine_codes(points: Points, shift: int) -> Codes:
    """(N,) codes of points (N, 3) in finest cells that are cut into 2^shift parts along each side."""
    codes, scale = np.empty(points.shape[0], np.int64), 1 << shift
    for i in range(points.shape[0]):
        x, y, z = int(points[i, 0] * scale), int(points[i, 1] * scale), int(points[i, 2] * scale)
        codes[i] = code_of(x, y, z)
    return codes


def order_samples(points: Points, depth: int) -> tuple[NDArray[np.int64], Codes]:
    """The order (N,) of points (N, 3) by their places along Morton's curve, and codes (N,) of their finest cells.

    Places are told apart to a part in 2^21 of the box, so that sums do not depend on the order in which points come.
    """
    shift = 21 - depth
    codes = _fine_codes(points, shift)
    order = np.argsort(codes, kind="stable")
    return order, codes[order] >> (3 * shift)


@dataclass(frozen=True)
class Members:
    """Samples by brick at a level.

    Attributes:
        level: 0 for the finest.
        codes: (S,) of the bricks that have samples, ascending.
        first: (S + 1,) the samples of brick b are ``first[b]`` to ``first[b + 1]``.
    """

    level: int
    codes: Codes
    first: Codes


def members(cells: Codes, level: int) -> Members:
    """The samples of each brick of a level, by the ascending codes (N,) of their finest cells."""
    mine = cells >> (3 * (level + 2))
    begins = np.flatnonzero(np.concatenate([[True], mine[1:] != mine[:-1]]))
    return Members(level, mine[begins], np.append(begins, len(mine)))


@numba.njit(cache=True, nogil=True)
def _find(codes: Codes, code: np.int64) -> int:
    """Position of a code among ascending ones, -1 if it is not there."""
    low, high = 0, codes.shape[0]
    while low < high:
        middle = (low + high) >> 1
        if codes[middle] < code:
            low = middle + 1
        else:
            high = middle
    return low if low < codes.shape[0] and codes[low] == code else -1


@numba.njit(cache=True, nogil=True)
def bricks_around(codes: Codes) -> Ids:
    """(B, 27) as in :class:`Level`, of bricks of which nothing but the codes is known."""
    around, place = np.full((codes.shape[0], 27), -1, np.int32), np.empty(3, np.int64)
    for b in range(codes.shape[0]):
        place_of(codes[b], place)
        for k in range(27):
            x, y, z = place[0] + k % 3 - 1, place[1] + k // 3 % 3 - 1, place[2] + k // 9 - 1
            if x >= 0 and y >= 0 and z >= 0:
                around[b, k] = _find(codes, code_of(x, y, z))
    return around


@numba.njit(cache=True, nogil=True)
def _bricks_near(
    points: Points, chosen: Flags, codes: Codes, first: Codes, level: int, reach: float, num: int
) -> Codes:
    """Codes, with repeats, of bricks (``num`` a side) within ``reach`` cells (at most 4), along each axis, of samples
    that are chosen (N,)."""
    scale, found, count = 1.0 / (1 << level), np.empty(27 * codes.shape[0], np.int64), 0
    place = np.empty(3, np.int64)
    for b in range(codes.shape[0]):
        place_of(codes[b], place)
        touched = 0
        for i in range(first[b], first[b + 1]):
            if not chosen[i]:
                continue
            x, y, z = (
                points[i, 0] * scale - 4 * place[0],
                points[i, 1] * scale - 4 * place[1],
                points[i, 2] * scale - 4 * place[2],
            )
            for w in range(0 if z < reach else 1, 3 if z > 4.0 - reach else 2):
                for v in range(0 if y < reach else 1, 3 if y > 4.0 - reach else 2):
                    for u in range(0 if x < reach else 1, 3 if x > 4.0 - reach else 2):
                        touched |= 1 << (u + 3 * v + 9 * w)
        for k in range(27):
            x, y, z = place[0] + k % 3 - 1, place[1] + k // 3 % 3 - 1, place[2] + k // 9 - 1
            if touched >> k & 1 and 0 <= x < num and 0 <= y < num and 0 <= z < num:
                found[count] = code_of(x, y, z)
                count += 1
    return found[:count]


@numba.njit(cache=True, nogil=True)
def _bricks_above(codes: Codes, num: int) -> Codes:
    """Codes, with repeats, of the coarser bricks (``num`` a side) that have a cell within or beside some bricks."""
    found, count, place = np.empty(8 * codes.shape[0], np.int64), 0, np.empty(3, np.int64)
    for b in range(codes.shape[0]):
        place_of(codes[b], place)
        x, y, z = 2 * place[0], 2 * place[1], 2 * place[2]
        for w in range(max(z - 1, 0) >> 2, min((z + 2) >> 2, num - 1) + 1):
            for v in range(max(y - 1, 0) >> 2, min((y + 2) >> 2, num - 1) + 1):
                for u in range(max(x - 1, 0) >> 2, min((x + 2) >> 2, num - 1) + 1):
                    found[count] = code_of(u, v, w)
                    count += 1
    return found[:count]


@numba.njit(cache=True, nogil=True)
def _with_corners(codes: Codes) -> Codes:
    """Codes, with repeats, of bricks and of those that have far corners of their cells."""
    found, place = np.empty((codes.shape[0], 8), np.int64), np.empty(3, np.int64)
    for b in range(codes.shape[0]):
        place_of(codes[b], place)
        for k in range(8):
            found[b, k] = code_of(place[0] + (k & 1), place[1] + (k >> 1 & 1), place[2] + (k >> 2))
    return found.ravel()


@numba.njit(cache=True, nogil=True)
def _children(parents: Codes, codes: Codes) -> tuple[Ids, Ids]:
    """(P, 8) bricks in each coarser one, and (B,) the coarser one of each."""
    child, parent, at = np.full((parents.shape[0], 8), -1, np.int32), np.empty(codes.shape[0], np.int32), 0
    for b in range(codes.shape[0]):
        while parents[at] < codes[b] >> 3:
            at += 1
        parent[b] = at
        child[at, codes[b] & 7] = b
    return child, parent


@numba.njit(cache=True, nogil=True)
def _around_by_parents(codes: Codes, parent: Ids, child: Ids, above: Ids) -> Ids:
    """(B, 27) as in :class:`Level`, by what is around the coarser bricks, ``above``."""
    around = np.full((codes.shape[0], 27), -1, np.int32)
    for b in range(codes.shape[0]):
        for k in range(27):
            x, y, z = (codes[b] & 1) + k % 3 - 1, (codes[b] >> 1 & 1) + k // 3 % 3 - 1, (codes[b] >> 2 & 1) + k // 9 - 1
            coarser = above[parent[b], ((x >> 1) + 1) + 3 * ((y >> 1) + 1) + 9 * ((z >> 1) + 1)]
            if coarser >= 0:
                around[b, k] = child[coarser, (x & 1) | (y & 1) << 1 | (z & 1) << 2]
    return around


def positions_of(codes: Codes, wanted: Codes) -> Codes:
    """Where (W,) some codes are among ascending ones, -1 where they are not."""
    if not len(codes):
        return np.full(len(wanted), -1)
    at = np.minimum(np.searchsorted(codes, wanted), len(codes) - 1)
    return np.where(codes[at] == wanted, at, -1)


def make_levels(
    points: Points, level_of: NDArray[np.int8], cells: Codes, depth: int, reach: float, events: Events
) -> list[Level]:
    """The grids, finest first.

    Args:
        points: (N, 3) samples in finest cells, 0 to 2^depth, in the order of their codes.
        level_of: (N,) the finest level that has bricks about each.
        cells: (N,) ascending codes of their finest cells.
        reach: cells of a sample's level within which that level answers.
    """
    num_levels = max(depth - COARSEST_DEPTH, 0) + 1
    leaves: list[Codes] = []
    for level in range(num_levels - 1):
        events.raise_if_cancelled()
        here, num = members(cells, level), (1 << depth - level) // SIDE
        found = [_bricks_near(points, level_of == level, here.codes, here.first, level, reach, num)]
        if level:
            found.append(_bricks_above(leaves[-1], num))
        leaves.append(np.unique(np.concatenate(found)))
    whole = (1 << depth - num_levels + 1) // SIDE
    leaves.append(np.arange(whole**3))  # whole is a power of two: these are all of its Morton codes
    out: list[Level] = []
    child, above = np.empty((0, 8), np.int32), np.empty((0, 27), np.int32)
    for level in range(num_levels - 1, -1, -1):
        mine = np.unique(_with_corners(leaves[level]))
        is_leaf = np.zeros(len(mine), np.bool_)
        is_leaf[np.searchsorted(mine, leaves[level])] = True
        if out:
            child, parent = _children(out[0].codes, mine)
            above = _around_by_parents(mine, parent, child, out[0].around)
            there = child >= 0
            out[0].child[there] = np.where(is_leaf[child[there]], child[there], -1)
        else:
            above, parent = bricks_around(mine), np.zeros(len(mine), np.int32)
        out.insert(0, Level(1 << depth - level, mine, is_leaf, above, parent, np.full((len(mine), 8), -1, np.int32)))
    return out
