"""The end of a dense run: cloud, maps, recording and report; and the beginning of one that finds everything done."""

from __future__ import annotations

import contextlib
import hashlib
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sfmapp.dense.files import read_patches, write_fused_ply, write_patches
from sfmapp.dense.maps import write_maps
from sfmapp.dense.prepare import DensePlan, coarser_plan, load_scene
from sfmapp.dense.scene import DenseScene, Patches
from sfmapp.errors import InputError, NoReconstructionError
from sfmapp.formats.colmap import read_model
from sfmapp.pipelines.dense.source import DenseJob
from sfmapp.report.dense_document import dense_document
from sfmapp.report.dense_html import render_dense_html
from sfmapp.report.dense_pictures import PictureRow, dense_pictures
from sfmapp.report.html import render_html
from sfmapp.scene.mesh import Mesh
from sfmapp.workspace.layout import DENSE
from sfmapp.workspace.plain_json import report_text

STAGE = "dense"
FORMAT = "sfmapp dense report 1"
FUSED, PATCHES, MAPS, PARTS = "dense/fused.ply", "dense/patches.npz", "dense/maps", "dense/clusters"
RECORDING = "dense/recording.rrd"
# photographs in the recording and on the page
PICTURE_PX = 640
# whose messages in the report of a workspace are ours to replace
_OWN_STAGES = frozenset((STAGE, "views", "maps", "mesh", "texture", "recording"))


def earlier_report(job: DenseJob, stage: str, key: str, files: Sequence[str]) -> dict[str, Any] | None:
    """The report of an earlier run of a stage, if its files are there and still hold.

    Raises:
        NoReconstructionError: the earlier run ended so, and nothing has changed.
    """
    section = read_section(job, stage)
    if not job.workspace.is_current(stage, key) or section is None:
        return None
    outcome = section["outcome"]
    if outcome["exit_code"] == NoReconstructionError.exit_code:
        raise AsBeforeError(f"{outcome['message']} (as before: nothing has changed)", outcome["advice"])
    if not all((job.workspace.folder / name).is_file() for name in files):
        return None
    return section | {"is_up_to_date": True}


class AsBeforeError(NoReconstructionError):
    """An earlier run has ended so and written its report."""


def write_part(job: DenseJob, plan: DensePlan, number: int, patches: Patches, row: dict[str, Any]) -> None:
    """Keep the patches of a cluster, and what is told of it, until the others are done or the run is resumed."""
    write_patches(job.workspace.folder / PARTS / f"{number}.npz", patches, plan.names)
    job.workspace.write_json(f"{PARTS}/{number}.json", row)


def read_part(job: DenseJob, plan: DensePlan, number: int) -> tuple[Patches, dict[str, Any]] | None:
    """What :func:`write_part` has kept; None if an earlier run has not come so far."""
    row = job.workspace.read_json(f"{PARTS}/{number}.json")
    try:
        patches, names = read_patches(job.workspace.folder / PARTS / f"{number}.npz")
    except InputError:
        return None
    return (patches, row) if names == plan.names and isinstance(row, dict) else None


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


def summary(patches: Patches) -> dict[str, Any]:
    """Numbers about a cloud, for the report."""
    if not len(patches):
        return {"num_patches": 0}
    return {
        "num_patches": len(patches),
        "mean_views": float(patches.num_views.mean()),
        "median_score": float(np.median(patches.score)),
        "median_sigma": float(np.median(patches.sigma)),
        "median_size": float(np.median(patches.size)),
    }


def summed(reports: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The reports of :func:`densify` on several clusters as one: counts and times added up."""
    levels: dict[int, dict[str, Any]] = {}
    waves: dict[int, dict[str, Any]] = {}
    for report in reports:
        for key, rows, sums in (("level", report["levels"], levels), ("wave", report["waves"], waves)):
            for row in rows:
                into = sums.setdefault(row[key], {key: row[key]})
                into.update({k: round(into.get(k, 0) + v, 3) for k, v in row.items() if k != key})
    funnel: dict[str, int] = {}
    seeds: dict[str, int] = {}
    for report in reports:
        for entry in report["funnel"]:
            funnel[entry["name"]] = funnel.get(entry["name"], 0) + entry["count"]
        for name, count in report["seeds"].items():
            seeds[name] = seeds.get(name, 0) + count
    return {
        "levels": [levels[level] for level in sorted(levels, reverse=True)],
        "waves": [waves[wave] for wave in sorted(waves)],
        "funnel": [{"name": name, "count": count} for name, count in funnel.items()],
        "seeds": seeds,
    }


def read_section(job: DenseJob, stage: str) -> dict[str, Any] | None:
    """What ``report.json`` tells of a stage; None without."""
    document = job.workspace.read_json("report.json")
    section = document.get("stages", {}).get(stage) if isinstance(document, dict) else None
    return section if isinstance(section, dict) else None


def finish(
    job: DenseJob,
    stage: str,
    key: str,
    section: dict[str, Any],
    shown: tuple[DenseScene, Patches, Mesh | None] | None = None,
    failure: NoReconstructionError | None = None,
) -> dict[str, Any]:
    """Write report and page, and mark the stage as done if it has begun; returns its section of the report.

    Args:
        job: at its end.
        stage: ``dense`` or ``mesh``.
        key: of it; empty if it has not begun.
        section: what is told of the stage.
        shown: views, patches and mesh, for the page; None if there are none.
        failure: why there are none.
    """
    outcome = {
        "exit_code": failure.exit_code if failure else 0,
        "message": str(failure) if failure else "",
        "advice": failure.advice if failure else None,
    }
    section = {"outcome": outcome} | section | {"run": job.watch.read()}
    _write_report(job, stage, section, outcome, shown)
    if key and job.workspace.has_key(stage, key):
        job.workspace.finish(stage, job.usage.get(stage, {}))
        job.workspace.save()
    return section


def _write_report(
    job: DenseJob, stage: str, section: dict[str, Any], outcome: dict[str, Any],
    shown: tuple[DenseScene, Patches, Mesh | None] | None,
) -> None:  # fmt: skip
    """Add the stage to ``report.json``, beside what a reconstruction or an earlier stage has written, and the page."""
    workspace = job.workspace
    old = workspace.read_json("report.json")
    document: dict[str, Any] = old if isinstance(old, dict) else {}
    if job.known.command == DENSE:
        document = {"format": FORMAT} | document | {"outcome": outcome, "run": job.facts()}
    document["stages"] = document.get("stages", {}) | {stage: section}
    document["usage"] = document.get("usage", {}) | job.usage
    for kind, new in (("warnings", job.log.warnings), ("decisions", job.log.decisions)):
        kept = [entry for entry in document.get(kind, []) if entry["stage"] not in _OWN_STAGES]
        document[kind] = kept + new
    pictures: list[PictureRow] = []
    if shown is not None:
        document["dense"], pictures = _dense_part(job, document["stages"], *shown)
    elif stage == STAGE:
        document["dense"] = None
    workspace.write_text("report.json", report_text(document))
    if job.known.command == DENSE:
        workspace.write_text("report.html", render_dense_html(document, pictures))
    elif "models" in document:
        model = read_model(job.known.model)[0]
        workspace.write_text("report.html", render_html(document, model, pictures))


def _dense_part(
    job: DenseJob, stages: Mapping[str, Any], scene: DenseScene, patches: Patches, mesh: Mesh | None
) -> tuple[dict[str, Any], list[PictureRow]]:
    options = job.options.dense
    mesh_report = stages["mesh"] if mesh is not None else None
    document = dense_document(
        scene, patches, stages[STAGE], mesh_report, cell_px=options.cell_px, min_views=options.min_views
    )
    return document, dense_pictures(scene, patches, mesh, cell_px=options.cell_px)
