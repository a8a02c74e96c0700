"""The report of a rig as a page of HTML."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from sfmapp.calibration.rig import PairCalibration, RigCalibration
from sfmapp.calibration.rig_file import epipolar_map
from sfmapp.camera.camera import Camera
from sfmapp.geometry import rigid3
from sfmapp.report.model import CalibrateRigReport
from sfmapp.report.page import render_page, table

# cells of the map of epipolar errors, and the width of its picture
_CELLS, _WIDTH = (12, 8), 480.0


def render_rig_html(report: CalibrateRigReport, found: RigCalibration) -> str:
    """The page of a report; ``found`` is the rig that it is of."""
    rig, run = report.rig, report.run
    facts = "; ".join([*(one.source for one in rig.photographs), f"sfmapp {run.versions['sfmapp']}", run.started])
    body = [
        f'<p class="dim">{escape(facts)}</p>',
        f"<p>{escape(rig.shots)}; boards {escape(', '.join(rig.boards))}</p>",
    ]
    body += [f'<p class="amber">{escape(warning)}</p>' for warning in rig.result.warnings]
    body += [_from_above(found), _pairs(report), *_maps(found), *_cameras(report, found), _photographs(report)]
    body.append(_correlations(report))
    return render_page(f"sfmapp calibrate rig: {len(rig.cameras)} cameras", body)


def _pairs(report: CalibrateRigReport) -> str:
    head = [("t", "cameras"), ("", "apart, mm"), ("", "sigma"), ("", "turn, deg"), ("", "sigma"), ("", "x, y, z, mm"),
            ("", "sigmas"), ("", "points in common"), ("", "epipolar rms, px"), ("t", "")]  # fmt: skip
    rows = []
    for pair in report.rig.result.pairs:
        sigmas = np.sqrt(np.maximum(np.diag(np.array(pair.covariance)), 0.0))
        error = None if pair.epipolar_rms_px is None else f"{pair.epipolar_rms_px:.3f}"
        rows.append([
            ("t", f"{pair.first}, {pair.second}"), ("", f"{1e3 * pair.baseline_m:.3f}"),
            ("", f"{1e3 * pair.baseline_sigma_m:.2g}"), ("", f"{pair.turn_deg:.4f}"),
            ("", f"{pair.turn_sigma_deg:.2g}"),
            ("", ", ".join(f"{1e3 * v:.3f}" for v in pair.second_from_first[4:])),
            ("", ", ".join(f"{1e3 * v:.2g}" for v in sigmas[3:])), ("", pair.num_points), ("", error),
            ("t", "joined by motion" if pair.by_motion else ""),
        ])  # fmt: skip
    note = "Shifts are those of points of the first camera into the second; sigmas of turns are roots of the trace."
    matrices = ""
    for pair in report.rig.result.pairs:
        lines = [f"E of {pair.first}, {pair.second}: " + _matrix(pair.essential)]
        lines += [] if pair.fundamental is None else ["F: " + _matrix(pair.fundamental)]
        matrices += "".join(f"<p>{escape(line)}</p>" for line in lines)
    more = f"<details><summary>E and F, x2^T F x1 = 0, of unit norm</summary>{matrices}</details>"
    return f'<h2>Pairs</h2>{table(head, rows)}<p class="dim">{note}</p>{more}'


def _matrix(rows: Sequence[Sequence[float]]) -> str:
    return "; ".join(" ".join(f"{v:.6g}" for v in row) for row in rows)


def _maps(found: RigCalibration) -> list[str]:
    """Epipolar errors over the first picture of each pair that has points in common."""
    pictures = [
        f"<figure>{_map(pair, found.rig.cameras[pair.first])}<figcaption>"
        f"{escape(found.names[pair.first])}, {escape(found.names[pair.second])}: rms {pair.epipolar_rms_px:.3f} px"
        "</figcaption></figure>"
        for pair in found.pairs if len(pair.epipolar_px)
    ]  # fmt: skip
    if not pictures:
        return []
    note = "Sampson errors, pixels, rms by place in the first picture; a lens that its model does not fit shows here."
    return ["<h2>Epipolar errors over the picture</h2>", f'<p class="dim">{note}</p>',
            f'<div class="row large">{"".join(pictures)}</div>']  # fmt: skip


def _map(pair: PairCalibration, camera: Camera) -> str:
    cells = epipolar_map(pair, (camera.width, camera.height), _CELLS)
    height = _WIDTH * camera.height / camera.width
    w, h = _WIDTH / _CELLS[0], height / _CELLS[1]
    most = max(float(np.nanmax(cells)) if np.isfinite(cells).any() else 1.0, 1e-12)
    parts = []
    for r, row in enumerate(cells):
        for c, value in enumerate(row):
            if np.isfinite(value):
                place = f'x="{c * w:.1f}" y="{r * h:.1f}" width="{w:.1f}" height="{h:.1f}"'
                parts.append(f'<rect {place} fill="#4a7fd4" fill-opacity="{0.1 + 0.9 * value / most:.2f}"/>')
                middle = f'x="{(c + 0.5) * w:.1f}" y="{(r + 0.5) * h + 4:.1f}" text-anchor="middle"'
                parts.append(f"<text {middle}>{value:.2f}</text>")
    return f'<svg class="plot" viewBox="0 0 {_WIDTH:g} {height:.0f}">{"".join(parts)}</svg>'


def _from_above(found: RigCalibration) -> str:
    """The cameras of the rig from above: x to the right, z up, each with its view."""
    centers = rigid3.center(found.rig.cam_from_rig)[:, [0, 2]]
    axes = rigid3.rotation_matrix(found.rig.cam_from_rig)[:, 2][:, [0, 2]]
    size = max(float(np.ptp(centers, axis=0).max()), 1e-6)
    low, high = centers.min(0) - 0.4 * size, centers.max(0) + 0.4 * size
    scale = _WIDTH / float((high - low)[0])
    parts = []
    for name, center, axis in zip(found.names, centers, axes, strict=True):
        x, y = (center[0] - low[0]) * scale, (high[1] - center[1]) * scale
        side = np.array([-axis[1], axis[0]]) * 0.5
        corners = [(axis + s * side) * 0.25 * size * scale for s in (-1.0, 1.0)]
        points = " ".join(f"{px:.1f},{py:.1f}" for px, py in [(x, y), *((x + d[0], y - d[1]) for d in corners)])
        parts.append(f'<polygon points="{points}" fill="#4a7fd444" stroke="#4a7fd4"/>')
        parts.append(f'<text x="{x + 6:.1f}" y="{y + 16:.1f}">{escape(name)}</text>')
    height = float((high - low)[1]) * scale
    picture = f'<svg class="plot" viewBox="0 0 {_WIDTH:g} {height:.0f}">{"".join(parts)}</svg>'
    return f'<h2>The rig from above</h2><figure style="max-width:30rem">{picture}</figure>'


def _cameras(report: CalibrateRigReport, found: RigCalibration) -> list[str]:
    body = ["<h2>Cameras</h2>"]
    for section, photos, made in zip(report.rig.cameras, report.rig.photographs, found.cameras, strict=True):
        text = f"{section.name}: {section.model}, {section.width}x{section.height}, rms {section.rms_px:.3f} px, "
        body.append(f"<h3>{escape(text + photos.intrinsics)}</h3>")
        rows = [
            [("t", name), ("", f"{value:.8g}"), ("", "held" if sigma == 0 else f"{sigma:.2g}")]
            for name, value, sigma in zip(made.param_names, section.params, section.sigmas, strict=True)
        ]
        body.append(table([("t", "parameter"), ("", "value"), ("", "sigma")], rows))
    return body


def _photographs(report: CalibrateRigReport) -> str:
    head = [("t", "camera"), ("t", "photograph"), ("", "points"), ("", "used"), ("", "rms, px"), ("t", "")]
    rows = []
    for one in report.rig.photographs:
        for picture in one.pictures:
            rms = None if picture.rms_px is None else f"{picture.rms_px:.3f}"
            rows.append([
                ("t", one.name), ("t", picture.name), ("", picture.num_points), ("", picture.num_used), ("", rms),
                ("w", picture.unused or picture.problem or ""),
            ])  # fmt: skip
    return f"<details open><summary>Photographs ({len(rows)})</summary>{table(head, rows)}</details>"


def _correlations(report: CalibrateRigReport) -> str:
    """Correlations of everything, those of half and more in colour."""
    covariance, names = np.array(report.rig.result.covariance), report.rig.result.unknowns
    is_free = np.diag(covariance) > 0
    scale = 1.0 / np.sqrt(np.diag(covariance)[is_free])
    values = covariance[np.ix_(is_free, is_free)] * scale[:, None] * scale[None, :]
    kept = [name for name, free in zip(names, is_free, strict=True) if free]
    rows = [
        [("t", name), *(("amber" if i != j and abs(v) > 0.5 else "", f"{v:.2f}") for j, v in enumerate(row[: i + 1]))]
        for i, (name, row) in enumerate(zip(kept, values, strict=True))
    ]
    head = [("t", ""), *(("", name) for name in kept)]
    return f"<details><summary>Correlations of all unknowns</summary>{table(head, rows)}</details>"
