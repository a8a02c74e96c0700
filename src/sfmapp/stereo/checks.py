"""What speaks against a disparity, and what takes its place: steps, speckles, holes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfmapp.stereo.result import DisparityMap, PixelState, RectifiedPair

Disparity = NDArray[np.float32]

# OpenCV's speckle filter takes whole numbers
_FRACTIONS = 16.0
_NOTHING = -32768


def beside_steps(disparity: Disparity, side: int, step_px: float) -> NDArray[np.bool_]:
    """(H, W): pixels with disparities in the window about them that differ by more than a step.

    A window that shows two surfaces takes the disparity of the one with more contrast, mostly the nearer one, so within
    half a window of a step it is not known which of the two a pixel belongs to.

    Args:
        disparity: (H, W) float32 pixels, NaN unknown.
        side: of the window, pixels, odd.
        step_px: pixels of disparity.
    """
    import cv2

    box, known = np.ones((side, side), np.uint8), np.isfinite(disparity)
    most = cv2.dilate(np.where(known, disparity, np.float32(-1e9)), box)
    least = cv2.erode(np.where(known, disparity, np.float32(1e9)), box)
    return np.asarray(most - least > step_px, np.bool_)


def without_speckles(disparity: Disparity, num_pixels: int, step_px: float) -> Disparity:
    """The map (H, W) without patches of at most so many pixels; neighbours within a step are of one patch."""
    import cv2

    known = np.isfinite(disparity)
    middle = np.float32(np.nanmedian(disparity)) if known.any() else np.float32(0.0)
    steps = np.where(known, np.rint(_FRACTIONS * (disparity - middle)), _NOTHING).astype(np.int16)
    cv2.filterSpeckles(steps, _NOTHING, num_pixels, int(_FRACTIONS * step_px))
    return np.where(steps == _NOTHING, np.float32(np.nan), disparity)


def largest_patch(found: DisparityMap) -> int:
    """Matched pixels of the largest patch without a step of more than a pixel, less those right behind one."""
    import cv2

    known = found.state == PixelState.MATCHED
    whole = known.copy()
    disparity = np.where(known, found.disparity, np.float32(0.0))
    whole[:, 1:] &= (np.abs(np.diff(disparity, axis=1)) <= 1.0) | ~known[:, :-1]
    whole[1:] &= (np.abs(np.diff(disparity, axis=0)) <= 1.0) | ~known[:-1]
    _, _, stats, _ = cv2.connectedComponentsWithStats(whole.astype(np.uint8), connectivity=4)
    return int(stats[1:, cv2.CC_STAT_AREA].max(initial=0))


def fill_holes(disparity: Disparity) -> Disparity:
    """The map (H, W) with its holes filled from both sides of each row by the lesser disparity, as a hole is what
    something nearer hides; rows without any are filled along their columns."""
    out = _fill_rows(disparity)
    empty = np.isnan(out)
    return np.where(empty, _fill_rows(out.T).T, out) if empty.any() else out


def _fill_rows(disparity: Disparity) -> Disparity:
    height, width = disparity.shape
    known, column = np.isfinite(disparity), np.arange(width)
    before = np.maximum.accumulate(np.where(known, column, -1), axis=1)
    behind = np.minimum.accumulate(np.where(known, column, width)[:, ::-1], axis=1)[:, ::-1]
    padded = np.pad(disparity, ((0, 0), (1, 1)), constant_values=np.nan)
    row = np.arange(height)[:, None]
    filled: Disparity = np.fmin(padded[row, before + 1], padded[row, behind + 1])
    return filled


def seen_by_both(disparity: Disparity, pair: RectifiedPair) -> NDArray[np.bool_]:
    """(H, W) where there is a disparity and neither photograph ends before the pixel or its partner."""
    width = disparity.shape[1]
    place = np.arange(width) - np.nan_to_num(disparity)
    column = np.clip(np.rint(place), 0, width - 1).astype(np.int64)
    shown = pair.left_shown & np.take_along_axis(pair.right_shown, column, 1)
    return np.asarray(np.isfinite(disparity) & shown, np.bool_)
