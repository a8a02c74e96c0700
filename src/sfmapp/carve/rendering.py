"""Meshes as views see them: depths in each pixel, and silhouettes rendered back."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.views import View, project_points

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Shown:
    """What a view shows of a mesh.

    Attributes:
        depth: (H, W) of the nearest triangle behind each pixel's centre, units of the world; inf for none.
        face: (H, W) int32 that triangle; -1 for none.
        corners: (N, 3) pixel and depth of each place between which there are triangles; NaN where the lens has none.
    """

    depth: NDArray[np.float32]
    face: NDArray[np.int32]
    corners: Array


def show_mesh(view: View, xyz: Array, faces: NDArray[np.int32]) -> Shown:
    """What a view shows of triangles (F, 3) between places (N, 3).

    Corners are projected by the lens, and triangles are flat between them: they are to be small against what the lens
    bends. A triangle with a corner that the lens does not see is left out.
    """
    seen = np.empty((len(xyz), 3))
    project_points(view.row, np.ascontiguousarray(xyz, np.float64), seen)
    depth = np.full((view.height, view.width), np.inf, np.float32)
    face = np.full(depth.shape, -1, np.int32)
    _rasterize(seen, faces, depth, face)
    return Shown(depth, face, seen)


def overlap(depth: NDArray[np.float32], silhouette: Silhouette) -> tuple[float, int, int]:
    """How well what a view shows of a mesh (H, W) fits its silhouette, where that is known.

    Returns:
        Intersection over union (1 where both are empty), pixels of the mesh alone, and of the silhouette alone.
    """
    shown, inside = np.isfinite(depth), silhouette.inside
    if silhouette.known is not None:
        shown, inside = shown & silhouette.known, inside & silhouette.known
    common = int((shown & inside).sum())
    over, under = int(shown.sum()) - common, int(inside.sum()) - common
    total = common + over + under
    return (common / total if total else 1.0), over, under


@numba.njit(cache=True, nogil=True)
def _rasterize(seen: Array, faces: NDArray[np.int32], depth: NDArray[np.float32], face: NDArray[np.int32]) -> None:
    """Least depths, and whose they are (in place), of triangles whose corners are at pixels and depths (N, 3)."""
    height, width = depth.shape
    for n in range(faces.shape[0]):
        i, j, k = faces[n, 0], faces[n, 1], faces[n, 2]
        ax, ay, az = seen[i, 0], seen[i, 1], seen[i, 2]
        bx, by, bz = seen[j, 0], seen[j, 1], seen[j, 2]
        cx, cy, cz = seen[k, 0], seen[k, 1], seen[k, 2]
        twice = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not (abs(twice) > 0.0 and az > 0.0 and bz > 0.0 and cz > 0.0):  # not a number counts as well
            continue
        # from the first pixel whose centre may be covered to the last
        top = int(max(0.0, np.ceil(min(ay, by, cy) - 0.5)))
        bottom = int(min(height - 1.0, np.floor(max(ay, by, cy) - 0.5)))
        left = int(max(0.0, np.ceil(min(ax, bx, cx) - 0.5)))
        right = int(min(width - 1.0, np.floor(max(ax, bx, cx) - 0.5)))
        for row in range(top, bottom + 1):
            for col in range(left, right + 1):
                x, y = col + 0.5, row + 0.5
                wb = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / twice
                wc = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / twice
                wa = 1.0 - wb - wc
                if wa < 0.0 or wb < 0.0 or wc < 0.0:
                    continue
                # the inverse of depth is linear in the picture
                z = np.float32(1.0 / (wa / az + wb / bz + wc / cz))
                if z < depth[row, col]:
                    depth[row, col] = z
                    face[row, col] = n
