"""Photographs from all sides to a closed surface: silhouettes, box, octree, mesh, colours, one after another."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.box import Box, cameras_inside, find_box, user_box
from sfmapp.carve.coloring import ColoringReport, color_surface
from sfmapp.carve.isosurface import surface_of
from sfmapp.carve.joined import Evidence
from sfmapp.carve.limits import Known, LimitsReport, SeenFaces, area_shown, find_known, find_limits
from sfmapp.carve.octree import Octree
from sfmapp.carve.silhouettes import Silhouette, find_silhouettes
from sfmapp.carve.tolerance import doubt_holes
from sfmapp.carve.views import up_of_views
from sfmapp.errors import InputError, NoReconstructionError, UsageError, listed
from sfmapp.events import Events
from sfmapp.images.image_set import ImageSet
from sfmapp.images.pixels import read_rgb
from sfmapp.pipelines.carve.joining import find_patches
from sfmapp.pipelines.carve.outputs import write_surface
from sfmapp.pipelines.carve.results import CarvedVolume, report_of, warn_of, write_page, write_recording
from sfmapp.pipelines.carve.solid import Solid, find_solid
from sfmapp.pipelines.carve.sources import CarveSource, find_views
from sfmapp.pipelines.carve.texture import with_texture
from sfmapp.pipelines.dense.source import is_of_model
from sfmapp.report.carve_document import CarveReport
from sfmapp.scene.mesh import Mesh
from sfmapp.workspace.job import Job
from sfmapp.workspace.layout import CARVE, REPORT
from sfmapp.workspace.options import Options
from sfmapp.workspace.usage import Stopwatch

Array = NDArray[np.float64]
FilePath = str | os.PathLike[str]
_NAMES_SHOWN = 4
# what the user's box may leave out of that of the silhouettes, as a share of its side, before it is said
_CUT = 0.05


@dataclass(frozen=True)
class CarveInput:
    """What is carved.

    Attributes:
        source: a workspace, a COLMAP model, or a folder of photographs with their cameras.
        images, poses: see :func:`sfmapp.pipelines.carve.sources.find_views`.
        lights: file of photographs under single lights, see :mod:`sfmapp.formats.lights_file`.
        box: lower x, y, z and upper ones of the box that the object is in; None: as the silhouettes say.
        with_dense: patches to join with the silhouettes: a ``patches.npz``, the workspace that holds one, or "" for
            that of ``source``; None: silhouettes alone.
        by_colors: see into hollows by the colours of the photographs.
    """

    source: FilePath
    images: FilePath | None = None
    poses: FilePath | None = None
    box: Sequence[float] | None = None
    lights: FilePath | None = None
    with_dense: FilePath | None = None
    by_colors: bool = False


@dataclass(frozen=True)
class CarveResult:
    """What was found and written.

    Attributes:
        output: the folder. report: what is in ``report.json``.
        octree: the volume. mesh: its closed surface, in colours.
        evidence: (N,) uint8 of the mesh's vertices: 0 no photograph sees it, 1 neither outlines nor patches tell it, 2
            outlines do, 3 patches do.
    """

    output: Path
    report: CarveReport
    octree: Octree
    mesh: Mesh
    evidence: NDArray[np.uint8]


def carve(
    what: CarveInput, output: FilePath | None = None, options: Options | None = None, *,
    record: bool = True, events: Events | None = None, watch: Stopwatch | None = None,
) -> CarveResult:  # fmt: skip
    """Carve a volume out of photographs from all sides.

    Args:
        what: the photographs and their cameras.
        output: a new folder, an empty one, or that of an earlier call; None, for a workspace or a model alone: its
            folder ``carve``.
        options: of these ``masks``, ``carve``, ``surface`` (its texture), ``images`` and ``threads``.
        record: write ``recording.rrd``.
        events: progress, warnings and cancellation. watch: started when the run began.

    Raises:
        UsageError: photographs without cameras, or an output that holds something else.
        InputError: photographs, cameras, masks or a box that cannot be used.
        NoReconstructionError: nothing is left of the volume.
        InterruptedRunError: ``events`` was asked to stop; the same call resumes.
    """
    patches = _patches(what)
    with Job.opened(CARVE, what.source, _target(what, output), options, events=events, watch=watch) as job:
        with job.stage("views"):
            source = find_views(what.source, what.images, what.poses, job.options, job.events)
        job.note_inputs({record.name: record.digest for record in source.records})
        silhouettes: Sequence[Silhouette]
        with job.stage("masks"):
            silhouettes, masks = find_silhouettes(
                ImageSet(source.records, ()),
                source.views,
                job.options.masks,
                job.events,
                points=source.points,
                threads=job.threads,
            )
        with job.stage("box"):
            box = _box(what, source, silhouettes, job)
        tolerance = None
        if job.options.carve.doubts_holes:
            with job.stage("tolerance"):
                silhouettes, tolerance = doubt_holes(source.views, silhouettes, *box.cube(), job.events)
        solid = find_solid(job, source, silhouettes, box, lights=what.lights, patches=patches, by_colors=what.by_colors)
        silhouettes = solid.hull.silhouettes  # of many photographs they are most of the memory
        mesh = _surface(job, solid)
        with job.stage("colors"):
            mesh, colors, looks = _colored(job, source, silhouettes, mesh, solid.octree.cell)
        with job.stage("limits"):
            known, limits = _limits(job, source, silhouettes, box, solid, looks)
        shown, texture = mesh, None
        if job.options.surface.texture:
            with job.stage("texture"):
                shown, texture = with_texture(job, source, mesh)
        with job.stage("files"):
            evidence = known.of_vertices(mesh)
            written = write_surface(job.workspace.folder, mesh, evidence, shown, up_of_views(source.views))
        volume = CarvedVolume(
            source, silhouettes, masks, tolerance, box, solid, mesh, colors, known, limits, texture,
            (*solid.files, *written),
        )  # fmt: skip
        warn_of(job, volume)
        report = report_of(job, volume)
        write_page(job, volume, report)
        write_recording(job, volume, report, wanted=record)
        job.workspace.write_json(REPORT, report)
        job.workspace.save()
        return CarveResult(job.workspace.folder, report, solid.octree, mesh, evidence)


@dataclass(frozen=True)
class _Looks:
    """What the photographs show of a surface: which triangles, and what its area is at least if it is the hull's."""

    mesh: Mesh
    seen: SeenFaces
    area_low: float


def _limits(
    job: Job, source: CarveSource, silhouettes: Sequence[Silhouette], box: Box, solid: Solid, looks: _Looks
) -> tuple[Known, LimitsReport | None]:  # fmt: skip
    """What is known of the surface, and what is not; the latter not of one that a user's box cuts off, for bounds are
    the whole hull's."""
    mesh, joining = looks.mesh, solid.joining
    evidence, band = (None, 0.0) if joining is None else (joining.evidence, joining.report.band)
    if evidence is None and solid.shadows is None and box.told_by == "user":  # its faces are told by nobody
        evidence = Evidence(source.views, silhouettes, solid.hull, ())
    known = find_known(mesh, source.views, evidence, band, threads=job.threads, seen=looks.seen)
    if box.told_by == "user":
        return known, None
    if joining is None:
        return known, find_limits(mesh, mesh, source.views, silhouettes, known, looks.area_low)
    hull_mesh = surface_of(joining.hull_octree, lambda xyz: solid.hull.distance(xyz, job.threads))
    return known, find_limits(mesh, hull_mesh, source.views, silhouettes, known)


def _patches(what: CarveInput) -> Path | None:
    """The file of patches, if any. Raises UsageError beside lights or colours, InputError if there is no such file."""
    if (what.with_dense is not None) + (what.lights is not None) + what.by_colors > 1:
        raise UsageError(
            "patches, shadows and colours cannot be joined with each other",
            "give one of --with-dense, --lights and --colors",
        )
    if what.with_dense is None:
        return None
    return find_patches(what.source, what.with_dense)


def _target(what: CarveInput, output: FilePath | None) -> Path:
    """The folder of the results. Raises UsageError if it has to be named."""
    if output is not None:
        return Path(output)
    if what.poses is None and is_of_model(Path(what.source)):
        return Path(what.source) / CARVE
    raise UsageError("a volume needs a folder to be written to", "give -o OUT")


def _box(what: CarveInput, source: CarveSource, silhouettes: Sequence[Silhouette], job: Job) -> Box:
    """The user's box, held against that of the silhouettes, or the latter."""
    given = None if what.box is None else user_box(what.box[:3], what.box[3:])
    try:
        found = find_box(source.views, silhouettes, source.points, job.events)
    except InputError:
        if given is None:
            raise
        return given
    if given is not None:
        if not ((given.low < found.high) & (given.high > found.low)).all():
            raise InputError(
                f"--box: expected a box around the object, found none of it in there: the silhouettes meet between "
                f"{_corner(found.low)} and {_corner(found.high)}",
                "leave --box out, or give one that holds it",
            )
        cut = np.maximum(given.low - found.low, found.high - given.high).max()
        if cut > _CUT * found.extent:
            job.events.warned(
                "box",
                f"the box leaves out what silhouettes allow, by up to {cut:.3g}: they meet between "
                f"{_corner(found.low)} and {_corner(found.high)}",
            )
        found = given
    # those that were left out carve nothing, wherever they are
    used = [v for v, each in zip(source.views, silhouettes, strict=True) if each.known is None or each.known.any()]
    inside = cameras_inside(found, used)
    if len(inside) > 0.5 * len(used):
        raise InputError(
            f"{len(inside)} of {len(used)} cameras stand inside the volume: an object is carved from outside",
            "check that masks show the object and not the background, take photographs from more sides, or give its "
            "box: --box X Y Z X Y Z",
        )
    if inside:
        job.events.warned(
            "box",
            f"cameras stand where the object may be: {listed(inside, _NAMES_SHOWN)}: if their poses are wrong, so is "
            "what they carve away: leave them out",
        )
    return found


def _corner(at: Array) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in at) + ")"


def _surface(job: Job, solid: Solid) -> Mesh:
    """The surface, in grey."""
    with job.stage("surface"):
        mesh = surface_of(solid.octree, solid.distance, solid.normals, job.events)
        if not len(mesh.faces):
            raise NoReconstructionError(
                "nothing is left of the volume at this resolution", "ask for more cells: --cells"
            )
        return mesh


def _colored(
    job: Job, source: CarveSource, silhouettes: Sequence[Silhouette], mesh: Mesh, cell: float
) -> tuple[Mesh, ColoringReport, _Looks]:  # fmt: skip
    """The surface in colours of the photographs, where these are from, and what else they show."""
    seen, areas = SeenFaces(mesh), [0.0]

    def look(v: int, depth: NDArray[np.float32]) -> None:
        seen.add(source.views[v], depth)
        areas.append(area_shown(source.views[v], silhouettes[v], depth))

    rgb, colors = color_surface(
        mesh, cell, source.views, silhouettes, lambda v: read_rgb(source.records[v]), job.events, threads=job.threads,
        also=look,
    )  # fmt: skip
    mesh = replace(mesh, rgb=rgb)
    return mesh, colors, _Looks(mesh, seen, max(areas))
