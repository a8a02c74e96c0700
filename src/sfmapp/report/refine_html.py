"""The report of a refinement as a page of HTML: before and after."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from sfmapp.images.sequence import GroundTruth
from sfmapp.odometry.result import OdometryResult
from sfmapp.report.document import check_contradictions
from sfmapp.report.model import PhotoReport, RefineReport
from sfmapp.report.odometry_document import GroundTruthFit
from sfmapp.report.odometry_html import trajectory_views
from sfmapp.report.page import adjustment_table, check_table, failure_box, log_table, render_page, table, usage_table
from sfmapp.reporting import NamedReason

REFINE_FORMAT = "sfmapp refine report 2"
_ROWS = (
    ("num_keyframes", "keyframes", "d"), ("num_points", "points", "d"), ("num_observations", "observations", "d"),
    ("mean_track_length", "track length, mean", ".2f"), ("mean_reprojection_error_px", "reprojection error, px", ".3f"),
    ("path_length", "path", ".4g"),
)  # fmt: skip


def render_refine_html(
    report: RefineReport,
    result: OdometryResult,
    ground_truth: GroundTruth | None,
    against: Sequence[GroundTruthFit | None],
) -> str:
    """The page of a report; ``result`` is the refined one, ``against`` each of its maps against the ground truth."""
    run = report.run
    facts = "; ".join([run.source, f"sfmapp {run.versions['sfmapp']}", run.started])
    body = [f'<p class="dim">{escape(facts)}</p>']
    found = check_contradictions(row for entry in report.maps.after for row in entry.contradictions)
    body += [failure_box(report.outcome), check_table(found), "<h2>Before and after</h2>" + _comparison(report)]
    body.append(trajectory_views(result, ground_truth, against, report.orientation))
    body.append(_photographs(report.photographs, report.skipped))
    body.append(adjustment_table((f"map {row.idx}", row.adjustment) for row in report.maps.after))
    body.append(usage_table(report.usage, run))
    body.append(log_table("Warnings", report.warnings) + log_table("Decisions", report.decisions))
    return render_page(f"sfmapp refine: {run.source}", body)


def _comparison(report: RefineReport) -> str:
    rows = []
    for before, after in zip(report.maps.before, report.maps.after, strict=True):
        for key, label, form in _ROWS:
            cells = [("", f"{entry[key]:{form}}") for entry in (before, after)]
            rows.append([("", before.idx), ("t", label), *cells])
    for off_before, off_after in zip(report.ground_truth.before, report.ground_truth.after, strict=False):
        cells = [("", f"{entry.ate_m.rmse:.4f}") for entry in (off_before, off_after)]
        label = f"off the ground truth, rmse m ({off_before.alignment.upper()})"
        rows.append([("", off_before.map), ("t", label), *cells])
    for k, pair in enumerate(zip(report.cameras.before, report.cameras.after, strict=False)):
        cells = [("w", " ".join([entry.model, *(f"{v:.6g}" for v in entry.params)])) for entry in pair]
        rows.append([("", ""), ("t", f"camera {k}"), *cells])
    return table([("", "map"), ("t", ""), ("", "before"), ("", "after")], rows)


def _photographs(photographs: Sequence[PhotoReport], skipped: Sequence[NamedReason]) -> str:
    if not photographs:
        return ""
    head = [("t", "photograph"), ("", "points seen"), ("", "agree with pose"), ("t", "")]
    rows = [
        [
            ("t green" if row.is_registered else "t red", row.name), ("", row.num_correspondences),
            ("", row.num_pose_inliers), ("w", row.reason),
        ]
        for row in photographs
    ]  # fmt: skip
    rows += [[("t red", row.name), ("", ""), ("", ""), ("w", row.reason)] for row in skipped]
    return "<h2>Photographs</h2>" + table(head, rows)
