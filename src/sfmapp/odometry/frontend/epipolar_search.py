"""Search along epipolar curves: for the other image of a stereo pair, and for new points between keyframes.

Correlation over candidates on a coarse level, then alignment on the finer ones. The candidates are positions, so the
caller may take them through any lens. Where two of them look alike on the coarse level, both are aligned, and what the
image itself shows decides.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.odometry.frontend.alignment import (
    SCRATCH,
    Alignment,
    Doubles,
    Floats,
    align_patches,
    correlate,
    patch_window,
    prepare_patch,
)
from sfmapp.odometry.frontend.pyramid import Bytes, Pyramid, build_pyramid

_CHUNK = 64  # points to a task
# pixels of the search level from the best candidate within which others are the same peak
_PEAK_PX = 2.5
# What is missing to a correlation of 1 is the square of the difference of the patches; a match is the only one where
# the next peak differs by half as much again in amplitude, 1.5^2.
_UNIQUE = 2.25
# missing correlation that noise, sampling and slant alone can make up
_NOISE = 0.02
# pixels of the search level by which the alignment may leave its candidate
_MAX_LEAVE_PX = 3.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _search(
    data1: Bytes, layout1: NDArray[np.int64], xy1: Doubles, data2: Bytes, layout2: NDArray[np.int64], segments: Doubles,
    counts: NDArray[np.int64], warps: Doubles, level: int, half: int, window: Floats, scores: Floats,
    best: NDArray[np.int64], best_score: Floats,
) -> None:  # fmt: skip
    """The first and second peak of each point: candidates, -1 where there is none, and correlations."""
    scratch, hessian = np.zeros(SCRATCH, np.float32), np.empty(4)
    start, step, height, width = layout2[level]
    scale = 0.5**level
    is_warped = warps.shape[0] > 0
    for i in range(xy1.shape[0]):
        best[i, 0], best[i, 1], best_score[i, 0], best_score[i, 1] = -1, -1, 0.0, 0.0
        if not (0.0 <= xy1[i, 0] <= layout1[0, 3] and 0.0 <= xy1[i, 1] <= layout1[0, 2]):
            continue
        warp = warps[i if is_warped else 0]
        shift = prepare_patch(
            data1, layout1, level, xy1[i, 0], xy1[i, 1], warp, is_warped, half, window, scratch, hessian
        )
        if not hessian[3] > 0.0:
            continue
        for k in range(counts[i]):
            x, y = segments[i, k, 0] * scale, segments[i, k, 1] * scale
            scores[k] = 0.0
            if 0.0 <= x <= width and 0.0 <= y <= height:
                left, top = x - 0.5 - half, y - 0.5 - half
                c, r = int(np.floor(left)), int(np.floor(top))
                scores[k] = correlate(
                    data2, start + r * step + c, step, left - c, top - r, 2 * half + 1, scratch, abs(shift), hessian[3]
                )
            if scores[k] > best_score[i, 0]:
                best[i, 0], best_score[i, 0] = k, scores[k]
        if best[i, 0] < 0:
            continue
        u, v = segments[i, best[i, 0], 0] * scale, segments[i, best[i, 0], 1] * scale
        for k in range(counts[i]):
            # only a peak counts: the flanks of the first one are as high as you like
            if scores[k] <= best_score[i, 1] or (k > 0 and scores[k - 1] > scores[k]):
                continue
            if k + 1 < counts[i] and scores[k + 1] > scores[k]:
                continue
            dx, dy = segments[i, k, 0] * scale - u, segments[i, k, 1] * scale - v
            if dx * dx + dy * dy > _PEAK_PX * _PEAK_PX:
                best[i, 1], best_score[i, 1] = k, scores[k]


class Matches(NamedTuple):
    """What a search along epipolar curves found.

    Attributes:
        xy: (N, 2) float64 pixels in the target, NaN where not found.
        zncc: (N,) float32 correlation there.
        is_found: (N,) bool; alike, the only place on the curve that is, and aligned.
    """

    xy: Doubles
    zncc: Floats
    is_found: NDArray[np.bool_]


def _is_unique(first: Floats, second: Floats) -> NDArray[np.bool_]:
    return _UNIQUE * np.maximum(1.0 - first, _NOISE) < np.maximum(1.0 - second, _NOISE)


def search_along_epipolar(
    reference: Pyramid, reference_xy: Doubles, target: Pyramid, segments: Doubles, counts: NDArray[np.int64], *,
    affine: Doubles | None = None, search_level: int = 1, half_width: int = 5, min_zncc: float = 0.8, threads: int = 1,
) -> Matches:  # fmt: skip
    """Find points of one image in another where only a curve is known for each.

    Args:
        reference, target: pyramids of the two images.
        reference_xy: (N, 2) float64 pixels.
        segments: (N, P, 2) float64 pixels, places in the target, in order along each curve, a pixel of the search level
            apart or less; those outside the image are passed over.
        counts: (N,) how many of the P are given.
        affine: (N, 2, 2) float64, takes an offset in the target to that in the reference; None: identity.
        search_level: on which candidates are compared.
        half_width: see ``align_patches``.
        min_zncc: least correlation, on both levels.
        threads: how many share the work; the results do not depend on it.
    """
    xy1 = np.ascontiguousarray(reference_xy, np.float64).reshape(-1, 2)
    places = np.ascontiguousarray(segments, np.float64)
    counts = np.ascontiguousarray(counts, np.int64)
    warps = np.empty((0, 2, 2)) if affine is None else np.ascontiguousarray(affine, np.float64).reshape(-1, 2, 2)
    num, level = len(xy1), min(search_level, reference.num_levels - 1, target.num_levels - 1)
    best, score = np.full((num, 2), -1, np.int64), np.zeros((num, 2), np.float32)
    window = patch_window(half_width)

    def work(first: int) -> None:
        part = slice(first, first + _CHUNK)
        _search(
            reference.data, reference.layout, xy1[part], target.data, target.layout, places[part], counts[part],
            warps[part], level, half_width, window, np.empty(places.shape[1], np.float32), best[part], score[part],
        )  # fmt: skip

    _for_chunks(work, num, threads)
    found = np.flatnonzero(score[:, 0] >= min_zncc)
    first = _align(reference, xy1, target, places, best[:, 0], warps, found, level, half_width, threads)
    is_found = np.zeros(num, np.bool_)
    is_found[found] = first.is_converged & (first.zncc >= min_zncc)
    xy, zncc = np.full((num, 2), np.nan), np.zeros(num, np.float32)
    xy[found], zncc[found] = first.xy, first.zncc
    rivals = np.flatnonzero(is_found & ~_is_unique(score[:, 0], score[:, 1]))
    second = _align(reference, xy1, target, places, best[:, 1], warps, rivals, level, half_width, threads)
    rival = np.where(second.is_converged, second.zncc, 0.0)
    is_found[rivals] = _is_unique(zncc[rivals], rival) | _is_unique(rival, zncc[rivals]) & (rival >= min_zncc)
    better = rival > zncc[rivals]
    xy[rivals[better]], zncc[rivals[better]] = second.xy[better], second.zncc[better]
    xy[~is_found] = np.nan
    return Matches(xy, zncc, is_found)


def _align(
    reference: Pyramid, xy1: Doubles, target: Pyramid, places: Doubles, chosen: NDArray[np.int64], warps: Doubles,
    rows: NDArray[np.int64], level: int, half_width: int, threads: int,
) -> Alignment:  # fmt: skip
    """Align some points from their chosen candidates; not converged where the result is far from its candidate."""
    start = places[rows, chosen[rows]]
    result = align_patches(
        reference, xy1[rows], target, start, affine=warps[rows] if len(warps) else None, coarsest_level=level,
        half_width=half_width, threads=threads,
    )  # fmt: skip
    near = np.abs(result.xy - start).max(axis=1, initial=0.0) <= _MAX_LEAVE_PX * 2.0**level
    return Alignment(result.xy, result.zncc, result.is_converged & near)


def _for_chunks(work: Callable[[int], None], num: int, threads: int) -> None:
    starts = range(0, num, _CHUNK)
    if threads > 1 and len(starts) > 1:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(work, starts))
    else:
        for first in starts:
            work(first)


def compile_kernels() -> None:
    """Compile, or load from the cache, what this module runs."""
    pyramid, xy = build_pyramid(np.zeros((40, 40), np.uint8)), np.full((1, 2), 20.0)
    search_along_epipolar(pyramid, xy, pyramid, xy[:, None], np.ones(1, np.int64))
