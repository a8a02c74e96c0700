"""Pair after pair of one size, as cameras deliver them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import TracebackType

import cv2
import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.expand import CONTRAST, LEAST_CONTRAST
from sfmapp.errors import UsageError
from sfmapp.images.pixels import as_gray
from sfmapp.stereo.checks import seen_by_both
from sfmapp.stereo.filling import fill_by_planes
from sfmapp.stereo.options import StereoOptions
from sfmapp.stereo.result import DisparityMap, PixelState, RectifiedPair
from sfmapp.stereo.semiglobal import BLANK_WINDOW, LEAST_UNIQUENESS, Level
from sfmapp.stereo.semiglobal_kernels import LANES, NOISE_BINS, collect, even_out, noise_of, report
from sfmapp.stereo.slanted import refine_slanted

# mean difference in grey from the blurred picture, about a pixel, below which there is nothing to match: a saturated
# sky. Noise of a quarter of a grey value, the least there is after rounding, shows more
BLANK = 0.1
# sixteenths of disparities are 16-bit numbers where islands are looked for
MOST_PX = 2047
# islands of fewer pixels, whose disparities differ by more than one from all around them, are dropped
LEAST_ISLAND, ISLAND_STEP_PX = 100, 1


class Matcher:
    """Semi-global matching of rectified pairs of one size: everything that it needs is allocated at the beginning.

    >>> matcher = Matcher(480, 640, (0, 64))
    >>> found = matcher.match(left, right)

    Args:
        height, width: of the pictures, pixels.
        search: the least disparity x_left - x_right that is looked for, which may be negative, and how many from there.
        left_right_px: by how much a disparity may differ when it is looked for from the other side, pixels.
        threads: 1 or 2; what is found does not depend on it.

    Raises:
        UsageError: a size, disparities or a number of threads that cannot be.
    """

    def __init__(
        self, height: int, width: int, search: tuple[int, int], *, left_right_px: float = 1.0, threads: int = 2
    ) -> None:
        if min(height, width) < 1 or search[1] < 1 or threads not in (1, 2):
            raise UsageError(
                f"a matcher of {height} x {width} pixels, {search[1]} disparities and {threads} threads; expected one "
                "of each at least, and at most two threads"
            )
        if search[0] < -MOST_PX or sum(search) > MOST_PX:
            raise UsageError(
                f"disparities from {search[0]} to {sum(search) - 1} px are asked for, the matcher sgm knows them to "
                f"{MOST_PX} on both sides; match smaller pictures"
            )
        self.search, self.shape = search, (height, width)
        self._tolerance = round(left_right_px)
        # a vector holds so many disparities whatever is asked: those about a narrow search are its rivals, for of few
        # disparities one fits by chance
        rivals = max(0, LANES - search[1])
        self._level = Level(height, width, (search[0] - rivals // 2, search[1] + rivals))
        self._pool = ThreadPoolExecutor(threads - 1) if threads > 1 else None
        self._grey = np.empty((2, height, width), np.uint8)
        self._kept = np.empty((height, width), np.int16)
        self._disparity, self._state = np.empty((height, width), np.float32), np.empty((height, width), np.uint8)
        self._scratch = np.empty((height, width), np.float32)
        self._measures = np.empty((3, height, width), np.float32)

    def __enter__(self) -> Matcher:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """End the thread beside."""
        if self._pool is not None:
            self._pool.shutdown()

    def match(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> DisparityMap:
        """Disparities of the left picture.

        Args:
            left, right: (H, W) or (H, W, 3) RGB uint8.

        Returns:
            A map whose arrays are the matcher's own: the next call writes into them. Costs are half the sums of eight
            paths, of differing bits of 48 and penalties.

        Raises:
            UsageError: a picture of another size or type.
        """
        left, right = self._gray(left, 0), self._gray(right, 1)
        found = self._level.match(left, right, self._tolerance, self._pool)
        collect(found, LEAST_UNIQUENESS, self._level.wide_texture, BLANK * BLANK_WINDOW**2, self.search, self._kept)
        cv2.filterSpeckles(self._kept, -32768, LEAST_ISLAND, 16 * ISLAND_STEP_PX)
        report(found, self._kept, self._disparity, self._state, self._measures)
        even_out(self._disparity, self._scratch)
        first, count = self.search
        cost, curvature, uniqueness = self._measures
        return DisparityMap(
            self._disparity, self._state, cost, curvature, uniqueness, (float(first), float(first + count)),
            {"matcher": "sgm"},
        )  # fmt: skip

    def _gray(self, picture: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
        if picture.shape[:2] != self.shape or picture.ndim > 3 or picture.dtype != np.uint8:
            raise UsageError(
                f"the matcher is one of {self.shape[1]} x {self.shape[0]} pixels of uint8, got an array of shape "
                f"{picture.shape} and type {picture.dtype}; make another for this size"
            )
        if picture.ndim == 2:
            return np.ascontiguousarray(picture)
        grey: NDArray[np.uint8] = self._grey[side]
        cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY, dst=grey)
        return grey


def match_by_sgm(pair: RectifiedPair, options: StereoOptions, search: tuple[int, int]) -> DisparityMap:
    """Semi-global matching of one pair; see :class:`Matcher`.

    Raises:
        UsageError: a window is asked for, which this matcher does not have.
    """
    if options.window is not None:
        raise UsageError(f"stereo.window is {options.window}, and the matcher sgm has no window; leave it out")
    height, width = pair.left.shape[:2]
    with Matcher(height, width, search, left_right_px=options.left_right_px) as matcher:
        found = matcher.match(pair.left, pair.right)
    hide_unseen(found, pair)
    if options.refine:
        left = as_gray(pair.left)
        contrast = CONTRAST * noise_of(left, np.empty(NOISE_BINS, np.int64)) + LEAST_CONTRAST
        disparity = refine_slanted(left, as_gray(pair.right), found.disparity, contrast, threads=2)
        even_out(disparity, np.empty_like(disparity))
        found = replace(found, disparity=disparity)
    if options.fill:
        fill(found, pair)
    return found


def fill(found: DisparityMap, pair: RectifiedPair) -> None:
    """Put surfaces from beside it into what was not matched."""
    empty = np.isnan(found.disparity)
    if empty.all():
        return
    filled = empty & pair.left_shown
    found.disparity[filled] = fill_by_planes(found.disparity)[filled]
    found.state[filled] = PixelState.FILLED


def hide_unseen(found: DisparityMap, pair: RectifiedPair) -> None:
    """Take back disparities of pixels that one of the photographs does not reach."""
    if pair.left_shown.all() and pair.right_shown.all():
        return
    hidden = ~seen_by_both(found.disparity, pair)
    found.state[hidden] = PixelState.UNKNOWN
    for values in (found.disparity, found.cost, found.curvature):
        values[hidden] = np.nan
