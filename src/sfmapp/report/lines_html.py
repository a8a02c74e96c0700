"""A calibration from lines as a page: what is told and why, and the photographs with their lines."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.line_refinement import Lines
from sfmapp.calibration.line_report import HeldOutLines, LinePhotograph, LinesReport
from sfmapp.calibration.result import CameraCalibration
from sfmapp.report.drawing import jpeg_url
from sfmapp.report.model import RunFacts
from sfmapp.report.page import render_page, table
from sfmapp.report.plots import Curve, plot_svg
from sfmapp.reporting import NamedReason, Report

Pixels = NDArray[np.uint8]

# of the directions, in their order; lines of none are grey
COLORS = ((229, 60, 50), (60, 180, 75), (50, 110, 240), (240, 170, 20), (180, 60, 210), (20, 190, 200))
_NO_DIRECTION = (150, 150, 150)
# longest side of a picture on the page, and most of them
_SHOWN_PX, _MOST_SHOWN = 900, 6


class CalibrateLinesReport(Report):
    """The report of ``sfmapp calibrate lines``.

    Attributes:
        skipped: files that could not be used.
    """

    lines: LinesReport
    skipped: Sequence[NamedReason]
    run: RunFacts


def line_picture(rgb: Pixels, photo: Lines) -> Pixels:
    """(H, W, 3) the photograph, dimmed, with its lines in the colours of their directions."""
    import cv2

    drawn: Pixels = (rgb // 2 + 40).astype(np.uint8)
    width = max(1, round(max(rgb.shape) / 700))
    for points, member in zip(photo.arcs.points, photo.member, strict=True):
        color = _NO_DIRECTION if member < 0 else COLORS[int(member) % len(COLORS)]
        # OpenCV has pixel centres at whole numbers; four bits of fraction
        path = np.round((points - 0.5) * 16.0).astype(np.int32)
        cv2.polylines(drawn, [path], False, color, width, cv2.LINE_AA, 4)
    return drawn


def lines_page(report: CalibrateLinesReport, calibration: CameraCalibration, pictures: Mapping[str, Pixels]) -> str:
    """The page, self-contained. Pictures are (H, W, 3) by name of the photograph."""
    return render_page("Calibration from lines", _body(report, calibration, pictures))


def _body(
    report: CalibrateLinesReport, calibration: CameraCalibration, pictures: Mapping[str, Pixels]
) -> Iterator[str]:
    lines = report.lines
    camera = calibration.camera
    yield f"<p>{escape(calibration.method)}; {camera.width}x{camera.height} px.</p>"
    yield from (f'<div class="failure"><p>{escape(warning)}</p></div>' for warning in lines.warnings)
    light = {"measured": "green", "left alone": "amber", "unknown": "red"}
    yield "<h2>What the lines tell</h2>" + table(
        [("t", ""), ("t", "verdict"), ("", "value"), ("", "sigma"), ("t", "why")],
        [
            [
                ("t", one.name), (f"t {light[one.verdict]}", one.verdict), ("", f"{one.value:.5g}"),
                ("", f"{one.sigma:.2g}"), ("w", one.reason),
            ]
            for one in lines.parameters
        ],
    )  # fmt: skip
    yield "<h2>Camera</h2>" + table(
        [("t", camera.model.name), ("", "value"), ("", "sigma")],
        [
            [("t", name), ("", f"{value:.6g}"), ("", f"{sigma:.2g}")]
            for name, value, sigma in zip(calibration.param_names, camera.params, calibration.sigmas, strict=True)
        ],
    )
    if lines.held_out is not None:
        yield "<h2>Lines that were held out</h2>" + _held_out(lines.held_out)
    yield "<h2>Straight lines for each distortion</h2>"
    curve = Curve("straight lines", np.array(lines.votes), "#4a7fd4")
    yield plot_svg(np.array(lines.strengths), [curve], [], "lambda R², R half the diagonal")
    yield "<h2>Photographs</h2>" + table(
        [("t", "name"), ("", "arcs"), ("", "straight"), ("t", "lines along each direction"), ("t", "problem")],
        [_row(one) for one in lines.photographs],
    )
    yield '<div class="row large">'
    for name, pixels in list(pictures.items())[:_MOST_SHOWN]:
        source = jpeg_url(pixels, _SHOWN_PX, quality=85)
        yield f'<figure><img src="{source}" alt=""><figcaption>{escape(name)}</figcaption></figure>'
    yield "</div>"


def _held_out(held: HeldOutLines) -> str:
    text = (
        f"Each half of the lines was calibrated from alone, and the other half was asked. {held.num_bent} of these "
        f"are bent by the distortion: {held.bend_before_px:.2f} px rms as photographed, {held.bend_after_px:.2f} px "
        "with the distortion undone (medians)."
    )
    if held.num_met is not None and held.num_expected is not None and held.focal_shares is not None:
        text += (
            f" {held.num_met} of {held.num_lines} straight lines meet a vanishing point of the others within two "
            f"sigmas, {held.num_expected:.0f} would by chance. The halves' focal lengths are "
            + " and ".join(f"{share:.4f}" for share in held.focal_shares)
            + " of that of all lines."
        )
    return f"<p>{escape(text)}</p>"


def _row(one: LinePhotograph) -> list[tuple[str, object]]:
    counts = ", ".join(str(direction.num_lines) for direction in one.directions) or "none stands out"
    return [("t", one.name), ("", one.num_arcs), ("", one.num_straight), ("t", counts), ("w", one.problem)]
