"""How a surface cuts a cube whose corners are inside or outside: 256 cases.

Corner k is off by the bits of k along x, y and z. An edge is its first corner and its axis. Faces that have two ways to
be cut always are so that the inside is apart, so that both cubes at a face cut it in one way (Lorensen and Cline, 1987;
Nielson and Hamann, 1991).
"""

from __future__ import annotations

from functools import cache

EDGES = tuple((corner, axis) for axis in range(3) for corner in range(8) if not corner >> axis & 1)


def edge_between(a: int, b: int) -> int:
    """Position among :data:`EDGES` of the edge between two corners."""
    axis = (a ^ b).bit_length() - 1
    return EDGES.index((min(a, b), axis))


@cache
def cube_faces() -> list[list[int]]:
    """The corners of the six faces, anticlockwise as seen from outside the cube."""
    faces = []
    for axis in range(3):
        u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        faces.append([(1 << axis) + k for k in (0, u, u + v, v)])
        faces.append([0, v, u + v, u])
    return faces


def surface_loops(case: int) -> list[list[int]]:
    """Closed walks over edges that bound the surface in a cube, anticlockwise as seen from outside of the solid.

    On a face, seen from outside the cube, each run of corners inside is cut off by a line from the edge behind it to
    the one before it, which leaves the solid to its right in the cube's own boundary and so to the left of none.

    Args:
        case: bit k for corner k inside.
    """
    following = {}
    for face in cube_faces():
        inside = [bool(case >> corner & 1) for corner in face]
        for k in range(4):
            if inside[k] and not inside[k - 1]:
                end = k
                while inside[(end + 1) % 4]:
                    end += 1
                enters = edge_between(face[k - 1], face[k])
                leaves = edge_between(face[end % 4], face[(end + 1) % 4])
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
