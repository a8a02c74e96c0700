"""How sure the keyframes of a map are, where errors of patches are anything but independent."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.clustered import clustered_covariances
from sfmapp.adjust.covariance import pose_errors_in_gauge
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.geometry import rigid3
from sfmapp.odometry.report import SharedErrors
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

# Two patches of one image have this correlation on average, however far apart they are. Residuals hardly show it, as
# the poses take up what an image has in common. The median over 65 rendered walks through rooms, halls and streets.
_SHARED_CORRELATION = 0.005
# Where errors are independent along the tracks nothing is shared between tracks either. The variance of the poses over
# that of independent errors is then 0.77 to 0.93 (80 synthetic maps; the loss makes it less than 1), and 1.01 to 4.5 on
# images (50 rendered walks). In between what is shared is faded in.
_INDEPENDENT, _CORRELATED = 0.95, 1.0
# A calibration that the images contradicted is a model that did not fit; what the lens does beyond the parameters that
# were refined is known as well as this share of what refining them has moved. On KITTI 00 and 01 a quarter to a third.
_UNKNOWN_SHARE = 0.5
# The same of the unit of length, which one number of the calibration moves: a fifth on KITTI 01, the one real rig here.
_UNKNOWN_SHARE_OF_SCALE = 0.25

# A loss that bends so many times later, over all observations, moves sharp sequences by 0.3 to 1.3 of their standard
# deviations (two rendered flights, five walks through rooms, KITTI 00 and 01). Of blurred ones that nothing else gives
# away a flight is moved by 2.4 and off by 2.7, and twelve walks are moved by 1.1 to 10 and off by 2.4 to 15.
_WIDER, _COVERED_SIGMAS = 2.0, 1.0
# Looked at roughly first, which falls short by up to a sixth and takes a third of the time (KITTI 00: 0.11 of 0.34 s),
# and closely where that comes near to what counts.
_WIDER_STEPS, _ROUGHLY, _CLOSELY, _NEAR_SIGMAS = 30, 1e-3, 1e-5, 0.7


@dataclass(frozen=True)
class MapCovariance:
    """How sure the keyframes of a map are.

    Attributes:
        poses: (K, 6, 6), NaN for those that no point holds. gauge: what they are relative to.
        shared: by how much errors that observations share make them larger.
        noise_px: standard deviation of a pixel coordinate with which independent errors would leave them as large.
    """

    poses: Array
    gauge: str
    shared: SharedErrors
    noise_px: float


def estimate_map_covariance(model: Reconstruction, num_sensors: int, loss_scale_px: float) -> MapCovariance:
    """Covariances of the keyframes, by the images alone.

    Args:
        model: adjusted, images S k + s as of ``KeyframeMap.reconstruction``.
        num_sensors: S. loss_scale_px: of Cauchy's loss, with which it was adjusted.

    Errors along a track are taken as the residuals show them (:mod:`sfmapp.adjust.clustered`). What tracks have in
    common over an image adds to the variance in proportion to how many there are: the effective number of
    observations in an image does not grow without end.
    """
    options = AdjustOptions(
        loss="cauchy", loss_scale_px=loss_scale_px, refine_focal=False, refine_distortion=False
    )  # fmt: skip
    found = clustered_covariances(model, options)
    share = float(np.clip((found.correlation - _INDEPENDENT) / (_CORRELATED - _INDEPENDENT), 0.0, 1.0))
    shared = 1.0 + share * _SHARED_CORRELATION * found.observations_per_image
    covariance = np.full((len(model.image_names) // num_sensors, 6, 6), np.nan)
    of_first = found.image_idx % num_sensors == 0
    covariance[found.image_idx[of_first] // num_sensors] = shared * found.poses[of_first]
    covariance[~np.isfinite(covariance).all((1, 2))] = np.nan
    numbers = SharedErrors(within_tracks=found.correlation, between_tracks=shared)
    gauge = "centroid, mean rotation" + ("" if num_sensors > 1 else " and spread")
    return MapCovariance(covariance, gauge, numbers, found.noise_px * math.sqrt(shared))


def widened_by_loss(
    found: MapCovariance, model: Reconstruction, num_sensors: int, loss_scale_px: float
) -> MapCovariance:
    """The covariances with what it adds that poses hang on which observations are believed.

    In blurred pictures a good part of them is not, and what is left agrees with itself. A loss that bends later, over
    all observations, is another estimate of the same poses; were the noise what the covariances are made of, it would
    differ by less than they say (Hausman, Econometrica 46, 1978).

    Args:
        found: of the same model, sensors and loss, see :func:`estimate_map_covariance`.
    """
    known = np.flatnonzero(np.isfinite(found.poses).all((1, 2)))
    if len(known) < 3:
        return found
    trial, ratio = model.copy(), 0.0
    trial.obs_is_inlier[:] = model.is_triangulated[model.tracks.obs_track_idx]
    for tolerance in (_ROUGHLY, _CLOSELY):
        options = AdjustOptions(
            loss="cauchy", loss_scale_px=_WIDER * loss_scale_px, refine_focal=False, refine_distortion=False,
            max_iterations=_WIDER_STEPS, relative_cost_tolerance=tolerance,
        )  # fmt: skip
        adjust_bundle(trial, options)
        moved = pose_errors_in_gauge(trial, model, known * num_sensors, 7 if num_sensors == 1 else 6)
        ratio = max(
            float(np.sqrt(np.mean((moved[:, half] ** 2).sum(1) / np.trace(found.poses[known, half, half], 0, 1, 2))))
            for half in (slice(0, 3), slice(3, 6))
        )
        if ratio < _NEAR_SIGMAS:
            break
    growth = 1.0 + max(ratio**2 - _COVERED_SIGMAS**2, 0.0)
    return replace(found, poses=growth * found.poses, shared=replace(found.shared, wider_loss_sigmas=ratio))


def covariance_of_refinement(given: Reconstruction, refined: Reconstruction, num_sensors: int) -> Array:
    """(6, 6) that a refined calibration adds to each keyframe, the same about and along all axes.

    Args:
        given, refined: the map adjusted with the calibration as it was given, and as it has become.
    """
    first = np.flatnonzero(given.is_registered & refined.is_registered)
    first = first[first % num_sensors == 0]
    moved = pose_errors_in_gauge(refined, given, first, 7 if num_sensors == 1 else 6)
    mean_squares = [float((moved[:, part] ** 2).mean()) for part in (slice(0, 3), slice(3, 6))]
    return _UNKNOWN_SHARE**2 * np.diag(np.repeat(mean_squares, 3))


def scale_sigma_of_refinement(given: Reconstruction, refined: Reconstruction) -> float:
    """Relative standard deviation that a refined calibration adds to the unit of length of a rig; as above."""
    return _UNKNOWN_SHARE_OF_SCALE * abs(
        math.log(rigid3.spread(refined.cam_from_world) / rigid3.spread(given.cam_from_world))
    )
