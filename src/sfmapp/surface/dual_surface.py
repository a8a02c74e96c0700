"""The surface where values at the nodes of a hierarchy of grids are nought: a vertex in each cell, a quad at each edge.

Dual marching cubes (Nielson, 2004) over the leaves of an octree (Ju et al., "Dual contouring of Hermite data", 2002):
each part of the surface in a cell has a vertex amid its crossings of the cell's edges, and around each edge that has no
finer cell beside it, and whose ends differ in sign, the vertices of the cells that meet there are joined. A node that a
finer level has on a face of a coarser cell has the value that is linear between the cell's corners, so that both see
the same crossings, and every edge of the mesh has an even number of triangles, two wherever no two sheets meet in a
vertex.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, partial
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Events
from sfmapp.geometry.cube_cases import EDGES, surface_loops
from sfmapp.surface.bricks import Codes, Flags, Ids, Level, Values, in_parts, load_window, place_of

Array = NDArray[np.float64]


class _Table(NamedTuple):
    """Parts of the surface in a cube.

    Attributes:
        num: (256,) parts in each case.
        part: (256, 8, 3) the part that crosses the edge from a corner along an axis, -1 for none.
    """

    num: NDArray[np.int8]
    part: NDArray[np.int8]


class _Cells(NamedTuple):
    """Vertices of the cells of a level's B bricks.

    Attributes:
        codes, is_leaf, around, child: as in :class:`~sfmapp.surface.bricks.Level`.
        is_simple: (B,) whether each cell has one vertex, whatever its parts: beside finer ones.
        values: (B, 64) of the nodes.
        begin: (B,) number of the first vertex of each brick.
        vertex: (B, 64) of each cell the first vertex, counted from there, -1 for none.
    """

    codes: Codes
    is_leaf: Flags
    around: Ids
    child: Ids
    is_simple: Flags
    values: Values
    begin: Codes
    vertex: NDArray[np.int16]


@cache
def _table() -> _Table:
    num, part = np.zeros(256, np.int8), np.full((256, 8, 3), -1, np.int8)
    for case in range(256):
        loops = surface_loops(case)
        num[case] = len(loops)
        for n, loop in enumerate(loops):
            for edge in loop:
                part[case, *EDGES[edge]] = n
    return _Table(num, part)


def dual_surface(
    levels: Sequence[Level], values: Sequence[Values], events: Events | None = None, threads: int = 1
) -> tuple[Array, Ids]:  # fmt: skip
    """The surface between negative and other values.

    Args:
        levels: the grids, finest first.
        values: (B, 64) of the nodes of each.
        threads: that share the bricks; the surface does not depend on their number.

    Returns:
        Vertices (V, 3) in finest cells from the box's lowest corner on, and triangles (F, 3), anticlockwise as seen
        from where values are not negative. The surface is open where it leaves the box.
    """
    events, table, total = events or Events(), _table(), 0
    cells: list[_Cells] = []
    for level, mine in zip(levels, values, strict=True):
        events.raise_if_cancelled()
        vertex, counts = np.full((len(level.codes), 64), -1, np.int16), np.zeros(len(level.codes), np.int64)
        is_simple = np.zeros(len(level.codes), np.bool_)
        _find_simple(level.around, level.child, is_simple)
        number = partial(
            _number_vertices, level.is_leaf, level.around, level.child, is_simple, mine, table.num, counts, vertex
        )
        in_parts(number, len(counts), threads)
        begin = total + np.concatenate([[0], np.cumsum(counts)])
        total = int(begin[-1])
        cells.append(
            _Cells(level.codes, level.is_leaf, level.around, level.child, is_simple, mine, begin[:-1], vertex)
        )  # fmt: skip
    xyz, found = np.empty((total, 3)), []
    for n, (level, here) in enumerate(zip(levels, cells, strict=True)):
        events.raise_if_cancelled()
        in_parts(partial(_place_vertices, here, table, float(1 << n), xyz), len(here.codes), threads)
        above = cells[min(n + 1, len(cells) - 1)]
        joined = (here, level.parent, above, np.bool_(n + 1 < len(cells)), level.num, table)
        begin = np.zeros(len(here.codes) + 1, np.int64)
        in_parts(partial(_join_vertices, *joined, begin, np.empty((0, 4), np.int32)), len(here.codes), threads)
        np.cumsum(begin, out=begin)
        quads = np.empty((int(begin[-1]), 4), np.int32)
        in_parts(partial(_join_vertices, *joined, begin, quads), len(here.codes), threads)
        found.append(quads)
    del cells
    quads = np.concatenate(found)
    faces = np.empty((2 * len(quads), 3), np.int32)
    return xyz, faces[: _cut(quads, xyz, faces)].copy()


@numba.njit(cache=True, nogil=True)
def _find_simple(around: Ids, child: Ids, is_simple: Flags) -> None:
    """Mark bricks (B,) that have finer ones in them or beside them."""
    for b in range(around.shape[0]):
        for k in range(27):
            if around[b, k] >= 0:
                for c in range(8):
                    if child[around[b, k], c] >= 0:
                        is_simple[b] = True


@numba.njit(cache=True, nogil=True)
def _case_of(window: Array, x: int, y: int, z: int) -> int:
    """Bit k: whether corner k of a cell is negative."""
    case = 0
    for k in range(8):
        case |= int(window[z + 1 + (k >> 2), y + 1 + (k >> 1 & 1), x + 1 + (k & 1)] < 0.0) << k
    return case


@numba.njit(cache=True, nogil=True)
def _number_vertices(
    is_leaf: Flags, around: Ids, child: Ids, is_simple: Flags, values: Values, num: NDArray[np.int8], counts: Codes,
    vertex: NDArray[np.int16], low: int, high: int,
) -> None:  # fmt: skip
    """Number the vertices of each brick from one to before another, as in :class:`_Cells`, and count them (B,)."""
    window = np.empty((7, 7, 7))
    for b in range(low, high):
        if not is_leaf[b]:
            continue
        load_window(values, around, b, window, np.nan)
        total = 0
        for n in range(64):
            x, y, z = n & 3, n >> 2 & 3, n >> 4
            case = _case_of(window, x, y, z)
            if case in (0, 255) or child[b, (x >> 1) | (y >> 1) << 1 | (z >> 1) << 2] >= 0:
                continue
            vertex[b, n] = total
            total += 1 if is_simple[b] else num[case]
        counts[b] = total


@numba.njit(cache=True, nogil=True)
def _crossing(before: float, start: float, end: float, after: float) -> float:
    """Where between the second (0) and the third (1) of four equidistant values their cubic is nought."""
    t = start / (start - end)
    if np.isnan(before) or np.isnan(after):
        return t
    low, high = 0.0, 1.0
    # of steps without a jump; Newton's method within a bracket, which is there as the signs differ
    for _ in range(4):
        value = (
            (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0 * start - t * (t - 1.0) * (t - 2.0) / 6.0 * before
            - (t + 1.0) * t * (t - 2.0) / 2.0 * end + (t + 1.0) * t * (t - 1.0) / 6.0 * after
        )  # fmt: skip
        slope = (
            (3.0 * t * t - 4.0 * t - 1.0) / 2.0 * start - (3.0 * t * t - 6.0 * t + 2.0) / 6.0 * before
            - (3.0 * t * t - 2.0 * t - 2.0) / 2.0 * end + (3.0 * t * t - 1.0) / 6.0 * after
        )  # fmt: skip
        if (value < 0.0) == (start < 0.0):
            low = t
        else:
            high = t
        t = t - value / slope if slope != 0.0 else low
        if not low <= t <= high:
            t = 0.5 * (low + high)
    return t


@numba.njit(cache=True, nogil=True)
def _place_vertices(cells: _Cells, table: _Table, scale: float, xyz: Array, low: int, high: int) -> None:
    """Write the places of the vertices of bricks from one to before another, each amid its crossings."""
    window, place = np.empty((7, 7, 7)), np.empty(3, np.int64)
    total, count, at = np.empty((4, 3)), np.empty(4, np.int64), np.empty(3, np.int64)
    for b in range(low, high):
        if not cells.is_leaf[b] or cells.vertex[b].max() < 0:
            continue
        place_of(cells.codes[b], place)
        load_window(cells.values, cells.around, b, window, np.nan)
        for n in range(64):
            first = cells.vertex[b, n]
            if first < 0:
                continue
            x, y, z = n & 3, n >> 2 & 3, n >> 4
            case = _case_of(window, x, y, z)
            total[:, :] = 0.0
            count[:] = 0
            for axis in range(3):
                dx, dy, dz = int(axis == 0), int(axis == 1), int(axis == 2)
                for k in range(8):
                    part = table.part[case, k, axis]
                    if k >> axis & 1 or part < 0:
                        continue
                    if cells.is_simple[b]:
                        part = 0
                    at[0], at[1], at[2] = x + (k & 1), y + (k >> 1 & 1), z + (k >> 2)
                    u, v, w = at[0] + 1, at[1] + 1, at[2] + 1
                    share = _crossing(
                        window[w - dz, v - dy, u - dx], window[w, v, u], window[w + dz, v + dy, u + dx],
                        window[w + 2 * dz, v + 2 * dy, u + 2 * dx],
                    )  # fmt: skip
                    for j in range(3):
                        total[part, j] += at[j]
                    total[part, axis] += share
                    count[part] += 1
            for part in range(1 if cells.is_simple[b] else table.num[case]):
                for j in range(3):
                    xyz[cells.begin[b] + first + part, j] = (4 * place[j] + total[part, j] / count[part]) * scale


@numba.njit(cache=True, nogil=True)
def _case_at(cells: _Cells, b: int, x: int, y: int, z: int) -> int:
    """The same as :func:`_case_of`, of a cell in a brick or beside it."""
    case = 0
    for k in range(8):
        u, v, w = x + (k & 1), y + (k >> 1 & 1), z + (k >> 2)
        other = cells.around[b, (u + 4 >> 2) + 3 * (v + 4 >> 2) + 9 * (w + 4 >> 2)]
        case |= int(cells.values[other, (u & 3) + 4 * (v & 3) + 16 * (w & 3)] < 0.0) << k
    return case


@numba.njit(cache=True, nogil=True)
def _coarse_vertex(parent: int, corner: Codes, place: Codes, above: _Cells) -> int:
    """The vertex of the coarser leaf that has a cell of this level, -1 where none has."""
    x, y, z = corner[0] >> 1, corner[1] >> 1, corner[2] >> 1
    u, v, w = (x >> 2) - (place[0] >> 1) + 1, (y >> 2) - (place[1] >> 1) + 1, (z >> 2) - (place[2] >> 1) + 1
    other = above.around[parent, u + 3 * v + 9 * w]
    if other < 0 or not above.is_leaf[other]:
        return -1
    first = above.vertex[other, (x & 3) + 4 * (y & 3) + 16 * (z & 3)]
    return int(-1 if first < 0 else above.begin[other] + first)


@numba.njit(cache=True, nogil=True)
def _vertices_around(
    cells: _Cells, parent: Ids, above: _Cells, has_above: np.bool_, num: int, table: _Table, b: int, n: int, axis: int,
    place: Codes, corner: Codes, found: Codes,
) -> bool:  # fmt: skip
    """Write the vertices (4,) of the cells around an edge, anticlockwise as seen from its end.

    False where it is not for this level to join them: beside a finer cell, at a side of the box, or between coarser
    cells only.
    """
    is_mine = False
    for j in range(4):
        x, y, z, bits = n & 3, n >> 2 & 3, n >> 4, 0
        for side in range(1, 3):
            # 0, 0; -1, 0; -1, -1; 0, -1 along the next two axes
            if (side == 1 and j in (1, 2)) or (side == 2 and j >= 2):
                other_axis = (axis + side) % 3
                x, y, z = x - int(other_axis == 0), y - int(other_axis == 1), z - int(other_axis == 2)
                bits |= 1 << other_axis
        corner[0], corner[1], corner[2] = 4 * place[0] + x, 4 * place[1] + y, 4 * place[2] + z
        if min(corner[0], corner[1], corner[2]) < 0 or max(corner[0], corner[1], corner[2]) >= num:
            return False
        other = cells.around[b, (x + 4 >> 2) + 3 * (y + 4 >> 2) + 9 * (z + 4 >> 2)]
        if other < 0 or not cells.is_leaf[other]:
            found[j] = _coarse_vertex(parent[b], corner, place, above) if has_above else -1
            if found[j] < 0:
                return False
            continue
        if cells.child[other, (x & 3) >> 1 | (y & 3) >> 1 << 1 | (z & 3) >> 1 << 2] >= 0:
            return False
        is_mine = True
        found[j] = cells.begin[other] + cells.vertex[other, (x & 3) + 4 * (y & 3) + 16 * (z & 3)]
        if not cells.is_simple[other]:
            # the edge begins in that corner of the cell from which the cell lies back
            found[j] += table.part[_case_at(cells, b, x, y, z), bits, axis]
    return is_mine


@numba.njit(cache=True, nogil=True)
def _join_vertices(
    cells: _Cells, parent: Ids, above: _Cells, has_above: np.bool_, num: int, table: _Table, begin: Codes, quads: Ids,
    low: int, high: int,
) -> None:  # fmt: skip
    """Write vertices of quads (Q, 4) of bricks from one to before another, -1 for the last of a triangle.

    Where those of each brick begin (B + 1,) is given or, if there is no room for any, their number is noted behind it.
    """
    place, corner, found = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(4, np.int64)
    for b in range(low, high):
        count = begin[b] if quads.shape[0] else 0
        place_of(cells.codes[b], place)
        for n in range(64):
            start = cells.values[b, n] < 0.0
            for axis in range(3):
                x, y, z = (
                    (n & 3) + int(axis == 0),
                    (n >> 2 & 3) + int(axis == 1),
                    (n >> 4) + int(axis == 2),
                )
                other = cells.around[b, (x + 4 >> 2) + 3 * (y + 4 >> 2) + 9 * (z + 4 >> 2)]
                if other < 0 or (cells.values[other, (x & 3) + 4 * (y & 3) + 16 * (z & 3)] < 0.0) == start:
                    continue
                if not _vertices_around(
                    cells, parent, above, has_above, num, table, b, n, axis, place, corner, found
                ):  # fmt: skip
                    continue
                # two cells of this level can lie in one coarser one: its vertex counts once
                num_found = 0
                for j in range(4):
                    if found[j] != found[j - 1]:
                        if quads.shape[0]:
                            quads[count, num_found] = found[j]
                        num_found += 1
                if num_found < 3:
                    continue
                if quads.shape[0]:
                    if num_found == 3:
                        quads[count, 3] = -1
                    if not start:
                        quads[count, 0], quads[count, 2] = quads[count, 2], quads[count, 0]
                count += 1
        if not quads.shape[0]:
            begin[b + 1] = count


@numba.njit(cache=True, nogil=True)
def _cut(quads: Ids, xyz: Array, faces: Ids) -> int:
    """Cut quads along their shorter diagonal into triangles; how many these are."""
    count = 0
    for q in range(quads.shape[0]):
        a, b, c, d = quads[q, 0], quads[q, 1], quads[q, 2], quads[q, 3]
        if d < 0:
            faces[count, 0], faces[count, 1], faces[count, 2] = a, b, c
            count += 1
            continue
        first, second = 0.0, 0.0
        for j in range(3):
            first += (xyz[a, j] - xyz[c, j]) ** 2
            second += (xyz[b, j] - xyz[d, j]) ** 2
        if first > second:
            a, b, c, d = b, c, d, a
        faces[count, 0], faces[count, 1], faces[count, 2] = a, b, c
        faces[count + 1, 0], faces[count + 1, 1], faces[count + 1, 2] = a, c, d
        count += 2
    return count
