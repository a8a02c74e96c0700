"""What a surface looks like, in the report of the workspace: a page of its own, or a part of a reconstruction's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sfmapp.dense.prepare import DensePlan, coarser_plan, load_scene
from sfmapp.dense.scene import Patches
from sfmapp.pipelines.dense_results import PICTURE_PX
from sfmapp.pipelines.dense_source import DenseJob
from sfmapp.pipelines.workspace import DENSE
from sfmapp.report.dense_document import dense_document
from sfmapp.report.dense_html import render_dense_html
from sfmapp.report.dense_pictures import PictureRow, dense_pictures
from sfmapp.report.html import render_html
from sfmapp.scene.mesh import Mesh


def look_at(
    job: DenseJob, plan: DensePlan, patches: Patches, clusters: Sequence[dict[str, Any]], mesh: Mesh | None = None
) -> tuple[dict[str, Any], list[PictureRow]]:
    """What the report says of patches, from the reports of their clusters, and the pictures of them and their mesh."""
    options = job.options.dense
    with job.measured("report"):
        scene = load_scene(coarser_plan(plan, PICTURE_PX), threads=job.threads)
        document = dense_document(scene, patches, clusters, cell_px=options.cell_px, min_views=options.min_views)
        return document, dense_pictures(scene, patches, mesh, cell_px=options.cell_px)


def write_page(job: DenseJob, pictures: Sequence[PictureRow]) -> None:
    """Write ``report.html`` from what ``report.json`` has come to say."""
    report = job.workspace.read_json("report.json")
    assert isinstance(report, dict)
    if job.known.command == DENSE:
        page = render_dense_html(report, pictures)
    else:
        from sfmapp.formats.colmap import read_model

        page = render_html(report, read_model(job.known.model)[0] if report["models"] else None, pictures)
    job.workspace.write_text("report.html", page)
