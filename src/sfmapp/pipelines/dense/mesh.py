"""Dense patches to a mesh, on a page: those of a workspace, or a cloud of oriented points in a PLY file."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.files import read_patches
from sfmapp.dense.prepare import DensePlan, coarser_plan, load_scene
from sfmapp.errors import InputError, NoReconstructionError, UsageError
from sfmapp.events import Events
from sfmapp.formats.glb import write_glb
from sfmapp.formats.mesh_ply import write_mesh_ply
from sfmapp.formats.ply_reader import read_ply_geometry
from sfmapp.geometry.upright import up_direction
from sfmapp.pipelines.dense import results as dense_results
from sfmapp.pipelines.dense.source import DenseJob, dense_job, find_source, model_digest, plan_source
from sfmapp.pipelines.stored_pixels import has_stored_pixels
from sfmapp.report.model import FailedReport, MeshRunReport, Outcome, RunUsage
from sfmapp.scene.mesh import Mesh
from sfmapp.surface.mesh import make_mesh
from sfmapp.surface.report import TextureReport
from sfmapp.surface.texture import texture_mesh
from sfmapp.workspace.keys import stage_key
from sfmapp.workspace.manifest import read_manifest
from sfmapp.workspace.options import Options, options_from_dict, with_absolute_paths
from sfmapp.workspace.usage import Stopwatch

STAGE: Literal["mesh"] = "mesh"
MESH_PLY, MESH_GLB = "mesh/mesh.ply", "mesh/mesh.glb"
# what a pixel measures at the points of a PLY, which does not say: so much of the way to the nearest ones
_NUM_NEAREST = 4
# of surfaces whose points have no colour
_GREY = 192


class MeshResult(NamedTuple):
    """The mesh, None where that of an earlier run holds; and the report of it."""

    mesh: Mesh | None
    report: MeshRunReport


def mesh_workspace(
    source: str | os.PathLike[str],
    options: Options | None = None,
    *,
    record: bool = True,
    events: Events | None = None,
    watch: Stopwatch | None = None,
) -> MeshResult:
    """Make a mesh of the patches of a workspace: ``mesh/mesh.ply`` and ``mesh/mesh.glb`` in it.

    Args:
        source: workspace in which ``sfmapp dense`` has been at work.
        options: ``surface`` counts here.
        record: show the mesh in ``dense/recording.rrd``.
        events: listens in, and can ask the run to stop.
        watch: started earlier, if more is to be counted in the report than this call.

    Raises:
        InputError: no patches, or the photographs are gone.
        NoReconstructionError: they hold no surface; the report is written.
        InterruptedRunError: ``events`` was asked to stop.
    """
    folder = Path(source)
    manifest = read_manifest(folder)
    if not (folder / dense_results.PATCHES).is_file():
        raise InputError(f"{folder} holds no patches to make a mesh of", f"run first: sfmapp dense {folder}")
    options = with_absolute_paths(options or Options())
    # the views are those that the patches were made of, whatever is said of them now
    earlier = options_from_dict({"dense": manifest.options.get("dense", {})})
    options = replace(options, dense=earlier.dense)
    with dense_job(find_source(folder, None, None, options), events, watch) as job:
        return _run(job, record)


def _run(job: DenseJob, record: bool) -> MeshResult:
    folder = job.workspace.folder
    digest = dense_results.file_digest(folder / dense_results.PATCHES)
    key = stage_key((__name__,), job.options.surface, digest)
    if (earlier := dense_results.earlier_mesh(job, key, (MESH_PLY, MESH_GLB))) is not None:
        return MeshResult(None, earlier)
    patches, names = read_patches(folder / dense_results.PATCHES)
    with job.stage("views"):
        plan, _ = plan_source(job)
    made_of = job.workspace.manifest.stage(dense_results.STAGE).model
    # earlier versions noted no model, and turned photographs that this one takes as they are stored
    is_other = (
        has_stored_pixels(job.workspace.manifest) if made_of is None else made_of != model_digest(job.known.model)
    )
    if is_other:
        raise InputError(
            f"{folder}: expected patches of its model, found those of an earlier one: it was reconstructed again",
            f"run again: sfmapp dense {folder}",
        )
    if plan.names != names:
        raise InputError(
            f"{folder}: the patches are of {len(names)} photographs, the model now has {len(plan.names)} others",
            f"run again: sfmapp dense {folder}",
        )
    job.note_source()
    job.workspace.begin(STAGE, key)
    try:
        with job.stage(STAGE):
            scene = dense_results.picture_scene(job, plan)
            mesh, report = make_mesh(
                patches.xyz, patches.normal, patches.rgb, patches.size, scene, job.options.surface,
                threads=job.threads, events=job.events,
            )  # fmt: skip
            if job.options.surface.texture:
                mesh, texture = _textured(job, plan, mesh)
                report = replace(report, texture=texture)
    except NoReconstructionError as failure:
        failed = FailedReport(outcome=Outcome.of(failure), run=job.took())
        dense_results.finish(job, STAGE, key, failed, (scene, patches, None))
        raise
    is_z_up = bool(up_direction(scene.upright_cam_from_world)[2] > np.sqrt(0.5))
    with job.measured("output"):
        write_mesh_ply(folder / MESH_PLY, mesh)
        write_glb(folder / MESH_GLB, mesh, is_z_up=is_z_up)
    if record:
        with job.measured("recording"):
            dense_results.write_recording(job, scene, patches, mesh)
    section = MeshRunReport(**report, outcome=Outcome.of(None), run=job.took())
    dense_results.finish(job, STAGE, key, section, (scene, patches, mesh))
    return MeshResult(mesh, section)


def _textured(job: DenseJob, plan: DensePlan, mesh: Mesh) -> tuple[Mesh, TextureReport]:
    """With the photographs at working resolution, or as finely as fits into memory."""
    num_bytes = 3.0 * float(plan.num_pixels.sum())
    shrink = max(1.0, np.sqrt(num_bytes / (0.5e6 * job.options.dense.max_memory_mb)))
    longest = max(max(canvas.working_size) for canvas in plan.canvases)
    scene = load_scene(coarser_plan(plan, int(longest / shrink)), threads=job.threads, events=job.events)
    return texture_mesh(mesh, scene, job.options.surface, events=job.events)


def mesh_cloud(
    cloud: str | os.PathLike[str], output: str | os.PathLike[str], options: Options | None = None, *,
    events: Events | None = None, watch: Stopwatch | None = None,
) -> MeshResult:  # fmt: skip
    """Make a mesh of a cloud of oriented points: ``mesh/mesh.ply`` and ``mesh/mesh.glb`` in a folder.

    Args:
        cloud: PLY of points with normals, such as ``dense/fused.ply``; without colours the mesh is grey.
        output: the folder; made if need be.
        options: ``surface`` and ``threads`` count here.
        events: listens in, and can ask the run to stop.
        watch: started earlier, if more is to be counted in the report than this call.

    Raises:
        UsageError: a texture is asked for, which needs photographs.
        InputError: not such a file.
        NoReconstructionError: the points hold no surface.
        InterruptedRunError: ``events`` was asked to stop.
    """
    options = options or Options()
    if options.surface.texture:
        raise UsageError("a texture needs the photographs, which a PLY does not hold", "give the workspace instead")
    events, watch = events or Events(), watch or Stopwatch()
    xyz, normal, rgb = _oriented_points(Path(cloud), events)
    threads = options.num_workers
    size = _sizes(xyz, threads)
    _check_precision(Path(cloud), xyz, float(np.median(size)), events)
    mesh, report = make_mesh(xyz, normal, rgb, size, None, options.surface, threads=threads, events=events)
    folder = Path(output)
    write_mesh_ply(folder / MESH_PLY, mesh)
    write_glb(folder / MESH_GLB, mesh)
    return MeshResult(mesh, MeshRunReport(**report, outcome=Outcome.of(None), run=RunUsage(**watch.read())))


def _oriented_points(path: Path, events: Events) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.uint8]]:
    """Places (N, 3), unit normals (N, 3) and colours (N, 3) of the points of a PLY that have a place and a normal."""
    advice = "compute oriented normals first, for example in CloudCompare, MeshLab or Open3D"
    points = read_ply_geometry(path)
    if points.normal is None:
        raise InputError(f"{path}: expected points with normals nx, ny and nz, found none", advice)
    length = np.linalg.norm(points.normal.astype(np.float64), axis=1)
    has_normal = np.isfinite(length) & (length > 0.0)
    usable = points.is_finite & has_normal
    for left_out, why in ((~points.is_finite, "a place that is not finite"), (~has_normal, "no normal (zero or NaN)")):
        if left_out.any():
            events.warned(STAGE, f"{path}: {int(left_out.sum())} of {len(usable)} points have {why}, they are left out")
    if not usable.any():
        raise InputError(f"{path}: expected points with places and normals, found none among {len(usable)}", advice)
    if points.rgb is None:
        events.decided(STAGE, f"{path} has no colours: the mesh is grey")
        rgb = np.full(points.xyz.shape, _GREY, np.uint8)
    else:
        rgb = points.rgb
    normal = (points.normal[usable] / length[usable, None]).astype(np.float32)
    return points.xyz[usable], normal, rgb[usable]


def _check_precision(path: Path, xyz: NDArray[np.float64], spacing: float, events: Events) -> None:
    """Warn of coordinates that have lost what lies between the points, as georeferenced ones do in single precision."""
    step = float(np.spacing(np.float32(np.abs(xyz).max())))
    if step > 0.25 * spacing and (xyz == xyz.astype(np.float32)).all():
        events.warned(
            STAGE,
            f"{path}: the points lie about {spacing:.3g} apart, but coordinates so far from 0 are {step:.3g} apart in "
            "single precision: write them as double, or move them to the origin first",
        )


def _sizes(xyz: NDArray[np.float64], threads: int) -> NDArray[np.float32]:
    """(N,) how far apart points are around each, evened out over its neighbours."""
    from scipy.spatial import cKDTree

    if len(xyz) <= _NUM_NEAREST:
        raise NoReconstructionError(f"expected points of a surface, found {len(xyz)}")
    distance, idx = cKDTree(xyz).query(xyz, k=_NUM_NEAREST + 1, workers=threads)
    own = distance[:, 1:].mean(axis=1)
    return np.asarray(np.maximum(np.median(own[idx], axis=1), 1e-30), np.float32)
