"""The report of ``sfmapp calibrate board`` as a page of HTML."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from sfmapp.calibration.report import BoardReport
from sfmapp.calibration.result import CameraCalibration
from sfmapp.calibration.uncertainty import image_grid, projection_sigma
from sfmapp.report.calibration_pictures import coverage_svg, heat_svg, outlines_svg, residual_field_svg
from sfmapp.report.model import CalibrateReport
from sfmapp.report.page import render_page, table

_GRID = (21, 15)
# correlations above this are worth a glance
_STRONG = 0.9


def render_board_html(report: CalibrateReport, made: CameraCalibration) -> str:
    """The page of a report; ``made``: the calibration that it is of, with its residuals."""
    board = report.board
    body = [_headline(report), _notes(board), _parameters(board), _next(board, made), _maps(made, board.unit)]
    body += [_pictures(board), _lenses(board), _correlations(board), _files(board)]
    return render_page(f"sfmapp calibrate: {report.run.source}", body)


def _headline(report: CalibrateReport) -> str:
    board, run = report.board, report.run
    parts = [
        f"{board.model}, {board.width}x{board.height}",
        f"{board.num_views} views of {board.board}",
        f"rms {board.rms_px:.3f} px",
        f"noise {board.noise_px:.3f} px a coordinate",
        f"a projection is sure to {board.median_sigma_px:.3f} px in the median, {board.worst_sigma_px:.3f} px at worst",
        f"{run.wall_s:.1f} s",
        f"sfmapp {run.versions['sfmapp']}",
        run.started,
    ]
    return f'<p class="dim">{escape("; ".join(parts))}</p>'


def _notes(board: BoardReport) -> str:
    lines = [*_guess_lines(board), *board.warnings, *([] if board.bend else [f"shape of the board: {board.bend_note}"])]
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


def _guess_lines(board: BoardReport) -> list[str]:
    guess = board.guess
    if guess is None:
        return []
    text = f"the board was told from the photographs: {guess.num_agree} agree, {guess.num_part} may show a part of it"
    text += f", {guess.num_other} show another" if guess.num_other else ""
    return [f"{text}; lengths are in {board.unit}", *guess.notes]


def _parameters(board: BoardReport) -> str:
    rows = [
        [("t", name), ("", f"{value:.6g}"), ("", f"{board.sigmas[name]:.2g}")] for name, value in board.params.items()
    ]
    return "<h2>Parameters</h2>" + table([("t", "parameter"), ("", "value"), ("", "sigma")], rows)


def _next(board: BoardReport, made: CameraCalibration) -> str:
    if not board.next_views:
        return ""
    seen = np.concatenate([view.xy[view.is_used] for view in made.views])
    picture = outlines_svg(made.camera, [np.array(view.outline) for view in board.next_views], seen)
    rows = [
        [("", n), ("w", view.hint), ("", f"{view.mean_sigma_px:.4f}")] for n, view in enumerate(board.next_views, 1)
    ]
    head = [("", ""), ("t", "photograph next"), ("", "then sigma, px")]
    now = f"The mean sigma of a projection over the picture is {board.mean_sigma_px:.4f} px now."
    beside = f"<div>{picture}</div><div>{table(head, rows)}</div>"
    return f'<h2>What to photograph next</h2><p>{now}</p><div class="row large">{beside}</div>'


def _maps(made: CameraCalibration, unit: str) -> str:
    used = [view for view in made.views if view.is_used.any()]
    xy, residuals = (np.concatenate([getattr(view, name) for view in used]) for name in ("xy", "residuals"))
    is_used = np.concatenate([view.is_used for view in used])
    grid = image_grid(made.camera, _GRID)
    figures = [
        (coverage_svg(made.camera, xy, is_used), "Where there were points; red ones were left aside"),
        (residual_field_svg(made.camera, xy[is_used], residuals[is_used]),
         "What is left, cell by cell: where neighbours point one way, the lens model cannot explain it"),
    ]  # fmt: skip
    near, middle, far = made.distances or (None, None, None)
    for distance, text in ((near, "nearest point"), (middle, "median distance of the points"), (far, "farthest point")):
        if distance is not None:
            sigma = projection_sigma(made, grid, distance)
            where = f"Sigma of a projection at {distance:.3g} {unit}, the {text}"
            figures.append((heat_svg(made.camera, sigma, _GRID, "px"), where))
    figures.append(
        (heat_svg(made.camera, projection_sigma(made, grid), _GRID, "px"), "Sigma of a projection at infinity")
    )
    parts = "".join(f"<figure>{svg}<figcaption>{escape(text)}</figcaption></figure>" for svg, text in figures)
    return f'<h2>Over the picture</h2><div class="row large">{parts}</div>'


def _pictures(board: BoardReport) -> str:
    rows = []
    for one in board.pictures:
        light = "grey" if one.like else "red" if one.unused else "amber" if one.problem else "green"
        rms = None if one.rms_px is None else f"{one.rms_px:.3f}"
        why = one.unused or one.problem or one.picked
        rows.append([(f"t {light}", one.name), ("", one.num_points), ("", one.num_used), ("", rms), ("w", why)])
    head = [("t", "photograph"), ("", "points"), ("", "used"), ("", "rms px"), ("t", "why")]
    return "<h2>Photographs</h2>" + table(head, rows)


def _lenses(board: BoardReport) -> str:
    if len(board.lenses) < 2:
        return ""
    rows = []
    for n, lens in enumerate(board.lenses):
        numbers: Sequence[float | None] = (lens.held_out_px, lens.rms_px, lens.worst_px)
        cells = [("", None if value is None else f"{value:.4g}") for value in numbers]
        rows.append([("t green" if n == 0 else "t", lens.model), ("", lens.num_params), *cells, ("w", lens.reason)])
    head = [("t", "lens model"), ("", "parameters"), ("", "held out px"), ("", "fitted px"), ("", "worst sigma px"),
            ("t", "why")]  # fmt: skip
    return "<h2>Lens models</h2>" + table(head, rows)


def _correlations(board: BoardReport) -> str:
    names = list(board.params)
    rows = []
    for name, row in zip(names, board.correlations, strict=True):
        cells = [
            ("amber" if abs(v) > _STRONG and other != name else "", f"{v:.2f}")
            for v, other in zip(row, names, strict=True)
        ]
        rows.append([("t", name), *cells])
    inner = table([("t", ""), *(("", name) for name in names)], rows)
    return f"<details><summary>Correlations</summary>{inner}</details>"


def _files(board: BoardReport) -> str:
    rows = [
        [("t", one.name), ("t", one.program), ("", None if one.max_px is None else f"{one.max_px:.1e}"),
         ("w", one.reason)] for one in board.files
    ]  # fmt: skip
    head = [("t", "file"), ("t", "for"), ("", "read back, px"), ("t", "why not")]
    return "<h2>For other programs</h2>" + table(head, rows)
