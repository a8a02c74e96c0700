"""The pages of ``calibrate target`` and ``locate``: the photograph with its residuals, and tables."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.point_reports import (
    FitReport,
    LocationReport,
    ParameterReport,
    PointReport,
    PoseReport,
    TargetReport,
    TargetsReport,
)
from sfmapp.calibration.report import CameraFileReport
from sfmapp.geometry.orientation import upright_pixels, upright_xy
from sfmapp.report.page import render_page, table

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

_WIDTH = 1400
# the longest residual that counts is drawn so long, pixels of the page, unless that would shrink it
_LONGEST = 40.0
# names and rows of so many points, the wrong ones first; the rest is in report.json
_MAX_NAMES, _MAX_ROWS = 150, 500
_GOOD, _WRONG, _EXPECTED = (40, 200, 90), (230, 60, 50), (250, 190, 40)


def draw_residuals(rgb: Pixels, orientation: int, points: Sequence[PointReport]) -> tuple[bytes, float]:
    """A JPEG of a photograph (H, W, 3), upright, with its points and, longer than they are, their residuals.

    Returns:
        The file, and how many times longer than in the photograph the residuals of points that agree are.
    """
    size = rgb.shape[1], rgb.shape[0]
    shown = upright_pixels(rgb, orientation)
    scale = min(1.0, _WIDTH / shown.shape[1])
    if scale < 1.0:
        shown = cv2.resize(shown, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    # paler, so that what is drawn stands out
    canvas = np.ascontiguousarray((0.55 * shown + 0.45 * 255.0).astype(np.uint8)[:, :, ::-1])
    marked = scale * upright_xy(orientation, np.array([point.marked_px for point in points]).reshape(-1, 2), *size)
    there = [point.expected_px if point.expected_px is not None else (np.nan, np.nan) for point in points]
    expected = scale * upright_xy(orientation, np.array(there).reshape(-1, 2), *size)
    used = np.array([point.is_used for point in points], bool)
    lengths = np.linalg.norm((expected - marked)[used], axis=1)
    longest = float(np.nanmax(lengths, initial=0.0))
    zoom = max(1.0, _LONGEST / longest) if longest > 1e-6 else 1.0
    for point, at, target in zip(points, marked, expected, strict=True):
        color = _GOOD if point.is_used else _WRONG
        if np.isfinite(target).all():
            end = at + zoom * (target - at) if point.is_used else target
            _line(canvas, at, end, color if point.is_used else _EXPECTED)
            if not point.is_used:
                _circle(canvas, target, 5, _EXPECTED)
        _circle(canvas, at, 6, color)
        if len(points) > _MAX_NAMES:
            continue
        place = (int(np.clip(at[0] + 9, 0, canvas.shape[1] - 60)), int(np.clip(at[1] - 7, 14, canvas.shape[0] - 4)))
        cv2.putText(canvas, point.name[:24], place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 3, cv2.LINE_AA)
        cv2.putText(canvas, point.name[:24], place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (40, 40, 40), 1, cv2.LINE_AA)
    return cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes(), zoom


def _fixed(xy: Array) -> tuple[int, int]:
    # OpenCV takes coordinates in 1/16 of a pixel, and has the centre of the first one at zero
    fixed = np.clip(np.rint(16.0 * (xy - 0.5)), -(2**30), 2**30).astype(int)
    return int(fixed[0]), int(fixed[1])


def _line(canvas: Pixels, start: Array, end: Array, color: tuple[int, int, int]) -> None:
    cv2.line(canvas, _fixed(start), _fixed(end), color[::-1], 2, cv2.LINE_AA, 4)


def _circle(canvas: Pixels, center: Array, radius: int, color: tuple[int, int, int]) -> None:
    cv2.circle(canvas, _fixed(center), radius * 16, color[::-1], 2, cv2.LINE_AA, 4)


def render_target_html(report: TargetReport, picture: tuple[bytes, float] | None) -> str:
    """The page of a calibration; ``picture`` from :func:`draw_residuals`, None without a photograph."""
    parts = [
        _head(report.fit),
        f"<h2>Camera</h2><p>{escape(report.fit.model)}, {report.fit.width} x {report.fit.height} pixels</p>",
        table([("t", "parameter"), ("", "value"), ("", "sigma")], _parameters(report.parameters)),
        _picture(picture),
        "<h2>Pose</h2>" + _pose(report.fit.pose),
        _held(report),
        _points(report.fit.points),
        _files(report.files),
    ]
    return render_page(f"Calibration of {report.fit.photograph}", parts)


def render_targets_html(report: TargetsReport, pictures: Sequence[tuple[bytes, float]]) -> str:
    """The page of a calibration from several photographs; ``pictures`` from :func:`draw_residuals`, of as many of the
    first of them as there are."""
    rows = [
        [("t", fit.photograph), ("", f"{fit.num_used} of {len(fit.points)}"), ("", f"{fit.rms_px:.3f}"),
         *[("", f"{value:.6g} +- {sigma:.2g}")
           for value, sigma in zip(fit.pose.center, fit.pose.sigma_center, strict=True)],
         ("", f"{max(fit.pose.sigma_rotation_deg):.2g}")]
        for fit in report.photographs
    ]  # fmt: skip
    unit = report.photographs[0].pose.unit
    axes = [("", f"{axis}, {unit}") for axis in "xyz"]
    head = [("t", "photograph"), ("", "points that agree"), ("", "rms px"), *axes, ("", "rotation, degrees")]
    lost = [[("t red", one.photograph), ("w", one.reason)] for one in report.lost]
    warnings = "".join(f"<li>{escape(warning)}</li>" for warning in report.warnings)
    parts = [
        f'<p class="{"amber" if report.warnings else "green"}">rms {report.rms_px:.3f} px, noise of a mark '
        f"{report.noise_px:.3g} px, {report.degrees_of_freedom:.0f} degrees of freedom</p>"
        f"<p class=dim>{escape(report.method)}</p>{f'<ul>{warnings}</ul>' if warnings else ''}",
        f"<h2>Camera</h2><p>{escape(report.model)}, {report.width} x {report.height} pixels</p>",
        table([("t", "parameter"), ("", "value"), ("", "sigma")], _parameters(report.parameters)),
        "<h2>Photographs</h2><p>Where the camera stood, with what is not known of it in the sigmas.</p>"
        + table(head, rows) + (table([("t", "left aside"), ("t", "")], lost) if lost else ""),
    ]  # fmt: skip
    for n, fit in enumerate(report.photographs):
        wrong = sum(not point.is_used for point in fit.points)
        title = escape(fit.photograph) + (f", {wrong} left aside" if wrong else "")
        inner = (_picture(pictures[n]) if n < len(pictures) else "") + _points(fit.points)
        parts.append(f"<details{' open' if wrong else ''}><summary>{title}</summary>{inner}</details>")
    parts.append(_files(report.files))
    return render_page(f"Calibration of {len(report.photographs)} photographs of known points", parts)


def _parameters(parameters: Sequence[ParameterReport]) -> list[list[tuple[str, object]]]:
    return [[("t", p.name), ("", f"{p.value:.6g}"), ("", f"{p.sigma:.2g}" if p.sigma else "held")] for p in parameters]


def render_location_html(report: LocationReport, picture: tuple[bytes, float]) -> str:
    """The page of a pose; ``picture`` from :func:`draw_residuals`."""
    rows = [
        [("", f"{o.turn_deg:.3f}"), ("", f"{o.shift:.5g}"), ("", f"{o.rms_px:.3f}")] for o in report.others
    ]  # fmt: skip
    head = [("", "turned by, degrees"), ("", f"away, {report.fit.pose.unit}"), ("", "rms px")]
    others = "<h2>Other poses that the points allow</h2>" + table(head, rows) if rows else ""
    body = [_head(report.fit), "<h2>Pose</h2>" + _pose(report.fit.pose), others, _picture(picture)]
    return render_page(f"Pose of {report.fit.photograph}", [*body, _points(report.fit.points)])


def _head(fit: FitReport) -> str:
    kind = "amber" if fit.warnings or fit.num_used < len(fit.points) else "green"
    text = f"{fit.num_used} of {len(fit.points)} points agree, rms {fit.rms_px:.3f} px"
    noise = f"noise of a mark {fit.noise_px:.3g} px ({fit.noise_source})"
    warnings = "".join(f"<li>{escape(warning)}</li>" for warning in fit.warnings)
    return (
        f'<p class="{kind}">{text}; {escape(noise)}</p><p class=dim>{escape(fit.method)}</p>'
        f"{f'<ul>{warnings}</ul>' if warnings else ''}"
    )


def _picture(picture: tuple[bytes, float] | None) -> str:
    if picture is None:
        return ""
    source = "data:image/jpeg;base64," + base64.b64encode(picture[0]).decode()
    text = (
        f"Green: points that agree, with the way to where camera and pose put them, {picture[1]:.3g} times as long. "
        "Red: points that the others contradict, yellow where they should be, in true length."
    )
    return f'<h2>Residuals</h2><figure><img src="{source}" alt="residuals"><figcaption>{text}</figcaption></figure>'


def _pose(pose: PoseReport) -> str:
    axes = ("x", "y", "z")
    rows = [
        [("t", f"centre {axis}"), ("", f"{value:.6g} {pose.unit}"), ("", f"{sigma:.2g}")]
        for axis, value, sigma in zip(axes, pose.center, pose.sigma_center, strict=True)
    ]
    rows += [
        [("t", f"rotation about the camera's {axis}"), ("", ""), ("", f"{sigma:.3g} degrees")]
        for axis, sigma in zip(axes, pose.sigma_rotation_deg, strict=True)
    ]
    quaternion = " ".join(f"{value:.9g}" for value in pose.cam_from_world)
    note = f"<p class=dim>cam_from_world, qx qy qz qw tx ty tz: {quaternion}</p>"
    return table([("t", ""), ("", "value"), ("", "sigma")], rows) + note


def _held(report: TargetReport) -> str:
    """How firmly the points hold the camera, and which lenses were tried."""
    text = ""
    if report.linear is not None:
        smallest = report.linear.singular_values[min(10, len(report.linear.singular_values) - 1)]
        text = (
            f"<p>The linear system has rank {report.linear.rank} of 11: its last singular value that has to be above "
            f"the noise is {smallest:.3g}, {smallest / report.linear.noise_level:.3g} times what noise alone makes.</p>"
        )
    if report.tilt_deg is not None:
        text = f"<p>The plane of the points is tilted by {report.tilt_deg:.1f} degrees against the picture.</p>"
    rows = [
        [
            ("t", lens.model + (" (chosen)" if lens.is_chosen else "")),
            ("", lens.num_unknown),
            ("", lens.num_used),
            ("", f"{lens.rms_px:.3f}"),
            ("", None if lens.left_out_px is None else f"{lens.left_out_px:.3f}"),
        ]
        for lens in report.lenses
    ]
    head = [("t", "lens"), ("", "unknowns"), ("", "points"), ("", "rms px"), ("", "left-out points, rms px")]
    return "<h2>What the points tell</h2>" + text + table(head, rows)


def _points(points: Sequence[PointReport]) -> str:
    rows = []
    ranked = sorted(points, key=lambda point: point.is_used) if len(points) > _MAX_ROWS else points
    for point in ranked[:_MAX_ROWS]:
        off: tuple[str | None, ...] = (None, None)
        if point.expected_px is not None:
            off = tuple(f"{m - e:+.3f}" for m, e in zip(point.marked_px, point.expected_px, strict=True))
        left_out = None if point.left_out_px is None else f"{point.left_out_px:.3f}"
        mark = [("", f"{value:.2f}") for value in point.marked_px]
        kind = "t" if point.is_used else "t red"
        rows.append([(kind, point.name), *mark, ("", off[0]), ("", off[1]), ("", left_out), ("w", point.reason)])
    head = [("t", "point"), ("", "u"), ("", "v"), ("", "residual u"), ("", "v"), ("", "left out, px"), ("t", "")]
    more = f"<p class=dim>{len(points) - _MAX_ROWS} more in report.json</p>" if len(points) > _MAX_ROWS else ""
    return "<h2>Points</h2>" + table(head, rows) + more


def _files(files: Sequence[CameraFileReport]) -> str:
    rows = [
        [("t", f.name), ("t", f.program), ("", None if f.max_px is None else f"{f.max_px:.2g}"), ("w", f.reason)]
        for f in files
    ]
    head = [("t", "file"), ("t", "for"), ("", "read back, px"), ("t", "")]
    return "<h2>Files</h2>" + table(head, rows) if rows else ""
