"""What came of densification and meshing, as JSON-able rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.scene import DenseScene, Patches
from sfmapp.report.coverage import coverage
from sfmapp.report.document import check

NUM_BINS = 20
# a photograph of which less is covered added little
HARDLY_COVERED = 0.2


def dense_document(
    scene: DenseScene, patches: Patches, reports: Sequence[Mapping[str, Any]], *, cell_px: int = 1, min_views: int = 3
) -> dict[str, Any]:
    """What the dense part of a report shows.

    Args:
        scene: the views, in any resolution.
        patches: of all of them.
        reports: of :func:`~sfmapp.dense.densify.densify`, one for each cluster of views; those without ``levels`` are
            of an earlier run and are counted only.
        cell_px, min_views: of the options.

    Returns:
        ``num_patches``, ``num_views``, ``checks``, ``growth`` (see :func:`_growth`), ``histograms`` of views, score and
        deviation (``edges``, ``counts``, ``median``; all patches are in one of the bins, the outermost of which are
        open) and ``images`` (see :func:`~sfmapp.report.coverage.coverage`).
    """
    images = coverage(scene, patches, block_px=max(4, 2 * cell_px), min_views=min_views)
    histograms = _histograms(patches)
    return {
        "num_patches": len(patches),
        "num_views": len(scene.views),
        "checks": _checks(histograms, images) if len(patches) else [],
        "growth": _growth(reports, len(patches)),
        "histograms": histograms,
        "images": images,
    }


def _growth(reports: Sequence[Mapping[str, Any]], num_patches: int) -> dict[str, Any]:
    """``levels``, ``waves``, ``seeds`` and ``funnel`` of densification, each the sum over clusters, and how many
    clusters there are and of how many an earlier run has the numbers (``num_clusters``, ``num_untold``).

    The funnel begins with what was accepted and goes on with what each step took away. Where clusters overlap, and at
    the sides of the region, more went away later: the last step, unless there are clusters that are not counted.
    """
    told = [report for report in reports if "levels" in report]
    levels = _sums([row for report in told for row in report["levels"]], "level")
    steps = _sums([step for report in told for step in report["funnel"] if step["name"] != "patches"], "name")
    left = sum(report["num_patches"] for report in told)
    if len(told) == len(reports) and left != num_patches:
        steps.append({"name": "of overlapping clusters or outside the region", "count": left - num_patches})
    return {
        "levels": sorted(levels, key=lambda row: -row["level"]),
        "waves": sorted(
            _sums([row for report in told for row in report["waves"]], "wave"), key=lambda row: row["wave"]
        ),
        "seeds": {
            name: sum(report["seeds"].get(name, 0) for report in told)
            for name in dict.fromkeys(name for report in told for name in report["seeds"])
        },
        "funnel": steps,
        "num_clusters": len(reports),
        "num_untold": len(reports) - len(told),
    }


def _sums(rows: Sequence[Mapping[str, Any]], key: str) -> list[dict[str, Any]]:
    """One row for each value of a key, in the order in which they come, with the sums of all else."""
    found: dict[Any, dict[str, Any]] = {}
    for row in rows:
        total = found.setdefault(row[key], {key: row[key]})
        for name, value in row.items():
            if name != key:
                total[name] = round(total.get(name, 0) + value, 3)
    return list(found.values())


def _histograms(patches: Patches) -> dict[str, dict[str, Any]]:
    """By the number of views, score, and deviation along the ray in pixels of the reference image on the surface."""
    views, score = patches.num_views.astype(np.float64), patches.score.astype(np.float64)
    sigma = (patches.sigma / patches.size).astype(np.float64)
    most = int(views.max()) if len(views) else 3
    fewest = int(views.min()) if len(views) else 2
    low = float(np.floor(20.0 * np.quantile(score, 0.002)) / 20.0) if len(score) else 0.0
    known = sigma[np.isfinite(sigma)]
    wide = float(np.quantile(known, 0.98)) if len(known) else 1.0
    return {
        "views": _histogram(views, np.arange(fewest, most + 2) - 0.5),
        "score": _histogram(score, np.linspace(min(low, 0.95), 1.0, NUM_BINS + 1)),
        "sigma_px": _histogram(sigma, np.linspace(0.0, wide or 1.0, NUM_BINS + 1)),
    }


def _histogram(values: NDArray[np.float64], edges: NDArray[np.floating]) -> dict[str, Any]:
    """Counts of values between edges; what lies outside is in the outermost bins, what is unknown in the last."""
    inside = np.nan_to_num(values, nan=edges[-1]).clip(edges[0], edges[-1])
    counts = np.histogram(inside, edges)[0]
    known = values[np.isfinite(values)]
    median = round(float(np.median(known)), 4) if len(known) else None
    return {"edges": edges.round(6).tolist(), "counts": counts.tolist(), "median": median}


def _checks(histograms: Mapping[str, Any], images: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    share = 100.0 * float(np.median([row["coverage"] for row in images]))
    bare = sum(row["coverage"] < HARDLY_COVERED for row in images)
    views, score = histograms["views"]["median"], histograms["score"]["median"]
    return [
        check("photographs covered by patches (median)", share, f"{share:.0f} %", 60, 30, "%"),
        check(f"photographs covered to less than {100 * HARDLY_COVERED:.0f} %", -bare / len(images),
              f"{bare} of {len(images)}", -0.05, -0.25, "of all"),
        check("photographs that agree on a patch (median)", views, f"{views:.0f}", 4, 3),
        check("score of patches (median)", score, f"{score:.2f}", 0.85, 0.78),
    ]  # fmt: skip
