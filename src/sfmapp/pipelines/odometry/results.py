"""What an odometry run writes: trajectories, frames, covariances, maps, recording and report."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sfmapp.camera.camera import Camera
from sfmapp.errors import InputError, InterruptedRunError, NoReconstructionError
from sfmapp.formats.colmap import read_model
from sfmapp.formats.trajectory import write_kitti, write_tum
from sfmapp.formats.trajectory_input import read_tum
from sfmapp.odometry.report import MapFacts
from sfmapp.odometry.result import FrameState, MapResult, OdometryResult
from sfmapp.pipelines.odometry.filtering import write_filtered_csv
from sfmapp.pipelines.odometry.live import live_counts, numbered
from sfmapp.pipelines.odometry.timing import frame_statistics
from sfmapp.report.document import named_params
from sfmapp.report.model import (
    CameraParams,
    GroundTruthReport,
    OdometryRunReport,
    Outcome,
    SequenceCamera,
    SequenceReport,
)
from sfmapp.report.odometry_document import (
    FORMAT,
    FrameTable,
    GroundTruthFit,
    errors_of_frames,
    fit_live_to_ground_truth,
    fit_to_ground_truth,
    frame_summary,
    ground_truth_row,
    make_checks,
    map_row,
)
from sfmapp.report.odometry_html import render_odometry_html
from sfmapp.reporting import document_text
from sfmapp.workspace.job import FAILED, NOT_WANTED, WRITTEN
from sfmapp.workspace.layout import MANIFEST, ODOMETRY, PAGE, REPORT
from sfmapp.workspace.manifest import read_manifest

if TYPE_CHECKING:
    from pathlib import Path

    from sfmapp.images import sequence as sequences
    from sfmapp.pipelines.odometry.tracking import Tracking
    from sfmapp.workspace.workspace import Workspace

_OUR_TRAJECTORY = re.compile(
    r"trajectory(_live)?(-\d+)?\.tum|trajectory_smooth\.tum|trajectory_filtered\.(tum|csv)|trajectory\.kitti(\.frames)?"
)
_AXES = ("rx", "ry", "rz", "tx", "ty", "tz")
FRAME_COLUMNS = ("index", "timestamp_s", "name", "state", "map", "tracked_points", "mapped_points", "tracking_ms")
COVARIANCE_COLUMNS = (
    "map", "index", "timestamp_s", "name", *(f"{a}_{b}" for i, a in enumerate(_AXES) for b in _AXES[i:])
)  # fmt: skip


def write_odometry(run: Tracking, result: OdometryResult, failure: NoReconstructionError | None) -> OdometryRunReport:
    """Write everything, the report last; returns it."""
    assert run.sequence is not None
    workspace, ground_truth = run.workspace, run.sequence.ground_truth
    facts = run.frames.facts(result)
    with run.measured("output"):
        # what matters most comes first, should the disk be full
        run.save_first(lambda: write_trajectories(workspace, result, facts))
        run.save_first(lambda: workspace.write_text("frames.csv", _frames_csv(result, facts)))
        models = [entry.reconstruction for entry in result.maps]
        run.save_first(lambda: workspace.write_models(models, events=run.events))
        run.save_first(lambda: workspace.write_text("covariance.csv", _covariance_csv(result)))
        run.save_first(lambda: workspace.write_text("frame_covariance.csv", _frame_covariance_csv(result)))
    against = (
        [fit_to_ground_truth(result, ground_truth, m) for m in range(len(result.maps))]
        if ground_truth is not None
        else []
    )
    with run.measured("recording"):
        _finish_recording(run, result, against)
    report = make_report(run, result, facts, against, failure)
    page = render_odometry_html(report, result, facts, ground_truth, against)
    run.save_first(lambda: workspace.write_text(PAGE, page))
    # the last measurement that can still be written down
    report = replace(report, run=replace(report.run, **run.watch.read()))
    run.save_first(lambda: workspace.write_text(REPORT, document_text(report)))
    workspace.note(usage=run.usage)
    workspace.finish(ODOMETRY, run.usage["odometry"], maps=[_map_facts(entry) for entry in result.maps])
    run.save_first(workspace.save)
    return report


def write_trajectories(workspace: Workspace, result: OdometryResult, facts: FrameTable | None = None) -> None:
    """A file of final poses for each map, and one of live poses; the largest map also as KITTI has it, smoothed and
    filtered.

    Maps have worlds of their own, so they cannot share a file. What an earlier run left is taken away.

    Args:
        facts: tell of the maps as they were when the live poses were given out; None: no live poses are written.
    """
    folder = workspace.folder
    files = {numbered("trajectory", m): poses_of_map(result, m) for m in range(len(result.maps))}
    if facts is not None:
        for place, live_map in enumerate(facts.live_maps()):
            mine = (facts.live_map == live_map)[:, None]
            files[numbered("trajectory_live", place)] = np.where(mine, result.live_cam_from_world, np.nan)
    if result.smoothed:
        files["trajectory_smooth.tum"] = result.smoothed[0].cam_from_world
    for path in folder.glob("trajectory*"):
        if _OUR_TRAJECTORY.fullmatch(path.name) and path.name not in files:
            path.unlink()
    for name, poses in files.items():
        write_tum(folder / name, result.timestamps_s, poses)
    if result.filtered is not None:
        write_tum(folder / "trajectory_filtered.tum", result.filtered.timestamps_s, result.filtered.cam_from_world)
        write_filtered_csv(folder / "trajectory_filtered.csv", result.filtered)
    if result.maps:
        write_kitti(folder / "trajectory.kitti", poses_of_map(result, 0), result.frame_idx)


def _map_facts(entry: MapResult) -> MapFacts:
    return MapFacts(scale_source=entry.scale_source, scale_sigma=entry.scale_sigma, contradictions=entry.contradictions)


def poses_of_map(result: OdometryResult, map_idx: int) -> Any:
    """(F, 7) final poses of the frames of one map, NaN for all others."""
    return np.where((result.frame_map == map_idx)[:, None], result.cam_from_world, np.nan)


def read_odometry(folder: Path) -> OdometryResult:
    """What :func:`write_odometry` has written of trajectories and maps; live poses and covariances are left out.

    Raises:
        InputError: a file is missing or is not what was written.
    """
    try:
        with (folder / "frames.csv").open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        frame_map = np.array([int(row["map"] or -1) for row in rows], np.int32)
        states = np.array([FrameState[row["state"].upper()] for row in rows], np.uint8)
        indices = np.array([int(row["index"]) for row in rows], np.int64)
        times = np.array([float(row["timestamp_s"]) for row in rows])
        names = [row["name"] for row in rows]
        known = read_manifest(folder, ODOMETRY).stage(ODOMETRY).maps
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{folder}: not the results of sfmapp odometry: {error}", "run it again") from error
    if known is None:
        raise InputError(f"{folder}: not the results of sfmapp odometry: {MANIFEST} tells of no maps", "run it again")
    poses = np.full((len(rows), 7), np.nan)
    maps = []
    position = {name: k for k, name in enumerate(names)}
    for m, row in enumerate(known):
        _, found = read_tum(folder / numbered("trajectory", m))
        if len(found) != (frame_map == m).sum():
            raise InputError(
                f"{folder}: frames.csv and the trajectory of map {m} disagree", "run sfmapp odometry again"
            )
        poses[frame_map == m] = found
        model, _ = read_model(folder / "sparse" / str(m))
        images = np.array([k for k, name in enumerate(model.image_names) if name in position], np.int64)
        frames = np.array([indices[position[model.image_names[k]]] for k in images], np.int64)
        order = np.argsort(frames, kind="stable")
        maps.append(MapResult(model, frames[order], images[order], **{**row, "contradictions": [*row.contradictions]}))
    return OdometryResult(indices, names, times, poses, np.full_like(poses, np.nan), frame_map, states, maps)


def _frames_csv(result: OdometryResult, facts: FrameTable) -> str:
    rows = []
    for k, name in enumerate(result.frame_names):
        counts = ["" if np.isnan(v) else int(v) for v in (facts.num_tracked[k], facts.num_mapped[k])]
        time_ms = "" if np.isnan(facts.time_ms[k]) else f"{facts.time_ms[k]:.3f}"
        state, map_idx = FrameState(int(result.frame_state[k])).name.lower(), int(result.frame_map[k])
        shown = map_idx if map_idx >= 0 else ""
        rows.append(
            [int(result.frame_idx[k]), repr(float(result.timestamps_s[k])), name, state, shown, *counts, time_ms]
        )
    return _csv(FRAME_COLUMNS, rows)


def _covariance_csv(result: OdometryResult) -> str:
    """The upper triangles of the keyframes' covariances; keyframes without one are left out."""
    position = {int(idx): k for k, idx in enumerate(result.frame_idx)}
    rows = []
    for m, entry in enumerate(result.maps):
        if entry.covariance is None:
            continue
        for frame_idx, covariance in zip(entry.keyframe_frame_idx.tolist(), entry.covariance, strict=True):
            if np.isfinite(covariance).all():
                rows.append(_covariance_row(result, m, position[frame_idx], covariance))
    return _csv(COVARIANCE_COLUMNS, rows)


def _frame_covariance_csv(result: OdometryResult) -> str:
    """The same of every frame's pose, in the gauge of its map."""
    rows = []
    if (covariances := result.covariance) is not None:
        known = np.flatnonzero(np.isfinite(covariances).all((1, 2)) & (result.frame_map >= 0))
        rows = [_covariance_row(result, int(result.frame_map[k]), int(k), covariances[k]) for k in known]
    return _csv(COVARIANCE_COLUMNS, rows)


def _covariance_row(result: OdometryResult, map_idx: int, k: int, covariance: Any) -> list[Any]:
    values = [f"{value:.9e}" for value in covariance[np.triu_indices(6)]]
    return [map_idx, int(result.frame_idx[k]), repr(float(result.timestamps_s[k])), result.frame_names[k], *values]


def _csv(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([head, *rows])
    return text.getvalue()


def _finish_recording(run: Tracking, result: OdometryResult, against: Sequence[GroundTruthFit | None]) -> None:
    """Let the recording show the end; a failure is a warning. A recording of other results is taken away."""
    workspace = run.workspace
    if run.live is None or not run.live.is_recording:
        workspace.recording.unlink(missing_ok=True)
        workspace.note(recording=NOT_WANTED)
    if run.live is None:
        return
    fits = [None if fit is None else fit.error.ground_truth_from_estimate for fit in against]
    problem = run.live.end(result, fits, errors_of_frames(result, against))
    if run.live.is_recording:
        workspace.note(recording=FAILED if problem else WRITTEN)
    if problem:
        run.workspace.recording.unlink(missing_ok=True)
        run.events.without_cancellation().warned("recording", f"no recording: {problem}")


def make_report(
    run: Tracking, result: OdometryResult, facts: FrameTable, against: Sequence[GroundTruthFit | None],
    failure: NoReconstructionError | None,
) -> OdometryRunReport:  # fmt: skip
    """The report as in ``report.json``."""
    assert run.sequence is not None
    frames = frame_summary(result)
    maps = [map_row(result, m) for m in range(len(result.maps))]
    known_map = None if result.report is None else result.report.known_map
    counts = live_counts(run.sequence)
    live = None if counts is None else run.latencies.report(counts)
    rate = run.sequence.frames_per_second if live is None else None  # what is live sets the pace itself
    timing = run.threads_cpu.timing(len(result.frame_idx), run.frames.tracking_s, rate, frame_statistics(facts.time_ms))
    return OdometryRunReport(
        format=FORMAT,
        outcome=_outcome(run, failure),
        run=run.facts(),
        sequence=describe_sequence(run.sequence, result),
        frames=frames,
        maps=maps,
        ground_truth=_ground_truth_rows(run, result, facts, against),
        timing=timing,
        live=live,
        checks=make_checks(frames, maps, live or timing, facts, known_map, run.stages.filter) if maps else [],
        usage=run.usage,
        warnings=run.log.warnings,
        decisions=run.log.decisions,
        stages=run.stages,
    )


def _outcome(run: Tracking, failure: NoReconstructionError | None) -> Outcome:
    if run.events.is_cancelled and live_counts(run.sequence) is None:  # that is how a live source ends
        message = "stopped on request: this is what was tracked until then"
        return Outcome(exit_code=InterruptedRunError.exit_code, message=message, advice="the same command begins again")
    return Outcome.of(failure)


def _ground_truth_rows(
    run: Tracking, result: OdometryResult, facts: FrameTable, against: Sequence[GroundTruthFit | None]
) -> list[GroundTruthReport]:
    """The error of each map, and of the live poses of the longest live map."""
    assert run.sequence is not None
    rows = [ground_truth_row(fit, m) for m, fit in enumerate(against) if fit is not None]
    if (
        run.sequence.ground_truth is not None
        and (live := fit_live_to_ground_truth(result, run.sequence.ground_truth, facts)) is not None
    ):
        rows.insert(1, ground_truth_row(live, 0, "live"))
    return rows


def describe_sequence(sequence: sequences.Sequence, result: OdometryResult) -> SequenceReport:
    """What was played, and how its cameras were changed in the end."""
    cameras = []
    for k, camera in enumerate(sequence.rig.cameras):
        given, refined = camera_params(camera), None
        if result.maps and (last := camera_params(result.maps[0].reconstruction.cameras[k])) != given:
            refined = last
        cameras.append(
            SequenceCamera(
                **given, width=camera.width, height=camera.height, focal_sigma_px=camera.focal_sigma,
                source=camera.focal_source, refined=refined,
            )
        )  # fmt: skip
    return SequenceReport(
        kind=sequence.kind,
        num_frames=sequence.num_frames,
        frames_per_second=sequence.frames_per_second,
        stereo=sequence.rig.is_stereo,
        imu=sequence.imu is not None,
        ground_truth=sequence.ground_truth is not None,
        orientation=sequence.orientation,
        cameras=cameras,
    )


def camera_params(camera: Camera) -> CameraParams:
    """Model and parameters of a camera."""
    return CameraParams(model=camera.model.name, params=named_params(camera))
