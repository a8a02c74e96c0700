"""The page of swept depth maps: photographs, their depth, how far off it may be, and what others said of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from sfmapp.report.drawing import jpeg_url
from sfmapp.report.page import render_page, table, usage_table
from sfmapp.report.stereo_pictures import QUALITY, SHOWN_PX, ColorScale, map_figure, scale_of
from sfmapp.report.sweep_document import SweepReport

# photographs that are shown with their maps, evenly spread
MOST_SHOWN = 12
# ends of the colours of sigma, as shares of the depth
_SIGMA_ENDS = (3e-4, 3e-2)
_STYLE = """<style>.bar-of{max-width:24rem}.bar-of img{width:100%;height:.8rem}
.bar-of div{display:flex;justify-content:space-between;font-size:.8rem;color:#888}</style>"""


@dataclass(frozen=True)
class SweptPicture:
    """What the page shows of a view: its position among the maps, the photograph (H, W, 3) of any size, and depth and
    sigma (H, W), NaN where nothing confirmed it."""

    place: int
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    sigma: NDArray[np.float32]


def sweep_page(report: SweepReport, pictures: Sequence[SweptPicture]) -> str:
    """The page, self-contained, its pictures in it."""
    return render_page(f"Depth maps of {len(report.maps)} photographs", _body(report, pictures))


def _body(report: SweepReport, pictures: Sequence[SweptPicture]) -> Iterator[str]:
    yield _STYLE
    for line in report.warnings:
        yield f'<div class="failure"><p>{escape(line.message or "")}</p></div>'
    yield f"<p>{_summary(report)}</p>"
    more = "" if len(pictures) == len(report.maps) else f" ({len(pictures)} of {len(report.maps)})"
    yield f"<h2>Photographs and their depth{more}</h2>"
    for picture in pictures:
        yield _row(report, picture)
    yield _all(report)
    yield usage_table(report.usage, report.run)
    if report.left_out:
        yield "<h2>Without a map</h2>"
        yield table([("t", "photograph"), ("t", "why")], [[("t", e.name), ("w", e.reason)] for e in report.left_out])


def _summary(report: SweepReport) -> str:
    if not report.maps:
        return "No photograph has a map."
    confirmed = float(np.median([row.confirmed for row in report.maps]))
    sigmas = [row.median_sigma for row in report.maps if row.median_sigma is not None]
    text = f"Planes were swept through what {len(report.maps)} photographs show. Half of the maps have a depth in "
    text += f"{confirmed:.0%} of their pixels or more that another one confirms and no more of them see through"
    text += f"; its sigma is {float(np.median(sigmas)):.2%} of it." if sigmas else "."
    return text + " Grey is what no other map confirms: blank, mirroring or seen by one photograph alone."


def _row(report: SweepReport, picture: SweptPicture) -> str:
    row = report.maps[picture.place]
    photograph = f'<figure><img src="{jpeg_url(picture.rgb, SHOWN_PX, QUALITY)}" alt=""><figcaption>'
    photograph += f"{escape(row.name)}, with {escape(', '.join(row.neighbors))}</figcaption></figure>"
    if not np.isfinite(picture.depth).any():
        return f'<div class="row">{photograph}<p>No depth of it is confirmed.</p></div>'
    depth = scale_of(picture.depth, is_log=True)
    nearest_is_red = ColorScale(depth.low, depth.high, is_log=True, is_reversed=True)
    share = (picture.sigma / picture.depth).astype(np.float32)
    maps = map_figure(picture.depth, nearest_is_red, f"depth, {row.near:.3g} to {row.far:.3g} were looked at")
    maps += map_figure(share, ColorScale(*_SIGMA_ENDS, is_log=True), "sigma as a share of it")
    return f'<div class="row">{photograph}{maps}</div>'


def _all(report: SweepReport) -> str:
    head = [
        ("t", "photograph"), ("", "planes"), ("", "near"), ("", "far"), ("", "answered"), ("", "confirmed"),
        ("", "sigma"),
    ]  # fmt: skip
    rows = [
        [
            ("t", row.name), ("", str(row.num_planes)), ("", f"{row.near:.4g}"), ("", f"{row.far:.4g}"),
            ("", f"{row.answered:.1%}"), ("", f"{row.confirmed:.1%}"),
            ("", "" if row.median_sigma is None else f"{row.median_sigma:.2%}"),
        ]
        for row in report.maps
    ]  # fmt: skip
    return f"<details><summary>All {len(rows)} maps</summary>{table(head, rows)}</details>"
