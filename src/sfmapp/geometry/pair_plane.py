"""Planes that two views see: found one after the other, and fitted once the relative pose is known.

``1 / Z = n . x / d`` on the plane ``n . X = d``, so that with x2 ~ R x + t (m . x), m = n / d, three numbers are all
that a plane has (HZ 13.1: Hartley and Zisserman, "Multiple View Geometry", 2004).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.dlt import homogeneous
from sfmapp.geometry.fit import CAUCHY_SIGMAS, cauchy, inverse_or_none, robust_sigma
from sfmapp.geometry.homography import guided_homography, transfer_errors

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# three points tell a plane where the epipolar geometry is known. Fewer than so many, and than this share of all, are as
# well a facet of something round: neighbours on it agree without being on a plane
_FREE, _LEAST, _LEAST_SHARE = 3, 30, 0.05
_STEPS = 15


@dataclass(frozen=True)
class PlaneFit:
    """A plane in the frame of camera 1, the baseline as unit.

    Attributes:
        normal: (3,) unit, away from camera 1. distance: of camera 1 from it.
        normal_sigma, distance_sigma: standard deviations, radians in the direction that is told worst, and baselines.
        rms: of the distances in picture 2, in the unit of the points.
    """

    normal: Array
    distance: float
    normal_sigma: float
    distance_sigma: float
    rms: float


def find_planes(
    xy1: Array, xy2: Array, threshold_px: float, search: Callable[[Array, Array], Array | None], most: int = 8
) -> Iterator[tuple[Array, Mask]]:
    """Homographies of planes among matches of one epipolar geometry, the largest first, each with its matches.

    One after the other: searched among what the others have left, refined on its inliers until these settle, and taken
    away together with its rim, which would pass for a plane beside it. A plane counts if so many matches cannot lie on
    one by chance: of matches whose place along their epipolar lines is any within the reach of all (Moisan and Stival,
    "A probabilistic criterion to detect rigid point matches", IJCV 2004).

    Args:
        xy1, xy2: (N, 2) pixels without distortion. threshold_px: transfer error of an inlier.
        search: a robust search for H among matches.
    """
    left, least = np.arange(len(xy1)), max(_LEAST, math.ceil(_LEAST_SHARE * len(xy1)))
    for _ in range(most):
        if len(left) < least:
            return
        a, b = xy1[left], xy2[left]
        found = search(a, b)
        if found is None:
            return
        h, info = guided_homography(found, a, b, threshold_px, rounds=10)
        inlier, errors = info.is_inlier, np.sqrt(transfer_errors(h, a, b))
        if inlier.sum() < least or not _is_no_chance(int(inlier.sum()), errors, threshold_px):
            return
        mask = np.zeros(len(xy1), np.bool_)
        mask[left[inlier]] = True
        yield h, mask
        left = left[errors >= 2.0 * threshold_px]


def _is_no_chance(num_inliers: int, errors: Array, threshold_px: float) -> bool:
    """Whether fewer than one such plane is expected of ``errors`` (N,) that spread at random over their own reach."""
    n = len(errors)
    finite = errors[np.isfinite(errors)]
    reach = float(np.percentile(finite, 90)) if len(finite) else 0.0
    if num_inliers >= 0.9 * n:
        return True
    share = min(threshold_px / max(reach, threshold_px), 1.0)
    log_expected = (
        math.log(max(n - _FREE, 1)) + _log_choose(n, num_inliers) + _log_choose(num_inliers, _FREE)
        + (num_inliers - _FREE) * math.log(share)
    )  # fmt: skip
    return log_expected < 0.0


def _log_choose(a: int, b: int) -> float:
    return math.lgamma(a + 1) - math.lgamma(b + 1) - math.lgamma(a - b + 1)


def fit_plane(cam2_from_cam1: Array, xn1: Array, xn2: Array) -> PlaneFit | None:
    """The plane through matches (N, 2), normalised, N >= 3, under a relative pose (7,) with unit translation; None
    where they leave it open. Robust: Cauchy's loss, its scale by the median residual."""
    rotation, t = rigid3.rotation_matrix(cam2_from_cam1), cam2_from_cam1[4:]
    x1 = homogeneous(xn1)
    turned = x1 @ rotation.T
    # the components of x2 x (R x + t (m . x)) = 0: linear in m
    across, known = np.cross(homogeneous(xn2), t), -np.cross(homogeneous(xn2), turned)
    rows = across[:, :, None] * x1[:, None, :]
    m: Array = np.asarray(np.linalg.lstsq(rows.reshape(-1, 3), known.ravel(), rcond=None)[0], np.float64)
    scale, cofactor = math.inf, np.zeros((3, 3))
    for step in range(_STEPS):
        mapped = turned + (x1 @ m)[:, None] * t
        if not (mapped[:, 2] > 0.0).mean() > 0.5:
            return None
        seen = mapped[:, :2] / mapped[:, 2:]
        residual = xn2 - seen
        along = (t[:2] - seen * t[2]) / mapped[:, 2:]
        jacobian = along[:, :, None] * x1[:, None, :]
        squared = (residual**2).sum(1)
        if step == 1:
            scale = max(CAUCHY_SIGMAS * robust_sigma(squared, 2), 1e-12)
        weights = cauchy(squared, scale)[1]
        weighted = jacobian * weights[:, None, None]
        hessian = np.einsum("nij,nik->jk", weighted, jacobian)
        inverse = inverse_or_none(hessian)
        if inverse is None:
            return None
        cofactor = inverse
        change = cofactor @ np.einsum("nij,ni->j", weighted, residual)
        m += change
        if step > 1 and np.linalg.norm(change) < 1e-9 * np.linalg.norm(m):
            break
    noise = float(squared @ weights) / max(2.0 * float(weights.sum()) - 3.0, 1.0)
    return _described(m, noise * cofactor, math.sqrt(float(squared @ weights / weights.sum())))


def _described(m: Array, covariance: Array, rms: float) -> PlaneFit | None:
    length = float(np.linalg.norm(m))
    if not length > 0.0:
        return None
    normal = m / length
    tangent = (np.eye(3) - np.outer(normal, normal)) / length
    turn = np.linalg.eigvalsh(tangent @ covariance @ tangent)[-1]
    away = float(normal @ covariance @ normal) / length**4
    return PlaneFit(normal, 1.0 / length, math.sqrt(max(float(turn), 0.0)), math.sqrt(max(away, 0.0)), rms)
