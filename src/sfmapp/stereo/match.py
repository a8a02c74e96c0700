"""A rectified pair to its disparities, by any of the matchers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from sfmapp.stereo.chance import chance_text
from sfmapp.stereo.matcher import match_by_sgm
from sfmapp.stereo.opencv_matchers import match_by_bm, match_by_sgbm
from sfmapp.stereo.options import MatcherName, StereoOptions
from sfmapp.stereo.result import DisparityMap, RectifiedPair
from sfmapp.stereo.search_range import search_range
from sfmapp.stereo.sparse_matches import PairMatches
from sfmapp.stereo.windows import match_by_windows

MATCHERS: dict[MatcherName, Callable[[RectifiedPair, StereoOptions, tuple[int, int]], DisparityMap]] = {
    "sgm": match_by_sgm,
    "window": match_by_windows,
    "opencv-sgbm": match_by_sgbm,
    "opencv-bm": match_by_bm,
}
"""By name: of a pair, the options, and the least disparity with how many from there on."""


def match_pair(
    pair: RectifiedPair, options: StereoOptions | None = None, *, matches: PairMatches | None = None
) -> DisparityMap:
    """Find the disparity of every pixel of the left picture.

    Args:
        pair: whose rows are epipolar lines.
        options: which matcher, and what it looks for.
        matches: sparse matches of the pair's pictures, which tell where to search; None: they are found if needed.

    Returns:
        The map; ``info["chance"]`` says so where no more is matched than chance would.
    """
    options = options or StereoOptions()
    search, told_by = search_range(pair, options, matches)
    found = MATCHERS[options.matcher](pair, options, search)
    quick = replace(options, refine=False, fill=False)
    chance = chance_text(pair, found, lambda turned: MATCHERS[options.matcher](turned, quick, search))
    told = {"range_told_by": told_by} | ({} if chance is None else {"chance": chance})
    return replace(found, info={**found.info, **told})
