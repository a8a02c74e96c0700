"""The end of a run: models, report and manifest; and the beginning of one that finds everything done."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sfmapp.errors import NoReconstructionError
from sfmapp.formats.colmap import MODEL_FILES
from sfmapp.geometry.orientation import MIRRORED
from sfmapp.georeference.world_frame import GEOREFERENCE, write_georeference
from sfmapp.mapping.report import MappingReport, ModelEntry, Uncertainty
from sfmapp.pipelines.sparse.planned import held_against_plan
from sfmapp.pipelines.sparse.videos import strips
from sfmapp.pipelines.stored_pixels import STORED, noted_orientations
from sfmapp.report.document import (
    FORMAT,
    camera_rows,
    check_control,
    check_open_images,
    check_poses,
    funnel_of_images,
    funnel_without_matches,
    make_checks,
)
from sfmapp.report.html import render_html
from sfmapp.report.model import ImageReport, Outcome, ReconstructionReport
from sfmapp.reporting import NamedReason, document_text
from sfmapp.workspace.job import FAILED, NO_MODEL, NOT_WANTED, WRITTEN
from sfmapp.workspace.layout import PAGE, REPORT
from sfmapp.workspace.manifest import raise_as_before

if TYPE_CHECKING:
    from sfmapp.pipelines.sparse.keys import StageKeys
    from sfmapp.pipelines.sparse.run import Run
    from sfmapp.scene.reconstruction import Reconstruction


def earlier_report(run: Run, keys: StageKeys) -> ReconstructionReport | None:
    """The report of an earlier run, if all that this run would write is there and still holds.

    Raises:
        NoReconstructionError: the earlier run ended so, and nothing has changed.
    """
    workspace = run.workspace
    if not workspace.is_current("mapping", keys.mapping):
        return None
    has_recording = workspace.recording.is_file() or workspace.manifest.recording in (NO_MODEL, FAILED)
    if (run.recorder is not None and not has_recording) or not (workspace.folder / PAGE).is_file():
        return None
    entry = workspace.manifest.stage("mapping")
    raise_as_before(entry)
    models = [workspace.model(idx) for idx in range(entry.num_models or 0)]
    if not all((model / name).is_file() for model in models for name in MODEL_FILES):
        return None
    report = workspace.read_report(ReconstructionReport)
    if report is None:
        return None
    return replace(report, run=replace(report.run, is_up_to_date=True, **run.watch.read()))


def write_results(
    run: Run, keys: StageKeys, models: Sequence[Reconstruction], failure: NoReconstructionError | None = None
) -> ReconstructionReport:
    """Write the models, the recording and the report, in this order; returns the report."""
    workspace = run.workspace
    if failure is not None and isinstance(failure.report, MappingReport):
        run.stages = replace(run.stages, mapping=failure.report)
    keypoints = [features.keypoints[:, :2].astype(np.float64) for features in run.features]
    facts = {"pixels": STORED, "orientations": noted_orientations(run.image_set.images)} if run.image_set else {}
    run.save_first(lambda: workspace.begin("mapping", keys.mapping, **facts))
    with run.stage("output"):
        run.save_first(lambda: workspace.write_models(models, keypoints, run.events))
        if run.georeference is not None:
            write_georeference(workspace.folder, run.georeference)
        else:
            (workspace.folder / GEOREFERENCE).unlink(missing_ok=True)
    with run.stage("recording"):
        workspace.note(recording=_record(run, models))
    report = _make_report(run, models, failure)
    if run.added is not None:
        report = replace(report, added=run.added(models))
    plan = held_against_plan(keys, run.options, run.stages, run.usage, report.run)
    report = replace(report, merged=run.merged, plan=plan)
    page = render_html(report, models[0] if models else None, frames=strips(workspace.folder, run.stages.videos))
    run.save_first(lambda: workspace.write_text(PAGE, page))
    took = run.watch.read()  # the last measurement that can still be written down
    report = replace(report, run=replace(report.run, **took))
    run.save_first(lambda: workspace.write_text(REPORT, document_text(report)))
    outcome = Outcome.of(failure)
    workspace.finish("mapping", run.usage.get("mapping"), outcome=outcome, num_models=len(models), run=took)
    workspace.note(usage=run.usage)
    run.save_first(workspace.save)
    return report


def _record(run: Run, models: Sequence[Reconstruction]) -> str:
    """Write the recording, or take away one that shows other results; a failure is a warning. Returns its state."""
    path = run.workspace.recording
    if run.recorder is None or not models or run.image_set is None:
        path.unlink(missing_ok=True)
        return NO_MODEL if run.recorder is not None else NOT_WANTED
    from sfmapp.viewer.recording import write_recording
    from sfmapp.viewer.replay import make_replay

    seen = run.recorder
    replay = make_replay(
        run.image_set, run.features, models, seen.steps, seen.messages,
        title=os.path.basename(os.path.abspath(run.source)),
    )  # fmt: skip
    outcome = write_recording(path, replay, run.image_set.images, threads=run.threads, drawer=run.drawer)
    if not outcome.problem:
        return WRITTEN
    path.unlink(missing_ok=True)
    run.events.raise_if_cancelled()  # a Ctrl-C in a terminal reaches the child as well
    run.events.warned("recording", f"no recording: {outcome.problem}")
    return FAILED


def _make_report(
    run: Run, models: Sequence[Reconstruction], failure: NoReconstructionError | None
) -> ReconstructionReport:
    assert run.image_set is not None
    mapped = run.stages.mapping.models if run.stages.mapping is not None and models else []
    entries = [
        ModelEntry(**model.summary(), contradictions=row.contradictions, apart=row.apart)
        for model, row in zip(models, mapped, strict=True)
    ]
    images, poses = _image_rows(run, failure), run.stages.poses
    located = run.stages.georeference
    also = [*(poses.contradictions if poses else ()), *(located.contradictions if located else ())]
    cameras = camera_rows(
        run.image_set, models[0] if models else None, mapped[0].uncertainty if mapped else Uncertainty()
    )
    return ReconstructionReport(
        format=FORMAT,
        outcome=Outcome.of(failure),
        run=run.facts(),
        models=entries,
        checks=[
            *make_checks(entries, images, cameras, also),
            *check_open_images([row.uncertainty for row in mapped]),
            *check_control(run.stages.control),
            *check_poses(poses),
        ]
        if models
        else [],
        images=images,
        skipped=[NamedReason(name=name, reason=reason) for name, reason in run.image_set.skipped],
        cameras=cameras,
        usage=run.usage,
        warnings=run.log.warnings,
        decisions=run.log.decisions,
        stages=run.stages,
    )


def _image_rows(run: Run, failure: NoReconstructionError | None) -> list[ImageReport]:
    assert run.image_set is not None
    names = [record.name for record in run.image_set.images]
    if run.correspondences is None:
        return funnel_without_matches(names, str(failure))
    mapped = run.stages.mapping.images if run.stages.mapping is not None else []
    rows = funnel_of_images(names, run.features, run.correspondences, mapped, run.options.mapping)
    is_mirrored = [record.orientation in MIRRORED for record in run.image_set.images]
    return [
        _mirrored(row) if row.failed_at == "pairs" and (not is_mirror) in is_mirrored else row
        for row, is_mirror in zip(rows, is_mirrored, strict=True)
    ]


def _mirrored(row: ImageReport) -> ImageReport:
    """An image that has no pair, where others are stored as mirror images of it."""
    return replace(
        row,
        reason="by EXIF's orientation it is stored as a mirror image of what others show, or they of it",
        remedy="Write the mirrored files anew, upright: exiftran -ai, mogrify -auto-orient.",
    )
