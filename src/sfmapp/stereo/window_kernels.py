"""Costs of windows of any size in constant time, row by row, and the best disparity of every pixel of both pictures.

For each row of the picture and each disparity, columns hold the sum of costs over the height of a window. A row further
down, each column takes in one pixel and lets one go; along the row, each window takes in one column and lets one go.
Both loops run over disparities, which are neighbours in memory. What is kept is a few rows of columns times
disparities, however tall the picture; of the census also the bits of as many rows as the largest window has. Sums are
whole numbers, so that nothing drifts.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.simd.bits import count_bits
from sfmapp.simd.pointers import Pointer, offset, pointer
from sfmapp.stereo.costs import CENSUS, SAD, SSD, ZNCC, Planes

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

# how the costs of several windows become one
SUM, LEAST = 0, 1


class Search(NamedTuple):
    """What the kernels look for.

    Attributes:
        first, num: the least disparity and how many from there on.
        stride: ``num``, rounded up to whole vectors.
        margin: column of the mirrored right picture at which its last pixel stands.
        beyond: columns that the left picture goes on beyond its sides: more than any window reaches.
        shift: bits that hold a disparity's number.
        steps: whole numbers for a unit of the cost, such that with ``shift`` bits more they fit into 32.
        tolerance: of the left-right check, pixels.
    """

    first: int
    num: int
    stride: int
    margin: int
    beyond: int
    shift: int
    steps: float
    tolerance: float


class Windows(NamedTuple):
    """Sizes that are looked at together.

    Attributes:
        radius: (N,) int64 half sides, without the middle.
        weight: (N,) float32 of the mean cost of each where costs are added.
        mode: SUM, or LEAST for the best of them.
        moved: windows may stand this far off the pixel, in eight directions; zero: on it alone.
    """

    radius: NDArray[np.int64]
    weight: Floats
    mode: int
    moved: int


class Found(NamedTuple):
    """(H, W) float32 each, as :class:`sfmapp.stereo.result.DisparityMap` has them; the disparity is NaN where the check
    from the other side fails."""

    disparity: Floats
    cost: Floats
    curvature: Floats
    uniqueness: Floats


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _change_column(
    kind: int, column: Pointer, stride: int, inside: Pointer, outside: Pointer, l_in: np.int32, l_out: np.int32
) -> None:
    """Costs of one pixel of the left picture come into a column, of another they go out of it, at all disparities."""
    if kind == SAD:
        for d in range(stride):
            column[d] += abs(l_in - inside[d]) - abs(l_out - outside[d])
    elif kind == SSD:
        for d in range(stride):
            column[d] += (l_in - inside[d]) * (l_in - inside[d]) - (l_out - outside[d]) * (l_out - outside[d])
    else:
        for d in range(stride):
            column[d] += l_in * inside[d] - l_out * outside[d]


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _inside(place: int, length: int) -> int:
    return min(max(place, 0), length - 1)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _move_down(
    kind: int, planes: Planes, search: Search, columns: NDArray[np.int32], radius: int, y: int, is_first: bool
) -> None:
    """Columns (beyond + W + beyond, stride) of windows about row y, from those about the row above or from nothing."""
    height, wide = planes.left.shape
    zeros = np.zeros(search.stride, np.int32)
    nothing = pointer(zeros)
    start = search.margin + wide - 1 - search.beyond + search.first
    for step in range(-radius if is_first else radius, radius + 1):
        come, gone = _inside(y + step, height), _inside(y - radius - 1, height)
        come_in, go_out = pointer(planes.right[come]), pointer(planes.right[gone])
        for x in range(wide):
            column, at = pointer(columns[x]), start - x
            if is_first:
                _change_column(
                    kind, column, search.stride, offset(come_in, at), nothing, planes.left[come, x], np.int32(0)
                )
            else:
                _change_column(
                    kind, column, search.stride, offset(come_in, at), offset(go_out, at), planes.left[come, x],
                    planes.left[gone, x],
                )  # fmt: skip
    columns[0, 0] += zeros[0]  # which must live until here


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _count_bits(planes: Planes, search: Search, y: int, out: Bytes) -> None:
    """Differing bits (beyond + W + beyond, stride) of row y, once for all windows that take it in and let it go."""
    wide, stride = planes.left.shape[1], search.stride
    start = search.margin + wide - 1 - search.beyond + search.first
    right = pointer(planes.right[y])
    for x in range(wide):
        word, there, to = planes.left[y, x], offset(right, start - x), pointer(out[x])
        for d in range(stride):
            to[d] = np.uint8(count_bits(np.uint64(np.uint32(word ^ there[d]))))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _move_bits_down(bits: Bytes, height: int, columns: NDArray[np.int32], radius: int, y: int, is_first: bool) -> None:
    """As :func:`_move_down`, of ``bits`` (R, beyond + W + beyond, stride), row y at y % R."""
    ring, wide, stride = bits.shape
    for step in range(-radius if is_first else radius, radius + 1):
        come, gone = bits[_inside(y + step, height) % ring], bits[_inside(y - radius - 1, height) % ring]
        for x in range(wide):
            column, come_in, go_out = pointer(columns[x]), pointer(come[x]), pointer(gone[x])
            if is_first:
                for d in range(stride):
                    column[d] += np.int32(come_in[d])
            else:
                for d in range(stride):
                    column[d] += np.int32(come_in[d]) - np.int32(go_out[d])


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _add_window(
    mode: int, total: Pointer, sums: Pointer, inside: Pointer, outside: Pointer, stride: int, weight: float
) -> None:
    """A window moves on by one column, and its cost joins those of the others."""
    scale = np.float32(weight)
    if mode == SUM:
        for d in range(stride):
            sums[d] += inside[d] - outside[d]
            total[d] += np.float32(sums[d]) * scale
    else:
        for d in range(stride):
            sums[d] += inside[d] - outside[d]
            value = np.float32(sums[d]) * scale
            total[d] = value if value < total[d] else total[d]


class _Moments(NamedTuple):
    """What makes products of a window a correlation: share of a pixel, mean and reciprocal deviation on the left, and
    pointers to those on the right, by disparity."""

    area: float
    mean: float
    scale: float
    right_mean: Pointer
    right_scale: Pointer


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _add_correlation(
    mode: int, total: Pointer, sums: Pointer, inside: Pointer, outside: Pointer, stride: int, weight: float,
    moments: _Moments,
) -> None:  # fmt: skip
    """As :func:`_add_window`, of 1 - ZNCC."""
    area, share = np.float32(moments.area), np.float32(weight)
    mean, scale = np.float32(moments.mean), np.float32(moments.scale)
    for d in range(stride):
        sums[d] += inside[d] - outside[d]
        product = np.float32(sums[d]) * area - mean * moments.right_mean[d]
        value = np.float32(1.0) - product * scale * moments.right_scale[d]
        if mode == SUM:
            total[d] += share * value
        else:
            total[d] = value if value < total[d] else total[d]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _join_windows(
    kind: int, planes: Planes, search: Search, windows: Windows, columns: NDArray[np.int32], y: int,
    costs: NDArray[np.int32],
) -> None:  # fmt: skip
    """Costs (W, stride) of the windows about the pixels of row y, in whole steps."""
    width, stride, num = costs.shape[0], search.stride, len(windows.radius)
    sums = np.zeros((num, stride), np.int32)
    total, nothing = np.zeros(stride, np.float32), np.zeros(stride, np.int32)
    whole, none, steps = pointer(total), pointer(nothing), np.float32(search.steps)
    start = np.float32(0.0 if windows.mode == SUM else 1e9)
    for n in range(num):
        for x in range(-windows.radius[n] - 1, windows.radius[n]):
            column = pointer(columns[n, search.beyond + x])
            _add_window(SUM, whole, pointer(sums[n]), column, none, stride, 0.0)
    for x in range(width):
        at = search.margin + width - 1 - x + search.first
        for d in range(stride):
            whole[d] = start
        for n in range(num):
            radius = windows.radius[n]
            middle = search.beyond + x
            come, gone = pointer(columns[n, middle + radius]), pointer(columns[n, middle - radius - 1])
            area, weight = 1.0 / ((2 * radius + 1) * (2 * radius + 1)), windows.weight[n]
            if kind == ZNCC:
                moments = _Moments(
                    area, planes.left_mean[n, y, x], planes.left_scale[n, y, x],
                    offset(pointer(planes.right_mean[n, y]), at), offset(pointer(planes.right_scale[n, y]), at),
                )  # fmt: skip
                _add_correlation(windows.mode, whole, pointer(sums[n]), come, gone, stride, weight, moments)
            else:
                share = area * weight if windows.mode == SUM else area
                _add_window(windows.mode, whole, pointer(sums[n]), come, gone, stride, share)
        out = pointer(costs[x])
        for d in range(stride):
            value = whole[d] if whole[d] > np.float32(0.0) else np.float32(0.0)
            out[d] = np.int32(value * steps)
    total[0] = nothing[0]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _least_moved(
    rows: tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]], moved: int, out: NDArray[np.int32]
) -> None:
    """Least of the costs (W, stride) of windows on a pixel and ``moved`` off it, above, below and beside."""
    width, stride = out.shape
    for x in range(width):
        to = pointer(out[x])
        for d in range(stride):
            to[d] = np.int32(0x7FFFFFFF)
        for row in rows:
            for side in (-moved, 0, moved):
                of = pointer(row[_inside(x + side, width)])
                for d in range(stride):
                    to[d] = of[d] if of[d] < to[d] else to[d]


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _best(costs: Pointer, low: int, high: int, shift: int, other: Pointer) -> np.uint32:
    """The least of low <= d < high with its cost above it, ``cost << shift | d``, and the same for those of the other
    picture's pixels that are compared here."""
    best = np.uint32(0xFFFFFFFF)
    for d in range(low, high):
        value = np.uint32((np.uint32(costs[d]) << np.uint32(shift)) | np.uint32(d))
        best = value if value < best else best
        other[d] = value if value < other[d] else other[d]
    return best


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _least(costs: Pointer, low: int, high: int) -> np.int32:
    least = np.int32(0x7FFFFFFF)
    for d in range(low, high):
        least = costs[d] if costs[d] < least else least
    return least


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _between(kind: int, before: int, behind: int) -> float:
    """Where the least cost lies between whole disparities, from how much more those beside it cost.

    Squares and correlations fall and rise as parabolas. Absolute differences and bits do as two lines of opposite
    slopes, of which a parabola would draw disparities to whole numbers (Shimizu and Okutomi, ICPR 2002).
    """
    is_parabola = kind in (SSD, ZNCC)
    bend = before + behind if is_parabola else 2 * max(before, behind)
    if bend <= 0:
        return 0.0
    return (0.5 if is_parabola else 1.0) * (before - behind) / bend


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _choose(
    kind: int, costs: NDArray[np.int32], search: Search, best_right: NDArray[np.uint32], y: int, found: Found
) -> None:
    """The best disparity of each pixel of a row, held against the best ones of the right picture's pixels."""
    width = costs.shape[0]
    steps, mask = np.float32(1.0 / search.steps), np.uint32((1 << search.shift) - 1)
    chosen = np.full(width, -1, np.int64)
    for x in range(width):
        best_right[x] = np.uint32(0xFFFFFFFF)
    backwards = pointer(best_right)
    for x in range(width):
        start = width - 1 - x + search.first  # of the mirrored right picture
        low, high = max(0, -start), min(search.num, width - start)
        if low >= high:
            continue
        of = pointer(costs[x])
        packed = _best(of, low, high, search.shift, offset(backwards, start))
        k = int(np.uint32(packed) & mask)
        cost = of[k]
        below, above = _least(of, low, k - 1), _least(of, k + 2, high)
        second = below if below < above else above
        found.cost[y, x] = np.float32(cost) * steps
        is_alone = second == np.int32(0x7FFFFFFF)
        found.uniqueness[y, x] = 0.0 if is_alone else np.float32(second - cost) / np.float32(second + 1e-9)
        between = 0.0
        if low < k < high - 1:
            before, behind = of[k - 1], of[k + 1]
            found.curvature[y, x] = np.float32(before + behind - 2 * cost) * steps
            between = _between(kind, before - cost, behind - cost)
        found.disparity[y, x] = search.first + k + between
        chosen[x] = k
    for x in range(width):
        if chosen[x] >= 0:
            there = width - 1 - x + search.first + chosen[x]
            seen = int(best_right[there] & mask)
            if abs(seen - chosen[x]) > search.tolerance:
                found.disparity[y, x] = np.nan


@numba.njit(cache=True, nogil=True, error_model="numpy")
def match_rows(
    kind: int, planes: Planes, search: Search, windows: Windows, rows: tuple[int, int], found: Found
) -> None:
    """Fill rows ``rows[0]`` to ``rows[1]`` of what is found; ``kind``: one of :mod:`sfmapp.stereo.costs`'s numbers."""
    height, wide = planes.left.shape
    width, moved, num = wide - 2 * search.beyond, windows.moved, len(windows.radius)
    columns = np.zeros((num, wide, search.stride), np.int32)
    kept = np.zeros((2 * moved + 1, width, search.stride), np.int32)
    best = np.zeros((width if moved else 1, search.stride), np.int32)
    best_right = np.empty(width, np.uint32)
    first = max(rows[0] - moved, 0)
    following = first
    # rows whose bits are counted: those that a window may take in or let go
    reach = windows.radius.max()
    bits = np.empty((2 * reach + 2, wide, search.stride) if kind == CENSUS else (1, 1, 1), np.uint8)
    counted = max(first - reach, 0)
    for y in range(rows[0], rows[1]):
        while following <= min(y + moved, height - 1):
            while kind == CENSUS and counted <= min(following + reach, height - 1):
                _count_bits(planes, search, counted, bits[counted % len(bits)])
                counted += 1
            for n in range(num):
                is_first, radius = following == first, windows.radius[n]
                if kind == CENSUS:
                    _move_bits_down(bits, height, columns[n], radius, following, is_first)
                else:
                    _move_down(kind, planes, search, columns[n], radius, following, is_first)
            _join_windows(kind, planes, search, windows, columns, following, kept[following % (2 * moved + 1)])
            following += 1
        if moved:
            above, below = _inside(y - moved, height), _inside(y + moved, height)
            length = 2 * moved + 1
            _least_moved((kept[above % length], kept[y % length], kept[below % length]), moved, best)
            _choose(kind, best, search, best_right, y, found)
        else:
            _choose(kind, kept[0], search, best_right, y, found)
