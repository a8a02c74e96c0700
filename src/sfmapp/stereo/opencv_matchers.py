"""OpenCV's matchers of rectified pairs, as what ours are compared with."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.images.pixels import as_gray
from sfmapp.stereo.checks import seen_by_both
from sfmapp.stereo.options import StereoOptions
from sfmapp.stereo.result import DisparityMap, PixelState, RectifiedPair

# StereoSGBM: Hirschmueller's penalties as OpenCV's own sample has them, by channels and window
_SMALL_STEP, _LARGE_STEP, _SGBM_WINDOW, _BM_WINDOW = 8, 32, 5, 15
# disparities of OpenCV have four binary digits behind the point
_FRACTIONS = 16.0
# OpenCV searches whole sixteens
_STEP = 16


def match_by_sgbm(pair: RectifiedPair, options: StereoOptions, search: tuple[int, int]) -> DisparityMap:
    """StereoSGBM in its mode of eight paths with the penalties and tests of OpenCV's sample ``stereo_match``.

    Args:
        search: the least disparity, and how many from there on; OpenCV takes the next multiple of 16.
    """
    import cv2

    window = options.window or _SGBM_WINDOW
    first, count = _whole_sixteens(search)
    channels = 1 if pair.left.ndim == 2 else pair.left.shape[2]
    matcher = cv2.StereoSGBM.create(
        minDisparity=first, numDisparities=count, blockSize=window, P1=_SMALL_STEP * channels * window**2,
        P2=_LARGE_STEP * channels * window**2, disp12MaxDiff=round(options.left_right_px), preFilterCap=63,
        uniquenessRatio=10, speckleWindowSize=100, speckleRange=32, mode=cv2.STEREO_SGBM_MODE_HH,
    )  # fmt: skip
    return _matched(matcher, pair.left, pair.right, (first, count), pair, "opencv-sgbm")


def match_by_bm(pair: RectifiedPair, options: StereoOptions, search: tuple[int, int]) -> DisparityMap:
    """StereoBM, block matching by sums of absolute differences; ``search`` as of :func:`match_by_sgbm`."""
    import cv2

    first, count = _whole_sixteens(search)
    matcher = cv2.StereoBM.create(numDisparities=count, blockSize=max(options.window or _BM_WINDOW, 5))
    matcher.setMinDisparity(first)
    matcher.setDisp12MaxDiff(round(options.left_right_px))
    left, right = as_gray(pair.left), as_gray(pair.right)
    return _matched(matcher, left, right, (first, count), pair, "opencv-bm")


def _whole_sixteens(search: tuple[int, int]) -> tuple[int, int]:
    return search[0], -(-search[1] // _STEP) * _STEP


def _matched(
    matcher: Any, left: NDArray[np.uint8], right: NDArray[np.uint8], search: tuple[int, int], pair: RectifiedPair,
    name: str,
) -> DisparityMap:  # fmt: skip
    """What a matcher of OpenCV finds. It leaves blank as many columns as it searches disparities at the side where the
    right picture ends: both pictures are widened there first."""
    import cv2

    first, count = search
    before, behind = max(first + count, 0), max(-first, 0)
    wide = [cv2.copyMakeBorder(one, 0, 0, before, behind, cv2.BORDER_REPLICATE) for one in (left, right)]
    fixed = matcher.compute(*wide)[:, before : before + left.shape[1]]
    disparity = fixed.astype(np.float32) / np.float32(_FRACTIONS)
    # what it found beyond the border is of its own making
    x = np.arange(disparity.shape[1], dtype=np.float32) + 0.5 - disparity
    known = (fixed >= first * _FRACTIONS) & (x >= 0.0) & (x <= disparity.shape[1])
    disparity[~known] = np.nan
    known = seen_by_both(disparity, pair)
    disparity[~known] = np.nan
    unknown = np.full(disparity.shape, np.nan, np.float32)
    state = np.where(known, np.uint8(PixelState.MATCHED), np.uint8(PixelState.UNKNOWN)).astype(np.uint8)
    return DisparityMap(
        disparity, state, unknown, unknown, np.zeros(disparity.shape, np.float32),
        (float(first), float(first + count)), {"matcher": name},
    )  # fmt: skip
