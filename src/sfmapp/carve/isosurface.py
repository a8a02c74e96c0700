"""The surface of an octree: marching cubes over its finest cells, on signed distances at their corners.

Each vertex lies on an edge of a cell where the distance changes its sign, each such edge has the four cells around it,
and each cell joins the vertices on its faces by one rule that both cells at a face share: the mesh is closed, every
edge has two triangles and every vertex one fan of them (Lorensen and Cline, 1987, with faces that have two ways always
cut so that the inside is apart; Nielson and Hamann, 1991).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.octree import Codes, Octree, codes_of, places_of
from sfmapp.events import Events
from sfmapp.geometry.cube_cases import EDGES, cube_faces, surface_loops
from sfmapp.geometry.morton import gather_bits
from sfmapp.scene.mesh import Mesh, vertex_normals

Array = NDArray[np.float64]
Ids = NDArray[np.int32]
Places = NDArray[np.int32]
# signed distances (N,) of points (N, 3), positive inside, units of the world
Distance = Callable[[Array], Array]
# outward unit normals (N, 3) of points (N, 3) on the surface; zero where it has none
Normals = Callable[[Array], NDArray[np.float32]]

STAGE = "surface"
# where nothing tells a colour
GREY = 200
# vertices are kept this far from the ends of their edges, as a share of these: triangles have an area, and no vertex
# is farther off than a fiftieth of a cell
_APART = 0.02
# distances are cut off at so many cells: a jump at the border of a picture must not draw a vertex to the far side
_REACH = 2.0
# cells that are looked at together, and vertices whose normals are asked for together
_CELLS, _POINTS = 1 << 17, 1 << 19


def surface_of(tree: Octree, distance: Distance, normals: Normals | None = None, events: Events | None = None) -> Mesh:
    """The closed surface of an octree, where a signed distance is zero.

    Cells are walked twice in slabs of layers, and what is kept of them is little more than the mesh itself.

    Args:
        tree: cells beyond those of its surface are looked at only where the distance changes its sign at their border,
            so that the mesh closes whatever ``distance`` says. It closes at the faces of the cube as well.
        distance: of the solid, such as :meth:`sfmapp.carve.hull.Hull.distance`.
        normals: of the solid; by default those of the triangles.

    Returns:
        A mesh whose edges have two triangles each, anticlockwise as seen from outside, in grey.
    """
    events = events or Events()
    codes = _distinct(np.concatenate([tree.surface, _cells_at_faces(tree)]))
    while True:
        places = _places_in_layers(codes, 2**tree.depth)
        values, around, num_faces = _look_at_corners(tree, places, distance, events)
        missing = _missing_cells(tree, codes, places, around)
        if not len(missing):
            break
        codes = _distinct(np.concatenate([codes, missing]))
    num_vertices = int(np.count_nonzero(around))
    del codes, around
    points, faces = _mesh_of_cells(tree, places, values, num_vertices, num_faces)
    del places, values
    found = vertex_normals(points, faces)
    if normals is not None:
        for first in range(0, len(points), _POINTS):
            own = found[first : first + _POINTS]
            told = normals(points[first : first + _POINTS])
            # a cone that is seen from within at a crease has no say
            agrees = (told * own).sum(axis=1) > 0.0
            own[agrees] = told[agrees]
    events.finished(STAGE, f"{len(faces)} triangles")
    return Mesh(points, faces, found, np.full((len(points), 3), GREY, np.uint8))


def _distinct(codes: Codes) -> Codes:
    """Codes (N,) in ascending order, each once."""
    codes = np.sort(codes)
    return codes[np.concatenate([[True], codes[1:] != codes[:-1]])] if len(codes) else codes


@numba.njit(cache=True, nogil=True)
def _by_layers(codes: Codes, ends: Ids, places: Places) -> None:
    """Places (N, 3) of cells by z and, within a layer, by code; ``ends`` (n + 1,): noughts."""
    for code in codes:
        ends[gather_bits(code >> np.uint64(2)) + np.uint64(1)] += 1
    for z in range(1, ends.shape[0]):
        ends[z] += ends[z - 1]
    for code in codes:
        layer = gather_bits(code >> np.uint64(2))
        at = ends[layer]
        places[at, 0], places[at, 1], places[at, 2] = gather_bits(code), gather_bits(code >> np.uint64(1)), layer
        ends[layer] += 1


def _places_in_layers(codes: Codes, num: int) -> Places:
    """Places (N, 3) of cells, ``num`` along each side, whose codes ascend: by z and, within a layer, by code."""
    places = np.empty((len(codes), 3), np.int32)
    _by_layers(codes, np.zeros(num + 1, np.int32), places)
    return places


def _cells_at_faces(tree: Octree) -> Codes:
    """Finest cells that lie at the faces of the cube in cells that are full: there the mesh has to be closed."""
    found = [np.empty(0, np.uint64)]
    for level, codes in enumerate(tree.full):
        if not len(codes):
            continue
        places, size = places_of(codes), 1 << (tree.depth - level)
        grid = np.stack(np.meshgrid(np.arange(size), np.arange(size), indexing="ij"), axis=-1).reshape(-1, 2)
        for axis in range(3):
            for end, offset in ((0, 0), (2**level - 1, size - 1)):
                for place in places[places[:, axis] == end]:
                    cells = np.insert(grid, axis, offset, axis=1) + place * size
                    found.append(codes_of(cells))
    return np.concatenate(found)


class _Slab(NamedTuple):
    """Cells of some layers.

    Attributes:
        places: (N, 3). corners: (N, 8) their numbers, in the order in which corners are met.
        first: number of the first that no cell before has. lattice: (M, 3) places of those from there on.
    """

    places: Places
    corners: Ids
    first: int
    lattice: Places


def _slabs(places: Places, num: int) -> Iterator[_Slab]:
    """Cells (N, 3) in layers, so many of these together that their number is worth a call."""
    planes = np.full((2, num + 1, num + 1), -1, np.int32)
    begin, first = 0, 0
    while begin < len(places):
        last = places[min(begin + _CELLS, len(places)) - 1, 2]
        end = int(np.searchsorted(places[:, 2], last, side="right"))
        corners = np.empty((end - begin, 8), np.int32)
        lattice = np.empty((8 * len(corners), 3), np.int32)
        met = _sweep(places, begin, end, planes, corners, first, lattice)
        yield _Slab(places[begin:end], corners, first, lattice[: met - first])
        begin, first = end, met


@numba.njit(cache=True, nogil=True)
def _forget(planes: NDArray[np.int32], z: int, places: Places, begin: int, end: int) -> None:
    """Take the corners of cells out of the plane of corners at a height."""
    for i in range(begin, end):
        for k in range(4):
            planes[z & 1, places[i, 1] + (k >> 1), places[i, 0] + (k & 1)] = -1


@numba.njit(cache=True, nogil=True)
def _sweep(
    places: Places, start: int, stop: int, planes: NDArray[np.int32], corners: Ids, first: int, lattice: Places
) -> int:
    """Fill corners and places for the layers of some cells, with a map of two planes of corners in which those of the
    layer before are still there; how many corners there are with them."""
    num, total, begin = places.shape[0], first, start
    while begin < stop:
        z, end = places[begin, 2], begin
        while end < num and places[end, 2] == z:
            end += 1
        for i in range(begin, end):
            for k in range(8):
                x, y, up = places[i, 0] + (k & 1), places[i, 1] + (k >> 1 & 1), k >> 2
                at = planes[(z + up) & 1, y, x]
                if at < 0:
                    at = total
                    planes[(z + up) & 1, y, x] = at
                    lattice[at - first, 0], lattice[at - first, 1], lattice[at - first, 2] = x, y, z + up
                    total += 1
                corners[i - start, k] = at
        # the lower plane, met by this layer and by the one below, is taken for the plane above the next layer
        before = begin
        while before > 0 and places[before - 1, 2] == z - 1:
            before -= 1
        _forget(planes, z, places, before, end)
        if not (end < num and places[end, 2] == z + 1):
            _forget(planes, z + 1, places, begin, end)
        begin = end
    return total


def _look_at_corners(
    tree: Octree, places: Places, distance: Distance, events: Events
) -> tuple[NDArray[np.float32], NDArray[np.int8], int]:
    """Distances (M,) at the corners of cells; how many of these cells are around each edge (M, 3), by its first corner
    and its axis, where the sign changes, nought where it does not; and the number of triangles."""
    num, cell, total = 2**tree.depth, tree.cell, 0
    # of most cells half of the corners are another's: what is not touched takes no memory
    values, around = np.empty(8 * len(places), np.float32), np.zeros((8 * len(places), 3), np.int8)
    first = _table()[0]
    events.started(STAGE, f"{len(places)} cells at the surface", total=len(places))
    end = 0
    for slab in _slabs(places, num):
        found = np.clip(distance(tree.low + cell * slab.lattice), -_REACH * cell, _REACH * cell).astype(np.float32)
        found[((slab.lattice == 0) | (slab.lattice == num)).any(axis=1)] = -np.float32(cell)
        end = slab.first + len(found)
        values[slab.first : end] = found
        total += _count_cells(slab.corners, values, around, first)
        events.advanced(STAGE, len(slab.places))
        events.raise_if_cancelled()
    return values[:end], around[:end], total


@numba.njit(cache=True, nogil=True)
def _count_cells(corners: Ids, values: NDArray[np.float32], around: NDArray[np.int8], first: Ids) -> int:
    """Add up for each edge the cells around it if its sign changes; the number of triangles in the cells."""
    total = 0
    for i in range(corners.shape[0]):
        case = 0
        for k in range(8):
            case |= (values[corners[i, k]] > 0.0) << k
        total += first[case + 1] - first[case]
        for axis in range(3):
            for k in range(8):
                if not k >> axis & 1 and (case >> k & 1) != (case >> (k | 1 << axis) & 1):
                    around[corners[i, k], axis] += 1
    return total


def _missing_cells(tree: Octree, codes: Codes, places: Places, around: NDArray[np.int8]) -> Codes:
    """Codes of cells beside those at hand that have an edge on which the sign changes."""
    if not ((around > 0) & (around < 4)).any():
        return np.empty(0, np.uint64)
    found = []
    for slab in _slabs(places, 2**tree.depth):
        part = around[slab.first : slab.first + len(slab.lattice)]
        first, axis = np.nonzero((part > 0) & (part < 4))
        for a in range(3):
            at = slab.lattice[first[axis == a]]
            found += [codes_of(at - np.insert([i, j], a, 0)) for i in (0, 1) for j in (0, 1)]
    wanted = _distinct(np.concatenate(found))
    at_hand = codes[np.minimum(np.searchsorted(codes, wanted), len(codes) - 1)]
    return np.asarray(wanted[at_hand != wanted])


@numba.njit(cache=True, nogil=True)
def _fill(
    places: Places, corners: Ids, values: NDArray[np.float32], edges: Ids, table: Table, xyz: Array, faces: Ids,
    num_vertices: int, num_faces: int,
) -> tuple[int, int]:  # fmt: skip
    """Number edges (M, 3) on which the sign changes, in the order in which cells meet them, with the place on each in
    cells, and the triangles between them; how many vertices and triangles there are with those of cells before."""
    for i in range(corners.shape[0]):
        case = 0
        for k in range(8):
            case |= (values[corners[i, k]] > 0.0) << k
        for axis in range(3):
            for k in range(8):
                if k >> axis & 1 or (case >> k & 1) == (case >> (k | 1 << axis) & 1):
                    continue
                a, b = corners[i, k], corners[i, k | 1 << axis]
                if edges[a, axis] >= 0:
                    continue
                edges[a, axis] = num_vertices
                share = min(max(values[a] / (values[a] - values[b]), _APART), 1.0 - _APART)
                for j in range(3):
                    xyz[num_vertices, j] = places[i, j] + (k >> j & 1)
                xyz[num_vertices, axis] += share
                num_vertices += 1
        for t in range(table.first[case], table.first[case + 1]):
            for j in range(3):
                edge = table.triangles[t, j]
                faces[num_faces, j] = edges[corners[i, table.ends[edge, 0]], table.ends[edge, 1]]
            num_faces += 1
    return num_vertices, num_faces


def _mesh_of_cells(
    tree: Octree, places: Places, values: NDArray[np.float32], num_vertices: int, num_faces: int
) -> tuple[Array, Ids]:
    """Vertices (V, 3), world, and triangles (F, 3) of cells with distances (M,) at their corners."""
    edges = np.full((len(values), 3), -1, np.int32)
    xyz, faces = np.empty((num_vertices, 3)), np.empty((num_faces, 3), np.int32)
    done = 0, 0
    for slab in _slabs(places, 2**tree.depth):
        done = _fill(slab.places, slab.corners, values, edges, _table(), xyz, faces, *done)
    xyz *= tree.cell
    xyz += tree.low
    return xyz, faces


# --------------------------------------------------------------------------------- how a cell is cut, in all 256 cases


class Table(NamedTuple):
    """For each case, bit k for corner k inside, the triangles of its cell.

    Attributes:
        first: (257,) of each case in ``triangles`` (T, 3), which are edges.
        ends: (12, 2) first corner and axis of each edge.
    """

    first: Ids
    triangles: NDArray[np.int8]
    ends: NDArray[np.int8]


@cache
def _table() -> Table:
    first, triangles = [0], []
    for case in range(256):
        for loop in surface_loops(case):
            triangles += _cut_loop(loop)
        first.append(len(triangles))
    return Table(np.array(first, np.int32), np.array(triangles, np.int8).reshape(-1, 3), np.array(EDGES, np.int8))


def _share_face(a: int, b: int) -> bool:
    """Whether two edges lie in one face of the cell."""
    ends = [{corner, corner | 1 << axis} for corner, axis in (EDGES[a], EDGES[b])]
    return any(ends[0] | ends[1] <= set(face) for face in cube_faces())


def _cut_loop(loop: list[int]) -> list[tuple[int, int, int]]:
    """Triangles of a loop without a diagonal in a face, which the cell beyond it might draw as well."""
    if len(loop) == 3:
        return [(loop[0], loop[1], loop[2])]
    for k in range(len(loop)):
        before, ear, after = loop[k - 1], loop[k], loop[(k + 1) % len(loop)]
        if not _share_face(before, after):
            rest = [edge for edge in loop if edge != ear]
            cut = _cut_loop(rest)
            if cut:
                return [(before, ear, after), *cut]
    return []
