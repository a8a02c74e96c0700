"""A triangle mesh as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


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
    return np.asarray(np.linalg.norm(face_vectors(xyz, faces), axis=1))


def flat_areas(xy: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.float64]:
    """(F,) areas of triangles whose corners are places (N, 2) in a picture."""
    a, b, c = (xy[faces[:, corner]] for corner in range(3))
    return np.asarray(0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]))


def vertex_normals(xyz: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float32]:
    """(N, 3) unit normals of vertices: those of their faces, weighted by area; z where a vertex has no face."""
    vectors = face_vectors(xyz, faces)
    total = np.stack(
        [np.bincount(faces.ravel(), np.repeat(vectors[:, axis], 3), len(xyz)) for axis in range(3)], axis=1
    )
    length = np.linalg.norm(total, axis=1)
    total[length == 0.0] = 0.0, 0.0, 1.0
    return np.asarray(total / np.where(length == 0.0, 1.0, length)[:, None], np.float32)
