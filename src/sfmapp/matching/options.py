"""Options of the matching stage."""

from __future__ import annotations

from dataclasses import dataclass

from sfmapp.option_checks import SHARE, Range, check_options, positive

_RANGES = {
    "max_ratio": positive(1.0),
    "max_distance": positive(2.0),
    "coarse_features": Range(0),
    "max_error_px": positive(1000.0),
    "min_inliers": Range(5, 100_000),  # five matches are the fewest that an essential matrix can be had from
    "min_e_f_ratio": SHARE,
    "max_h_ratio": SHARE,
    "max_ransac_trials": Range(1, 10**7),
}


@dataclass(frozen=True)
class MatchingOptions:
    """How keypoints are matched between two images and how the matches are verified.

    Distances between descriptors are Euclidean with SIFT descriptors scaled to unit norm (0 to sqrt 2), and a share of
    the bits for ORB.

    Attributes:
        max_ratio: Largest ratio of the best distance to the second best, in both directions (Lowe, IJCV 2004).
        max_distance: Largest distance of a match.
        coarse_features: Features of each image, largest first, whose matches guide those of all others along the
            epipolar lines; twice as many where there are four times. Pairs in which these show nothing in common are
            given up. Images with fewer than twice as many, and pairs on which they do not agree, are matched in full.
        max_error_px: Inlier threshold in pixels of the full-size image. None: 0.2 % of the image diagonal, within
            2 to 8 px.
        min_inliers: Verified matches that a pair needs to be used.
        min_e_f_ratio: An essential matrix is accepted if it has at least this share of the inliers of the fundamental
            matrix.
        max_h_ratio: A pair is planar or panoramic if a homography explains more than this share of the inliers.
        max_ransac_trials: Largest number of RANSAC hypotheses for each model.
    """

    max_ratio: float = 0.8
    max_distance: float = 0.7
    coarse_features: int = 1536
    max_error_px: float | None = None
    min_inliers: int = 15
    min_e_f_ratio: float = 0.95
    max_h_ratio: float = 0.8
    max_ransac_trials: int = 5000

    def __post_init__(self) -> None:
        check_options("matching", self, _RANGES)
