"""The report of a panorama, as a type and as a page."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from sfmapp.panorama.report import PictureReport, TurningReport
from sfmapp.report.drawing import jpeg_url, shrunk
from sfmapp.report.model import LogLine, Outcome, RunFacts
from sfmapp.report.page import failure_box, log_table, render_page, table, usage_table
from sfmapp.reporting import NamedReason, Report, Usage

# longer side of the picture on the page
_SHOWN_PX, _QUALITY = 1600, 85
_LIGHTS = {"rotation": "green", "parallax": "amber", "contradicted": "red", "no rotation": "dim"}


class OtherPanorama(Report):
    """A further panorama of photographs that overlap none of the first: what the stages said."""

    turning: TurningReport
    picture: PictureReport


class PanoramaReport(Report):
    """The report of ``sfmapp panorama``.

    Attributes:
        outcome: how it ended. turning, picture: what the stages said; absent where they were not reached.
        others: further panoramas, of photographs that overlap none of the first.
        skipped: files that could not be used.
        usage: of each step.
    """

    format: str
    outcome: Outcome
    run: RunFacts
    turning: TurningReport | None = None
    picture: PictureReport | None = None
    others: Sequence[OtherPanorama] = ()
    skipped: Sequence[NamedReason]
    usage: Mapping[str, Usage]
    warnings: Sequence[LogLine]
    decisions: Sequence[LogLine]


def panorama_page(report: PanoramaReport, shown: Sequence[NDArray[np.uint8]]) -> str:
    """The page, self-contained. ``shown``: the panoramas in small, as :func:`in_small` makes them."""
    return render_page(f"Panorama: {report.run.source}", _body(report, shown))


def in_small(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture (H, W, 3) as it fits on the page."""
    return shrunk(pixels, _SHOWN_PX)[0]


def _body(report: PanoramaReport, shown: Sequence[NDArray[np.uint8]]) -> Iterator[str]:
    yield failure_box(report.outcome)
    panoramas = [] if report.turning is None else [(report.turning, report.picture)]
    panoramas += [(other.turning, other.picture) for other in report.others]
    for turning, _ in panoramas:
        for each in turning.contradictions:
            yield f'<div class="failure"><p>{escape(each.message)}</p><p>{escape(each.advice)}</p></div>'
    for k, (turning, picture) in enumerate(panoramas):
        if k:
            yield f"<h1>Panorama {k + 1}</h1>"
        if picture is not None and k < len(shown):
            yield _picture(picture, shown[k])
        yield _cameras(turning) + _parallax(turning) + _left_out(turning) + _images(turning, picture) + _pairs(turning)
    if report.skipped:
        rows = [[("t red", one.name), ("w", one.reason)] for one in report.skipped]
        yield "<h2>Files that could not be used</h2>" + table([("t", "file"), ("t", "reason")], rows)
    yield usage_table(report.usage, report.run)
    yield log_table("Warnings", report.warnings) + log_table("Decisions", report.decisions)


def _picture(picture: PictureReport, small: NDArray[np.uint8]) -> str:
    text = (
        f"{picture.file}: {picture.width} x {picture.height} pixels, {picture.projection}, "
        f"{picture.span_deg:.0f} degrees{', closed' if picture.is_closed else ''}; overlaps differ in brightness by "
        f"{picture.worst_overlap:.1%} at most"
    )
    source = jpeg_url(small, _SHOWN_PX, _QUALITY)
    return (
        f'<figure><img style="max-width:100%" src="{source}" alt="the panorama">'
        f"<figcaption>{escape(text)}</figcaption></figure>"
    )


def _cameras(turning: TurningReport) -> str:
    rows = []
    for camera in turning.cameras:
        sigma = "" if camera.focal_sigma_px is None else f"{camera.focal_sigma_px:.2g}"
        why = "told by the photographs" if camera.is_told else "hangs on what was known before"
        bends = ", ".join(
            f"{name} {camera.params[n]:.4f} \N{PLUS-MINUS SIGN} {camera.sigma[name]:.1g}"
            for name, n in (("k1", 3), ("k2", 4))
            if name in camera.sigma and len(camera.params) > n
        )
        rows.append([
            ("", camera.camera_idx), ("", camera.num_images), ("", f"{camera.width} x {camera.height}"),
            ("", f"{camera.prior_focal_px:.1f}"), ("t", camera.prior_source), ("", f"{camera.focal_px:.2f}"),
            ("", sigma), ("t", bends), ("t " + ("green" if camera.is_told else "amber"), why),
        ])  # fmt: skip
    head = [("", "camera"), ("", "photographs"), ("", "size"), ("", "focal before, px"), ("t", "from"),
            ("", "focal, px"), ("", "sigma"), ("t", "distortion"), ("t", "focal length")]  # fmt: skip
    noise = (
        f"A keypoint has a noise of {turning.noise_px:.3f} px; {turning.num_rays} rays, {turning.num_observations} "
        f"measurements. Sigmas are widened by {turning.correlation:.2f}, as residuals of neighbours agree."
    )
    return "<h2>Cameras</h2>" + table(head, rows) + f"<p class=dim>{escape(noise)}</p>"


def _parallax(turning: TurningReport) -> str:
    """Where the photographer did not turn on the spot."""
    moved = [pair for pair in turning.pairs if pair.parallax_px > 0.0 and pair.verdict in ("rotation", "parallax")]
    moved.sort(key=lambda pair: -pair.parallax_px)
    text = f"The rotations explain {turning.turned_share:.1%} of all verified matches."
    if not moved:
        return f"<h2>Parallax</h2><p>{text} No pair shows more than the noise of its keypoints.</p>"
    rows = [
        [("t", pair.images[0]), ("t", pair.images[1]), ("", f"{pair.parallax_px:.2f}"), ("", f"{pair.turn_deg:.1f}")]
        for pair in moved[:20]
    ]
    head = [("t", "photograph"), ("t", "and"), ("", "parallax px"), ("", "turned by degrees")]
    more = (
        f"<p>{text} Between these the camera was also moved, or something in them did, beyond the noise of keypoints: "
        "turn about the lens, not about yourself, where things are near.</p>"
    )
    return "<h2>Parallax</h2>" + more + table(head, rows)


def _left_out(turning: TurningReport) -> str:
    if not turning.left_out:
        return ""
    rows = [[("t red", one.name), ("w", one.reason)] for one in turning.left_out]
    return "<h2>Photographs that are left out</h2>" + table([("t", "photograph"), ("t", "why")], rows)


def _images(turning: TurningReport, picture: PictureReport | None) -> str:
    rows = []
    for image in turning.images:
        sigma = max(image.sigma_deg)
        gain = "" if picture is None else f"{np.mean(picture.gains[image.name]):.2f}"
        rms = "" if image.rms_px is None else f"{image.rms_px:.2f}"
        rows.append([("t", image.name), ("", image.num_rays), ("", rms), ("", f"{sigma:.2g}"), ("", gain)])
    head = [("t", "photograph"), ("", "rays"), ("", "rms px"), ("", "sigma of the rotation, degrees"), ("", "gain")]
    return "<h2>Photographs</h2>" + table(head, rows)


def _pairs(turning: TurningReport) -> str:
    rows = [
        [
            ("t", pair.images[0]), ("t", pair.images[1]), ("", pair.num_matches), ("", pair.num_turned),
            ("", f"{pair.turn_deg:.1f}"), ("", f"{pair.median_px:.2f}" if math.isfinite(pair.median_px) else ""),
            ("", f"{pair.parallax_px:.2f}"), ("t " + _LIGHTS[pair.verdict], pair.verdict),
        ]
        for pair in turning.pairs
    ]  # fmt: skip
    head = [("t", "photograph"), ("t", "and"), ("", "matches"), ("", "explained"), ("", "turned by degrees"),
            ("", "median px"), ("", "parallax px"), ("t", "what it is")]  # fmt: skip
    return f"<details><summary>Pairs ({len(rows)})</summary>{table(head, rows)}</details>"
