"""From a projective model to the world by points of known place, seen in its photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import NoReconstructionError
from sfmapp.geometry.projective import dehomogenized, project, triangulate_views
from sfmapp.geometry.projective_adjustment import ProjectiveModel, adjust_projective, sightings_of
from sfmapp.geometry.upgrade import MIN_POINTS, find_space_homography, place_covariances
from sfmapp.reporting import Report
from sfmapp.uncalibrated.projective_model import ProjectiveReconstruction

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Beyond it, an error of a known place is that much larger in what lies between: five that are nearly in a plane.
_MOST_CONDITION = 100.0
# depth of the known places over their width, below which they are a plane: its map squeezes space flat
_LEAST_DEPTH = 0.03


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
        sigma: standard deviation of a known coordinate, as what is left tells it; NaN for five points.
        condition: of the equations.
        points: what became of each.
    """

    frame: Array
    covariance: Array | None
    sigma: float
    condition: float
    points: tuple[KnownPointReport, ...]

    def sigmas_of(self, points: Array) -> Array | None:
        """(N,) standard deviation of places along the longest axis, from the frame's covariance; None without one."""
        if self.covariance is None:
            return None
        values = np.linalg.eigvalsh(place_covariances(self.frame, self.covariance, points))[:, -1]
        sigmas: Array = np.sqrt(values.clip(0.0))
        return sigmas


def upgrade_by_known_points(
    found: ProjectiveReconstruction, names: Sequence[str], xyz: Array, xy: Array, sigma: float | None = None
) -> KnownFrame:
    """The frame of the world from five points or more, of which some may be wrong.

    Args:
        found: the projective model. names: P of them. xyz: (P, 3) known places. xy: (P, I, 2) pixels that show them, by
            image, NaN where they were not marked.
        sigma: standard deviation of a known coordinate; None: as what is left tells.

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
    model, _ = adjust_projective(start, sightings_of(seen[usable]), fixed_views=held)
    frame, info = find_space_homography(model.points, xyz[usable], sigma=sigma, is_robust=True)
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
    return KnownFrame(frame, info.covariance, float(info.sigma_px), info.condition, tuple(reports))
