"""What became of a dense run: were there patches where the images have texture, and if not, why not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sfmapp.dense.prepare import DensePlan
from sfmapp.dense.pyramid import noise_deviation
from sfmapp.dense.report import SharesReport
from sfmapp.dense.scene import DenseView, Patches
from sfmapp.errors import NoReconstructionError
from sfmapp.geometry import rigid3

# a window of 7x7 pixels is textured if its grey values vary by so much, and by so much more than noise does
LEAST_DEVIATION, NOISE_FACTOR, WINDOW_PX = 4.0, 1.5, 7
# of the open pixels that have to be textured, and of the textured cells that have to be covered
LEAST_TEXTURED, LEAST_COVERED, GOOD_COVERED = 0.01, 0.01, 0.1
# Patches of chance: where photographs are given to the wrong poses they cover 7 to 12 %, and one in five is trusted by
# one view more than it needs, if another could see it. Of true patches, which cover 150 %, four in five are.
CHANCE_COVERED, CHANCE_CONFIRMED = 0.3, 0.35
# With poses swapped, or a third of a degree and more off, hardly a sparse point holds up as a patch: up to 0.3 of them
# on synthetic scenes, 0.2 on the sample, where 0.8 and more do with the true poses. What is covered then has a median
# score of 0.80 to 0.86 and reaches 0.36.
LEAST_POINTS, LEAST_POINTS_SHARE, WEAK_COVERED, WEAK_SCORE = 30, 0.35, 0.5, 0.87
# of so many patches it is looked at, if so many of them could be trusted by more views than they need
SAMPLE, LEAST_ASKED = 5000, 200


def textured_pixels(view: DenseView) -> tuple[int, int]:
    """How many of the open pixels of a view are textured, and how many there are."""
    import cv2

    gray = cv2.cvtColor(np.ascontiguousarray(view.rgb), cv2.COLOR_RGB2GRAY)
    window = (WINDOW_PX, WINDOW_PX)
    mean = cv2.boxFilter(gray, cv2.CV_32F, window)
    variance = cv2.sqrBoxFilter(gray, cv2.CV_32F, window) - mean * mean
    textured = variance > max(LEAST_DEVIATION, NOISE_FACTOR * noise_deviation(gray)) ** 2
    is_open = np.ones(gray.shape, bool) if view.mask is None else view.mask
    return int((textured & is_open).sum()), int(is_open.sum())


def judge(patches: Patches, texture: Sequence[tuple[int, int]], points: tuple[int, int], cell_px: int) -> SharesReport:
    """What patches cover of what is textured, and how many of the sparse points hold up.

    Args:
        patches: the result.
        texture: of each view, as :func:`textured_pixels` gives it.
        points: sparse points that were accepted as patches, and how many there are.
        cell_px: side of a cell.
    """
    textured, is_open = (sum(column) for column in zip(*texture, strict=True))
    cells = max(textured, LEAST_TEXTURED * is_open) / cell_px**2
    return SharesReport(
        textured=textured / max(is_open, 1),
        covered=len(patches.view_idx) / max(cells, 1.0),
        points=points[0] / points[1] if points[1] >= LEAST_POINTS else None,
    )


def confirmed_share(patches: Patches, plan: DensePlan, min_views: int) -> float | None:
    """Of the patches that could be trusted by more views than they need, the share that is; None if they are too few.

    A view could if it is a neighbour of the reference image and has the patch in its picture. Those that fewer views
    trust because the others cannot see them are not asked.
    """
    some = np.unique(np.linspace(0, len(patches) - 1, SAMPLE).astype(np.int64)) if len(patches) else np.zeros(0, int)
    xyz, reference = patches.xyz[some], patches.reference_idx[some]
    rotation, poses = rigid3.rotation_matrix(plan.cam_from_world), plan.cam_from_world
    num_seeing = np.ones(len(some), np.int64)
    for column in plan.neighbors.T:
        other = column[reference]
        seen = np.einsum("nij,nj->ni", rotation[other], xyz) + poses[other, 4:]
        k = np.array([canvas.k for canvas in plan.canvases])[other]
        size = np.array([canvas.working_size for canvas in plan.canvases])[other]
        pixel = seen[:, :2] / np.where(seen[:, 2:] > 0.0, seen[:, 2:], np.nan) * k[:, :2] + k[:, 2:]
        num_seeing += (other >= 0) & ((pixel >= 0.0) & (pixel < size)).all(axis=1)
    num_views = patches.num_views[some]
    asked = (num_seeing > min_views) & (num_views >= min_views)
    if asked.sum() < LEAST_ASKED:
        return None
    return float((num_views[asked] > min_views).mean())


def check(patches: Patches, shares: SharesReport, plan: DensePlan, min_views: int) -> str | None:
    """A warning if little was found, None if all is well. Of a region no more is asked than that it is not empty.

    Args:
        patches: the result, within the region if there is one.
        shares: of :func:`judge`.
        plan: the views.
        min_views: that have to trust a patch.

    Raises:
        NoReconstructionError: hardly anything was found; it says whether for lack of texture, or because the poses
            contradict the images.
    """
    found = f"{len(patches)} patches"
    if shares.textured < LEAST_TEXTURED and shares.covered < GOOD_COVERED:
        raise NoReconstructionError(
            f"{found}: the images show next to no texture ({100 * shares['textured']:.1f} % of their area)",
            "patches need texture to be matched: sharper or closer photographs, or a pattern on the surface",
        )
    if plan.region is not None:
        if len(patches):
            return None
        low, high = (", ".join(f"{value:g}" for value in corner) for corner in (plan.region.low, plan.region.high))
        raise NoReconstructionError(
            f"no patch in the region from ({low}) to ({high})",
            "check its corners against the coordinates of the model, or leave it out to see what is there",
        )
    share = f"{found} cover {100 * shares['covered']:.1f} % of what is textured in the images"
    confirmed = confirmed_share(patches, plan, min_views) if shares.covered < CHANCE_COVERED else None
    is_chance = confirmed is not None and confirmed < CHANCE_CONFIRMED
    if is_chance:
        share += f", and {100 * (confirmed or 0.0):.0f} % of them agree with more than {min_views} views"
    is_weak = shares.covered < WEAK_COVERED and (not len(patches) or float(np.median(patches.score)) < WEAK_SCORE)
    if is_weak and shares.points is not None and shares.points < LEAST_POINTS_SHARE:
        share += f", and {100 * shares['points']:.0f} % of the sparse points hold up"
        is_chance = True
    if shares.covered < LEAST_COVERED or is_chance:
        raise NoReconstructionError(
            f"{share}: the poses contradict the images",
            "check that model and photographs belong together (names, sizes, orientation), that the poses are "
            "camera from world, and the reprojection error of the model",
        )
    if shares.covered < GOOD_COVERED:
        return f"only {share}: are the poses exact, and do the photographs overlap?"
    return None
