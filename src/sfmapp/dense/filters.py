"""Which patches stay: those that agree with what other images see and that belong to a surface (the paper's part 4)."""

from __future__ import annotations

from typing import Any

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
    copy_patch,
    image_pointers,
    store_pointers,
)
from sfmapp.dense.expand import place
from sfmapp.dense.patch_kernels import NEAR, cell_of, cell_size, off_planes, project
from sfmapp.geometry.components import find_root
from sfmapp.simd.pointers import Index, offset

# cells to each side that are asked for patches of the same surface, and how many of them have to have one
ASKED_CELLS = 2
LEAST_SUPPORT = 4
# patches that hang together; fewer are no surface
SMALLEST_GROUP = 24


@numba.njit(cache=True, nogil=True)
def refill(
    image_arrays: Images, store_arrays: Store, cell_arrays: Cells, order: NDArray[np.int64], fresh: NDArray[np.int32],
    num_fresh: NDArray[np.int64],
) -> None:  # fmt: skip
    """Empty the cells and put the patches of ``order`` back, the first of a surface in a cell stays."""
    cell_arrays.patch[:] = -1
    images, store, cells = image_pointers(image_arrays), store_pointers(store_arrays), cell_pointers(cell_arrays)
    for i in range(order.shape[0]):
        place(images, store, cells, order[i], fresh, num_fresh)


@numba.njit(cache=True, nogil=True)
def compact(store: Store, kept: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Move the patches that are ``kept`` (N,) bool to the front; (N,) int32 their new positions, -1 for the others."""
    new_idx = np.full(kept.shape[0], -1, np.int32)
    count: Any = np.int64(0)
    for p in range(kept.shape[0]):
        if kept[p]:
            if p != count:
                copy_patch(store, p, count)
            new_idx[p] = count
            count += 1
    return new_idx


@numba.njit(cache=True, nogil=True)
def renumber(cell_arrays: Cells, new_idx: NDArray[np.int32]) -> None:
    """Give the patches in the cells their new positions; -1 takes a patch out, and what is behind it moves up."""
    cells = cell_pointers(cell_arrays)
    for g in range(cell_arrays.patch.shape[0]):
        num_left = 0
        for layer in range(LAYERS):
            p = cells.patch[LAYERS * g + layer]
            if p < 0:
                break
            cells.patch[LAYERS * g + layer] = np.int32(-1)
            if new_idx[p] >= 0:
                cells.patch[LAYERS * g + num_left] = new_idx[p]
                num_left += 1


@numba.njit(cache=True, nogil=True)
def judge_patches(
    image_arrays: Images, store_arrays: Store, cell_arrays: Cells, least_views: int, first: int, last: int,
    keep: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Fill ``keep[first:last]``: 0 kept, 1 contradicted by what images see, 2 without neighbours of its surface."""
    images, store, cells = image_pointers(image_arrays), store_pointers(store_arrays), cell_pointers(cell_arrays)
    for p in range(first, last):
        keep[p] = 0
        if store.num_views[p] < least_views:
            keep[p] = 1
            continue
        reach = f32(2.0 * NEAR) * cell_size(images, store, p)
        against = f32(0.0)
        r = np.int64(store.views[p * store.row])
        for j in range(-1, images.num_slots):
            m = r if j < 0 else np.int64(images.neighbors[r * images.num_slots + j])
            if m < 0:
                break
            against += _contradiction(images, store, cells, p, m, reach)
        if against > f32(store.num_views[p]) * store.score[p]:
            keep[p] = 1
        elif _support(images, store, cells, p, r, reach) < LEAST_SUPPORT:
            keep[p] = 2


@numba.njit(cache=True, nogil=True)
def _contradiction(
    images: ImagePointers, store: StorePointers, cells: CellPointers, p: int, m: Index, reach: float
) -> float:
    """Scores of the patches in p's cell of view m that p would hide, or that would hide p although m trusts it."""
    u, v, z = project(images, m, offset(store.xyz, 3 * p))
    g = cell_of(images, m, u, v) if z > 0.0 else np.int64(-1)
    if g < 0:
        return f32(0.0)
    against = f32(0.0)
    for layer in range(LAYERS):
        q = cells.patch[LAYERS * g + layer]
        if q < 0:
            break
        if q == p or off_planes(store, p, store, q) < f32(2.0) * reach:
            continue
        _, _, depth = project(images, m, offset(store.xyz, 3 * q))
        is_seen = False
        for j in range(store.num_views[p]):
            is_seen = is_seen or store.views[p * store.row + j] == m
        if z < depth or is_seen:
            against += store.score[q]
    return against


@numba.njit(cache=True, nogil=True)
def _support(images: ImagePointers, store: StorePointers, cells: CellPointers, p: int, r: Index, reach: float) -> int:
    """Cells around p in its reference image that hold a patch of its surface."""
    u, v, _ = project(images, r, offset(store.xyz, 3 * p))
    g = cell_of(images, r, u, v)
    if g < 0:
        return 0
    columns, start = np.int64(images.columns[r]), images.cell_start[r]
    cy = (g - start) // columns
    cx = (g - start) - cy * columns
    support = 0
    for y in range(max(cy - ASKED_CELLS, 0), min(cy + ASKED_CELLS + 1, images.rows[r])):
        for x in range(max(cx - ASKED_CELLS, 0), min(cx + ASKED_CELLS + 1, columns)):
            for layer in range(LAYERS):
                q = cells.patch[LAYERS * (start + y * columns + x) + layer]
                if q < 0:
                    break
                if q != p and off_planes(store, p, store, q) < f32(1.5) * reach:
                    support += 1
                    break
    return support


@numba.njit(cache=True, nogil=True)
def group_sizes(
    image_arrays: Images, store_arrays: Store, cell_arrays: Cells, count: int, min_views: int
) -> NDArray[np.int32]:
    """(N,) int32 size of the group of each patch: patches in adjacent cells of one surface hang together, and those
    that ``min_views`` images trust count."""
    images, store, cells = image_pointers(image_arrays), store_pointers(store_arrays), cell_pointers(cell_arrays)
    parent = np.arange(count, dtype=np.int32)
    for m in range(images.num_views):
        start, columns, rows = images.cell_start[m], np.int64(images.columns[m]), np.int64(images.rows[m])
        for y in range(rows):
            for x in range(columns):
                for layer in range(LAYERS):
                    p = cells.patch[LAYERS * (start + y * columns + x) + layer]
                    if p < 0:
                        break
                    if x + 1 < columns:
                        _join(images, store, cells, parent, p, start + y * columns + x + 1)
                    if y + 1 < rows:
                        _join(images, store, cells, parent, p, start + (y + 1) * columns + x)
    # those that a better patch of their surface keeps out of every cell hang together with it
    for p in range(count):
        r = np.int64(store.views[p * store.row])
        u, v, _ = project(images, r, offset(store.xyz, 3 * p))
        g = cell_of(images, r, u, v)
        if g >= 0:
            _join(images, store, cells, parent, p, g)
    sizes = np.zeros(count, np.int32)
    for p in range(count):
        if store.num_views[p] >= min_views:
            sizes[find_root(parent, p)] += 1
    for p in range(count):
        sizes[p] = sizes[find_root(parent, p)]
    return sizes


@numba.njit(cache=True, nogil=True)
def _join(
    images: ImagePointers, store: StorePointers, cells: CellPointers, parent: NDArray[np.int32], p: int, g: int
) -> None:
    for layer in range(LAYERS):
        q = cells.patch[LAYERS * g + layer]
        if q < 0:
            return
        size = max(cell_size(images, store, p), cell_size(images, store, q))
        if q != p and off_planes(store, p, store, q) < f32(2.0 * NEAR) * size:
            a, b = find_root(parent, p), find_root(parent, q)
            if a != b:
                parent[max(a, b)] = min(a, b)
