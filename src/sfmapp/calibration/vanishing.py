"""Directions of a built world in photographs whose focal length is unknown: many hypotheses, each judged by all lines.

A line speaks for a direction by the angle by which it misses the direction's vanishing point. Angles are Gaussian for
lines of the direction, as sharp as the line is long, and even over the half circle for all others, so the gain in
log-likelihood of a line is comparable between directions, focal lengths and photographs (cf. Schindler and Dellaert,
"Atlanta world", CVPR 2004; Antunes and Barreto, CVPR 2013).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.self_calibration import focal_from_vanishing_points

Array = NDArray[np.float64]

# What is known of lines before the photograph is seen: half of them belong to none of the directions.
_OUTLIERS = 0.5
_LOG_OUTLIER = math.log(_OUTLIERS)
# Squared sigmas beyond which a line belongs to nothing, to the last digit.
_FAR = 80.0
# Errors of a line of a direction: of its points in pixels of a photograph of up to 2000, and of the builder in radians.
SIGMA_PX, SIGMA_BUILT = 0.3, math.radians(0.1)
# Focal lengths that are tried, as multiples of the longer side: 118 to 14 degrees of view, in steps of 8 %.
FOCAL_SHARES = np.geomspace(0.3, 4.0, 34)
# Work of the search in a photograph: pairs of lines whose meeting points are judged, meeting points that are kept as
# axes, and lines tried as the second direction with each.
_PAIRS, _AXES, _SECONDS = 2000, 16, 16
# Lines that an axis needs: two meet always.
_LEAST_MEETING = 3


@dataclass(frozen=True)
class PlaneLines:
    """The lines of a photograph as a search needs them.

    Attributes:
        normals: (N, 3) and covariances (N, 3, 3) as :func:`sfmapp.calibration.line_planes.fit_planes` has them.
        sigma_px: (N,) what a line's points may be off by.
        peak: (N,) density of the angle of a line of a direction where it is right, over that of other lines.
    """

    normals: Array
    covariances: Array
    sigma_px: Array
    peak: Array


def plane_lines(normals: Array, covariances: Array, length_px: Array, pixel_scale: float) -> PlaneLines:
    """Lines with the errors that are expected of them; pixel_scale is by what those of pixels are larger than usual."""
    # points at even steps that are turned by an angle are off by length / sqrt(12) times the angle, rms
    lever = length_px / math.sqrt(12.0)
    sigma = np.hypot(SIGMA_PX * pixel_scale, SIGMA_BUILT * lever)
    angle = np.minimum(sigma / lever, 0.5)
    return PlaneLines(normals, covariances, sigma, math.pi / (math.sqrt(2.0 * math.pi) * angle))


@numba.njit(cache=True, nogil=True)
def _miss2(m: Array, c: Array, p0: float, p1: float, p2: float) -> float:
    """Squared rms distance, in pixels, by which a line has to turn to meet a vanishing point."""
    off = m[0] * p0 + m[1] * p1 + m[2] * p2
    spread = (
        c[0, 0] * p0 * p0 + c[1, 1] * p1 * p1 + c[2, 2] * p2 * p2
        + 2.0 * (c[0, 1] * p0 * p1 + c[0, 2] * p0 * p2 + c[1, 2] * p1 * p2)
    )  # fmt: skip
    return float(off * off / max(spread, 1e-300))


@numba.njit(cache=True, nogil=True)
def _gain(miss2: float, sigma: float, peak: float, num: int) -> float:
    """Log-likelihood of a line over that of one that belongs to nothing, for its nearest of a number of directions."""
    x = miss2 / (sigma * sigma)
    if x > _FAR:
        return _LOG_OUTLIER
    return math.log(_OUTLIERS + (1.0 - _OUTLIERS) / num * peak * math.exp(-0.5 * x))


def misses(lines: PlaneLines, points: Array) -> Array:
    """(N, P) how far, in sigmas, each line misses each vanishing point (P, 3)."""
    off = lines.normals @ points.T
    spread = np.einsum("pi,nij,pj->np", points, lines.covariances, points)
    result: Array = np.abs(off) / np.sqrt(np.maximum(spread, 1e-300)) / lines.sigma_px[:, None]
    return result


def gains(lines: PlaneLines, points: Array, num: int) -> tuple[Array, NDArray[np.intp]]:
    """(N,) gain of each line by the best of vanishing points (P, 3) of a world with num directions, and which it is."""
    miss = misses(lines, points)
    best = miss.argmin(1)
    x = np.minimum(miss[np.arange(len(miss)), best] ** 2, _FAR)
    return np.log(_OUTLIERS + (1.0 - _OUTLIERS) / num * lines.peak * np.exp(-0.5 * x)), best


@numba.njit(cache=True, nogil=True)
def _judge_meeting_points(
    m: Array, c: Array, sigma: Array, peak: Array, pairs: NDArray[np.int64], score: Array
) -> None:
    for k in range(len(pairs)):
        i, j = pairs[k]
        p = np.cross(m[i], m[j])
        norm = math.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
        score[k] = 0.0
        if norm < 1e-9:
            continue
        for n in range(len(m)):
            gain = _gain(_miss2(m[n], c[n], p[0], p[1], p[2]), sigma[n], peak[n], 1)
            if gain > 0.0:
                score[k] += gain


def find_axes(lines: PlaneLines, rng: np.random.Generator) -> Array:
    """(A, 3) meeting points of lines that many lines meet, the best first, no two of which mean the same."""
    num = len(lines.normals)
    share = lines.peak / lines.peak.sum()
    pairs = np.stack([rng.choice(num, _PAIRS, p=share), rng.choice(num, _PAIRS, p=share)], 1)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    score = np.empty(len(pairs))
    _judge_meeting_points(lines.normals, lines.covariances, lines.sigma_px, lines.peak, pairs, score)
    points = np.cross(lines.normals[pairs[:, 0]], lines.normals[pairs[:, 1]])
    points /= np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-300)
    meets = (misses(lines, points) < 2.0).astype(np.float32)
    count = meets.sum(0)
    score[count < _LEAST_MEETING] = 0.0
    chosen: list[int] = []
    while len(chosen) < _AXES and score.max(initial=0.0) > 0.0:
        best = int(score.argmax())
        chosen.append(best)
        score[meets[:, best] @ meets >= 0.6 * count] = 0.0
        score[best] = 0.0
    return points[chosen]


@numba.njit(cache=True, nogil=True)
def _frame(a: Array, m: Array, f: float, is_point: bool, points: Array) -> bool:
    """Fill points (3, 3) with the vanishing points of the frame of the axis a and a second direction: that of the line
    m at right angles to it, or, for ``is_point``, the vanishing point m brought to a right angle."""
    v0, v1, v2 = a[0], a[1], a[2] * f
    norm = math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
    v0, v1, v2 = v0 / norm, v1 / norm, v2 / norm
    if is_point:
        n0, n1, n2 = m[0], m[1], m[2] * f
        along = n0 * v0 + n1 * v1 + n2 * v2
        h0, h1, h2 = n0 - along * v0, n1 - along * v1, n2 - along * v2
    else:
        n0, n1, n2 = m[0], m[1], m[2] / f
        h0, h1, h2 = v1 * n2 - v2 * n1, v2 * n0 - v0 * n2, v0 * n1 - v1 * n0
    norm = math.sqrt(h0 * h0 + h1 * h1 + h2 * h2)
    if norm < 1e-9:
        return False
    h0, h1, h2 = h0 / norm, h1 / norm, h2 / norm
    points[0, 0], points[0, 1], points[0, 2] = v0, v1, v2 / f
    points[1, 0], points[1, 1], points[1, 2] = h0, h1, h2 / f
    points[2, 0], points[2, 1] = v1 * h2 - v2 * h1, v2 * h0 - v0 * h2
    points[2, 2] = (v0 * h1 - v1 * h0) / f
    return True


@numba.njit(cache=True, nogil=True)
def _judge_frame(m: Array, c: Array, sigma: Array, peak: Array, points: Array) -> float:
    total = 0.0
    for n in range(len(m)):
        least = 1e300
        for k in range(3):
            miss2 = _miss2(m[n], c[n], points[k, 0], points[k, 1], points[k, 2])
            if miss2 < least:
                least = miss2
        total += _gain(least, sigma[n], peak[n], 3)
    return total


@numba.njit(cache=True, nogil=True)
def _search_frames(
    m: Array, c: Array, sigma: Array, peak: Array, axes: Array, seconds: NDArray[np.int64], focals: Array, best: Array,
    frames: Array,
) -> None:  # fmt: skip
    """For each focal length the best frame: its gain, and its vanishing points (3, 3)."""
    points = np.empty((3, 3))
    for i in range(len(focals)):
        best[i] = -1e300
        for a in range(len(axes)):
            for k in range(seconds.shape[1] + len(axes)):
                other = k - seconds.shape[1]
                if other == a:
                    continue
                second = axes[other] if other >= 0 else m[seconds[a, k]]
                if not _frame(axes[a], second, focals[i], other >= 0, points):
                    continue
                score = _judge_frame(m, c, sigma, peak, points)
                if score > best[i]:
                    best[i] = score
                    frames[i] = points


def focals_of_pairs(axes: Array, low: float, high: float) -> Array:
    """Focal lengths between two bounds for which two of the axes are at right angles."""
    i, j = np.triu_indices(len(axes), 1)
    focals = focal_from_vanishing_points(axes[i], axes[j])
    return focals[(focals > low) & (focals < high)]


def search_frames(lines: PlaneLines, axes: Array, focals: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """For each focal length (F,), in units of R, the gain (F,) and the rotation (F, 3, 3) of the best frame: column k
    is the direction k of the world in the camera."""
    num = len(lines.normals)
    seconds = rng.integers(0, num, (len(axes), _SECONDS))
    best, points = np.empty(len(focals)), np.zeros((len(focals), 3, 3))
    _search_frames(
        lines.normals, lines.covariances, lines.sigma_px, lines.peak, axes, seconds, focals, best, points
    )  # fmt: skip
    directions = points * np.stack([np.ones_like(focals), np.ones_like(focals), focals], 1)[:, None, :]
    return best, directions.swapaxes(1, 2)
