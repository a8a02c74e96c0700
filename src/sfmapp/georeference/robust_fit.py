"""The similarity of a model to measured places of its cameras of which some may be wrong, and what does not fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.georeference.consensus import Rival, likeliest_set
from sfmapp.georeference.fit import Level, Similarity, fit_similarity, student

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A tag is wrong beyond this squared normalised residual: chi square of three degrees of freedom at 0.999, so that of
# a thousand right ones one is lost, which costs nothing.
MAX_CHI2 = 16.27
# Fewer tags than this leave no redundancy to find a wrong one by: seven unknowns, three numbers a tag.
MIN_REDUNDANT = 4
_MAX_ROUNDS = 20
_FLAT_AND_UP = (slice(0, 2), slice(2, 3))


@dataclass(frozen=True)
class RobustFit:
    """A similarity, and the tags that agree with it.

    Attributes:
        similarity: with sigmas as found: its covariance holds.
        is_inlier: (n,) bool.
        residual: (n, 3) place of the camera minus tag, metres; NaN heights where there are none.
        sigma: (n, 3) of the tags, metres, as found.
        factor: by which stated sigmas were multiplied, horizontally and vertically.
        chi2: (n,) squared normalised residuals, by these sigmas.
        rival: another set of tags that may as well be the right one; None for none.
    """

    similarity: Similarity
    is_inlier: Mask
    residual: Array
    sigma: Array
    factor: tuple[float, float]
    chi2: Array
    rival: Rival | None = None


def robust_fit(
    centers: Array, places: Array, sigma: Array, is_stated: Mask, level: Level | None = None
) -> RobustFit | None:
    """The similarity that most tags agree with, by the likeliest set of them (:func:`likeliest_set`) and then by all
    that agree.

    The sigmas of the tags say how good they are among each other; how good they are at all the residuals tell, where
    there are enough: always where nothing was stated, else where they refute what was.

    Args:
        centers: (n, 3) in the model; places: (n, 3); sigma: (n, 3) of the places, infinite for none.
        is_stated: (2,) bool: whether sigmas are more than a guess, horizontally and vertically.
        level: more about the vertical, for the last fits.

    Returns:
        None where the tags determine no similarity.
    """
    found = likeliest_set(centers, places, sigma, is_stated=bool(is_stated.all()))
    if found is None:
        return None
    is_redundant = len(centers) >= MIN_REDUNDANT
    # three places tell nothing of how good they are, but a triangle that is not that of the cameras does
    factor = np.full(2, found.factor if is_redundant else max(1.0, found.factor))
    is_inlier, fit = found.is_inlier, found.similarity
    for n in range(_MAX_ROUNDS):
        previous = is_inlier
        if n:
            residual = fit.apply(centers) - places
            wide = sigma * factor[[0, 0, 1]]
            chi2 = np.nansum((residual / wide) ** 2, axis=1)
            is_inlier = chi2 <= MAX_CHI2 if is_redundant else np.ones(len(centers), bool)
        wide = sigma * factor[[0, 0, 1]]
        if is_inlier.sum() < 3:
            return None
        if level is not None and n == 0:
            fit = _leveled(fit, level, centers[is_inlier])
        better = fit_similarity(centers, places, wide, is_inlier, fit, level)
        if better is None:
            return None
        fit, old = better, factor
        if is_redundant:
            squares = ((fit.apply(centers) - places) / sigma) ** 2
            factor = estimate_factors(squares, fit.redundancy, sigma, is_inlier, is_stated, otherwise=found.factor)
        if n > 1 and np.array_equal(previous, is_inlier) and np.allclose(old, factor, rtol=1e-3):
            break
    wide = sigma * factor[[0, 0, 1]]
    residual = fit.apply(centers) - places
    chi2 = np.nansum((residual / wide) ** 2, axis=1)
    return RobustFit(fit, is_inlier, residual, wide, (float(factor[0]), float(factor[1])), chi2, found.rival)


def _leveled(start: Similarity, level: Level, centers: Array) -> Similarity:
    """A start turned about the line that centers (n, 3) lie along until what is known to be up is nearest to up."""
    origin = centers.mean(0)
    axis = start.rotation @ np.linalg.svd(centers - origin)[2][0]
    up, wanted = start.rotation @ level.up, np.array([0.0, 0.0, 1.0])
    up, wanted = up - (up @ axis) * axis, wanted - (wanted @ axis) * axis
    angle = np.arctan2(axis @ np.cross(up, wanted), up @ wanted)
    turned = rigid3.exp_so3(angle * axis) @ start.rotation
    return replace(start, rotation=turned, origin=origin, mean=start.apply(origin[None])[0])


def estimate_factors(
    squares: Array,
    redundancy: Array,
    sigma: Array,
    is_inlier: Mask,
    is_stated: Mask,
    groups: Sequence[slice] = _FLAT_AND_UP,
    *,
    otherwise: float = 1.0,
) -> Array:
    """Factors (G,) on sigmas by which residuals are what they should be, for each group of columns.

    Args:
        squares: (n, K) squared residuals over squared sigmas; redundancy: (n, K) of the residuals.
        sigma: (n, K), infinite for what is unknown.
        is_inlier: (n,) bool; is_stated: (G,) bool.
        groups: of columns with a factor of their own: horizontally and vertically, by default.
        otherwise: the factor where residuals are too few to tell it.
    """
    factors = np.full(len(groups), otherwise)
    for k, axes in enumerate(groups):
        counts = np.isfinite(sigma[:, axes]) & is_inlier[:, None]
        freedom = float(redundancy[:, axes][counts].sum())
        if freedom < 3.0:
            continue
        ratio = max(float(squares[:, axes][counts].sum()) / freedom, 1e-12)
        factors[k] = 1.0
        # within three standard deviations of the mean of chi square, what was stated stands
        if not is_stated[k] or abs(np.log(ratio)) > 3.0 * np.sqrt(2.0 / freedom):
            factors[k] = np.sqrt(ratio) * student(freedom)
    return factors


def turn_between(a: RobustFit, b: RobustFit) -> float:
    """Angle in radians between the verticals that two fits give a model."""
    return float(np.arccos(np.clip(a.similarity.rotation[2] @ b.similarity.rotation[2], -1.0, 1.0)))
