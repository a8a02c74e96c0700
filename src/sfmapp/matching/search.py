"""Robust searches for the matrices of a pair, and whether what was found can be chance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import epipolar, five_point, homography
from sfmapp.geometry.fit import CAUCHY_SIGMAS, HEAVY_TAILS, robust_sigma
from sfmapp.geometry.relative_pose import refine_on_inliers, refine_relative_pose

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Ints = NDArray[np.int64]

# Of a relative pose: samples of five among inliers of F, of which nine in ten are right; so many of the best are
# refined on so many of these, and the best of that on all, in so many rounds. A third of the samples ends in the wrong
# one of two valleys in 7 of 84 runs over pairs of a narrow field of view, these in 1.
_SAMPLES, _REFINED, _FEW, _ROUNDS = 15, 4, 200, 8
# what the threshold of normalised image points becomes where OpenCV expects pixels
_SEARCH_PX = 2.0
# A search ends when a sample without a wrong match has been drawn with this probability.
_CONFIDENCE = 0.999
# Of such samples some lead to models that miss many of the right matches: so many times as many are drawn before a
# model that explains enough is given up.
_SPARE = 2.0
# A relative pose at the noise of its matches is within so many of their standard deviations, as usual, measured so many
# times at most, as a bent pose is twice as far from them; and once more only where that is less than so much of before.
_NOISE_SIGMAS, _NOISE_ROUNDS, _SAME_NOISE = 3.0, 2, 0.9
# Matches that leave the eight numbers of a plane open by less than a tenth of their noise.
_MANY = 1000


@dataclass(frozen=True)
class Ransac:
    """How to draw: most hypotheses of a search, and the state of the random generator (31 bits)."""

    max_trials: int
    seed: int

    def trials(self, least_share: float, sample_size: int) -> int:
        """Hypotheses after which a model that explains at least this share of the matches would have been found; one
        that explains fewer is worth nothing to the caller."""
        clean = least_share**sample_size
        if clean <= 0.0 or clean >= 1.0:
            return 1 if clean > 0.0 else self.max_trials
        wanted = _SPARE * math.log(1.0 - _CONFIDENCE) / math.log1p(-clean)
        return math.ceil(min(wanted, self.max_trials))

    def params(self, threshold: float, least_share: float, sample_size: int) -> Any:
        """MAGSAC++ scores (Barath et al., CVPR 2020) with local optimisation, in OpenCV's USAC framework."""
        import cv2

        params = cv2.UsacParams()
        params.confidence = _CONFIDENCE
        params.maxIterations = self.trials(least_share, sample_size)
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


def find_fundamental(
    xy1: Array, xy2: Array, threshold: float, ransac: Ransac, least_share: float = 0.0
) -> Array | None:
    """F (3, 3) by RANSAC from matched pixels (N, 2), N >= 8, or None; see :meth:`Ransac.trials` of the least share."""
    import cv2

    try:
        return first_matrix(cv2.findFundamentalMat(xy1, xy2, ransac.params(threshold, least_share, 7))[0])
    except cv2.error:  # coincident points can leave it without a single valid sample
        return None


def find_homography(xy1: Array, xy2: Array, threshold: float, ransac: Ransac, least_share: float = 0.0) -> Array | None:
    """H (3, 3) by RANSAC from matched pixels (N, 2), or None."""
    import cv2

    try:
        return first_matrix(cv2.findHomography(xy1, xy2, ransac.params(threshold, least_share, 4))[0])
    except cv2.error:
        return None


def plane_of_matches(
    xy1: Array, xy2: Array, pool: Mask, threshold: float, ransac: Ransac, least_share: float
) -> tuple[Array, Mask]:
    """H (3, 3) by RANSAC from some of the matches (N, 2), and (N,) which of all it explains; NaN, and none, without.

    Args:
        pool: (N,) bool, those that it is sought among.
        least_share: of the pool, to be worth having.
    """
    few = np.flatnonzero(pool)
    few = few[:: max(-(-len(few) // _MANY), 1)]
    h = find_homography(xy1[few], xy2[few], threshold, ransac, least_share)
    if h is None:
        return np.full((3, 3), np.nan), np.zeros(len(xy1), bool)
    return h, homography.transfer_errors(h, xy1, xy2) < threshold**2


def find_essential(xn1: Array, xn2: Array, threshold: float, ransac: Ransac, least_share: float = 0.0) -> Array | None:
    """E (3, 3) of unit norm by RANSAC from normalised image points (N, 2), or None; the threshold in their units."""
    import cv2

    eye, no_distortion = np.eye(3), np.zeros(4)
    try:
        params = ransac.params(threshold, least_share, 5)
        found = cv2.findEssentialMat(xn1, xn2, eye, eye, no_distortion, no_distortion, params)[0]
    except cv2.error:
        return None
    e = first_matrix(found)
    return None if e is None else epipolar.nearest_essential(e)


def find_relative_pose(xn1: Array, xn2: Array, threshold: float, ransac: Ransac) -> Array | None:
    """The relative pose (7,) with unit translation of two calibrated views, of which some matches are wrong, or None.

    F tells most wrong matches at the least cost; of samples of five among what it leaves, and of F itself,
    :func:`best_relative_pose` makes the pose.

    Args:
        xn1, xn2: (N, 2) normalised image points, N >= 8.
        threshold: largest Sampson distance of an inlier, in their units.
        ransac: how to draw.
    """
    scale = _SEARCH_PX / threshold  # to what OpenCV takes for pixels
    f = find_fundamental(xn1 * scale, xn2 * scale, _SEARCH_PX, ransac)
    if f is not None:
        inlier = epipolar.sampson_errors(f, xn1 * scale, xn2 * scale) < _SEARCH_PX**2
        if is_significant(inlier, _SEARCH_PX, tuple(np.ptp(xn2 * scale, axis=0))):
            back = np.diag([scale, scale, 1.0])
            pool = np.flatnonzero(inlier)
            essentials = [epipolar.nearest_essential(back @ f @ back)[None]]
            essentials.append(essentials_of_samples(xn1[pool], xn2[pool], ransac))
            return best_relative_pose(np.concatenate(essentials), pool, xn1, xn2, threshold)
    # of the samples whose model comes within the threshold of most, half of it tells the better
    found = find_essential(xn1, xn2, 0.5 * threshold, ransac)
    if found is None:
        return None
    pool = np.flatnonzero(epipolar.sampson_errors(found, xn1, xn2) < (2.0 * threshold) ** 2)
    return best_relative_pose(found[None], pool, xn1, xn2, threshold)


def essentials_of_samples(xn1: Array, xn2: Array, ransac: Ransac) -> Array:
    """(K, 3, 3) E of samples of five among matches (N, 2) or (N, 3), normalised or unit rays, of which most are right;
    none of fewer than eight."""
    if len(xn1) < 8:
        return np.zeros((0, 3, 3))
    rays = [xn if xn.shape[1] == 3 else np.concatenate([xn, np.ones((len(xn), 1))], 1) for xn in (xn1, xn2)]
    rays = [each / np.linalg.norm(each, axis=1, keepdims=True) for each in rays]
    drawn = np.random.default_rng([ransac.seed, len(xn1)]).integers(0, len(xn1), (_SAMPLES, 5))
    return five_point.essentials_of_samples(rays[0], rays[1], drawn)


def best_relative_pose(essentials: Array, pool: Ints, xn1: Array, xn2: Array, threshold: float) -> Array | None:
    """The relative pose (7,) with unit translation that one of several E leads to, or None.

    Those of least truncated error are refined on all matches that they explain, in front of both cameras, until these
    settle (Chum, Matas and Kittler, "Locally optimized RANSAC", 2003), and the best of them once more as the tails of
    its residuals ask.

    Args:
        essentials: (K, 3, 3) candidates.
        pool: (M,) positions of the matches that candidates are compared on, most of which should be right.
        xn1, xn2: (N, 2) normalised image points of all matches, or (N, 3) unit rays.
        threshold: largest Sampson distance of an inlier, in their units.
    """
    if len(pool) < 8 or not len(essentials):
        return None
    few = pool[:: max(-(-len(pool) // _FEW), 1)]
    a, b = xn1[few], xn2[few]
    costs = epipolar.truncated_sums(essentials, a, b, threshold**2)
    starts = epipolar.decompose_essential(essentials[np.argsort(costs, kind="stable")[:_REFINED]])
    # a sample is off by more than the noise: its inliers are looked for more widely than those of what is refined
    poses = [
        refine_on_inliers(
            epipolar.choose_in_front(of_four, a, b)[0], a, b, threshold, first_gate=2.0 * threshold, rounds=2,
            max_iterations=3,
        )[0]
        for of_four in starts
    ]  # fmt: skip

    def cost(pose: Array) -> float:
        _, squared = refine_on_inliers(pose, xn1, xn2, threshold, first_gate=threshold, rounds=0)
        return float(np.minimum(squared, threshold**2).sum())

    # the first of equals
    start = min(poses, key=cost)
    best, squared = refine_on_inliers(start, xn1, xn2, threshold, first_gate=threshold, rounds=_ROUNDS)
    inlier = squared < threshold**2
    if inlier.sum() < 8:
        return best
    sigma = max(robust_sigma(squared[inlier], 1), 1e-3 * threshold)
    if math.sqrt(float(squared[inlier].mean())) < HEAVY_TAILS * sigma:
        return best
    return refine_relative_pose(best, xn1[inlier], xn2[inlier], CAUCHY_SIGMAS * sigma)


def relative_pose_at_noise(essentials: Array, xn1: Array, xn2: Array, threshold: float) -> Array | None:
    """:func:`best_relative_pose` of all matches, at the threshold and then as near to them as their noise lets it be.

    The threshold of verification is several times the noise of good keypoints. Where views have little parallax, a
    pose that also comes within it of the matches of one thing taken for its like bends all others by a little, which
    costs less than to leave those out, though the right pose has most of the others four times as near.

    Args:
        essentials: (K, 3, 3) candidates. xn1, xn2: (N, 2) normalised image points, or (N, 3) unit rays, of which most
            are right. threshold: largest Sampson distance of an inlier, in their units.

    Returns:
        (7,) pose with unit translation, or None.
    """
    everything = np.arange(len(xn1))
    pose = best_relative_pose(essentials, everything, xn1, xn2, threshold)
    limit = threshold
    for _ in range(_NOISE_ROUNDS):
        if pose is None:
            break
        essential = epipolar.essential_from_pose(pose)
        sigma = robust_sigma(epipolar.sampson_errors(essential, xn1, xn2), 1)
        before, limit = limit, max(_NOISE_SIGMAS * sigma, 1e-3 * threshold)
        if limit > _SAME_NOISE * before:
            break
        pose = best_relative_pose(np.concatenate([essentials, essential[None]]), everything, xn1, xn2, limit)
    return pose
