"""The similarity that brings a model to measured places of its cameras, its covariance, and what does not fit.

Coordinates of places are x east, y north, z up in metres. A place may have no height: its sigma is infinite then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A tag is wrong beyond this squared normalised residual: chi square of three degrees of freedom at 0.999, so that of
# a thousand right ones one is lost, which costs nothing.
MAX_CHI2 = 16.27
# medians of chi square with 2 and 3 degrees of freedom
MEDIAN_CHI2 = {2: 1.386, 3: 2.366}
# All triples up to this many, else as many drawn: with 40 % wrong tags one in five triples is right.
_MAX_TRIPLES = 2000
# ... and fewer where there are so many tags that memory would matter: then fewer do
_MAX_SCORES = 4_000_000
_MAX_ROUNDS = 20
# A height that is unknown is held to that of the frame's origin within this, in metres.
UNKNOWN_M = 1000.0
_FLAT_AND_UP = (slice(0, 2), slice(2, 3))
# Fewer tags than this leave no redundancy to find a wrong one by: seven unknowns, three numbers a tag.
MIN_REDUNDANT = 5


@dataclass(frozen=True)
class Level:
    """What is known of the vertical beside places: ``up`` (3,) unit vector, good to ``sigma_rad``, and whence."""

    up: Array
    sigma_rad: float
    source: str


class LevelOfImage(NamedTuple):
    """The vertical as one image sees it: ``level.up`` is in that camera's frame."""

    image_idx: int
    level: Level


@dataclass(frozen=True)
class Similarity:
    """``place = mean + scale R (center - origin)``.

    Attributes:
        rotation: (3, 3); scale; origin: (3,) in the model; mean: (3,) in the world.
        covariance: (7, 7) of rotation (radians about east, north, up, on the left), log scale, mean (metres), with
            places as good as their sigmas say.
        redundancy: (n, 3) share of each residual's variance that the fit leaves: 1 for what had no part in it.
    """

    rotation: Array
    scale: float
    origin: Array
    mean: Array
    covariance: Array
    redundancy: Array

    def apply(self, xyz: Array) -> Array:
        """Places (n, 3) of points (n, 3)."""
        return self.scale * (xyz - self.origin) @ self.rotation.T + self.mean

    @property
    def world_from_model(self) -> Array:
        """(8,) quaternion x y z w, translation, scale, as of :mod:`sfmapp.geometry.similarity`."""
        pose = rigid3.from_matrix(self.rotation, self.mean - self.scale * self.rotation @ self.origin)
        return np.append(pose, self.scale)


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
    """

    similarity: Similarity
    is_inlier: Mask
    residual: Array
    sigma: Array
    factor: tuple[float, float]
    chi2: Array


def fit_similarity(
    centers: Array, places: Array, sigma: Array, is_used: Mask, start: Similarity, level: Level | None = None
) -> Similarity | None:
    """Maximum-likelihood similarity by Gauss-Newton steps.

    Args:
        centers: (n, 3) in the model; places: (n, 3); sigma: (n, 3) of the places, infinite for none.
        is_used: (n,) bool.
        start: near it.
        level: more about the vertical.

    Returns:
        None where nothing determines it.
    """
    weight = np.where(is_used[:, None], sigma**-2.0, 0.0)
    total = weight.sum(1)
    origin = (total[:, None] * centers).sum(0) / total.sum()
    rotation, scale, mean = start.rotation, start.scale, start.apply(origin[None])[0]
    known = np.where(weight > 0, places, 0.0)
    for _ in range(_MAX_ROUNDS):
        turned = scale * (centers - origin) @ rotation.T
        jacobian = np.zeros((len(centers), 3, 7))
        jacobian[:, :, :3] = -rigid3.skew(turned)
        jacobian[:, :, 3] = turned
        jacobian[:, :, 4:] = np.eye(3)
        residual = np.where(weight > 0, turned + mean - known, 0.0)
        information = np.einsum("nai,na,naj->ij", jacobian, weight, jacobian)
        gradient = np.einsum("nai,na,na->i", jacobian, weight, residual)
        # where no height is known nothing else holds the model
        information[6, 6] += UNKNOWN_M**-2
        gradient[6] += mean[2] * UNKNOWN_M**-2
        if level is not None:
            up = rotation @ level.up
            slope = -rigid3.skew(up[None])[0][:2] / level.sigma_rad
            information[:3, :3] += slope.T @ slope
            gradient[:3] += slope.T @ up[:2] / level.sigma_rad
        solved = newton_step(information, gradient)
        if solved is None:
            return None
        step, covariance, length = solved
        rotation = rigid3.exp_so3(step[:3]) @ rotation
        scale *= float(np.exp(np.clip(step[3], -1.0, 1.0)))
        mean = mean + step[4:]
        if length < 1e-6:
            break
    leverage = np.einsum("nai,ij,naj->na", jacobian, covariance, jacobian) * weight
    return Similarity(rotation, scale, origin, mean, covariance, 1.0 - leverage)


def newton_step(information: Array, gradient: Array) -> tuple[Array, Array, float] | None:
    """The step (N,), the covariance (N, N) and the largest part of the step in units of what its unknown alone would be
    known to; None where the information does not determine the unknowns."""
    # a scale of its own for every unknown: metres, radians and shares
    root = np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information / np.outer(root, root)
    if np.linalg.cond(scaled) > 1e12:
        return None
    covariance = np.linalg.inv(scaled) / np.outer(root, root)
    step = -covariance @ gradient
    return step, covariance, float(np.abs(step * root).max())


def robust_fit(
    centers: Array, places: Array, sigma: Array, is_stated: Mask, level: Level | None = None
) -> RobustFit | None:
    """The similarity that most tags agree with, by least median of squares and then by all that agree.

    Rousseeuw, JASA 1984: no threshold is needed to begin with. The sigmas of the tags say how good they are among each
    other; how good they are at all the residuals tell, where there are enough: always where nothing was stated, else
    where they refute what was.

    Args:
        centers: (n, 3) in the model; places: (n, 3); sigma: (n, 3) of the places, infinite for none.
        is_stated: (2,) bool: whether sigmas are more than a guess, horizontally and vertically.
        level: more about the vertical, for the last fits.

    Returns:
        None where the tags determine no similarity.
    """
    if len(centers) < 3:
        return None
    start, scale2 = least_median(centers, places, sigma)
    if start is None:
        return None
    is_redundant = len(centers) >= MIN_REDUNDANT
    factor = np.full(2, np.sqrt(scale2)) if is_redundant else np.ones(2)
    is_inlier, fit = np.ones(len(centers), bool), start
    for n in range(_MAX_ROUNDS):
        residual = fit.apply(centers) - places
        wide = sigma * factor[[0, 0, 1]]
        chi2 = np.nansum((residual / wide) ** 2, axis=1)
        previous, is_inlier = is_inlier, chi2 <= MAX_CHI2 if is_redundant else np.ones(len(centers), bool)
        if is_inlier.sum() < 3:
            return None
        if level is not None and n == 0:
            fit = _leveled(fit, level, centers[is_inlier])
        better = fit_similarity(centers, places, wide, is_inlier, fit, level)
        if better is None:
            return None
        fit, old = better, factor
        # until the set of inliers is about right only the robust scale is safe
        if is_redundant and n:
            squares = ((fit.apply(centers) - places) / sigma) ** 2
            factor = estimate_factors(squares, fit.redundancy, sigma, is_inlier, is_stated)
        if n > 1 and np.array_equal(previous, is_inlier) and np.allclose(old, factor, rtol=1e-3):
            break
    wide = sigma * factor[[0, 0, 1]]
    residual = fit.apply(centers) - places
    chi2 = np.nansum((residual / wide) ** 2, axis=1)
    return RobustFit(fit, is_inlier, residual, wide, (float(factor[0]), float(factor[1])), chi2)


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
) -> Array:
    """Factors (G,) on sigmas by which residuals are what they should be, for each group of columns.

    Args:
        squares: (n, K) squared residuals over squared sigmas; redundancy: (n, K) of the residuals.
        sigma: (n, K), infinite for what is unknown.
        is_inlier: (n,) bool; is_stated: (G,) bool.
        groups: of columns with a factor of their own: horizontally and vertically, by default.
    """
    factors = np.ones(len(groups))
    for k, axes in enumerate(groups):
        counts = np.isfinite(sigma[:, axes]) & is_inlier[:, None]
        freedom = float(redundancy[:, axes][counts].sum())
        if freedom < 3.0:
            continue
        ratio = max(float(squares[:, axes][counts].sum()) / freedom, 1e-12)
        # within three standard deviations of the mean of chi square, what was stated stands
        if not is_stated[k] or abs(np.log(ratio)) > 3.0 * np.sqrt(2.0 / freedom):
            factors[k] = np.sqrt(ratio) * student(freedom)
    return factors


def student(freedom: float) -> float:
    """By what a sigma from so many degrees of freedom is to be multiplied for 1.96 of it to hold 95 %.

    Quantile of Student's t over that of the normal distribution; Abramowitz and Stegun 26.7.5.
    """
    z = 1.959964
    return 1.0 + (z**2 + 1) / (4 * freedom) + (5 * z**4 + 16 * z**2 + 3) / (96 * freedom**2)


def least_median(centers: Array, places: Array, sigma: Array) -> tuple[Similarity | None, float]:
    """The similarity of three places whose median squared normalised residual over all is least, improved by the half
    that it fits best, and the squared factor on the sigmas that this median tells; None where it is none.

    Rousseeuw, JASA 1984; Rousseeuw and Van Driessen, 2006. Arguments as of :func:`fit_similarity`.
    """
    num = len(centers)
    has_height = np.isfinite(sigma[:, 2])
    flat = np.where(np.isfinite(places), places, 0.0)
    if num**3 <= 6 * _MAX_TRIPLES:
        triples = np.array(list(combinations(range(num), 3)))
    else:
        triples = np.sort(
            np.random.default_rng(num).integers(0, num, (min(_MAX_TRIPLES, _MAX_SCORES // num), 3)), axis=1
        )
        triples = triples[(triples[:, 0] != triples[:, 1]) & (triples[:, 1] != triples[:, 2])]
    weight = 1.0 / np.where(np.isfinite(sigma), sigma, np.inf) ** 2

    def scores(rotation: Array, scale: Array, shift: Array) -> Array:
        moved = scale[:, None, None] * (centers @ rotation.transpose(0, 2, 1)) + shift[:, None]
        squares: Array = ((moved - flat) ** 2 * weight).sum(2)
        return squares

    found = closed_form(centers[triples], flat[triples])
    order = np.argsort(np.median(scores(*found), axis=1), kind="stable")[:10]
    rotation, scale, shift = (part[order] for part in found)
    half = (num + 4) // 2
    for _ in range(10):  # concentration steps
        kept = np.argsort(scores(rotation, scale, shift), axis=1, kind="stable")[:, :half]
        rotation, scale, shift = closed_form(centers[kept], flat[kept])
    squares = scores(rotation, scale, shift)
    sums = np.sort(squares, axis=1)[:, :half].sum(1)
    best = int(np.argmin(sums))
    if not (np.isfinite(scale[best]) and scale[best] > 0):
        return None, 1.0
    # as for the median absolute deviation of few values: Rousseeuw and Leroy 1987, page 202
    freedom = 3 if has_height.mean() > 0.5 else 2
    scale2 = float(np.median(squares[best])) / MEDIAN_CHI2[freedom] * (1.0 + 5.0 / max(num - 3, 1)) ** 2
    start = Similarity(
        rotation[best], float(scale[best]), np.zeros(3), shift[best], np.zeros((7, 7)), np.ones((num, 3))
    )
    return start, max(scale2, 1e-12)


def closed_form(x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Similarities (k) of point sets (k, m, 3): rotations (k, 3, 3), scales (k,), shifts (k, 3). Umeyama 1991.

    Points on a line give one of the rotations that fit.
    """
    mean_x, mean_y = x.mean(1), y.mean(1)
    dx, dy = x - mean_x[:, None], y - mean_y[:, None]
    u, d, vt = np.linalg.svd(np.einsum("kni,knj->kij", dy, dx))
    sign = np.ones_like(d)
    sign[:, 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation = np.einsum("kij,kj,kjl->kil", u, sign, vt)
    scale = (d * sign).sum(1) / np.maximum((dx**2).sum((1, 2)), 1e-300)
    shift = mean_y - scale[:, None] * np.einsum("kij,kj->ki", rotation, mean_x)
    return rotation, scale, shift


def turn_between(a: RobustFit, b: RobustFit) -> float:
    """Angle in radians between the verticals that two fits give a model."""
    return float(np.arccos(np.clip(a.similarity.rotation[2] @ b.similarity.rotation[2], -1.0, 1.0)))
