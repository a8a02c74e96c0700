"""The report of an odometry run as a page of HTML."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from sfmapp.geometry import rigid3, similarity
from sfmapp.images.sequence import GroundTruth
from sfmapp.odometry.report import BeliefReport, FilterReport, KnownMapReport
from sfmapp.odometry.result import OdometryResult
from sfmapp.report.model import (
    Gap,
    GroundTruthReport,
    LiveReport,
    LogLine,
    MapReport,
    OdometryRunReport,
    OdometryStages,
    SequenceCamera,
    SequenceReport,
    TimingReport,
)
from sfmapp.report.odometry_document import FrameTable, GroundTruthFit, errors_of_frames, unit_of
from sfmapp.report.page import adjustment_table, check_table, failure_box, log_table, render_page, table, usage_table
from sfmapp.report.path_view import GROUND_TRUTH_COLOR, PATH_COLOR, PathScene, legend, path_view_svg
from sfmapp.report.plots import Curve, plot_svg

MAX_VIEWS = 4
MAX_GAPS = 50
_ORANGE, _GREY = "#e07b00", "#999"
# Places of a known map that are named.
_MAX_PLACES = 4


def render_odometry_html(
    report: OdometryRunReport, result: OdometryResult | None, facts: FrameTable | None,
    ground_truth: GroundTruth | None,
    against: Sequence[GroundTruthFit | None],
) -> str:  # fmt: skip
    """The page of a report; ``against``: each map against the ground truth, empty without one."""
    body = [_headline(report), failure_box(report.outcome), check_table(report.checks)]
    if result is not None and facts is not None and len(result.frame_idx):
        body.append(trajectory_views(result, ground_truth, against, report.sequence.orientation))
        body.append("<h2>Frame by frame</h2>" + _plots(result, facts, against))
        body.append(_gaps(report.frames.gaps))
    body.append(_maps(report.maps) + _ground_truth(report.ground_truth))
    if report.stages.odometry is not None and report.stages.odometry.known_map is not None:
        body.append(_known_map(report.stages.odometry.known_map))
    num_open = 0 if report.stages.odometry is None else report.stages.odometry.loops_open
    body.append(_loops(report.decisions, num_open) + _sequence(report.sequence, report.stages))
    body.append(adjustment_table((f"map {row.idx}", row.adjustment) for row in report.maps))
    body.append(
        _live(report.live)
        + _filter(report.stages.filter)
        + _timing(report.timing)
        + usage_table(report.usage, report.run)
    )
    body.append(log_table("Warnings", report.warnings) + log_table("Decisions", report.decisions))
    return render_page(f"sfmapp odometry: {report.run.source}", body)


def _headline(report: OdometryRunReport) -> str:
    run, frames, parts = report.run, report.frames, list[str]()
    if frames:
        parts.append(f"{frames.num_with_pose} of {frames.num_frames} frames with a pose")
        if frames.repeated:
            parts.append(f"{frames.repeated} of them repeat the one before, whose pose they have")
    if report.maps:
        first = report.maps[0]
        parts.append(f"path {first.path_length:.4g} {first.unit or '(unit arbitrary)'}")
        parts.append(f"{first.num_keyframes} keyframes")
        parts.append(f"{first.num_points} points")
    if timing := report.timing:
        parts.append(f"{timing.cpu_ms_per_frame:.1f} CPU ms a frame")
        parts.append(f"{timing.frames_per_second:.1f} frames a second")
    parts += [f"seed {run.seed}", f"sfmapp {run.versions['sfmapp']}", run.started]
    return f'<p class="dim">{escape("; ".join(parts))}</p>'


def trajectory_views(
    result: OdometryResult, ground_truth: GroundTruth | None, against: Sequence[GroundTruthFit | None], orientation: int
) -> str:
    """Each map from above; those that the ground truth joins share its frame but not one picture. ``orientation``:
    EXIF's."""
    parts = []
    for map_idx in range(min(len(result.maps), MAX_VIEWS)):
        fit = against[map_idx] if against else None
        unit = unit_of(result.maps[map_idx])
        svg = path_view_svg(_scene(result, map_idx, ground_truth, fit, "m" if fit else unit), orientation)
        entries = [(PATH_COLOR, "trajectory, keyframes as dots")]
        if fit:
            entries.append(
                (GROUND_TRUTH_COLOR, f"ground truth; the trajectory is laid on it ({fit.alignment.upper()})")
            )
        title = "From above" + (f", map {map_idx}" if len(result.maps) > 1 else "")
        parts.append(f"<h2>{title}</h2>{svg}{legend(entries)}")
    if len(result.maps) > MAX_VIEWS:
        parts.append(f"<p class=dim>{len(result.maps) - MAX_VIEWS} smaller maps are not drawn</p>")
    return "".join(parts)


def _scene(
    result: OdometryResult, map_idx: int, ground_truth: GroundTruth | None, fit: GroundTruthFit | None, unit: str
) -> PathScene:  # fmt: skip
    entry = result.maps[map_idx]
    model = entry.reconstruction
    mine = result.frame_map == map_idx
    first, last = np.flatnonzero(mine)[[0, -1]]
    poses = np.where(mine[:, None], result.cam_from_world, np.nan)[first : last + 1]
    keyframes = model.cam_from_world[entry.keyframe_image_idx]
    points = model.point_xyz[model.is_triangulated]
    centers = np.zeros((0, 3))
    if fit is not None and ground_truth is not None:
        to_ground_truth = fit.error.ground_truth_from_estimate
        poses, keyframes = (
            similarity.transform_poses(to_ground_truth, poses),
            similarity.transform_poses(to_ground_truth, keyframes),
        )
        points = similarity.apply(to_ground_truth, points)
        during = slice(int(fit.pairs.ground_truth_idx[0]), int(fit.pairs.ground_truth_idx[-1]) + 1)
        centers = rigid3.center(ground_truth.cam_from_world[during])
    return PathScene(poses, keyframes, points, centers, unit)


def _plots(result: OdometryResult, facts: FrameTable, against: Sequence[GroundTruthFit | None]) -> str:
    x = result.frame_idx.astype(np.float64)
    has_pose = np.isfinite(result.cam_from_world[:, 0])
    edges = np.diff(np.concatenate([[0], (~has_pose).astype(np.int8), [0]]))
    spans = zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1, strict=True)
    gaps = [(float(x[first]), float(x[last])) for first, last in spans]
    parts = [
        "<h3>Points</h3>",
        plot_svg(
            x,
            [Curve("tracked", facts.num_tracked, _GREY), Curve("measured with", facts.num_mapped, PATH_COLOR)],
            gaps,
            "frame",
        ),
        "<h3>CPU time of tracking, ms</h3>",
        plot_svg(x, [Curve("tracking", facts.time_ms, _ORANGE)], gaps, "frame"),
    ]
    if any(against):
        error = errors_of_frames(result, against)
        parts += [
            "<h3>Distance from the ground truth, m</h3>",
            plot_svg(x, [Curve("final", error, GROUND_TRUTH_COLOR)], gaps, "frame"),
        ]
    return "".join(parts)


def _gaps(gaps: Sequence[Gap]) -> str:
    if not gaps:
        return ""
    head = [
        ("", "from frame"),
        ("", "to frame"),
        ("", "frames"),
        ("", "seconds"),
        ("", "map before"),
        ("", "map after"),
    ]
    keys = ("first_frame", "last_frame", "num_frames", "duration_s", "map_before", "map_after")
    rows = [[("", f"{row[k]:.2f}" if k == "duration_s" else row[k]) for k in keys] for row in gaps[:MAX_GAPS]]
    return "<h2>Gaps: frames without a pose</h2>" + table(head, rows) + _more(len(gaps))


def _maps(maps: Iterable[MapReport]) -> str:
    head = [
        ("", "map"), ("", "frames"), ("", "from"), ("", "to"), ("", "keyframes"), ("", "points"), ("", "error px"),
        ("", "path"), ("t", "unit of length"),
    ]  # fmt: skip
    sure = [
        ("", "map"), ("", "position"), ("", "at most"), ("", "rotation deg"), ("", "at most"), ("t", "held fixed"),
    ]  # fmt: skip
    rows, sigmas = [], []
    for row in maps:
        unit, position, rotation = row.unit, row.position_sigma, row.rotation_sigma_deg
        rows.append(
            [
                ("", row.idx), ("", row.num_frames), ("", row.first_frame), ("", row.last_frame),
                ("", row.num_keyframes), ("", row.num_points), ("", f"{row.mean_reprojection_error_px:.2f}"),
                ("", f"{row.path_length:.4g} {unit}".rstrip()), ("t", scale_text(row)),
            ]
        )  # fmt: skip
        if position and rotation:
            texts = [f"{position.median:.2g} {unit}", f"{position.max:.2g} {unit}"]
            texts += [f"{rotation.median:.2g}", f"{rotation.max:.2g}"]
            sigmas.append([("", row.idx), *(("", text) for text in texts), ("w dim", row.gauge)])
    if not rows:
        return ""
    more = "<h3>Standard deviation of the keyframes (median)</h3>" + table(sure, sigmas) if sigmas else ""
    return "<h2>Maps</h2>" + table(head, rows) + more


def scale_text(row: MapReport) -> str:
    """Where a map's unit of length comes from, and how sure it is."""
    if row.scale_source == "none":
        return "arbitrary"
    sigma = row.scale_sigma
    text = f"metres, from {row.scale_source.replace('_', ' ')}"
    return f"{text}, \N{PLUS-MINUS SIGN}{100 * sigma:.2g} %" if sigma else text


def _ground_truth(rows: Sequence[GroundTruthReport]) -> str:
    if not rows:
        return ""
    head = [
        ("", "map"), ("t", "poses"), ("t", "alignment"), ("", "frames"), ("", "true path m"), ("", "rmse m"),
        ("", "% of path"), ("", "mean"), ("", "median"), ("", "worst"), ("", "rotation rmse deg"), ("", "scale"),
    ]  # fmt: skip
    cells = []
    for row in rows:
        ate, path = row.ate_m, row.true_path_m
        share = f"{100 * ate.rmse / path:.2f}" if path else "-"
        cells.append(
            [
                ("", row.map), ("t", row.poses), ("t", row.alignment.upper()), ("", row.num_pairs),
                ("", f"{path:.1f}"), ("", f"{ate.rmse:.3f}"), ("", share),
                ("", f"{ate.mean:.3f}"), ("", f"{ate.median:.3f}"), ("", f"{ate.max:.3f}"),
                ("", f"{row.rotation_deg.rmse:.3f}"), ("", f"{row.scale:.4g}"),
            ]
        )  # fmt: skip
    return "<h2>Against the ground truth</h2>" + table(head, cells)


def known_map_text(row: KnownMapReport) -> str:
    """What a known map has to do with the sequence, in one sentence."""
    if not row.is_found:
        return f"no frame was found in {row.source}"
    text = f"{row.num_localised} frames localised in {row.source}, {row.num_new} mapped anew beside it"
    if row.num_elsewhere:
        text += f", {row.num_elsewhere} in a map of their own"
    if row.position_sigmas is None or row.rotation_sigmas is None:
        return f"{text}; too few keyframes hang together to say whether both agree"
    return (
        f"{text}; positions by its landmarks and by the sequence alone differ by {row.position_sigmas:.1f} standard "
        f"deviations, rotations by {row.rotation_sigmas:.1f} (rms)"
    )


def _known_map(row: KnownMapReport) -> str:
    places = f"It has {row.num_keyframes} keyframes or photographs, {row.num_places} with a picture to know it by."
    told = f"<p>{escape(belief_text(row.belief))}</p>" if row.belief.num_looks else ""
    return f"<h2>Known map</h2><p>{escape(known_map_text(row))}.</p>{told}<p class=dim>{escape(places)}</p>"


def belief_text(row: BeliefReport) -> str:
    """How a camera was found in a known map, or where it might be, in sentences."""
    looked = f"{row.num_looks} frames were held against its places, with up to {row.max_particles} particles"
    if row.num_looks_to_decision is not None:
        after = f"a place was believed after {row.num_looks_to_decision}"
        several = f"; {row.num_open} times several places fitted, and none was believed" if row.num_open else ""
        return f"{looked}: {after} (all else together below {row.max_doubt:g}){several}."
    if not row.places:
        return f"{looked}: none of them fits."
    named = [f"{name} ({probability:.2g})" for name, probability in zip(row.places, row.probabilities, strict=True)]
    shown = ", ".join(named[:_MAX_PLACES]) + (
        f" and {len(named) - _MAX_PLACES} more" if len(named) > _MAX_PLACES else ""
    )
    return f"{looked}: undecided. It may be near {shown}, or in none of its places ({row.not_in_map:.2g})."


def _loops(decisions: Iterable[LogLine], num_open: int) -> str:
    """The decisions that laid one part of a map on another, and how many loops were left open."""
    head = [
        ("", "frame"), ("t", "what"), ("", "to frame"), ("", "shift, depths of the scene"), ("", "turn deg"),
        ("", "scale"), ("", "inliers"), ("", "rms px"),
    ]  # fmt: skip
    rows = []
    for line in decisions:
        data: Mapping[str, Any] = line.data or {}
        if "shift_in_depths" in data:
            numbers = [f"{data['shift_in_depths']:.3g}", f"{data['rotation_deg']:.2f}", f"{data['scale']:.4f}"]
            inliers = ", ".join(map(str, np.atleast_1d(data["num_inliers"])))
            old = int(data["old_frame_idx"])
            texts = [str(old) if old >= 0 else "the known map", *numbers, inliers, f"{data['rms_px']:.2f}"]
            rows.append([("", data["frame_idx"]), ("t", line.message), *(("", text) for text in texts)])
    text = f"<p>{num_open} more seen and left open: what they show may be elsewhere as well.</p>" if num_open else ""
    return "<h2>Loops and joined maps</h2>" + (table(head, rows) if rows else "") + text if rows or num_open else ""


def _sequence(sequence: SequenceReport, stages: OdometryStages) -> str:
    rows = [[("t", key.replace("_", " ")), ("w", _short(value))] for key, value in sequence.items() if key != "cameras"]
    if (calibration := stages.self_calibration) is not None:
        rows.append([("t", "calibrated with the first minute"), ("w", calibration.text)])
    head = [("", "camera"), ("t", "model"), ("", "size"), ("t", "parameters"), ("t", "refined in the end")]
    cameras = [
        [
            ("", k), ("t", camera.model), ("", f"{camera.width} x {camera.height}"),
            ("w", ", ".join(f"{name} {value:.6g}" for name, value in camera.params.items())), ("w", refined(camera)),
        ]
        for k, camera in enumerate(sequence.cameras)
    ]  # fmt: skip
    return "<h2>Sequence</h2>" + table([("t", ""), ("t", "")], rows) + (table(head, cameras) if cameras else "")


def refined(camera: SequenceCamera) -> str:
    """Model and parameters that the last adjustment changed a camera to, in words."""
    if (found := camera.refined) is None:
        return ""
    return f"{found.model}: " + ", ".join(f"{name} {value:.6g}" for name, value in found.params.items())


def live_text(live: LiveReport) -> str:
    """What became of the frames of a live source, and how old their poses were, in a sentence or two."""
    text = f"{live.num_arrived} frames came, {live.num_dropped} of them were dropped because newer ones were there"
    if (latency := live.latency_ms) is not None:
        text += (
            f"; a pose was known {latency.median:.0f} ms after its frame had come (median; 95 %: {latency.p95:.0f} ms, "
            f"at most {latency.max:.0f} ms)"
        )
    return f"{text}; {live.end}" if live.end else text


def _live(live: LiveReport | None) -> str:
    if live is None:
        return ""
    note = (
        f"At most {live.max_waiting} frames wait. The longest time without a frame was {live.longest_silence_s:.2f} s."
    )
    return f"<h2>Live</h2><p>{escape(live_text(live))}.</p><p class=dim>{note}</p>"


def _filter(found: FilterReport | None) -> str:
    """What the filter made of live poses, what it did not believe, and over what it went by motion alone."""
    if found is None:
        return ""
    text = (
        f"{found.num_poses} poses at {found.rate_hz:.4g} Hz, predicted by {found.prediction.replace('imu', 'the IMU')} "
        f"and corrected by {found.num_used} measured poses."
        + ("" if found.reason is None else f" Not by the IMU: {found.reason}.")
    )
    facts = [("t", "what"), ("", "found"), ("t", "expected")]
    body = f"<h2>Filtered live poses</h2><p>{escape(text)}</p>" + table(facts, _filter_facts(found))
    if found.rejected:
        rows = [[("t", row.name), ("", f"{row.timestamp_s:.2f}"), ("w", row.reason)] for row in found.rejected]
        head = [("t", "frame left out"), ("", "at, s"), ("t", "why")]
        body += table(head, rows[:MAX_GAPS]) + _more(len(rows))
    if found.gaps:
        rows = [
            [("", f"{gap.first_s:.2f}"), ("", f"{gap.last_s:.2f}"), ("", f"{gap.position_sigma:.3g}"),
             ("", f"{gap.rotation_sigma_deg:.2f}")] for gap in found.gaps
        ]  # fmt: skip
        head = [("", "gap: last pose, s"), ("", "until, s"), ("", "position sigma"), ("", "rotation sigma, deg")]
        body += table(head, rows[:MAX_GAPS]) + _more(len(rows))
    return body


def _more(num: int) -> str:
    return f"<p class=dim>{num - MAX_GAPS} more in report.json</p>" if num > MAX_GAPS else ""


def _filter_facts(found: FilterReport) -> list[list[tuple[str, str]]]:
    """Innovations beside what they should be, and how late rows are."""
    rows = []
    if told := found.consistency:
        rows += [
            [("t", f"squared innovations of {told.num_innovations} poses, over what they should be"),
             ("", f"{told.mean:.2f}"),
             ("w", f"{told.correlated_low:.2f} to {told.correlated_high:.2f} in 95 % of runs, of the "
                   f"{told.num_independent:.0f} independent ones that they are worth; {told.mean_low:.2f} to "
                   f"{told.mean_high:.2f} if all were")],
            [("t", "of them inside the 95 % interval of one"), ("", f"{100 * told.share_inside:.0f} %"), ("w", "95 %")],
        ]  # fmt: skip
        if told.correlation is not None:
            limit = f"within {told.max_correlation:.2f} of 0 if the filter knew all that lasts"
            rows.append([("t", "correlation with the frame before"), ("", f"{told.correlation:.2f}"), ("w", limit)])
    ms = f"{found.latency_ms_median:.2g} / {found.latency_ms_p95:.2g} / {found.latency_ms_max:.3g}"
    rows.append([("t", "delay of a row, ms: median / 95 % / most"), ("", ms), ("w", "")])
    return rows


def _timing(timing: TimingReport | None) -> str:
    if not timing:
        return ""
    rows = [[("t", part.replace("_", " ")), ("", f"{value:.1f}")] for part, value in timing.parts_cpu_ms.items()]
    rows.append([("t", "all"), ("", f"{timing.cpu_ms_per_frame:.1f}")])
    note = (
        f"{timing.num_frames} frames in {timing.wall_s:.1f} s, {timing.frames_per_second:.1f} a second. "
        "Compiling kernels and drawing the recording are not counted."
    )
    return "<h2>Time of a frame</h2>" + table([("t", "part"), ("", "CPU ms")], rows) + f"<p class=dim>{note}</p>"


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.5g}"
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return str(value)
