"""Closing again what trimming has opened in a surface that was captured all round."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.scene import DenseScene
from sfmapp.scene.mesh import face_areas, face_vectors
from sfmapp.surface.patch_cloud import CHUNK
from sfmapp.surface.trim import in_view, pieces

# as large as a dome on a flat gap, a half sphere
LARGEST_DOME = 2.0
# of the largest gap is the largest one that views show, and of that one the largest with a balloon
SHOWN = 0.25
# side of the largest square gap that is closed in a surface that stays open elsewhere, in spacings of the patches
LARGEST_PATCHED = 20.0
# in areas of what is kept
LARGEST_BALLOON = 2.0


def close_gaps(
    xyz: NDArray[np.float64],
    faces: NDArray[np.int32],
    kept: NDArray[np.bool_],
    scene: DenseScene | None,
    largest_share: float,
    spacing: float,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Take back pieces of the closed surface that were cut off, where they close a gap and not an open surface.

    How large a gap is tells the membrane over it, the surface that has each of its vertices amid its neighbours: the
    balloon behind a wall has one about as large as the wall. Where Poisson's surface is little more than the membrane
    it is taken as it is. Where it is a balloon (under a statue's base, through a doorway) the membrane is taken in its
    place. What the views show most of they would have found patches on, if it were there and had texture: such gaps
    have to be smaller. All this is for objects that were captured all round. Of a surface that stays open anyway most
    gaps are where nobody has looked, and just the small ones are closed.

    Args:
        xyz: (N, 3) vertices of the closed surface.
        faces: (F, 3).
        kept: (F,) what trimming has left.
        scene: the views; None: nobody knows what they show.
        largest_share: of the area of what is kept, that a gap may have; 0: none is closed.
        spacing: of the patches, world units.

    Returns:
        The vertices (N, 3), those of membranes in their new places, and the faces to keep (F,).
    """
    idx = np.flatnonzero(~kept)
    if not len(idx) or largest_share == 0.0:
        return xyz, kept
    piece = pieces(faces[idx], len(xyz))
    kept_area = float(face_areas(xyz, faces[kept]).sum())
    is_fixed = np.zeros(len(xyz), np.bool_)
    is_fixed[faces[kept]] = True
    area = np.bincount(piece, face_areas(xyz, faces[idx]))
    is_beside = np.bincount(piece, is_fixed[faces[idx]].any(axis=1)) > 0
    # the membranes of the largest balloons would take long and come to nothing
    least, patched = _least_areas(xyz, faces[idx], piece), (LARGEST_PATCHED * spacing) ** 2
    candidate = is_beside & (area <= LARGEST_BALLOON * kept_area) & (least <= largest_share * kept_area)
    if (is_beside & ~candidate).any():
        candidate &= least <= patched
    idx, piece = idx[candidate[piece]], piece[candidate[piece]]
    if not len(idx):
        return xyz, kept
    flat = _membranes(xyz, faces[idx], is_fixed)
    flat_area = np.bincount(piece, face_areas(flat, faces[idx]), len(area))
    is_balloon = area > LARGEST_DOME * flat_area
    largest = np.full(len(area), largest_share * kept_area)
    if scene is not None:
        shown = np.bincount(piece, face_areas(flat, faces[idx]) * in_view(flat, faces[idx], scene), len(area))
        largest[shown > 0.5 * flat_area] *= SHOWN
        largest[(shown > 0.5 * flat_area) & is_balloon] *= SHOWN
    is_gap = candidate & (flat_area <= largest)
    if (is_beside & ~is_gap).any():
        is_gap &= flat_area <= patched
    out, moved = kept.copy(), xyz.copy()
    out[idx] = is_gap[piece]
    flattened = np.unique(faces[idx[(is_gap & is_balloon)[piece]]])
    moved[flattened] = flat[flattened]
    return moved, out


def _least_areas(
    xyz: NDArray[np.float64], faces: NDArray[np.int32], piece: NDArray[np.int32]
) -> NDArray[np.float64]:  # fmt: skip
    """(P,) what the area of any surface with the rim of each piece of some faces (F, 3) is at least.

    Triangles' normals, as long as their areas, add up to what the rim alone tells (Stokes).
    """
    total = np.zeros((int(piece.max()) + 1, 3))
    for start in range(0, len(faces), CHUNK):
        part = slice(start, start + CHUNK)
        vectors = face_vectors(xyz, faces[part])
        for axis in range(3):
            total[:, axis] += np.bincount(piece[part], vectors[:, axis], len(total))
    return np.asarray(np.linalg.norm(total, axis=1))


def _membranes(xyz: NDArray[np.float64], faces: NDArray[np.int32], is_fixed: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The vertices (N, 3) with those of some faces, where they are not fixed, each at the mean of its neighbours."""
    from scipy.sparse import coo_array, csr_array, diags_array
    from scipy.sparse.linalg import splu

    used, corners = np.unique(faces, return_inverse=True)
    corners = corners.reshape(-1, 3)
    start, end = corners[:, [0, 1, 2, 1, 2, 0]].ravel(), corners[:, [1, 2, 0, 0, 1, 2]].ravel()
    links = csr_array(coo_array((np.ones(len(start)), (start, end)), (len(used), len(used))))
    links.data[:] = 1.0
    free = np.flatnonzero(~is_fixed[used])
    fixed = np.flatnonzero(is_fixed[used])
    out = xyz.copy()
    if len(free):
        rows = links[free]
        system = diags_array(np.asarray(rows.sum(axis=1)).ravel()) - rows[:, free]
        out[used[free]] = splu(system.tocsc()).solve(rows[:, fixed] @ xyz[used[fixed]])
    return out
