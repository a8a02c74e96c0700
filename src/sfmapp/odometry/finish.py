"""The last word on a map: all keyframes adjusted at once, the calibration questioned, and how sure the poses are."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.solver import AdjustOptions, adjust_bundle
from sfmapp.contradictions import Contradiction
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.mapping.structure import residual_scale_px
from sfmapp.odometry.backend import classify, make_job, take_over
from sfmapp.odometry.keyframe_map import KeyframeMap
from sfmapp.odometry.map_covariance import covariance_of_refinement, estimate_map_covariance
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.stereo import turn_of_rig
from sfmapp.odometry.sweep import is_too_large, sweep
from sfmapp.scene.camera import Camera, CameraModel
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]

STAGE = "adjustment"
# What a calibration is off by: rectification, temperature and a lens model with few terms leave about a percent.
_FOCAL_SIGMA, _DISTORTION_SIGMA = 0.01, 0.01
# The cameras of a rig turn against each other with temperature and shocks. A hundredth of a degree of that changes the
# scale of a drive by half a percent, and if it is not let free the focal lengths bend to explain it.
_TURN_SIGMA_DEG = 0.05
# A changed calibration has to explain this much, in units of the noise, per free parameter. Independent noise alone
# explains 1; errors of patches are not independent, and exact cameras of rendered sequences show up to 30. Rectified
# images of a real car show a thousand.
MIN_EVIDENCE = 90.0
# A map whose poses leave the calibration open must not decide on it: the largest change in sigmas of what was given.
_MAX_CHANGE_SIGMAS = 4.0
# Covariances take two dense matrices over all poses.
_MAX_COVARIANCE_KEYFRAMES = 400
_FIRST_STEPS, _MAX_STEPS = 8, 30
# Keyframes of a large map that its cameras are questioned on.
_NUM_QUESTIONED = 100
# Where Cauchy's loss begins to bend, in sigmas.
_LOSS_SIGMAS = 2.0
# Residuals are not believed to be better than that, however well a synthetic sequence fits.
MIN_SIGMA_PX = 0.02


@dataclass(frozen=True)
class Conclusion:
    """What the end of a map has brought.

    Attributes:
        covariance: (K, 6, 6) of the keyframes; None if not asked for or too many.
        gauge: what it holds fixed.
        report: numbers for the report.
        contradictions: evidence against the map that stands unresolved.
    """

    covariance: Array | None
    gauge: str
    report: dict[str, Any]
    contradictions: list[Contradiction] = field(default_factory=list)


def conclude(keyframes: KeyframeMap, options: OdometryOptions, events: Events) -> Conclusion:
    """Adjust all keyframes and points of a map, in place, and the cameras where the images contradict them."""
    if is_too_large(keyframes):
        return _conclude_large(keyframes, options, events)
    everything = np.arange(len(keyframes.keyframes))
    job = make_job(keyframes, everything, everything > 0)
    model, report = job.model, dict[str, Any]()
    for steps in (_FIRST_STEPS, _MAX_STEPS):  # which observations agree is clear long before all have settled
        sigma = max(residual_scale_px(model), MIN_SIGMA_PX)
        cost = _adjust(model, sigma, max_steps=steps)
        if steps == _FIRST_STEPS:
            classify(model, job.num_elsewhere)
        events.raise_if_cancelled()
    num_sensors, of_refinement = len(keyframes.rig.cameras), np.zeros((6, 6))
    if options.refine_camera:
        refined, report["camera"] = _question_cameras(job.model, cost, sigma)
        if refined is not None:
            events.decided(STAGE, "the images contradict the given calibration, which is refined", **report["camera"])
            of_refinement = covariance_of_refinement(model, refined, num_sensors)
            job.model = model = refined
    report["sigma_px"] = classify(model, job.num_elsewhere)
    take_over(job, keyframes)
    keyframes.rig = _rig_of(model)
    covariance, gauge = None, ""
    if options.covariance and 1 < len(everything) <= _MAX_COVARIANCE_KEYFRAMES:
        covariance, gauge, report["covariance"] = estimate_map_covariance(model, num_sensors, _LOSS_SIGMAS * sigma)
        covariance += of_refinement
    return Conclusion(covariance, gauge, report)


def _conclude_large(keyframes: KeyframeMap, options: OdometryOptions, events: Events) -> Conclusion:
    """The same piece by piece, without covariances; the cameras are questioned on the newest keyframes alone."""
    report: dict[str, Any] = {"is_piecewise": True}
    if options.refine_camera:
        num = len(keyframes.keyframes)
        part = np.arange(num - _NUM_QUESTIONED, num)
        job = make_job(keyframes, part, part > part[0])
        sigma = max(residual_scale_px(job.model), MIN_SIGMA_PX)
        refined, report["camera"] = _question_cameras(job.model, _adjust(job.model, sigma), sigma)
        if refined is not None:
            events.decided(STAGE, "the images contradict the given calibration, which is refined", **report["camera"])
            keyframes.rig = _rig_of(refined)
            if refined.rig is not None:
                _rescale(keyframes, _spread(refined) / _spread(job.model))
    sweep(keyframes, options, events)
    return Conclusion(None, "", report)


def _adjust(
    model: Reconstruction, sigma: float, given: list[Camera] | None = None, max_steps: int = _MAX_STEPS
) -> float:
    """Adjust all, the cameras as well if they were given; returns the cost in units of the noise."""
    num_sensors = 1 if model.rig is None else len(model.rig.cam_from_rig)
    variable = np.ones(len(model.image_names), bool)
    variable[:num_sensors] = False
    # the engine counts a residual of one pixel as one sigma, so priors are handed over in that unit
    priors = None if given is None else [replace(c, focal_sigma=_FOCAL_SIGMA * c.focal / sigma) for c in given]
    turn_px = math.radians(_TURN_SIGMA_DEG) * model.cameras[0].focal
    result = adjust_bundle(
        model,
        AdjustOptions(
            loss="cauchy", loss_scale_px=_LOSS_SIGMAS * sigma, max_iterations=max_steps,
            # how long lenses are and what the scale is show last: with 1e-4 a drive of 144 m ends 0.1 m off, not 0.02
            relative_cost_tolerance=1e-4 if given is None else 1e-5,
            refine_focal=given is not None, refine_distortion=given is not None,
            distortion_sigma=_DISTORTION_SIGMA / sigma, refine_principal_point=given is not None,
            principal_point_sigma_px=turn_px / sigma,
        ),
        variable_images=variable, variable_centers=np.arange(len(model.cameras)) > 0, prior_cameras=priors,
    )  # fmt: skip
    return 2 * result.final_cost / sigma**2


def _question_cameras(
    model: Reconstruction, before: float, sigma: float
) -> tuple[Reconstruction | None, dict[str, Any]]:
    """The model with refined cameras if they explain the same observations much better, and the numbers behind that.

    Args:
        model: adjusted with the cameras as they were given. before: its cost in units of the noise, sigma in pixels.
    """
    given = [_with_distortion(camera) for camera in model.cameras]
    free = model.copy()
    free.cameras = list(given)
    turn_deg = _straighten_rig(free)
    after = _adjust(free, sigma, given)
    evidence = (before - after) / (sum(len(camera.params) for camera in given) - 2)
    changes = [c.focal / g.focal - 1 for c, g in zip(free.cameras, given, strict=True)]
    accepted = evidence > MIN_EVIDENCE and max(map(abs, changes)) < _MAX_CHANGE_SIGMAS * _FOCAL_SIGMA
    numbers = {
        "is_refined": bool(accepted), "evidence_per_parameter": evidence, "min_evidence": MIN_EVIDENCE,
        "focal_change": changes, "turn_deg": turn_deg, "given": [c.params.tolist() for c in given],
        "refined": [c.params.tolist() for c in free.cameras],
    }  # fmt: skip
    return free if accepted else None, numbers


def _rig_of(model: Reconstruction) -> Rig:
    return Rig(tuple(model.cameras), rigid3.IDENTITY[None] if model.rig is None else model.rig.cam_from_rig)


def _spread(model: Reconstruction) -> float:
    """Root mean square distance of the cameras from their middle."""
    return float(np.sqrt(((model.centers - model.centers.mean(0)) ** 2).sum(1).mean()))


def _rescale(keyframes: KeyframeMap, scale: float) -> None:
    """Make a map larger, in place: a rig that is turned measures other lengths."""
    keyframes.point_xyz *= scale
    for keyframe in keyframes.keyframes:
        keyframe.rig_from_world[4:] *= scale


def _straighten_rig(model: Reconstruction) -> list[float]:
    """Turn the second camera of a rig, in place, so that its matches meet their epipolar lines; returns by how much."""
    if model.rig is None:
        return []
    tracks, sensor = model.tracks, model.rig.sensor_idx
    # a point that both cameras saw at once has two observations in a row: images are sorted within a track
    image, track = tracks.obs_image_idx, tracks.obs_track_idx
    first = np.flatnonzero(
        (track[1:] == track[:-1]) & (model.rig.frame_idx[image[1:]] == model.rig.frame_idx[image[:-1]])
        & (sensor[image[:-1]] == 0) & (sensor[image[1:]] == 1) & model.obs_is_inlier[1:] & model.obs_is_inlier[:-1]
    )  # fmt: skip
    rig = Rig(tuple(model.cameras), model.rig.cam_from_rig)
    turn = turn_of_rig(rig, tracks.obs_xy[first], tracks.obs_xy[first + 1], _TURN_SIGMA_DEG)
    mounts = model.rig.cam_from_rig.copy()
    mounts[1] = rigid3.compose(rigid3.from_matrix(rigid3.exp_so3(turn), np.zeros(3)), mounts[1])
    rig_from_world = model.rig.rig_from_world(model.cam_from_world)
    model.rig = replace(model.rig, cam_from_rig=mounts)
    images = np.arange(len(sensor))
    model.cam_from_world = model.rig.cam_from_world(images, rig_from_world[model.rig.frame_idx])
    return np.degrees(turn).tolist()


def _with_distortion(camera: Camera) -> Camera:
    """The same camera in a model that has room for distortion, free to change. The principal point of the first is not
    refined, as a turn of the camera looks the same; that of another camera stands for its turn in the rig."""
    if camera.is_fisheye:
        return replace(camera, is_fixed=False)
    return replace(camera, model=CameraModel.OPENCV, params=camera.canonical, is_fixed=False)
