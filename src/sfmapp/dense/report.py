"""What densification has brought: views and their neighbours, patches level by level, and what was taken away."""

from __future__ import annotations

from collections.abc import Sequence

from sfmapp.reporting import NamedReason, Report, Step


class NeighborsReport(Report):
    """How views were given neighbours.

    Attributes:
        num_without: views without any.
        num_by_points, num_by_cameras: pairs that common points speak for, and places and directions alone.
        median_angle_deg: between neighbours, as seen from what they show; None without any.
    """

    num_without: int
    num_by_points: int
    num_by_cameras: int
    median_angle_deg: float | None


class ViewReport(Report):
    """A view at working resolution, and the names of its neighbours."""

    name: str
    width: int
    height: int
    neighbors: Sequence[str]


class ViewsReport(Report):
    """What was planned with the views of a model.

    Attributes:
        num_points: sparse points that two of them see.
        shrink: least, median and largest number of pixels of a photograph for one at working resolution, a side.
        missing: photographs that could not be used.
        copies: names of photographs that show what another one shows, from the same place.
    """

    num_views: int
    num_points: int
    shrink: Sequence[float]
    neighbors: NeighborsReport
    views: Sequence[ViewReport]
    missing: Sequence[NamedReason]
    copies: Sequence[str]


class LevelReport(Report):
    """Work on one level of the pyramids; 0 is the working resolution.

    Attributes:
        carried: patches that the coarser level handed on; absent on the coarsest.
        points, corners: seeds that became patches: sparse points, and corners matched along epipolar lines.
        expanded: patches that grew from others; ``seen_by_few``: those of them where few views see.
        accepted: before the filters.
        contradicted, without_neighbours, in_small_groups: what the filters took away.
        patches: what was left.
    """

    level: int
    carried: int | None = None
    points: int
    expanded: int
    corners: int
    seen_by_few: int
    accepted: int
    contradicted: int
    without_neighbours: int
    in_small_groups: int
    patches: int
    wall_s: float
    cpu_s: float


class WaveReport(Report):
    """One wave of expansion."""

    wave: int
    tried: int
    accepted: int


class SeedsReport(Report):
    """Seeds of the finest level that became patches, by where they came from."""

    carried: int
    points: int
    corners: int


class TwoViewsReport(Report):
    """Two views, to which growing patches and stereo have put their hands.

    Attributes:
        by_stereo, by_growth: patches of each. of_stereo_share: of the cells of both views that either covers, those
            that stereo does; of_growth_share: the same of patches that grew.
        is_stereo_first: what the other one found was taken where it left a gap.
    """

    by_stereo: int
    by_growth: int
    of_stereo_share: float
    of_growth_share: float
    is_stereo_first: bool


class DensifyReport(Report):
    """What came of the patches of some views.

    Attributes:
        levels: the coarsest first.
        funnel: what was accepted, what each filter took away, and what was left.
        two_views: absent where there are more, or where stereo cannot rectify them.
    """

    num_patches: int
    levels: Sequence[LevelReport]
    waves: Sequence[WaveReport]
    seeds: SeedsReport
    funnel: Sequence[Step]
    two_views: TwoViewsReport | None = None


class SharesReport(Report):
    """What patches cover.

    Attributes:
        textured: share of the open pixels of all views.
        covered: cells that trust a patch, against textured ones; above 1 where patches lie on more than is textured.
        points: of the sparse points those that hold up as patches; None where there are too few to tell.
    """

    textured: float
    covered: float
    points: float | None


class ClusterReport(Report):
    """A cluster of views that was worked on by itself; ``is_resumed``: its patches are of an earlier run."""

    views: Sequence[str]
    num_patches: int
    is_resumed: bool


class CloudNumbers(Report):
    """A cloud in numbers: means and medians over its patches, absent without any.

    Attributes:
        mean_views: photographs that trust a patch.
        median_sigma: standard deviation along the ray, world units.
        median_size: what a pixel measures at the patch, world units.
    """

    num_patches: int
    mean_views: float | None = None
    median_score: float | None = None
    median_sigma: float | None = None
    median_size: float | None = None
