"""The page of a matched pair: what was seen, how far away it is, and how far off that may be."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from html import escape
from urllib.parse import quote

import cv2
import numpy as np

from sfmapp.images.pixels import as_rgb
from sfmapp.report.drawing import jpeg_url
from sfmapp.report.page import render_page, table
from sfmapp.report.stereo_document import StereoReport
from sfmapp.report.stereo_pictures import (
    QUALITY,
    SHOWN_PX,
    ColorScale,
    anaglyph,
    map_figure,
    rows_across,
    scale_of,
)
from sfmapp.stereo.measured import MeasuredPair, MeasuredReport
from sfmapp.stereo.report import StereoPairReport
from sfmapp.stereo.result import DisparityMap, RectifiedPair
from sfmapp.stereo.temporal import ConsistencyReport, FilmReport

# of what has not moved, what the intervals let expect
_PROMISED = 0.95
_STYLE = """<style>.bar-of img{width:100%;height:.8rem;object-fit:fill;image-rendering:auto}
.bar-of div{display:flex;justify-content:space-between;font-size:.8rem}
.slider{position:relative}.slider img{width:100%;display:block}.slider img+img{position:absolute;inset:0;
clip-path:inset(0 0 0 var(--cut,50%))}.slider+input{width:100%}</style>"""


def stereo_page(report: StereoPairReport, pair: RectifiedPair, found: DisparityMap, measured: MeasuredPair) -> str:
    """The page, self-contained, its pictures in it."""
    title = f"{report.left.rsplit('/', 1)[-1]} and {report.right.rsplit('/', 1)[-1]}"
    return render_page(title, _body(report, pair, found, measured))


def pairs_page(report: StereoReport) -> str:
    """The page of several pairs, each a line that leads to its own."""
    return render_page(f"{len(report.pairs)} stereo pairs", _lines(report))


def _lines(report: StereoReport) -> Iterator[str]:
    for failed in report.failed:
        yield f'<div class="failure"><p><b>{escape(failed.name)}</b>: {escape(failed.reason)}</p></div>'
    if report.film is not None:
        yield f"<p>{_film(report.film)}</p>"
    has_depths, is_film = any(pair.disparity.depths for pair in report.pairs), report.film is not None
    head = ["matched", "right within a pixel", "sigma px", "rows off px"]
    head += ["depths"] * has_depths + ["still", "agrees with the frame before"] * is_film
    rows = []
    for pair in report.pairs:
        found, seen, sigma = pair.disparity, pair.rectification.rows, pair.measured.median_sigma_px
        cells = [
            f"{found.density:.1%}", f"{pair.measured.expected_right:.1%}", "" if sigma is None else f"{sigma:.3f}",
            "" if seen is None else f"{seen.rms_px:.2f}",
        ]  # fmt: skip
        if has_depths:
            of = found.depths
            cells.append(f"{of[0]:.3g} to {of[-1]:.3g} {_unit(pair.measured)}" if of else "")
        if is_film:
            cells += _agreement(pair.consistency)
        link = f'<a href="{quote(pair.name)}/report.html">{escape(pair.name)}</a>'
        warnings = escape("; ".join(pair.rectification.warnings))
        middle = "".join(f"<td>{text}</td>" for text in cells)
        rows.append(f"<tr><td class=t>{link}</td>{middle}<td class=w>{warnings}</td></tr>")
    names = "".join(f"<th>{name}</th>" for name in head)
    yield f"<div class=wide><table><tr><th class=t>pair</th>{names}<th class=t>warnings</th></tr>{''.join(rows)}"
    yield "</table></div>"


def _film(film: FilmReport) -> str:
    """What is said of a whole film."""
    if film.agreeing_share is None or film.worst_agreeing_share is None:
        return (
            f"Nothing tells whether depths stay where nothing moves: in {film.num_following} frames hardly a pixel "
            "shows what it showed in the frame before."
        )
    text = (
        f"Where nothing moves, {film.kept_share:.1%} of the pixels are matched again in the next frame, and "
        f"{film.agreeing_share:.1%} of their disparities agree within the 95 % intervals of both; they change by "
        f"{film.median_change_px:.3f} px (medians of {film.num_compared} frames of {film.num_following} that follow "
        "another)."
    )
    if film.worst_agreeing_share < _PROMISED:
        text += f" Least agrees {escape(film.worst or '')}, with {film.worst_agreeing_share:.1%}."
    return text


def _agreement(found: ConsistencyReport | None) -> tuple[str, str]:
    """Two cells: what has not moved, and how much of it agrees."""
    if found is None:
        return "", ""
    share = "" if found.agreeing_share is None else f"{found.agreeing_share:.1%}"
    return f"{found.still_share:.1%}", share


def _body(report: StereoPairReport, pair: RectifiedPair, found: DisparityMap, measured: MeasuredPair) -> Iterator[str]:
    yield _STYLE
    for warning in report.rectification.warnings:
        yield f'<div class="failure"><p>{escape(warning)}</p></div>'
    yield _summary(report)
    yield from _maps(report, pair, found, measured)
    if measured.depth is not None:
        yield "<h2>How well depth is told</h2>" + _depths(report.measured)
    yield from _both_views(pair, found, is_polar=report.rectification.is_polar)
    yield "<h2>Rectification</h2>" + _rectification(report)


def _summary(report: StereoPairReport) -> str:
    disparity, told, unit = report.disparity, report.measured, _unit(report.measured)
    text = (
        f"<p>{disparity.density:.1%} of the pixels are matched by {escape(disparity.matcher)}, which looked for "
        f"disparities from {disparity.searched[0]:g} to {disparity.searched[1]:g} px ({escape(disparity.told_by)})"
    )
    if disparity.filled:
        text += f"; {disparity.filled:.1%} are filled from their neighbours, and have no sigma"
    text += "."
    if told.median_sigma_px is not None:
        text += (
            f" A disparity is good to {told.median_sigma_px:.2f} px in the median (68 %; 95 % within "
            f"{told.median_half_width_95_px:.2f} px). By their confidences, {told.expected_right:.1%} of the matches "
            f"are right within a pixel, and {told.sure_share:.1%} are sure of it by nine chances in ten."
        )
    if told.least_depth is not None:
        text += (
            f"</p><p>The rig tells depths from {told.least_depth:.3g} to {_length(told.greatest_depth)} {unit}: nearer "
            "points were not looked for, farther ones may as well be at infinity. At "
            f"{_length(told.ten_percent_depth)} {unit} sigma is a tenth of the depth."
        )
    elif told.median_sigma_px is not None:
        text += "</p><p>No baseline is known: there are disparities, and no depths."
    same = report.consistency
    if same is not None and same.agreeing_share is not None:
        text += (
            f"</p><p>{same.still_share:.1%} of the pixels surely show what they showed in "
            f"{escape(same.compared_with)}. Of these {same.kept_share:.1%} are matched again, and "
            f"{same.agreeing_share:.1%} of their disparities agree within the 95 % intervals of both; they change by "
            f"{same.median_change_px:.3f} px in the median."
        )
    return text + "</p>"


def _maps(report: StereoPairReport, pair: RectifiedPair, found: DisparityMap, measured: MeasuredPair) -> Iterator[str]:
    yield '<h2>Maps of the left picture</h2><div class="row large">'
    picture = jpeg_url(as_rgb(pair.left), SHOWN_PX, QUALITY)
    yield f'<figure><img src="{picture}" alt=""><figcaption>what the maps are of</figcaption></figure>'
    unit = _unit(report.measured)
    if measured.depth is not None and measured.depth_sigma is not None:
        depth = np.where(measured.is_solid, measured.depth, np.nan)
        scale = replace(scale_of(depth, is_log=True), is_reversed=True)  # what is near is red, as of disparities
        yield map_figure(depth, scale, f"depth, {unit}: what is rather right than wrong, and told from infinity")
        with np.errstate(invalid="ignore"):
            percent = 100.0 * measured.depth_sigma / measured.depth
        yield map_figure(percent, _errors(percent), "sigma of depth, % of it, calibration included")
    yield map_figure(found.disparity, scale_of(found.disparity), "disparity, px, all that was matched or filled")
    sigma = measured.error.sigma
    yield map_figure(sigma, _errors(sigma), "sigma of disparity, px: 68 % of the errors are below it")
    confidence = np.where(np.isfinite(sigma), measured.error.confidence, np.nan)
    scale = ColorScale(0.0, 1.0, colormap=cv2.COLORMAP_VIRIDIS)
    yield map_figure(confidence, scale, "confidence: chance to be right within a pixel")
    yield "</div><p class=dim>Red is near, of depths and disparities. Dark grey: nothing is known there.</p>"


def _unit(told: MeasuredReport) -> str:
    """Of depths; a model that nothing brought to metres has units of its own."""
    return told.unit or "units"


def _length(value: float | None) -> str:
    """With three digits, and all of those before the point."""
    return "" if value is None else f"{value:.3g}" if value < 1000.0 else f"{value:,.0f}"


def _errors(values: np.ndarray) -> ColorScale:
    return scale_of(values, is_log=True, colormap=cv2.COLORMAP_INFERNO)


def _depths(told: MeasuredReport) -> str:
    if not told.depths:
        return "<p class=dim>Nothing was matched that is rather right than wrong, and told from infinity.</p>"
    rows, has_calibration, unit = [], any(at.of_calibration for at in told.depths), _unit(told)
    for at in told.depths:
        texts = [
            f"{at.share:.0%}", f"{at.depth:.4g}", f"{at.disparity_px:.2f}", f"{at.disparity_sigma_px:.3f}",
            f"{at.sigma:.3g}", f"{100.0 * at.sigma / at.depth:.2g}", f"{at.of_calibration:.3g}",
        ]  # fmt: skip
        rows.append([("", text) for text in texts[: len(texts) - (not has_calibration)]])
    head = [
        "nearer are", f"depth {unit}", "disparity px", "its sigma px", f"sigma of depth {unit}", "%",
        *([f"of calibration {unit}"] if has_calibration else []),
    ]  # fmt: skip
    note = (
        "To first order, sigma grows with the square of the depth. The part of the calibration is the same for all "
        "pixels, and does not average out."
        if has_calibration
        else "To first order, sigma grows with the square of the depth. Nothing is known of the calibration's own "
        "sigma: a part of the width, 1.75 in ten thousand, is in the sigma of every disparity."
    )
    return table([("", name) for name in head], rows) + f"<p class=dim>{note}</p>"


def _both_views(pair: RectifiedPair, found: DisparityMap, *, is_polar: bool) -> Iterator[str]:
    known = found.disparity[np.isfinite(found.disparity)]
    shift = round(float(np.median(known))) if known.size else 0
    yield '<h2>Both views</h2><figure><div class="slider">'
    for picture in (pair.left, pair.right):
        yield f'<img src="{jpeg_url(as_rgb(picture), SHOWN_PX, QUALITY)}" alt="">'
    yield (
        '</div><input type="range" min="0" max="100" value="50" aria-label="left or right" '
        "oninput=\"this.previousElementSibling.style.setProperty('--cut',this.value+'%')\">"
        "<figcaption>left of the handle the left picture, right of it the right one: "
        + ("what is near grows away from the epipole" if is_polar else "whatever crosses it has to stay on its row")
        + "</figcaption></figure>"
    )
    if is_polar:
        return
    yield (
        f'<figure><img src="{jpeg_url(rows_across(pair, found), 2 * SHOWN_PX, QUALITY)}" alt=""><figcaption>some rows '
        "across both pictures, and on each some pixels with their matches</figcaption></figure>"
    )
    yield (
        f'<figure><img src="{jpeg_url(anaglyph(pair, shift), 1400, QUALITY)}" alt=""><figcaption>for glasses of red '
        f"(left) and cyan (right); what has a disparity of {shift} px lies in the plane of the screen</figcaption>"
        "</figure>"
    )


def _rectification(report: StereoPairReport) -> str:
    how = report.rectification
    rows = [
        ("cameras", how.cameras),
        ("pictures", f"{how.width} x {how.height} pixels" + (", as they were given" if how.is_as_given else "")),
    ]
    if how.focal_px is not None:
        rows.append(("focal length", f"{how.focal_px:.2f} px"))
        rows.append(("disparity at infinity", f"{-(how.doffs_px or 0.0):.2f} px"))
    if how.baseline is not None:
        rows.append(("baseline", f"{how.baseline:.6g} {how.unit or 'units'}"))
    if how.is_polar:
        rows.append(("rows", "half-planes about the baseline, one camera in front of the other"))
    elif not how.is_as_given:
        rows.append(("axes turned by", f"{how.turn_deg[0]:.2f} and {how.turn_deg[1]:.2f} degrees"))
        rows.append(("kept of each photograph", f"{how.kept[0]:.0%} and {how.kept[1]:.0%}"))
    if how.rows is not None:
        rows.append(
            (
                "rows of sparse matches",
                f"{how.rows.median_px:+.2f} px in the median, {how.rows.rms_px:.2f} px rms, of {how.rows.num_matches}",
            )
        )
    return table([("t", ""), ("t", "")], [[("t", name), ("w", value)] for name, value in rows])
