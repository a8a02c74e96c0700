"""The surface of an octree: marching cubes over its finest cells, on signed distances at their corners.

Each vertex lies on an edge of a cell where the distance changes its sign, each such edge has the four cells around it,
and each cell joins the vertices on its faces by one rule that both cells at a face share: the mesh is closed, every
edge has two triangles and every vertex one fan of them (Lorensen and Cline, 1987, with faces that have two ways always
cut so that the inside is apart; Nielson and Hamann, 1991).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.octree import Codes, Octree, codes_of, places_of
from sfmapp.events import Events
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
# Corner k of a cell is off by the bits of k along x, y and z. An edge is its first corner and its axis.
_EDGES = [(corner, axis) for axis in range(3) for corner in range(8) if not corner >> axis & 1]
# vertices are kept this far from the ends of their edges, as a share of these: triangles have an area, and no vertex
# is farther off than a fiftieth of a cell
_APART = 0.02
# distances are cut off at so many cells: a jump at the border of a picture must not draw a vertex to the far side
_REACH = 2.0


def surface_of(tree: Octree, distance: Distance, normals: Normals | None = None, events: Events | None = None) -> Mesh:
    """The closed surface of an octree, where a signed distance is zero.

    Args:
        tree: cells beyond those of its surface are looked at only where the distance changes its sign at their border,
            so that the mesh closes whatever ``distance`` says. It closes at the faces of the cube as well.
        distance: of the solid, such as :meth:`sfmapp.carve.hull.Hull.distance`.
        normals: of the solid; by default those of the triangles.

    Returns:
        A mesh whose edges have two triangles each, anticlockwise as seen from outside, in grey.
    """
    events = events or Events()
    events.started(STAGE, f"{len(tree.surface)} cells at the surface", total=2)
    places = _places_in_layers(np.concatenate([tree.surface, _cells_at_faces(tree)]))
    num, cell = 2**tree.depth, tree.cell
    values = np.empty(0, np.float32)
    while True:
        corners, lattice = _number_corners(places, num)
        values = np.clip(distance(tree.low + cell * lattice), -_REACH * cell, _REACH * cell).astype(np.float32)
        values[((lattice == 0) | (lattice == num)).any(axis=1)] = -np.float32(cell)
        missing = _missing_cells(places, corners, lattice, values)
        if not len(missing):
            break
        places = _places_in_layers(np.concatenate([codes_of(places), missing]))
    events.advanced(STAGE)
    vertex_of_edge, xyz = _vertices(corners, lattice, values)
    faces = _triangles(corners, values, vertex_of_edge, *_table())
    points = tree.low + cell * xyz
    found = vertex_normals(points, faces)
    if normals is not None and len(points):
        told = normals(points)
        # a cone that is seen from within at a crease has no say
        agrees = (told * found).sum(axis=1) > 0.0
        found = np.where(agrees[:, None], told, found)
    events.finished(STAGE, f"{len(faces)} triangles")
    return Mesh(points, faces, found, np.full((len(points), 3), GREY, np.uint8))


def _places_in_layers(codes: Codes) -> Places:
    """Places (N, 3) of cells without doubles, by z and, within a layer, by code."""
    places = places_of(np.unique(codes)).astype(np.int32)
    return places[np.argsort(places[:, 2], kind="stable")]


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


def _number_corners(places: Places, num: int) -> tuple[Ids, Places]:
    """Corners (N, 8) of cells as numbers, and the places (M, 3) of these, in the order in which they are met."""
    corners = np.empty((len(places), 8), np.int32)
    lattice = np.empty((8 * len(places), 3), np.int32)
    planes = np.full((2, num + 1, num + 1), -1, np.int32)
    total = _sweep(places, planes, corners, lattice)
    return corners, lattice[:total].copy()


@numba.njit(cache=True, nogil=True)
def _sweep(places: Places, planes: NDArray[np.int32], corners: Ids, lattice: Places) -> int:
    """Fill corners and places for cells in layers, with a map of two planes of corners; how many there are."""
    num, total, before, begin = places.shape[0], 0, 0, 0
    while begin < num:
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
                    lattice[at, 0], lattice[at, 1], lattice[at, 2] = x, y, z + up
                    total += 1
                corners[i, k] = at
        # the lower plane, met by this layer and by the one below, is taken for the plane above the next layer
        follows = end < num and places[end, 2] == z + 1
        for i in range(before, end):
            for k in range(4):
                planes[z & 1, places[i, 1] + (k >> 1), places[i, 0] + (k & 1)] = -1
                if not follows and i >= begin:
                    planes[(z + 1) & 1, places[i, 1] + (k >> 1), places[i, 0] + (k & 1)] = -1
        before, begin = (begin if follows else end), end
    return total


@numba.njit(cache=True, nogil=True)
def _count_cells(corners: Ids, values: NDArray[np.float32], cells: NDArray[np.int8]) -> None:
    """Add up for each edge (M, 3), by its first corner and its axis, the cells around it if its sign changes."""
    for i in range(corners.shape[0]):
        for axis in range(3):
            for k in range(8):
                if not k >> axis & 1:
                    a, b = corners[i, k], corners[i, k | 1 << axis]
                    if (values[a] > 0.0) != (values[b] > 0.0):
                        cells[a, axis] += 1


def _missing_cells(places: Places, corners: Ids, lattice: Places, values: NDArray[np.float32]) -> Codes:
    """Codes of cells beside those at hand that have an edge on which the sign changes."""
    cells = np.zeros((len(lattice), 3), np.int8)
    _count_cells(corners, values, cells)
    first, axis = np.nonzero((cells > 0) & (cells < 4))
    if not len(first):
        return np.empty(0, np.uint64)
    found = []
    for a in range(3):
        at = lattice[first[axis == a]]
        for i in (0, 1):
            for j in (0, 1):
                found.append(codes_of(at - np.insert([i, j], a, 0)))
    return np.setdiff1d(np.concatenate(found), codes_of(places))


@numba.njit(cache=True, nogil=True)
def _number_edges(corners: Ids, lattice: Places, values: NDArray[np.float32], edges: Ids, xyz: Array) -> int:
    """Number edges (M, 3) on which the sign changes, in the order in which cells meet them, with the place on each."""
    total = 0
    for i in range(corners.shape[0]):
        for axis in range(3):
            for k in range(8):
                if k >> axis & 1:
                    continue
                a, b = corners[i, k], corners[i, k | 1 << axis]
                if (values[a] > 0.0) == (values[b] > 0.0) or edges[a, axis] >= 0:
                    continue
                edges[a, axis] = total
                share = min(max(values[a] / (values[a] - values[b]), _APART), 1.0 - _APART)
                for j in range(3):
                    xyz[total, j] = lattice[a, j]
                xyz[total, axis] += share
                total += 1
    return total


def _vertices(corners: Ids, lattice: Places, values: NDArray[np.float32]) -> tuple[Ids, Array]:
    """The vertex on each edge (M, 3), -1 where none is, and their places (V, 3) in cells."""
    edges = np.full((len(lattice), 3), -1, np.int32)
    xyz = np.empty((3 * len(lattice), 3))
    total = _number_edges(corners, lattice, values, edges, xyz)
    return edges, xyz[:total].copy()


@numba.njit(cache=True, nogil=True)
def _fill_triangles(
    corners: Ids,
    values: NDArray[np.float32],
    edges: Ids,
    first: Ids,
    triangles: NDArray[np.int8],
    ends: NDArray[np.int8],
    faces: Ids,
) -> int:
    """Triangles of all cells into ``faces`` unless that is empty; how many there are."""
    total = 0
    for i in range(corners.shape[0]):
        case = 0
        for k in range(8):
            case |= (values[corners[i, k]] > 0.0) << k
        for t in range(first[case], first[case + 1]):
            if faces.shape[0]:
                for j in range(3):
                    edge = triangles[t, j]
                    faces[total, j] = edges[corners[i, ends[edge, 0]], ends[edge, 1]]
            total += 1
    return total


def _triangles(corners: Ids, values: NDArray[np.float32], edges: Ids, first: Ids, triangles: NDArray[np.int8]) -> Ids:
    ends = np.array(_EDGES, np.int8)
    faces = np.empty((0, 3), np.int32)
    faces = np.empty((_fill_triangles(corners, values, edges, first, triangles, ends, faces), 3), np.int32)
    if len(faces):
        _fill_triangles(corners, values, edges, first, triangles, ends, faces)
    return faces


# --------------------------------------------------------------------------------- how a cell is cut, in all 256 cases


@cache
def _table() -> tuple[Ids, NDArray[np.int8]]:
    """For each case, bit k for corner k inside, the triangles of its cell: ``first`` (257,) in edges (T, 3)."""
    first, triangles = [0], []
    for case in range(256):
        for loop in _loops(case):
            triangles += _cut_loop(loop)
        first.append(len(triangles))
    return np.array(first, np.int32), np.array(triangles, np.int8).reshape(-1, 3)


def _edge_between(a: int, b: int) -> int:
    axis = (a ^ b).bit_length() - 1
    return _EDGES.index((min(a, b), axis))


@cache
def _faces() -> list[list[int]]:
    """The corners of the six faces, anticlockwise as seen from outside the cell."""
    faces = []
    for axis in range(3):
        u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        faces.append([(1 << axis) + k for k in (0, u, u + v, v)])
        faces.append([0, v, u + v, u])
    return faces


def _loops(case: int) -> list[list[int]]:
    """Closed walks over edges that bound the surface in a cell, anticlockwise as seen from outside of the solid.

    On a face, seen from outside the cell, each run of corners inside is cut off by a line from the edge behind it to
    the one before it, which leaves the solid to its right in the cell's own boundary and so to the left of none.
    """
    following = {}
    for face in _faces():
        inside = [bool(case >> corner & 1) for corner in face]
        for k in range(4):
            if inside[k] and not inside[k - 1]:
                end = k
                while inside[(end + 1) % 4]:
                    end += 1
                enters = _edge_between(face[k - 1], face[k])
                leaves = _edge_between(face[end % 4], face[(end + 1) % 4])
                following[enters] = leaves
    loops = []
    while following:
        start, at = next(iter(following.items()))
        loop = [start]
        del following[start]
        while at != start:
            loop.append(at)
            at = following.pop(at)
        loops.append(loop)
    return loops


def _share_face(a: int, b: int) -> bool:
    """Whether two edges lie in one face of the cell."""
    ends = [{corner, corner | 1 << axis} for corner, axis in (_EDGES[a], _EDGES[b])]
    return any(ends[0] | ends[1] <= set(face) for face in _faces())


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
