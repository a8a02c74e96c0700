"""A triangle mesh as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

# triangles at a time: what is made of them is many times as large as they are
_CHUNK = 1 << 17


@dataclass(frozen=True)
class Mesh:
    """Triangles with a colour for each vertex and, if asked for, a texture.

    Attributes:
        xyz: (N, 3) float64 vertices, world.
        faces: (F, 3) int32 positions of their corners, anticlockwise as seen from outside.
        normal: (N, 3) float32 unit normals, world, outward.
        rgb: (N, 3) uint8, sRGB.
        uv: (N, 2) float32 place of each vertex in the texture, 0 to 1, from its left and upper edge; None without one.
        texture: (H, W, 3) uint8, sRGB; None without one.
    """

    xyz: NDArray[np.float64]
    faces: NDArray[np.int32]
    normal: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    uv: NDArray[np.float32] | None = None
    texture: NDArray[np.uint8] | None = None

    def __len__(self) -> int:
        return len(self.faces)


def face_vectors(xyz: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """(F, 3) outward normals of triangles, as long as the triangles' areas."""
    a, b, c = (xyz[faces[:, corner]] for corner in range(3))
    return np.asarray(0.5 * np.cross(b - a, c - a))


def face_areas(xyz: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """(F,) areas of triangles."""
    areas = np.empty(len(faces))
    for first in range(0, len(faces), _CHUNK):
        some = slice(first, first + _CHUNK)
        areas[some] = np.linalg.norm(face_vectors(xyz, faces[some]), axis=1)
    return areas


def enclosed_volume(xyz: NDArray[np.float64], faces: NDArray[np.int32]) -> float:
    """Volume in a closed mesh, cubic units of the world, by the divergence theorem."""
    total, middle = 0.0, xyz.mean(axis=0)
    for first in range(0, len(faces), _CHUNK):
        a, b, c = (xyz[faces[first : first + _CHUNK, corner]] - middle for corner in range(3))
        total += float(np.einsum("fc,fc->", a, np.cross(b, c)))
    return total / 6.0


def flat_areas(xy: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.float64]:
    """(F,) areas of triangles whose corners are places (N, 2) in a picture."""
    a, b, c = (xy[faces[:, corner]] for corner in range(3))
    return np.asarray(0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]))


@numba.njit(cache=True, nogil=True)
def _add_normals(xyz: NDArray[np.float64], faces: NDArray[np.int32], total: NDArray[np.float64]) -> None:
    """Add the normals of triangles, as long as their areas, to those of their corners (N, 3)."""
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        ux, uy, uz = xyz[b, 0] - xyz[a, 0], xyz[b, 1] - xyz[a, 1], xyz[b, 2] - xyz[a, 2]
        vx, vy, vz = xyz[c, 0] - xyz[a, 0], xyz[c, 1] - xyz[a, 1], xyz[c, 2] - xyz[a, 2]
        x, y, z = 0.5 * (uy * vz - uz * vy), 0.5 * (uz * vx - ux * vz), 0.5 * (ux * vy - uy * vx)
        for corner in (a, b, c):
            total[corner, 0] += x
            total[corner, 1] += y
            total[corner, 2] += z


def vertex_normals(xyz: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float32]:
    """(N, 3) unit normals of vertices: those of their faces, weighted by area; z where a vertex has no face."""
    total = np.zeros((len(xyz), 3))
    _add_normals(np.ascontiguousarray(xyz, np.float64), np.ascontiguousarray(faces, np.int32), total)
    length = np.linalg.norm(total, axis=1)
    total[length == 0.0] = 0.0, 0.0, 1.0
    total /= np.where(length == 0.0, 1.0, length)[:, None]
    return total.astype(np.float32)
