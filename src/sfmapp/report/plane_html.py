"""The pages of ``warp`` and ``rectify``: what was made, and what the corners tell."""

from __future__ import annotations

from html import escape
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.orientation import upright_pixels, upright_xy
from sfmapp.images.pixels import to_8_bits
from sfmapp.planes.report import PlaneReport, RectifyReport, WarpReport
from sfmapp.report.drawing import jpeg_url, shrunk
from sfmapp.report.page import render_page, table

Array = NDArray[np.float64]

_SHOWN_PX, _QUALITY = 1400, 85
_OUTLINE = (255, 140, 0)


def warp_page(report: WarpReport, pixels: NDArray[Any], orientation: int) -> str:
    """The page of ``warp``. ``pixels``: the photograph with the picture, as stored; ``orientation``: of its EXIF."""
    plane = report.plane
    text = (
        f"{report.result}: {report.picture} ({report.picture_width} x {report.picture_height}) on {plane.photograph}, "
        f"{report.covered_share:.1%} of it"
    )
    stretch = (
        f"In the world the picture is stretched by {report.stretch:.3g} +- {report.stretch_sigma:.2g} in width over "
        "height: 1 keeps its shape. "
    )
    density = f"A pixel of it takes up to {report.pixel_share:.2g} pixels of the photograph along a side: " + (
        "it is averaged, not picked from." if report.pixel_share < 1.0 else "more of it than there is to see."
    )
    parts = [
        _warnings(plane), _figure(upright_pixels(_rgb(pixels), orientation), text),
        f"<p>{stretch}{density}</p>", _plane(plane),
    ]  # fmt: skip
    return render_page(f"{report.picture} on {plane.photograph}", parts)


def rectify_page(report: RectifyReport, photograph: NDArray[Any], pixels: NDArray[Any], orientation: int) -> str:
    """The page of ``rectify``: the photograph with the corners, as stored, and the plane."""
    plane = report.plane
    shown, scale = shrunk(upright_pixels(_rgb(photograph), orientation), _SHOWN_PX)
    size = photograph.shape[1], photograph.shape[0]
    outline = upright_xy(orientation, np.array(plane.corners), *size)
    text = f"{plane.photograph}: corners {plane.source}, 1 at the top left of the plane"
    unit = f"{report.units_per_pixel:.4g} {plane.unit} a pixel"
    parts = [
        _warnings(plane), _figure(_outlined(shown, outline * scale), text),
        _figure(_rgb(pixels), f"{report.result}: {report.result_width} x {report.result_height} pixels, {unit}"),
        _size(report), _plane(plane),
    ]  # fmt: skip
    return render_page(f"A plane of {plane.photograph}", parts)


def _warnings(plane: PlaneReport) -> str:
    lines = "".join(f"<p>{escape(text)}</p>" for text in plane.warnings)
    return f'<div class="failure">{lines}</div>' if lines else ""


def _size(report: RectifyReport) -> str:
    rows = []
    for name, value, sigma in zip(("width", "height"), report.plane.size, report.size_sigma, strict=True):
        rows.append(
            [("t", name), ("", f"{value:.5g} {report.plane.unit}"), ("", None if sigma is None else f"{sigma:.2g}")]
        )
    head = [("t", ""), ("", "of the rectangle"), ("", "sigma")]
    return f"<h2>Size</h2><p>Width to height: {escape(report.aspect_source)}.</p>" + table(head, rows)


def _plane(plane: PlaneReport) -> str:
    shape = plane.shape
    rows = [
        [("t", "camera"), ("w", plane.camera)],
        [("t", "corners"), ("w", f"{plane.source}, to {plane.sigma_px:g} px")],
        [("t", "width over height"), ("w", f"{shape.aspect:.4g} +- {shape.aspect_sigma:.2g}")],
        [
            ("t" if shape.is_rectangle else "t red", "angle between the sides"),
            ("w", f"{shape.angle_deg:.2f} +- {shape.angle_sigma_deg:.2g} degrees with that focal length"),
        ],
        [
            ("t", "focal length, where that is to be 90"),
            ("w", f"{shape.focal_px:.0f} +- {shape.focal_sigma_px:.2g} px"),
        ],
    ]  # fmt: skip
    told = "<h2>What the corners tell</h2>" + table([("t", ""), ("t", "")], rows)
    if not plane.poses:
        return told + "<p class=dim>No pose: nothing is known of the focal length.</p>"
    lines = [
        [
            ("", n), ("", f"{pose.distance:.4g} {plane.unit}"), ("", f"{pose.tilt_deg:.2f}"),
            ("", ", ".join(f"{v:.3f}" for v in pose.normal)), ("", f"{pose.rms_px:.2f}"),
        ]
        for n, pose in enumerate(plane.poses, 1)
    ]  # fmt: skip
    head = [
        ("", ""), ("", "middle of the plane away"), ("", "tilt from the line of sight °"), ("", "normal in the camera"),
        ("", "rms px"),
    ]  # fmt: skip
    sigma = (
        ""
        if plane.distance_sigma is None
        else f"The first distance is good to {plane.distance_sigma:.2g} {plane.unit}. "
    )
    ambiguity = (
        "The corners allow both: a plane that leans the other way looks nearly the same from so far."
        if len(plane.poses) > 1
        else "The corners allow no other."
    )
    return told + "<h2>How the plane lies</h2>" + table(head, lines) + f"<p class=dim>{sigma}{ambiguity}</p>"


def _rgb(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    shown = to_8_bits(pixels)
    return cv2.cvtColor(shown, cv2.COLOR_GRAY2RGB) if shown.ndim == 2 else np.ascontiguousarray(shown[..., :3])


def _outlined(rgb: NDArray[np.uint8], corners: Array) -> NDArray[np.uint8]:
    canvas = np.ascontiguousarray(rgb)
    fixed = np.clip(np.rint(16.0 * (corners - 0.5)), -(2**30), 2**30).astype(np.int32)  # of OpenCV, 1/16 pixel
    cv2.polylines(canvas, [fixed], True, (0, 0, 0), 5, cv2.LINE_AA, 4)
    cv2.polylines(canvas, [fixed], True, _OUTLINE, 3, cv2.LINE_AA, 4)
    for n, (x, y) in enumerate(corners, 1):
        place = int(np.clip(x + 8, 4, rgb.shape[1] - 20)), int(np.clip(y - 8, 20, rgb.shape[0] - 6))
        cv2.putText(canvas, str(n), place, cv2.FONT_HERSHEY_SIMPLEX, 0.8, (0, 0, 0), 5, cv2.LINE_AA)
        cv2.putText(canvas, str(n), place, cv2.FONT_HERSHEY_SIMPLEX, 0.8, _OUTLINE, 2, cv2.LINE_AA)
    return canvas


def _figure(rgb: NDArray[np.uint8], text: str) -> str:
    source = jpeg_url(rgb, _SHOWN_PX, _QUALITY)
    return f'<figure><img src="{source}" alt=""><figcaption>{escape(text)}</figcaption></figure>'
