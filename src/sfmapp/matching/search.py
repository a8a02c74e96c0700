"""Robust searches for the matrices of a pair, and whether what was found can be chance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import epipolar, fundamental

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Ransac:
    """How to draw: most hypotheses of a search, and the state of the random generator (31 bits)."""

    max_trials: int
    seed: int

    def params(self, threshold: float) -> Any:
        """MAGSAC++ scores (Barath et al., CVPR 2020) with local optimisation, in OpenCV's USAC framework."""
        import cv2

        params = cv2.UsacParams()
        params.confidence = 0.999
        params.maxIterations = self.max_trials
        params.threshold = threshold
        params.score = cv2.SCORE_METHOD_MAGSAC
        params.loMethod = cv2.LOCAL_OPTIM_SIGMA
        params.final_polisher = cv2.MAGSAC
        params.sampler = cv2.SAMPLING_UNIFORM
        params.isParallel = False
        params.randomGeneratorState = self.seed
        return params


def is_significant(inlier: Mask, threshold: float, extent: tuple[float, float]) -> bool:
    """Whether so many inliers of an F cannot be chance: fewer than one such F is expected among unrelated matches.

    The number of false alarms of Moisan and Stival, "A probabilistic criterion to detect rigid point matches", IJCV
    2004, at a fixed threshold.

    Args:
        inlier: (N,) bool.
        threshold: distance from the epipolar line in pixels.
        extent: width and height in pixels of where the matches could lie.
    """
    return _is_no_chance(inlier, min(2.0 * threshold * math.hypot(*extent) / max(extent[0] * extent[1], 1.0), 1.0))


def is_significant_of_rays(inlier: Mask, threshold: float) -> bool:
    """The same of rays that fill half of the sphere or more; the threshold is an angle in radians.

    A band on both sides of a half circle takes this share of a half sphere.
    """
    return _is_no_chance(inlier, min(2.0 * threshold, 1.0))


def _is_no_chance(inlier: Mask, band_share: float) -> bool:
    n, k = len(inlier), int(inlier.sum())
    if k < 8:
        return False

    def log_choose(a: int, b: int) -> float:
        return math.lgamma(a + 1) - math.lgamma(b + 1) - math.lgamma(a - b + 1)

    log_expected = math.log(max(n - 7, 1)) + log_choose(n, k) + log_choose(k, 7) + (k - 7) * math.log(band_share)
    return log_expected < 0.0


def first_matrix(found: Any) -> Array | None:
    """OpenCV returns None, an empty array, or several 3 x 3 solutions stacked."""
    if found is None or found.shape[0] < 3 or not np.isfinite(found[:3]).all():
        return None
    matrix = np.ascontiguousarray(found[:3], np.float64)
    norm = np.linalg.norm(matrix)
    return matrix / norm if norm > 0 else None


def find_fundamental(xy1: Array, xy2: Array, threshold: float, ransac: Ransac) -> Array | None:
    """F (3, 3) by RANSAC from matched pixels (N, 2), N >= 8, or None."""
    import cv2

    try:
        return first_matrix(cv2.findFundamentalMat(xy1, xy2, ransac.params(threshold))[0])
    except cv2.error:  # coincident points can leave it without a single valid sample
        return None


def polish_fundamental(f: Array, xy1: Array, xy2: Array, threshold: float, rounds: int = 3) -> tuple[Array, Mask]:
    """F fitted to all of its inliers, as long as that does not lose any, and the inliers (N,) of the last."""
    inlier = epipolar.sampson_errors(f, xy1, xy2) < threshold**2
    for _ in range(rounds):
        if inlier.sum() < 8:
            break
        a, b = xy1[inlier], xy2[inlier]
        refined = fundamental.fundamental_from_points(a, b, fundamental.sampson_weights(f, a, b))
        refined_inlier = epipolar.sampson_errors(refined, xy1, xy2) < threshold**2
        if refined_inlier.sum() < inlier.sum():
            break
        f, inlier = refined, refined_inlier
    return f, inlier


def find_homography(xy1: Array, xy2: Array, threshold: float, ransac: Ransac) -> Array | None:
    """H (3, 3) by RANSAC from matched pixels (N, 2), or None."""
    import cv2

    try:
        return first_matrix(cv2.findHomography(xy1, xy2, ransac.params(threshold))[0])
    except cv2.error:
        return None


def find_essential(xn1: Array, xn2: Array, threshold: float, ransac: Ransac) -> Array | None:
    """E (3, 3) of unit norm by RANSAC from normalised image points (N, 2), or None; the threshold in their units."""
    import cv2

    eye, no_distortion = np.eye(3), np.zeros(4)
    try:
        found = cv2.findEssentialMat(xn1, xn2, eye, eye, no_distortion, no_distortion, ransac.params(threshold))[0]
    except cv2.error:
        return None
    e = first_matrix(found)
    return None if e is None else epipolar.nearest_essential(e)


def find_relative_pose(xn1: Array, xn2: Array, threshold: float, ransac: Ransac) -> Array | None:
    """The relative pose (7,) with unit translation of two calibrated views, of which some matches are wrong, or None.

    Args:
        xn1, xn2: (N, 2) normalised image points, N >= 8.
        threshold: largest Sampson distance of an inlier, in their units.
        ransac: how to draw.
    """
    # of the samples whose model comes within the threshold of most matches, half of it tells the better ones
    essential = find_essential(xn1, xn2, 0.5 * threshold, ransac)
    if essential is None:
        return None
    pose = None
    # a sample is off by more than the noise: its inliers are looked for more widely than those of what is refined
    for gate in (2.0 * threshold, threshold):
        inlier = epipolar.sampson_errors(essential, xn1, xn2) < gate**2
        if inlier.sum() < 8:
            break
        a, b = xn1[inlier], xn2[inlier]
        if pose is None:
            pose = epipolar.choose_in_front(epipolar.decompose_essential(essential), a, b)[0]
        pose = epipolar.refine_relative_pose(pose, a, b, threshold)
        essential = epipolar.essential_from_pose(pose)
    return pose
