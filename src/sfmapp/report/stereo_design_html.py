"""The page of ``sfmapp stereo-design``: tables, depth errors over depth, and rigs seen from above."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from sfmapp.report.page import render_page, table
from sfmapp.report.plots import Curve, plot_svg
from sfmapp.stereo.design import DesignReport, RigStudy, StereoDesign

Array = NDArray[np.float64]

_COLORS = ("#4a7fd4", "#d1372c", "#2a9d4a", "#e0a100", "#8c5bc7", "#7a7a7a")
_WIDTH, _HEIGHT = 460.0, 420.0


def design_page(report: DesignReport) -> str:
    """The page, self-contained."""
    return render_page("A stereo rig before it is built", _body(report))


def _body(report: DesignReport) -> Iterator[str]:
    yield (
        f"<p>Two cameras of {report.width} x {report.height} pixels, focal length {report.focal_px:.5g} px, field of "
        f"view {report.field_of_view_deg:.1f}&deg;. Largest errors: disparity {report.disparity_error_px:g} px, "
        f"baseline {report.baseline_error:g} {report.unit}, focal length {report.focal_error_px:g} px.</p>"
    )
    yield from _curves(report)
    yield '<h2>Seen from above</h2><div class="row large">'
    for rig in report.rigs:
        yield f"<figure>{_top_view(report, rig)}<figcaption>{_name(rig, report.unit)}</figcaption></figure>"
    yield (
        "</div><p class=dim>Shaded: seen by both. Bars: where a point on the middle line may come out, from the "
        "nearest to the farthest depth. Dashed: points of disparity 0.</p>"
    )
    for rig in report.rigs:
        yield f"<h2>{_name(rig, report.unit)[0].upper()}{_name(rig, report.unit)[1:]}</h2>" + _rig(report, rig)
    if report.wanted:
        yield "<h2>The baseline that an error needs</h2>" + _wanted(report)
    yield (
        "<p class=dim>Nearest and farthest are exact. The three terms are to first order, |f/d| of the baseline's "
        "error, |fB/d&sup2;| of the disparity's, |B/d| of the focal length's, and add up to the largest error. Points "
        "stand midway between the cameras.</p>"
    )


def _curves(report: DesignReport) -> Iterator[str]:
    nearest = min(rig.rows[0].depth for rig in report.rigs)
    farthest = max(rig.rows[-1].depth for rig in report.rigs)
    low, high = (nearest, farthest) if farthest > nearest else (0.5 * nearest, 1.5 * nearest)
    depths = np.linspace(low, high, 200)
    errors = []
    for n, rig in enumerate(report.rigs):
        design, color = _design(report, rig), _COLORS[n % len(_COLORS)]
        disparity = design.disparity(depths)
        far = design.depth(disparity - report.disparity_error_px) - depths
        percent = np.where(np.isfinite(far), 100.0 * far / depths, np.nan)
        # beyond its depth there is nothing to read off
        errors.append(Curve(_short(rig, report.unit), np.where(percent < 100.0, percent, np.nan), color))
    yield "<h2>Error of the far side, % of the depth</h2>" + plot_svg(depths, errors, (), f"depth {report.unit}")
    if any(rig.converging_deg for rig in report.rigs):
        yield "<p class=dim>Turned inwards or not, a baseline tells depth about equally well: curves may coincide.</p>"


def _rig(report: DesignReport, rig: RigStudy) -> str:
    rows, has_terms = [], bool(report.baseline_error or report.focal_error_px)
    for row in rig.rows:
        far = "infinity" if row.farthest is None else f"{row.farthest:.7g}"
        spread = None if row.spread is None else f"{row.spread:.6g}"
        texts = [
            f"{row.depth:g}", f"{row.disparity_px:.3f}", f"{row.nearest:.7g}", far, spread, f"{row.of_disparity:.4g}",
        ]  # fmt: skip
        if has_terms:
            texts += [f"{row.of_baseline:.4g}", f"{row.of_focal:.4g}", f"{row.total:.4g}"]
        texts.append(f"{row.common_share:.0%}")
        rows.append([("", text) for text in texts])
    unit = report.unit
    head = [
        f"depth {unit}", "disparity px", f"nearest {unit}", f"farthest {unit}", f"between {unit}",
        f"of disparity {unit}" if has_terms else f"error, first order {unit}",
        *([f"of baseline {unit}", f"of focal length {unit}", f"all three {unit}"] if has_terms else []), "in common",
    ]  # fmt: skip
    text = (
        f"<p>Both see points from {rig.least_depth:.4g} {unit}; from {rig.greatest_depth:.4g} {unit} on, a point may "
        "as well be at infinity."
    )
    if rig.fixation is not None:
        text += (
            f" The axes meet at {rig.fixation:.4g} {unit}; disparity is 0 on an upright cylinder of radius "
            f"{rig.zero_disparity_radius:.4g} {unit} through that point and both centres, negative beyond it."
        )
    if rig.farthest_common is not None:
        text += f" From {rig.farthest_common:.4g} {unit} on they see nothing in common."
    return text + "</p>" + table([("", name) for name in head], rows)


def _wanted(report: DesignReport) -> str:
    rows = [
        [
            ("", f"{one.depth:g} {report.unit}"), ("", f"{one.error:g} {report.unit}"),
            ("", f"{one.baseline:.4g} {report.unit}"), ("", f"{one.common_share:.0%}"),
        ]
        for one in report.wanted
    ]  # fmt: skip
    return table([("", "depth"), ("", "error wanted"), ("", "least baseline"), ("", "in common")], rows)


def _top_view(report: DesignReport, rig: RigStudy) -> str:
    """Both fields of view, what they share, intervals of depth and the circle of disparity 0."""
    design, top = _design(report, rig), 1.1 * rig.rows[-1].depth
    scale = _HEIGHT * 0.9 / top
    mid, ground = 0.5 * _WIDTH, 0.96 * _HEIGHT

    def at(x: float, z: float) -> str:
        return f"{mid + x * scale:.1f} {ground - z * scale:.1f}"

    half, view = math.radians(0.5 * rig.converging_deg), math.radians(design.half_view_deg)
    parts = []
    for side in (-1.0, 1.0):
        x = side * 0.5 * rig.baseline
        edges = [x + top * math.tan(-side * half + sign * view) for sign in (-1.0, 1.0)]
        parts.append(
            f'<path d="M{at(edges[0], top)}L{at(x, 0.0)}L{at(edges[1], top)}" fill="none" stroke="currentColor" '
            'stroke-opacity=".5"/>'
        )
        parts.append(f'<path d="M{at(x, 0.0)}m-5 6h10l-5 -9z" fill="currentColor"/>')
    depths = np.linspace(rig.least_depth, top, 60) if rig.least_depth < top else np.zeros(0)
    if len(depths):
        widths = 0.5 * design.common_width(depths)
        outline = [at(-w, z) for w, z in zip(widths, depths, strict=True)]
        outline += [at(w, z) for w, z in zip(widths[::-1], depths[::-1], strict=True)]
        parts.append(f'<path d="M{"L".join(outline)}z" fill="#4a7fd4" fill-opacity=".2"/>')
    if rig.zero_disparity_radius is not None:
        # the arc from centre to centre that runs through the place where the axes meet
        radius, is_large = rig.zero_disparity_radius * scale, int(rig.converging_deg < 90.0)
        ends = at(-0.5 * rig.baseline, 0.0), at(0.5 * rig.baseline, 0.0)
        arc = f"M{ends[0]}A{radius:.1f} {radius:.1f} 0 {is_large} 1 {ends[1]}"
        parts.append(f'<path d="{arc}" fill="none" stroke="#2a9d4a" stroke-width="2" stroke-dasharray="6 4"/>')
    for row in rig.rows:
        far = min(top, row.farthest if row.farthest is not None else top)
        parts.append(f'<path d="M{at(0.0, row.nearest)}L{at(0.0, far)}" stroke="#d1372c" stroke-width="3"/>')
        parts.append(f'<path d="M{at(0.0, row.depth)}m-7 0h14" stroke="#d1372c" stroke-width="2"/>')
    parts.append(f'<text x="8" y="18">up to {top:.3g} {report.unit}</text>')
    return f'<svg class="view" viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}" style="max-height:none">{"".join(parts)}</svg>'


def _design(report: DesignReport, rig: RigStudy) -> StereoDesign:
    """The rig, with lengths in the unit of the report."""
    return StereoDesign(
        report.focal_px, report.width, report.height, rig.baseline, rig.converging_deg, report.disparity_error_px
    )


def _name(rig: RigStudy, unit: str) -> str:
    axes = f"axes converging by {rig.converging_deg:.3g}&deg;" if rig.converging_deg else "parallel axes"
    return f"baseline {rig.baseline:g} {unit}, {axes}"


def _short(rig: RigStudy, unit: str) -> str:
    return f"{rig.baseline:g} {unit}" + (f", {rig.converging_deg:.3g}°" if rig.converging_deg else "")
