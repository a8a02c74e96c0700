"""Photographs from all sides to a closed surface: silhouettes, box, octree, mesh, colours, one after another."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.box import Box, cameras_inside, clip_octree, find_box, tightened, user_box
from sfmapp.carve.coloring import ColoringReport, color_surface
from sfmapp.carve.files import read_octree, write_octree
from sfmapp.carve.hull import Hull, hull_of
from sfmapp.carve.isosurface import Distance, Normals, surface_of
from sfmapp.carve.joined import Joined
from sfmapp.carve.octree import Octree
from sfmapp.carve.silhouettes import Silhouette, find_silhouettes
from sfmapp.carve.space_carving import CarvingReport, LevelCounts, carve_hull
from sfmapp.carve.tolerance import doubt_holes
from sfmapp.carve.views import up_of_views
from sfmapp.errors import InputError, NoReconstructionError, UsageError
from sfmapp.events import Events
from sfmapp.images.image_set import ImageSet
from sfmapp.images.pixels import read_rgb
from sfmapp.pipelines.carve.joining import Photographs, find_patches, join_patches
from sfmapp.pipelines.carve.lights import carve_by_lights
from sfmapp.pipelines.carve.outputs import CARVING, JOINED, OCTREE, SHADOWED, write_surface
from sfmapp.pipelines.carve.sources import CarveSource, find_views
from sfmapp.pipelines.carve.texture import with_texture
from sfmapp.pipelines.dense.source import is_of_model
from sfmapp.report.carve_document import BoxFacts, CarveReport, SurfaceFacts
from sfmapp.report.carve_html import carve_page
from sfmapp.reporting import NamedReason, from_plain
from sfmapp.scene.mesh import Mesh, face_areas
from sfmapp.viewer.carve_recording import record_carving
from sfmapp.workspace.job import FAILED, NOT_WANTED, WRITTEN, Job
from sfmapp.workspace.keys import input_key, stage_key
from sfmapp.workspace.layout import CARVE, PAGE, REPORT
from sfmapp.workspace.options import Options
from sfmapp.workspace.usage import Stopwatch

Array = NDArray[np.float64]
FilePath = str | os.PathLike[str]
STAGE = CARVE
_NAMES_SHOWN = 4
# what the user's box may leave out of that of the silhouettes, as a share of its side, before it is said
_CUT = 0.05
# of a silhouette; the volume leaves less than 4 % of those of good masks and cameras, at 128 cells or more
_UNCOVERED = 0.08
# cells along the side of the volume that tells how much of its box is filled
_COARSE = 64
# a photograph whose silhouette the result fits so much worse than most is named
_FAR_BELOW = 0.1


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
    """

    source: FilePath
    images: FilePath | None = None
    poses: FilePath | None = None
    box: Sequence[float] | None = None
    lights: FilePath | None = None
    with_dense: FilePath | None = None


@dataclass(frozen=True)
class CarveResult:
    """What was found and written.

    Attributes:
        output: the folder. report: what is in ``report.json``.
        octree: the volume. mesh: its closed surface, in colours.
    """

    output: Path
    report: CarveReport
    octree: Octree
    mesh: Mesh


@dataclass(frozen=True)
class CarvedVolume:
    """A volume when all is done, for files, page and recording."""

    source: CarveSource
    silhouettes: Sequence[Silhouette]
    box: Box
    octree: Octree
    hull: Hull
    mesh: Mesh


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
        with job.stage("masks"):
            images = ImageSet(source.records, ())
            silhouettes, masks = find_silhouettes(
                images, source.views, job.options.masks, job.events, points=source.points, threads=job.threads
            )
        with job.stage("box"):
            box = _box(what, source, silhouettes, job)
        tolerance = None
        if job.options.carve.doubts_holes:
            with job.stage("tolerance"):
                silhouettes, tolerance = doubt_holes(source.views, silhouettes, *box.cube(), job.events)
        hull, octree, carving = _carve(job, source, silhouettes, box)
        shadows, taken = None, None
        if what.lights is not None:
            with job.stage("shadows"):
                octree, shadows, taken = carve_by_lights(
                    Path(what.lights), source, silhouettes, octree, job.events, job.threads
                )
                write_octree(job.workspace.folder / SHADOWED, octree)
        shape: tuple[Distance, Normals | None] = _shape(job, hull, octree, box, taken)
        joining = None
        if patches is not None:
            joined, joining = join_patches(job, patches, Photographs(source.views, silhouettes, hull), octree)
            octree, shape = _joined_shape(joined, box)
            write_octree(job.workspace.folder / JOINED, octree)
        mesh, colors = _surface(job, source, silhouettes, octree, shape)
        volume = CarvedVolume(source, silhouettes, box, octree, hull, mesh)
        _warn(job, volume, carving, colors)
        shown, texture = mesh, None
        if job.options.surface.texture:
            with job.stage("texture"):
                shown, texture = with_texture(job, source, mesh)
        with job.stage("files"):
            surface = write_surface(job.workspace.folder, mesh, shown, up_of_views(source.views))
            files = [OCTREE, *([SHADOWED] if shadows else []), *([JOINED] if joining else []), *surface]
        report = CarveReport(
            run=job.facts(), cameras=source.cameras, num_views=len(source.views),
            left_out=[NamedReason(name=name, reason=reason) for name, reason in source.left_out], masks=masks,
            box=BoxFacts(low=box.low.tolist(), high=box.high.tolist(), told_by=box.told_by, apart=box.apart),
            tolerance=tolerance, carving=carving, shadows=shadows, surface=_facts(mesh), colors=colors, texture=texture,
            files=files, usage=job.usage, warnings=job.log.warnings, decisions=job.log.decisions, joining=joining,
        )  # fmt: skip
        with job.measured("page"):
            page = carve_page(report, source.views, silhouettes, octree, mesh, lambda v: read_rgb(source.records[v]))
            job.workspace.write_text(PAGE, page)
        _record(job, volume, report, record=record)
        job.workspace.write_json(REPORT, report)
        job.workspace.save()
        return CarveResult(job.workspace.folder, report, octree, mesh)


def _patches(what: CarveInput) -> Path | None:
    """The file of patches, if any. Raises UsageError beside lights, InputError if there is no such file."""
    if what.with_dense is None:
        return None
    if what.lights is not None:
        raise UsageError("patches and shadows cannot be joined", "give either --with-dense or --lights")
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
    inside = cameras_inside(found, source.views)
    if len(inside) > 0.5 * len(source.views):
        raise InputError(
            f"{len(inside)} of {len(source.views)} cameras stand inside the volume: an object is carved from outside",
            "check that masks show the object and not the background, or give its box: --box X Y Z X Y Z",
        )
    if inside:
        job.events.warned("box", f"cameras stand inside the volume: {', '.join(inside[:_NAMES_SHOWN])}")
    return found


def _corner(at: Array) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in at) + ")"


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
    if job.workspace.is_current(STAGE, key):
        try:
            found = read_octree(folder / OCTREE), from_plain(CarvingReport, job.workspace.read_json(CARVING))
            job.events.decided(STAGE, "the volume was carved by an earlier call")
            return hull, *found
        except (InputError, ValueError):
            pass  # taken away or damaged: carved again
    with job.stage(STAGE, key):
        octree, report = _carved(job, source, hull, box)
        job.events.raise_if_cancelled()
        write_octree(folder / OCTREE, octree)
        job.workspace.write_json(CARVING, report)
    return hull, octree, report


def _carved(job: Job, source: CarveSource, hull: Hull, box: Box) -> tuple[Octree, CarvingReport]:
    """The volume in a box that a user gave; in one that silhouettes tell, which is loose, in what a coarse volume fills
    of it."""
    names, options = [view.name for view in source.views], job.options.carve
    if box.told_by != "user" and options.cells > _COARSE:
        coarse, _ = carve_hull(hull, names, *box.cube(), replace(options, cells=_COARSE), Events(), threads=job.threads)
        box = tightened(box, coarse)
    octree, report = carve_hull(hull, names, *box.cube(), options, job.events, threads=job.threads)
    if box.told_by == "user":
        octree = clip_octree(octree, box)
        low, high = octree.volume_bounds()
        report = replace(report, volume_low=low, volume_high=high)
    return octree, report


def _digest(silhouettes: Sequence[Silhouette]) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for silhouette in silhouettes:
        digest.update(silhouette.distance.tobytes())
        if silhouette.known is not None:
            digest.update(np.packbits(silhouette.known).tobytes())
    return digest.hexdigest()


def _surface(
    job: Job, source: CarveSource, silhouettes: Sequence[Silhouette], octree: Octree,
    shape: tuple[Distance, Normals | None],
) -> tuple[Mesh, ColoringReport]:  # fmt: skip
    with job.stage("surface"):
        mesh = surface_of(octree, *shape, job.events)
        if not len(mesh.faces):
            raise NoReconstructionError(
                "nothing is left of the volume at this resolution", "ask for more cells: --cells"
            )
    with job.stage("colors"):
        rgb, colors = color_surface(
            mesh, octree.cell, source.views, silhouettes, lambda v: read_rgb(source.records[v]), job.events,
            threads=job.threads,
        )  # fmt: skip
    return Mesh(mesh.xyz, mesh.faces, mesh.normal, rgb), colors


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


def _joined_shape(joined: Joined, box: Box) -> tuple[Octree, tuple[Distance, None]]:
    """Octree and signed distance of what silhouettes and patches leave, cut off by the box of a user."""
    if box.told_by != "user":
        return joined.tree, (joined.distance, None)
    return clip_octree(joined.tree, box), (lambda xyz: np.minimum(joined.distance(xyz), box.distance(xyz)), None)


def _warn(job: Job, volume: CarvedVolume, carving: CarvingReport, colors: ColoringReport) -> None:
    if any(view.is_mirrored for view in volume.source.views):
        job.events.warned(
            STAGE, "the world of these cameras is mirrored: in it, and in the files, the object is as a mirror shows it"
        )
    if carving.touches_box and volume.box.told_by != "user":
        job.events.warned(STAGE, "the volume reaches the border of its box, which cuts it off: give a larger --box")
    typical = float(np.median([fit.iou for fit in colors.views]))
    uncovered = float(np.median([fit.under_share for fit in colors.views]))
    if uncovered > _UNCOVERED and volume.box.told_by != "user":
        job.events.warned(
            STAGE,
            f"the volume leaves {uncovered:.0%} of the typical silhouette uncovered: others take away what each shows, "
            "as cameras or masks contradict each other",
        )
    odd = [fit for fit in colors.views if fit.iou < typical - _FAR_BELOW]
    if odd and volume.box.told_by != "user":  # what a box leaves out is missed by all
        named = ", ".join(f"{fit.name} ({fit.iou:.2f})" for fit in odd[:_NAMES_SHOWN])
        job.events.warned(
            STAGE,
            f"the volume fits some silhouettes worse than most ({typical:.2f}): {named}: their cameras or masks are "
            "doubtful",
        )


def _record(job: Job, volume: CarvedVolume, report: CarveReport, *, record: bool) -> None:
    if not record:
        job.workspace.note(recording=NOT_WANTED)
        return
    records = volume.source.records
    with job.measured("recording"):
        recorded = record_carving(
            job.workspace.recording, _story(report), volume.source.views, volume.silhouettes, volume.octree,
            volume.mesh, [_level_text(level) for level in report.carving.levels], lambda v: read_rgb(records[v]),
        )  # fmt: skip
    job.workspace.note(recording=FAILED if recorded.problem else WRITTEN)
    if recorded.problem:
        job.events.warned("recording", f"no recording: {recorded.problem}")


def _story(report: CarveReport) -> str:
    fits, surface = [fit.iou for fit in report.colors.views], report.surface
    return (
        f"**{report.num_views} photographs**; the volume covers their silhouettes by {np.median(fits):.2%} in the "
        f"median, {min(fits):.2%} at least.\n\nVolume {surface.volume:.5g}, area {surface.area:.5g}, "
        f"{surface.num_faces:,} triangles.\n\nThe timeline *level* carves it: yellow cells are split on, green ones "
        "are wholly inside."
    )


def _level_text(level: LevelCounts) -> str:
    return (
        f"**Level {level.level}**: cells of {level.side:.4g}\n\n{level.looked_at:,} looked at: {level.carved:,} carved "
        f"away, {level.full:,} wholly inside, {level.split:,} split"
    )


def _facts(mesh: Mesh) -> SurfaceFacts:
    """Size of a closed mesh, by the divergence theorem."""
    a, b, c = (mesh.xyz[mesh.faces[:, corner]] - mesh.xyz.mean(axis=0) for corner in range(3))
    return SurfaceFacts(
        num_vertices=len(mesh.xyz), num_faces=len(mesh.faces), low=mesh.xyz.min(axis=0).tolist(),
        high=mesh.xyz.max(axis=0).tolist(), area=float(face_areas(mesh.xyz, mesh.faces).sum()),
        volume=float(np.einsum("fc,fc->", a, np.cross(b, c)) / 6.0),
    )  # fmt: skip
