"""Photographs of one camera at several focal lengths: how they are told apart before any focal length is known.

The map between two photographs of a camera that turned, K2 R K1^-1, says by how much longer the second focal length is
than the first, whatever the first one is. Along the pairs that photographs hang together by, each gets its zoom
against the others; where these fall into groups, far apart beside what they differ by within, each group has a focal
length of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.geometry.homography import refine_homography
from sfmapp.panorama.pairs import MatchedPixels, groups_of

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Groups are so many times as far apart as neighbours within them, and of two photographs on the average. A camera that
# moved makes zooms that are spread evenly or normally: of these 3 % of eight and 1 % of twelve pass for groups.
_APART = 5.0
# of fewer photographs each may have a zoom of its own, and nothing tells how much those of one zoom differ
_FEWEST_FOR_SPREAD = 4
_MEAN_ROUNDS = 10
# of logarithms of zooms: what distortion makes of that of a pair, on rendered rings half of it
_SMALL = 1e-3
# of so many matches of a pair its homography is refined; pixels that count as one unit there, and the step of a slope
_MATCHES_OF_PAIR, _SCALE, _DIFFERENCE = 150, 300.0, 1e-6


@dataclass(frozen=True)
class Zooms:
    """What pairs say of the zooms of one camera's photographs.

    Attributes:
        images: (N,) positions, ascending, of those that are in a pair.
        log_zoom: (N,) of each; of photographs that hang together the mean is zero.
        part: (N,) numbers from 0, of those that hang together.
        group: (N,) numbers from 0, of those of a part with one focal length.
    """

    images: Ints
    log_zoom: Array
    part: Ints
    group: Ints


def find_zooms(
    camera: Camera, pairs: Sequence[MatchedPixels], homographies: Sequence[Array], threshold_px: float
) -> Zooms | None:
    """Groups of photographs of one camera that have a focal length each.

    Args:
        camera: as it was known before. pairs: of two photographs of it. homographies: of each, NaN for none.
        threshold_px: what matches may be off by. A zoom that moves the corners of a picture by less than half is none.

    Returns:
        None if all of them can have one focal length.
    """
    known = [k for k, h in enumerate(homographies) if np.isfinite(h).all()]
    if not known:
        return None
    ends = np.array([pairs[k].images for k in known])
    images, position = np.unique(ends, return_inverse=True)
    position = position.reshape(-1, 2)
    center = camera.canonical[2:4]
    ratios, sigmas = np.array([_told_ratio(pairs[k], homographies[k], center) for k in known]).T
    told = np.isfinite(ratios) & np.isfinite(sigmas)
    if not told.any():
        return None
    zooms = _means(len(images), position[told], ratios[told], np.hypot(sigmas[told], _SMALL))
    tolerance = threshold_px / math.hypot(camera.width, camera.height)
    part, group, num = np.full(len(images), -1), np.full(len(images), -1), 0
    for n, members in enumerate(groups_of(len(images), position[told])):
        found = _grouped(zooms[members], tolerance)
        part[members], group[members] = n, num + found
        num += int(found.max()) + 1
    if num == part.max() + 1:
        return None
    kept = part >= 0
    return Zooms(images[kept].astype(np.int64), zooms[kept], part[kept], group[kept])


def _told_ratio(pair: MatchedPixels, homography: Array, center: Array) -> tuple[float, float]:
    """:func:`_log_ratio` of the refined homography of a pair, and its standard deviation: where two photographs share a
    narrow strip they hardly tell it. NaN for what is not told."""
    step = max(len(pair.xy[0]) // _MATCHES_OF_PAIR, 1)
    # about the principal points, in units of a picture's size, so that entries are alike
    first, second = ((each[::step] - center) / _SCALE for each in pair.xy)
    shift = np.array([[_SCALE, 0.0, center[0]], [0.0, _SCALE, center[1]], [0.0, 0.0, 1.0]])
    h, info = refine_homography(np.linalg.inv(shift) @ homography @ shift, first, second, is_robust=True)
    if info.covariance is None:
        return math.nan, math.nan
    slopes = np.empty(9)
    for k, entry in enumerate(np.eye(9).reshape(9, 3, 3)):
        slopes[k] = (_log_ratio(h + _DIFFERENCE * entry) - _log_ratio(h - _DIFFERENCE * entry)) / (2.0 * _DIFFERENCE)
    return _log_ratio(h), math.sqrt(max(float(slopes @ info.covariance @ slopes), 0.0))


def _log_ratio(h: Array) -> float:
    """Logarithm of the second focal length over the first of H = s K2 R K1^-1 about principal points; NaN for none.

    Of a rotation the last entry is the determinant of the upper left block, R33 = R11 R22 - R12 R21, so that the block
    of H has s (f2 / f1)^2 times H33 as its own; and det H = s^3 (f2 / f1)^2. Nothing hangs on either focal length.
    """
    whole, last = float(np.linalg.det(h)), float(h[2, 2])
    if whole == 0.0 or last == 0.0:
        return math.nan
    root = math.copysign(1.0, whole) * abs(whole) ** (1.0 / 3.0)
    block = float(np.linalg.det(h[:2, :2])) / (last * root)
    return 0.75 * math.log(block) if 0.0 < block < math.inf else math.nan


def _means(num: int, ends: Ints, ratios: Array, sigmas: Array) -> Array:
    """(N,) logarithms of zooms of which the ratios (P,) are differences: least in the sum of absolute errors, then with
    Geman and McClure's weights, so that wrong pairs do not count where right ones are more."""
    rows = np.zeros((len(ends), num))
    at = np.arange(len(ends))
    rows[at, ends[:, 1]] = 1.0
    rows[at, ends[:, 0]] -= 1.0
    zooms, root = np.zeros(num), np.ones(len(ends))
    for k in range(2 * _MEAN_ROUNDS):
        # of the solutions the shortest: the mean of those that hang together is zero
        weighted = rows * (root / sigmas)[:, None]
        zooms = np.asarray(np.linalg.lstsq(weighted, ratios * root / sigmas, rcond=None)[0], np.float64)
        error = np.abs(rows @ zooms - ratios) / sigmas
        scale = 3.0 * max(float(np.median(error)), 1.0)
        root = 1.0 / np.sqrt(np.maximum(error, 1.0)) if k < _MEAN_ROUNDS else 1.0 / (1.0 + (error / scale) ** 2)
    return zooms


def _grouped(zooms: Array, tolerance: float) -> Ints:
    """(N,) numbers of groups from 0, of logarithms of zooms; all 0 where there are none."""
    order = np.argsort(zooms, kind="stable")
    gaps = np.diff(zooms[order])
    widest = np.sort(gaps)[::-1]
    limit = math.inf
    for num in range(int((widest > tolerance).sum()), 0, -1):
        if num == len(gaps):
            is_clear = len(zooms) < _FEWEST_FOR_SPREAD
        else:
            is_clear = 2 * (num + 1) <= len(zooms) and bool(widest[num - 1] > _APART * widest[num])
        if is_clear:
            limit = float(widest[num - 1])
            break
    group = np.empty(len(zooms), np.int64)
    group[order] = np.concatenate([[0], np.cumsum(gaps >= limit)])
    return group


def unzoomed(pair: MatchedPixels, homography: Array, zooms: Zooms, center: Array) -> tuple[MatchedPixels, Array]:
    """A pair as a camera of one focal length would have seen it, and its homography."""
    factors = np.exp(zooms.log_zoom[np.searchsorted(zooms.images, pair.images)])
    xy = [center + (each - center) / factor for each, factor in zip(pair.xy, factors, strict=True)]
    first, second = (
        np.array([[s, 0.0, (1.0 - s) * center[0]], [0.0, s, (1.0 - s) * center[1]], [0.0, 0.0, 1.0]])
        for s in (factors[0], 1.0 / factors[1])
    )
    return MatchedPixels(pair.images, pair.cameras, (xy[0], xy[1])), second @ homography @ first
