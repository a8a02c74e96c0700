"""How far off a depth may be that two pictures tell.

With Z = f B / (d + doffs), to first order::

    dZ = |f / d| dB + |f B / d^2| dd + |B / d| df                      largest error, of three that add up
    var Z = (Z / d)^2 var d + J C J^T,  J = (Z / f, Z / B, -Z / d)     of standard deviations

where d stands for d + doffs and C for the covariance of focal length, baseline and doffs. Both are of one pixel;
the calibration's part is common to all pixels of a map, and does not average out over them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.stereo.depth import Map, baseline_of
from sfmapp.stereo.result import RectifiedGeometry

Array = NDArray[np.float64]

# how far a point has to stand from infinity, in standard deviations of its disparity, to be told from it: 95 %
TOLD_SIGMAS = 1.96


class DepthErrorTerms(NamedTuple):
    """Largest errors of depths (...,) by their causes, in the unit of the baseline."""

    of_baseline: Array
    of_disparity: Array
    of_focal: Array

    @property
    def total(self) -> Array:
        """All three against us."""
        return self.of_baseline + self.of_disparity + self.of_focal


class DepthLimits(NamedTuple):
    """What a rig can tell.

    Attributes:
        least: depth at the greatest disparity that can be: nearer points are not matched.
        greatest: depth whose disparity is told from that of infinity, by ``TOLD_SIGMAS``.
        at_ten_percent: depth whose standard deviation is a tenth of it.
    """

    least: float
    greatest: float
    at_ten_percent: float


def depth_error_terms(
    geometry: RectifiedGeometry, disparity: ArrayLike, *, baseline_error: float = 0.0, disparity_error: float = 1.0,
    focal_error: float = 0.0,
) -> DepthErrorTerms:  # fmt: skip
    """The three terms of the largest depth error, to first order.

    Args:
        disparity: of any shape, pixels.
        baseline_error: in its unit. disparity_error, focal_error: pixels.
    """
    d = np.abs(np.asarray(disparity, np.float64) + geometry.doffs)
    baseline = baseline_of(geometry)
    with np.errstate(divide="ignore"):
        return DepthErrorTerms(
            geometry.focal / d * abs(baseline_error),
            geometry.focal * baseline / d**2 * abs(disparity_error),
            baseline / d * abs(focal_error),
        )


def depth_sigma(geometry: RectifiedGeometry, disparity: ArrayLike, disparity_sigma: ArrayLike) -> Map:
    """Standard deviation of depth, of disparity and calibration together, to first order.

    Args:
        disparity, disparity_sigma: of one shape, pixels; NaN where unknown.

    Returns:
        The same shape, float32, in the unit of the baseline; NaN where the depth is unknown.
    """
    d = np.asarray(disparity, np.float64) + geometry.doffs
    d = np.where(d > 0.0, d, np.nan)
    baseline = baseline_of(geometry)
    depth = geometry.focal * baseline / d
    by_disparity = depth / d
    variance = (by_disparity * np.asarray(disparity_sigma, np.float64)) ** 2
    if geometry.covariance is not None:
        slopes = (depth / geometry.focal, depth / baseline, -by_disparity)
        for i, a in enumerate(slopes):
            for j, b in enumerate(slopes):
                variance += a * b * geometry.covariance[i, j]
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)), np.float32)


def depth_interval(geometry: RectifiedGeometry, disparity: ArrayLike, half_width: ArrayLike) -> tuple[Map, Map]:
    """Nearest and farthest depth of disparities give or take ``half_width``, exactly: far away depth is anything but
    symmetric about its estimate. Infinite where infinity is inside."""
    d = np.asarray(disparity, np.float64) + geometry.doffs
    half, power = np.asarray(half_width, np.float64), geometry.focal * baseline_of(geometry)
    with np.errstate(divide="ignore", invalid="ignore"):
        near = np.where(d + half > 0.0, power / (d + half), np.inf)
        far = np.where(d - half > 0.0, power / (d - half), np.inf)
    unknown = np.isnan(d) | np.isnan(half)
    near[unknown], far[unknown] = np.nan, np.nan
    return np.asarray(near, np.float32), np.asarray(far, np.float32)


def depth_limits(geometry: RectifiedGeometry, greatest_disparity: float, disparity_sigma: float) -> DepthLimits:
    """The least and the greatest depth that a rig tells.

    Args:
        greatest_disparity: that was looked for, pixels; the width of the picture bounds it.
        disparity_sigma: of a usual pixel; the part of the calibration in ``doffs`` is added.
    """
    power = geometry.focal * baseline_of(geometry)
    variance = disparity_sigma**2
    if geometry.covariance is not None:
        variance += float(geometry.covariance[2, 2])
    sigma = variance**0.5
    widest = min(greatest_disparity, geometry.width) + geometry.doffs
    return DepthLimits(
        power / widest if widest > 0.0 else np.inf,
        power / (TOLD_SIGMAS * sigma) if sigma else np.inf,
        power / (10.0 * sigma) if sigma else np.inf,
    )
