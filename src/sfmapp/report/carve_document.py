"""The report of ``sfmapp carve``, as a type."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sfmapp.carve.coloring import ColoringReport
from sfmapp.carve.joined import JoinReport
from sfmapp.carve.limits import LimitsReport
from sfmapp.carve.masks_report import MasksReport
from sfmapp.carve.shadow_carving import ShadowCarvingReport
from sfmapp.carve.shadows import DetectionReport
from sfmapp.carve.space_carving import CarvingReport
from sfmapp.carve.swept_sights import SightsReport
from sfmapp.carve.tolerance import ToleranceReport
from sfmapp.report.model import LogLine, RunFacts
from sfmapp.reporting import NamedReason, Report, Usage
from sfmapp.surface.report import TextureReport


class BoxFacts(Report):
    """Where the object was looked for.

    Attributes:
        low, high: corners, world. told_by: ``silhouettes``, ``points`` of a reconstruction, or ``user``.
        apart: photographs whose silhouettes meet with no others.
    """

    low: Sequence[float]
    high: Sequence[float]
    told_by: str
    apart: Sequence[str]


class SurfaceFacts(Report):
    """The closed surface.

    Attributes:
        low, high: corners of the box around it, world.
        area, volume: square and cubic units of the world.
    """

    num_vertices: int
    num_faces: int
    low: Sequence[float]
    high: Sequence[float]
    area: float
    volume: float


class ShadowsReport(Report):
    """What single lights said of a volume.

    Attributes:
        carving: what was taken away. lights: what could be told of their shadows.
    """

    carving: ShadowCarvingReport
    lights: Sequence[DetectionReport]


class CarveReport(Report):
    """The report of ``sfmapp carve``.

    Attributes:
        cameras: what they are, in words. left_out: photographs without a camera, and cameras without a photograph.
        tolerance: holes of masks through which nothing was carved; absent where that was not asked for.
        shadows: what photographs under single lights took away; absent without.
        limits: what is not known of the surface, and where to photograph from next; absent with a box.
        texture: that of the GLB; absent where vertices have the colours.
        joining: what patches or colours did to it, and sights: what colours told; absent without.
        files: what was written, in the folder of the run.
        usage: of each step.
    """

    run: RunFacts
    cameras: str
    num_views: int
    left_out: Sequence[NamedReason]
    masks: MasksReport
    box: BoxFacts
    tolerance: ToleranceReport | None = None
    carving: CarvingReport
    surface: SurfaceFacts
    colors: ColoringReport
    limits: LimitsReport | None = None
    texture: TextureReport | None = None
    files: Sequence[str]
    usage: Mapping[str, Usage]
    warnings: Sequence[LogLine]
    decisions: Sequence[LogLine]
    shadows: ShadowsReport | None = None
    joining: JoinReport | None = None
    sights: SightsReport | None = None
