"""A rectified pair to its disparities, by any of the matchers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sfmapp.stereo.matcher import match_by_sgm
from sfmapp.stereo.opencv_matchers import match_by_bm, match_by_sgbm
from sfmapp.stereo.options import MatcherName, StereoOptions
from sfmapp.stereo.result import DisparityMap, RectifiedPair
from sfmapp.stereo.sparse_matches import PairMatches, match_pictures
from sfmapp.stereo.windows import match_by_windows

MATCHERS: dict[MatcherName, Callable[[RectifiedPair, StereoOptions, tuple[int, int]], DisparityMap]] = {
    "sgm": match_by_sgm,
    "window": match_by_windows,
    "opencv-sgbm": match_by_sgbm,
    "opencv-bm": match_by_bm,
}
"""By name: of a pair, the options, and the least disparity with how many from there on."""

# disparities of the nearest and the farthest in a hundred matches are widened by so much of their range, for keypoints
# lie on what has texture and what is nearest may have none
_QUANTILES, _WIDENED, _LEAST_MARGIN_PX = (0.01, 0.99), 0.2, 8.0
# fewer matches than this tell no range; the search is then a share of the width, as OpenCV's samples have it
_FEW_MATCHES, _SHARE_OF_WIDTH = 20, 1.0 / 8.0
# two features that match may still lie a little off the row
_ROW_PX = 2.0


def match_pair(
    pair: RectifiedPair, options: StereoOptions | None = None, *, matches: PairMatches | None = None
) -> DisparityMap:
    """Find the disparity of every pixel of the left picture.

    Args:
        pair: whose rows are epipolar lines.
        options: which matcher, and what it looks for.
        matches: sparse matches of the pair's pictures, which tell where to search; None: they are found if needed.
    """
    options = options or StereoOptions()
    search, told_by = search_range(pair, options, matches)
    found = MATCHERS[options.matcher](pair, options, search)
    return replace(found, info={**found.info, "range_told_by": told_by})


def search_range(
    pair: RectifiedPair, options: StereoOptions, matches: PairMatches | None = None
) -> tuple[tuple[int, int], str]:
    """The least disparity, how many from there on, and what tells it: options, sparse matches, or nothing.

    A point at infinity has the disparity ``-doffs`` where cameras are known: nothing is looked for beyond it.
    """
    if options.min_disparity is not None and options.num_disparities is not None:
        return (options.min_disparity, options.num_disparities), "options"
    matches = match_pictures(pair.left, pair.right) if matches is None else matches
    found = matches.disparities[np.abs(matches.row_differences) < _ROW_PX]
    infinity = -float("inf") if pair.geometry is None else -pair.geometry.doffs
    if len(found) < _FEW_MATCHES:
        start = 0.0 if pair.geometry is None else infinity
        low, high, told_by = start, start + _SHARE_OF_WIDTH * pair.left.shape[1], "the width of the picture"
    else:
        low, high = np.quantile(found, _QUANTILES)
        margin = max(_WIDENED * (high - low), _LEAST_MARGIN_PX)
        low, high, told_by = low - margin, high + margin, f"{len(found)} sparse matches"
        low = max(low, infinity - 1.0)
    first = int(np.floor(low)) if options.min_disparity is None else options.min_disparity
    count = max(int(np.ceil(high)) - first, 1) if options.num_disparities is None else options.num_disparities
    return (first, count), told_by
