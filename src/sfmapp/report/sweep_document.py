"""The report of ``sfmapp sweep``, as a type."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sfmapp.dense.report import ViewsReport
from sfmapp.report.model import LogLine, RunFacts
from sfmapp.reporting import NamedReason, Report, Usage


class SweptView(Report):
    """The map of one photograph.

    Attributes:
        neighbors: photographs it was swept with.
        num_planes: that were looked at, and near, far: depth of the nearest and of the farthest, units of the world.
        answered: share of the pixels with a depth before other maps were asked, and confirmed: after.
        median_sigma: of the depths, as a share of them; None where there is none.
    """

    name: str
    neighbors: Sequence[str]
    num_planes: int
    near: float
    far: float
    answered: float
    confirmed: float
    median_sigma: float | None


class OccupancyReport(Report):
    """The volume of ``--occupancy``.

    Attributes:
        cells: along x, y and z. cell: side of one, units of the world.
        num_features: cells that hold one.
    """

    cells: Sequence[int]
    cell: float
    num_features: int


class SweepReport(Report):
    """The report of ``sfmapp sweep``.

    Attributes:
        occupancy: of the feature-occupancy volume; None where none was asked for.
        views: what was planned. maps: those that were made. left_out: photographs without one, and why.
        usage: of each step.
    """

    run: RunFacts
    views: ViewsReport
    maps: Sequence[SweptView]
    occupancy: OccupancyReport | None
    left_out: Sequence[NamedReason]
    usage: Mapping[str, Usage]
    warnings: Sequence[LogLine]
