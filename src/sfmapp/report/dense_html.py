"""Patches and meshes as a part of a page of HTML, or as a page of their own."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from sfmapp.dense.report import LevelReport, TwoViewsReport, WaveReport
from sfmapp.report.document import check_contradictions
from sfmapp.report.model import CoverageReport, DenseHistograms, DensePart, DenseRunReport
from sfmapp.report.page import check_table, failure_box, log_table, render_page, table, usage_table
from sfmapp.report.plots import Curve, bars_svg, plot_svg
from sfmapp.reporting import Step
from sfmapp.surface.report import MeshReport

if TYPE_CHECKING:
    from sfmapp.report.dense_pictures import PictureRow

MAX_IMAGES = 30
_BLUE, _GREY = "#4a7fd4", "#999"


def render_dense_html(report: DenseRunReport, pictures: Sequence[PictureRow]) -> str:
    """The page of a report on densification or meshing alone.

    Args:
        report: of the run.
        pictures: of :func:`~sfmapp.report.dense_pictures.dense_pictures`.
    """
    run = report.run
    facts = "; ".join([run.source, f"sfmapp {run.versions['sfmapp']}", run.started])
    body = [f'<p class="dim">{escape(facts)}</p>', failure_box(report.outcome)]
    made = report.stages.dense
    if made is not None and made.calibration is not None:
        body.append(f"<p>{escape(made.calibration.text)}</p>")
        body.append(check_table(check_contradictions(made.calibration.contradictions)))
    if report.dense is not None:
        body.append(dense_section(report.dense, pictures))
    body.append(usage_table(report.usage, run))
    body.append(log_table("Warnings", report.warnings) + log_table("Decisions", report.decisions))
    return render_page(f"sfmapp dense: {run.source}", body)


def dense_section(document: DensePart, pictures: Sequence[PictureRow]) -> str:
    """The dense part of a page: pictures, checks, how sure the patches are, what is bare, their growth, the mesh.

    Args:
        document: of :func:`~sfmapp.report.dense_document.dense_document`.
        pictures: of :func:`~sfmapp.report.dense_pictures.dense_pictures`.
    """
    mesh = document.mesh
    facts = [f"{document.num_patches} patches of {document.num_views} photographs"]
    facts += [f"a mesh of {mesh.num_faces} triangles"] if mesh else []
    parts = [f"<h2>Surface</h2><p>{' and '.join(facts)}</p>"]
    parts += [_picture_row(row, "row large" if k == 0 else "row") for k, row in enumerate(pictures)]
    parts += [check_table(document.checks), _histograms(document.histograms) if document.num_patches else ""]
    parts += [_images(document.images), _growth(document)]
    parts += [_mesh(mesh)] if mesh else []
    return "".join(parts)


def _picture_row(row: PictureRow, kind: str) -> str:
    figures = []
    for picture in row.pictures:
        source = "data:image/jpeg;base64," + base64.b64encode(picture.jpeg).decode()
        text = escape(picture.caption)
        figures.append(f'<figure><img src="{source}" alt="{text}"><figcaption>{text}</figcaption></figure>')
    return f'<h3>{escape(row.title)}</h3><div class="{kind}">{"".join(figures)}</div>'


def _histograms(histograms: DenseHistograms) -> str:
    shown = (
        (histograms.views, "Photographs that agree", "photographs"),
        (histograms.score, "Score: mean correlation", "score"),
        (histograms.sigma_px, "Deviation along the ray", "pixels of the photograph on the surface"),
    )
    parts = []
    for entry, title, label in shown:
        median = "" if entry.median is None else f", median {entry.median:.3g}"
        parts.append(f"<div><h3>{title}{median}</h3>{bars_svg(entry.edges, entry.counts, label)}</div>")
    note = "Numbers of patches; the outermost bars hold what lies beyond them as well."
    return f'<h2>How sure the patches are</h2><div class="row">{"".join(parts)}</div><p class="dim">{note}</p>'


def _images(images: Sequence[CoverageReport]) -> str:
    """Worst first: these are the ones to do something about."""
    head = [
        ("t", "photograph"), ("", "neighbours"), ("", "own patches"), ("", "patches seen"),
        ("", "covered"), ("", "not in others"), ("", "plain"), ("", "unmatched"), ("t", "what is missing, mostly"),
    ]  # fmt: skip
    rows = []
    for image in sorted(images, key=lambda row: row.coverage)[:MAX_IMAGES]:
        light = "green" if image.coverage >= 0.6 else "amber" if image.coverage >= 0.3 else "red"
        shares = [f"{100 * image[key]:.0f} %" for key in ("coverage", "out_of_sight", "plain", "unmatched")]
        counts = [image[key] for key in ("num_neighbors", "num_patches", "num_trusting")]
        cells = [("", value) for value in (*counts, *shares)]
        rows.append([(f"t {light}", image.name), *cells, ("w dim", image.reason)])
    more = len(images) - MAX_IMAGES
    note = f"<p class=dim>{more} that are covered better are in report.json</p>" if more > 0 else ""
    return "<h2>What of each photograph is covered</h2>" + table(head, rows) + note


def _growth(document: DensePart) -> str:
    parts = ["<h2>How the patches came about</h2>", _two_views(document.two_views)]
    parts += [_levels(document.levels), _waves(document.waves)]
    seeds = ", ".join(f"{count} from {_SEEDS.get(name, name)}" for name, count in document.seeds.items())
    parts.append(f"<p>Seeds of the finest level: {escape(seeds)}.</p>")
    parts.append(_funnel("What was taken away again", "patches", document.funnel[:-1], document.num_patches))
    return "".join(parts)


def _two_views(found: TwoViewsReport | None) -> str:
    if found is None:
        return ""
    shares = f"{100 * found.of_stereo_share:.0f}", f"{100 * found.of_growth_share:.0f}"
    first, second = ("stereo", "growth") if found.is_stereo_first else ("growth", "stereo")
    return (
        f"<p>Two photographs: {found.by_stereo} patches are by stereo, their disparities pixel by pixel, and "
        f"{found.by_growth} by growth, as below. Of what either covers stereo has {shares[0]} %, growth {shares[1]} %: "
        f"{first} was taken, and {second} where that left gaps.</p>"
    )


_SEEDS = {"carried": "the coarser level", "points": "sparse points", "corners": "corners matched along epipolar lines"}
_LEVEL_COLUMNS = (
    ("carried", "carried over"), ("points", "sparse points"), ("corners", "corners"), ("expanded", "expanded"),
    ("accepted", "accepted"), ("contradicted", "contradicted"), ("without_neighbours", "without neighbours"),
    ("in_small_groups", "in small groups"), ("patches", "patches"),
)  # fmt: skip


def _levels(levels: Iterable[LevelReport]) -> str:
    head = [("", "level"), *(("", label) for _, label in _LEVEL_COLUMNS), ("", "wall s"), ("", "CPU s")]
    rows = []
    for level in levels:
        counts = [("", level.get(key)) for key, _ in _LEVEL_COLUMNS]
        rows.append([("", level.level), *counts, ("", f"{level.wall_s:.2f}"), ("", f"{level.cpu_s:.2f}")])
    note = "Level 0 is the working resolution, each further one half of it; the coarsest is worked on first."
    return table(head, rows) + f'<p class="dim">{note}</p>'


def _waves(waves: Sequence[WaveReport]) -> str:
    if not waves:
        return ""
    number = np.array([wave.wave for wave in waves], np.float64)
    tried, accepted = (np.array([wave[key] for wave in waves], np.float64) for key in ("tried", "accepted"))
    curves = [Curve("tried", tried, _GREY), Curve("accepted", accepted, _BLUE)]
    return "<h3>Patches by wave</h3>" + plot_svg(number, curves, [], "wave")


def _mesh(mesh: MeshReport) -> str:
    poisson = mesh.poisson
    facts = [
        ("triangles", mesh.num_faces), ("vertices", mesh.num_vertices),
        ("edges at rims", mesh.num_rim_edges or "none: it is closed"), ("depth of the octree", mesh.depth),
        ("spacing of the patches, world units", f"{mesh.spacing:.4g}"),
        ("wall s, of it Poisson", f"{mesh.wall_s:.1f}, {poisson.wall_s:.1f}"),
        ("CPU s, of it Poisson", f"{mesh.cpu_s:.1f}, {poisson.cpu_s:.1f}"),
        ("peak memory of Poisson, MB", f"{poisson.peak_memory_mb or 0.0:.0f}"),
    ]  # fmt: skip
    rows = [[("t", name), ("", value)] for name, value in facts]
    steps = [[("t", step.name), ("", step.count)] for step in mesh.funnel]
    return (
        "<h2>Mesh</h2>" + table([("t", ""), ("", "")], rows)
        + "<h3>Triangles left after each step</h3>" + table([("t", "step"), ("", "triangles")], steps)
    )  # fmt: skip


def _funnel(title: str, what: str, steps: Sequence[Step], left: int) -> str:
    """The first step is what there was, the others what each took away."""
    rows = [[("t", step.name), ("", step.count if k == 0 else -step.count)] for k, step in enumerate(steps)]
    rows.append([("t", f"{what} left"), ("", left)])
    return f"<h3>{title}</h3>" + table([("t", "step"), ("", what)], rows)
