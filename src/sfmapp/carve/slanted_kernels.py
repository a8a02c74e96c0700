"""Slanted planes of a swept map: what neighbouring pixels propose, and Gauss-Newton on the NCC of several photographs.

After Bleyer, Rhemann and Rother, "PatchMatch stereo" (BMVC 2011), and Galliani, Lasinger and Schindler, "Massively
parallel multiview stereopsis by surface normal diffusion" (ICCV 2015): a plane that fits one pixel is tried at others.
The start is not random but what the sweep found, so few rounds do. Windows and steps are those of dense patches.
What the maps of other views tell is tried as well, and the better liked the more of them tell it: after the geometric
consistency of Schoenberger et al., "Pixelwise view selection for unstructured multi-view stereo" (ECCV 2016).
"""

from __future__ import annotations

import numba
import numpy as np
from numba import float32 as f32
from numpy.typing import NDArray

from sfmapp.dense.arrays import ImagePointers, Images, Limits, image_pointers
from sfmapp.dense.expand import CONTRAST, LEAST_CONTRAST, LEAST_DEVIATION
from sfmapp.dense.patch_kernels import Trial, holds_window, measure, refine
from sfmapp.dense.window import MOST_SLOTS, read_reference
from sfmapp.simd.pointers import Index, Pointer, offset, pointer
from sfmapp.stereo.slanted import REACH, slope_along

Map = NDArray[np.float32]

# pixels away, along rows and columns, of those whose planes are tried: of each direction that with the best score
REACHES = (1, 3, 7, 15)
# photographs that tell the score of a plane, those that fit it best, as in the sweep itself
TOLD_BY = 3
# by how much the NCC of another's plane has to be better, and what a plane beyond the sweep's costs where it is sure
LEAST_GAIN, FIRMNESS = f32(0.01), f32(0.03)
# NCC of a photograph that sees it no less than this takes part
PROMISING = 0.4
# what it is worth in NCC that as many other maps as decide tell the same plane: nothing at all leaves up to two points
# fewer right within 1 % on four views of the lego, twice of it up to half a point; eight rendered ones hardly care
SUPPORT = f32(0.2)
_LIMITS = Limits(2, 2, 0.7, PROMISING, 4)


@numba.njit(cache=True, nogil=True)
def _score(
    images: ImagePointers, u: float, v: float, plane: Pointer, work: Pointer, slots: Pointer, rhos: Pointer
) -> float:
    """Mean NCC of a plane at (u, v) where it fits best, photographs sorted best first; -1 if none sees it."""
    for slot in range(images.num_slots):
        rho = measure(images, 0, slot, u, v, plane[0], plane[1], plane[2], work)
        k = slot
        while k > 0 and rhos[k - 1] < rho:
            slots[k], rhos[k] = slots[k - 1], rhos[k - 1]
            k -= 1
        slots[k], rhos[k] = slot, rho
    total, count = f32(0.0), 0
    for slot in range(min(TOLD_BY, images.num_slots)):
        if rhos[slot] > f32(-1.0):
            total += rhos[slot]
            count += 1
    # one alone may agree by chance
    return total / f32(max(count, 2)) if count else f32(-1.0)


@numba.njit(cache=True, nogil=True)
def _proposer(score: Map, x: Index, y: Index, direction: Index) -> tuple[Index, Index]:
    """Of the pixels to one side the one with the best score; (-1, -1) if there is none."""
    dx, dy = (1, 0, -1, 0)[direction], (0, 1, 0, -1)[direction]
    at_x: Index = -1
    at_y: Index = -1
    most = f32(-2.0)
    for reach in REACHES:
        px, py = x + reach * dx, y + reach * dy
        if 0 <= px < score.shape[1] and 0 <= py < score.shape[0] and score[py, px] > most:
            at_x, at_y, most = px, py, score[py, px]
    return at_x, at_y


@numba.njit(cache=True, nogil=True)
def slopes_of(plane: Map, slopes: Map) -> None:
    """Slopes (H, W, 2) along rows and down columns of planes (H, W), zero at the border."""
    height, width = plane.shape
    values = pointer(plane)
    slopes[:] = 0.0
    for y in range(REACH, height - REACH):
        for x in range(REACH, width - REACH):
            here = offset(values, y * width + x)
            slopes[y, x, 0], slopes[y, x, 1] = slope_along(here, 1), slope_along(here, width)


@numba.njit(cache=True, nogil=True)
def _settle(
    images: ImagePointers, u: float, v: float, unit: float, best: Pointer, trial: Pointer, work: Pointer,
    slots: Pointer, rhos: Pointer,
) -> float:  # fmt: skip
    """Move a plane to where it fits best, if that is near and better; the score of what is left."""
    rho = _score(images, u, v, best, work, slots, rhos)
    for j in range(3):
        trial[j] = best[j]
    n = 0
    while n < images.num_slots and n < _LIMITS.max_refined and rhos[n] >= f32(PROMISING):
        n += 1
    if n > 0:
        left, _ = refine(images, 0, u, v, Trial(trial, slots, rhos, work), n, _LIMITS)
        if left > 0 and abs(trial[0] - best[0]) < f32(1.5 * unit):
            after = _score(images, u, v, trial, work, slots, rhos)
            if after >= rho:
                rho = after
                for j in range(3):
                    best[j] = trial[j]
    return rho


@numba.njit(cache=True, nogil=True)
def improve_rows(
    image_arrays: Images, planes: Map, score: Map, sure: Map, unit: float, rows: tuple[int, int], scratch: Map,
    out: Map, out_score: Map,
) -> None:  # fmt: skip
    """One round over rows, from the first to before the last: of the planes of a pixel and of those around it the best,
    moved to where it fits best.

    Args:
        image_arrays: view 0 is the reference, its neighbours are all others.
        planes: (H, W, 3) inverse depth at the pixel and its slopes per pixel, kernel units.
        score: (H, W) of the round before; any but NaN where planes are tried elsewhere.
        sure: (H, W) inverse depth that the sweep is sure of, NaN elsewhere.
        unit: inverse depth from one plane of the sweep to the next.
        scratch: of :func:`sfmapp.dense.window.make_scratch`.
        out, out_score: as planes and score.
    """
    images, work = image_pointers(image_arrays), pointer(scratch)
    width = score.shape[1]
    slots, rhos, best = np.empty(MOST_SLOTS, np.int64), np.empty(MOST_SLOTS, np.float32), np.empty(3, np.float32)
    trial = np.empty(3, np.float32)
    slot_at, rho_at, best_at, trial_at = pointer(slots), pointer(rhos), pointer(best), pointer(trial)
    contrast = f32(CONTRAST) * images.noise[0] + f32(LEAST_CONTRAST)
    for y in range(rows[0], rows[1]):
        for x in range(width):
            for j in range(3):
                out[y, x, j] = best[j] = planes[y, x, j]
            out_score[y, x] = score[y, x]
            if not np.isfinite(planes[y, x, 0]) or not holds_window(images, 0, x, y):
                continue
            deviation = read_reference(images.quads, images.width[0], x, y, contrast, work)
            if deviation < f32(LEAST_DEVIATION) * images.noise[0]:
                continue
            u, v = f32(x), f32(y)
            # what the round before left, and zero only at the start
            own = score[y, x]
            if own == f32(0.0):
                own = _score(images, u, v, best_at, work, slot_at, rho_at)
            own += LEAST_GAIN - _off(sure[y, x], best[0], unit)
            for direction in range(4):
                cx, cy = _proposer(score, x, y, direction)
                if cx < 0 or not np.isfinite(planes[cy, cx, 0]):
                    continue
                trial[1], trial[2] = planes[cy, cx, 1], planes[cy, cx, 2]
                trial[0] = planes[cy, cx, 0] + f32(x - cx) * trial[1] + f32(y - cy) * trial[2]
                if not trial[0] > f32(0.0):
                    continue
                other = _score(images, u, v, trial_at, work, slot_at, rho_at) - _off(sure[y, x], trial[0], unit)
                if other > own:
                    own = other
                    for j in range(3):
                        best[j] = trial[j]
            out_score[y, x] = _settle(images, u, v, unit, best_at, trial_at, work, slot_at, rho_at)
            for j in range(3):
                out[y, x, j] = best[j]


@numba.njit(cache=True, nogil=True)
def _off(sure: float, inverse: float, unit: float) -> float:
    """What a plane costs that is not the one the sweep is sure of: nothing within one plane."""
    if not np.isfinite(sure):
        return f32(0.0)
    return FIRMNESS * f32(min(max(abs(inverse - sure) / unit - 1.0, 0.0), 2.0))


@numba.njit(cache=True, nogil=True)
def take_told_rows(
    image_arrays: Images, planes: Map, told: Map, unit: float, rows: tuple[int, int], scratch: Map, out: Map,
    out_score: Map,
) -> None:  # fmt: skip
    """Of rows, from the first to before the last, the plane of a pixel or that of another view's map that is better,
    moved to where it fits best; own ones that stay are not moved.

    Args:
        image_arrays, unit, scratch, out, out_score: as of :func:`improve_rows`.
        planes: (H, W, 3) as there, NaN where there is none yet.
        told: (K, H, W, 3) planes that other maps tell, NaN where they tell nothing.
    """
    images, work = image_pointers(image_arrays), pointer(scratch)
    slots, rhos, best = np.empty(MOST_SLOTS, np.int64), np.empty(MOST_SLOTS, np.float32), np.empty(3, np.float32)
    trial = np.empty(3, np.float32)
    slot_at, rho_at, best_at, trial_at = pointer(slots), pointer(rhos), pointer(best), pointer(trial)
    contrast = f32(CONTRAST) * images.noise[0] + f32(LEAST_CONTRAST)
    for y in range(rows[0], rows[1]):
        for x in range(planes.shape[1]):
            for j in range(3):
                out[y, x, j] = best[j] = planes[y, x, j]
            out_score[y, x] = f32(-2.0)
            if not holds_window(images, 0, x, y):
                continue
            deviation = read_reference(images.quads, images.width[0], x, y, contrast, work)
            if deviation < f32(LEAST_DEVIATION) * images.noise[0]:
                continue
            u, v = f32(x), f32(y)
            rho, own, moved = f32(-2.0), f32(-2.0), False
            if np.isfinite(best[0]):
                rho = _score(images, u, v, best_at, work, slot_at, rho_at)
                own = rho + _support(told, x, y, best[0], unit) + LEAST_GAIN
            for k in range(told.shape[0]):
                if not np.isfinite(told[k, y, x, 0]) or abs(told[k, y, x, 0] - best[0]) < f32(0.5 * unit):
                    continue
                for j in range(3):
                    trial[j] = told[k, y, x, j]
                other = _score(images, u, v, trial_at, work, slot_at, rho_at) + _support(told, x, y, trial[0], unit)
                if other > own:
                    own, moved = other, True
                    for j in range(3):
                        best[j] = trial[j]
            if moved:
                rho = _settle(images, u, v, unit, best_at, trial_at, work, slot_at, rho_at)
            for j in range(3):
                out[y, x, j] = best[j]
            out_score[y, x] = rho


@numba.njit(cache=True, nogil=True)
def _support(told: Map, x: Index, y: Index, inverse: float, unit: float) -> float:
    """What it is worth that other maps tell this inverse depth: the less the farther off they are, up to a plane."""
    total = f32(0.0)
    for k in range(told.shape[0]):
        if np.isfinite(told[k, y, x, 0]):
            total += f32(max(1.0 - abs(inverse - told[k, y, x, 0]) / unit, 0.0))
    return SUPPORT * min(total / f32(TOLD_BY), f32(1.0))


@numba.njit(cache=True, nogil=True)
def take_islands(plane: Map, slopes: Map, believed: NDArray[np.bool_], least: int) -> None:
    """Believe no pixels (H, W) of which fewer than ``least`` hang together. Neighbours do whose planes and slopes
    (H, W, 2) lead from one to the other within a plane: on surfaces that are seen at a slant planes alone do not."""
    height, width = plane.shape
    seen = np.zeros((height, width), np.bool_)
    waiting = np.empty(height * width, np.int64)
    for start in range(height * width):
        if seen[start // width, start % width] or not believed[start // width, start % width]:
            continue
        waiting[0], count, done = start, 1, 0
        seen[start // width, start % width] = True
        while done < count:
            y, x = waiting[done] // width, waiting[done] % width
            done += 1
            for direction in range(4):
                dx, dy = (1, 0, -1, 0)[direction], (0, 1, 0, -1)[direction]
                p, q = x + dx, y + dy
                if p < 0 or q < 0 or p >= width or q >= height or seen[q, p] or not believed[q, p]:
                    continue
                along = (slopes[y, x, 0] + slopes[q, p, 0]) * dx + (slopes[y, x, 1] + slopes[q, p, 1]) * dy
                if abs(plane[q, p] - plane[y, x] - f32(0.5) * along) <= f32(1.0):
                    seen[q, p] = True
                    waiting[count] = q * width + p
                    count += 1
        if count < least:
            for n in range(count):
                believed[waiting[n] // width, waiting[n] % width] = False
