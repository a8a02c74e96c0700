"""The page of ``sfmapp transfer``: three photographs to click into, and one that nobody took."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.trifocal import LIMIT_SIGMAS
from sfmapp.report.drawing import jpeg_url
from sfmapp.report.model import RunFacts
from sfmapp.report.page import render_page, table
from sfmapp.reporting import Report
from sfmapp.twoview.drawing import spread_points
from sfmapp.uncalibrated.three_views import ThreeViews, TransferReport

Pixels = NDArray[np.uint8]

_SHOWN_PX, _MATCHES = 900, 40
_STYLE = """<style>.views{display:grid;grid-template-columns:repeat(auto-fit,minmax(20rem,1fr));gap:.6rem}
.views canvas{width:100%;display:block;cursor:crosshair}
button{font:inherit;padding:.2rem .7rem}
</style>"""


class TransferRunReport(Report):
    """The report of ``sfmapp transfer``."""

    transfer: TransferReport
    run: RunFacts


def transfer_page(
    report: TransferRunReport, views: ThreeViews, pictures: tuple[Pixels, Pixels, Pixels], synthesised: Pixels
) -> str:
    """The page, self-contained, with its own script.

    Args:
        pictures: (H, W, 3) RGB of the photographs as stored. synthesised: (H, W, 3) of the third.
    """
    names = report.transfer.names
    return render_page(f"{names[0]} and {names[1]} in {names[2]}", _body(report, views, pictures, synthesised))


def _body(
    report: TransferRunReport, views: ThreeViews, pictures: tuple[Pixels, Pixels, Pixels], synthesised: Pixels
) -> Iterator[str]:
    told = report.transfer
    yield _STYLE
    if told.degenerate:
        yield f'<div class="failure"><p>{escape(told.degenerate[0].upper() + told.degenerate[1:])}.</p></div>'
    yield (
        "<p>No calibration is used on this page. F takes a point of one photograph to a line of another; where the "
        "lines of a matched point of photographs 1 and 2 cross in photograph 3, there it is: <i>x</i><sub>3</sub> ~ "
        "F<sub>31</sub><i>x</i><sub>1</sub> &times; F<sub>32</sub><i>x</i><sub>2</sub>. In the trifocal plane, which "
        "the three camera centres span, both lines are one. The trifocal tensor has no such plane.</p>"
        "<noscript><p>The pictures of this page are drawn by its own script; your browser runs none.</p></noscript>"
    )
    yield "<h2>Click a point</h2>"
    yield '<p><button id="next-match">another match</button> <span id="transfer-said"></span></p><div class="views">'
    for n, name in enumerate(told.names, 1):
        yield f'<figure><canvas id="view{n}"></canvas><figcaption>{n}: {escape(name)}</figcaption></figure>'
    yield "</div><p class=dim>Grey band in photograph 3: the trifocal plane.</p>"
    yield "<h2>How well</h2>" + _ways(told)
    if told.new_view is not None:
        yield from _new_view(told, pictures[2], synthesised)
    yield f'<p class="dim">{report.run.wall_s:.1f} s, seed {report.run.seed}, {escape(report.run.started)}</p>'
    for n, pixels in enumerate(pictures, 1):
        yield f'<img id="photo{n}" src="{jpeg_url(pixels, _SHOWN_PX)}" alt="" hidden>'
    text = json.dumps(_data(told, views), separators=(",", ":")).replace("<", "\\u003c")
    yield f'<script type="application/json" id="transfer-data">{text}</script>'
    script = Path(__file__).with_name("transfer_script.js").read_text(encoding="utf-8")
    yield f"<script>{script}</script>"


def _ways(told: TransferReport) -> str:
    rows = []
    for way in told.ways:
        numbers = ("", "", "")
        if math.isfinite(way.median_px):
            numbers = (f"{way.median_px:.2f}", f"{way.p90_px:.2f}", f"{way.median_sigma_px:.2f}")
        rows.append([("t", way.name), ("", way.num_points), ("", way.num_refused), *(("", text) for text in numbers)])
    head = [
        ("t", "transfer"), ("", "points"), ("", "refused"), ("", "median px"), ("", "90 % within px"),
        ("", "median sigma px"),
    ]  # fmt: skip
    return table(head, rows) + (
        f"<p class=dim>Measured on keypoints that had no part in the geometry: half of the {told.num_common} points in "
        "common fit it, the other half is transferred, and the other way round. Refused: the longer axis of its error "
        f"ellipse is above {LIMIT_SIGMAS:g} times the noise of a keypoint ({told.noise_px:.2f} px). Lines of a point "
        f"cross at {told.median_crossing_deg:.1f} degrees in the median.</p>"
    )


def _new_view(told: TransferReport, real: Pixels, synthesised: Pixels) -> Iterator[str]:
    view = told.new_view
    assert view is not None
    yield "<h2>A photograph that nobody took</h2><div class=views>"
    for pixels, caption in (
        (synthesised, "synthesised from photographs 1 and 2"), (real, f"photograph 3, {told.names[2]}"),
    ):  # fmt: skip
        source = jpeg_url(pixels, _SHOWN_PX)
        yield f'<figure><img src="{source}" alt=""><figcaption>{escape(caption)}</figcaption></figure>'
    yield (
        f"</div><p>{view.num_triangles:,} triangles between matches of photographs 1 and 2 were carried into the third "
        f"view, corner by corner through the tensor. No model stands between. {view.coverage:.0%} of the picture is "
        f"filled; there its grey values correlate with the real ones to {view.correlation:.3f}. Black: no match of "
        "photographs 1 and 2 says anything.</p>"
    )


def _data(told: TransferReport, views: ThreeViews) -> dict[str, object]:
    chosen = spread_points(views.xy[:, 0], _MATCHES)
    return {
        "size": told.sizes, "f21": told.fundamental_21, "f31": told.fundamental_31, "f32": told.fundamental_32,
        "tensor": told.tensor, "plane": told.trifocal_line,
        "matches": np.round(views.xy[chosen, :2].reshape(len(chosen), 4), 2).tolist(),
        "line_sigma": told.line_sigma_px, "limit": LIMIT_SIGMAS * told.noise_px,
    }  # fmt: skip
