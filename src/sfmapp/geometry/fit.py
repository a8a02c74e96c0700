"""What an estimate from matched points says of itself, and the damped steps that refinements take."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
S = TypeVar("S")


@dataclass(frozen=True)
class FitInfo:
    """How a model was had from N matched points, and how firmly they hold it.

    Attributes:
        is_inlier: (N,) bool, the points that the model was fitted to.
        num_iterations: samples drawn, or steps taken; 1 for what one linear system gives.
        condition: of that system: its largest singular value over the smallest of those that have to be there. NaN
            where no such system was solved.
        singular_values: of the system, descending.
        num_free: independent solutions that fit within the noise: 1 where the points tell the model, more where they
            leave it open (a plane or a rotation leaves three fundamental matrices), 0 where nothing was found.
        sigma_px: standard deviation of a coordinate, as given or as the residuals tell; NaN where they cannot.
        covariance: of the entries of the model, row by row, at unit norm; None where it was not asked for.
    """

    is_inlier: Mask
    num_iterations: int
    condition: float
    singular_values: Array
    num_free: int
    sigma_px: float = math.nan
    covariance: Array | None = None


def matched_points(xy1: ArrayLike, xy2: ArrayLike, at_least: int, what: str) -> tuple[Array, Array]:
    """Both sides of N matches as (N, 2) float64.

    Raises:
        ValueError: of another shape, not finite, or fewer than ``at_least``; it says what for.
    """
    a, b = (np.ascontiguousarray(xy, np.float64) for xy in (xy1, xy2))
    if a.ndim != 2 or a.shape[1] != 2 or a.shape != b.shape:
        raise ValueError(f"{what} takes two arrays (N, 2), got {a.shape} and {b.shape}")
    if len(a) < at_least:
        raise ValueError(f"{what} takes at least {at_least} points, got {len(a)}")
    bad = ~(np.isfinite(a).all(1) & np.isfinite(b).all(1))
    if bad.any():
        found = f"{int(bad.sum())} of {len(a)} points are not finite, the first is {int(bad.argmax())}"
        raise ValueError(f"{what}: {found}")
    return a, b


def count_free(singular_values: Array, noise: Array) -> int:
    """How many of the singular values, descending, are no larger than noise makes them.

    Args:
        singular_values, noise: (K,) values, and the root of the expected square of each if noise were all that is left.

    The factor of two leaves room for the scatter of few equations: a chi-square of eight exceeds four times its mean
    once in 10,000 times.
    """
    is_noise = singular_values <= 2.0 * noise
    return int(np.argmin(np.append(is_noise[::-1], False)))


def minimize(
    state: S,
    linearize: Callable[[S], tuple[float, Array, Array]],
    move: Callable[[S, Array], S],
    max_iterations: int,
) -> tuple[S, Array, int]:
    """Levenberg and Marquardt's method.

    Args:
        state: where it starts.
        linearize: half the cost's second and first derivatives at a state: (cost, (K, K), (K,)).
        move: a state a step (K,) further.

    Returns:
        The state of least cost, the (K, K) matrix there, and the number of steps, rejected ones included.
    """
    cost, hessian, gradient = linearize(state)
    damping, taken = 1e-4, 0
    while taken < max_iterations and damping < 1e6:
        taken += 1
        damped = hessian + damping * np.diag(np.maximum(np.diag(hessian), 1e-300))
        try:
            step: Array = -np.asarray(np.linalg.solve(damped, gradient), np.float64)
        except np.linalg.LinAlgError:
            damping *= 10.0
            continue
        candidate = move(state, step)
        new_cost, new_hessian, new_gradient = linearize(candidate)
        if not new_cost < cost:
            damping *= 10.0
            continue
        has_converged = cost - new_cost <= 1e-9 * cost
        state, cost, hessian, gradient = candidate, new_cost, new_hessian, new_gradient
        damping = max(0.1 * damping, 1e-12)
        if has_converged:
            break
    return state, hessian, taken


def robust_sigma(squared: Array, degrees: int) -> float:
    """Standard deviation of one of the ``degrees`` (1 or 2) coordinates of residuals with these squared lengths (N,),
    by their median: up to half of them may be wrong."""
    # medians of chi-square of one and of two degrees of freedom
    return math.sqrt(float(np.median(squared)) / {1: 0.4549, 2: 1.3863}[degrees])


def cauchy(squared: Array, scale: float) -> tuple[float, Array]:
    """Cost and weights (N,) of residuals with these squared lengths: ``s^2 log(1 + r^2 / s^2)`` each; plain squares
    where the scale is infinite, or zero, as that of copies of one picture is."""
    if math.isinf(scale) or scale == 0.0:
        return float(squared.sum()), np.ones(len(squared))
    ratio = squared / scale**2
    return float(scale**2 * np.log1p(ratio).sum()), 1.0 / (1.0 + ratio)


CAUCHY_SIGMAS = 2.385
"""Scale of Cauchy's loss in standard deviations: with normal noise it costs five per cent of the information (Holland
and Welsch, "Robust regression using iteratively reweighted least-squares", 1977)."""

HEAVY_TAILS = 1.25
"""Root of the mean square of inliers of two views over their sigma by the median: 0.9 to 1.1 of normal noise (120
scenes), 1.5 to 2.5 of keypoints of photographs (53 pairs). Where tails are that heavy, the loss has to bend; elsewhere
squares are best."""


def inverse_or_none(matrix: Array) -> Array | None:
    """Inverse of a symmetric positive definite matrix, None where it is singular in double precision."""
    values, vectors = np.linalg.eigh(matrix)
    if not values[0] > 1e-15 * len(values) * values[-1]:
        return None
    inverse: Array = (vectors / values) @ vectors.T
    return inverse
