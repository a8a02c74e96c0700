"""An odometry map refined offline, as the reconstruction that it is: adjusted whole, and photographs added.

:func:`refine` opens the workspaces and sees to it that every end is a clean one.
"""

from __future__ import annotations

import os
from collections.abc import Sequence as Rows
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.graph import FactorGraph
from sfmapp.adjust.options import AdjustOptions, AdjustReport
from sfmapp.errors import InputError, NoReconstructionError
from sfmapp.events import Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.images.sequence import Sequence
from sfmapp.mapping import structure
from sfmapp.mapping.options import MappingOptions
from sfmapp.mapping.settling import Round, adjust_until_settled, round_options
from sfmapp.odometry.result import MapResult, OdometryResult
from sfmapp.pipelines.odometry.add_photos import PhotoResult, add_photos
from sfmapp.pipelines.odometry.results import read_odometry, write_trajectories
from sfmapp.report.model import (
    CamerasBeforeAfter,
    GroundTruthBeforeAfter,
    GroundTruthReport,
    MapReport,
    MapsBeforeAfter,
    Outcome,
    RefinedCamera,
    RefineReport,
)
from sfmapp.report.odometry_document import GroundTruthFit, fit_to_ground_truth, ground_truth_row, map_row
from sfmapp.report.refine_html import REFINE_FORMAT, render_refine_html
from sfmapp.reporting import NamedReason, document_text
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.sequences.open import open_sequence
from sfmapp.workspace.job import Job
from sfmapp.workspace.kernels import kernels_compiling
from sfmapp.workspace.layout import ODOMETRY, PAGE, REFINE
from sfmapp.workspace.manifest import Manifest, read_manifest
from sfmapp.workspace.options import Options, options_from_dict
from sfmapp.workspace.usage import Stopwatch

Array = NDArray[np.float64]

STAGE = "refinement"
FOLDER = "refined"
# How far a calibration may be off that is freed: as in the last adjustment of odometry.
_FOCAL_SIGMA = 0.01
# Residuals are not believed to be better than that, however well a synthetic sequence fits.
_MIN_SIGMA_PX = 0.02
# Nor is an observation refused for less than half a pixel.
_MIN_LIMIT_PX = 0.5


class RefineResult(NamedTuple):
    """The refined maps and trajectory, and the report of it as in ``report.json``."""

    odometry: OdometryResult
    report: RefineReport


def refine(
    output: str | os.PathLike[str],
    refined: str | os.PathLike[str] | None = None,
    options: Options | None = None,
    *,
    photos: str | os.PathLike[str] | None = None,
    free_intrinsics: bool = False,
    events: Events | None = None,
    watch: Stopwatch | None = None,
) -> RefineResult:
    """Adjust the maps of an odometry run whole, reject what does not fit, and move the frames with their keyframes.

    Args:
        output: workspace of an odometry run; it is not changed.
        refined: folder of the results; None: ``OUT/refined``.
        options: of all stages; mapping and adjust count here, and with photographs images, features and matching.
        photos: photographs to add to the largest map: a folder, a glob or a list.
        free_intrinsics: refine the calibration of the sequence as well.
        events: listens in, and can ask the run to stop.
        watch: started earlier, if more is to be counted in the report than this call.

    Raises:
        UsageError: ``refined`` holds something else.
        InputError: ``output`` is no workspace, or the photographs or, with them, the sequence cannot be read.
        NoReconstructionError: there is no map in it.
        InterruptedRunError: ``events`` was asked to stop.
    """
    source = Path(output)
    manifest = read_manifest(source, ODOMETRY)
    before = read_odometry(source)
    if not before.maps:
        raise NoReconstructionError(f"{source} holds no map to refine", "run sfmapp odometry first")
    target = refined or source / FOLDER
    with Job.opened(REFINE, source, target, options, events=events, watch=watch) as job:
        job.note_inputs({})
        job.until_end.enter_context(kernels_compiling(job.events, job.usage))
        pool = job.until_end.enter_context(ThreadPoolExecutor(job.threads))
        sequence = _open_sequence(manifest, job, required=photos is not None)
        after, added = _refined(job, before, sequence, photos, free_intrinsics, pool)
        return RefineResult(after, _write(job, before, after, sequence, added))


def _open_sequence(manifest: Manifest, job: Job, *, required: bool) -> Sequence | None:
    """The sequence of the run, for its ground truth and its images; None if it is gone and only the ground truth was
    wanted."""
    wanted = options_from_dict({"sequence": manifest.options.get("sequence", {})}).sequence
    try:
        return open_sequence(manifest.source, wanted, job.events, require_camera=False)
    except InputError as error:
        if required:
            raise
        job.events.warned(STAGE, f"the sequence and its ground truth are gone: {error}")
        return None


def _refined(
    job: Job, before: OdometryResult, sequence: Sequence | None, photos: str | os.PathLike[str] | None,
    free_intrinsics: bool, pool: Executor,
) -> tuple[OdometryResult, PhotoResult | None]:  # fmt: skip
    """All maps refined, the largest with photographs in it."""
    options = job.options
    maps, adjustments = [], list[AdjustReport | None]()
    with job.stage("adjustment"):
        job.events.started(STAGE, "adjusting maps", total=len(before.maps))
        for entry in before.maps:
            mapping = lenient(options.mapping, entry.reconstruction)
            model, report = adjusted(entry.reconstruction, mapping, options.adjust, free_intrinsics, pool, job.events)
            maps.append(model)
            adjustments.append(report)
            job.events.advanced(STAGE)
        job.events.finished(STAGE)
    added = None
    if photos is not None:
        assert sequence is not None
        with job.stage("photographs"):
            # what the map was adjusted to stays: the photographs must not bend a calibration that was not to be freed
            map_with_photos, added = add_photos(
                maps[0], before, sequence, os.fspath(photos),
                replace(options, mapping=lenient(options.mapping, maps[0])), threads=job.threads, pool=pool,
                events=job.events,
            )  # fmt: skip
            maps[0], adjustments[0] = map_with_photos, added.adjustment
    entries = [
        in_previous_gauge(replace(entry, adjustment=report), model)
        for entry, report, model in zip(before.maps, adjustments, maps, strict=True)
    ]
    return moved_frames(before, entries), added


def lenient(options: MappingOptions, model: Reconstruction) -> MappingOptions:
    """Points of neighbouring frames are seen under small angles; with a rig, whose baseline is known, smaller ones."""
    least = 0.2 if model.rig is not None else 1.0
    return replace(options, min_triangulation_angle_deg=min(options.min_triangulation_angle_deg, least))


def adjusted(
    model: Reconstruction, mapping: MappingOptions, adjust: AdjustOptions, free_intrinsics: bool, pool: Executor,
    events: Events,
) -> tuple[Reconstruction, AdjustReport]:  # fmt: skip
    """A copy, adjusted and filtered in turn until its observations settle, and the last adjustment."""
    model = model.copy()
    model.cameras = [replace(camera, is_fixed=not free_intrinsics) for camera in model.cameras]
    priors = [replace(camera, focal_sigma=_FOCAL_SIGMA * camera.focal) for camera in model.cameras]

    def adjust_once(num_steps: int) -> Round:
        before = model.obs_is_inlier.copy()
        chosen = round_options(adjust.robust(sigma_px), num_steps)
        report = FactorGraph(model, chosen, prior_cameras=priors, noise_px=1.0).optimize(events)
        events.decided(STAGE, f"closing adjustment: {report.text}", **report)
        limit_px = mapping.max_reprojection_error_sigmas * structure.residual_scale_px(model, _MIN_SIGMA_PX)
        limit_px = float(np.clip(limit_px, _MIN_LIMIT_PX, mapping.max_reprojection_error_px))
        structure.filter_observations(model, mapping, pool, None, limit_px)
        structure.triangulate(model, np.flatnonzero(~model.is_triangulated), mapping, pool, limit_px)
        made = Round(report, before, model.obs_is_inlier.copy())
        summary = model.summary()
        text = f"{summary.num_points} points, {summary.mean_reprojection_error_px:.3f} px"
        events.decided(
            STAGE, f"adjusted: {made.num_changed} observations became inliers or outliers; {text}", **summary
        )
        events.raise_if_cancelled()
        return made

    sigma_px = structure.residual_scale_px(model, _MIN_SIGMA_PX)
    return model, adjust_until_settled(adjust_once, STAGE, events)


def in_previous_gauge(entry: MapResult, model: Reconstruction) -> MapResult:
    """The refined map where the old one lay: an adjustment leaves place and, with one camera, size open.

    Metres that came from outside stay what they were on average; a rig knows its own.
    """
    old = entry.reconstruction.cam_from_world[entry.keyframe_image_idx]
    new = model.cam_from_world[entry.keyframe_image_idx]
    known = np.isfinite(new[:, 0])
    try:
        old_from_new = similarity.align_poses(new[known], old[known]).b_from_a
    except ValueError:  # all in one place
        return replace(entry, reconstruction=model, covariance=None, gauge="")
    if model.rig is not None:
        rotation = rigid3.rotation_matrix(old_from_new)
        shift = rigid3.center(old[known]).mean(0) - rotation @ rigid3.center(new[known]).mean(0)
        old_from_new = similarity.from_parts(rotation, shift, 1.0)
    model.cam_from_world[model.is_registered] = similarity.transform_poses(
        old_from_new, model.cam_from_world[model.is_registered]
    )
    model.point_xyz = similarity.apply(old_from_new, model.point_xyz)
    return replace(entry, reconstruction=model, covariance=None, gauge="")


def moved_frames(before: OdometryResult, entries: list[MapResult]) -> OdometryResult:
    """The trajectory with new maps: each frame moves as its two neighbouring keyframes do, by its distance in time."""
    poses = before.cam_from_world.copy()
    for m, (old, new) in enumerate(zip(before.maps, entries, strict=True)):
        was = old.reconstruction.cam_from_world[old.keyframe_image_idx]
        now = new.reconstruction.cam_from_world[new.keyframe_image_idx]
        kept = np.flatnonzero(np.isfinite(now[:, 0]))
        if not len(kept):
            continue
        mine = np.flatnonzero(before.frame_map == m)
        times = before.timestamps_s[np.searchsorted(before.frame_idx, old.keyframe_frame_idx[kept])]
        after = np.clip(np.searchsorted(times, before.timestamps_s[mine]), 0, len(kept) - 1)
        ahead = np.maximum(after - 1, 0)
        span = times[after] - times[ahead]
        weight = np.where(span > 0, (before.timestamps_s[mine] - times[ahead]) / np.where(span > 0, span, 1.0), 1.0)
        moved = [
            rigid3.compose(rigid3.compose(poses[mine], rigid3.inverse(was[kept[k]])), now[kept[k]])
            for k in (ahead, after)
        ]
        poses[mine] = rigid3.interpolate(moved[0], moved[1], np.clip(weight, 0.0, 1.0))
    poses = poses[before.twin_rows]
    return replace(before, cam_from_world=poses, live_cam_from_world=before.live_cam_from_world, maps=entries)


def _write(
    job: Job, before: OdometryResult, after: OdometryResult, sequence: Sequence | None, added: PhotoResult | None
) -> RefineReport:
    """Models, trajectories and the report, which is returned."""
    workspace, ground_truth = job.workspace, sequence.ground_truth if sequence is not None else None
    with job.measured("output"):
        workspace.write_models([entry.reconstruction for entry in after.maps], events=job.events)
        write_trajectories(workspace, after)
    fits = {
        name: [fit_to_ground_truth(result, ground_truth, m) for m in range(len(result.maps))]
        if ground_truth is not None
        else []
        for name, result in (("before", before), ("after", after))
    }
    report = RefineReport(
        format=REFINE_FORMAT,
        outcome=Outcome.of(None),
        run=job.facts(),
        maps=MapsBeforeAfter(before=_map_rows(before), after=_map_rows(after)),
        cameras=CamerasBeforeAfter(before=_cameras(before), after=_cameras(after)),
        ground_truth=GroundTruthBeforeAfter(**{name: _errors(found) for name, found in fits.items()}),
        orientation=sequence.orientation if sequence is not None else 1,
        photographs=added.rows if added is not None else [],
        skipped=[
            NamedReason(name=name, reason=reason) for name, reason in (added.skipped if added is not None else ())
        ],
        usage=job.usage,
        warnings=job.log.warnings,
        decisions=job.log.decisions,
    )
    workspace.write_text(PAGE, render_refine_html(report, after, ground_truth, fits["after"]))
    workspace.write_text("report.json", document_text(report))
    workspace.note(usage=job.usage)
    workspace.save()
    return report


def _map_rows(result: OdometryResult) -> list[MapReport]:
    return [map_row(result, m) for m in range(len(result.maps))]


def _cameras(result: OdometryResult) -> list[RefinedCamera]:
    cameras = result.maps[0].reconstruction.cameras
    return [RefinedCamera(model=camera.model.name, params=camera.params.tolist()) for camera in cameras]


def _errors(fits: Rows[GroundTruthFit | None]) -> list[GroundTruthReport]:
    return [ground_truth_row(fit, m) for m, fit in enumerate(fits) if fit is not None]
