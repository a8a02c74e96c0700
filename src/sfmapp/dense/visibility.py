"""Which images can see a place: those that can and still do not trust a patch speak against it."""

from __future__ import annotations

import math

import numba
import numpy as np
from numba import float32 as f32

from sfmapp.dense.arrays import LAYERS, CellPointers, ImagePointers, StorePointers
from sfmapp.dense.patch_kernels import APART, LEAST_COSINE, cell_of, cell_size, off_planes, project
from sfmapp.dense.window import HALF
from sfmapp.simd.pointers import Index, offset

# of an image: where a window about as large as that of the reference image reaches out of it
BORDER = float(HALF + 1)


@numba.njit(cache=True, nogil=True)
def are_excused(images: ImagePointers, store: StorePointers, cells: CellPointers, found: StorePointers, i: int) -> bool:
    """Whether the neighbours of the reference image that do not trust patch i have a reason: they cannot see it."""
    m = np.int64(found.views[i * found.row])
    for slot in range(images.num_slots):
        s = np.int64(images.neighbors[m * images.num_slots + slot])
        if s < 0:
            break
        is_trusting = False
        for j in range(1, found.num_views[i]):
            is_trusting = is_trusting or found.views[i * found.row + j] == s
        if not is_trusting and can_see(images, store, cells, s, found, i):
            return False
    return True


@numba.njit(cache=True, nogil=True)
def can_see(
    images: ImagePointers, store: StorePointers, cells: CellPointers, s: Index, found: StorePointers, i: int
) -> bool:
    """Whether the window of patch i lies in the image and mask of view s, faces it, and no patch of it hides it."""
    xyz, normal, eye = offset(found.xyz, 3 * i), offset(found.normal, 3 * i), offset(images.center, 3 * s)
    u, v, z = project(images, s, xyz)
    right, bottom = images.width[s] - 1 - BORDER, images.height[s] - 1 - BORDER
    if z <= 0.0 or u < BORDER or v < BORDER or u > right or v > bottom:
        return False
    e0, e1, e2 = eye[0] - xyz[0], eye[1] - xyz[1], eye[2] - xyz[2]
    facing = e0 * normal[0] + e1 * normal[1] + e2 * normal[2]
    g = cell_of(images, s, u, v)
    if g < 0 or images.closed[g] != 0 or facing < LEAST_COSINE * math.sqrt(e0 * e0 + e1 * e1 + e2 * e2):
        return False
    for layer in range(LAYERS):
        q = cells.patch[LAYERS * g + layer]
        if q < 0:
            break
        _, _, depth = project(images, s, offset(store.xyz, 3 * q))
        if depth < z and off_planes(found, i, store, q) > f32(APART) * cell_size(images, found, i):
            return False
    return True
