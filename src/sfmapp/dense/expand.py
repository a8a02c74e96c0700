"""Waves: patches grow into the empty cells beside them, all cells of a view at once.

Furukawa and Ponce expand from a queue, one patch after the other. Here the cells that border on new patches are tried
together, each by itself, from the state at the beginning of the wave, and what was found is entered in the order of
the cells: threads share the work, and the result does not depend on how many there are.
"""

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
    Limits,
    Store,
    StorePointers,
    cell_pointers,
    image_pointers,
    store_pointers,
)
from sfmapp.dense.patch_kernels import (
    APART,
    Trial,
    cell_of,
    cell_size,
    holds_window,
    judge,
    measure,
    off_planes,
    plane_in_view,
    project,
    refine,
    unproject,
)
from sfmapp.dense.visibility import are_excused
from sfmapp.dense.window import BEST, HALF, MOST_SLOTS, RHOS, read_reference
from sfmapp.simd.pointers import Index, Pointer, offset, pointer

CANDIDATES = 3
# a cell that has failed so often is left alone until the next round
MOST_TRIES = 3
# what is known of a cell beside the number of tries: it waits for the next wave; a patch was one image short
WAITING, SHORT = np.uint8(128), np.uint8(64)
TRIES = np.uint8(63)
# NCC of what is in a cell from which no second layer is looked for, and by how much that has to be better
CONTENT, BETTER = f32(0.85), f32(0.05)
# planes that differ by less than this across the window are one candidate
SAME_PX = f32(0.15)
# images that choose between candidates
NUM_CHOOSING = 3
# a pixel of the window has a quarter of the weight of the centre where it differs from it by this many deviations of
# the noise, and by this many grey levels more
CONTRAST, LEAST_CONTRAST = 6.0, 20.0
# deviation of a window, in those of the noise, below which it shows nothing
LEAST_DEVIATION = 1.0
# and the deviation up to which noise keeps windows of the same place from agreeing: the NCC of two such windows is
# 1 - (noise / deviation)^2 on average, and has to pass the threshold of trust by as much as it varies
CLEAR_DEVIATION = 2.5


@numba.njit(cache=True, nogil=True)
def frontier(
    image_arrays: Images, store_arrays: Store, cell_arrays: Cells, m: int, fresh: NDArray[np.int32], num_fresh: int,
    places: NDArray[np.int32], candidates: NDArray[np.int32],
) -> int:  # fmt: skip
    """Cells of view m to try next to cells that were filled: pixels to ``places``, patches to grow to ``candidates``.

    ``fresh[:num_fresh]``: filled cells, counted within the view; num_fresh < 0: all cells with filled neighbours are
    looked for. Returns their number.
    """
    images, store, cells = image_pointers(image_arrays), store_pointers(store_arrays), cell_pointers(cell_arrays)
    start, columns, rows = images.cell_start[m], np.int64(images.columns[m]), np.int64(images.rows[m])
    places_, candidates_ = pointer(places), pointer(candidates)
    n = 0
    if num_fresh < 0:
        for y in range(rows):
            for x in range(columns):
                if _may_be_tried(images, cells, m, x, y):
                    place, row = offset(places_, 2 * n), offset(candidates_, CANDIDATES * n)
                    n += _offer(images, store, cells, m, x, y, place, row)
        return n
    for i in range(num_fresh):
        cy = fresh[i] // columns
        cx = fresh[i] - cy * columns
        for y in range(max(cy - 1, 0), min(cy + 2, rows)):
            for x in range(max(cx - 1, 0), min(cx + 2, columns)):
                g = start + y * columns + x
                if cells.tried[g] >= WAITING or not _may_be_tried(images, cells, m, x, y):
                    continue
                place, row = offset(places_, 2 * n), offset(candidates_, CANDIDATES * n)
                if _offer(images, store, cells, m, x, y, place, row):
                    cells.tried[g] |= WAITING
                    n += 1
    for i in range(n):
        g = start + np.int64(places[i, 1] // images.cell_px) * columns + places[i, 0] // images.cell_px
        cells.tried[g] &= ~WAITING
    return n


@numba.njit(cache=True, nogil=True)
def _may_be_tried(images: ImagePointers, cells: CellPointers, m: int, x: int, y: int) -> bool:
    """The cell has room for a patch, its window lies in the image, and it has not failed too often."""
    g = images.cell_start[m] + y * images.columns[m] + x
    if images.closed[g] != 0 or cells.patch[LAYERS * g + LAYERS - 1] >= 0 or (cells.tried[g] & TRIES) >= MOST_TRIES:
        return False
    u, v = x * images.cell_px + images.cell_px // 2, y * images.cell_px + images.cell_px // 2
    return holds_window(images, m, u, v)


@numba.njit(cache=True, nogil=True)
def _offer(
    images: ImagePointers, store: StorePointers, cells: CellPointers, m: int, x: Any, y: Any, place: Pointer,
    row: Pointer,
) -> int:  # fmt: skip
    """Enter a cell as one to be tried if a patch beside it can grow into it: the best-scored candidates first."""
    start, columns, rows = images.cell_start[m], np.int64(images.columns[m]), np.int64(images.rows[m])
    g = start + y * columns + x
    there = cells.patch[LAYERS * g]
    count: Any = np.int64(0)
    for ny in range(max(y - 1, 0), min(y + 2, rows)):
        for nx in range(max(x - 1, 0), min(x + 2, columns)):
            if nx == x and ny == y:
                continue
            for layer in range(LAYERS):
                p = cells.patch[LAYERS * (start + ny * columns + nx) + layer]
                if p < 0:
                    break
                # what grows is the surface that is not in the cell yet
                if there >= 0 and off_planes(store, p, store, there) < f32(APART) * cell_size(images, store, p):
                    continue
                count = _insert(store, row, count, p)
    if count == 0:
        return 0
    for j in range(count, CANDIDATES):
        row[j] = -1
    place[0], place[1] = x * images.cell_px + images.cell_px // 2, y * images.cell_px + images.cell_px // 2
    cells.tried[g] += 1
    return 1


@numba.njit(cache=True, nogil=True)
def _insert(store: StorePointers, row: Pointer, count: int, p: int) -> int:
    """Keep the best CANDIDATES patches of a row sorted by score; their new number."""
    for j in range(count):
        if row[j] == p:
            return count
    j = min(count, CANDIDATES - 1)
    if count == CANDIDATES and store.score[row[j]] >= store.score[p]:
        return count
    while j > 0 and store.score[row[j - 1]] < store.score[p]:
        row[j] = row[j - 1]
        j -= 1
    row[j] = p
    return min(count + 1, CANDIDATES)


@numba.njit(cache=True, nogil=True)
def try_cells(
    image_arrays: Images, store_arrays: Store, own_arrays: Store, cell_arrays: Cells, m: int, places: NDArray[np.int32],
    candidates: NDArray[np.int32], part: tuple[int, int], limits: Limits, wave: int, scratch: NDArray[np.float32],
    found_arrays: Store,
) -> None:  # fmt: skip
    """Grow patches into cells ``part[0]`` to ``part[1]`` of view m; results at the same positions of what is found.

    With a negative wave the patches are those of a coarser level, and their own waves are passed on.
    """
    images, store, found = image_pointers(image_arrays), store_pointers(store_arrays), store_pointers(found_arrays)
    cells, own = cell_pointers(cell_arrays), store_pointers(own_arrays)
    slot_array, work = np.empty(MOST_SLOTS, np.int64), pointer(scratch)
    trial = Trial(offset(work, BEST), pointer(slot_array), offset(work, RHOS), work)
    quads, width = offset(images.quads, images.start[m]), images.width[m]
    contrast = f32(CONTRAST) * images.noise[m] + f32(LEAST_CONTRAST)
    for i in range(part[0], part[1]):
        found.num_views[i] = 0
        u, v = places[i, 0], places[i, 1]
        deviation = read_reference(quads, width, u, v, contrast, work)
        uf, vf = f32(u), f32(v)
        candidate = offset(pointer(candidates), CANDIDATES * i)
        if deviation < f32(LEAST_DEVIATION) * images.noise[m]:
            continue
        there = cells.patch[LAYERS * cell_of(images, m, u, v)] if wave >= 0 else np.int32(-1)
        known = zncc_with_patch(images, store, m, uf, vf, there, work) if there >= 0 else f32(-1.0)
        if known > CONTENT:
            continue
        parent = choose(images, store, m, uf, vf, candidate, work)
        if parent < 0:
            continue
        n = slots_of(images, store, m, parent, trial.slots, limits.max_refined)
        if n < limits.min_views - 1:
            continue
        n, sigma = refine(images, m, uf, vf, trial, n, limits)
        if n <= 0 or not judge(images, m, uf, vf, trial, n, sigma, limits, found, i):
            if is_one_short(n, trial.rhos, limits):
                cells.tried[cell_of(images, m, u, v)] |= SHORT
            if wave < 0 and n > 0 and deviation < f32(CLEAR_DEVIATION) * images.noise[m]:
                inherit(images, store, m, uf, vf, parent, found, i)
            continue
        if found.num_views[i] < limits.enough and not are_excused(images, own, cells, found, i):
            found.num_views[i] = 0
            continue
        found.wave[i] = wave if wave >= 0 else store.wave[parent]
        if there >= 0 and not is_second_layer(images, store, there, known, found, i):
            found.num_views[i] = 0
    slot_array[0] = 0


@numba.njit(cache=True, nogil=True)
def is_second_layer(
    images: ImagePointers, store: StorePointers, there: Index, known: float, found: StorePointers, i: int
) -> bool:
    """Whether what was found explains the pixel better than patch ``there`` does, whose NCC is ``known``, and has not
    slid back onto it."""
    reach = f32(APART) * cell_size(images, found, i)
    return found.score[i] >= known + BETTER and not off_planes(found, i, store, there) < reach


@numba.njit(cache=True, nogil=True)
def is_one_short(n: int, rhos: Pointer, limits: Limits) -> bool:
    """Whether a patch was refused, by refinement (n < 0) or the verdict (n > 0), that one image fewer would trust."""
    left = limits.min_views - 2
    return left > 0 and (n == -left or (n > 0 and rhos[left - 1] >= f32(limits.trusted)))


@numba.njit(cache=True, nogil=True)
def retry(cell_arrays: Cells) -> None:
    """Let cells be tried again in which a patch was one image short, and no others that were tried."""
    cells = cell_pointers(cell_arrays)
    for g in range(cell_arrays.tried.shape[0]):
        if cells.tried[g] & SHORT:
            cells.tried[g] = SHORT
        elif cells.tried[g] & TRIES:
            cells.tried[g] = MOST_TRIES


@numba.njit(cache=True, nogil=True)
def inherit(
    images: ImagePointers, store: StorePointers, m: int, u: float, v: float, p: int, found: StorePointers, i: int
) -> None:
    """Enter the patch of a coarser level as it is at ``found[i]``, where pixel (u, v) of view m looks at its plane."""
    row, num = p * store.row, np.int64(store.num_views[p])
    is_trusted = False
    for j in range(num):
        is_trusted = is_trusted or store.views[row + j] == m
    normal = offset(store.normal, 3 * p)
    wu, wv, w = plane_in_view(images, m, offset(store.xyz, 3 * p), normal)
    w0 = wu * u + wv * v + w
    if not is_trusted or not w0 > 0.0:
        return
    k, z = offset(images.k, 4 * m), 1.0 / w0
    unproject(images, m, u, v, z, offset(found.xyz, 3 * i))
    for j in range(3):
        found.normal[3 * i + j] = normal[j]
    found.score[i], found.sigma[i] = store.score[p], store.sigma[p]
    found.size[i], found.wave[i] = z / (0.5 * (k[0] + k[1])), store.wave[p]
    found.views[i * found.row] = m
    at = 1
    for j in range(num):
        if store.views[row + j] != m:
            found.views[i * found.row + at] = store.views[row + j]
            at += 1
    for j in range(num, found.row):
        found.views[i * found.row + j] = -1
    found.num_views[i] = num


@numba.njit(cache=True, nogil=True)
def slots_of(images: ImagePointers, store: StorePointers, m: int, p: int, slots: Pointer, most: int) -> int:
    """Slots of view m that trust patch p, best first, filled up with its best neighbours; their number."""
    n = 0
    for j in range(store.num_views[p]):
        s = np.int64(store.views[p * store.row + j])
        if s != m and n < most and images.slot[m * images.num_views + s] >= 0:
            slots[n] = images.slot[m * images.num_views + s]
            n += 1
    for slot in range(images.num_slots):
        if n >= most or images.neighbors[m * images.num_slots + slot] < 0:
            break
        is_there = False
        for j in range(n):
            is_there = is_there or slots[j] == slot
        if not is_there:
            slots[n] = slot
            n += 1
    return n


@numba.njit(cache=True, nogil=True)
def choose(images: ImagePointers, store: StorePointers, m: int, u: float, v: float, row: Pointer, work: Pointer) -> int:
    """The candidate whose plane, carried on to (u, v), the images like best; its plane at BEST; -1 for none."""
    chosen, liking = -1, f32(-2.0)
    best = offset(work, BEST)
    is_alone = row[1] < 0
    for j in range(CANDIDATES):
        p = row[j]
        if p < 0:
            break
        wu, wv, w = plane_in_view(images, m, offset(store.xyz, 3 * p), offset(store.normal, 3 * p))
        w0, wx, wy = f32(wu * u + wv * v + w), f32(wu), f32(wv)
        if not w0 > f32(0.0):
            continue
        if not is_alone:
            if chosen >= 0:
                # relative differences of inverse depth, in pixels by way of the focal length
                off = abs(w0 - best[0]) + f32(HALF) * (abs(wx - best[1]) + abs(wy - best[2]))
                if off * f32(images.k[4 * m]) < SAME_PX * w0:
                    continue
            like = _liking(images, store, m, u, v, p, w0, wx, wy, work)
            if not like > liking:
                continue
            liking = like
        chosen = p
        best[0], best[1], best[2] = w0, wx, wy
        if liking > CONTENT:
            break
    return chosen


@numba.njit(cache=True, nogil=True)
def zncc_with_patch(
    images: ImagePointers, store: StorePointers, m: int, u: float, v: float, p: Index, work: Pointer
) -> float:
    """Mean NCC of a patch, seen from view m at (u, v), with the first images that trust it."""
    wu, wv, w = plane_in_view(images, m, offset(store.xyz, 3 * p), offset(store.normal, 3 * p))
    w0 = f32(wu * u + wv * v + w)
    return _liking(images, store, m, u, v, p, w0, f32(wu), f32(wv), work) if w0 > f32(0.0) else f32(-1.0)


@numba.njit(cache=True, nogil=True)
def _liking(
    images: ImagePointers, store: StorePointers, m: int, u: float, v: float, p: Index, w0: float, wx: float, wy: float,
    work: Pointer,
) -> float:  # fmt: skip
    """Mean NCC of a plane with the first images that trust its patch; -1 if none is a neighbour of view m."""
    total, asked = f32(0.0), 0
    for i in range(store.num_views[p]):
        s = np.int64(store.views[p * store.row + i])
        if s == m or images.slot[m * images.num_views + s] < 0:
            continue
        total += measure(images, m, np.int64(images.slot[m * images.num_views + s]), u, v, w0, wx, wy, work)
        asked += 1
        if asked == NUM_CHOOSING:
            break
    return total / f32(asked) if asked > 0 else f32(-1.0)


@numba.njit(cache=True, nogil=True)
def enter(
    image_arrays: Images, store_arrays: Store, cell_arrays: Cells, count: int, found: Store, num_found: int,
    fresh: NDArray[np.int32], num_fresh: NDArray[np.int64],
) -> int:  # fmt: skip
    """Append what was found to the store, and to the cells of all images that trust it; returns the new count.

    Newly filled cells are noted in ``fresh`` (V, room), ``num_fresh`` (V,): -1 there means that there was no room.
    """
    images, store, cells = image_pointers(image_arrays), store_pointers(store_arrays), cell_pointers(cell_arrays)
    for i in range(num_found):
        if found.num_views[i] == 0:
            continue
        p = count
        for j in range(3):
            store.xyz[3 * p + j], store.normal[3 * p + j] = found.xyz[i, j], found.normal[i, j]
        store.score[p], store.sigma[p], store.size[p] = found.score[i], found.sigma[i], found.size[i]
        store.num_views[p], store.wave[p] = found.num_views[i], found.wave[i]
        for j in range(store.row):
            store.views[p * store.row + j] = found.views[i, j]
        place(images, store, cells, p, fresh, num_fresh)
        count += 1
    return count


@numba.njit(cache=True, nogil=True)
def place(
    images: ImagePointers, store: StorePointers, cells: CellPointers, p: int, fresh: NDArray[np.int32],
    num_fresh: NDArray[np.int64],
) -> None:  # fmt: skip
    """Put a patch into the cells of the images that trust it, where none of its surface is."""
    reach = f32(APART) * cell_size(images, store, p)
    for j in range(store.num_views[p]):
        m = np.int64(store.views[p * store.row + j])
        u, v, z = project(images, m, offset(store.xyz, 3 * p))
        g = cell_of(images, m, u, v) if z > 0.0 else np.int64(-1)
        if g < 0:
            continue
        for layer in range(LAYERS):
            q = cells.patch[LAYERS * g + layer]
            if q < 0:
                cells.patch[LAYERS * g + layer] = p
                if num_fresh[m] >= 0:
                    if num_fresh[m] < fresh.shape[1]:
                        fresh[m, num_fresh[m]] = g - images.cell_start[m]
                        num_fresh[m] += 1
                    else:
                        num_fresh[m] = -1
                break
            if q == p or off_planes(store, p, store, q) < reach:
                break
