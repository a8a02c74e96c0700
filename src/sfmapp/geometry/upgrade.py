"""From a projective frame to an affine one by parallel lines, and to the world by points of known place.

Frames are (4, 4) maps G of points (N, 4), ``G X``; cameras follow by ``P G^-1``
(:func:`sfmapp.geometry.projective.in_frame`). HZ stands for Hartley and Zisserman, "Multiple View Geometry", 2004.
"""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry.dlt import normalizing
from sfmapp.geometry.fit import FitInfo, count_free, inverse_or_none, minimize
from sfmapp.geometry.projective import dehomogenized, whitening_of

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_POINTS = 5
"""Fifteen unknowns, three equations each."""

MIN_VOTERS = 2
"""Points beyond the five of a sample that have to agree before others may be called wrong."""

_MAX_SAMPLES = 500
# median of the length of a normal vector in space, in standard deviations of a coordinate
_MEDIAN_LENGTH = 1.538
# length that 1.2 in 100 exceed, in the same unit: 2.5 standard deviations of one number
_LIMIT = 3.3


def find_space_homography(
    points: ArrayLike, xyz: ArrayLike, *, sigma: float | None = None, covariances: Array | None = None,
    is_robust: bool = False, seed: int = 0,
) -> tuple[Array, FitInfo]:  # fmt: skip
    """The frame in which points stand where they are known to be: ``(xyz, 1) ~ G X``, least squared distance in space.

    Args:
        points: (N, 4) in a projective frame, N >= 5, no four of the five in a plane.
        xyz: (N, 3) where they are known to be.
        sigma: standard deviation of a known coordinate, the projective points' own noise included; None: as what is
            left of more than five points tells.
        covariances: (N, 3, 3) of the distances between both, in the squared unit of ``xyz``: points count by how firmly
            they stand, and ``sigma`` is not used. None: all count alike.
        is_robust: some may be wrong: samples of five by the least median. Of seven points or more: below, nothing
            could say which one is wrong, and all count.
        seed: of the samples, where not all are tried.

    Returns:
        G (4, 4) of unit norm. ``covariance`` (16, 16) of its entries, None for five points without ``sigma``;
        ``sigma_px`` is that of a coordinate, in the unit of ``xyz``, or with ``covariances`` the factor by which what
        is left exceeds them; ``num_free`` is above 1 where points in one plane leave the frame open.

    Raises:
        ValueError: fewer than five points, or some that are not finite.
    """
    x, known = _known(points, xyz)
    whitening, about = whitening_of(x), normalizing(known)
    white = x @ whitening.T
    white /= np.linalg.norm(white, axis=1, keepdims=True)
    target = known * about[0, 0] + about[:3, 3]
    is_inlier, taken = np.ones(len(x), np.bool_), 1
    if is_robust and len(x) >= MIN_POINTS + MIN_VOTERS:
        is_inlier, taken = _least_median(white, target, seed)
    white, target = white[is_inlier], target[is_inlier]
    weights = np.broadcast_to(np.eye(3), (len(white), 3, 3))
    if covariances is not None:
        weights = np.linalg.inv(np.linalg.cholesky(covariances[is_inlier])) / about[0, 0]
    rows = _rows(white, target)
    _, values, vt = np.linalg.svd(rows, full_matrices=len(rows) < 16)
    values = np.pad(values, (0, 16 - len(values)))
    frame, by_frame, hessian, steps = _refined(vt[15].reshape(4, 4), white, target, weights)
    left = (weights @ (dehomogenized(white @ frame.T) - target)[:, :, None])[:, :, 0]
    num_left = 3 * len(white) - 15
    unit = told = float(np.sqrt((left**2).sum() / num_left)) if num_left > 0 else math.nan
    if sigma is not None:
        unit = told = sigma * about[0, 0]
    coordinate = 0.0 if math.isnan(unit) else unit
    if covariances is not None:
        unit, told = 1.0, told * about[0, 0]
        coordinate = about[0, 0] * math.sqrt(float(np.median(np.trace(covariances[is_inlier], axis1=1, axis2=2))) / 3.0)
    # an entry of a row has the noise of a coordinate times one of a unit vector
    noise = np.full(16, coordinate * math.sqrt(len(rows) / 16.0) + 1e-11 * values[0])
    num_free = max(count_free(values, noise), 1)
    found = np.linalg.solve(about, frame) @ whitening
    norm = float(np.linalg.norm(found))
    found = found / norm
    covariance = None
    cofactor = inverse_or_none(hessian)
    if cofactor is not None and not math.isnan(unit) and num_free == 1:
        by_step = (np.linalg.inv(about) @ by_frame.T.reshape(15, 4, 4) @ whitening).reshape(15, 16).T / norm
        by_step -= np.outer(found.ravel(), found.ravel() @ by_step)
        covariance = unit**2 * by_step @ cofactor @ by_step.T
    condition = float(values[0] / max(values[14], 1e-300))
    return found, FitInfo(is_inlier, taken + steps, condition, values, num_free, told / about[0, 0], covariance)


def _known(points: ArrayLike, xyz: ArrayLike) -> tuple[Array, Array]:
    x, known = np.array(points, np.float64), np.asarray(xyz, np.float64)
    if x.ndim != 2 or x.shape[1] != 4 or known.shape != (len(x), 3):
        raise ValueError(f"known points are (N, 4) in the frame and (N, 3) in the world, got {x.shape}, {known.shape}")
    if len(x) < MIN_POINTS:
        raise ValueError(f"a projective frame has fifteen unknowns: give {MIN_POINTS} known points, got {len(x)}")
    bad = ~(np.isfinite(x).all(1) & np.isfinite(known).all(1))
    if bad.any():
        raise ValueError(f"{int(bad.sum())} of {len(x)} known points are not finite, the first is {int(bad.argmax())}")
    return x, known


def _rows(points: Array, xyz: Array) -> Array:
    """(..., 3 N, 16) equations in the entries of G, of unit points (..., N, 4)."""
    rows = np.zeros((*xyz.shape, 16))
    for k in range(3):
        rows[..., k, 4 * k : 4 * k + 4] = points
        rows[..., k, 12:] = -xyz[..., k, None] * points
    return rows.reshape(*xyz.shape[:-2], -1, 16)


def _least_median(points: Array, xyz: Array, seed: int) -> tuple[Mask, int]:
    """Points that agree with the sample of five of least median distance, and the number of samples."""
    num = len(points)
    if math.comb(num, MIN_POINTS) <= _MAX_SAMPLES:
        samples = np.array(list(combinations(range(num), MIN_POINTS)))
    else:
        rng = np.random.default_rng([seed, num])
        samples = rng.random((_MAX_SAMPLES, num)).argpartition(MIN_POINTS - 1, axis=1)[:, :MIN_POINTS]
    found = np.linalg.svd(_rows(points[samples], xyz[samples]))[2][:, 15].reshape(-1, 4, 4)
    lengths = np.linalg.norm(dehomogenized(points @ found.swapaxes(1, 2)) - xyz, axis=2)
    lengths = np.nan_to_num(lengths, nan=np.inf)
    # of the points beyond the sample, which fits its own: the middle one
    rank = MIN_POINTS + (num - MIN_POINTS) // 2
    medians = np.partition(lengths, rank, axis=1)[:, rank]
    best = int(np.argmin(medians))
    # the small-sample factor of Rousseeuw and Leroy, 1987
    sigma = medians[best] / _MEDIAN_LENGTH * (1.0 + 5.0 / (num - MIN_POINTS))
    return lengths[best] <= max(_LIMIT * sigma, 1e-9), len(samples)


def _refined(frame: Array, points: Array, xyz: Array, weights: Array) -> tuple[Array, Array, Array, int]:
    """The frame of least squared distance, whitened by (N, 3, 3); the directions (16, 15) it moved in, the Hessian
    (15, 15), and steps."""

    def tangent(g: Array) -> Array:
        basis: Array = np.linalg.svd(g.reshape(1, 16))[2][1:].T
        return basis

    def linearize(g: Array) -> tuple[float, Array, Array]:
        mapped = points @ g.T
        seen = mapped[:, :3] / mapped[:, 3:]
        slopes = _rows(points, seen).reshape(-1, 3, 16) / mapped[:, 3, None, None]
        jacobian = (weights @ slopes).reshape(-1, 16) @ tangent(g)
        left = (weights @ (xyz - seen)[:, :, None]).ravel()
        return float(left @ left), jacobian.T @ jacobian, -jacobian.T @ left

    def moved(g: Array, step: Array) -> Array:
        further = g + (tangent(g) @ step).reshape(4, 4)
        unit: Array = further / np.linalg.norm(further)
        return unit

    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        best, hessian, steps = minimize(frame / np.linalg.norm(frame), linearize, moved, 30)
    return best, tangent(best), hessian, steps


def meeting_point(lines: ArrayLike) -> tuple[Array, float]:
    """Where lines in a projective frame meet: of lines that are parallel in the world, a point at infinity.

    Args:
        lines: (L, 2, 4) two points of each, L >= 2.

    Returns:
        (4,) of unit norm, and how badly they meet: the sine of the angle that it makes with the lines, 0 for lines that
        do.

    Raises:
        ValueError: fewer than two lines, points that are not finite, or lines that are one.
    """
    ends = np.asarray(lines, np.float64)
    if ends.ndim != 3 or ends.shape[1:] != (2, 4) or len(ends) < 2:
        raise ValueError(f"a common point takes two lines or more, each of two points (L, 2, 4), got {ends.shape}")
    if not np.isfinite(ends).all():
        raise ValueError("a common point takes lines through points that are finite")
    whitening = whitening_of(ends.reshape(-1, 4))
    bases = np.linalg.svd((ends @ whitening.T).swapaxes(1, 2), full_matrices=False)[0]
    across = np.eye(4) - bases @ bases.swapaxes(1, 2)
    values, vectors = np.linalg.eigh(across.sum(0))
    if values[1] < 1e-9 * len(ends):
        raise ValueError("a common point takes lines that are not all one line")
    point = np.linalg.solve(whitening, vectors[:, 0])
    return point / np.linalg.norm(point), math.sqrt(max(float(values[0]), 0.0) / len(ends))


def affine_frame(plane: ArrayLike) -> Array:
    """(4, 4) frame in which a plane (4,), ``plane . X = 0``, is the plane at infinity: parallel lines are parallel,
    and ratios along them are those of the world (HZ 10.4.1)."""
    p = np.asarray(plane, np.float64)
    if p.shape != (4,) or not np.isfinite(p).all() or not p.any():
        raise ValueError(f"a plane is four finite numbers that are not all zero, got {p.tolist()}")
    # rows at right angles to the plane: as well conditioned as can be
    return np.vstack([np.linalg.svd(p.reshape(1, 4))[2][1:], p / np.linalg.norm(p)])


def plane_through(points: ArrayLike) -> tuple[Array, FitInfo]:
    """The plane (4,) through three points (N, 4) or more: that at infinity through those of parallel lines.

    Raises:
        ValueError: fewer than three points, not finite, or on one line: three directions of which none lies in the
            plane of the other two are needed.
    """
    x = np.asarray(points, np.float64)
    if x.ndim != 2 or x.shape[1] != 4 or len(x) < 3:
        raise ValueError(f"a plane takes three points (N, 4) or more, got {x.shape}")
    if not np.isfinite(x).all():
        raise ValueError("a plane takes points that are finite")
    unit = x / np.linalg.norm(x, axis=1, keepdims=True)
    values, vt = np.linalg.svd(unit)[1:]
    if values[2] < 1e-9 * values[0]:
        raise ValueError(
            "the directions of these parallel lines lie in one plane: add one that points out of it, or the plane at "
            "infinity is left open"
        )
    info = FitInfo(np.ones(len(x), np.bool_), 1, float(values[0] / values[2]), values, 1)
    return vt[3], info


def place_covariances(frame: Array, covariance: Array, points: Array) -> Array:
    """(N, 3, 3) of what the frame's own covariance (16, 16) makes of the places of exact points (N, 4)."""
    mapped = points @ frame.T
    slopes = _rows(points, mapped[:, :3] / mapped[:, 3:]).reshape(-1, 3, 16) / mapped[:, 3, None, None]
    found: Array = slopes @ covariance @ slopes.swapaxes(1, 2)
    return found
