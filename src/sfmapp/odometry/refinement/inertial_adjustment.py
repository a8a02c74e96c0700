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
from sfmapp.odometry.loops.pose_graph import count_shared
from sfmapp.odometry.map.backend import make_job, take_over
from sfmapp.odometry.map.covariance import estimate_map_covariance
from sfmapp.odometry.map.keyframe_map import KeyframeMap
from sfmapp.odometry.options import MAX_COVARIANCE_KEYFRAMES
from sfmapp.odometry.refinement.calibration_check import LOSS_SIGMAS
from sfmapp.odometry.report import InertialEvidence

# Pairs of keyframes that share points, up to which a map is adjusted as a whole: a thousand keyframes that all see the
# same room, whose system is a full matrix of 288 MB. A walk of some thousands that see what is around them has fewer.
_MAX_PAIRS = 500_000


def adjust_with_imu(
    keyframes: KeyframeMap, imu: Imu, sigma_px: float, *, noise_px: float | None, scale_sigma: float | None
) -> InertialAlignment | ScaleRefusal:
    """Adjust a map, in place, with inertial measurements, unless they refuse to or contradict it.

    A map whose keyframes see too many others is not changed: the last of them tell what its unit is.

    Args:
        keyframes: adjusted by its images, which tell which observations agree.
        sigma_px: the noise of an observation, by which the loss is set.
        noise_px: what that comes to with what errors have in common (``MapCovariance.noise_px``); None to find out.
        scale_sigma: of a rig's unit of length; None for a single camera.
    """
    num, first = len(keyframes.keyframes), _first_of_part(keyframes)
    part = np.arange(first, num)
    job = make_job(keyframes, part, part > first)
    if noise_px is None:
        noise_px = _noise_together(keyframes, sigma_px)
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
    if first > 0:
        bent, straight = (rigid3.spread(m.cam_from_world) for m in (found.model, job.model))
        return replace(found, scale=found.scale * bent / straight, model=job.model)
    job.model = found.model
    take_over(job, keyframes)
    return found


def _first_of_part(keyframes: KeyframeMap) -> int:
    """The first of the last keyframes that are adjusted together; 0 where that is all of them."""
    num = len(keyframes.keyframes)
    if num <= MAX_COVARIANCE_KEYFRAMES:
        return 0
    with_later = np.tril(count_shared(keyframes) > 0).sum(0)
    return int(np.argmax(np.cumsum(with_later[::-1])[::-1] <= _MAX_PAIRS))


def _noise_together(keyframes: KeyframeMap, sigma_px: float) -> float:
    """``MapCovariance.noise_px`` of the newest keyframes: it is a ratio, which does not hang on how many they are."""
    num = len(keyframes.keyframes)
    part = np.arange(max(0, num - MAX_COVARIANCE_KEYFRAMES), num)
    model = make_job(keyframes, part, part > part[0]).model
    return estimate_map_covariance(model, len(keyframes.rig.cameras), LOSS_SIGMAS * sigma_px).noise_px
