"""The solid that is left of a box: by silhouettes, then by shadows, or by silhouettes with patches or colours."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.box import Box, clip_octree, tightened
from sfmapp.carve.files import read_octree, write_octree
from sfmapp.carve.hull import Hull, hull_of, outline_error
from sfmapp.carve.isosurface import Distance, Normals
from sfmapp.carve.octree import Octree
from sfmapp.carve.options import CarveOptions
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.space_carving import CarvingReport, carve_hull, told_cells
from sfmapp.carve.swept_sights import SightsReport
from sfmapp.errors import NoReconstructionError
from sfmapp.events import Events
from sfmapp.pipelines.carve.colors import join_colors
from sfmapp.pipelines.carve.joining import Joining, Photographs, join_patches
from sfmapp.pipelines.carve.lights import carve_by_lights
from sfmapp.pipelines.carve.outputs import CARVING, COLORED, JOINED, OCTREE, SHADOWED, earlier
from sfmapp.pipelines.carve.sources import CarveSource
from sfmapp.report.carve_document import ShadowsReport
from sfmapp.reporting import from_plain
from sfmapp.workspace.job import Job
from sfmapp.workspace.keys import input_key, stage_key
from sfmapp.workspace.layout import CARVE

Array = NDArray[np.float64]
FilePath = str | os.PathLike[str]
STAGE = CARVE
# cells along the side of the volume that tells how much of its box is filled
_COARSE = 64


@dataclass(frozen=True)
class Solid:
    """What is left.

    Attributes:
        octree: its cells. distance, normals: of its surface, see :func:`sfmapp.carve.isosurface.surface_of`.
        carving: how silhouettes carved it. shadows, joining: what shadows, and patches or colours, did; None without.
            The volume's bounds are those of what is left.
        hull: of the silhouettes. sights: what colours told, where they were joined; None otherwise.
        files: names of the octrees that were written.
    """

    octree: Octree
    distance: Distance
    normals: Normals | None
    carving: CarvingReport
    shadows: ShadowsReport | None
    hull: Hull
    joining: Joining | None
    sights: SightsReport | None
    files: tuple[str, ...]


def find_solid(
    job: Job, source: CarveSource, silhouettes: Sequence[Silhouette], box: Box, *,
    lights: FilePath | None = None, patches: Path | None = None, by_colors: bool = False,
) -> Solid:  # fmt: skip
    """Carve a box by silhouettes, and by what else there is.

    Args:
        lights: file of photographs under single lights. patches: file of dense patches.
        by_colors: see into hollows by the photographs' colours. At most one of the three.
    """
    hull, octree, carving = _carve(job, source, silhouettes, box)
    folder = job.workspace.folder
    if lights is not None:
        with job.stage("shadows"):
            octree, shadows, taken = carve_by_lights(Path(lights), source, silhouettes, octree, job.events, job.threads)
            write_octree(folder / SHADOWED, octree)
        shape = _shape(job, hull, octree, box, taken)
        return Solid(octree, *shape, carving, shadows, hull, None, None, (OCTREE, SHADOWED))
    if patches is not None or by_colors:
        photographs, sights = Photographs(source.views, silhouettes, hull), None
        if patches is not None:
            file, joining = JOINED, join_patches(job, patches, photographs, octree, box)
        else:
            joining, sights = join_colors(job, source, photographs, octree, box)
            file = COLORED
            write_octree(folder / COLORED, joining.joined.tree)
        joined = joining.joined
        inner, outer = joined.tree.volume_bounds()
        carving = replace(carving, volume_low=inner, volume_high=outer)
        distance = _cut(joined.distance, box)
        return Solid(joined.tree, distance, None, carving, None, hull, joining, sights, (OCTREE, file))
    return Solid(octree, *_shape(job, hull, octree, box, None), carving, None, hull, None, None, (OCTREE,))


def _carve(
    job: Job, source: CarveSource, silhouettes: Sequence[Silhouette], box: Box
) -> tuple[Hull, Octree, CarvingReport]:  # fmt: skip
    """The octree, that of an earlier call where it was finished with the same inputs and options."""
    options, folder = job.options.carve, job.workspace.folder
    hull = hull_of(source.views, silhouettes, min_views=options.min_views, misses=options.misses)
    key = stage_key(
        (__name__,), options, [input_key(record) for record in source.records], _digest(silhouettes),
        [view.row.tolist() for view in source.views], box.low.tolist(), box.high.tolist(), box.told_by,
    )  # fmt: skip

    def read() -> tuple[Octree, CarvingReport]:
        return read_octree(folder / OCTREE), from_plain(CarvingReport, job.workspace.read_json(CARVING))

    found = earlier(job, STAGE, key, read, "the volume was carved by an earlier call")
    if found is not None:
        return hull, *found
    with job.stage(STAGE, key):
        octree, report = _carved(job, source, silhouettes, hull, box)
        job.events.raise_if_cancelled()
        write_octree(folder / OCTREE, octree)
        job.workspace.write_json(CARVING, report)
    job.workspace.save()  # a call that is stopped from here on need not carve again
    return hull, octree, report


def _carved(
    job: Job, source: CarveSource, silhouettes: Sequence[Silhouette], hull: Hull, box: Box
) -> tuple[Octree, CarvingReport]:
    """The volume in a box that a user gave; in one that silhouettes tell, which is loose, in what a coarse volume fills
    of it."""
    names, options = [view.name for view in source.views], job.options.carve
    if box.told_by != "user" and 2**options.depth > _COARSE:
        coarse, _ = carve_hull(hull, names, *box.cube(), replace(options, cells=_COARSE), Events(), threads=job.threads)
        box = tightened(box, coarse)
    options = _with_cells(job, source, silhouettes, box)
    try:
        octree, report = carve_hull(hull, names, *box.cube(), options, job.events, threads=job.threads)
    except NoReconstructionError:
        job.events.raise_if_cancelled()  # nothing is left of what was not looked at
        raise
    if box.told_by == "user":
        octree = clip_octree(octree, box)
        low, high = octree.volume_bounds()
        report = replace(report, volume_low=low, volume_high=high)
    return octree, report


def _with_cells(job: Job, source: CarveSource, silhouettes: Sequence[Silhouette], box: Box) -> CarveOptions:
    """The options, with a number of cells: what was asked for, or what outlines tell apart."""
    options, (low, side) = job.options.carve, box.cube()
    error = outline_error(source.views, silhouettes, low + 0.5 * side)
    told, most = told_cells(error, side), 2**options.depth
    if options.cells is None:
        options = replace(options, cells=told)
    if told < most:
        said = f"outlines are told to {error:.3g} (three standard deviations), as large as {side / error:.0f} cells"
        asked = "are asked for: the finest tell no more" if told < 2**options.depth else "are taken"
        job.events.decided(STAGE, f"{said} along the side: {2**options.depth} {asked}")
    return options


def _digest(silhouettes: Sequence[Silhouette]) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for silhouette in silhouettes:
        digest.update(silhouette.distance.tobytes())
        if silhouette.known is not None:
            digest.update(np.packbits(silhouette.known).tobytes())
    return digest.hexdigest()


def _shape(job: Job, hull: Hull, octree: Octree, box: Box, taken: Distance | None) -> tuple[Distance, Normals]:
    """Signed distance and normals of the hull, cut off by the box of a user and by what shadows have taken away."""

    def cut(xyz: Array) -> Array:
        found = np.full(len(xyz), np.inf)
        if box.told_by == "user":
            found = np.minimum(found, box.distance(xyz))
        return found if taken is None else np.minimum(found, taken(xyz))

    def distance(xyz: Array) -> Array:
        return np.minimum(hull.distance(xyz, job.threads), cut(xyz))

    def normals(xyz: Array) -> NDArray[np.float32]:
        found = hull.normals(xyz, octree.cell, job.threads)
        # where the hull was cut, triangles tell them
        found[cut(xyz) < 0.5 * octree.cell] = 0.0
        return found

    return distance, normals


def _cut(distance: Distance, box: Box) -> Distance:
    """Signed distance of what is in the box of a user."""
    if box.told_by != "user":
        return distance
    return lambda xyz: np.minimum(distance(xyz), box.distance(xyz))
