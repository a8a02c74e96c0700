"""Neighbours of one surface settle on a common course, each patch on the line of sight of its own reference image.

Windows of neighbouring patches overlap but come from different reference images, and their errors differ: a plane
through the neighbours, fitted with weights from their own standard deviations, is two to three times as exact as one
patch. In pixels and inverse depth a plane is linear, so the fit is a 3 x 3 system.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numba import float32 as f32
from numpy.typing import NDArray

from sfmapp.dense.arrays import (
    LAYERS,
    CellPointers,
    Cells,
    ImagePointers,
    Images,
    Store,
    StorePointers,
    cell_pointers,
    image_pointers,
    store_pointers,
)
from sfmapp.dense.patch_kernels import (
    NEAR,
    cell_of,
    cell_size,
    normal_of_plane,
    off_planes,
    plane_in_view,
    project,
    unproject,
)
from sfmapp.simd.pointers import Index, offset, pointer

# cells to each side that take part, and the pixels over which their weight falls off
RADIUS_CELLS, FALL_OFF_PX = 3, 2.2
# how far a surface bends away from its tangent over one pixel, in pixels: a ball of 50 pixels' radius
BEND_PX = 0.01
# no neighbour is trusted further than this share of a pixel of depth, whatever its own deviation says
FLOOR_PX = 0.05
# slopes of the patch itself count as if measured over this many pixels
SLOPE_BASE_PX = 1.5


@numba.njit(cache=True, nogil=True)
def settle(
    image_arrays: Images, store_arrays: Store, cell_arrays: Cells, first: int, last: int, xyz: NDArray[np.float32],
    normal: NDArray[np.float32], sigma: NDArray[np.float32],
) -> None:  # fmt: skip
    """New places, normals (N, 3) and deviations (N,) of patches ``first`` to ``last``, all from the old ones."""
    images, store, cells = image_pointers(image_arrays), store_pointers(store_arrays), cell_pointers(cell_arrays)
    for p in range(first, last):
        r = np.int64(store.views[p * store.row])
        x = offset(store.xyz, 3 * p)
        u, v, z = project(images, r, x)
        for j in range(3):
            xyz[p, j], normal[p, j] = store.xyz[3 * p + j], store.normal[3 * p + j]
        sigma[p] = store.sigma[p]
        g = cell_of(images, r, u, v)
        if g < 0:
            continue
        wu, wv, _ = plane_in_view(images, r, x, offset(store.normal, 3 * p))
        a, b, c, spread, is_regular = _fit(images, store, cells, p, r, g, u, v, z, wu, wv)
        if is_regular and a > 0.0:
            unproject(images, r, u, v, 1.0 / a, offset(pointer(xyz), 3 * p))
            normal_of_plane(images, r, u, v, a, b, c, offset(pointer(normal), 3 * p))
            sigma[p] = spread * _length_per_inverse_depth(images, r, u, v, a)


@numba.njit(cache=True, nogil=True)
def _length_per_inverse_depth(images: ImagePointers, r: Index, u: float, v: float, w: float) -> float:
    """Length along the ray of pixel (u, v) for a change of inverse depth by one."""
    k = offset(images.k, 4 * r)
    x, y = (u - k[2]) / k[0], (v - k[3]) / k[1]
    return math.sqrt(x * x + y * y + 1.0) / (w * w)


@numba.njit(cache=True, nogil=True)
def _fit(
    images: ImagePointers, store: StorePointers, cells: CellPointers, p: int, r: Index, g: int, u: float, v: float,
    z: float, wu: float, wv: float,
) -> tuple[float, float, float, float, bool]:  # fmt: skip
    """Plane (w, dw/du, dw/dv at the patch) through its neighbours in view r, the deviation of w, whether it is one."""
    columns, start = np.int64(images.columns[r]), images.cell_start[r]
    cy = (g - start) // columns
    cx = (g - start) - cy * columns
    reach = f32(2.0 * NEAR) * cell_size(images, store, p)
    # what a pixel along the surface is in inverse depth
    unit = np.float64(store.size[p]) / (z * z)
    floor = FLOOR_PX * unit
    own = _deviation(images, store, p, r, u, v, 1.0 / z)
    slope = SLOPE_BASE_PX * SLOPE_BASE_PX / (own * own + floor * floor)
    n00 = n01 = n02 = g0 = 0.0
    n11 = n22 = slope
    n12, g1, g2 = 0.0, slope * wu, slope * wv
    most = 0.0
    for y in range(max(cy - RADIUS_CELLS, 0), min(cy + RADIUS_CELLS + 1, np.int64(images.rows[r]))):
        for x in range(max(cx - RADIUS_CELLS, 0), min(cx + RADIUS_CELLS + 1, columns)):
            for layer in range(LAYERS):
                q = np.int64(cells.patch[LAYERS * (start + y * columns + x) + layer])
                if q < 0:
                    break
                if q != p and not off_planes(store, p, store, q) < reach:
                    continue
                uq, vq, zq = project(images, r, offset(store.xyz, 3 * q))
                du, dv, w = uq - u, vq - v, 1.0 / zq
                deviation = _deviation(images, store, q, r, uq, vq, w)
                off = w - (1.0 / z + wu * du + wv * dv)
                doubt = 1.0 + off * off / (9.0 * (deviation * deviation + own * own + floor * floor))
                fall = math.exp(-(du * du + dv * dv) / (2.0 * FALL_OFF_PX * FALL_OFF_PX))
                bend = unit * BEND_PX * (du * du + dv * dv)
                weight = fall / ((deviation * deviation + floor * floor + bend * bend) * doubt)
                n00 += weight
                n01 += weight * du
                n02 += weight * dv
                n11 += weight * du * du
                n12 += weight * du * dv
                n22 += weight * dv * dv
                g0 += weight * w
                g1 += weight * du * w
                g2 += weight * dv * w
                most += 1.0
    if most < 4.0:
        return 0.0, 0.0, 0.0, 0.0, False
    c00, c01, c02 = n11 * n22 - n12 * n12, n02 * n12 - n01 * n22, n01 * n12 - n02 * n11
    determinant = n00 * c00 + n01 * c01 + n02 * c02
    if not determinant > 1e-9 * n00 * n11 * n22:
        return 0.0, 0.0, 0.0, 0.0, False
    c11, c12, c22 = n00 * n22 - n02 * n02, n01 * n02 - n00 * n12, n00 * n11 - n01 * n01
    return (
        (c00 * g0 + c01 * g1 + c02 * g2) / determinant,
        (c01 * g0 + c11 * g1 + c12 * g2) / determinant,
        (c02 * g0 + c12 * g1 + c22 * g2) / determinant,
        math.sqrt(c00 / determinant),
        True,
    )


@numba.njit(cache=True, nogil=True)
def _deviation(images: ImagePointers, store: StorePointers, q: Index, r: Index, u: float, v: float, w: float) -> float:
    """Standard deviation of a patch in inverse depth of view r, taken along its line of sight."""
    return np.float64(store.sigma[q]) / _length_per_inverse_depth(images, r, u, v, w)
