"""The page of ``sfmapp uncalibrated``: what pixels alone say, what they leave open, and what closes it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path

import numpy as np

from sfmapp.report.model import RunFacts
from sfmapp.report.page import render_page, table
from sfmapp.reporting import Report
from sfmapp.uncalibrated.clouds import Clouds, boxed
from sfmapp.uncalibrated.known_places import KnownPointReport

_POINTS = 4000
_STYLE = """<style>.clouds{display:grid;grid-template-columns:repeat(auto-fit,minmax(20rem,1fr));gap:.6rem}
.clouds canvas{width:100%;display:block;background:#111;touch-action:none}
</style>"""


class ProjectiveReport(Report):
    """What matched pixels alone tell.

    Attributes:
        num_images: given. num_cameras: that have a camera. without_camera: names of the others.
        num_points, num_sightings: of the model. dropped: share of sightings that do not fit.
        rms_px: of a coordinate. sigma_px: standard deviation of one, as the free numbers tell.
        core: photographs whose common points were factorised.
        ambiguity_rms_px: of the same pixels from the model under a random map of space.
        ambiguity_ratio: by how much ratios of distances differ between the two models: the largest over the smallest.
    """

    num_images: int
    num_cameras: int
    without_camera: Sequence[str]
    num_points: int
    num_sightings: int
    dropped: float
    rms_px: float
    sigma_px: float
    core: Sequence[str]
    ambiguity_rms_px: float
    ambiguity_ratio: float


class SelfCalibrationReport(Report):
    """The metric frame in which all photographs are of one camera.

    Attributes:
        focal_px, focal_sigma_px: square pixels and the principal point in the middle are taken for granted.
        linear_focal_px: of the linear dual absolute quadric; absent where that was none of a camera.
        start_focal_px: of the least squares over K and the plane at infinity, before the adjustment.
        condition: of these equations. rms_px: of a coordinate after the adjustment.
        motion: what is special of the turns, if anything. warnings: what cannot be checked.
    """

    focal_px: float
    focal_sigma_px: float
    linear_focal_px: float | None
    start_focal_px: float
    condition: float
    rms_px: float
    motion: str
    warnings: Sequence[str]


class KnownPointsReport(Report):
    """The frame of the world, by points of known place.

    Attributes:
        num_used: that agree. sigma: of a known coordinate as what is left tells beyond the noise of the marks; absent
            for five points.
        condition: of the equations. median_point_sigma: of the model's points, along the longest axis; absent for five.
        points: each.
    """

    num_used: int
    sigma: float | None
    condition: float
    median_point_sigma: float | None
    points: Sequence[KnownPointReport]


class UncalibratedReport(Report):
    """The report of ``sfmapp uncalibrated``.

    Attributes:
        projective: the model of the pixels. refused: why there is no metric one, empty if there is.
        self_calibration, known_points: what made it metric; absent where it was not that.
    """

    projective: ProjectiveReport
    refused: str
    run: RunFacts
    self_calibration: SelfCalibrationReport | None = None
    known_points: KnownPointsReport | None = None


def uncalibrated_page(report: UncalibratedReport, clouds: Clouds) -> str:
    """The page, self-contained, with its own script."""
    return render_page(f"No calibration: {report.run.source}", _body(report, clouds))


def _body(report: UncalibratedReport, clouds: Clouds) -> Iterator[str]:
    told = report.projective
    yield _STYLE
    if report.refused:
        yield (
            f'<div class="failure"><p><b>No metric model.</b> {escape(report.refused[0].upper() + report.refused[1:])}.'
            "</p><p>The projective one stands: it has every incidence and no length.</p></div>"
        )
    yield "<h2>1. What matched pixels say</h2>"
    core = ", ".join(escape(name) for name in told.core)
    yield (
        f"<p>{told.num_cameras} of {told.num_images} photographs have a camera of eleven free numbers, "
        f"{told.num_points:,} "
        f"points a place, {told.num_sightings:,} sightings leave {told.rms_px:.3f} px in a coordinate "
        f"({told.dropped:.1%} "
        f"were dropped). It began with the points that {core} share: their pixels, each times its depth, are a "
        "matrix of "
        "rank four, which falls into cameras and points (Sturm and Triggs). The others came by resection.</p>"
    )
    if told.without_camera:
        yield f"<p>Without a camera: {', '.join(escape(name) for name in told.without_camera)}.</p>"
    yield "<h2>2. What they leave open</h2>"
    yield (
        "<p>For any invertible 4 x 4 map H of space, cameras PH<sup>-1</sup> see points HX in the same pixels. "
        "Below, the "
        f"model as it was found and under a random H: the first leaves {told.rms_px:.4f} px, the second "
        f"{told.ambiguity_rms_px:.4f}, and yet ratios of distances differ by a factor of "
        f"{told.ambiguity_ratio:.1f}. Drag to "
        "turn. Straight lines, planes and what meets what are all that the two have in common.</p>"
    )
    yield "<noscript><p>The clouds are drawn by this page's own script; your browser runs none.</p></noscript>"
    yield '<div class="clouds">'
    for name, caption in (("found", "as it was found"), ("mapped", "under a random map of space")):
        yield f'<figure><canvas data-cloud="{name}"></canvas><figcaption>{caption}</figcaption></figure>'
    yield "</div>"
    if report.known_points is not None:
        yield from _known(report.known_points)
    if report.self_calibration is not None:
        yield from _metric(report.self_calibration, told)
    if clouds.metric is not None:
        yield (
            '<div class="clouds"><figure><canvas data-cloud="metric"></canvas><figcaption>metric; red: cameras'
            "</figcaption></figure></div>"
        )
    yield f'<p class="dim">{report.run.wall_s:.1f} s, seed {report.run.seed}, {escape(report.run.started)}</p>'
    text = json.dumps(_data(clouds), separators=(",", ":"))
    yield f'<script type="application/json" id="cloud-data">{text}</script>'
    script = Path(__file__).with_name("cloud_script.js").read_text(encoding="utf-8")
    yield f"<script>{script}</script>"


def _known(told: KnownPointsReport) -> Iterator[str]:
    yield "<h2>3. What closes it: known points</h2>"
    sigma = (
        "five points leave nothing over to check them by"
        if told.sigma is None
        else f"what is left says {told.sigma:.3g} beyond the noise of its marks"
    )
    spread = (
        ""
        if told.median_point_sigma is None
        else f" Points of the model are good to {told.median_point_sigma:.3g} in the median."
    )
    yield (
        f"<p>H has fifteen unknowns, a known point tells three. {told.num_used} of {len(told.points)} are used; "
        "for the "
        f"standard deviation of a known coordinate {sigma}; condition {told.condition:.0f}.{spread}</p>"
    )
    rows = [
        [
            ("t green" if one.is_used else "t red", one.name), ("", one.num_images),
            ("", "" if one.left_px is None else f"{one.left_px:.2f}"),
            ("", "" if one.distance is None else f"{one.distance:.4g}"),
        ]
        for one in told.points
    ]  # fmt: skip
    yield table([("t", "point"), ("", "photographs"), ("", "marks px"), ("", "distance from its place")], rows)


def _metric(told: SelfCalibrationReport, projective: ProjectiveReport) -> Iterator[str]:
    yield "<h2>3. What closes it: one camera</h2>"
    for warning in told.warnings:
        yield f'<div class="failure"><p>{escape(warning[0].upper() + warning[1:])}.</p></div>'
    linear = "none of a camera" if told.linear_focal_px is None else f"{told.linear_focal_px:.0f} px"
    rows = [
        [("t", "linear: P Q P^T ~ K K^T, square pixels, known principal point"), ("", linear)],
        [("t", "least squares over K and the plane at infinity"), ("", f"{told.start_focal_px:.0f} px")],
        [
            ("t", "bundle adjustment with one camera"),
            ("", f"{told.focal_px:.1f} \N{PLUS-MINUS SIGN} {told.focal_sigma_px:.1f} px"),
        ],
    ]
    yield (
        "<p>All photographs are of one camera, with square pixels and its principal point in the middle. The dual "
        "absolute "
        "quadric Q, which every picture sees as KK<sup>T</sup>, is the same in all of them, and tells the frame up "
        "to a "
        "similarity.</p>" + table([("t", "way"), ("", "focal length")], rows)
    )
    yield (
        f"<p>With one camera the pixels leave {told.rms_px:.3f} px, with eleven free numbers a view "
        f"{projective.rms_px:.3f}. "
        "The sigma is what keypoint noise makes of it; square pixels and the principal point are not in it.</p>"
    )


def _data(clouds: Clouds) -> dict[str, object]:
    chosen = np.unique(np.linspace(0, len(clouds.found) - 1, min(len(clouds.found), _POINTS)).astype(np.int64))
    sets = {"found": clouds.found, "mapped": clouds.mapped}
    if clouds.metric is not None:
        sets["metric"] = clouds.metric
    out: dict[str, object] = {"rgb": clouds.rgb[chosen].tolist()}
    for name, xyz in sets.items():
        box = boxed(xyz, clouds.centers if name == "metric" else np.zeros((0, 3)))
        out[name] = np.round(box[0][chosen], 4).tolist()
        if name == "metric":
            out["centers"] = np.round(box[1], 4).tolist()
    return out
