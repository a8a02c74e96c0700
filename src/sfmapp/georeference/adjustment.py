"""A model that lies in the frame already, adjusted with the measured places of its cameras, and both judged by it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.georeference.drift import Drift
from sfmapp.georeference.factors import position_graph
from sfmapp.georeference.fit import LevelOfImage, fit_similarity
from sfmapp.georeference.robust_fit import MAX_CHI2, MIN_REDUNDANT, RobustFit, estimate_factors
from sfmapp.mapping.mapper import Mapper
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Rounds of adjusting and of judging the positions anew, and the change of sigmas that calls for another.
_MAX_ROUNDS, _SETTLED = 4, 0.1
# Positions add three numbers each, and may cost the reprojections about as much chi square; so many times that is a
# contradiction between photographs and positions, not noise.
MAX_COST_PER_NUMBER = 10.0
# Positions with sigmas so many times as large hold a model in its place, and do not bend it.
_LOOSE = 1e3


class Measured(NamedTuple):
    """Places (m, 3) of images (m,) and their sigmas (m, 3) as stated or guessed, in metres, infinite for no height."""

    image_idx: NDArray[np.int64]
    places: Array
    sigma: Array
    is_stated: Mask


@dataclass(frozen=True)
class Adjusted:
    """What came of it.

    Attributes:
        fit: places against cameras as they lie now.
        covariance: (3, 3) of the centre of each image, in the frame; empty where that could not be had.
    """

    fit: RobustFit
    covariance: dict[int, Array]


def adjust_with_positions(
    mapper: Mapper, measured: Measured, fit: RobustFit, level: LevelOfImage | None, drift: Drift
) -> Adjusted | None:
    """Adjust a model in place with the positions that agree, and judge all of them by what came of it.

    How good positions are follows from their residuals and from what the adjustment leaves of each (its redundancy), so
    that a model that gives way to them does not make them look better than they are.

    Args:
        mapper: of a model that lies in the frame.
        fit: of its cameras to the places.
        level: more about the vertical.
        drift: what errors of neighbouring positions have in common.

    Returns:
        None where photographs and positions contradict each other: the model is then to be taken back.
    """
    model, noise = mapper.reconstruction, mapper.noise
    # what photographs alone make of one more adjustment is no doing of the positions: those hold but the gauge here
    loose = fit.sigma * _LOOSE
    mapper.adjust_with(position_graph(measured.image_idx, measured.places, loose, level), noise)
    before = model.copy()
    if (
        measured.is_stated.any() and len(measured.image_idx) >= MIN_REDUNDANT
    ):  # what the shape of the model makes of residuals is no reason to doubt them yet
        fit = _with_factors(fit, measured, np.where(measured.is_stated, 1.0, fit.factor))
    covariance: dict[int, Array] = {}
    for _ in range(_MAX_ROUNDS):
        used, factor = fit.is_inlier, np.array(fit.factor)
        places, sigma = measured.places[used], fit.sigma[used] * drift.inflation
        images = measured.image_idx[used]
        graph = position_graph(images, places, sigma, level)
        mapper.adjust_with(graph, noise)
        if not model.is_registered[measured.image_idx].all():
            return None
        covariance = _center_covariances(mapper, graph)
        fit = _judged(fit, model.centers[measured.image_idx], measured, covariance, drift.inflation)
        if np.array_equal(fit.is_inlier, used) and np.allclose(fit.factor, factor, rtol=_SETTLED):
            break
    cost = growth_of_cost(before, model, noise.sigma_px)
    if cost > MAX_COST_PER_NUMBER * 3 * int(fit.is_inlier.sum()):
        return None
    return Adjusted(finished(fit, model, measured, level, drift), covariance)


def finished(
    fit: RobustFit, model: Reconstruction, measured: Measured, level: LevelOfImage | None, drift: Drift
) -> RobustFit:
    """A fit with residuals of the cameras as they lie, and a covariance with what errors have in common."""
    centers = model.centers[measured.image_idx]
    residual = centers - measured.places
    chi2 = np.nansum((residual / fit.sigma) ** 2, axis=1)
    is_inlier = chi2 <= MAX_CHI2 if len(chi2) >= MIN_REDUNDANT else np.ones(len(chi2), bool)
    in_world = None
    if level is not None:
        turn = rigid3.rotation_matrix(model.cam_from_world[level.image_idx])
        in_world = replace(level.level, up=turn.T @ level.level.up)
    origin = centers.mean(0)
    here = replace(fit.similarity, rotation=np.eye(3), scale=1.0, origin=origin, mean=origin)
    found = fit_similarity(centers, measured.places, fit.sigma, is_inlier, here, in_world) or fit.similarity
    found = replace(found, covariance=found.covariance * np.outer(drift.spread, drift.spread))
    return replace(fit, similarity=found, residual=residual, chi2=chi2, is_inlier=is_inlier)


def _with_factors(fit: RobustFit, measured: Measured, factor: Array) -> RobustFit:
    return replace(fit, factor=(float(factor[0]), float(factor[1])), sigma=measured.sigma * factor[[0, 0, 1]])


def _judged(
    fit: RobustFit, centers: Array, measured: Measured, covariance: dict[int, Array], inflation: float
) -> RobustFit:
    """Factors and inliers anew, by the residuals of cameras as they lie."""
    residual = centers - measured.places
    if len(centers) < MIN_REDUNDANT:
        return replace(fit, residual=residual)
    if covariance:
        variance = np.array([np.diag(covariance[i]) for i in measured.image_idx.tolist()])
        share = np.clip(variance / (fit.sigma * inflation) ** 2, 0.0, 1.0)
        redundancy = np.where(fit.is_inlier[:, None], 1.0 - share, 1.0 + share)
    else:
        redundancy = fit.similarity.redundancy
    squares = (residual / measured.sigma) ** 2
    factor = estimate_factors(squares, redundancy, measured.sigma, fit.is_inlier, measured.is_stated)
    fit = _with_factors(fit, measured, factor)
    chi2 = np.nansum((residual / fit.sigma) ** 2, axis=1)
    return replace(fit, residual=residual, chi2=chi2, is_inlier=chi2 <= MAX_CHI2)


def _center_covariances(mapper: Mapper, graph: object) -> dict[int, Array]:
    """(3, 3) of the centres of images, in the frame, by image; empty where they cannot be had."""
    found = mapper.pose_covariances_with(graph)
    if found is None:
        return {}
    images, poses = found
    of_centers = rigid3.center_covariance(mapper.reconstruction.cam_from_world[images], poses)
    return dict(zip(images.tolist(), of_centers, strict=True))


def growth_of_cost(before: Reconstruction, after: Reconstruction, noise_px: float) -> float:
    """Growth of the squared residuals of observations that hold in both, in units of their noise; those far off are
    counted as at three."""
    both = before.obs_is_inlier & after.obs_is_inlier
    chi2 = [np.minimum((model.residuals_px()[both] ** 2).sum(1) / noise_px**2, 9.0) for model in (before, after)]
    return float((chi2[1] - chi2[0]).sum())
