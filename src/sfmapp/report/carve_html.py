"""The page of a carved volume: how well it fits its silhouettes, what it looks like, how it was carved."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.coloring import Difference
from sfmapp.carve.limits import CLOSURE, OUTLINES, PATCHES, UNSEEN, Known, LimitsReport
from sfmapp.carve.octree import Octree
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.swept_sights import SightsReport
from sfmapp.carve.views import View
from sfmapp.report.carve_document import CarveReport
from sfmapp.report.carve_pictures import TINTS, cropped, overlap_picture, result_pictures, slice_picture
from sfmapp.report.drawing import jpeg_url
from sfmapp.report.page import log_table, render_page, table, usage_table
from sfmapp.scene.mesh import Mesh

Pixels = NDArray[np.uint8]

# photographs that are shown: evenly spread, and of those that fit worst the first
_NUM_SHOWN, _NUM_WORST = 4, 2
_NUM_HOLLOWS = 5
_SHOWN_PX, _QUALITY = 640, 85
_STYLE = """<style>.trio{display:grid;grid-template-columns:repeat(3,1fr);gap:.8rem;margin-bottom:1rem}
.key{display:inline-block;width:.8rem;height:.8rem;vertical-align:-.1rem;margin:0 .25rem 0 .6rem;
box-shadow:0 0 0 1px #bbb}</style>"""


@dataclass(frozen=True)
class Shape:
    """The volume that the page shows: its cells, its surface, and what is known of that."""

    octree: Octree
    mesh: Mesh
    known: Known


def carve_page(
    report: CarveReport, views: Sequence[View], silhouettes: Sequence[Silhouette], shape: Shape,
    read: Callable[[int], Pixels],
) -> str:  # fmt: skip
    """The page, self-contained, its pictures in it; ``read`` gives the photograph of a view."""
    title = f"A volume of {report.num_views} photographs"
    return render_page(title, _body(report, views, silhouettes, shape, read))


def _body(
    report: CarveReport, views: Sequence[View], silhouettes: Sequence[Silhouette], shape: Shape,
    read: Callable[[int], Pixels],
) -> Iterator[str]:  # fmt: skip
    yield _STYLE
    for line in report.warnings:
        yield f'<div class="failure"><p>{escape(line.message or "")}</p></div>'
    yield _summary(report)
    yield from _photographs(report, views, silhouettes, shape, read)
    yield from _fits(report)
    if report.limits is not None:
        outlines = "outlines alone" if report.shadows is None else "outlines and shadows alone"
        yield _limits(report.limits, None if report.joining is None else _teller(report), outlines)
    yield from _slices(shape.octree, shape.mesh)
    yield _levels(report)
    yield log_table("Decisions", report.decisions)
    yield usage_table(report.usage, report.run)


def _summary(report: CarveReport) -> str:
    fits = [fit.iou for fit in report.colors.views]
    surface, low, high = report.surface, report.carving.volume_low, report.carving.volume_high
    if report.shadows is not None:
        low, high = report.shadows.carving.volume_within, report.shadows.carving.volume_after
    size = " x ".join(f"{high - low:.4g}" for low, high in zip(surface.low, surface.high, strict=True))
    text = (
        f"<p>Seen again by its {report.num_views} photographs, the volume covers their silhouettes by "
        f"{np.median(fits):.2%} in the median (intersection over union; least {min(fits):.2%}). Cameras: "
        f"{escape(report.cameras)}.</p><p>Its closed surface of {surface.num_faces:,} triangles measures {size}, with "
        f"a volume of {surface.volume:.5g} and an area of {surface.area:.5g}, in units of the world. Its volume lies "
        f"between {low:.5g}, cells that are wholly inside, and {high:.5g}, with those at "
        "the surface. "
    )
    if report.shadows is not None:
        text += "The object itself may be smaller: what neither outlines nor shadows show stays filled."
    elif report.joining is None:
        text += "The object itself may be smaller: what no outline shows, such as the inside of a cup, stays filled."
    else:
        joining = report.joining
        text += (
            f"That is {joining.volume / joining.hull_volume:.0%} of what outlines alone leave ("
            f"{joining.hull_volume:.5g}): {joining.num_sights} photographs tell its hollows by {_teller(report)}."
        )
    text += "</p>"
    if report.box.told_by != "silhouettes":
        text += f"<p>The box was told by {escape(report.box.told_by)}.</p>"
    if report.shadows is not None:
        taken = report.shadows.carving
        told = "; ".join(
            f"{light.light} {light.dark_share:.0%} in shadow"
            + (f", {light.turned_share:.0%} as dark but perhaps turned away" if light.turned_share > 0.005 else "")
            + (
                f", {light.too_dark_share + light.mirror_share:.0%} not to be told"
                if light.too_dark_share + light.mirror_share > 0.005
                else ""
            )
            for light in report.shadows.lights
        )
        text += (
            f"<p>Shadows took away {1.0 - taken.volume_after / taken.volume_before:.1%} of what silhouettes left, by "
            f"{taken.num_pairs} photographs under single lights ({escape(told)}). What is left still holds the object, "
            "as far as it is matt, has no edge sharper than was said, and nothing else throws shadows on it.</p>"
        )
    if report.sights is not None:
        text += _sights(report.sights, report.colors.differences)
    colors = report.colors
    if colors.seen_share < 1.0:
        text += (
            f"<p>{colors.seen_share:.1%} of the vertices have the colours of photographs that show them "
            f"({colors.median_views:.0f} in the median); the others those of what is near.</p>"
        )
    return text


def _teller(report: CarveReport) -> str:
    """What was joined with the silhouettes."""
    return "patches" if report.sights is None else "colours"


def _sights(sights: SightsReport, differences: Sequence[Difference]) -> str:
    """What colours told, and whether the object looks the same from everywhere, as they suppose."""
    text = (
        f"<p>Colours tell the depth of {sights.known_share:.0%} of what {sights.num_maps} photographs show of the "
        "object, each confirmed by another one; where they tell nothing the hull stays. Surfaces are supposed to look "
        "the same from everywhere"
    )
    told = [f"{row.levels:.0f} at {row.from_deg:.0f} to {row.to_deg:.0f} degrees" for row in differences]
    if told:
        text += ": photographs of one place differ by grey levels of " + ", ".join(told) + " between their directions"
    return text + ".</p>"


def _photographs(
    report: CarveReport, views: Sequence[View], silhouettes: Sequence[Silhouette], shape: Shape,
    read: Callable[[int], Pixels],
) -> Iterator[str]:  # fmt: skip
    kind = None if report.joining is None else shape.known.kind
    fits = np.array([fit.iou for fit in report.colors.views])
    spread = np.unique(np.linspace(0, len(views) - 1, _NUM_SHOWN + 1)[:-1].round().astype(int)).tolist()
    chosen = [*spread, *(i for i in np.argsort(fits, kind="stable")[:_NUM_WORST].tolist() if i not in spread)]
    yield "<h2>Photographs and what was carved</h2>"
    told = ""
    if kind is not None:
        named = (
            (PATCHES, _teller(report)), (OUTLINES, "outlines alone"), (CLOSURE, "neither"), (UNSEEN, "no photograph"),
        )  # fmt: skip
        told = ", tinted by what tells it:" + ",".join(_key(TINTS[number], name) for number, name in named)
    yield (
        '<p class=dim>Left the photograph, pale outside its silhouette: <span class=key style="background:#eb3c28">'
        '</span>covered by the volume alone, <span class=key style="background:#286eff"></span>by the silhouette '
        f"alone. In the middle the volume in colours, right its shape lit from the camera{told}. The last ones fit "
        "worst.</p>"
    )
    for v in chosen:
        shown, colors, lit = result_pictures(views[v], shape.mesh, kind)
        pictures = [overlap_picture(read(v), shown, silhouettes[v]), colors, lit]
        captions = [f"{report.colors.views[v].name}: {fits[v]:.2%}", "", ""]
        yield "<div class=trio>"
        for picture, caption in zip(cropped(pictures, shown, silhouettes[v]), captions, strict=True):
            url = jpeg_url(picture, _SHOWN_PX, _QUALITY)
            yield f'<figure><img src="{url}" alt=""><figcaption>{escape(caption)}</figcaption></figure>'
        yield "</div>"


def _key(color: tuple[int, int, int], name: str) -> str:
    return f'<span class=key style="background:rgb{color}"></span>{name}'


def _fits(report: CarveReport) -> Iterator[str]:
    head = [
        ("t", "photograph"),
        ("", "overlap"),
        ("", "volume alone px"),
        ("", "silhouette alone px"),
        ("t", "told by"),
    ]
    problems = {mask.name: mask.problem for mask in report.masks.masks}
    rows = [
        [
            ("t", fit.name), ("", f"{fit.iou:.2%}"), ("", fit.over_px), ("", fit.under_px),
            ("w", fit.source + (f": {problems[fit.name]}" if problems.get(fit.name) else "")),
        ]
        for fit in report.colors.views
    ]  # fmt: skip
    yield f"<details><summary>All {len(rows)} photographs</summary>{table(head, rows)}</details>"
    for entry in report.left_out:
        yield f"<p class=dim>{escape(entry.name)}: {escape(entry.reason)}</p>"


def _limits(limits: LimitsReport, teller: str | None, outlines: str) -> str:
    """``teller``: what was joined with the silhouettes, if anything; ``outlines``: these, and what carved besides."""
    text = "<h2>What is not known</h2><p>"
    if teller is not None:
        text += (
            f"{teller.capitalize()} tell {limits.patches_share:.1%} of the surface. {limits.closure_share:.1%} is told "
            f"by neither {teller} nor outlines: it closes the rest, and the object's own surface may be elsewhere. "
        )
    text += (
        f"{limits.outlines_share:.1%} of the surface is told by {outlines}: photographs see it, and it may be "
        f"hollow there. {limits.unseen_share:.1%} no photograph sees. The object's volume is no more than "
        f"{limits.volume_high:.5g}"
    )
    text += f", its area no less than {limits.area_low:.5g}.</p>" if limits.area_low else ".</p>"
    if limits.hollows:
        rows = [
            [("", f"{one.share:.1%}"), ("t", _place(one.at)), ("t", _direction(one.faces))] for one in limits.hollows
        ]
        head = [("", "of the surface"), ("t", "unseen about"), ("t", "looks towards")]
        text += table(head, rows[:_NUM_HOLLOWS])
    if limits.next_views:
        rows = [[("t", _place(one.place)), ("", f"{one.gain_share:.1%}")] for one in limits.next_views]
        head = [("t", "a photograph from here"), ("", "of the surface, unseen so far and turned to it")]
        text += table(head, rows)
    return text


def _place(at: Sequence[float]) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in at) + ")"


def _direction(way: Sequence[float]) -> str:
    # no minus before what rounds to nought
    return "(" + ", ".join(f"{round(value, 2) + 0.0:.2f}" for value in way) + ")"


def _slices(octree: Octree, mesh: Mesh) -> Iterator[str]:
    yield "<h2>Slices</h2><div class=trio>"
    low, high = mesh.xyz.min(axis=0), mesh.xyz.max(axis=0)
    for axis, at in enumerate((0.5 * (low + high)).tolist()):
        url = jpeg_url(slice_picture(octree, axis, at, (low, high)), _SHOWN_PX, 92)
        names = ["xyz"[(axis + n) % 3] for n in range(3)]
        caption = f"{names[0]} = {at:.4g}; {names[1]} to the right, {names[2]} up"
        yield f'<figure><img src="{url}" alt=""><figcaption>{caption}</figcaption></figure>'
    yield "</div><p class=dim>Cells wholly inside, large ones pale and small ones dark; black: at the surface.</p>"


def _levels(report: CarveReport) -> str:
    carving = report.carving
    head = [
        ("", name) for name in ("level", "side", "cells", "looked at", "full", "carved", "seen by too few", "split")
    ]
    rows = [
        [
            ("", level.level), ("", f"{level.side:.4g}"), ("", f"{8**level.level:,}"), ("", f"{level.looked_at:,}"),
            ("", f"{level.full:,}"), ("", f"{level.carved:,}"), ("", f"{level.unseen:,}"), ("", f"{level.split:,}"),
        ]
        for level in carving.levels
    ]  # fmt: skip
    return (
        f"<h2>How it was carved</h2><p>{carving.cells} cells along the side of the cube: {carving.share_of_dense:.2%} "
        f"of those of a dense grid were looked at, in {carving.num_questions:,} questions to a photograph.</p>"
        + table(head, rows)
    )
