"""What of a closed Poisson surface is real: close to patches, in view of a camera, not a loose scrap."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.scene import DenseScene
from sfmapp.geometry.components import find_root
from sfmapp.scene.mesh import face_areas, face_vectors
from sfmapp.surface.patch_cloud import CHUNK, PatchCloud


@dataclass(frozen=True)
class Surroundings:
    """What the patches say of the vertices (N) of a surface.

    Attributes:
        distance: (N,) float32 distance to the nearest patch, in spacings of the patches there.
        radius: (N,) float32 distance to the farthest of the nearest patches, world units: how sparse they are.
        is_backside: (N,) bool, True where all the nearest patches look the other way.
        rgb: (N, 3) uint8 colour of the nearest patches.
    """

    distance: NDArray[np.float32]
    radius: NDArray[np.float32]
    is_backside: NDArray[np.bool_]
    rgb: NDArray[np.uint8]


def look_around(
    xyz: NDArray[np.float64], normal: NDArray[np.float32], patches: PatchCloud, threads: int
) -> Surroundings:
    """Ask the patches nearest to each vertex (N, 3) with its normal (N, 3).

    Colours are weighted by the inverse of the distance (Shepard 1968), as if none were nearer than half a spacing.
    """
    found = Surroundings(
        np.empty(len(xyz), np.float32), np.empty(len(xyz), np.float32), np.empty(len(xyz), np.bool_),
        np.empty((len(xyz), 3), np.uint8),
    )  # fmt: skip
    for start in range(0, len(xyz), CHUNK):
        part = slice(start, start + CHUNK)
        distance, idx = patches.nearest(xyz[part], threads)
        spacing = patches.spacing[idx]
        found.distance[part] = distance[:, 0] / spacing[:, 0]
        found.radius[part] = distance[:, -1]
        facing = np.einsum("nkc,nc->nk", patches.normal[idx], normal[part])
        found.is_backside[part] = (facing < 0.0).all(axis=1)
        weight = 1.0 / np.maximum(distance, 0.5 * spacing)
        color = np.einsum("nk,nkc->nc", weight / weight.sum(axis=1, keepdims=True), patches.rgb[idx])
        found.rgb[part] = np.rint(color).astype(np.uint8)
    return found


def in_view(xyz: NDArray[np.float64], faces: NDArray[np.int32], scene: DenseScene) -> NDArray[np.bool_]:
    """(F,) bool, True for faces of which a view shows the centre, and their front. What hides what is not asked."""
    seen = np.zeros(len(faces), np.bool_)
    for start in range(0, len(faces), CHUNK):
        some = faces[start : start + CHUNK]
        vectors, centers, idx = face_vectors(xyz, some), xyz[some].mean(axis=1), np.arange(len(some))
        for view, camera in zip(scene.views, scene.centers, strict=True):
            pixel, _ = view.project(centers[idx])
            faces_camera = np.einsum("fc,fc->f", centers[idx] - camera, vectors[idx]) < 0.0
            shown = view.shows(pixel) & faces_camera
            seen[start + idx[shown]] = True
            idx = idx[~shown]
    return seen


def pieces(faces: NDArray[np.int32], num_vertices: int) -> NDArray[np.int32]:
    """(F,) number of the piece that each face (F, 3), or edge (F, 2), belongs to: those hang together that share a
    vertex."""
    root = np.arange(num_vertices, dtype=np.int32)
    _join_vertices(np.ascontiguousarray(faces), root)
    mine = root[faces[:, 0]]
    is_root = np.zeros(num_vertices, np.bool_)
    is_root[mine] = True
    return (np.cumsum(is_root, dtype=np.int32) - np.int32(1))[mine]


@numba.njit(cache=True, nogil=True)
def _join_vertices(faces: NDArray[np.int32], root: NDArray[np.int32]) -> None:
    """Join the vertices (N) of each face (F, K); ``root``, at first each its own, becomes the lowest that hangs
    together with each."""
    for f in range(faces.shape[0]):
        for k in range(1, faces.shape[1]):
            a, b = find_root(root, faces[f, 0]), find_root(root, faces[f, k])
            if a < b:
                root[b] = a
            else:
                root[a] = b
    for v in range(root.shape[0]):
        root[v] = root[root[v]]  # none lies above its root, so that is known to be one


def without_islands(
    xyz: NDArray[np.float64], faces: NDArray[np.int32], kept: NDArray[np.bool_], smallest_share: float
) -> NDArray[np.bool_]:
    """``kept`` (F,) without the pieces that have less than a share of the area of all that is kept."""
    idx = np.flatnonzero(kept)
    if not len(idx):
        return kept
    piece = pieces(faces[idx], len(xyz))
    area = face_areas(xyz, faces[idx])
    piece_area = np.bincount(piece, area)
    out = np.zeros_like(kept)
    out[idx] = piece_area[piece] >= smallest_share * area.sum()
    return out


def rim(faces: NDArray[np.int32]) -> NDArray[np.int32]:
    """(R, 2) edges, as pairs of vertices in the order of their face, that have a face on one side only."""
    # smaller vertex, larger one, whether the face has the larger first: sorted, the faces of an edge follow each other
    keys = np.empty(3 * len(faces), np.int64)
    for side in range(3):
        start, end, mine = faces[:, side], faces[:, (side + 1) % 3], keys[side::3]
        mine[:] = np.minimum(start, end)
        mine <<= 32
        mine |= np.maximum(start, end).astype(np.int64) << 1
        mine |= start > end
    keys.sort()
    is_alone = np.ones(len(keys), np.bool_)
    is_alone[1:] = (keys[1:] ^ keys[:-1]) > 1
    is_alone[:-1] &= is_alone[1:]
    keys = keys[is_alone]
    edges = np.stack([keys >> 32, (keys & 0xFFFFFFFF) >> 1], axis=1).astype(np.int32)
    return np.where(((keys & 1) == 1)[:, None], edges[:, ::-1], edges)
