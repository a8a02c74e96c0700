"""Errors that positions of photographs taken one after the other have in common, as those of a receiver that drifts.

Errors of neighbours in time are correlated: an autoregression of first order, by which errors of photographs k apart
have the correlation r^k. The fit itself takes out most of what many neighbours have in common, and leaves residuals
that look better than they are; restricted likelihood (Patterson and Thompson, Biometrika 1971) reckons with that. It
tells r poorly from a few dozen positions, so that what follows is averaged over r by its likelihood: independent errors
are given the same chance beforehand as drift of any r.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Correlations from one photograph to the next that are tried beside none; beyond the last, errors are common to all in
# sets of a few dozen, and no residual tells.
_TRIED = np.array([*np.arange(0.025, 0.95, 0.05), 0.96, 0.98])
# Fewer positions than this leave no neighbours to tell by: seven unknowns.
_LEAST = 10


@dataclass(frozen=True)
class Drift:
    """What residuals of neighbours tell.

    Attributes:
        correlation: of errors from one photograph to the next, mean of what is likely.
        inflation: by what sigmas of positions are to be multiplied, as if errors were independent, for places of
            cameras to be as uncertain as they are, on average; one at least.
        spread: (K,) by what standard deviations of unknowns that were fitted as if they were independent are to be
            multiplied: of rotation, scale and mean place, and of what else was fitted.
    """

    correlation: float
    inflation: float
    spread: Array


def similarity_slope(arm: Array) -> Array:
    """(n, 3, 7) how places move with rotation (radians), log scale and shift of a similarity about the mean place.

    Args:
        arm: (n, 3) of the places from it.
    """
    shift = np.broadcast_to(np.eye(3), (len(arm), 3, 3))
    return np.concatenate([-rigid3.skew(arm), arm[:, :, None], shift], 2)


def estimate_drift(residual: Array, sigma: Array, slope: Array, is_used: Mask, order: Array) -> Drift:
    """Drift of positions (n, 3) beside a model that was fitted to them.

    Args:
        residual: (n, 3) metres, east, north, up; sigma: (n, 3), infinite for no height.
        slope: (n, 3, K) of the residuals by what was fitted, a similarity first: see :func:`similarity_slope`.
        is_used: (n,) bool: those that it was fitted to.
        order: (n,) number of the photograph in time, increasing by one from each to the next.
    """
    rows = np.flatnonzero(is_used)
    rows = rows[np.argsort(order[rows], kind="stable")]
    known = np.isfinite(sigma[rows])
    if len(rows) < _LEAST or not known[:, 0].all():
        return Drift(0.0, 1.0, np.ones(slope.shape[2]))
    axes = [k for k in range(3) if known[:, k].all()]  # heights that some have tell no drift
    jacobian = slope[rows][:, axes] / sigma[rows][:, axes, None]
    normal = residual[rows][:, axes] / sigma[rows][:, axes]
    gaps = np.maximum(np.diff(order[rows]), 1.0)
    num = slope.shape[2]
    flat = jacobian.reshape(-1, num)
    information = flat.T @ flat
    # what no height holds, and a scale of its own for every unknown
    root = np.sqrt(np.maximum(np.diag(information), 1e-12))
    held = np.linalg.pinv(information / np.outer(root, root), rcond=1e-9)
    freedom = normal.size - round(float(np.trace(held @ (information / np.outer(root, root)))))
    likelihoods, variances = [], []
    for r in (0.0, *_TRIED):
        likelihood, variance = _with_correlation(r, jacobian / root, normal, gaps, held, freedom)
        likelihoods.append(likelihood)
        variances.append(variance)
    prior = np.array([1.0, *np.full(len(_TRIED), 1.0 / len(_TRIED))])
    weight = prior * np.exp(np.array(likelihoods) - max(likelihoods))
    weight /= weight.sum()
    independent = np.maximum(variances[0], 1e-300)
    ratio = (weight[:, None] * np.array(variances)).sum(0) / independent
    spread = np.sqrt(np.maximum(ratio, 1.0))
    return Drift(float(weight @ [0.0, *_TRIED]), float(spread[-1]), spread[:-1])


def _with_correlation(
    r: float, jacobian: Array, normal: Array, gaps: Array, held: Array, freedom: int
) -> tuple[float, Array]:
    """Restricted log likelihood of a correlation, and variances (K + 1,) under it of what was fitted as if errors were
    independent, and of a place by it, on average; in units in which the sigmas of positions are as stated."""
    power = r**gaps
    left = np.sqrt(1.0 - power**2)
    white = [
        np.concatenate([x[:1], (x[1:] - _shaped(power, x) * x[:-1]) / _shaped(left, x)]) for x in (jacobian, normal)
    ]
    slope, rest = white[0].reshape(-1, jacobian.shape[2]), white[1].ravel()
    information = slope.T @ slope
    values, vectors = np.linalg.eigh(information)
    good = values > 1e-9 * values[-1]
    inverse = (vectors[:, good] / values[good]) @ vectors[:, good].T
    rest = rest - slope @ (inverse @ (slope.T @ rest))
    variance = float(rest @ rest) / freedom
    determinant = 2.0 * normal.shape[1] * float(np.log(left).sum()) + float(np.log(values[good]).sum())
    # the fit weighs positions as if they were independent: its covariance is held J^T S J held
    number = np.concatenate([[0.0], np.cumsum(gaps)])
    together = np.eye(len(number)) if r == 0.0 else r ** np.abs(number[:, None] - number[None])
    between = np.einsum("nai,nm,maj->ij", jacobian, together, jacobian, optimize=True)
    covariance = variance * held @ between @ held
    of_place = float(np.einsum("nai,ij,naj->", jacobian, covariance, jacobian, optimize=True)) / normal.size
    likelihood = -0.5 * (freedom * np.log(max(variance, 1e-300)) + determinant)
    return likelihood, np.append(np.diag(covariance), of_place)


def _shaped(values: Array, like: Array) -> Array:
    return values.reshape(-1, *([1] * (like.ndim - 1)))
