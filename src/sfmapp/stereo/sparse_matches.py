"""Sparse matches of two pictures: they tell the range of disparities, misalignment, and wrong pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.features.extract import FeatureOptions, features_from_picture
from sfmapp.images.pixels import Picture, as_gray, as_rgb
from sfmapp.matching.descriptors import match_sift
from sfmapp.matching.options import MatchingOptions

Array = NDArray[np.float64]

# enough for a range and an alignment; SIFT takes half a CPU second a picture at this size
_NUM_FEATURES, _SIZE_PX = 3000, 1600


@dataclass(frozen=True)
class PairMatches:
    """Of two pictures.

    Attributes:
        left, right: (N, 2) pixels, the centre of the first pixel at (0.5, 0.5).
    """

    left: Array
    right: Array

    def __len__(self) -> int:
        return len(self.left)

    @property
    def disparities(self) -> Array:
        """(N,) x_left - x_right."""
        return self.left[:, 0] - self.right[:, 0]

    @property
    def row_differences(self) -> Array:
        """(N,) y_left - y_right: 0 of a rectified pair."""
        return self.left[:, 1] - self.right[:, 1]

    def of(self, kept: NDArray[np.bool_]) -> PairMatches:
        """Those that are kept, (N,) bool."""
        return PairMatches(self.left[kept], self.right[kept])


def match_pictures(
    left: NDArray[np.uint8], right: NDArray[np.uint8],
    left_shown: NDArray[np.bool_] | None = None, right_shown: NDArray[np.bool_] | None = None,
) -> PairMatches:  # fmt: skip
    """SIFT in two pictures (H, W) or (H, W, 3), mutual nearest neighbours that pass the ratio test, not verified.

    Args:
        left_shown, right_shown: (H, W), False where nothing may be detected; None for everywhere.
    """
    options = FeatureOptions(max_num_features=_NUM_FEATURES, max_size_px=_SIZE_PX, max_num_orientations=1)
    found = [
        features_from_picture(picture_of(pixels, shown), options)[0]
        for pixels, shown in ((left, left_shown), (right, right_shown))
    ]
    limits = MatchingOptions()
    if not all(map(len, found)):
        return PairMatches(np.zeros((0, 2)), np.zeros((0, 2)))
    rows = match_sift(found[0].descriptors, found[1].descriptors, limits.max_ratio, limits.max_distance)
    xy = [one.keypoints[rows[:, n], :2].astype(np.float64) for n, one in enumerate(found)]
    return PairMatches(xy[0], xy[1])


def picture_of(pixels: NDArray[np.uint8], shown: NDArray[np.bool_] | None) -> Picture:
    """What features are found in: a picture (H, W) or (H, W, 3), its mask where it does not show all."""
    return Picture(as_rgb(pixels), as_gray(pixels), None if shown is None or shown.all() else shown)
