"""A carved volume joined with what colours of the photographs say of its hollows."""

from __future__ import annotations

import numpy as np

from sfmapp.carve.box import Box
from sfmapp.carve.joined import Evidence, JoinOptions
from sfmapp.carve.octree import Octree
from sfmapp.carve.swept_sights import SightsReport, sights_by_colors
from sfmapp.errors import InputError
from sfmapp.pipelines.carve.joining import Joining, Photographs, join_in_box
from sfmapp.pipelines.carve.sources import CarveSource
from sfmapp.pipelines.carve.undistorted import undistorted
from sfmapp.workspace.job import Job

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
    cameras = [view.camera for view in source.views if view.camera is not None]
    if not cameras:
        raise InputError(
            "--colors: expected cameras with a lens and a pose, found projection matrices",
            "carve by silhouettes, or give poses and a lens",
        )
    surface = octree.centers(octree.surface)
    away = [np.linalg.norm(view.center - surface.mean(axis=0)) for view in source.views if view.camera is not None]
    pixels = [octree.cell * camera.k_matrix[0, 0] / d for camera, d in zip(cameras, away, strict=True)]
    with job.stage("sights"):
        shrink = float(np.median(pixels)) / _PIXELS_A_CELL
        views = undistorted(job, source, _PIXEL_BYTES, photographs.silhouettes, shrink=max(1.0, shrink))
        sights, report = sights_by_colors(views, surface, job.events, threads=job.threads)
    with job.stage("join"):
        evidence = Evidence(photographs.views, photographs.silhouettes, photographs.hull, sights)
        joined, joining = join_in_box(job, evidence, octree, box, JOIN)
    return Joining(joined, joining, evidence, octree), report
