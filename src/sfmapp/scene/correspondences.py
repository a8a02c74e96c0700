"""Verified matches between pairs of images, as flat arrays."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class TwoViewConfig(IntEnum):
    """What a pair of images was found to be; COLMAP's ids."""

    UNDEFINED = 0
    DEGENERATE = 1
    CALIBRATED = 2
    UNCALIBRATED = 3
    PLANAR = 4
    PANORAMIC = 5
    PLANAR_OR_PANORAMIC = 6
    WATERMARK = 7
    MULTIPLE = 8


@dataclass(frozen=True)
class Correspondences:
    """Verified matches of image pairs, in the order of the images; pairs that failed stay, with counts and no matches.

    Attributes:
        pair_image_idx: (P, 2) int32, positions i < j of the images.
        pair_ptr: (P + 1,) int64; the matches of pair p are ``matches[pair_ptr[p]:pair_ptr[p + 1]]``.
        matches: (M, 2) int32, positions of the keypoints in images i and j; inliers only.
        config: (P,) int8 of TwoViewConfig; UNDEFINED where verification failed.
        fundamental, essential, homography: (P, 3, 3) float64, mapping image i to j (x_j^T F x_i = 0, x_j ~ H x_i) in
            COLMAP's pixels for F and H and normalised coordinates for E; NaN where not estimated.
        cam2_from_cam1: (P, 7) float64 pose j_from_i with unit translation, NaN where not estimated.
        median_angle_deg: (P,) float64, median triangulation angle of the inliers; NaN where there is no pose.
        num_putative, num_inliers_f, num_inliers_e, num_inliers_h: (P,) int32 matches before verification, and how many
            of them each model explains.
    """

    pair_image_idx: NDArray[np.int32]
    pair_ptr: NDArray[np.int64]
    matches: NDArray[np.int32]
    config: NDArray[np.int8]
    fundamental: NDArray[np.float64]
    essential: NDArray[np.float64]
    homography: NDArray[np.float64]
    cam2_from_cam1: NDArray[np.float64]
    median_angle_deg: NDArray[np.float64]
    num_putative: NDArray[np.int32]
    num_inliers_f: NDArray[np.int32]
    num_inliers_e: NDArray[np.int32]
    num_inliers_h: NDArray[np.int32]

    @property
    def num_pairs(self) -> int:
        """P."""
        return len(self.pair_image_idx)

    @property
    def num_inliers(self) -> NDArray[np.int64]:
        """(P,) number of verified matches of each pair."""
        return np.diff(self.pair_ptr)

    def matches_of_pair(self, pair_idx: int) -> NDArray[np.int32]:
        """(K, 2) keypoint positions of a pair."""
        return self.matches[self.pair_ptr[pair_idx] : self.pair_ptr[pair_idx + 1]]

    def without(self, pair_idx: NDArray[np.integer]) -> Correspondences:
        """The same without the matches of some pairs, which stay in as UNDEFINED."""
        kept = np.ones(self.num_pairs, bool)
        kept[pair_idx] = False
        counts = self.num_inliers
        return replace(
            self,
            pair_ptr=np.concatenate([[0], np.cumsum(np.where(kept, counts, 0))]),
            matches=self.matches[np.repeat(kept, counts)],
            config=np.where(kept, self.config, TwoViewConfig.UNDEFINED).astype(np.int8),
        )
