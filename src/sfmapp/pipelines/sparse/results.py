"""The end of a run: models, report and manifest; and the beginning of one that finds everything done."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sfmapp.errors import NoReconstructionError
from sfmapp.geometry.orientation import MIRRORED
from sfmapp.pipelines.stored_pixels import STORED
from sfmapp.report.document import FORMAT, camera_rows, funnel_of_images, funnel_without_matches, make_checks
from sfmapp.report.html import render_html
from sfmapp.workspace.job import FAILED, NO_MODEL, NOT_WANTED, WRITTEN
from sfmapp.workspace.plain_json import report_text

if TYPE_CHECKING:
    from sfmapp.pipelines.sparse.keys import StageKeys
    from sfmapp.pipelines.sparse.run import Run
    from sfmapp.scene.reconstruction import Reconstruction

MODEL_FILES = ("cameras.bin", "images.bin", "points3D.bin")


def earlier_report(run: Run, keys: StageKeys) -> dict[str, Any] | None:
    """The report of an earlier run, if all that this run would write is there and still holds.

    Raises:
        NoReconstructionError: the earlier run ended so, and nothing has changed.
    """
    workspace = run.workspace
    report = workspace.read_json("report.json")
    if not workspace.is_current("mapping", keys.mapping) or not report or report.get("format") != FORMAT:
        return None
    has_recording = workspace.recording.is_file() or workspace.manifest.get("recording") in (NO_MODEL, FAILED)
    if (run.recorder is not None and not has_recording) or not (workspace.folder / "report.html").is_file():
        return None
    outcome = report["outcome"]
    if outcome["exit_code"] == NoReconstructionError.exit_code:
        raise NoReconstructionError(f"{outcome['message']} (as before: nothing has changed)", outcome["advice"])
    models = [workspace.model(idx) for idx in range(len(report["models"]))]
    if not all((model / name).is_file() for model in models for name in MODEL_FILES):
        return None
    report["run"] |= {"is_up_to_date": True, **run.watch.read()}
    return report


def write_results(
    run: Run, keys: StageKeys, models: Sequence[Reconstruction], failure: NoReconstructionError | None = None
) -> dict[str, Any]:
    """Write the models, the recording and the report, in this order; returns the report."""
    workspace, manifest = run.workspace, run.workspace.manifest
    if failure is not None and failure.report is not None:
        run.stages["mapping"] = failure.report
    keypoints = [features.keypoints[:, :2].astype(np.float64) for features in run.features]
    run.save_first(lambda: workspace.begin("mapping", keys.mapping, pixels=STORED))
    with run.stage("output"):
        run.save_first(lambda: workspace.write_models(models, keypoints))
    with run.stage("recording"):
        manifest["recording"] = _record(run, models)
    report = _make_report(run, models, failure)
    page = render_html(report, models[0] if models else None)
    run.save_first(lambda: workspace.write_text("report.html", page))
    report["run"] |= run.watch.read()  # the last measurement that can still be written down
    run.save_first(lambda: workspace.write_text("report.json", report_text(report)))
    workspace.finish("mapping", run.usage.get("mapping", {}))
    manifest["usage"] = run.usage
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
    outcome = write_recording(path, replay, threads=run.threads)
    if not outcome.problem:
        return WRITTEN
    path.unlink(missing_ok=True)
    run.events.raise_if_cancelled()  # a Ctrl-C in a terminal reaches the child as well
    run.events.warned("recording", f"no recording: {outcome.problem}")
    return FAILED


def _make_report(run: Run, models: Sequence[Reconstruction], failure: NoReconstructionError | None) -> dict[str, Any]:
    assert run.image_set is not None
    mapped = run.stages.get("mapping", {}).get("models") or []
    summaries = [
        model.summary() | {"contradictions": row["contradictions"], "apart": row["apart"]}
        for model, row in zip(models, mapped, strict=True)
    ]
    uncertainty = mapped[0]["uncertainty"] if mapped else {}
    images = _image_rows(run, failure)
    cameras = camera_rows(run.image_set, models[0] if models else None, uncertainty)
    return {
        "format": FORMAT,
        "outcome": {
            "exit_code": failure.exit_code if failure else 0,
            "message": str(failure) if failure else "",
            "advice": failure.advice if failure else None,
        },
        "run": run.facts(),
        "models": summaries,
        "checks": make_checks(summaries, images, cameras) if models else [],
        "images": images,
        "skipped": [{"name": name, "reason": reason} for name, reason in run.image_set.skipped],
        "cameras": cameras,
        "usage": run.usage,
        "warnings": run.log.warnings,
        "decisions": run.log.decisions,
        "stages": run.stages,
    }


def _image_rows(run: Run, failure: NoReconstructionError | None) -> list[dict[str, Any]]:
    assert run.image_set is not None
    names = [record.name for record in run.image_set.images]
    if run.correspondences is None:
        return funnel_without_matches(names, str(failure))
    mapping = run.stages.get("mapping") or {}
    rows = funnel_of_images(names, run.features, run.correspondences, mapping.get("images", []), run.options.mapping)
    is_mirrored = [record.orientation in MIRRORED for record in run.image_set.images]
    for row, is_mirror in zip(rows, is_mirrored, strict=True):
        if row.get("failed_at") == "pairs" and (not is_mirror) in is_mirrored:
            row["reason"] = "by EXIF's orientation it is stored as a mirror image of what others show, or they of it"
            row["remedy"] = "Write the mirrored files anew, upright: exiftran -ai, mogrify -auto-orient."
    return rows
