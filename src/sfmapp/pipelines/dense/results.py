"""The end of a dense run: cloud, maps, recording and report; and the beginning of one that finds everything done."""

from __future__ import annotations

import contextlib
import hashlib
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from sfmapp.dense.files import read_patches, write_fused_ply, write_patches
from sfmapp.dense.maps import write_maps
from sfmapp.dense.prepare import DensePlan, coarser_plan, load_scene
from sfmapp.dense.report import CloudNumbers, DensifyReport
from sfmapp.dense.scene import DenseScene, Patches
from sfmapp.errors import InputError
from sfmapp.formats.colmap import read_model
from sfmapp.pipelines.dense.source import DenseJob
from sfmapp.pipelines.sparse.videos import strips
from sfmapp.report.dense_document import dense_document
from sfmapp.report.dense_html import render_dense_html
from sfmapp.report.dense_pictures import PictureRow, dense_pictures
from sfmapp.report.html import render_html
from sfmapp.report.model import (
    DensePart,
    DenseReport,
    DenseRunReport,
    FailedReport,
    LogLine,
    MeshRunReport,
    ReconstructionReport,
    Stages,
)
from sfmapp.reporting import R, Step, document_text, from_plain
from sfmapp.scene.mesh import Mesh
from sfmapp.surface.report import MeshReport
from sfmapp.workspace.layout import DENSE, PAGE, REPORT
from sfmapp.workspace.manifest import raise_as_before

STAGE: Literal["dense"] = "dense"
MESH = "mesh"
FORMAT = "sfmapp dense report 2"
FUSED, PATCHES, MAPS, PARTS = "dense/fused.ply", "dense/patches.npz", "dense/maps", "dense/clusters"
RECORDING = "dense/recording.rrd"
# photographs in the recording and on the page
PICTURE_PX = 640
Document: TypeAlias = ReconstructionReport | DenseRunReport
# whose messages in the report of a workspace are ours to replace
_OWN_STAGES = frozenset((STAGE, "calibration", "views", "maps", "mesh", "texture", "recording"))


def earlier_dense(job: DenseJob, key: str, files: Sequence[str]) -> DenseReport | None:
    """What an earlier densification has said, if its files are there and still hold.

    Raises:
        AsBeforeError: it came to nothing, and nothing has changed.
    """
    document = _earlier_document(job, STAGE, key, files)
    found = document.stages.dense if document is not None else None
    return None if found is None else replace(found, run=job.took(is_up_to_date=True))


def earlier_mesh(job: DenseJob, key: str, files: Sequence[str]) -> MeshRunReport | None:
    """The same of meshing."""
    document = _earlier_document(job, MESH, key, files)
    found = document.stages.mesh if document is not None else None
    return replace(found, run=job.took(is_up_to_date=True)) if isinstance(found, MeshRunReport) else None


def _earlier_document(job: DenseJob, stage: str, key: str, files: Sequence[str]) -> Document | None:
    if not job.workspace.is_current(stage, key):
        return None
    raise_as_before(job.workspace.manifest.stage(stage))
    if not all((job.workspace.folder / name).is_file() for name in files):
        return None
    return _document(job)


class PartReport(DensifyReport):
    """What is told of a cluster of views.

    Attributes:
        texture: textured and open pixels of each of its views.
        num_points: sparse points that were tried.
    """

    texture: Sequence[tuple[int, int]]
    num_points: int


def write_part(job: DenseJob, plan: DensePlan, number: int, patches: Patches, row: PartReport) -> None:
    """Keep the patches of a cluster, and what is told of it, until the others are done or the run is resumed."""
    write_patches(job.workspace.folder / PARTS / f"{number}.npz", patches, plan.names)
    job.workspace.write_json(f"{PARTS}/{number}.json", row)


def read_part(job: DenseJob, plan: DensePlan, number: int) -> tuple[Patches, PartReport] | None:
    """What :func:`write_part` has kept; None if an earlier run has not come so far."""
    try:
        row = from_plain(PartReport, job.workspace.read_json(f"{PARTS}/{number}.json"))
        patches, names = read_patches(job.workspace.folder / PARTS / f"{number}.npz")
    except (InputError, ValueError):
        return None
    return (patches, row) if names == plan.names else None


def file_digest(path: Path) -> str:
    """Hash of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "blake2b").hexdigest()


def remove_parts(job: DenseJob) -> None:
    """All clusters are done: their files have served."""
    folder = job.workspace.folder / PARTS
    for path in folder.glob("*"):
        if path.stem.isdecimal() and path.suffix in (".npz", ".json"):
            path.unlink()
    with contextlib.suppress(OSError):  # something of the user's is in it
        folder.rmdir()


def write_cloud(job: DenseJob, plan: DensePlan, patches: Patches) -> None:
    """Write ``dense/fused.ply`` and ``dense/patches.npz``."""
    folder = job.workspace.folder
    with job.measured("output"):
        write_patches(folder / PATCHES, patches, plan.names)
        write_fused_ply(folder / FUSED, patches)


def remove_extras(job: DenseJob) -> None:
    """Take away maps and recording, which show other patches."""
    (job.workspace.folder / RECORDING).unlink(missing_ok=True)
    shutil.rmtree(job.workspace.folder / MAPS, ignore_errors=True)


def picture_scene(job: DenseJob, plan: DensePlan) -> DenseScene:
    """The views in the size of pictures."""
    with job.measured("pictures"):
        return load_scene(coarser_plan(plan, PICTURE_PX), threads=job.threads)


def write_extras(
    job: DenseJob, plan: DensePlan, patches: Patches, scene: DenseScene | None, *, maps: bool, record: bool
) -> None:  # fmt: skip
    """Write maps and recording where they are wanted and not there; ``scene``: of pictures, None to load it if need
    be."""
    folder = job.workspace.folder
    if maps and not (folder / MAPS).is_dir():
        with job.measured("maps"):
            write_maps(folder / MAPS, plan, patches, job.options.dense.cell_px, job.events)
    if record and not (folder / RECORDING).is_file():
        with job.measured("recording"):
            write_recording(job, scene or picture_scene(job, plan), patches)


def write_recording(job: DenseJob, scene: DenseScene, patches: Patches, mesh: Mesh | None = None) -> None:
    """Write ``dense/recording.rrd``; a failure is a warning."""
    from sfmapp.viewer.dense_recording import record_dense

    title = job.known.images.resolve().name
    report = record_dense(job.workspace.folder / RECORDING, scene, patches, mesh=mesh, title=title)
    if report.problem:
        job.events.raise_if_cancelled()  # a Ctrl-C in a terminal reaches the child as well
        job.events.warned("recording", f"no recording: {report.problem}")


def summary(patches: Patches) -> CloudNumbers:
    """Numbers about a cloud, for the report."""
    if not len(patches):
        return CloudNumbers(num_patches=0)
    return CloudNumbers(
        num_patches=len(patches),
        mean_views=float(patches.num_views.mean()),
        median_score=float(np.median(patches.score)),
        median_sigma=float(np.median(patches.sigma)),
        median_size=float(np.median(patches.size)),
    )


def summed(reports: Sequence[DensifyReport]) -> DensifyReport:
    """The reports of :func:`densify` on several clusters as one: counts and times added up."""
    levels = [_added([row for r in reports for row in r.levels if row.level == n], "level") for n in _levels(reports)]
    numbers = sorted({wave.wave for report in reports for wave in report.waves})
    waves = [_added([row for r in reports for row in r.waves if row.wave == n], "wave") for n in numbers]
    funnel: dict[str, int] = {}
    for step in (step for report in reports for step in report.funnel):
        funnel[step.name] = funnel.get(step.name, 0) + step.count
    return DensifyReport(
        num_patches=sum(report.num_patches for report in reports),
        levels=levels,
        waves=waves,
        seeds=_added([report.seeds for report in reports]),
        funnel=[Step(name=name, count=count) for name, count in funnel.items()],
        two_views=reports[0].two_views,
    )


def _levels(reports: Sequence[DensifyReport]) -> list[int]:
    """Their numbers, the coarsest first."""
    return sorted({level.level for report in reports for level in report.levels}, reverse=True)


def _added(rows: Sequence[R], key: str = "") -> R:
    """The sums of the fields of reports, but for one that is the same in all."""
    total, *others = rows
    for row in others:
        total = replace(total, **{k: round(total.get(k, 0) + v, 3) for k, v in row.items() if k != key})
    return total


def _document(job: DenseJob) -> Document | None:
    """The report of the workspace as it stands; None if there is none that can be read."""
    if job.known.command == DENSE:
        return job.workspace.read_report(DenseRunReport)
    return job.workspace.read_report(ReconstructionReport)


def finish(
    job: DenseJob,
    stage: Literal["dense", "mesh"],
    key: str,
    section: DenseReport | MeshRunReport | FailedReport,
    shown: tuple[DenseScene, Patches, Mesh | None] | None = None,
) -> None:
    """Write report and page, and mark the stage as done if it has begun.

    Args:
        job: at its end.
        stage: which.
        key: of it; empty if it has not begun.
        section: what is told of the stage.
        shown: views, patches and mesh, for the page; None if there are none.
    """
    _write_report(job, stage, section, shown)
    if key and job.workspace.has_key(stage, key):
        job.workspace.finish(stage, job.usage.get(stage), outcome=section.outcome)
        job.workspace.save()


def _write_report(
    job: DenseJob, stage: str, section: DenseReport | MeshRunReport | FailedReport,
    shown: tuple[DenseScene, Patches, Mesh | None] | None,
) -> None:  # fmt: skip
    """Add the stage to ``report.json``, beside what a reconstruction or an earlier stage has written, and the page."""
    workspace, old = job.workspace, _document(job)
    if old is None or isinstance(old, DenseRunReport):
        stages = Stages() if old is None else old.stages
        old = DenseRunReport(
            format=FORMAT, outcome=section.outcome, run=job.facts(), usage={} if old is None else old.usage,
            warnings=[] if old is None else old.warnings, decisions=[] if old is None else old.decisions,
            stages=stages, dense=None if old is None else old.dense,
        )  # fmt: skip
    document = replace(
        old, stages=_with(old.stages, section), usage={**old.usage, **job.usage},
        warnings=[*_of_others(old.warnings), *job.log.warnings],
        decisions=[*_of_others(old.decisions), *job.log.decisions],
    )  # fmt: skip
    pictures: list[PictureRow] = []
    if shown is not None:
        part, pictures = _dense_part(job, document.stages, *shown)
        document = replace(document, dense=part)
    elif stage == STAGE:
        document = replace(document, dense=None)
    workspace.write_text(REPORT, document_text(document))
    if isinstance(document, DenseRunReport):
        workspace.write_text(PAGE, render_dense_html(document, pictures))
    else:
        frames = strips(workspace.folder, document.stages.videos)
        workspace.write_text(PAGE, render_html(document, read_model(job.known.model)[0], pictures, frames))


def _with(stages: Stages, section: DenseReport | MeshRunReport | FailedReport) -> Stages:
    return replace(stages, dense=section) if isinstance(section, DenseReport) else replace(stages, mesh=section)


def _of_others(lines: Sequence[LogLine]) -> list[LogLine]:
    """Those of stages that are not ours to replace."""
    return [line for line in lines if line.stage not in _OWN_STAGES]


def _dense_part(
    job: DenseJob, stages: Stages, scene: DenseScene, patches: Patches, mesh: Mesh | None
) -> tuple[DensePart, list[PictureRow]]:
    options = job.options.dense
    assert stages.dense is not None
    mesh_report = None
    if mesh is not None and isinstance(stages.mesh, MeshRunReport):
        fields = MeshReport.__dataclass_fields__
        mesh_report = MeshReport(**{name: value for name, value in stages.mesh.items() if name in fields})
    document = dense_document(
        scene,
        patches,
        stages.dense,
        mesh_report,
        cell_px=options.cell_px,
        min_views=options.views_to_agree(len(scene.views)),
    )
    return document, dense_pictures(scene, patches, mesh, cell_px=options.cell_px)
