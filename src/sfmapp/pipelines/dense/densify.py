"""A model and its photographs to dense patches, on a page.

:func:`dense` opens the workspace and sees to it that every end is a clean one; :func:`_run` is the job.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from sfmapp.dense import outcome
from sfmapp.dense.clusters import Cluster, make_clusters, merge_clusters
from sfmapp.dense.files import read_patches
from sfmapp.dense.prepare import DensePlan
from sfmapp.dense.report import ClusterReport
from sfmapp.dense.scene import Patches
from sfmapp.errors import NoReconstructionError
from sfmapp.events import Events
from sfmapp.pipelines.dense import results as dense_results
from sfmapp.pipelines.dense.parts import densify_clusters
from sfmapp.pipelines.dense.results import STAGE
from sfmapp.pipelines.dense.source import DenseJob, calibrate_source, dense_job, find_source, model_digest, plan_source
from sfmapp.report.model import DenseReport, Outcome
from sfmapp.workspace.kernels import compile_dense_kernels
from sfmapp.workspace.keys import input_key, stage_key
from sfmapp.workspace.manifest import AsBeforeError
from sfmapp.workspace.options import Options, with_absolute_paths
from sfmapp.workspace.usage import Stopwatch


class DenseResult(NamedTuple):
    """The patches, the names of the images that they count, and the report of it: ``dense`` of ``report.json``.

    ``output``: the workspace.
    """

    patches: Patches
    image_names: tuple[str, ...]
    report: DenseReport
    output: Path


def dense(
    source: str | os.PathLike[str],
    output: str | os.PathLike[str] | None = None,
    options: Options | None = None,
    *,
    images: str | os.PathLike[str] | None = None,
    maps: bool = False,
    record: bool = True,
    events: Events | None = None,
    watch: Stopwatch | None = None,
) -> DenseResult:
    """Reconstruct oriented patches all over the surfaces that the photographs of a model show.

    What an earlier run in the same workspace has done is used where it still holds.

    Args:
        source: a workspace, or the folder of a COLMAP model.
        output: workspace of the results; None: ``source`` itself, or the folder ``sfmapp`` of a COLMAP model.
        options: ``dense`` and, for masks, ``images`` count here. ``images.camera``, a calibration, replaces the cameras
            of the model, whose poses and points are adjusted to it; the model that comes of it is in the workspace.
        images: folder of the photographs; None: as noted in the workspace, or where COLMAP has them.
        maps: write depth and normal maps of every view as well.
        record: write ``dense/recording.rrd``, the patches growing wave by wave.
        events: listens in, and can ask the run to stop.
        watch: started earlier, if more is to be counted in the report than this call.

    Raises:
        UsageError: the output folder holds something else.
        InputError: no model, or too few of its photographs are there.
        NoReconstructionError: hardly a patch was found; the report and what there is are written.
        InterruptedRunError: ``events`` was asked to stop; the same call resumes.
    """
    where = find_source(source, output, images, with_absolute_paths(options or Options()))
    with dense_job(where, events, watch) as job:
        return _run(job, maps=maps, record=record)


def _run(job: DenseJob, *, maps: bool, record: bool) -> DenseResult:
    """The job: views, what still holds of an earlier run, patches, and the report of it all."""
    report = DenseReport(outcome=Outcome.of(None), run=job.took())
    key = ""
    try:
        with job.stage("views"):
            report = replace(report, calibration=calibrate_source(job))
            plan, views = plan_source(job)
            report = replace(report, views=views)
        clusters = make_clusters(plan, job.options.dense.cell_px, job.options.dense.max_memory_mb)
        key = _key(job, plan, clusters)
        files = (dense_results.FUSED, dense_results.PATCHES)
        if (earlier := dense_results.earlier_dense(job, key, files)) is not None:
            patches, _ = read_patches(job.workspace.folder / dense_results.PATCHES)
            dense_results.write_extras(job, plan, patches, None, maps=maps, record=record)
            return DenseResult(patches, plan.names, earlier, job.workspace.folder)
        is_resumed = job.workspace.has_key(STAGE, key)
        job.note_source()
        job.workspace.begin(STAGE, key, model=model_digest(job.known.model))
        with job.measured("kernels"):
            compile_dense_kernels(job.events)
        patches, report = _densify(job, plan, clusters, report, is_resumed)
        dense_results.write_cloud(job, plan, patches)
        assert report.shares is not None
        if warning := outcome.check(patches, report.shares, plan, job.options.dense.views_to_agree(len(plan.records))):
            job.events.warned(STAGE, warning)
    except AsBeforeError:
        raise
    except NoReconstructionError as failure:
        job.note_source()
        dense_results.finish(job, STAGE, key, replace(report, outcome=Outcome.of(failure), run=job.took()))
        raise
    scene = dense_results.picture_scene(job, plan)
    dense_results.remove_extras(job)
    dense_results.write_extras(job, plan, patches, scene, maps=maps, record=record)
    report = replace(report, run=job.took())
    dense_results.finish(job, STAGE, key, report, (scene, patches, None))
    return DenseResult(patches, plan.names, report, job.workspace.folder)


def _key(job: DenseJob, plan: DensePlan, clusters: Sequence[Cluster]) -> str:
    """Of the patches: model, photographs and masks, options, our code; and the clusters, which is all that follows
    from how much memory there may be."""
    inputs = [[record.name, record.turn, input_key(record)] for record in plan.records]
    cores = [cluster.core.tolist() for cluster in clusters]
    return stage_key((__name__,), job.options.dense, model_digest(job.known.model), inputs, cores)


def _densify(
    job: DenseJob, plan: DensePlan, clusters: list[Cluster], report: DenseReport, is_resumed: bool
) -> tuple[Patches, DenseReport]:
    """Patches of all clusters, within the region, and the report with what came of it."""
    options = job.options.dense
    if len(clusters) > 1:
        sizes = [len(cluster.core) for cluster in clusters]
        job.events.decided(
            STAGE, f"{len(plan.records)} views in {len(clusters)} clusters to stay below {options.max_memory_mb} MB",
            sizes=sizes, memory_mb=[round(cluster.memory_mb) for cluster in clusters],
        )  # fmt: skip
    done: dict[int, tuple[Patches, dense_results.PartReport]] = {}
    if is_resumed and len(clusters) > 1:
        found = ((number, dense_results.read_part(job, plan, number)) for number in range(len(clusters)))
        done = {number: part for number, part in found if part is not None}
    known = set(done)
    with job.stage(STAGE):
        ahead = [number for number in range(len(clusters)) if number not in known]
        for number, part, row in densify_clusters(job, plan, clusters, ahead):
            if len(clusters) > 1:
                dense_results.write_part(job, plan, number, part, row)
            done[number] = part, row
        parts = [done[number][0] for number in range(len(clusters))]
        rows = [done[number][1] for number in range(len(clusters))]
        told = [
            ClusterReport(
                views=[plan.names[m] for m in cluster.core], num_patches=len(parts[number]),
                is_resumed=number in known,
            )
            for number, cluster in enumerate(clusters)
        ]  # fmt: skip
        patches = merge_clusters(plan, options.cell_px, parts) if len(parts) > 1 else parts[0]
        if plan.region is not None:
            patches = patches.subset(plan.region.holds(patches.xyz))
    dense_results.remove_parts(job)
    total = dense_results.summed(rows)
    # noise drowns points in the finest images; in one of the sizes they hold up if the poses are right
    points = max(level.points for level in total.levels), rows[0].num_points
    if len(rows) > 1:  # there they are not told from those of the views around
        points = 0, 0
    texture = [counts for row in rows for counts in row.texture]
    shares = outcome.judge(patches, texture, points, options.cell_px)
    return patches, replace(
        report, clusters=told, levels=total.levels, waves=total.waves, funnel=total.funnel, seeds=total.seeds,
        two_views=total.two_views, shares=shares, **dense_results.summary(patches),
    )  # fmt: skip
