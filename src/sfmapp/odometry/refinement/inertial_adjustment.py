"""Keyframes adjusted together with what an inertial sensor measured between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfmapp.adjust.options import AdjustOptions
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Imu
from sfmapp.odometry.inertial.faults import align_or_explain
from sfmapp.odometry.inertial.scale import ScaleRefusal
from sfmapp.odometry.inertial.seen_map import SeenMap
from sfmapp.odometry.inertial.visual_inertial import InertialAlignment
from sfmapp.odometry.map.backend import make_job, take_over
from sfmapp.odometry.map.covariance import estimate_map_covariance
from sfmapp.odometry.map.keyframe_map import KeyframeMap
from sfmapp.odometry.refinement.calibration_check import LOSS_SIGMAS
from sfmapp.odometry.report import InertialEvidence

# Covariances take two dense matrices over all poses.
MAX_COVARIANCE_KEYFRAMES = 400


def adjust_with_imu(
    keyframes: KeyframeMap, imu: Imu, sigma_px: float, *, noise_px: float | None, scale_sigma: float | None
) -> InertialAlignment | ScaleRefusal:
    """Adjust a map, in place, with inertial measurements, unless they refuse to or contradict it.

    A map of more than 400 keyframes is not changed: its last 400 tell what its unit is.

    Args:
        keyframes: adjusted by its images, which tell which observations agree.
        sigma_px: the noise of an observation, by which the loss is set.
        noise_px: what that comes to with what errors have in common (``MapCovariance.noise_px``); None to find out.
        scale_sigma: of a rig's unit of length; None for a single camera.
    """
    num = len(keyframes.keyframes)
    part = np.arange(max(0, num - MAX_COVARIANCE_KEYFRAMES), num)
    job = make_job(keyframes, part, part > part[0])
    if noise_px is None:
        num_sensors = len(keyframes.rig.cameras)
        noise_px = estimate_map_covariance(job.model, num_sensors, LOSS_SIGMAS * sigma_px).noise_px
    if not np.isfinite(noise_px):
        reason = "the observations do not determine the poses of the map"
        return ScaleRefusal("imu", reason, InertialEvidence(num_poses=len(part), num_intervals=0))
    options = AdjustOptions(
        loss="cauchy", loss_scale_px=LOSS_SIGMAS * sigma_px, refine_focal=False, refine_distortion=False
    )
    times = np.array([keyframes.keyframes[k].timestamp_s for k in part])
    seen = SeenMap(job.model, times, options, noise_px, scale_sigma)
    found = align_or_explain(seen, imu)
    if isinstance(found, ScaleRefusal):
        return found
    if len(part) < num:
        bent, straight = (rigid3.spread(m.cam_from_world) for m in (found.model, job.model))
        return replace(found, scale=found.scale * bent / straight, model=job.model)
    job.model = found.model
    take_over(job, keyframes)
    return found
