"""A carved volume joined with what colours of the photographs say of its hollows."""

from __future__ import annotations

import numpy as np

from sfmapp.carve.box import Box
from sfmapp.carve.files import read_sights, write_sights
from sfmapp.carve.joined import Evidence, JoinOptions
from sfmapp.carve.octree import Octree
from sfmapp.carve.sight import Sight
from sfmapp.carve.swept_sights import SightsReport, sights_by_colors
from sfmapp.errors import InputError
from sfmapp.pipelines.carve.joining import Joining, Photographs, join_in_box
from sfmapp.pipelines.carve.outputs import SEEING, SIGHTS, earlier
from sfmapp.pipelines.carve.sources import CarveSource
from sfmapp.pipelines.carve.undistorted import undistorted
from sfmapp.reporting import from_plain
from sfmapp.workspace.job import Job
from sfmapp.workspace.keys import stage_key
from sfmapp.workspace.layout import CARVE

STAGE = "sights"
# of colours, mask, the four maps of a sweep, and those of a sight
_PIXEL_BYTES = 36.0
# a photograph that is finer than so many pixels for a cell says no more
_PIXELS_A_CELL = 2.0
# Depths of plain surfaces are not told, and the least surface there cuts off what is the object's: it looked worse than
# the hull. Against the hull, which counts as one sight where photographs see it, it takes two that agree.
# They are seldom many, and more is said behind them than behind patches.
JOIN = JoinOptions(keep=1.0, back=2.0)


def join_colors(
    job: Job, source: CarveSource, photographs: Photographs, octree: Octree, box: Box
) -> tuple[Joining, SightsReport]:
    """The volume that silhouettes and colours leave together, in the cube and the cells of the hull's octree, what
    is in the box if that is a user's.

    Raises:
        InputError: cameras are matrices.
        NoReconstructionError: colours tell nothing, or see through all of the hull.
    """
    if all(view.camera is None for view in source.views):
        raise InputError(
            "--colors: expected cameras with a lens and a pose, found projection matrices",
            "carve by silhouettes, or give poses and a lens",
        )
    sights, report = _sights(job, source, photographs, octree)
    with job.stage("join"):
        evidence = Evidence(photographs.views, photographs.silhouettes, photographs.hull, sights)
        joined, joining = join_in_box(job, evidence, octree, box, JOIN)
    return Joining(joined, joining, evidence, octree), report


def _sights(
    job: Job, source: CarveSource, photographs: Photographs, octree: Octree
) -> tuple[list[Sight], SightsReport]:  # fmt: skip
    """What colours tell, swept as finely as cells are; that of an earlier call with the same volume."""
    # the octree's own key tells the photographs, their cameras and silhouettes
    key = stage_key((__name__,), None, job.options.dense.max_memory_mb, job.workspace.manifest.stage(CARVE).key)
    path = job.workspace.folder / SIGHTS

    def read() -> tuple[list[Sight], SightsReport]:
        return read_sights(path), from_plain(SightsReport, job.workspace.read_json(SEEING))

    found = earlier(job, STAGE, key, read, "colours were looked at by an earlier call")
    if found is not None:
        return found
    surface = octree.centers(octree.surface)
    posed = [(view, view.camera) for view in source.views if view.camera is not None]
    away = [np.linalg.norm(view.center - surface.mean(axis=0)) for view, _ in posed]
    pixels = [octree.cell * camera.k_matrix[0, 0] / d for (_, camera), d in zip(posed, away, strict=True)]
    shrink = float(np.median(pixels)) / _PIXELS_A_CELL
    with job.stage(STAGE, key):
        views = undistorted(job, source, _PIXEL_BYTES, photographs.silhouettes, shrink=max(1.0, shrink))
        sights, report = sights_by_colors(views, surface, job.events, threads=job.threads)
        write_sights(path, sights)
        job.workspace.write_json(SEEING, report)
    job.workspace.save()  # a call that is stopped from here on need not look again
    return sights, report
