"""The study of a rig before it is built: lengths as people write them, several baselines side by side."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sfmapp.errors import UsageError
from sfmapp.formats.atomic import replaced_file
from sfmapp.planes.lengths import METRES, parse_length, parse_size
from sfmapp.report.stereo_design_html import design_page
from sfmapp.stereo.design import DesignReport, StereoDesign, WantedBaseline, baseline_for, study

_NUM_DEPTHS = 9
_FINE = METRES | {"um": 1e-6, "nm": 1e-9}
_NUMBER = re.compile(r"\s*(?P<value>[0-9.]+(?:e[+-]?\d+)?)\s*(?P<unit>[a-z]*)\s*", re.IGNORECASE)


@dataclass(frozen=True)
class Wishes:
    """A rig as it is written on the command line: ``20mm``, ``30/mm``, ``0.5m``.

    Attributes:
        focal: a length, with ``pixel``; or pixels.
        size: ``WxH`` pixels.
        baselines: lengths. depths: one, or the nearest and the farthest.
        pixel: width of a pixel, ``3.75um``, or how many a millimetre has, ``30/mm``.
        converging_deg: angle between the axes; or fixate: distance at which they meet. Parallel where both are None.
        disparity_error, focal_error: pixels. baseline_error: a length.
        max_disparity: that the matcher looks for, pixels.
        wanted_error: a length, for which baselines are computed.
    """

    focal: str
    size: str
    baselines: Sequence[str]
    depths: Sequence[str]
    pixel: str | None = None
    converging_deg: float | None = None
    fixate: str | None = None
    disparity_error: float = 1.0
    focal_error: float = 0.0
    baseline_error: str | None = None
    max_disparity: float | None = None
    wanted_error: str | None = None


def design_stereo(wishes: Wishes, page: Path | None = None) -> DesignReport:
    """Depth errors, common fields of view and least and greatest depths of rigs with parallel axes, and with
    converging ones where these are asked for.

    Args:
        page: an HTML page with tables and plots, to be written; None for none.

    Raises:
        UsageError: a wish that means nothing; the message says what was expected.
        InputError: the page cannot be written.
    """
    if page is not None and page.suffix.lower() != ".html":
        raise UsageError(f"{page}: expected a file that ends in .html")
    size = parse_size(wishes.size)
    if size.is_metric:
        raise UsageError(f"size is {wishes.size!r}, expected pixels", "--size 1280x960")
    unit = _unit(wishes.depths[0])
    depths = _depths(wishes.depths)
    first = StereoDesign(
        focal_pixels(wishes.focal, wishes.pixel), int(size.width), int(size.height), parse_length(wishes.baselines[0]),
        disparity_error_px=wishes.disparity_error, focal_error_px=wishes.focal_error,
        baseline_error=parse_length(wishes.baseline_error) if wishes.baseline_error else 0.0,
        greatest_disparity_px=wishes.max_disparity,
    )  # fmt: skip
    rigs = [replace(first, baseline=parse_length(text)) for text in wishes.baselines]
    rigs += [replace(rig, converging_deg=_converging(rig, wishes)) for rig in rigs if _is_converging(wishes)]
    report = DesignReport(
        focal_px=first.focal_px, width=first.width, height=first.height, field_of_view_deg=2.0 * first.half_view_deg,
        disparity_error_px=first.disparity_error_px, baseline_error=first.baseline_error / METRES[unit],
        focal_error_px=first.focal_error_px, unit=unit,
        rigs=[study(rig, depths, METRES[unit]) for rig in rigs],
        wanted=_wanted(first, depths, wishes.wanted_error, METRES[unit]),
    )  # fmt: skip
    if page is not None:
        with replaced_file(page) as beside:
            beside.write_text(design_page(report), encoding="utf-8")
    return report


def focal_pixels(focal: str, pixel: str | None) -> float:
    """Pixels of a focal length: ``1200``, ``1200px``, or ``20mm`` with ``30/mm`` or ``3.75um``. Raises UsageError."""
    match = _NUMBER.fullmatch(focal)
    value, unit = (_value(match), match["unit"].lower()) if match else (0.0, "")
    if value > 0.0 and unit in ("", "px"):
        if pixel is not None:
            raise UsageError(f"focal length is {focal!r}, in pixels already", "leave --pixel out, or give millimetres")
        return value
    if not value > 0.0 or unit not in METRES:
        raise UsageError(f"focal length is {focal!r}, expected pixels, or a length", "--focal 1200, or --focal 8mm")
    if pixel is None:
        raise UsageError(f"focal length is {focal!r}: expected the size of a pixel as well", "--pixel 3.75um")
    return value * METRES[unit] / _pixel_width(pixel)


def _pixel_width(text: str) -> float:
    """Metres."""
    density = text.strip().lower().removesuffix("/mm").removesuffix("px").strip()
    match = _NUMBER.fullmatch(density if text.strip().lower().endswith("/mm") else text)
    if match is not None and (value := _value(match)) > 0.0:
        if text.strip().lower().endswith("/mm") and not match["unit"]:
            return 1e-3 / value
        if match["unit"].lower() in _FINE:
            return value * _FINE[match["unit"].lower()]
    raise UsageError(f"pixel is {text!r}, expected its width, or how many a millimetre has", "3.75um, or 30/mm")


def _value(match: re.Match[str]) -> float:
    try:
        value = float(match["value"])
    except ValueError:
        return 0.0
    return value if math.isfinite(value) else 0.0


def _depths(texts: Sequence[str]) -> list[float]:
    """Metres: one depth, or some from the first to the second, each so many times the one before."""
    if len(texts) > 2:
        raise UsageError(f"range is {' '.join(texts)!r}, expected one depth, or the nearest and the farthest")
    ends = [parse_length(text) for text in texts]
    if len(ends) == 1:
        return ends
    if not ends[0] < ends[1]:
        raise UsageError(f"range is {' '.join(texts)!r}, expected the nearest depth first")
    between = np.geomspace(ends[0], ends[1], _NUM_DEPTHS)
    # round numbers are read more easily, and these are examples
    return [ends[0], *(float(f"{depth:.2g}") for depth in between[1:-1]), ends[1]]


def _unit(text: str) -> str:
    parse_length(text)
    return re.sub(r"^[\s\d.e+-]*", "", text.strip(), flags=re.IGNORECASE).lower()


def _is_converging(wishes: Wishes) -> bool:
    return wishes.converging_deg is not None or wishes.fixate is not None


def _converging(rig: StereoDesign, wishes: Wishes) -> float:
    if wishes.fixate is not None:
        return math.degrees(2.0 * math.atan(0.5 * rig.baseline / parse_length(wishes.fixate)))
    angle = wishes.converging_deg
    assert angle is not None
    if not angle > 0.0:
        raise UsageError(
            f"axes that converge at {angle:g} degrees: expected an angle above 0", "leave it out: parallel"
        )
    return angle


def _wanted(design: StereoDesign, depths: Sequence[float], error: str | None, unit_m: float) -> list[WantedBaseline]:
    if error is None:
        return []
    told, limit = [], parse_length(error)
    for depth in depths:
        baseline = baseline_for(design, depth, limit)
        share = float(replace(design, baseline=baseline, converging_deg=0.0).common_share(depth))
        told.append(
            WantedBaseline(
                depth=depth / unit_m, error=limit / unit_m, baseline=baseline / unit_m, common_share=share
            )
        )  # fmt: skip
    return told
