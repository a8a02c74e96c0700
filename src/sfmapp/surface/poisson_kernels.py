"""Kernels of the screened Poisson surface: how dense samples are, their divergence, relaxation, and what they ask for.

Values of nodes are (B, 64) float32, a row for each brick (:mod:`sfmapp.surface.bricks`). Samples (N) come in the order
of their bricks; ``codes`` (S,) and ``first`` (S + 1,) are their :class:`~sfmapp.surface.bricks.Members`, ``at`` (S,) is
the number of each of these bricks in the level, -1 where it has none. Kernels that take ``low`` and ``high`` work at
the bricks from one to before the other, so that several threads can share the work: no sum depends on how it is cut.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.surface.bricks import Codes, Flags, Ids, Points, Values, load_window, place_of

Array = NDArray[np.float64]

# A plane of one sample per cell, counted in cells and smoothed by a quadratic B-spline along each axis, comes to 0.667
# samples across an axis and to 0.61 across a diagonal of the cells.
_PLANE = 0.64


@numba.njit(cache=True, nogil=True)
def count_samples(points: Points, first: Codes, level: int, counts: Values) -> None:
    """Count samples in the cells (S, 64) of the bricks that have some."""
    scale = 1.0 / (1 << level)
    for b in range(counts.shape[0]):
        for i in range(first[b], first[b + 1]):
            x, y, z = np.int64(points[i, 0] * scale), np.int64(points[i, 1] * scale), np.int64(points[i, 2] * scale)
            counts[b, (x & 3) + 4 * (y & 3) + 16 * (z & 3)] += np.float32(1.0)


@numba.njit(cache=True, nogil=True)
def find_densities(
    points: Points, asked: Flags, codes: Codes, first: Codes, level: int, around: Ids, counts: Values, density: Values,
    low: int, high: int,
) -> None:  # fmt: skip
    """Write how many samples there are in the square of a cell's side around those that are asked (N,)."""
    scale, weight = 1.0 / (1 << level), np.empty((3, 3))
    window, place, cell = np.empty((6, 6, 6)), np.empty(3, np.int64), np.empty(3, np.int64)
    for b in range(low, high):
        is_loaded = False
        for i in range(first[b], first[b + 1]):
            if not asked[i]:
                continue
            if not is_loaded:
                is_loaded = True
                place_of(codes[b], place)
                load_window(counts, around, b, window, 0.0)
            for axis in range(3):
                t = points[i, axis] * scale - 4 * place[axis]
                cell[axis] = min(max(int(t), 0), 3)
                _quadratic(t - cell[axis] - 0.5, weight[axis])
            total = 0.0
            for z in range(3):
                for y in range(3):
                    for x in range(3):
                        share = weight[0, x] * weight[1, y] * weight[2, z]
                        total += share * window[cell[2] + z, cell[1] + y, cell[0] + x]
            density[i] = total / _PLANE


@numba.njit(cache=True, nogil=True)
def merge_samples(
    points: Points, cells: Codes, flux: Points, level_of: NDArray[np.int8], level: int, shift: int, out_points: Points,
    out_cells: Codes, out_flux: Points, out_level_of: NDArray[np.int8],
) -> int:  # fmt: skip
    """Write samples of which one, amid the others and of as much area, stands for all up to a level whose cells' codes
    have all but the last ``shift`` bits in common, or count them if there is no room for any."""
    count, begin, sums, total = 0, 0, np.empty(3), np.empty(3)
    while begin < points.shape[0]:
        end, num, at = begin, 0, -1
        sums[:] = 0.0
        total[:] = 0.0
        while end < points.shape[0] and cells[end] >> shift == cells[begin] >> shift:
            is_fine = level_of[end] <= level
            if is_fine:
                num += 1
                for axis in range(3):
                    sums[axis] += points[end, axis]
                    total[axis] += flux[end, axis]
            if not is_fine or at < 0:
                if is_fine:
                    at = count
                if out_cells.shape[0]:
                    out_points[count], out_cells[count] = points[end], cells[end]
                    out_flux[count], out_level_of[count] = flux[end], level_of[end]
                count += 1
            end += 1
        if at >= 0 and out_cells.shape[0]:
            out_level_of[at] = level
            for axis in range(3):
                out_points[at, axis] = np.float32(sums[axis] / num)
                out_flux[at, axis] = np.float32(total[axis])
        begin = end
    return count


@numba.njit(cache=True, nogil=True)
def _quadratic(t: float, weight: Array) -> None:
    """Weights (3,) of a quadratic B-spline at the knots -1, 0, 1 for a place between -0.5 and 0.5."""
    weight[0], weight[1], weight[2] = 0.5 * (0.5 - t) ** 2, 0.75 - t * t, 0.5 * (0.5 + t) ** 2


@numba.njit(cache=True, nogil=True)
def _b2(t: float) -> float:
    """The quadratic B-spline."""
    t = abs(t)
    if t < 0.5:
        return 0.75 - t * t
    return 0.5 * (1.5 - t) ** 2 if t < 1.5 else 0.0


@numba.njit(cache=True, nogil=True)
def _b3(t: float) -> float:
    """The cubic B-spline."""
    t = abs(t)
    if t < 1.0:
        return 2.0 / 3.0 - t * t + 0.5 * t * t * t
    return (2.0 - t) ** 3 / 6.0 if t < 2.0 else 0.0


@numba.njit(cache=True, nogil=True)
def _is_near(around: Ids, b: int, low: int, high: int) -> bool:
    """Whether a brick or one of those around it is among some."""
    is_near = False
    for k in range(27):
        is_near |= low <= around[b, k] < high
    return is_near


@numba.njit(cache=True, nogil=True)
def _add_window(window: Array, start: int, around: Ids, b: int, values: Values, low: int, high: int) -> None:
    """Add a window (K, K, K) of nodes, its first at ``start`` in all three directions, to those values (high - low, 64)
    of a brick and of those around it that are among some."""
    for z in range(window.shape[0]):
        for y in range(window.shape[1]):
            for x in range(window.shape[2]):
                if window[z, y, x] != 0.0:
                    u, v, w = x + start + 4, y + start + 4, z + start + 4
                    other = around[b, (u >> 2) + 3 * (v >> 2) + 9 * (w >> 2)]
                    if low <= other < high:
                        values[other - low, (u & 3) + 4 * (v & 3) + 16 * (w & 3)] += np.float32(window[z, y, x])


@numba.njit(cache=True, nogil=True)
def add_divergence(
    points: Points, flux: Points, level_of: NDArray[np.int8], codes: Codes, first: Codes, level: int, at: Codes,
    around: Ids, divergence: Values, low: int, high: int,
) -> None:  # fmt: skip
    """Add the divergence, summed over a cell, of the samples' areas times normals, ``flux`` (N, 3), in finest cells.

    The step of a surface, smoothed by a quadratic B-spline along each axis, differs between two nodes of an edge by
    what its normals are along the edge, smoothed by a cubic one there and by quadratic ones across: exactly so,
    wherever the nodes are. Samples of the next coarser level have their kernel twice as wide, from the middles of the
    edges; those of still coarser ones are left out: their own level has told of them.
    """
    scale, window, place = 1.0 / (1 << level), np.empty((12, 12, 12)), np.empty(3, np.int64)
    weight, step, begin, vector = np.empty((3, 8)), np.empty((3, 8)), np.empty(3, np.int64), np.empty(3)
    mine = divergence[low:high]
    for b in range(codes.shape[0]):
        if at[b] < 0 or not _is_near(around, at[b], low, high):
            continue
        place_of(codes[b], place)
        is_used = False
        for i in range(first[b], first[b + 1]):
            if level_of[i] > level + 1:
                continue
            if not is_used:
                is_used = True
                window[:, :, :] = 0.0
            is_wide = level_of[i] > level
            num = 8 if is_wide else 5
            for axis in range(3):
                t = points[i, axis] * scale - 4 * place[axis]
                start = np.int64(np.floor(t)) - 3 if is_wide else np.int64(np.floor(t + 0.5)) - 2
                begin[axis], vector[axis] = start + 4, flux[i, axis] * scale * scale
                for j in range(num):
                    x = start + j - t
                    if is_wide:
                        weight[axis, j] = 0.5 * _b2(0.5 * x)
                        step[axis, j] = 0.5 * (_b2(0.5 * x + 0.25) - _b2(0.5 * x - 0.25))
                    else:
                        weight[axis, j] = _b2(x)
                        step[axis, j] = _b3(x + 0.5) - _b3(x - 0.5)
            # what a wide kernel has beyond the bricks around is nothing but its last corner
            for z in range(min(num, 12 - begin[2])):
                for y in range(min(num, 12 - begin[1])):
                    along = vector[0] * weight[1, y] * weight[2, z]
                    across = vector[1] * step[1, y] * weight[2, z] + vector[2] * weight[1, y] * step[2, z]
                    for x in range(min(num, 12 - begin[0])):
                        window[begin[2] + z, begin[1] + y, begin[0] + x] += along * step[0, x] + across * weight[0, x]
        if is_used:
            _add_window(window, -4, around, at[b], mine, low, high)


@numba.njit(cache=True, nogil=True)
def prolong(codes: Codes, parent: Ids, above: Ids, coarse: Values, values: Values) -> None:
    """Values of a level between those of the coarser one, linear along each axis; ``above`` is what is around there."""
    window = np.empty((3, 3, 3))
    for b in range(codes.shape[0]):
        u, v, w = 2 * (codes[b] & 1), 2 * (codes[b] >> 1 & 1), 2 * (codes[b] >> 2 & 1)
        for z in range(3):
            for y in range(3):
                for x in range(3):
                    other = above[parent[b], (u + x + 4 >> 2) + 3 * (v + y + 4 >> 2) + 9 * (w + z + 4 >> 2)]
                    at = (u + x & 3) + 4 * (v + y & 3) + 16 * (w + z & 3)
                    window[z, y, x] = coarse[other, at] if other >= 0 else 0.0
        for n in range(64):
            x, y, z, total = n & 3, n >> 2 & 3, n >> 4, 0.0
            for k in range(8):
                total += window[(z >> 1) + (k >> 2 & z & 1), (y >> 1) + (k >> 1 & y & 1), (x >> 1) + (k & x & 1)]
            values[b, n] = np.float32(0.125 * total)


@numba.njit(cache=True, nogil=True)
def _free_corners(b: int, is_leaf: Flags, around: Ids, place: Codes) -> int:
    """Bit m: whether all cells around the nodes of a leaf brick that lie on its lower sides m are of leaf bricks."""
    is_there, free = 0, 0
    for k in range(8):
        x, y, z = -(k & 1), -(k >> 1 & 1), -(k >> 2)
        other = around[b, (x + 1) + 3 * (y + 1) + 9 * (z + 1)]
        is_beyond = place[0] + x < 0 or place[1] + y < 0 or place[2] + z < 0
        if is_beyond or (other >= 0 and is_leaf[other]):
            is_there |= 1 << k
    for m in range(8):
        is_free = True
        for k in range(8):
            if k & m == k and not is_there >> k & 1:
                is_free = False
        free |= int(is_free) << m
    return free


@numba.njit(cache=True, nogil=True)
def relax(
    codes: Codes, is_leaf: Flags, is_whole: np.bool_, around: Ids, num: int, colour: int, omega: float,
    divergence: Values, values: Values, low: int, high: int,
) -> None:  # fmt: skip
    """Half a sweep of successive over-relaxation, over the nodes of one colour of a chessboard.

    Nodes at the border of what the level answers for keep what the coarser level says. Of the level that answers for
    the whole box nothing flows through the sides.
    """
    window, place = np.empty((6, 6, 6)), np.empty(3, np.int64)
    for b in range(low, high):
        place_of(codes[b], place)
        is_last = 4 * place[0] >= num or 4 * place[1] >= num or 4 * place[2] >= num
        # the last bricks have nothing but nodes on the sides of the box
        if not (is_leaf[b] or (is_last and is_whole)):
            continue
        free = 255 if is_last else _free_corners(b, is_leaf, around, place)
        is_inside = min(place[0], place[1], place[2]) > 0 and 4 * max(place[0], place[1], place[2]) + 4 < num
        load_window(values, around, b, window, 0.0)
        for z in range(4):
            for y in range(4):
                for x in range((colour + y + z) & 1, 4, 2):
                    if not free >> (np.int64(x == 0) | np.int64(y == 0) << 1 | np.int64(z == 0) << 2) & 1:
                        continue
                    total = -np.float64(divergence[b, x + 4 * y + 16 * z])
                    here = window[z + 1, y + 1, x + 1]
                    if is_inside:
                        total += window[z + 1, y + 1, x] + window[z + 1, y + 1, x + 2] + window[z + 1, y, x + 1]
                        total += window[z + 1, y + 2, x + 1] + window[z, y + 1, x + 1] + window[z + 2, y + 1, x + 1]
                    else:
                        u, v, w = 4 * place[0] + x, 4 * place[1] + y, 4 * place[2] + z
                        if u > num or v > num or w > num:
                            continue
                        # a node beyond a side is taken for the one on it: no difference, no flow
                        total += window[z + 1, y + 1, x] if u > 0 else here
                        total += window[z + 1, y + 1, x + 2] if u < num else here
                        total += window[z + 1, y, x + 1] if v > 0 else here
                        total += window[z + 1, y + 2, x + 1] if v < num else here
                        total += window[z, y + 1, x + 1] if w > 0 else here
                        total += window[z + 2, y + 1, x + 1] if w < num else here
                    values[b, x + 4 * y + 16 * z] = np.float32(here + omega * (total / 6.0 - here))


@numba.njit(cache=True, nogil=True)
def _cubic(t: float, weight: Array) -> None:
    """Weights (4,) of the cubic through nodes at -1, 0, 1, 2 for a place between 0 and 1."""
    weight[0], weight[1] = -t * (t - 1.0) * (t - 2.0) / 6.0, (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0
    weight[2], weight[3] = -(t + 1.0) * t * (t - 2.0) / 2.0, (t + 1.0) * t * (t - 1.0) / 6.0


@numba.njit(cache=True, nogil=True)
def evaluate(
    points: Points, chosen: Flags, codes: Codes, first: Codes, level: int, at: Codes, around: Ids, values: Values,
    found: Values, low: int, high: int,
) -> None:  # fmt: skip
    """Write (N,) the values at samples that are chosen, by cubics along each axis."""
    scale, window, place = 1.0 / (1 << level), np.empty((7, 7, 7)), np.empty(3, np.int64)
    weight, cell = np.empty((3, 4)), np.empty(3, np.int64)
    for b in range(low, high):
        if at[b] < 0:
            continue
        place_of(codes[b], place)
        is_loaded = False
        for i in range(first[b], first[b + 1]):
            if not chosen[i]:
                continue
            if not is_loaded:
                is_loaded = True
                load_window(values, around, at[b], window, 0.0)
            for axis in range(3):
                t = points[i, axis] * scale - 4 * place[axis]
                cell[axis] = min(max(int(t), 0), 3)
                _cubic(t - cell[axis], weight[axis])
            total = 0.0
            for z in range(4):
                for y in range(4):
                    row = 0.0
                    for x in range(4):
                        row += weight[0, x] * window[cell[2] + z, cell[1] + y, cell[0] + x]
                    total += weight[1, y] * weight[2, z] * row
            found[i] = np.float32(total)


@numba.njit(cache=True, nogil=True)
def add_samples(
    points: Points, told: Values, chosen: Flags, codes: Codes, first: Codes, level: int, at: Codes, around: Ids,
    total: Values, count: Values, low: int, high: int,
) -> None:  # fmt: skip
    """Add what samples tell (N,) to the nodes (high - low, 64) around those that are chosen, by quadratic B-splines.

    And how many tell it.
    """
    scale, sums, counts = 1.0 / (1 << level), np.empty((7, 7, 7)), np.empty((7, 7, 7))
    place, node, weight = np.empty(3, np.int64), np.empty(3, np.int64), np.empty((3, 3))
    for b in range(codes.shape[0]):
        if at[b] < 0 or not _is_near(around, at[b], low, high):
            continue
        place_of(codes[b], place)
        is_used = False
        for i in range(first[b], first[b + 1]):
            if not chosen[i]:
                continue
            if not is_used:
                is_used = True
                sums[:, :, :] = 0.0
                counts[:, :, :] = 0.0
            for axis in range(3):
                t = points[i, axis] * scale - 4 * place[axis]
                node[axis] = np.int64(np.floor(t + 0.5))
                _quadratic(t - node[axis], weight[axis])
            for z in range(3):
                for y in range(3):
                    for x in range(3):
                        share = weight[0, x] * weight[1, y] * weight[2, z]
                        counts[node[2] + z, node[1] + y, node[0] + x] += share
                        sums[node[2] + z, node[1] + y, node[0] + x] += share * told[i]
        if is_used:
            _add_window(sums, -1, around, at[b], total, low, high)
            _add_window(counts, -1, around, at[b], count, low, high)


@numba.njit(cache=True, nogil=True)
def take_away(
    codes: Codes, is_leaf: Flags, is_whole: np.bool_, around: Ids, total: Values, count: Values, doubt: float,
    values: Values, low: int, high: int,
) -> None:  # fmt: skip
    """Take from values what samples tell on average, as if ``doubt`` more had told that nothing is to be taken.

    The coarser level has the say at the border of what the level answers for: what is on its other side is not ours.
    """
    place = np.empty(3, np.int64)
    for b in range(low, high):
        if not (is_leaf[b] or is_whole):
            continue
        place_of(codes[b], place)
        free = 255 if is_whole else _free_corners(b, is_leaf, around, place)
        for n in range(64):
            at_sides = np.int64(n & 3 == 0) | np.int64(n >> 2 & 3 == 0) << 1 | np.int64(n >> 4 == 0) << 2
            if count[b - low, n] > 0.0 and free >> at_sides & 1:
                values[b, n] -= np.float32(total[b - low, n] / (count[b - low, n] + doubt))
