"""What is said of a volume: warnings, the report, the page, the recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.box import Box
from sfmapp.carve.coloring import ColoringReport
from sfmapp.carve.limits import Known, LimitsReport
from sfmapp.carve.masks_report import MasksReport
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.space_carving import LevelCounts
from sfmapp.carve.tolerance import ToleranceReport
from sfmapp.images.pixels import read_rgb
from sfmapp.pipelines.carve.solid import Solid
from sfmapp.pipelines.carve.sources import CarveSource
from sfmapp.report.carve_document import BoxFacts, CarveReport, SurfaceFacts
from sfmapp.report.carve_html import Shape, carve_page
from sfmapp.reporting import NamedReason
from sfmapp.scene.mesh import Mesh, enclosed_volume, face_areas
from sfmapp.surface.report import TextureReport
from sfmapp.viewer.carve_recording import record_carving
from sfmapp.workspace.job import FAILED, NOT_WANTED, WRITTEN, Job
from sfmapp.workspace.layout import CARVE, PAGE

STAGE = CARVE
_NAMES_SHOWN = 4
# of a silhouette; the volume leaves less than 4 % of those of good masks and cameras, at 128 cells or more
_UNCOVERED = 0.08
# a photograph whose silhouette the result fits so much worse than most is named
_FAR_BELOW = 0.1


@dataclass(frozen=True)
class CarvedVolume:
    """A volume when all is done.

    Attributes:
        silhouettes: as they were carved by. masks, tolerance: how they were found, and what is doubtful about them.
        mesh: its surface in colours. known, limits: what is known of it, and what is not; the latter None with a box.
        texture: of the GLB, None without.
        files: names of what was written.
    """

    source: CarveSource
    silhouettes: Sequence[Silhouette]
    masks: MasksReport
    tolerance: ToleranceReport | None
    box: Box
    solid: Solid
    mesh: Mesh
    colors: ColoringReport
    known: Known
    limits: LimitsReport | None
    texture: TextureReport | None
    files: tuple[str, ...]

    def photograph(self, v: int) -> NDArray[np.uint8]:
        """(H, W, 3) of a view."""
        return read_rgb(self.source.records[v])


def report_of(job: Job, volume: CarvedVolume) -> CarveReport:
    """The report, after all warnings."""
    source, box, solid = volume.source, volume.box, volume.solid
    return CarveReport(
        run=job.facts(), cameras=source.cameras, num_views=len(source.views),
        left_out=[NamedReason(name=name, reason=reason) for name, reason in source.left_out], masks=volume.masks,
        box=BoxFacts(low=box.low.tolist(), high=box.high.tolist(), told_by=box.told_by, apart=box.apart),
        tolerance=volume.tolerance, carving=solid.carving, shadows=solid.shadows,
        joining=None if solid.joining is None else solid.joining.report, sights=solid.sights,
        surface=_facts(volume.mesh), colors=volume.colors, limits=volume.limits,
        texture=volume.texture, files=volume.files, usage=job.usage,
        warnings=job.log.warnings, decisions=job.log.decisions,
    )  # fmt: skip


def write_page(job: Job, volume: CarvedVolume, report: CarveReport) -> None:
    """The page of the report."""
    with job.measured("page"):
        shape = Shape(volume.solid.octree, volume.mesh, volume.known)
        page = carve_page(report, volume.source.views, volume.silhouettes, shape, volume.photograph)
        job.workspace.write_text(PAGE, page)


def warn_of(job: Job, volume: CarvedVolume) -> None:
    """Say what speaks against the volume."""
    carving, colors = volume.solid.carving, volume.colors
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


def write_recording(job: Job, volume: CarvedVolume, report: CarveReport, *, wanted: bool) -> None:
    """The recording of how it was carved; what goes wrong there is told."""
    if not wanted:
        job.workspace.note(recording=NOT_WANTED)
        return
    with job.measured("recording"):
        recorded = record_carving(
            job.workspace.recording, _story(report), volume.source.views, volume.silhouettes, volume.solid.octree,
            volume.mesh, [_level_text(level) for level in report.carving.levels], volume.photograph,
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
    """Size of a closed mesh."""
    return SurfaceFacts(
        num_vertices=len(mesh.xyz), num_faces=len(mesh.faces), low=mesh.xyz.min(axis=0).tolist(),
        high=mesh.xyz.max(axis=0).tolist(), area=float(face_areas(mesh.xyz, mesh.faces).sum()),
        volume=enclosed_volume(mesh.xyz, mesh.faces),
    )  # fmt: skip
