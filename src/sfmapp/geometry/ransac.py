"""RANSAC as it was written down: draw, fit, count, keep the best, stop when a clean sample is nearly certain.

Fischler and Bolles, "Random sample consensus", CACM 1981. It is here to be read, and to stand beside the estimate of
the main path (``sfmapp.matching``), which scores by MAGSAC++ and refines the best models as it goes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry.dlt import normalizing
from sfmapp.geometry.epipolar import sampson_errors
from sfmapp.geometry.fit import FitInfo, matched_points
from sfmapp.geometry.fundamental import eight_point, epipolar_rows, rank_two

Array = NDArray[np.float64]

SAMPLE_SIZE = 8
# samples that are solved at a time: one call of LAPACK's for all of them
_BATCH = 64


@dataclass(frozen=True)
class Improvement:
    """A sample that beat all before it.

    Attributes:
        trial: its number, from 1. num_inliers: of its model. needed: trials that this many inliers ask for.
    """

    trial: int
    num_inliers: int
    needed: float


def trials_needed(inlier_share: float, sample_size: int = SAMPLE_SIZE, confidence: float = 0.99) -> float:
    """Samples after which one without an outlier has been drawn with this probability:
    ``log(1 - p) / log(1 - w^s)``; infinite without inliers."""
    clean = inlier_share**sample_size
    if clean <= 0.0:
        return math.inf
    return math.log(1.0 - confidence) / math.log1p(-clean) if clean < 1.0 else 1.0


def ransac_fundamental(
    xy1: ArrayLike,
    xy2: ArrayLike,
    threshold_px: float,
    *,
    seed: int = 0,
    max_trials: int = 10_000,
    confidence: float = 0.99,
) -> tuple[Array, FitInfo, list[Improvement]]:
    """F by RANSAC over samples of eight, fitted to all inliers of the best at the end.

    Args:
        xy1, xy2: (N, 2) matched pixels, N >= 8.
        threshold_px: Sampson distance of an inlier. Of the algebraic residual ``|x2^T F x1|`` no number can be said
            that holds for all points: it has no unit.
        seed: the same draws the same samples.
        max_trials: most samples. Where ``trials_needed`` of the best is above it, the answer is not certain.
        confidence: probability of a clean sample, at which it stops.

    Returns:
        F (3, 3) of unit norm, NaN if no sample had eight inliers; ``num_iterations`` the samples drawn; and every
        sample that was better than those before.

    Raises:
        ValueError: fewer than eight points, or some that are not finite.
    """
    a, b = matched_points(xy1, xy2, SAMPLE_SIZE, "RANSAC over samples of eight")
    rng = np.random.default_rng([seed, len(a)])
    t1, t2 = normalizing(a), normalizing(b)
    rows = epipolar_rows(a * t1[0, 0] + t1[:2, 2], b * t2[0, 0] + t2[:2, 2])
    best, inlier, history = np.full((3, 3), np.nan), np.zeros(len(a), np.bool_), list[Improvement]()
    trial, needed = 0, float(max_trials)
    while trial < needed:
        samples = rng.random((_BATCH, len(a))).argpartition(SAMPLE_SIZE - 1, axis=1)[:, :SAMPLE_SIZE]
        solved = np.linalg.svd(rows[samples])[2][:, 8].reshape(-1, 3, 3)
        for f in t2.T @ rank_two(solved) @ t1:
            trial += 1
            found = sampson_errors(f, a, b) < threshold_px**2
            if found.sum() > max(int(inlier.sum()), SAMPLE_SIZE - 1):
                best, inlier = f / np.linalg.norm(f), found
                wanted = trials_needed(float(found.mean()), confidence=confidence)
                history.append(Improvement(trial, int(found.sum()), wanted))
                needed = min(float(max_trials), wanted)
            if trial >= needed:
                break
    if not inlier.any():
        return best, FitInfo(inlier, trial, math.nan, np.zeros(0), 0), history
    fitted, info = eight_point(a[inlier], b[inlier])
    now = sampson_errors(fitted, a, b) < threshold_px**2
    if now.sum() >= inlier.sum():
        best, inlier = fitted, now
    return best, FitInfo(inlier, trial, info.condition, info.singular_values, info.num_free, info.sigma_px), history
