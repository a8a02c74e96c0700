"""Ground control in the report: a table of points left out in turn, and a map with their residuals as arrows."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from sfmapp.georeference.control.report import ControlledModel, ControlPointRow, ControlReport, UnitsReport
from sfmapp.georeference.poses.report import PosesReport
from sfmapp.report.page import table
from sfmapp.report.top_view import HEIGHT, WIDTH, fit_page
from sfmapp.report.world_map import nice_length, scale_bar
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

# The longest arrow of a map, as a share of its width.
_LONGEST = 0.12
_ABOUT = (
    "Each control point was left out in turn: how far the adjustment without its coordinates puts it from where they "
    "do, and the standard deviation that this should have, by the marks, the other points and its own survey. 95 % of "
    "the horizontal lengths are below 2.45 of what is expected, 95 % of the heights below 1.96. Metres."
)


def control_section(report: ControlReport, model: Reconstruction | None) -> str:
    """What control points said of each model.

    Args:
        model: the largest, for a map; None for none.
    """
    parts = ["<h2>Ground control</h2>", f'<p class="dim">{escape(report.path)}, {escape(report.crs)}</p>']
    for row in report.models:
        title = f"<h3>Model {row.model}</h3>" if len(report.models) > 1 else ""
        reason = f"<p>Not brought to ground control: {escape(row.reason)}.</p>" if row.reason else ""
        findings = "".join(f"<li>{escape(text)}</li>" for text in row.findings)
        parts.append(title + reason + (f"<ul>{findings}</ul>" if findings else ""))
        if not row.reason:
            parts.append(f'<p class="dim">{_ABOUT}</p>' + _points(row.points))
            if row.model == 0 and model is not None:
                parts.append(_map(row, model))
    return "".join(parts)


def units_section(report: UnitsReport) -> str:
    """Metres by known lengths, each left out in turn, and what told the vertical."""
    lines = []
    for scale in report.scales:
        text = f"not in metres: {scale.reason}"
        if scale.sigma_share is not None:
            text = f"metres by known lengths, to {100 * scale.sigma_share:.2g} %"
        lines += [f"model {scale.model}: {text}", *scale.findings]
    for level in report.levels:
        told = level.reason or f"level by {level.source}, within {level.sigma_deg:.2g} degrees"
        lines.append(f"model {level.model}: {told}")
    rows = [
        [
            ("t green" if bar.is_used else "t red", bar.name), ("", f"{bar.metres:g}"), ("", f"{bar.sigma_m:.2g}"),
            ("", f"{bar.model_m:.4f}"), ("", None if bar.left_out_m is None else f"{bar.left_out_m:+.4f}"),
            ("", None if bar.left_out_sigma_m is None else f"{bar.left_out_sigma_m:.4f}"),
        ]
        for scale in report.scales
        for bar in scale.bars
    ]  # fmt: skip
    head = [("t", "known length"), ("", "m"), ("", "sigma"), ("", "in the model"), ("", "left out"), ("", "expected")]
    texts = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f"<h2>Metres and up</h2><ul>{texts}</ul>" + (table(head, rows) if rows else "")


def poses_section(report: PosesReport) -> str:
    """Known poses beside those of the models."""
    lines = []
    for model in report.models:
        text = f"not in the frame of known poses: {model.reason}"
        if model.sigma is not None and model.sigma_deg is not None:
            how = "held" if report.is_fixed else "leaned on"
            text = (
                f"{model.num_used} of {model.num_known} known poses {how}; good to {model.sigma:.2g} along each axis "
                f"and {model.sigma_deg:.2g} degrees about each"
            )
        lines.append(f"model {model.model}: {text}")
        if model.positions is not None:
            lines.append(f"model {model.model}: {model.positions.sentence}")
    wrong = {str(name) for found in report.contradictions for name in _names(found.evidence.get("images"))}
    rows = [
        [
            ("t green" if image.is_used and image.name not in wrong else "t red", image.name),
            *(("", None if value is None else f"{value:.3g}") for value in (image.off, image.off_deg, image.sigmas)),
            ("w", image.reason),
        ]
        for image in report.images
    ]
    head = [("t", "photograph"), ("", "off"), ("", "degrees"), ("", "sigmas"), ("t", "")]
    texts = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f'<h2>Known poses</h2><p class="dim">{escape(report.path)}</p><ul>{texts}</ul>' + table(head, rows)


def _names(value: object) -> Sequence[object]:
    return value if isinstance(value, list) else ()


def _points(points: Sequence[ControlPointRow]) -> str:
    head = [
        ("t", "point"), ("t", "role"), ("", "marks"), ("", "left out: east"), ("", "north"), ("", "up"),
        ("", "expected: east"), ("", "north"), ("", "up"), ("", "horizontal / expected"), ("", "height / expected"),
        ("", "taking part: east"), ("", "north"), ("", "up"), ("t", ""),
    ]  # fmt: skip
    lights = {"control": "green", "refuted": "red", "unplaced": "amber"}
    rows = [
        [
            ("t " + lights[point.role], point.name), ("t", point.role), ("", point.num_marks),
            *_metres(point.left_out_m), *_metres(point.left_out_sigma_m),
            ("", _ratio(point.normalized_horizontal)), ("", _ratio(point.normalized_vertical)),
            *_metres(point.residual_m), ("w", point.reason),
        ]
        for point in points
    ]  # fmt: skip
    return table(head, rows)


def _metres(values: tuple[float, float, float] | None) -> list[tuple[str, str | None]]:
    return [("", None if values is None else f"{value:.3f}") for value in values or (0.0, 0.0, 0.0)]


def _ratio(value: float | None) -> str | None:
    return None if value is None else f"{value:.2f}"


def _map(row: ControlledModel, model: Reconstruction) -> str:
    """North is up; horizontal residuals are arrows, those of heights bars beside, both by one scale that is said."""
    shown = [point for point in row.points if point.left_out_m is not None]
    if not shown:
        return ""
    centers = model.centers[model.is_registered][:, :2]
    places = np.array([point.xyz_m[:2] for point in row.points])
    scale, offset = fit_page(places, np.concatenate([centers, places]))
    residual = np.array([point.left_out_m for point in shown])
    longest = max(float(np.linalg.norm(residual[:, :2], axis=1).max()), float(np.abs(residual[:, 2]).max()), 1e-9)
    # a round number of times the size of the ground
    exaggeration = nice_length(_LONGEST * WIDTH / (longest * scale[0]))
    parts = [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2" fill="#8888"/>' for x, y in centers * scale + offset]
    for point in row.points:
        x, y = np.array(point.xyz_m[:2]) * scale + offset
        color = {"control": "#2a9d4a", "refuted": "#d1372c", "unplaced": "#e0a100"}[point.role]
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="none" stroke="{color}" stroke-width="2"/>')
        parts.append(f'<text x="{x + 8:.1f}" y="{y - 8:.1f}">{escape(point.name)}</text>')
        if point.left_out_m is not None:
            east, north, up = exaggeration * scale[0] * np.array(point.left_out_m)
            parts.append(_arrow(x, y, east, -north, color))
            parts.append(_bar(x - 9, y, -up, color))
    parts.append(scale_bar(float(scale[0])))
    note = (
        f"Control points and their residuals when left out, drawn {exaggeration:g} times as long as the ground: arrows "
        "horizontally, bars beside them in height (up the page: the others put the point higher). Dots are cameras."
    )
    view = f'<svg class="view" viewBox="0 0 {WIDTH:.0f} {HEIGHT:.0f}">{"".join(parts)}</svg>'
    return f'{view}<p class="dim">{note}</p>'


def _arrow(x: float, y: float, dx: float, dy: float, color: str) -> str:
    length = max(float(np.hypot(dx, dy)), 1e-9)
    tip = np.array([x + dx, y + dy])
    back, side = np.array([dx, dy]) / length * min(8.0, length), np.array([-dy, dx]) / length * min(4.0, length / 2)
    (ax, ay), (bx, by) = tip - back + side, tip - back - side
    style = f'stroke="{color}" stroke-width="2" fill="{color}"'
    line = f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{tip[0]:.1f}" y2="{tip[1]:.1f}" {style}/>'
    return line + f'<polygon points="{tip[0]:.1f},{tip[1]:.1f} {ax:.1f},{ay:.1f} {bx:.1f},{by:.1f}" {style}/>'


def _bar(x: float, y: float, dy: float, color: str) -> str:
    return f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{x:.1f}" y2="{y + dy:.1f}" stroke="{color}" stroke-width="4"/>'
