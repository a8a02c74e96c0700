"""Cells with two patches, one behind the other: the image that trusts both decides whether it shows both.

A window reaches beyond its centre, so a wall is trusted up to a pixel or two under what stands before it, and what
stands there a pixel or two beyond its edge.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numba import float32 as f32
from numpy.typing import NDArray

from sfmapp.dense.arrays import LAYERS, Cells, Images, Store, cell_pointers, image_pointers, store_pointers
from sfmapp.dense.expand import BETTER, CONTRAST, LEAST_CONTRAST, LEAST_DEVIATION, zncc_with_patch
from sfmapp.dense.patch_kernels import holds_window, project
from sfmapp.dense.window import read_reference
from sfmapp.simd.pointers import offset, pointer


@numba.njit(cache=True, nogil=True)
def weigh_layers(
    image_arrays: Images, store_arrays: Store, cell_arrays: Cells, m: int, cell_idx: NDArray[np.int64], first: int,
    last: int, scratch: NDArray[np.float32], loser: NDArray[np.int32],
) -> None:  # fmt: skip
    """Of two patches in one cell of view m, which its image contradicts: patches to ``loser[first:last]``, -1 for none.

    ``cell_idx``: cells with two layers. Each patch is asked about its own pixel: which of the two planes explains it?
    """
    images, store, cells = image_pointers(image_arrays), store_pointers(store_arrays), cell_pointers(cell_arrays)
    work = pointer(scratch)
    quads, width = offset(images.quads, images.start[m]), images.width[m]
    contrast = f32(CONTRAST) * images.noise[m] + f32(LEAST_CONTRAST)
    for i in range(first, last):
        loser[i] = -1
        worst = BETTER
        for layer in range(LAYERS):
            p = cells.patch[LAYERS * cell_idx[i] + layer]
            q = cells.patch[LAYERS * cell_idx[i] + LAYERS - 1 - layer]
            uf, vf, _ = project(images, m, offset(store.xyz, 3 * p))
            u, v = np.int32(math.floor(uf + 0.5)), np.int32(math.floor(vf + 0.5))
            if not holds_window(images, m, u, v):
                continue
            if read_reference(quads, width, u, v, contrast, work) < f32(LEAST_DEVIATION) * images.noise[m]:
                continue
            own = zncc_with_patch(images, store, m, f32(u), f32(v), p, work)
            other = zncc_with_patch(images, store, m, f32(u), f32(v), q, work)
            if own > f32(-1.0) and other - own > worst:
                loser[i], worst = p, other - own


@numba.njit(cache=True, nogil=True)
def take_trust(
    store_arrays: Store, cell_arrays: Cells, m: int, cell_idx: NDArray[np.int64], loser: NDArray[np.int32]
) -> None:
    """View m no longer trusts the patches of ``loser``; those that have it as their reference image lose all views."""
    store, cells = store_pointers(store_arrays), cell_pointers(cell_arrays)
    for i in range(cell_idx.shape[0]):
        p = np.int64(loser[i])
        if p < 0:
            continue
        g = cell_idx[i]
        if cells.patch[LAYERS * g] == p:
            cells.patch[LAYERS * g] = cells.patch[LAYERS * g + 1]
        cells.patch[LAYERS * g + 1] = np.int32(-1)
        num = np.int64(store.num_views[p])
        if store.views[p * store.row] == m:
            store.num_views[p] = 0
            continue
        left = 0
        for j in range(num):
            if store.views[p * store.row + j] != m:
                store.views[p * store.row + left] = store.views[p * store.row + j]
                left += 1
        for j in range(left, num):
            store.views[p * store.row + j] = -1
        store.num_views[p] = left
