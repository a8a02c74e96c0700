"""Disparities by windows: each pixel alone takes the disparity at which what is about it looks most alike.

``nested`` adds the mean costs of three windows about the pixel, the next 2.6 times as large as the one before: near
pixels weigh much, and where there is little to see many far ones still speak. ``fixed`` has one window. ``adaptive``
takes, for each pixel and disparity, that of several sizes whose mean cost is the least. ``shiftable`` moves one window
to where it fits best, on the pixel or half its side off in eight directions (Kang, Szeliski and Chai, CVPR 2001).
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from sfmapp.images.pixels import as_gray
from sfmapp.stereo.checks import beside_steps, seen_by_both, without_speckles
from sfmapp.stereo.costs import GREATEST, NUMBERS, planes_of
from sfmapp.stereo.filling import fill_by_planes
from sfmapp.stereo.options import StereoOptions, WindowsName
from sfmapp.stereo.result import DisparityMap, PixelState, RectifiedPair
from sfmapp.stereo.window_kernels import LEAST, SUM, Found, Search, Windows, match_rows

# shares of the option ``window``, and its default
_SHARES: dict[WindowsName, tuple[float, ...]] = {
    "nested": (0.385, 1.0, 2.54), "fixed": (1.0,), "adaptive": (0.333, 0.6, 1.0, 1.4), "shiftable": (1.0,),
}  # fmt: skip
_SIDES: dict[WindowsName, int] = {"nested": 13, "fixed": 15, "adaptive": 15, "shiftable": 11}
# The second best disparity costs so much more, as a share. From 0.09 to 0.105 errors are below and densities above
# those of StereoBM in three shared and six rendered pairs.
_LEAST_UNIQUENESS = 0.1
# of what fills holes first: an answer that is seen from both sides, although not by far the best one
_LEAST_OF_FILLING = 0.05
# windows of 5 pixels that hold a step of more than 2 show two surfaces
_STEP_SIDE, _STEP_PX = 5, 2.0
# patches that are no larger belong to nothing: OpenCV's sample, and neighbours as on a slope of 45 degrees
_SPECKLE, _SPECKLE_STEP_PX = 100, 1.0
_LANES = 16


def match_by_windows(pair: RectifiedPair, options: StereoOptions, search: tuple[int, int]) -> DisparityMap:
    """Match windows of any size in constant time per pixel and disparity.

    Args:
        pair: the pictures.
        options: cost, windows, left-right tolerance, filling.
        search: the least disparity, and how many from there on.
    """
    sides = window_sides(options)
    found = best_disparities(as_gray(pair.left), as_gray(pair.right), search, options)
    seen = seen_by_both(found.disparity, pair)
    unique = found.uniqueness >= _LEAST_UNIQUENESS
    disparity = np.where(seen & unique, found.disparity, np.float32(np.nan))
    disparity[beside_steps(disparity, _STEP_SIDE, _STEP_PX)] = np.nan
    disparity = without_speckles(disparity, _SPECKLE, _SPECKLE_STEP_PX)
    matched = np.isfinite(disparity)
    state = np.where(matched, np.uint8(PixelState.MATCHED), np.uint8(PixelState.UNKNOWN)).astype(np.uint8)
    info = {
        "matcher": "window", "cost": options.cost, "windows": options.windows, "sides_px": list(sides),
        "seen_from_one_side": int((~seen).sum()), "not_unique": int((seen & ~unique).sum()),
        "beside_a_step_or_speckle": int((seen & unique & ~matched).sum()),
    }  # fmt: skip
    if options.fill and matched.any():
        weak = np.where(seen & (found.uniqueness >= _LEAST_OF_FILLING), found.disparity, np.float32(np.nan))
        weak = without_speckles(np.where(matched, disparity, weak), _SPECKLE, _SPECKLE_STEP_PX)
        disparity = fill_by_planes(np.where(matched, disparity, weak))
        filled = ~matched & pair.left_shown
        state[filled] = PixelState.FILLED
        disparity[~matched & ~filled] = np.nan
    known = state == PixelState.MATCHED
    cost, curvature = (np.where(known, plane, np.float32(np.nan)) for plane in (found.cost, found.curvature))
    searched = (float(search[0]), float(search[0] + search[1] - 1))
    uniqueness = np.where(known, found.uniqueness, np.float32(0.0))
    return DisparityMap(disparity, state, cost, curvature, uniqueness, searched, info)


def window_sides(options: StereoOptions) -> tuple[int, ...]:
    """Sides of the windows, pixels, odd."""
    side = options.window or _SIDES[options.windows]
    return tuple(2 * round(0.5 * (share * side - 1.0)) + 1 for share in _SHARES[options.windows])


def best_disparities(
    left: NDArray[np.uint8], right: NDArray[np.uint8], search: tuple[int, int], options: StereoOptions
) -> Found:
    """The best disparity of every pixel of the left of two grey pictures (H, W) uint8, before any test but that of the
    other side."""
    sides = window_sides(options)
    first, count = search
    stride = -(-count // _LANES) * _LANES
    shift = max(math.ceil(math.log2(count)), 1)
    beyond = max(sides) // 2 + 1
    reach = (beyond + max(-first, 0), beyond + max(first + stride, 0))
    # costs and numbers of disparities share 32 bits
    steps = (2.0 ** (32 - shift) - 2.0) / (1.001 * GREATEST[options.cost])
    planes = planes_of(left, right, options.cost, sides, beyond, reach)
    weights = np.full(len(sides), 1.0 / len(sides), np.float32)
    windows = Windows(
        np.array(sides, np.int64) // 2, weights, LEAST if options.windows == "adaptive" else SUM,
        sides[0] // 2 if options.windows == "shiftable" else 0,
    )  # fmt: skip
    looked_for = Search(first, count, stride, reach[0], beyond, shift, steps, float(options.left_right_px))
    found = Found(*(np.full(left.shape, np.nan, np.float32) for _ in range(4)))
    middle = left.shape[0] // 2

    def match(rows: tuple[int, int]) -> None:
        match_rows(NUMBERS[options.cost], planes, looked_for, windows, rows, found)

    # sums are whole numbers: what is found does not depend on where they begin
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(match, ((0, middle), (middle, left.shape[0]))))
    return found
