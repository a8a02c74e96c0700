"""The last word on a map: all keyframes adjusted at once, the calibration questioned, and how sure the poses are."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.options import AdjustOptions, AdjustReport
from sfmapp.contradictions import Contradiction
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Imu
from sfmapp.mapping.structure import residual_scale_px
from sfmapp.odometry.inertial.scale import ScaleEstimate, ScaleRefusal
from sfmapp.odometry.inertial.visual_inertial import InertialAlignment
from sfmapp.odometry.loops.sweep import is_too_large, sweep
from sfmapp.odometry.map.backend import Job, classify, make_job, take_over
from sfmapp.odometry.map.covariance import (
    covariance_of_refinement,
    estimate_map_covariance,
    scale_sigma_of_refinement,
    widened_by_loss,
)
from sfmapp.odometry.map.keyframe_map import KeyframeMap
from sfmapp.odometry.options import MAX_COVARIANCE_KEYFRAMES, OdometryOptions
from sfmapp.odometry.refinement.calibration_check import (
    LOSS_SIGMAS,
    Answer,
    adjust_poses,
    close_poses,
    follow_with_poses,
    question_calibration,
)
from sfmapp.odometry.refinement.inertial_adjustment import adjust_with_imu
from sfmapp.odometry.refinement.motion_plane import offer_plane
from sfmapp.odometry.report import AdjustmentReport, PlaneEvidence
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]

STAGE = "adjustment"
# A rolling shutter has to explain this much, in units of the noise. Independent noise alone explains 1; errors of
# patches are not independent, and exact cameras of rendered sequences show up to 30.
MIN_EVIDENCE = 90.0
_FIRST_STEPS, _MAX_STEPS, _TOLERANCE = 8, 30, 1e-4
# A unit of length that is less sure than that is worth a word.
_SCALE_OPEN = 0.02
# A map whose positions are not known to a tenth of its size has no shape to speak of.
_MAX_OPEN_SHARE = 0.1
# Keyframes of a large map that its cameras are questioned on.
_NUM_QUESTIONED = 100
# Residuals are not believed to be better than that, however well a synthetic sequence fits.
MIN_SIGMA_PX = 0.02


@dataclass(frozen=True)
class FinalAdjustment:
    """What the end of a map has brought.

    Attributes:
        covariance: (K, 6, 6) of the keyframes; None if not asked for or too many.
        gauge: what it holds fixed.
        report: numbers for the report.
        contradictions: evidence against the map that stands unresolved.
        scale_sigma: relative standard deviation of the unit of length of a rig; None without one.
        noise_covariance: (K, 6, 6) what the noise of the observations alone makes of ``covariance``.
        adjustment: the last of all keyframes together; None where they were too many.
        inertial: what an inertial sensor said of the unit of length; None without one.
    """

    covariance: Array | None
    gauge: str
    report: AdjustmentReport
    contradictions: list[Contradiction] = field(default_factory=list)
    scale_sigma: float | None = None
    noise_covariance: Array | None = None
    adjustment: AdjustReport | None = None
    inertial: ScaleEstimate | ScaleRefusal | None = None


def adjust_finally(
    keyframes: KeyframeMap, options: OdometryOptions, events: Events, given: Rig | None = None, imu: Imu | None = None
) -> FinalAdjustment:
    """Adjust all keyframes and points of a map, in place, and the cameras where the images contradict them.

    Images alone come first: they question the calibration, and tell which observations agree and how much their errors
    have in common. Where there is an inertial sensor, and it agrees, the last adjustment is of both.

    Args:
        keyframes: with the rig that it was made with, which may be a refined one.
        options, events: the usual.
        given: the rig as it was given, which is questioned once more, by all there is; None for that of the keyframes.
        imu: what was measured beside the frames; None: nothing, or nothing that is to count.
    """
    if is_too_large(keyframes):
        return _adjust_large_map(keyframes, options, events, imu)
    everything = np.arange(len(keyframes.keyframes))
    job = make_job(keyframes, everything, everything > 0)
    model = job.model
    # which observations agree is clear long before all have settled
    adjust_poses(model, residual_scale_px(model, MIN_SIGMA_PX), _FIRST_STEPS, _TOLERANCE, events=events)
    classify(model, job.num_elsewhere)
    events.raise_if_cancelled()
    sigma = residual_scale_px(model, MIN_SIGMA_PX)
    cost, found_before = follow_with_poses(model, sigma, events), None
    events.raise_if_cancelled()
    if given is not None and keyframes.rig is not given:
        found_before, model = (model, cost), _with_rig(model, given)
        cost = follow_with_poses(model, sigma, events)
    answer = _question(model, cost, sigma, options, events, found_before)
    adjustment = close_poses(answer.model, sigma, _MAX_STEPS, _TOLERANCE, events)
    num_sensors, of_refinement = len(keyframes.rig.cameras), np.zeros((6, 6))
    if answer.is_refined:
        of_refinement = covariance_of_refinement(model, answer.model, num_sensors) / answer.excess**2
    events.decided(STAGE, f"closing adjustment: {adjustment.text}", **adjustment)
    job.model = model = answer.model
    report = AdjustmentReport(camera=answer.report, sigma_px=classify(model, job.num_elsewhere))
    take_over(job, keyframes)
    keyframes.rig = rig_of(model)
    found, final = (
        None,
        FinalAdjustment(None, "", report, list(answer.contradictions), answer.scale_sigma, None, adjustment),
    )
    asks_for_covariance = options.covariance or imu is not None or options.motion != "free"
    if 1 < len(everything) <= MAX_COVARIANCE_KEYFRAMES and asks_for_covariance:
        found = estimate_map_covariance(model, num_sensors, LOSS_SIGMAS * sigma)
    if imu is not None:
        final = _with_imu(final, keyframes, imu, (sigma, None if found is None else found.noise_px), events)
    final = _with_plane(final, job, keyframes, options, (sigma, None if found is None else found.noise_px), events)
    if found is None or not options.covariance:
        return final
    found = widened_by_loss(found, model, num_sensors, LOSS_SIGMAS * sigma)
    noise = found.poses if final.noise_covariance is None else final.noise_covariance
    covariance = noise + of_refinement + (0.0 if answer.pose_covariance is None else answer.pose_covariance)
    if answer.is_refined:
        final.contradictions.extend(_left_open(covariance, rigid3.spread(model.cam_from_world), events))
    return replace(
        final, covariance=covariance, gauge=found.gauge, report=replace(final.report, covariance=found.shared),
        noise_covariance=noise,
    )  # fmt: skip


def _with_imu(
    final: FinalAdjustment, keyframes: KeyframeMap, imu: Imu, noise_px: tuple[float, float | None], events: Events
) -> FinalAdjustment:
    """What the images have brought, and what an inertial sensor makes of it.

    Args:
        noise_px: of an observation, and what that comes to with what errors have in common, where it is known.
    """
    sigma, together = noise_px
    is_metric = final.scale_sigma is not None
    found = adjust_with_imu(keyframes, imu, sigma, noise_px=together, scale_sigma=final.scale_sigma)
    events.raise_if_cancelled()
    report = replace(final.report, inertial=found.evidence)
    if isinstance(found, InertialAlignment):
        numbers = found.adjustment
        events.decided(STAGE, f"closing adjustment with inertial measurements: {numbers.text}", **numbers)
        return replace(
            final,
            report=report,
            adjustment=numbers,
            inertial=found.scale_estimate,
            noise_covariance=found.pose_covariance,
        )
    contradictions = list(final.contradictions)
    if is_metric and found.contradiction is not None:  # of a single camera the scale is told of, or why there is none
        contradictions.append(found.contradiction)
        events.warned(STAGE, found.contradiction.message, subject=found.contradiction.subject)
    return replace(final, report=report, inertial=found, contradictions=contradictions)


def _with_plane(
    final: FinalAdjustment, job: Job, keyframes: KeyframeMap, options: OdometryOptions,
    noise_px: tuple[float, float | None], events: Events,
) -> FinalAdjustment:  # fmt: skip
    """What there is so far, and what the plane of a camera on wheels makes of it; or what speaks for such a plane.

    Args:
        job: the map as the images alone have it, which is in ``keyframes``.
        noise_px: of an observation, and what that comes to with what errors have in common, where it is known.
    """
    sigma, together = noise_px
    num_sensors, found = len(keyframes.rig.cameras), None
    if options.motion == "free":
        found = offer_plane(job.model.cam_from_world[::num_sensors]) if final.inertial is None else None
    elif final.inertial is not None:
        found = PlaneEvidence(state="dropped", reason="an inertial sensor holds the map, or contradicts it")
    elif together is None or not math.isfinite(together):
        reason = f"the observations do not determine the poses, or keyframes are more than {MAX_COVARIANCE_KEYFRAMES}"
        found = PlaneEvidence(state="dropped", reason=reason)
    else:
        # gtsam is not imported for a motion that is free
        from sfmapp.odometry.refinement.planar_adjustment import PlanarMap, hold_to_plane

        adjust = AdjustOptions(
            loss="cauchy", loss_scale_px=LOSS_SIGMAS * sigma, refine_focal=False, refine_distortion=False
        )
        answer = hold_to_plane(job.model, adjust, together, num_sensors)
        events.raise_if_cancelled()
        found = answer.evidence if isinstance(answer, PlanarMap) else answer
        if isinstance(answer, PlanarMap):
            job.model = answer.model
            take_over(job, keyframes)
            numbers = answer.adjustment
            events.decided(STAGE, f"closing adjustment on a ground plane: {numbers.text}", **numbers)
            final = replace(final, adjustment=numbers, noise_covariance=answer.pose_covariance)
    if found is None:
        return final
    events.decided(STAGE, f"ground plane {found.state}: {found.reason}", **found)
    return replace(final, report=replace(final.report, plane=found))


def _left_open(covariance: Array, size: float, events: Events) -> list[Contradiction]:
    """A contradiction where a refined calibration leaves the positions (K, 6, 6) open against the size of the map."""
    known = covariance[np.isfinite(covariance).all((1, 2)), 3:, 3:]
    share = math.sqrt(max(float(np.median(np.trace(known, axis1=1, axis2=2))), 0.0)) / size if len(known) else math.inf
    if share < _MAX_OPEN_SHARE:
        return []
    message = (
        "the images contradict the given calibration, and what they say instead is so unsure that positions are open "
        f"by {share:.0%} of the size of the map"
    )
    events.warned(STAGE, message)
    evidence = {"position_sigma_share": min(share, 1e6), "max_position_sigma_share": _MAX_OPEN_SHARE}
    return [Contradiction("given calibration", message, "calibrate the camera, or move and turn more", evidence)]


def _adjust_large_map(
    keyframes: KeyframeMap, options: OdometryOptions, events: Events, imu: Imu | None
) -> FinalAdjustment:
    """The same piece by piece, without covariances; the cameras are questioned on the newest keyframes alone."""
    num = len(keyframes.keyframes)
    part = np.arange(num - _NUM_QUESTIONED, num)
    job = make_job(keyframes, part, part > part[0])
    sigma = residual_scale_px(job.model, MIN_SIGMA_PX)
    cost = adjust_poses(job.model, sigma, _MAX_STEPS, _TOLERANCE, events=events)
    answer = _question(job.model, cost, sigma, options, events)
    if answer.is_refined:
        keyframes.rig = rig_of(answer.model)
        if answer.model.rig is not None:
            _rescale(keyframes, rigid3.spread(answer.model.cam_from_world) / rigid3.spread(job.model.cam_from_world))
    sweep(keyframes, options, events)
    plane = None
    if options.motion != "free":
        reason = f"the map has more than {MAX_COVARIANCE_KEYFRAMES} keyframes"
        plane = PlaneEvidence(state="dropped", reason=reason)
        events.decided(STAGE, f"ground plane dropped: {reason}")
    report = AdjustmentReport(camera=answer.report, is_piecewise=True, plane=plane)
    final = FinalAdjustment(None, "", report, answer.contradictions, answer.scale_sigma)
    return final if imu is None else _with_imu(final, keyframes, imu, (sigma, None), events)


def _question(
    model: Reconstruction,
    cost: float,
    sigma: float,
    options: OdometryOptions,
    events: Events,
    found_before: tuple[Reconstruction, float] | None = None,
) -> Answer:
    """Question the calibration of an adjusted map, and tell of what comes of it."""
    answer = question_calibration(model, cost, sigma, may_refine=options.refine_camera, found_before=found_before)
    if answer.is_refined and answer.scale_sigma is not None and answer.report.scale is not None:
        of_refinement = scale_sigma_of_refinement(model, answer.model) / answer.excess
        parts = replace(answer.report.scale, beyond_the_lens_model=of_refinement)
        answer = replace(
            answer, scale_sigma=math.hypot(answer.scale_sigma, of_refinement),
            report=replace(answer.report, scale=parts),
        )  # fmt: skip
    events.raise_if_cancelled()
    if answer.is_refined:
        message = "the images contradict the given calibration, which is refined"
        events.decided(STAGE, message, **answer.report)
    for contradiction in answer.contradictions:
        events.warned(STAGE, contradiction.message, subject=contradiction.subject)
    if answer.scale_sigma is not None and answer.scale_sigma > _SCALE_OPEN:
        events.warned(
            STAGE,
            f"the scale is known only to {answer.scale_sigma:.1%}: on so straight a path, or with points so far away, "
            "the images do not determine the focal lengths and the relative rotation of the cameras",
        )
    return answer


def _with_rig(model: Reconstruction, rig: Rig) -> Reconstruction:
    """The same map seen by other cameras, which sit elsewhere on the rig; to be adjusted."""
    out = model.copy()
    out.cameras = list(rig.cameras)
    if model.rig is not None:
        frames = model.rig.rig_from_world(model.cam_from_world)
        out.rig = replace(model.rig, cam_from_rig=rig.cam_from_rig)
        out.cam_from_world = out.rig.cam_from_world(np.arange(len(model.image_names)), frames[model.rig.frame_idx])
    return out


def rig_of(model: Reconstruction) -> Rig:
    """The cameras of a map's model, and where they sit."""
    return Rig(tuple(model.cameras), rigid3.IDENTITY[None] if model.rig is None else model.rig.cam_from_rig)


def _rescale(keyframes: KeyframeMap, scale: float) -> None:
    """Make a map larger, in place: a rig that is turned measures other lengths."""
    keyframes.point_xyz *= scale
    for keyframe in keyframes.keyframes:
        keyframe.rig_from_world[4:] *= scale
