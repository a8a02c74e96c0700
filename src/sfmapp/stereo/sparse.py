"""Sparse stereo: keypoints of both pictures of a rectified pair, matched along their rows, to points in space.

A partner lies within a pixel of the same row, which leaves a hundredth of the keypoints to be confused with. Its place
is then found to hundredths of a pixel by aligning windows. What is left between the rows of partners had no part in
finding disparities, so it tells how far off they are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.features.extract import FeatureOptions, features_from_picture
from sfmapp.images.pixels import as_gray
from sfmapp.matching.guided import GuidedImage, background_of, match_guided
from sfmapp.matching.options import MatchingOptions
from sfmapp.stereo.alignment import aligned_matches
from sfmapp.stereo.depth import baseline_of
from sfmapp.stereo.result import RectifiedGeometry, RectifiedPair
from sfmapp.stereo.sparse_matches import PairMatches, picture_of

Array = NDArray[np.float64]

# epipolar lines of a rectified pair are its rows
ALONG_ROWS: Array = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
# log2 of the scale and turn in radians between partners: cameras of a pair look the same way, and a surface that slants
# so that it is half as wide for one of them is hardly matched
_CHANGE: Array = np.array([-0.5, 0.5, 0.0, math.radians(30)])
# Along rows a window's stretch and shear are solved for as well, and steps of disparity pull: errors of disparities are
# 1.6 to 2.5 times those of rows on six rendered pairs.
_ALONG = 1.9
# fewer rows than this do not tell a standard deviation to a quarter
_FEW = 10


@dataclass(frozen=True)
class SparsePoints:
    """Points that keypoints tell.

    Attributes:
        matches: N of them, pixels.
        noise_px: standard deviations of a coordinate of a keypoint and of a disparity.
        xyz: (N, 3) in the frame of the rectified left camera, x right, y down, z forward, in the baseline's unit.
        covariance: (N, 3, 3), of keypoints and calibration; the calibration's part is common to all points.
    """

    matches: PairMatches
    noise_px: tuple[float, float]
    xyz: Array
    covariance: Array


def match_along_rows(pair: RectifiedPair, row_px: float = 1.0) -> PairMatches:
    """SIFT keypoints of both pictures, mutual nearest neighbours among those within ``row_px`` of the same row.

    Where both windows align, the right end is moved there; others are left out, as are those that then are off the row.
    """
    shown = (pair.left_shown, pair.right_shown)
    gray = [as_gray(picture) for picture in (pair.left, pair.right)]
    images = []
    for one, mask in zip(gray, shown, strict=True):
        features = features_from_picture(picture_of(one, mask), FeatureOptions(max_num_orientations=1))[0]
        if not len(features):
            return PairMatches(np.zeros((0, 2)), np.zeros((0, 2)))
        images.append(GuidedImage.of(features, background_of(features)))
    limits = MatchingOptions()
    rows = match_guided(images[0], images[1], ALONG_ROWS, row_px, _CHANGE, limits.max_ratio, limits.max_distance)
    ends = [np.ascontiguousarray(image.shape[rows[:, n], :2]) for n, image in enumerate(images)]
    matches = aligned_matches(gray[0], gray[1], PairMatches(ends[0], ends[1]))
    matches = matches.of(np.abs(matches.row_differences) < row_px)
    if pair.geometry is None:
        return matches
    return matches.of(matches.disparities > -pair.geometry.doffs)


def sparse_points(pair: RectifiedPair, matches: PairMatches | None = None) -> SparsePoints:
    """Points of a rectified pair with their covariance, from keypoints alone.

    Args:
        matches: those of :func:`match_along_rows`; None: found here.

    Raises:
        UsageError: nothing tells the baseline.
    """
    matches = match_along_rows(pair) if matches is None else matches
    geometry = pair.geometry or RectifiedGeometry(pair.left.shape[1], pair.left.shape[0], 1.0, 0.0, 0.0)
    noise = noise_of_rows(matches)
    xyz, covariance = points_with_covariance(geometry, matches, noise)
    return SparsePoints(matches, noise, xyz, covariance)


def noise_of_rows(matches: PairMatches) -> tuple[float, float]:
    """Standard deviations of a coordinate of a keypoint and of a disparity, pixels, from what rows of partners differ
    by, which has twice the variance of one; NaN of few matches."""
    if len(matches) < _FEW:
        return math.nan, math.nan
    rows = float(np.std(matches.row_differences))
    return rows / math.sqrt(2.0), _ALONG * rows


def points_with_covariance(
    geometry: RectifiedGeometry, matches: PairMatches, noise_px: tuple[float, float]
) -> tuple[Array, Array]:
    """Points (N, 3) and covariances (N, 3, 3), to first order.

    With D = d + doffs, X = B (x - cx) / D, Y = B (y - cy) / D, Z = f B / D, where x is the left column and y the mean
    of both rows.

    Args:
        geometry: with a baseline; its covariance is taken in where there is one.
        noise_px: standard deviations of a coordinate and of a disparity.
    """
    baseline = baseline_of(geometry)
    x, y = matches.left[:, 0] - geometry.cx, 0.5 * (matches.left[:, 1] + matches.right[:, 1]) - geometry.cy
    from_infinity = matches.disparities + geometry.doffs
    scale = baseline / from_infinity
    xyz = scale[:, None] * np.column_stack([x, y, np.full(len(x), geometry.focal)])
    # by the left column, the row, the disparity
    by_pixels = np.zeros((len(x), 3, 3))
    by_pixels[:, 0, 0] = by_pixels[:, 1, 1] = scale
    by_pixels[:, :, 2] = -xyz / from_infinity[:, None]
    variance = np.array([noise_px[0], noise_px[0] / math.sqrt(2.0), noise_px[1]]) ** 2
    covariance = np.einsum("nij,j,nkj->nik", by_pixels, variance, by_pixels)
    if geometry.covariance is not None:
        # by focal length, baseline, doffs
        by_rig = np.zeros((len(x), 3, 3))
        by_rig[:, 2, 0] = scale
        by_rig[:, :, 1] = xyz / baseline
        by_rig[:, :, 2] = by_pixels[:, :, 2]
        covariance += np.einsum("nij,jk,nlk->nil", by_rig, geometry.covariance, by_rig)
    return xyz, covariance
