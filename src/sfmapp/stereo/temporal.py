"""Whether depths stay where nothing moves: one pair of a film beside the pair before.

No truth is needed for it: what did not move is where it was. A pixel surely has not moved where the window about it in
the left picture changed by less than a shift of a quarter of a pixel would change it, whichever way it went (the least
eigenvalue of the structure tensor, as Shi and Tomasi, CVPR 1994, have it for what can be tracked). Disparities of these
have to agree within the 95 per cent intervals of both; of independent errors 95 in 100 do, and more where both have an
error in common.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.images.pixels import as_gray
from sfmapp.reporting import Report
from sfmapp.stereo.disparity_error import window_mean
from sfmapp.stereo.result import DisparityMap, PixelState

Map = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Of 8 bits, noise of a few grey levels becomes less than one by this blur, so that it is no change.
_BLUR_PX, _WINDOW = 1.5, 11
# Disparities of one surface change by less than places do (Burt and Julesz, Science 1980), so that what moves by less
# changes no disparity by more than this.
_STILL_PX = 0.25
# a film of which fewer pixels than this share are still says nothing of itself
_LEAST_SHARE = 0.01


class ConsistencyReport(Report):
    """How a pair agrees with the pair before, where nothing has moved between.

    Attributes:
        compared_with: name of the pair before.
        still_share: of all pixels, those that surely have not moved, and were matched before.
        kept_share: of these, those that are matched again; absent, as what follows, where hardly any has not moved.
        agreeing_share: of those that are matched again, those whose disparities agree within their 95 % intervals.
        median_change_px: of the size of the change of these disparities.
    """

    compared_with: str
    still_share: float
    kept_share: float | None = None
    agreeing_share: float | None = None
    median_change_px: float | None = None


class FilmReport(Report):
    """How the pairs of a film agree, each with the one before.

    Attributes:
        num_compared: pairs with enough that has not moved, of ``num_following``, those that have one before them.
        kept_share, agreeing_share, median_change_px: the medians of these pairs; absent where there are none.
        worst: name of the pair that agrees least. worst_agreeing_share: that.
    """

    num_following: int
    num_compared: int
    kept_share: float | None = None
    agreeing_share: float | None = None
    median_change_px: float | None = None
    worst: str | None = None
    worst_agreeing_share: float | None = None


@dataclass(frozen=True)
class Moment:
    """What is kept of a pair until the next.

    Attributes:
        name: of the pair. gray: (H, W) uint8, the left picture. shown: (H, W) bool, where it is one.
        disparity, half_width_95: (H, W) float32 pixels, NaN where nothing was matched.
    """

    name: str
    gray: NDArray[np.uint8]
    shown: Mask
    disparity: Map
    half_width_95: Map

    @staticmethod
    def of(name: str, left: NDArray[np.uint8], shown: Mask, found: DisparityMap, half_width_95: Map) -> Moment:
        """Of a matched pair; filled pixels are guesses, and left out."""
        disparity = np.where(found.state == PixelState.MATCHED, found.disparity, np.float32(np.nan))
        return Moment(name, as_gray(left), shown, disparity, half_width_95)


def compare_moments(before: Moment, now: Moment) -> ConsistencyReport:
    """How the disparities of two moments agree where the left picture stays as it is."""
    if before.gray.shape != now.gray.shape:  # of rectifications of their own
        return ConsistencyReport(compared_with=before.name, still_share=0.0)
    is_still = still_pixels(before.gray, now.gray) & before.shown & now.shown & np.isfinite(before.disparity)
    share = float(is_still.mean())
    again = is_still & np.isfinite(now.disparity)
    if share < _LEAST_SHARE or not again.any():
        return ConsistencyReport(compared_with=before.name, still_share=share)
    change = np.abs(now.disparity[again] - before.disparity[again])
    allowed = np.hypot(now.half_width_95[again], before.half_width_95[again])
    return ConsistencyReport(
        compared_with=before.name, still_share=share, kept_share=float(again.sum() / is_still.sum()),
        agreeing_share=float((change <= allowed).mean()), median_change_px=float(np.median(change)),
    )  # fmt: skip


def film_report(pairs: Iterable[tuple[str, ConsistencyReport]]) -> FilmReport | None:
    """Of the pairs by name that have one before them; None without such."""
    told = list(pairs)
    if not told:
        return None
    rows = [
        (each.agreeing_share, each.kept_share, each.median_change_px, name)
        for name, each in told
        if each.agreeing_share is not None and each.kept_share is not None and each.median_change_px is not None
    ]
    if not rows:
        return FilmReport(num_following=len(told), num_compared=0)
    agreeing, kept, change = np.median([row[:3] for row in rows], axis=0).tolist()
    worst = min(rows)
    return FilmReport(
        num_following=len(told), num_compared=len(rows), kept_share=kept, agreeing_share=agreeing,
        median_change_px=change, worst=worst[3], worst_agreeing_share=worst[0],
    )  # fmt: skip


def still_pixels(before: NDArray[np.uint8], now: NDArray[np.uint8]) -> Mask:
    """(H, W): whose windows surely show the same at the same place. Brightness may change as a whole. What has no
    texture, or that of an edge alone, could have moved unseen.

    Args:
        before, now: (H, W) uint8 grey values.
    """
    import cv2

    first, second = (cv2.GaussianBlur(picture.astype(np.float32), (0, 0), _BLUR_PX) for picture in (before, now))
    both = first + second
    dx, dy = (cv2.Sobel(both, cv2.CV_32F, *order, ksize=1, scale=0.25) for order in ((1, 0), (0, 1)))
    change = second - first
    change -= window_mean(change, _WINDOW)
    xx, xy, yy = window_mean(dx * dx, _WINDOW), window_mean(dx * dy, _WINDOW), window_mean(dy * dy, _WINDOW)
    least = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    is_still: Mask = window_mean(change * change, _WINDOW) < _STILL_PX**2 * least
    return is_still
