"""Which disparities a pair is searched for: told by options, by sparse matches, and by the pair matched when small."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sfmapp.stereo.matcher import MOST_PX, match_by_sgm
from sfmapp.stereo.options import StereoOptions
from sfmapp.stereo.result import RectifiedPair
from sfmapp.stereo.sparse_matches import PairMatches, match_pictures

# disparities of the nearest and the farthest in a hundred matches are widened by so much of their range, for keypoints
# lie on what has texture and what is nearest may have none
_QUANTILES, _WIDENED, _LEAST_MARGIN_PX = (0.01, 0.99), 0.2, 8.0
# fewer matches than this tell no range; the search is then a share of the width, as OpenCV's samples have it
_FEW_MATCHES, _SHARE_OF_WIDTH = 20, 1.0 / 8.0
# two features that match may still lie a little off the row
_ROW_PX = 2.0
# the longer side of the small pair at most, pixels; how much of the width its disparities may be; the share of pixels
# that has to be matched, as of unrelated pictures few are; and the share that may be wrong on either side: three of the
# least islands that the matcher leaves
_SMALL_PX, _NEAREST, _LEAST_DENSITY, _SMALL_QUANTILES = 320, 0.5, 0.2, (0.003, 0.997)


def search_range(
    pair: RectifiedPair, options: StereoOptions, matches: PairMatches | None = None
) -> tuple[tuple[int, int], str]:
    """The least disparity, how many from there on, and what tells it: options, matches, or nothing.

    Keypoints are not found again where a surface is steep, as a road in front of a car: the pair is matched as a small
    one as well, up to half its width, and the search holds what either tells. A point at infinity has the disparity
    ``-doffs`` where cameras are known: nothing is looked for beyond it.
    """
    if options.min_disparity is not None and options.num_disparities is not None:
        return (options.min_disparity, options.num_disparities), "options"
    matches = match_pictures(pair.left, pair.right) if matches is None else matches
    found = matches.disparities[np.abs(matches.row_differences) < _ROW_PX]
    infinity = -float("inf") if pair.geometry is None else -pair.geometry.doffs
    start = 0.0 if pair.geometry is None else infinity
    low, high, tellers = start, start + _SHARE_OF_WIDTH * pair.left.shape[1], []
    if len(found) >= _FEW_MATCHES:
        low, high = np.quantile(found, _QUANTILES)
        margin = max(_WIDENED * (high - low), _LEAST_MARGIN_PX)
        low, high = max(low - margin, infinity - 1.0), high + margin
        tellers.append(f"{len(found)} sparse matches")
    told = _range_of_small(pair, min(low, start), max(high, start + _NEAREST * pair.left.shape[1]))
    if told is not None:
        ends = [told] if not tellers else [told, (low, high)]
        low, high = max(min(end[0] for end in ends), infinity - 1.0), max(end[1] for end in ends)
        tellers.append("the pair matched when small")
    first = int(np.floor(low)) if options.min_disparity is None else options.min_disparity
    count = max(int(np.ceil(high)) - first, 1) if options.num_disparities is None else options.num_disparities
    return (first, count), " and ".join(tellers) or "the width of the picture"


def _range_of_small(pair: RectifiedPair, least: float, greatest: float) -> tuple[float, float] | None:
    """Least and greatest disparity, in pixels of the pair, of a small copy of it; None where too little matches."""
    height, width = pair.left.shape[:2]
    scale = max(1.0, max(height, width) / _SMALL_PX)
    size = (max(round(width / scale), 1), max(round(height / scale), 1))
    scale = width / size[0]
    # a pixel is shown where all of it is
    shown = [_shrunk(255 * part.astype(np.uint8), size) == 255 for part in (pair.left_shown, pair.right_shown)]
    small = RectifiedPair(_shrunk(pair.left, size), _shrunk(pair.right, size), shown[0], shown[1])
    first = int(np.floor(least / scale)) - 1
    found = match_by_sgm(small, StereoOptions(), (first, int(np.ceil(greatest / scale)) + 1 - first))
    if found.density < _LEAST_DENSITY:
        return None
    low, high = np.nanquantile(found.disparity, _SMALL_QUANTILES)
    margin = max(2.0 * scale, _LEAST_MARGIN_PX)
    return max(scale * float(low) - margin, -MOST_PX), min(scale * float(high) + margin, MOST_PX)


def _shrunk(picture: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
