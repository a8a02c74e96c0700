"""Fundamental matrices from matched points, ``x2^T F x1 = 0``: linear, minimal, refined, and how sure they are.

Part of the literature writes the constraint the other way round, ``x1^T F x2 = 0``; its F is the transpose of ours.
HZ stands for Hartley and Zisserman, "Multiple View Geometry", 2004.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.dlt import homogeneous, normalizing
from sfmapp.geometry.epipolar import sampson_errors
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

# Rows of the normalised system are of order one: what double precision leaves of a singular value that is zero.
_ROUNDING = 1e-12


def epipolar_rows(xy1: Array, xy2: Array) -> Array:
    """(..., N, 9) equations ``a f = 0`` in the entries of F, row by row, of points (..., N, 2) (HZ 11.3)."""
    x, y, u, v = xy1[..., 0], xy1[..., 1], xy2[..., 0], xy2[..., 1]
    return np.stack([u * x, u * y, u, v * x, v * y, v, x, y, np.ones_like(x)], -1)


def rank_two(matrix: Array) -> Array:
    """The matrices (..., 3, 3) of rank two nearest in the Frobenius norm, of unit norm."""
    u, s, vt = np.linalg.svd(matrix)
    near = (u[..., :2] * s[..., None, :2]) @ vt[..., :2, :]
    unit: Array = near / np.linalg.norm(near, axis=(-2, -1), keepdims=True)
    return unit


def fundamental_from_points(xy1: Array, xy2: Array) -> Array:
    """Normalised eight-point algorithm (HZ algorithm 11.1) at its quickest: F (3, 3) of rank two and unit norm.

    Args:
        xy1, xy2: (N, 2) corresponding pixels, N >= 8.
    """
    if len(xy1) < 8:
        raise ValueError(f"the eight-point algorithm takes at least 8 points, got {len(xy1)}")
    t1, t2 = normalizing(xy1), normalizing(xy2)
    design = epipolar_rows(xy1 * t1[0, 0] + t1[:2, 2], xy2 * t2[0, 0] + t2[:2, 2])
    # the eigenvector of the 9 x 9 normal matrix: the points are normalised, so squaring costs no digits that matter
    f = t2.T @ rank_two(np.linalg.eigh(design.T @ design)[1][:, 0].reshape(3, 3)) @ t1
    unit: Array = f / np.linalg.norm(f)
    return unit


def _squared_slopes(fundamental: Array, xy1: Array, xy2: Array) -> Array:
    """(N,) squared gradient of ``x2^T F x1`` by the four coordinates: Sampson's denominator."""
    line2 = xy1 @ fundamental[:2, :2].T + fundamental[:2, 2]
    line1 = xy2 @ fundamental[:2, :2] + fundamental[2, :2]
    squared: Array = (line2**2).sum(1) + (line1**2).sum(1)
    return squared


def eight_point(
    xy1: ArrayLike, xy2: ArrayLike, *, is_normalized: bool = True, noise_px: float | None = None
) -> tuple[Array, FitInfo]:
    """Eight-point algorithm (Longuet-Higgins 1981), normalised as in Hartley, "In defense of the eight-point
    algorithm", PAMI 1997, or not, to see what that buys; with what the points leave open.

    Args:
        xy1, xy2: (N, 2) corresponding pixels, N >= 8.
        is_normalized: bring the points of each picture to the origin and to a mean square of 2 first.
        noise_px: standard deviation of a coordinate; None: as the residuals of more than eight points tell.

    Returns:
        F (3, 3) of rank two and unit norm, and what is known of it. ``num_free`` is 3 for points of a plane, for a
        rotation and for two copies of one picture; any F of the family that is then returned fits.

    Raises:
        ValueError: fewer than eight points, or some that are not finite.
    """
    a, b = matched_points(xy1, xy2, 8, "the eight-point algorithm")
    t1, t2 = (normalizing(a), normalizing(b)) if is_normalized else (np.eye(3), np.eye(3))
    na, nb = a * t1[0, 0] + t1[:2, 2], b * t2[0, 0] + t2[:2, 2]
    rows = epipolar_rows(na, nb)
    _, values, vt = np.linalg.svd(rows, full_matrices=len(rows) < 9)
    values = np.pad(values, (0, 9 - len(values)))
    f = t2.T @ rank_two(vt[8].reshape(3, 3)) @ t1
    f /= np.linalg.norm(f)
    sigma = _noise(sampson_errors(f, a, b), noise_px)
    # in normalised units, where one pixel is t[0, 0]
    unit = 0.0 if math.isnan(sigma) else sigma * math.hypot(t1[0, 0], t2[0, 0]) / math.sqrt(2.0)
    slopes = np.array([_squared_slopes(v.reshape(3, 3), na, nb).sum() for v in vt])
    noise = unit * np.sqrt(slopes) + _ROUNDING * values[0]
    info = FitInfo(
        np.ones(len(a), np.bool_), 1, float(values[0] / max(values[7], 1e-300)), values,
        max(count_free(values, noise), 1), sigma,
    )  # fmt: skip
    return f, info


def _noise(squared: Array, noise_px: float | None) -> float:
    """Standard deviation of a coordinate from the Sampson errors of a fit of seven numbers; at eight points one
    equation is left, which is not enough to tell."""
    if noise_px is not None:
        return noise_px
    variance = float(squared.sum()) / (len(squared) - 7) if len(squared) > 8 else math.inf
    return math.sqrt(variance) if math.isfinite(variance) else math.nan


def seven_point(xy1: ArrayLike, xy2: ArrayLike) -> tuple[Array, FitInfo]:
    """The one or three F of seven points (HZ 11.1.2): ``det(a F1 + (1 - a) F2) = 0`` is a cubic in a.

    Args:
        xy1, xy2: (7, 2) corresponding pixels.

    Returns:
        (K, 3, 3) of rank two and unit norm, K from 0 to 3. ``num_free`` is 2 at best: the pencil that the cubic is
        solved in.

    Raises:
        ValueError: not seven points, or some that are not finite.
    """
    a, b = matched_points(xy1, xy2, 7, "the seven-point algorithm")
    if len(a) != 7:
        raise ValueError(f"the seven-point algorithm takes 7 points, got {len(a)}")
    t1, t2 = normalizing(a), normalizing(b)
    rows = epipolar_rows(a * t1[0, 0] + t1[:2, 2], b * t2[0, 0] + t2[:2, 2])
    _, values, vt = np.linalg.svd(rows)
    first, second = vt[7].reshape(3, 3), vt[8].reshape(3, 3)
    num_free = 2 + int((values <= _ROUNDING * values[0]).sum())
    info = FitInfo(np.ones(7, np.bool_), 1, float(values[0] / max(values[6], 1e-300)), values, num_free)
    if num_free > 2:
        return np.zeros((0, 3, 3)), info
    # the cubic through its values at four places
    at = np.array([-1.0, 0.0, 1.0, 2.0])
    determinants = [np.linalg.det(x * first + (1.0 - x) * second) for x in at]
    cubic = np.linalg.solve(np.vander(at), determinants)
    roots = np.roots(cubic)
    real = roots.real[np.abs(roots.imag) < 1e-9 * np.maximum(np.abs(roots), 1.0)]
    found = t2.T @ (real[:, None, None] * first + (1.0 - real)[:, None, None] * second) @ t1
    return rank_two(found), info


class _Factors(NamedTuple):
    """A matrix of rank two as ``U diag(cos, sin, 0) V^T``: seven degrees of freedom (Bartoli and Sturm, PAMI 2004)."""

    u: Array
    angle: float
    v: Array

    @property
    def matrix(self) -> Array:
        product: Array = self.u @ np.diag([math.cos(self.angle), math.sin(self.angle), 0.0]) @ self.v.T
        return product

    @property
    def slopes(self) -> Array:
        """(7, 3, 3) derivatives by turns of U, turns of V, and the angle."""
        s = np.diag([math.cos(self.angle), math.sin(self.angle), 0.0])
        turns = [rigid3.skew(axis) for axis in np.eye(3)]
        of_u = [self.u @ turn @ s @ self.v.T for turn in turns]
        of_v = [self.u @ s @ turn.T @ self.v.T for turn in turns]
        of_s = self.u @ np.diag([-math.sin(self.angle), math.cos(self.angle), 0.0]) @ self.v.T
        return np.stack([*of_u, *of_v, of_s])

    def moved(self, step: Array) -> _Factors:
        return _Factors(
            self.u @ rigid3.exp_so3(step[:3]), self.angle + float(step[6]), self.v @ rigid3.exp_so3(step[3:6])
        )


def _factors(matrix: Array) -> _Factors:
    u, s, vt = np.linalg.svd(matrix)
    return _Factors(u * np.linalg.det(u), math.atan2(s[1], s[0]), vt.T * np.linalg.det(vt))


def sampson_jacobian(matrix: Array, slopes: Array, xy1: Array, xy2: Array) -> tuple[Array, Array]:
    """Signed Sampson distances (N,) of F or E, and their derivatives (N, K) along (K, 3, 3) changes of the matrix."""
    x1, x2 = homogeneous(xy1), homogeneous(xy2)
    line2, line1 = x1 @ matrix.T, x2 @ matrix
    scale = 1.0 / np.sqrt(np.maximum((line2[:, :2] ** 2).sum(1) + (line1[:, :2] ** 2).sum(1), 1e-300))
    residual = (x2 * line2).sum(1) * scale
    slope2, slope1 = x1 @ slopes.swapaxes(1, 2), x2 @ slopes  # (K, N, 3)
    change = (x2 * slope2).sum(2)
    longer = (line2[:, :2] * slope2[..., :2]).sum(2) + (line1[:, :2] * slope1[..., :2]).sum(2)
    return residual, (scale * (change - residual * scale * longer)).T


def refine_fundamental(
    fundamental: Array, xy1: ArrayLike, xy2: ArrayLike, *, noise_px: float | None = None, is_robust: bool = False,
    max_iterations: int = 30,
) -> tuple[Array, FitInfo]:  # fmt: skip
    """F of least squared Sampson distance over its seven degrees of freedom, with its covariance.

    To first order in the noise that is the maximum likelihood estimate (HZ 11.4.3).

    Args:
        fundamental: (3, 3) start. xy1, xy2: (N, 2) corresponding pixels, N >= 8.
        noise_px: standard deviation of a coordinate; None: as the residuals of more than eight points tell.
        is_robust: some of the points may be wrong: Cauchy's loss, its scale by the median residual at the start.

    Returns:
        F (3, 3) of unit norm; the (9, 9) covariance of its entries, of rank seven, by first-order propagation (HZ
        5.2.2), None where the points leave F open or the noise is not known.

    Raises:
        ValueError: fewer than eight points, or some that are not finite.
    """
    a, b = matched_points(xy1, xy2, 8, "the refinement of a fundamental matrix")
    t1, t2 = normalizing(a), normalizing(b)
    start = _factors(np.linalg.solve(t2.T, fundamental) @ np.linalg.inv(t1))

    squared = sampson_errors(fundamental, a, b)
    scale = CAUCHY_SIGMAS * robust_sigma(squared, 1) if is_robust else math.inf

    def linearize(state: _Factors) -> tuple[float, Array, Array]:
        residual, jacobian = sampson_jacobian(t2.T @ state.matrix @ t1, t2.T @ state.slopes @ t1, a, b)
        cost, weights = cauchy(residual**2, scale)
        weighted = jacobian.T * weights
        return cost, weighted @ jacobian, weighted @ residual

    best, hessian, taken = minimize(start, linearize, _Factors.moved, max_iterations)
    f = t2.T @ best.matrix @ t1
    norm = float(np.linalg.norm(f))
    f = f / norm
    squared = sampson_errors(f, a, b)
    sigma = robust_sigma(squared, 1) if is_robust and noise_px is None else _noise(squared, noise_px)
    by_step = (t2.T @ best.slopes @ t1).reshape(7, 9).T / norm
    by_step -= np.outer(f.ravel(), f.ravel() @ by_step)
    cofactor = inverse_or_none(hessian)
    covariance = None
    if cofactor is not None and not math.isnan(sigma):
        _, jacobian = sampson_jacobian(t2.T @ best.matrix @ t1, t2.T @ best.slopes @ t1, a, b)
        # with weights, what the noise does to the gradient is not what the cost bends by (Huber 1967)
        pull = jacobian * cauchy(squared, scale)[1][:, None]
        covariance = sigma**2 * by_step @ cofactor @ (pull.T @ pull) @ cofactor @ by_step.T
    values = np.sqrt(np.maximum(np.linalg.eigvalsh(hessian)[::-1], 0.0))
    info = FitInfo(
        np.ones(len(a), np.bool_), taken, float(values[0] / max(values[-1], 1e-300)), values, 1, sigma, covariance
    )
    return f, info


def epipoles(fundamental: Array) -> tuple[Array, Array]:
    """Homogeneous epipoles (3,), of unit norm, in picture 1 and 2: ``F e1 = 0`` and ``F^T e2 = 0``.

    A third entry near zero is an epipole at infinity: the lines are parallel.
    """
    u, _, vt = np.linalg.svd(fundamental)
    return vt[2], u[:, 2]
