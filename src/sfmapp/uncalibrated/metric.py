"""From a projective model to a metric one: known points, or self-calibration and an adjustment with one camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.covariance import estimate_covariances
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3
from sfmapp.geometry.absolute_conic import MetricFrame, NoMetricFrameError, kind_of_motion, self_calibrate
from sfmapp.geometry.dlt import decompose_projection
from sfmapp.geometry.projective import dehomogenized, in_frame
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.tracks import Tracks
from sfmapp.uncalibrated.projective_model import ProjectiveReconstruction

Array = NDArray[np.float64]

# A focal length with a larger share of sigma is said to be open: what hangs on it is no measurement
_MAX_SIGMA = 0.1
# residuals of keypoints that a camera without skew or distortion leaves, over those of twelve free numbers a view:
# beyond it the pictures are of no such camera
_MOST_WORSE = 3.0


@dataclass(frozen=True)
class MetricModel:
    """A metric model of uncalibrated photographs, up to a similarity.

    Attributes:
        reconstruction: cameras (one), poses, points; images without a camera are not registered.
        start: the frame of the absolute conic, before the adjustment.
        focal_px, focal_sigma_px: after it; the principal point and square pixels are taken for granted.
        rms_px: of a coordinate after it. projective_rms_px: before, with eleven numbers for each view.
        motion: kind of the turns, in words, if they are special; what they leave open is then said by ``warnings``.
    """

    reconstruction: Reconstruction
    start: MetricFrame
    focal_px: float
    focal_sigma_px: float
    rms_px: float
    projective_rms_px: float
    motion: str
    warnings: tuple[str, ...]


def upgrade_by_self_calibration(
    found: ProjectiveReconstruction, names: Sequence[str], size: tuple[int, int], *, threads: int = 1
) -> MetricModel:
    """The metric model of photographs from one camera with square pixels and its principal point in the middle.

    Args:
        found: the projective model. names: of all images. size: (width, height) of each.

    Raises:
        NoMetricFrameError: too few views, no such camera, or motions that leave it open.
    """
    center = np.array([0.5 * size[0], 0.5 * size[1]])
    start = self_calibrate(found.model.cameras, found.model.points, center, float(max(size)))
    model = _reconstruction(found, start, names, size)
    options = AdjustOptions(refine_distortion=False, max_iterations=100).robust(max(found.info.sigma_px, 0.05))
    adjust_bundle(model, options, threads=threads)
    covariances = estimate_covariances(model, options)
    focal = model.cameras[0].focal
    sigma = math.sqrt(float(covariances.intrinsics[0][0, 0])) if len(covariances.intrinsics) else math.inf
    # turns as the adjustment has them: those of the start are too rough to tell one axis from several
    poses = model.cam_from_world[found.view_idx]
    motion = kind_of_motion(np.eye(4), rigid3.to_matrix(poses))
    left = model.residuals_px()[model.obs_is_inlier]
    rms = float(np.sqrt(np.nanmean(left**2)))
    if not sigma < _MAX_SIGMA * focal:
        raise NoMetricFrameError(
            f"these motions do not tell the camera: {motion}. The focal length is {focal:.0f} +- {sigma:.0f} px"
        )
    return MetricModel(model, start, focal, sigma, rms, found.info.rms_px, *_doubts(motion, found, rms))


def _doubts(motion: str, found: ProjectiveReconstruction, rms: float) -> tuple[str, tuple[str, ...]]:
    warnings = []
    if "one axis" in motion:
        warnings.append(
            "the camera turned about one axis only: the scale along that axis hangs on square pixels, and where it "
            "vanishes on the principal point; neither can be checked, and the sigma of the focal length has no "
            "part of it"
        )
    else:
        motion = ""
    if rms > _MOST_WORSE * found.info.rms_px:
        warnings.append(
            f"one camera with square pixels leaves {rms:.2f} px where a projective one leaves "
            f"{found.info.rms_px:.2f}: the "
            "photographs were zoomed or cropped, or their lens distorts"
        )
    return motion, tuple(warnings)


def _reconstruction(
    found: ProjectiveReconstruction, start: MetricFrame, names: Sequence[str], size: tuple[int, int]
) -> Reconstruction:
    """As the stages of calibrated photographs have it, at a scale with the cameras one unit from their middle."""
    cameras, points = in_frame(found.model.cameras, found.model.points, start.frame)
    xyz = dehomogenized(points)
    poses = []
    for camera in cameras:
        _, rotation, translation = decompose_projection(camera)
        poses.append(rigid3.from_matrix(rotation, translation))
    cam_from_world = np.array(poses)
    centers = rigid3.center(cam_from_world)
    unit = 1.0 / max(float(np.sqrt(((centers - centers.mean(0)) ** 2).sum(1).mean())), 1e-300)
    cam_from_world[:, 4:] *= unit
    camera = Camera(
        CameraModel.SIMPLE_PINHOLE, size[0], size[1], np.array([float(start.k[0, 0]), 0.5 * size[0], 0.5 * size[1]])
    )
    seen = found.seen
    tracks = Tracks.from_observations(seen.point_idx, found.view_idx[seen.view_idx], seen.xy, num_images=len(names))
    model = Reconstruction.empty([camera], list(names), np.zeros(len(names), np.int32), tracks)
    model.cam_from_world[found.view_idx] = cam_from_world
    model.point_xyz[:] = xyz * unit
    # a point at infinity, or behind a camera, is none of a metric model
    model.obs_is_inlier[:] = np.isfinite(model.residuals_px()).all(1)
    return model
