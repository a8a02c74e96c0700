"""The first patches: corners matched along epipolar lines, sparse points, and the patches of the level before.

A corner of one image is looked for along its epipolar line in the next few, a pixel at a time, where the other image
has a corner as well. Places that correlate there and in a second image are refined, and the best one stays.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import float32 as f32
from numpy.typing import NDArray

from sfmapp.dense.arrays import (
    LAYERS,
    Cells,
    ImagePointers,
    Images,
    Limits,
    Store,
    cell_pointers,
    copy_patch,
    image_pointers,
    store_pointers,
)
from sfmapp.dense.expand import (
    CANDIDATES,
    CONTENT,
    CONTRAST,
    LEAST_CONTRAST,
    is_second_layer,
    slots_of,
    zncc_with_patch,
)
from sfmapp.dense.patch_kernels import Trial, cell_of, holds_window, judge, measure, project, refine
from sfmapp.dense.window import BEST, HALF, MOST_SLOTS, RHOS, read_reference
from sfmapp.simd.pointers import Pointer, offset, pointer

# NCC of a fronto-parallel window with one image, and on average with two, from which a place is worth refining
LEAST_LIKENESS, LEAST_SUPPORT = f32(0.55), f32(0.5)
NUM_KEPT = 3


def corners(gray: NDArray[np.uint8], block_px: int, noise: float) -> NDArray[np.int32]:
    """(N, 2) int32 pixels x, y of the strongest corner in each block of so many pixels, where it stands above noise."""
    import cv2

    # three pixels: the window of the smaller eigenvalue (Shi and Tomasi, CVPR 1994)
    strength = cv2.cornerMinEigenVal(cv2.GaussianBlur(gray, (0, 0), 0.8).astype(np.float32), 3)
    border = HALF + 1
    height, width = (side // block_px for side in gray.shape)
    if height == 0 or width == 0:
        return np.zeros((0, 2), np.int32)
    strength[:border] = strength[-border:] = strength[:, :border] = strength[:, -border:] = 0.0
    blocks = strength[: height * block_px, : width * block_px].reshape(height, block_px, width, block_px)
    blocks = blocks.transpose(0, 2, 1, 3).reshape(height * width, block_px * block_px)
    best = blocks.argmax(axis=1)
    y, x = np.divmod(np.arange(height * width), width)
    places = np.stack([x * block_px + best % block_px, y * block_px + best // block_px], 1)
    # what the noise alone would make of the smaller eigenvalue; Sobel's mask of OpenCV divides by its sum of weights
    floor = (noise / 12.0) ** 2
    strong: NDArray[np.int32] = places[blocks.max(axis=1) > floor].astype(np.int32)
    return strong


class CornerSearch(NamedTuple):
    """Where matches of a corner are looked for.

    Attributes:
        num_neighbors: in so many of the best neighbours.
        has_corner: (G,) bool, the cells of all views where a match may lie.
        depth_range: (V, 2) float64 smallest and largest inverse depth.
    """

    num_neighbors: int
    has_corner: NDArray[np.bool_]
    depth_range: NDArray[np.float64]


@numba.njit(cache=True, nogil=True)
def match_corners(
    image_arrays: Images, m: int, places: NDArray[np.int32], store_arrays: Store, cell_arrays: Cells,
    search: CornerSearch, part: tuple[int, int], limits: Limits, scratch: NDArray[np.float32], found_arrays: Store,
    spare: int,
) -> None:  # fmt: skip
    """Look for corners ``part[0]`` to ``part[1]`` of view m in its neighbours; patches at the same positions of found.

    ``spare``: a position of ``found`` that nobody else uses. What is in a cell already stays; a second layer has to
    explain the corner better.
    """
    images, found = image_pointers(image_arrays), store_pointers(found_arrays)
    store, cells = store_pointers(store_arrays), cell_pointers(cell_arrays)
    slot_array, work = np.empty(MOST_SLOTS, np.int64), pointer(scratch)
    trial = Trial(offset(work, BEST), pointer(slot_array), offset(work, RHOS), work)
    quads, width = offset(images.quads, images.start[m]), images.width[m]
    likes, depths = np.empty(NUM_KEPT, np.float32), np.empty(NUM_KEPT, np.float32)
    contrast = f32(CONTRAST) * images.noise[m] + f32(LEAST_CONTRAST)
    for i in range(part[0], part[1]):
        found.num_views[i] = 0
        u, v = places[i, 0], places[i, 1]
        if not holds_window(images, m, u, v):
            continue
        deviation = read_reference(quads, width, u, v, contrast, work)
        if deviation < f32(2.0) * images.noise[m]:
            continue
        cell = cell_of(images, m, u, v)
        there = cells.patch[LAYERS * cell] if cell >= 0 else np.int32(-1)
        known = zncc_with_patch(images, store, m, f32(u), f32(v), there, work) if there >= 0 else f32(-1.0)
        if known > CONTENT:
            continue
        likes[:] = LEAST_SUPPORT
        depths[:] = f32(-1.0)
        for slot in range(min(images.num_slots, search.num_neighbors)):
            if images.neighbors[m * images.num_slots + slot] < 0:
                break
            _search(images, m, slot, f32(u), f32(v), search, likes, depths, work)
        _refine_best(images, m, f32(u), f32(v), depths, limits, trial, found_arrays, spare, i)
        if there >= 0 and not is_second_layer(images, store, there, known, found, i):
            found.num_views[i] = 0
    slot_array[0] = 0


@numba.njit(cache=True, nogil=True)
def _refine_best(
    images: ImagePointers, m: int, u: float, v: float, depths: NDArray[np.float32], limits: Limits, trial: Trial,
    found_arrays: Store, spare: int, i: int,
) -> None:  # fmt: skip
    """Refine what the search has left of pixel (u, v), and enter the best at position i of ``found``."""
    found, plane, slots = store_pointers(found_arrays), trial.plane, trial.slots
    best = f32(-1.0)
    for j in range(NUM_KEPT):
        if depths[j] <= f32(0.0):
            break
        plane[0], plane[1], plane[2] = depths[j], f32(0.0), f32(0.0)
        n: Any = np.int64(0)  # a literal would have refine and judge compiled twice
        for slot in range(images.num_slots):
            if images.neighbors[m * images.num_slots + slot] >= 0 and n < limits.max_refined:
                slots[n] = slot
                n += 1
        n, sigma = refine(images, m, u, v, trial, n, limits)
        if n > 0 and judge(images, m, u, v, trial, n, sigma, limits, found, spare):
            quality = found.score[spare] * f32(found.num_views[spare])
            if quality > best:
                best = quality
                copy_patch(found_arrays, spare, i)
                found.wave[i] = 0


@numba.njit(cache=True, nogil=True)
def _search(
    images: ImagePointers, m: int, slot: int, u: float, v: float, search: CornerSearch, likes: NDArray[np.float32],
    depths: NDArray[np.float32], work: Pointer,
) -> None:  # fmt: skip
    """Walk the epipolar line of (u, v) in one neighbour, and keep the best places in ``likes`` and ``depths``."""
    pair = m * images.num_slots + slot
    a, b, s = offset(images.a, 9 * pair), offset(images.b, 3 * pair), images.neighbors[pair]
    q0, q1, q2 = a[0] * u + a[1] * v + a[2], a[3] * u + a[4] * v + a[5], a[6] * u + a[7] * v + a[8]
    nearest, farthest = search.depth_range[m, 1], search.depth_range[m, 0]
    low, high = _visible_range(q0, q1, q2, b, farthest, nearest, images.width[s], images.height[s])
    if not low < high:
        return
    w, side, has_corner = low, images.cell_px, search.has_corner
    while w < high:
        scale = q2 + b[2] * w
        x, y = (q0 + b[0] * w) / scale, (q1 + b[1] * w) / scale
        # one pixel further along the line
        ex, ey = (b[0] - x * b[2]) / scale, (b[1] - y * b[2]) / scale
        step = 1.0 / max(math.sqrt(ex * ex + ey * ey), 1e-12)
        at = w
        w += step
        cx, cy = int((x + 0.5) / side), int((y + 0.5) / side)
        if cx < 0 or cy < 0 or cx >= images.columns[s] or cy >= images.rows[s]:
            continue
        if not has_corner[images.cell_start[s] + np.int64(cy) * images.columns[s] + cx]:
            continue
        like = measure(images, m, slot, u, v, f32(at), f32(0.0), f32(0.0), work)
        if like < LEAST_LIKENESS:
            continue
        second = f32(-1.0)
        for other in range(images.num_slots):
            if other != slot and images.neighbors[m * images.num_slots + other] >= 0:
                second = max(second, measure(images, m, other, u, v, f32(at), f32(0.0), f32(0.0), work))
        _keep(f32(0.5) * (like + second), f32(at), likes, depths)


@numba.njit(cache=True, nogil=True)
def _visible_range(
    q0: float, q1: float, q2: float, b: Pointer, low: float, high: float, width: int, height: int
) -> tuple[float, float]:
    """The part of a range of inverse depth in which ``q + b w`` lies in front of the camera and inside its image."""
    # q2 + b2 w > 0, q0 + b0 w > 0, (W - 1) (q2 + b2 w) - (q0 + b0 w) > 0 and so on: each cuts off one side
    for n in range(5):
        if n == 0:
            c, d = q2, b[2]
        elif n == 1:
            c, d = q0, b[0]
        elif n == 2:
            c, d = q1, b[1]
        elif n == 3:
            c, d = (width - 1) * q2 - q0, (width - 1) * b[2] - b[0]
        else:
            c, d = (height - 1) * q2 - q1, (height - 1) * b[2] - b[1]
        if d > 0.0:
            low = max(low, -c / d)
        elif d < 0.0:
            high = min(high, -c / d)
        elif c <= 0.0:
            return 1.0, 0.0
    return low + 1e-9, high - 1e-9


@numba.njit(cache=True, nogil=True)
def _keep(like: float, depth: float, likes: NDArray[np.float32], depths: NDArray[np.float32]) -> None:
    """Insert a place among the best few, sorted."""
    for j in range(likes.shape[0]):
        if like > likes[j]:
            for k in range(likes.shape[0] - 1, j, -1):
                likes[k], depths[k] = likes[k - 1], depths[k - 1]
            likes[j], depths[j] = like, depth
            return


@numba.njit(cache=True, nogil=True)
def try_points(
    image_arrays: Images, m: int, places: NDArray[np.int32], point_arrays: Store, part: tuple[int, int], limits: Limits,
    scratch: NDArray[np.float32], found_arrays: Store,
) -> None:  # fmt: skip
    """Patches at sparse points ``part[0]`` to ``part[1]``, given as a store, in the pixels of view m that show them."""
    images, found = image_pointers(image_arrays), store_pointers(found_arrays)
    slot_array, work = np.empty(MOST_SLOTS, np.int64), pointer(scratch)
    trial = Trial(offset(work, BEST), pointer(slot_array), offset(work, RHOS), work)
    quads, width = offset(images.quads, images.start[m]), images.width[m]
    points = store_pointers(point_arrays)
    contrast = f32(CONTRAST) * images.noise[m] + f32(LEAST_CONTRAST)
    for i in range(part[0], part[1]):
        found.num_views[i] = 0
        u, v = places[i, 0], places[i, 1]
        if not holds_window(images, m, u, v):
            continue
        deviation = read_reference(quads, width, u, v, contrast, work)
        if deviation < f32(2.0) * images.noise[m]:
            continue
        _, _, z = project(images, m, offset(points.xyz, 3 * i))
        n = slots_of(images, points, m, i, trial.slots, limits.max_refined)
        if z <= 0.0 or n < limits.min_views - 1:
            continue
        plane = trial.plane
        plane[0], plane[1], plane[2] = f32(1.0 / z), f32(0.0), f32(0.0)
        n, sigma = refine(images, m, f32(u), f32(v), trial, n, limits)
        if n > 0 and judge(images, m, f32(u), f32(v), trial, n, sigma, limits, found, i):
            found.wave[i] = 0
    slot_array[0] = 0


@numba.njit(cache=True, nogil=True)
def finer_cells(
    images: Images, cells: Cells, m: int, coarse_images: Images, coarse_cells: Cells, places: NDArray[np.int32],
    candidates: NDArray[np.int32],
) -> int:  # fmt: skip
    """Empty cells of view m where the coarser level has patches: pixels to ``places``, patches to ``candidates``."""
    start, columns, rows, side = images.cell_start[m], images.columns[m], images.rows[m], images.cell_px[0]
    coarse_start, coarse_columns, coarse_rows = (
        coarse_images.cell_start[m], coarse_images.columns[m], coarse_images.rows[m],
    )  # fmt: skip
    per_x = coarse_images.width[m] / images.width[m] / coarse_images.cell_px[0]
    per_y = coarse_images.height[m] / images.height[m] / coarse_images.cell_px[0]
    n = 0
    for y in range(rows):
        v = y * side + side // 2
        if v < HALF or v >= images.height[m] - HALF - 1:
            continue
        cy = min(int((v + 0.5) * per_y), coarse_rows - 1)
        for x in range(columns):
            u = x * side + side // 2
            g = start + np.int64(y) * columns + x
            if u < HALF or u >= images.width[m] - HALF - 1 or images.closed[g] != 0 or cells.patch[g, 0] >= 0:
                continue
            cx = min(int((u + 0.5) * per_x), coarse_columns - 1)
            count = 0
            # the patches of the cell itself come first, those beside it fill up
            for layer in range(LAYERS):
                p = coarse_cells.patch[coarse_start + np.int64(cy) * coarse_columns + cx, layer]
                if p >= 0:
                    candidates[n, count] = p
                    count += 1
            for step in range(4):
                nx, ny = cx + (step == 0) - (step == 1), cy + (step == 2) - (step == 3)
                if count == CANDIDATES or nx < 0 or ny < 0 or nx >= coarse_columns or ny >= coarse_rows:
                    continue
                p = coarse_cells.patch[coarse_start + np.int64(ny) * coarse_columns + nx, 0]
                if p >= 0 and (count == 0 or candidates[n, count - 1] != p):
                    candidates[n, count] = p
                    count += 1
            if count == 0:
                continue
            for j in range(count, CANDIDATES):
                candidates[n, j] = -1
            places[n, 0], places[n, 1] = u, v
            n += 1
    return n
