"""The part of a report on densification and meshing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.report import LevelReport, SeedsReport, TwoViewsReport, WaveReport
from sfmapp.dense.scene import DenseScene, Patches
from sfmapp.report.coverage import coverage
from sfmapp.report.document import check
from sfmapp.report.model import Check, CoverageReport, DenseHistograms, DensePart, Histogram
from sfmapp.reporting import Step
from sfmapp.surface.report import MeshReport

NUM_BINS = 20
# a photograph of which less is covered added little
HARDLY_COVERED = 0.2


class Densified(Protocol):
    """What the report of densification and the sums of several have in common."""

    @property
    def seeds(self) -> SeedsReport | None: ...
    @property
    def levels(self) -> Sequence[LevelReport]: ...
    @property
    def waves(self) -> Sequence[WaveReport]: ...
    @property
    def funnel(self) -> Sequence[Step]: ...
    @property
    def two_views(self) -> TwoViewsReport | None: ...


def dense_document(
    scene: DenseScene, patches: Patches, dense_report: Densified, mesh_report: MeshReport | None = None,
    *, cell_px: int = 1, min_views: int = 3,
) -> DensePart:  # fmt: skip
    """The dense part of a report.

    Args:
        scene: the views, in any resolution.
        patches: what :func:`~sfmapp.dense.densify.densify` made of them.
        dense_report: its report, or the sums of those of several clusters of views.
        mesh_report: of :func:`~sfmapp.surface.mesh.make_mesh`; None without a mesh.
        cell_px, min_views: of the options.

    Returns:
        With histograms in which all patches are in one of the bins, the outermost of which are open.
    """
    images = coverage(scene, patches, block_px=max(4, 2 * cell_px), min_views=min_views)
    histograms = _histograms(patches)
    return DensePart(
        num_patches=len(patches),
        num_views=len(scene.views),
        checks=_checks(histograms, images) if len(patches) else [],
        seeds=dense_report.seeds or SeedsReport(carried=0, points=0, corners=0),
        levels=dense_report.levels,
        waves=dense_report.waves,
        funnel=_funnel(dense_report.funnel, len(patches)),
        histograms=histograms,
        images=images,
        mesh=mesh_report,
        two_views=dense_report.two_views,
    )


def _funnel(steps: Sequence[Step], num_patches: int) -> list[Step]:
    """The steps of densification, which end with the patches that it left, and what went away after it."""
    *removals, left = steps
    later = left.count - num_patches
    more = [Step(name="of overlapping clusters or outside the region", count=later)] if later else []
    return [*removals, *more, Step(name=left.name, count=num_patches)]


def _histograms(patches: Patches) -> DenseHistograms:
    """By the number of views, score, and deviation along the ray in pixels of the reference image on the surface."""
    views, score = patches.num_views.astype(np.float64), patches.score.astype(np.float64)
    sigma = (patches.sigma / patches.size).astype(np.float64)
    most = int(views.max()) if len(views) else 3
    fewest = int(views.min()) if len(views) else 2
    low = float(np.floor(20.0 * np.quantile(score, 0.002)) / 20.0) if len(score) else 0.0
    known = sigma[np.isfinite(sigma)]
    wide = float(np.quantile(known, 0.98)) if len(known) else 1.0
    return DenseHistograms(
        views=_histogram(views, np.arange(fewest, most + 2) - 0.5),
        score=_histogram(score, np.linspace(min(low, 0.95), 1.0, NUM_BINS + 1)),
        sigma_px=_histogram(sigma, np.linspace(0.0, wide or 1.0, NUM_BINS + 1)),
    )


def _histogram(values: NDArray[np.float64], edges: NDArray[np.floating]) -> Histogram:
    """Counts of values between edges; what lies outside is in the outermost bins, what is unknown in the last."""
    inside = np.nan_to_num(values, nan=edges[-1]).clip(edges[0], edges[-1])
    counts = np.histogram(inside, edges)[0]
    known = values[np.isfinite(values)]
    median = round(float(np.median(known)), 4) if len(known) else None
    return Histogram(edges=edges.round(6).tolist(), counts=counts.tolist(), median=median)


def _checks(histograms: DenseHistograms, images: Sequence[CoverageReport]) -> list[Check]:
    share = 100.0 * float(np.median([row.coverage for row in images]))
    bare = sum(row.coverage < HARDLY_COVERED for row in images)
    views, score = histograms.views.median or 0.0, histograms.score.median or 0.0
    return [
        check("photographs covered by patches (median)", share, f"{share:.0f} %", 60, 30, "%"),
        check(f"photographs covered to less than {100 * HARDLY_COVERED:.0f} %", -bare / len(images),
              f"{bare} of {len(images)}", -0.05, -0.25, "of all"),
        check("photographs that agree on a patch (median)", views, f"{views:.0f}", 4, 3),
        check("score of patches (median)", score, f"{score:.2f}", 0.85, 0.78),
    ]  # fmt: skip
