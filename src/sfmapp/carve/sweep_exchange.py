"""Planes of several views' maps tried in each other: what one view could not tell alone, others may.

After Xu and Tao, "Multi-scale geometric consistency guided multi-view stereo" (CVPR 2019): a map is brought to another
view, where its planes are tried, and those that several maps tell are preferred. Once round is what is done.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.plane_sweep import SweptPlanes, believed_planes
from sfmapp.carve.slanted_sweep import better_told
from sfmapp.dense.scene import DenseScene, DenseView
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Map = NDArray[np.float32]

# a plane so far from its own pixel that depths differ by more than this share is not of the same place
_SAME_PLACE = 0.05


def exchange_planes(
    scene: DenseScene, view_idx: int, swept: Mapping[int, SweptPlanes], pool: Executor | None = None
) -> SweptPlanes:
    """The map of a view, after what its neighbours' maps tell was tried in it.

    Args:
        scene: as of :func:`sfmapp.carve.plane_sweep.sweep_planes`.
        view_idx: position of the view.
        swept: its own map, and those of its neighbours that have one.
        pool: does two things at a time; bytes do not depend on it.
    """
    own, view = swept[view_idx], scene.views[view_idx]
    sides = [m for m in own.neighbors if m in swept]
    if not sides:
        return own
    told = [brought(scene.views[m], swept[m], view) for m in sides]
    inverse, slopes = (np.stack(parts) for parts in zip(*told, strict=True))
    if view.mask is not None:
        inverse[:, ~view.mask] = np.nan
    others, planes = [scene.views[m] for m in own.neighbors], own.planes
    found = better_told(view, others, planes.first, planes.step, own.plane, own.slopes, (inverse, slopes), pool)
    return believed_planes(view, others, planes, found, np.isfinite(own.plane), own.neighbors)


def brought(view: DenseView, swept: SweptPlanes, to: DenseView) -> tuple[Map, Map]:
    """What the map of a view tells in another: inverse depth (H, W) per unit of the world, the nearest where several
    are told, NaN where none is, and its slopes (H, W, 2) per pixel."""
    relative = rigid3.compose(to.cam_from_world, rigid3.inverse(view.cam_from_world))
    inverse = np.full((to.height, to.width), np.nan, np.float32)
    slopes = np.full((to.height, to.width, 2), np.nan, np.float32)
    pose = rigid3.rotation_matrix(relative), relative[4:].copy()
    _bring(swept.plane, swept.slopes, (swept.planes.first, swept.planes.step), view.k, pose, to.k, inverse, slopes)
    return inverse, slopes


@numba.njit(cache=True, nogil=True)
def _bring(
    plane: Map, slopes: Map, along: tuple[float, float], k: Array, pose: tuple[Array, Array], to_k: Array,
    out: Map, out_slopes: Map,
) -> None:  # fmt: skip
    """Planes of one view in the four pixels of another about the places where they lie."""
    rotation, shift = pose
    first, step = along
    height, width = out.shape
    n, p = np.empty(3), np.empty(3)
    for y in range(plane.shape[0]):
        for x in range(plane.shape[1]):
            inverse = first + step * plane[y, x]
            if not inverse > 0.0:
                continue
            a, b = (x + 0.5 - k[2]) / k[0], (y + 0.5 - k[3]) / k[1]
            # the plane is n x = 1 in the frame of its own view
            lean_x, lean_y = step * slopes[y, x, 0] * k[0], step * slopes[y, x, 1] * k[1]
            ahead = inverse - lean_x * a - lean_y * b
            away = 1.0
            for j in range(3):
                n[j] = rotation[j, 0] * lean_x + rotation[j, 1] * lean_y + rotation[j, 2] * ahead
                p[j] = (rotation[j, 0] * a + rotation[j, 1] * b + rotation[j, 2]) / inverse + shift[j]
                away += n[j] * shift[j]
            if p[2] <= 0.0 or abs(away) < 1e-9:
                continue
            left = int(np.floor(p[0] / p[2] * to_k[0] + to_k[2] - 0.5))
            top = int(np.floor(p[1] / p[2] * to_k[1] + to_k[3] - 0.5))
            n /= away
            for v in range(max(top, 0), min(top + 2, height)):
                for u in range(max(left, 0), min(left + 2, width)):
                    told = n[0] * (u + 0.5 - to_k[2]) / to_k[0] + n[1] * (v + 0.5 - to_k[3]) / to_k[1] + n[2]
                    if told > 0.0 and abs(told * p[2] - 1.0) <= _SAME_PLACE and not told <= out[v, u]:
                        out[v, u] = told
                        out_slopes[v, u, 0], out_slopes[v, u, 1] = n[0] / to_k[0], n[1] / to_k[1]
