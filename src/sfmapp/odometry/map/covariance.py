"""How sure the keyframes of a map are, where errors of patches are anything but independent."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.clustered import clustered_covariances
from sfmapp.adjust.covariance import pose_errors_in_gauge
from sfmapp.adjust.options import AdjustOptions
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
