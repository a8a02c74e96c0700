"""From a projective model to the world by points of known place, seen in its photographs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import NoReconstructionError
from sfmapp.geometry.fit import FitInfo
from sfmapp.geometry.projective import dehomogenized, project, triangulate_views
from sfmapp.geometry.projective_adjustment import (
    ProjectiveModel,
    Sightings,
    adjust_projective,
    noise_of_places,
    sightings_of,
)
from sfmapp.geometry.upgrade import MIN_POINTS, MIN_VOTERS, find_space_homography, place_covariances
from sfmapp.reporting import Report
from sfmapp.uncalibrated.projective_model import ProjectiveReconstruction

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Beyond it, an error of a known place is that much larger in what lies between: five that are nearly in a plane.
_MOST_CONDITION = 100.0
# depth of the known places over their width, below which they are a plane: its map squeezes space flat
_LEAST_DEPTH = 0.03
# chi-square of three that 1.2 in 100 right points exceed: as find_space_homography asks at its start
_LIMIT = 3.3**2
# which points agree settles in two or three
_MAX_ROUNDS = 6


class KnownPointReport(Report):
    """A point of known place.

    Attributes:
        name: of it. num_images: with a camera that show it; fewer than two are of no use.
        is_used: it agrees with the others. distance: from where the others put it, in the unit of the places; absent
            where it could not be triangulated.
        left_px: root mean square of its marks about its place in the projective model.
    """

    name: str
    num_images: int
    is_used: bool
    distance: float | None = None
    left_px: float | None = None


@dataclass(frozen=True)
class KnownFrame:
    """The frame that known points ask for.

    Attributes:
        frame: (4, 4). covariance: (16, 16) of its entries; None where five points leave nothing over to tell it by.
        sigma: standard deviation of a known coordinate, as given or as what is left tells beyond the noise of the
            points' marks, 0 where that explains all; NaN for five points.
        condition: of the equations.
        points: what became of each.
    """

    frame: Array
    covariance: Array | None
    sigma: float
    condition: float
    points: tuple[KnownPointReport, ...]

    def covariances_of(self, found: ProjectiveReconstruction) -> Array | None:
        """(N, 3, 3) of the places of the model's points: what the frame leaves open and the noise of each point's own
        pixels; None without a covariance of the frame."""
        if self.covariance is None:
            return None
        own = noise_of_places(found.model, found.seen, self.frame, found.info.sigma_px)
        return own + place_covariances(self.frame, self.covariance, found.model.points)


def upgrade_by_known_points(
    found: ProjectiveReconstruction, names: Sequence[str], xyz: Array, xy: Array, sigma: float | None = None
) -> KnownFrame:
    """The frame of the world from five points or more, of which some may be wrong.

    Args:
        found: the projective model. names: P of them. xyz: (P, 3) known places. xy: (P, I, 2) pixels that show them, by
            image, NaN where they were not marked.
        sigma: standard deviation of a known coordinate, without the noise of its marks; None: as what is left tells.

    Points count by how firmly their marks hold them: one far behind the others may stand off by many times as much
    along its rays, and is right.

    Raises:
        NoReconstructionError: fewer than five in two photographs or more of the model, or points in one plane.
    """
    seen = xy[:, found.view_idx]
    counts = np.isfinite(seen[:, :, 0]).sum(1)
    usable = np.flatnonzero(counts >= 2)
    if len(usable) < MIN_POINTS:
        raise NoReconstructionError(
            f"a projective model comes to the world by {MIN_POINTS} known points or more, each marked in two of its "
            f"photographs at least; found {len(usable)} of {len(names)}",
            "mark more points, or the same in more photographs",
        )
    points, _ = triangulate_views(found.model.cameras, seen[usable])
    held = np.ones(len(found.view_idx), np.bool_)
    start = ProjectiveModel(found.model.cameras, points)
    marks = sightings_of(seen[usable])
    model, adjusted = adjust_projective(start, marks, fixed_views=held)
    frame, info = find_space_homography(model.points, xyz[usable], sigma=sigma, is_robust=True)
    if info.num_free == 1 and info.is_inlier.sum() > MIN_POINTS:
        frame, info, sigma = _weighed(model, marks, adjusted.sigma_px, xyz[usable], (frame, info), sigma)
    depths = np.linalg.svd(xyz[usable][info.is_inlier] - xyz[usable][info.is_inlier].mean(0), compute_uv=False)
    if info.num_free > 1 or not info.condition < _MOST_CONDITION or depths[2] < _LEAST_DEPTH * depths[0]:
        raise NoReconstructionError(
            "the known points lie nearly in one plane, or four of five do: the world is left open (condition "
            f"{info.condition:.0f}, depth over width {depths[2] / max(depths[0], 1e-300):.2f})",
            "mark points at different heights, spread over the whole object",
        )
    distances = np.linalg.norm(dehomogenized(model.points @ frame.T) - xyz[usable], axis=1)
    left = np.sqrt(np.nanmean((project(model.cameras, model.points) - seen[usable]) ** 2, axis=(1, 2)))
    reports = [
        KnownPointReport(name=name, num_images=int(count), is_used=False)
        for name, count in zip(names, counts, strict=True)
    ]
    for row, point in enumerate(usable):
        reports[point] = KnownPointReport(
            name=names[int(point)], num_images=int(counts[point]), is_used=bool(info.is_inlier[row]),
            distance=float(distances[row]), left_px=float(left[row]),
        )  # fmt: skip
    told = math.nan if sigma is None else sigma
    return KnownFrame(frame, info.covariance, told, info.condition, tuple(reports))


def _weighed(
    model: ProjectiveModel, marks: Sightings, sigma_px: float, xyz: Array, start: tuple[Array, FitInfo],
    sigma: float | None,
) -> tuple[Array, FitInfo, float]:  # fmt: skip
    """The frame by points that count as firmly as they stand, which of them agree, and sigma of a known coordinate."""
    frame, info = start
    is_inlier, known = info.is_inlier, 0.0
    for _ in range(_MAX_ROUNDS):
        own = noise_of_places(model, marks, frame, sigma_px)
        left = dehomogenized(model.points @ frame.T) - xyz
        known = _beyond(left[is_inlier], own[is_inlier]) if sigma is None else sigma
        # what is exact on both sides still has the digits of a float
        least = (1e-9 * np.abs(xyz - xyz.mean(0)).max()) ** 2
        covariances = own + max(known**2, least) * np.eye(3)
        frame, fit = find_space_homography(
            model.points[is_inlier], xyz[is_inlier], covariances=covariances[is_inlier]
        )  # fmt: skip
        info = replace(fit, is_inlier=is_inlier)
        if len(xyz) < MIN_POINTS + MIN_VOTERS or fit.covariance is None:
            break
        # the frame is as sure of a point that had no part in it as it is there
        of_frame = place_covariances(frame, fit.covariance, model.points)
        left = dehomogenized(model.points @ frame.T) - xyz
        expected = covariances + np.where(is_inlier, 0.0, 1.0)[:, None, None] * of_frame
        agrees = np.einsum("ni,nij,nj->n", left, np.linalg.inv(expected), left) <= _LIMIT
        if agrees.sum() < MIN_POINTS + MIN_VOTERS or (agrees == is_inlier).all():
            break
        is_inlier = agrees
    return frame, info, known


def _beyond(left: Array, own: Array) -> float:
    """Standard deviation that coordinates have beyond their own covariances (N, 3, 3): what makes the squared sum of
    what is left (N, 3) as large as its free numbers (Paule and Mandel, 1982)."""
    values, vectors = np.linalg.eigh(own)
    squared = np.einsum("nij,ni->nj", vectors, left) ** 2
    num_left = left.size - 15

    def excess(variance: float) -> float:
        return float((squared / (values + variance)).sum()) - num_left

    low, high = 0.0, float(squared.sum()) / num_left
    if not excess(1e-12 * high) > 0.0:
        return 0.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) > 0.0 else (low, middle)
    return math.sqrt(high)
