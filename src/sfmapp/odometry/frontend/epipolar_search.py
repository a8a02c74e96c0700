"""Search along epipolar curves: for the other image of a stereo pair, and for new points between keyframes.

Correlation over candidates on a coarse level, then alignment on the finer ones. The candidates are positions, so the
caller may take them through any lens. Where two of them look alike on the coarse level, both are aligned, and what the
image itself shows decides.
"""

from __future__ import annotations

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
from sfmapp.odometry.frontend.pyramid import Pyramid, build_pyramid

_LEVEL = 1  # on which candidates are compared
_HALF_WIDTH = 5
_MIN_ZNCC = 0.8  # on both levels
# pixels of the search level from the best candidate within which others are the same peak
_PEAK_PX = 2.5
# What is missing to a correlation of 1 is the square of the difference of the patches; a match is the only one where
# the next peak differs by half as much again in amplitude, 1.5^2.
_UNIQUE = 2.25
# missing correlation that noise, sampling and slant alone can make up
_NOISE = 0.02
# pixels of the search level by which the alignment may leave its candidate
_MAX_LEAVE_PX = 3.0


class _Peaks(NamedTuple):
    """The first and the second peak of each curve.

    Attributes:
        candidate: (N, 2) int64, -1 where there is none.
        zncc: (N, 2) float32.
    """

    candidate: NDArray[np.int64]
    zncc: Floats


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _search(
    reference: Pyramid, xy: Doubles, target: Pyramid, segments: Doubles, counts: NDArray[np.int64], level: int,
    window: Floats, peaks: _Peaks,
) -> None:  # fmt: skip
    scratch, hessian, scores = np.zeros(SCRATCH, np.float32), np.empty(4), np.empty(segments.shape[1], np.float32)
    start, step, height, width = target.layout[level]
    first, scale, half, unwarped = reference.layout[0], 0.5**level, _HALF_WIDTH, np.eye(2)
    best, best_score = peaks.candidate, peaks.zncc
    for i in range(xy.shape[0]):
        best[i, 0], best[i, 1], best_score[i, 0], best_score[i, 1] = -1, -1, 0.0, 0.0
        if not (0.0 <= xy[i, 0] <= first[3] and 0.0 <= xy[i, 1] <= first[2]):
            continue
        shift = prepare_patch(
            reference.data, reference.layout, level, xy[i, 0], xy[i, 1], unwarped, False, half, window, scratch, hessian
        )
        if not hessian[3] > 0.0:
            continue
        for k in range(counts[i]):
            x, y = segments[i, k, 0] * scale, segments[i, k, 1] * scale
            scores[k] = 0.0
            if 0.0 <= x <= width and 0.0 <= y <= height:
                left, top = x - 0.5 - half, y - 0.5 - half
                c, r = int(np.floor(left)), int(np.floor(top))
                at, fx, fy = start + r * step + c, left - c, top - r
                scores[k] = correlate(
                    target.data, at, step, fx, fy, 2 * half + 1, scratch, abs(shift), hessian[3]
                )  # fmt: skip
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
    is_unique: NDArray[np.bool_] = _UNIQUE * np.maximum(1.0 - first, _NOISE) < np.maximum(1.0 - second, _NOISE)
    return is_unique


def search_along_epipolar(
    reference: Pyramid, reference_xy: Doubles, target: Pyramid, segments: Doubles, counts: NDArray[np.int64]
) -> Matches:
    """Find points of one image in another where only a curve is known for each.

    Args:
        reference, target: pyramids of the two images.
        reference_xy: (N, 2) float64 pixels.
        segments: (N, P, 2) float64 pixels, places in the target, in order along each curve, two pixels apart or less;
            those outside the image are passed over.
        counts: (N,) how many of the P are given.
    """
    xy1 = np.ascontiguousarray(reference_xy, np.float64).reshape(-1, 2)
    places = np.ascontiguousarray(segments, np.float64)
    counts = np.ascontiguousarray(counts, np.int64)
    num, level = len(xy1), min(_LEVEL, reference.num_levels - 1, target.num_levels - 1)
    peaks = _Peaks(np.full((num, 2), -1, np.int64), np.zeros((num, 2), np.float32))
    _search(reference, xy1, target, places, counts, level, patch_window(_HALF_WIDTH), peaks)
    best, score = peaks.candidate, peaks.zncc

    found = np.flatnonzero(score[:, 0] >= _MIN_ZNCC)
    first = _align(reference, xy1[found], target, places[found, best[found, 0]], level)
    is_found = np.zeros(num, np.bool_)
    is_found[found] = first.is_converged & (first.zncc >= _MIN_ZNCC)
    xy, zncc = np.full((num, 2), np.nan), np.zeros(num, np.float32)
    xy[found], zncc[found] = first.xy, first.zncc
    rivals = np.flatnonzero(is_found & ~_is_unique(score[:, 0], score[:, 1]))
    second = _align(reference, xy1[rivals], target, places[rivals, best[rivals, 1]], level)
    rival = np.where(second.is_converged, second.zncc, 0.0)
    is_found[rivals] = _is_unique(zncc[rivals], rival) | _is_unique(rival, zncc[rivals]) & (rival >= _MIN_ZNCC)
    better = rival > zncc[rivals]
    xy[rivals[better]], zncc[rivals[better]] = second.xy[better], second.zncc[better]
    xy[~is_found] = np.nan
    return Matches(xy, zncc, is_found)


def _align(reference: Pyramid, xy: Doubles, target: Pyramid, start: Doubles, level: int) -> Alignment:
    """Align some points from their candidates; not converged where the result is far from its candidate."""
    result = align_patches(reference, xy, target, start, coarsest_level=level, half_width=_HALF_WIDTH)
    near = np.abs(result.xy - start).max(axis=1, initial=0.0) <= _MAX_LEAVE_PX * 2.0**level
    return Alignment(result.xy, result.zncc, result.is_converged & near)


def compile_kernels() -> None:
    """Compile, or load from the cache, what this module runs."""
    pyramid, xy = build_pyramid(np.zeros((40, 40), np.uint8)), np.full((1, 2), 20.0)
    search_along_epipolar(pyramid, xy, pyramid, xy[:, None], np.ones(1, np.int64))
