"""Plane-induced and rotation-only maps between two views: estimated, refined, taken apart.

``x2 ~ H x1`` for homogeneous pixels (N, 2) float64. HZ stands for Hartley and Zisserman, "Multiple View Geometry",
2004.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.dlt import homogeneous, homography_rows, normalizing
from sfmapp.geometry.epipolar import contiguous
from sfmapp.geometry.fit import (
    CAUCHY_SIGMAS,
    FitInfo,
    cauchy,
    count_free,
    inverse_or_none,
    matched_points,
    minimize,
    robust_sigma,
)

Array = NDArray[np.float64]


def transfer_errors(homography: Array, xy1: Array, xy2: Array) -> Array:
    """(N,) squared distances between x2 and H x1 or x1 and H^-1 x2, whichever is larger, pixels squared.

    Taking the larger of the two keeps a zoom from making one direction look harmless. Infinite at and beyond the
    horizon of either map and for a singular H.
    """
    determinant = np.linalg.det(homography) if np.isfinite(homography).all() else 0.0
    errors = np.full(len(xy1), np.inf)
    if abs(determinant) >= 1e-14 * np.linalg.norm(homography) ** 3:
        h = homography * np.sign(determinant)
        _transfer_errors(*contiguous(h, np.linalg.inv(h)), *contiguous(xy1, xy2), errors)
    return errors


@numba.njit(cache=True, nogil=True)
def _transfer_errors(h: Array, inverse: Array, xy1: Array, xy2: Array, out: Array) -> None:
    """Fill out (N,), infinite before, with the larger of both directions where both are in front."""
    for i in range(xy1.shape[0]):
        x, y, u, v = xy1[i, 0], xy1[i, 1], xy2[i, 0], xy2[i, 1]
        w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
        z = inverse[2, 0] * u + inverse[2, 1] * v + inverse[2, 2]
        if w > 0.0 and z > 0.0:
            du = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w - u
            dv = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w - v
            dx = (inverse[0, 0] * u + inverse[0, 1] * v + inverse[0, 2]) / z - x
            dy = (inverse[1, 0] * u + inverse[1, 1] * v + inverse[1, 2]) / z - y
            out[i] = max(du * du + dv * dv, dx * dx + dy * dy)


class PlaneMotions(NamedTuple):
    """Motions that a homography allows, K <= 4: two, each with both signs of the normal and of the translation.

    Attributes:
        poses: (K, 7) cam2_from_cam1 with unit translation.
        normals: (K, 3) unit normals of the plane in the frame of camera 1.
        distances: (K,) of camera 1 from the plane, in units of the translation.
    """

    poses: Array
    normals: Array
    distances: Array

    def possible(self, xn1: Array) -> PlaneMotions:
        """Those that have most of the points (N, 2), normalised, in front of both cameras: two, as a rule, between
        which only a third view or a second plane decides."""
        x1 = homogeneous(xn1)
        along = x1 @ self.normals.T
        depth1 = self.distances / np.where(along == 0.0, np.nan, along)
        z_row = rigid3.rotation_matrix(self.poses).reshape(-1, 3, 3)[:, 2]
        depth2 = depth1 * (x1 @ z_row.T) + self.poses[:, 6]
        keep = ((depth1 > 0) & (depth2 > 0)).mean(0) > 0.5
        return PlaneMotions(self.poses[keep], self.normals[keep], self.distances[keep])


def motions_from_homography(homography: Array, k1: Array, k2: Array) -> PlaneMotions:
    """Motions and planes with ``H ~ K2 (R + t n^T / d) K1^-1``; none for a pure rotation.

    Malis and Vargas, "Deeper understanding of the homography decomposition", INRIA 6303, 2007, as in OpenCV.
    """
    import cv2

    _, rotations, translations, normals = cv2.decomposeHomographyMat(np.linalg.inv(k2) @ homography @ k1, np.eye(3))
    poses, planes, distances = [], [], []
    for rotation, translation, normal in zip(rotations, translations, normals, strict=True):
        norm = np.linalg.norm(translation)
        if norm > 1e-9 and np.linalg.det(rotation) > 0:
            poses.append(rigid3.from_matrix(rotation, translation[:, 0] / norm))
            planes.append(normal[:, 0])
            distances.append(1.0 / norm)
    return PlaneMotions(
        np.array(poses).reshape(-1, 7), np.array(planes).reshape(-1, 3), np.array(distances).reshape(-1)
    )


def fit_homography(
    xy1: ArrayLike, xy2: ArrayLike, *, is_inhomogeneous: bool = False, noise_px: float | None = None
) -> tuple[Array, FitInfo]:
    """H of N >= 4 points by the normalised direct linear transform (HZ algorithm 4.2).

    Args:
        xy1, xy2: (N, 2) corresponding pixels.
        is_inhomogeneous: solve 2N x 8 by least squares with the last entry of the normalised matrix held at one, and
            not 2N x 9 under |h| = 1. It fails where the middle of picture 1 is mapped to the horizon (HZ 4.1.2).
        noise_px: standard deviation of a coordinate; None: as the residuals of more than four points tell.

    Returns:
        H (3, 3), whose last entry is 1 unless it is 0, and what is known of it; ``num_free`` is above 1 where three of
        four points lie on a line.

    Raises:
        ValueError: fewer than four points, or some that are not finite.
    """
    a, b = matched_points(xy1, xy2, 4, "a homography")
    t1, t2 = normalizing(a), normalizing(b)
    na, nb = homogeneous(a) @ t1.T, homogeneous(b) @ t2[:2].T
    rows = homography_rows(na, nb)
    _, values, vt = np.linalg.svd(rows, full_matrices=len(rows) < 9)
    values = np.pad(values, (0, 9 - len(values)))
    entries = vt[8]
    if is_inhomogeneous:
        entries = np.append(np.linalg.lstsq(rows[:, :8], -rows[:, 8], rcond=None)[0], 1.0)
    h = np.linalg.solve(t2, entries.reshape(3, 3)) @ t1
    sigma = _noise(h, a, b, noise_px)
    # noise of both pictures enters a row with the weight of its point, and the slope of the map
    unit = 0.0 if math.isnan(sigma) else sigma * math.hypot(t1[0, 0], t2[0, 0]) / math.sqrt(2.0)
    slopes = [_squared_row_slopes(v.reshape(3, 3), na, nb) for v in vt]
    noise = unit * np.sqrt(np.array(slopes)) + 1e-12 * values[0]
    info = FitInfo(
        np.ones(len(a), np.bool_), 1, float(values[0] / max(values[7], 1e-300)), values,
        max(count_free(values, noise), 1), sigma,
    )  # fmt: skip
    return (h / h[2, 2] if h[2, 2] != 0 else h), info


def _squared_row_slopes(h: Array, points: Array, pixels: Array) -> float:
    """Sum of the squared derivatives of the two equations of each point by its four coordinates."""
    by_target = 2.0 * ((points @ h[2]) ** 2).sum()
    by_source = ((h[:2, None, :2] - pixels.T[:, :, None] * h[2, :2]) ** 2).sum()
    return float(by_target + by_source)


def _noise(h: Array, xy1: Array, xy2: Array, noise_px: float | None) -> float:
    """Standard deviation of a coordinate, from what eight numbers leave of the distances in four dimensions."""
    if noise_px is not None:
        return noise_px
    if len(xy1) <= 4:
        return math.nan
    with np.errstate(divide="ignore", invalid="ignore"):
        left, weight = _left_and_weight(h, xy1, xy2)
    variance = float(np.einsum("ni,nij,nj->", left, weight, left)) / (2 * len(xy1) - 8)
    return math.sqrt(variance) if math.isfinite(variance) else math.nan


def _left_and_weight(h: Array, at: Array, xy2: Array) -> tuple[Array, Array]:
    """Of points at (N, 2): what is left in picture 2 (N, 2), and the inverse of its covariance (N, 2, 2) where both
    pictures have unit noise."""
    mapped = homogeneous(at) @ h.T
    seen = mapped[:, :2] / mapped[:, 2:]
    slopes = (h[:2, :2] - seen[:, :, None] * h[2, :2]) / mapped[:, 2:, None]
    weight: Array = np.asarray(np.linalg.inv(np.eye(2) + slopes @ slopes.swapaxes(1, 2)), np.float64)
    return xy2 - seen, weight


class _Plane(NamedTuple):
    """A homography under way: unit norm, in normalised pixels, and where each point (N, 2) truly is in picture 1."""

    h: Array
    at: Array


def refine_homography(
    homography: Array, xy1: ArrayLike, xy2: ArrayLike, *, noise_px: float | None = None, is_robust: bool = False,
    max_iterations: int = 30,
) -> tuple[Array, FitInfo]:  # fmt: skip
    """H of least squared reprojection error in both pictures, the gold standard (HZ algorithm 4.3), and its covariance.

    The places of the points are unknowns too, eliminated in every step.

    Args:
        homography: (3, 3) start. xy1, xy2: (N, 2) corresponding pixels, N >= 4.
        noise_px: standard deviation of a coordinate; None: as the residuals of more than four points tell.
        is_robust: some of the points may be wrong: Cauchy's loss, its scale by the median residual at the start.

    Returns:
        H (3, 3) of unit norm; the (9, 9) covariance of its entries, of rank eight (HZ 5.2.3), None where the points
        leave H open or the noise is not known.

    Raises:
        ValueError: fewer than four points, or some that are not finite.
    """
    a, b = matched_points(xy1, xy2, 4, "the refinement of a homography")
    t1, t2 = normalizing(a), normalizing(b)
    problem = _GoldStandard(a * t1[0, 0] + t1[:2, 2], b * t2[0, 0] + t2[:2, 2], t2[0, 0] / t1[0, 0])
    start = t2 @ homography @ np.linalg.inv(t1)
    first = _Plane(start / np.linalg.norm(start), problem.xy1)
    if (
        is_robust
    ):  # at first the points of picture 1 are where they were seen: both pictures' noise is left in picture 2
        at_rest = problem.moved(first, np.zeros(8))
        problem = problem._replace(loss=CAUCHY_SIGMAS * robust_sigma(problem.squared(at_rest), 2))
    best, hessian, taken = minimize(first, problem.linearize, problem.moved, max_iterations)
    h = np.linalg.solve(t2, best.h) @ t1
    norm = float(np.linalg.norm(h))
    h = h / norm
    squared = problem.squared(best)
    sigma = noise_px
    if sigma is None and is_robust:
        sigma = robust_sigma(squared, 2) / t1[0, 0]
    elif sigma is None:
        sigma = math.sqrt(float(squared.sum()) / (2 * len(a) - 8)) / t1[0, 0] if len(a) > 4 else math.nan
    by_step = np.linalg.solve(t2, _tangent(best.h).T.reshape(8, 3, 3)) @ t1
    by_step = by_step.reshape(8, 9).T / norm
    by_step -= np.outer(h.ravel(), h.ravel() @ by_step)
    cofactor = inverse_or_none(hessian)
    covariance = None
    if cofactor is not None and not math.isnan(sigma):
        # with weights, what the noise does to the gradient is not what the cost bends by (Huber 1967)
        _, pull, _ = problem.normal(best, cauchy(squared, problem.loss)[1] ** 2)
        covariance = (sigma * t1[0, 0]) ** 2 * by_step @ cofactor @ pull @ cofactor @ by_step.T
    values = np.sqrt(np.maximum(np.linalg.eigvalsh(hessian)[::-1], 0.0))
    condition = float(values[0] / max(values[-1], 1e-300))
    return h, FitInfo(np.ones(len(a), np.bool_), taken, condition, values, 1, sigma, covariance)


class _GoldStandard(NamedTuple):
    """Least reprojection error in both pictures, in normalised pixels of picture 1.

    Attributes:
        xy1, xy2: (N, 2) normalised pixels. scale: a pixel of picture 2 in units of one of picture 1, both normalised.
        loss: of Cauchy; infinite for plain squares.
    """

    xy1: Array
    xy2: Array
    scale: float
    loss: float = math.inf

    def _left(self, state: _Plane) -> tuple[Array, Array, Array, Array, Array]:
        """What is left in both pictures (N, 2), its slopes by H (N, 2, 8) and by the places (N, 2, 2), and the inverse
        (N, 2, 2) of the places' own normal matrices."""
        left2, by_h, by_at = (each / self.scale for each in _plane_slopes(state, self.xy2))
        own: Array = np.asarray(np.linalg.inv(np.eye(2) + by_at.swapaxes(1, 2) @ by_at), np.float64)
        return self.xy1 - state.at, left2, by_h, by_at, own

    def squared(self, state: _Plane) -> Array:
        """(N,) over both pictures."""
        left1, left2, *_ = self._left(state)
        total: Array = (left1**2).sum(1) + (left2**2).sum(1)
        return total

    def normal(self, state: _Plane, weights: Array) -> tuple[Array, Array, Array]:
        """Squared errors (N,), normal matrix (8, 8) and gradient (8,) with the places of the points eliminated."""
        left1, left2, by_h, by_at, own = self._left(state)
        toward = left1 + np.einsum("nij,ni->nj", by_at, left2)
        rest = left2 - np.einsum("nij,njk,nk->ni", by_at, own, toward)
        reduced = by_h - by_at @ own @ by_at.swapaxes(1, 2) @ by_h
        weighted = (by_h * weights[:, None, None]).reshape(-1, 8)
        squared = (left1**2).sum(1) + (left2**2).sum(1)
        return squared, weighted.T @ reduced.reshape(-1, 8), -weighted.T @ rest.ravel()

    def linearize(self, state: _Plane) -> tuple[float, Array, Array]:
        cost, weights = cauchy(self.squared(state), self.loss)
        return cost, *self.normal(state, weights)[1:]

    def moved(self, state: _Plane, step: Array) -> _Plane:
        left1, left2, by_h, by_at, own = self._left(state)
        toward = left1 + np.einsum("nij,ni->nj", by_at, left2 - by_h @ step)
        h = state.h + (_tangent(state.h) @ step).reshape(3, 3)
        return _Plane(h / np.linalg.norm(h), state.at + np.einsum("nij,nj->ni", own, toward))


def _plane_slopes(state: _Plane, xy2: Array) -> tuple[Array, Array, Array]:
    """What is left in picture 2 (N, 2), and the slopes of the mapped points by H (N, 2, 8) and by their places."""
    mapped = homogeneous(state.at) @ state.h.T
    seen = mapped[:, :2] / mapped[:, 2:]
    rows = homography_rows(homogeneous(state.at), seen).reshape(-1, 2, 9) / mapped[:, 2:, None]
    by_at = (state.h[:2, :2] - seen[:, :, None] * state.h[2, :2]) / mapped[:, 2:, None]
    return xy2 - seen, rows @ _tangent(state.h), by_at


def _tangent(h: Array) -> Array:
    """(9, 8) orthonormal directions in which a matrix of unit norm can move."""
    basis: Array = np.linalg.svd(h.reshape(1, 9))[2][1:].T
    return basis


def guided_homography(
    homography: Array, xy1: Array, xy2: Array, threshold_px: float, rounds: int = 5
) -> tuple[Array, FitInfo]:
    """H refined on its inliers, and on those of what comes out, until they no longer change (HZ algorithm 4.6)."""
    inlier = transfer_errors(homography, xy1, xy2) < threshold_px**2
    h, info = homography, FitInfo(inlier, 0, math.nan, np.zeros(0), 0)
    for taken in range(1, rounds + 1):
        if inlier.sum() < 4:
            break
        h, found = refine_homography(h, xy1[inlier], xy2[inlier])
        info = replace(found, is_inlier=inlier, num_iterations=taken)
        now = transfer_errors(h, xy1, xy2) < threshold_px**2
        if (now == inlier).all():
            break
        inlier = now
    return h, info


def rotation_from_rays(xn1: Array, xn2: Array, weights: Array) -> Array:
    """Rotation (3, 3) that best turns the rays of xn1 into those of xn2 (Kabsch 1976).

    Both are (N, 2) normalised image points, or (N, 3) unit rays.
    """
    a, b = xn1, xn2
    if xn1.shape[1] == 2:
        a = np.concatenate([xn1, np.ones((len(xn1), 1))], 1)
        b = np.concatenate([xn2, np.ones((len(xn2), 1))], 1)
        a /= np.linalg.norm(a, axis=1, keepdims=True)
        b /= np.linalg.norm(b, axis=1, keepdims=True)
    u, _, vt = np.linalg.svd((b * weights[:, None]).T @ a)
    rotation: Array = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return rotation


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    points = np.array([[0.1, 0.2], [0.3, -0.1]])
    transfer_errors(np.eye(3), points, points)
