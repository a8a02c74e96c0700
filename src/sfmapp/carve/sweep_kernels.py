"""Kernels of the plane sweep: costs of 64 planes of a pixel are one vector of bytes, as in semi-global matching."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.simd import u8x64 as u8
from sfmapp.simd.bits import first_bit
from sfmapp.simd.pointers import Index, Pointer, pointer
from sfmapp.stereo.semiglobal_kernels import (
    GAP,
    LANES,
    STRIDE,
    Bytes,
    Found,
    Rows,
    Views,
    Words,
    between_lanes,
    clear,
    cost_of_unseen,
    smooth_columns,
    smoothed,
)

# the word where a neighbour shows nothing: the census has 48 bits
UNSEEN_WORD = ~np.uint64(0)
# a neighbour that shows nothing differs in all bits of a word
_ALL_BITS = np.uint8(64)
# a plane so near to the neighbour's own centre, as a share of the depth of the middle plane, is not projected
_LEAST_DEPTH = 0.05


class Neighbours(NamedTuple):
    """What N other photographs show, each brought to the reference's picture by the plane in the middle of the sweep.

    Attributes:
        words: flat uint64, census words of all of them; UNSEEN_WORD outside of their pictures.
        start, width, height, left, top: (N,) int64, where each one begins, its size, and the pixel of the reference at
            which its first word lies.
        epipole: (N, 3) float64: a pixel (x, y) of the reference is seen at ``(x, y, 1) + d epipole``, where d is the
            inverse depth beyond that of the middle plane.
    """

    words: Words
    start: NDArray[np.int64]
    width: NDArray[np.int64]
    height: NDArray[np.int64]
    left: NDArray[np.int64]
    top: NDArray[np.int64]
    epipole: NDArray[np.float64]


@numba.njit(cache=True, nogil=True)
def _look_up(
    seen: Neighbours, n: Index, x: float, y: float, first: float, step: float, own: np.uint64, words: Words
) -> None:
    """Words (64,) of neighbour n at the nearest pixel to where planes from inverse depth ``first`` on show (x, y); the
    opposite of one's own where it shows nothing."""
    e0, e1, e2 = seen.epipole[n, 0], seen.epipole[n, 1], seen.epipole[n, 2]
    left, top, width, height, start = seen.left[n], seen.top[n], seen.width[n], seen.height[n], seen.start[n]
    for k in range(LANES):
        d = first + k * step
        z = 1.0 + d * e2
        word = UNSEEN_WORD
        if z > _LEAST_DEPTH:
            u = np.int64(np.floor((x + d * e0) / z)) - left
            v = np.int64(np.floor((y + d * e1) / z)) - top
            if u >= 0 and u < width and v >= 0 and v < height:
                word = seen.words[start + v * width + u]
        words[k] = ~own if word == UNSEEN_WORD else word


@numba.njit(cache=True, nogil=True)
def _raw_costs(
    views: Views, seen: Neighbours, planes: tuple[float, float], unseen: np.uint8, y: Index, words: Words, out: Pointer
) -> None:
    """Differing bits of row y for all planes: the mean of the two neighbours that fit best.

    Of several, those in front of which something stands fit worst (Kang, Szeliski and Chai, "Handling occlusions in
    dense multi-view stereo", CVPR 2001).
    """
    nothing, looked = u8.splat(_ALL_BITS), pointer(words)
    for x in range(views.grey.shape[1]):
        first = planes[0] + planes[1] * views.base[y, x]
        best = second = nothing
        for n in range(seen.start.shape[0]):
            _look_up(seen, n, x + 0.5, y + 0.5, first, planes[1], views.left[y, x], words)
            bits = u8.count_differences(views.left[y, x], looked, 0)
            second = u8.minimum(second, u8.maximum(best, bits))
            best = u8.minimum(best, bits)
        cost = u8.select_equal(second, nothing, best, u8.mean(best, second))
        least = u8.lowest(cost)
        instead = unseen if least == _ALL_BITS else cost_of_unseen(unseen, least)
        u8.store(out, GAP + STRIDE * x, u8.select_equal(cost, nothing, u8.splat(instead), cost))


@numba.njit(cache=True, nogil=True)
def fill_costs(
    views: Views, seen: Neighbours, planes: tuple[float, float], unseen: np.uint8, band: tuple[int, int],
    scratch: tuple[Bytes, Words], rows: Rows,
) -> None:  # fmt: skip
    """Costs of a band of rows, from the first to before the last.

    Args:
        planes: inverse depth of the first plane less that of the middle, and the step from plane to plane.
        unseen: cost of what no neighbour shows.
        scratch: (4, GAP + STRIDE W) and (64,).
    """
    raw, words = scratch
    (height, width), ring, doubt = views.grey.shape, rows.costs.shape[0], pointer(views.doubt)
    clear(raw)
    for y in range(max(band[0] - 1, 0), min(band[0] + 1, height)):
        _raw_costs(views, seen, planes, unseen, y, words, pointer(raw[y % 3]))
    for y in range(band[0], band[1]):
        if y + 1 < height:
            _raw_costs(views, seen, planes, unseen, y + 1, words, pointer(raw[(y + 1) % 3]))
        smooth_columns(views.base, y, raw)
        middle, costs = pointer(raw[3]), pointer(rows.costs[y % ring])
        for x in range(width):
            cost = smoothed(views.base, y, x, middle)
            u8.store(costs, LANES * x, u8.add(cost, u8.load(doubt, LANES * np.int64(views.expected[y, x]))))


@numba.njit(cache=True, nogil=True)
def decide(views: Views, band: tuple[int, int], rows: Rows, found: Found) -> None:
    """The plane of least cost of each pixel of a band of rows, and a place between planes."""
    ring = rows.costs.shape[0]
    for y in range(band[0], band[1]):
        above, below = pointer(rows.above[y % ring]), pointer(rows.below[y % ring])
        for x in range(views.grey.shape[1]):
            value = u8.add(u8.load(above, LANES * x), u8.load(below, LANES * x))
            u8.store(above, LANES * x, value)
            best = u8.lowest(value)
            k = first_bit(u8.lanes_equal(value, u8.splat(best)))
            found.best[y, x] = best
            found.elsewhere[y, x] = u8.lowest(u8.hide(value, k))
            shift, bend = np.float32(0.0), np.int64(0)
            if k > 0 and k < LANES - 1:
                shift, bend = between_lanes(above, LANES * x + k, np.int64(best))
            found.disparity[y, x] = np.float32(views.base[y, x] + k) + shift
            found.bend[y, x] = np.int16(bend)
            found.agrees[y, x] = np.uint8(1)
