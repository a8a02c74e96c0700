"""The end of a dense run: cloud, maps, recording and report; and the beginning of one that finds everything done."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from sfmapp.dense.files import write_fused_ply, write_patches
from sfmapp.dense.maps import write_maps
from sfmapp.dense.prepare import DensePlan, coarser_plan, load_scene
from sfmapp.dense.scene import Patches
from sfmapp.errors import NoReconstructionError
from sfmapp.pipelines.dense_source import DenseJob, model_digest
from sfmapp.pipelines.keys import input_key
from sfmapp.pipelines.options import options_to_dict
from sfmapp.pipelines.results import report_text
from sfmapp.pipelines.workspace import DENSE, stage_key
from sfmapp.scene.mesh import Mesh

STAGE = "dense"
FORMAT = "sfmapp dense report 1"
FUSED, PATCHES, MAPS, PARTS = "dense/fused.ply", "dense/patches.npz", "dense/maps", "dense/clusters"
RECORDING = "dense/recording.rrd"
AS_BEFORE = " (as before: nothing has changed)"
# photographs in a recording
PICTURE_PX = 640


def dense_key(job: DenseJob, plan: DensePlan) -> str:
    """Of the patches: model, photographs and masks, options, our code."""
    inputs = [[record.name, record.orientation, input_key(record)] for record in plan.records]
    packages = ("dense", "images", "geometry", "scene")
    return stage_key(packages, options_to_dict(job.options.dense), model_digest(job.known.model), inputs)


def earlier_report(job: DenseJob, key: str) -> dict[str, Any] | None:
    """The report of an earlier run, if its cloud is there and still holds.

    Raises:
        NoReconstructionError: the earlier run ended so, and nothing has changed.
    """
    workspace = job.workspace
    section = (workspace.read_json("report.json") or {}).get(STAGE)
    if not workspace.is_current(STAGE, key) or not isinstance(section, dict):
        return None
    outcome = section["outcome"]
    if outcome["exit_code"] == NoReconstructionError.exit_code:
        raise NoReconstructionError(f"{outcome['message'].removesuffix(AS_BEFORE)}{AS_BEFORE}", outcome["advice"])
    if not all((workspace.folder / name).is_file() for name in (FUSED, PATCHES)):
        return None
    return section | {"is_up_to_date": True}


def part_path(job: DenseJob, number: int) -> Path:
    """Where the patches of a cluster wait for the others."""
    return job.workspace.folder / PARTS / f"{number}.npz"


def remove_parts(job: DenseJob) -> None:
    """All clusters are done: their files have served."""
    folder = job.workspace.folder / PARTS
    for path in folder.glob("*.npz"):
        if path.stem.isdecimal():
            path.unlink()
    with contextlib.suppress(OSError):  # something of the user's is in it
        folder.rmdir()


def write_cloud(job: DenseJob, plan: DensePlan, patches: Patches) -> None:
    """Write ``dense/fused.ply`` and ``dense/patches.npz``."""
    folder = job.workspace.folder
    with job.measured("output"):
        write_patches(folder / PATCHES, patches, plan.names)
        write_fused_ply(folder / FUSED, patches)


def write_extras(
    job: DenseJob, plan: DensePlan, patches: Patches, *, maps: bool, record: bool, is_new: bool
) -> None:  # fmt: skip
    """Write maps and recording where they are wanted, and take away those that show other patches."""
    folder = job.workspace.folder
    if is_new:
        (folder / RECORDING).unlink(missing_ok=True)
        shutil.rmtree(folder / MAPS, ignore_errors=True)
    if maps and not (folder / MAPS).is_dir():
        with job.measured("maps"):
            write_maps(folder / MAPS, plan, patches, job.options.dense.cell_px, job.events)
    if record and not (folder / RECORDING).is_file():
        with job.measured("recording"):
            write_recording(job, plan, patches)


def write_recording(job: DenseJob, plan: DensePlan, patches: Patches, mesh: Mesh | None = None) -> None:
    """Write ``dense/recording.rrd``; a failure is a warning."""
    from sfmapp.viewer.dense_recording import record_dense

    scene = load_scene(coarser_plan(plan, PICTURE_PX), threads=job.threads)
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


def finish(
    job: DenseJob, key: str, report: dict[str, Any], failure: NoReconstructionError | None = None
) -> dict[str, Any]:
    """Write the report and mark the stage as done, if it has begun; returns its section."""
    if not key or failure is not None:
        job.note_source()
    section = write_section(job, STAGE, report, failure)
    if key and job.workspace.has_key(STAGE, key):
        job.workspace.finish(STAGE, job.usage.get(STAGE, {}))
        job.workspace.save()
    return section


def write_section(
    job: DenseJob, name: str, report: dict[str, Any], failure: NoReconstructionError | None = None
) -> dict[str, Any]:
    """Put what came of a stage into ``report.json`` beside what is there; returns it."""
    outcome = {
        "exit_code": failure.exit_code if failure else 0,
        "message": str(failure) if failure else "",
        "advice": failure.advice if failure else None,
    }
    usage = dict(job.usage)
    told = {"warnings": job.log.warnings, "decisions": job.log.decisions}
    section = {"outcome": outcome} | report | {"usage": usage, "run": job.watch.read()} | told
    document = job.workspace.read_json("report.json")
    document = document if isinstance(document, dict) else {}
    if job.known.command == DENSE:
        document = {"format": FORMAT} | document | {"outcome": outcome, "run": job.facts()}
    document[name] = section
    job.workspace.write_text("report.json", report_text(document))
    return section
