"""The report of a reconstruction as a page of HTML."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

from sfmapp.report.added_html import added_section
from sfmapp.report.control_html import control_section, poses_section, units_section
from sfmapp.report.dense_html import dense_section
from sfmapp.report.model import CameraReport, ImageReport, ReconstructionReport
from sfmapp.report.page import adjustment_table, check_table, failure_box, log_table, render_page, table, usage_table
from sfmapp.report.parts_html import parts_section
from sfmapp.report.plan import PlanCheck
from sfmapp.report.top_view import top_view_svg
from sfmapp.report.video_html import videos_section
from sfmapp.report.world_map import world_section
from sfmapp.reporting import NamedReason

if TYPE_CHECKING:
    from sfmapp.report.dense_pictures import PictureRow
    from sfmapp.scene.reconstruction import Reconstruction

FUNNEL = (
    ("features", "features"),
    ("candidate_pairs", "pairs tried"),
    ("verified_pairs", "pairs verified"),
    ("putative_matches", "matches"),
    ("verified_matches", "verified"),
    ("correspondences_2d3d", "points seen"),
    ("pose_inliers", "agree with pose"),
    ("observations", "observations"),
)

# of pairs that a model was to start from: more tell nothing new
_MAX_STARTS = 12


def _starts(report: ReconstructionReport) -> str:
    """The pairs that models were to start from, each with the command that tells its story: a page takes seconds, so
    that none is made before somebody asks."""
    text = (
        '<p class="dim">Two photographs step by step, and why a model would or would not begin with them; OUT is the '
        "folder of this page: <code>sfmapp pair OUT IMAGE IMAGE</code>.</p>"
    )
    mapping = report.stages.mapping
    tried = [pair for start in mapping.initial_pairs for pair in start.pairs] if mapping is not None else []
    rows = [
        [
            ("t", " and ".join(pair.images)), ("", pair.num_points), ("", f"{pair.median_angle_deg:.1f}"),
            ("w", pair.reason or "a model begins with it"),
            ("w", f"sfmapp pair OUT {' '.join(shlex.quote(name) for name in pair.images)}"),
        ]
        for pair in tried[:_MAX_STARTS]
    ]  # fmt: skip
    head = [("t", "to begin with"), ("", "points"), ("", "angle, degrees"), ("t", ""), ("t", "its story")]
    return text + (table(head, rows) if rows else "")


def render_html(
    report: ReconstructionReport, model: Reconstruction | None, dense_pictures: Sequence[PictureRow] = (),
    frames: Mapping[str, str] | None = None,
) -> str:  # fmt: skip
    """The page of a report.

    Args:
        report: of the run.
        model: the largest model, for a view from above.
        dense_pictures: of the patches. frames: URLs of small pictures of frames of videos, by name.
    """
    body = [_headline(report), failure_box(report.outcome), check_table(report.checks)]
    if model is not None:
        note = "Points and cameras of the largest model; each triangle opens where its camera looks."
        new = len(report.added.photographs) if report.added is not None else 0
        view = top_view_svg(model, _orientation(report, model), new=new)
        body.append(f'<h2>From above</h2>{view}<p class="dim">{note}</p>')
    if report.stages.videos:
        body.append(videos_section(report.stages.videos, frames or {}))
    if report.added is not None:
        body.append(added_section(report.added))
    if report.merged is not None and not report.outcome.exit_code:
        body.append(f"<h2>Merged</h2><p>{escape(report.merged.text)}.</p>")
    placed = report.stages.georeference
    if placed is not None:
        is_in_world = any(one.model == 0 and not one.reason for one in placed.models)
        body.append(world_section(placed, model if is_in_world else None))
    if report.stages.control is not None:
        body.append(control_section(report.stages.control, model))
    if report.stages.poses is not None:
        body.append(poses_section(report.stages.poses))
    if report.stages.units is not None:
        body.append(units_section(report.stages.units))
    if report.dense is not None:
        body.append(dense_section(report.dense, dense_pictures))
    body.append(_failed(report.images) + _skipped(report.skipped))
    body.append("<h2>Images</h2>" + _images(report.images) + _starts(report))
    body.append("<h2>Cameras</h2>" + _cameras(report.cameras))
    if report.stages.mapping is not None:
        body.append(parts_section(report.stages.mapping.parts))
        entries = enumerate(report.stages.mapping.models)
        body.append(adjustment_table((f"model {m}", model.adjustment) for m, model in entries))
    body.append(usage_table(report.usage, report.run))
    if report.plan is not None:
        body.append(_planned(report.plan))
    body.append(log_table("Warnings", report.warnings) + log_table("Decisions", report.decisions))
    return render_page(f"sfmapp: {report.run.source}", body)


def _planned(plan: PlanCheck) -> str:
    """What ``sfmapp plan`` had said of the run."""
    rows = [
        [
            ("t", row.stage), ("t", f"{row.quantity}, {row.unit}"), ("", row.planned.text("")),
            ("" if row.is_within else "amber", f"{row.took:.2f}" if row.took < 100 else f"{row.took:.0f}"),
        ]
        for row in plan.rows
    ]  # fmt: skip
    head = [("t", "stage"), ("t", ""), ("", "planned"), ("", "taken")]
    return f"<h2>Planned and taken</h2><p>{escape(plan.sentence[:1].upper() + plan.sentence[1:])}</p>" + table(
        head, rows
    )


def _orientation(report: ReconstructionReport, model: Reconstruction) -> list[int]:
    """EXIF orientation of the images of a model."""
    read = report.stages.images
    known = {image.name: image.orientation for image in read.images} if read is not None else {}
    return [known.get(name, 1) for name in model.image_names]


def _headline(report: ReconstructionReport) -> str:
    run = report.run
    parts = []
    if report.models:
        model = report.models[0]
        parts.append(f"{model.num_registered} of {model.num_images} images registered")
        parts.append(f"{model.num_points} points")
        parts.append(f"{model.mean_reprojection_error_px:.2f} px")
    parts += [f"{run.wall_s:.1f} s", f"seed {run.seed}", f"sfmapp {run.versions['sfmapp']}", run.started]
    return f'<p class="dim">{escape("; ".join(parts))}</p>'


def _images(images: Iterable[ImageReport]) -> str:
    head = [("t", "image"), ("", "model"), *(("", label) for _, label in FUNNEL)]
    rows = []
    for image in images:
        light = "green" if image.is_registered else "red"
        counts = [("", image.funnel[key]) for key, _ in FUNNEL]
        rows.append([(f"t {light}", image.name), ("", image.model), *counts])
    return table(head, rows)


def _failed(images: Iterable[ImageReport]) -> str:
    rows = [
        [("t red", image.name), ("t", image.failed_at), ("w", image.reason), ("w", image.remedy)]
        for image in images
        if not image.is_registered
    ]
    if not rows:
        return ""
    head = [("t", "image"), ("t", "failed at"), ("t", "why"), ("t", "what helps")]
    return "<h2>Images in no model</h2>" + table(head, rows)


def _skipped(skipped: Sequence[NamedReason]) -> str:
    if not skipped:
        return ""
    rows = [[("t red", entry.name), ("w", entry.reason)] for entry in skipped]
    return "<h2>Files that could not be used</h2>" + table([("t", "file"), ("t", "reason")], rows)


def _cameras(cameras: Iterable[CameraReport]) -> str:
    head = [("", "camera"), ("t", "model"), ("", "size"), ("", "images"), ("t", "focal prior"), ("t", "parameters")]
    rows = []
    for camera in cameras:
        refined: Mapping[str, float] = camera.refined or {}
        texts = []
        for name, value in camera.initial.items():
            text = f"{name} {value:.5g}"
            if name in refined and refined[name] != value:
                text += f" \N{RIGHTWARDS ARROW} {refined[name]:.5g}"
            if name in camera.sigma:
                text += f" \N{PLUS-MINUS SIGN} {camera.sigma[name]:.2g}"
            texts.append(text)
        sigma = camera.focal_sigma_px
        prior = camera.focal_source + (f" \N{PLUS-MINUS SIGN} {sigma:.0f} px" if sigma else "")
        size = f"{camera.width} x {camera.height}"
        cells = [("", camera.idx), ("t", camera.model), ("", size), ("", camera.num_images)]
        rows.append([*cells, ("t", prior + (", fixed" if camera.is_fixed else "")), ("w", ", ".join(texts))])
    return table(head, rows)
