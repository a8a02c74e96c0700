"""What speaks for and against a disparity that was filled in: how far from matches it is, and how they differ.

Nothing in the right picture tells of what it does not show. What tells is the hole: how near the next match is, how
wide the hole, how far apart its two ends and how much of it nothing can hide, whether it ends at the border, and how
matches scatter around. The logarithms of both intervals are linear in the logarithms of these, as quantiles of true
errors of rendered pairs have it (Koenker and Bassett, "Regression quantiles", Econometrica 1978), and the chance to be
right within a pixel is logistic. ``benchmarks/stereo_filled_sigma.py`` fits them, and judges them on photographs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sfmapp.stereo.result import DisparityMap, PixelState

Floats = NDArray[np.float32]

FILLED_CUES = ("distance", "gap", "jump", "beyond", "border", "scatter", "off", "step")

# the window whose matches are looked at, pixels
_AROUND = 31
# below which pixels are the same, and beyond which a surface is another however far
_SMALL_PX, _FAR_PX = 0.1, 64.0


# cues beyond so many of their standard deviations over the pairs of the fit are taken as that
_LIMIT = 4.0


@dataclass(frozen=True)
class FilledTable:
    """From C cues to intervals.

    Attributes:
        centers, spreads: (C,) means and standard deviations of the cues over the pairs of the fit.
        sigma, half_width_95, confidence: (1 + C,) of 1 and the cues so normalised: logarithms of pixels, and log odds.
    """

    centers: Sequence[float]
    spreads: Sequence[float]
    sigma: Sequence[float]
    half_width_95: Sequence[float]
    confidence: Sequence[float]

    def normalised(self, cues: Floats) -> Floats:
        """(N, 1 + C) of cues (C, N): 1 and the cues less their means, in standard deviations."""
        centers, spreads = (np.asarray(values, np.float32) for values in (self.centers, self.spreads))
        normal = np.clip((cues.T - centers) / spreads, -_LIMIT, _LIMIT)
        return np.column_stack([np.ones(len(normal), np.float32), normal])

    def read(self, cues: Floats) -> tuple[Floats, Floats, Floats]:
        """Sigma, 95 per cent half width and confidence (N,) of cues (C, N)."""
        normal = self.normalised(cues)
        sigma, half_width, odds = (
            normal @ np.asarray(row, np.float32) for row in (self.sigma, self.half_width_95, self.confidence)
        )
        confidence = (1.0 / (1.0 + np.exp(-odds))).astype(np.float32)
        return np.exp(sigma), np.exp(np.maximum(half_width, sigma)), confidence


class _Ends(NamedTuple):
    """Of the hole of each filled pixel (N,): pixels to its ends along the row, disparities there, NaN at borders."""

    before_px: Floats
    behind_px: Floats
    before: Floats
    behind: Floats


def filled_cues(found: DisparityMap) -> tuple[Floats, NDArray[np.int64]]:
    """Cues (8, N) of the N filled pixels, in the order of ``FILLED_CUES``, and their places in the raveled map."""
    known = (found.state == PixelState.MATCHED) & np.isfinite(found.disparity)
    place = np.flatnonzero((found.state == PixelState.FILLED) & np.isfinite(found.disparity))
    disparity = np.where(known, found.disparity, np.float32(0.0))
    here = found.disparity.ravel()[place]
    ends = _ends(disparity, known, place)
    distance = cv2.distanceTransform((~known).astype(np.uint8), cv2.DIST_L2, 3).ravel()[place]
    gap = ends.before_px + ends.behind_px - 1.0
    is_border = np.isnan(ends.before) | np.isnan(ends.behind)
    jump = np.nan_to_num(np.abs(ends.before - ends.behind))
    beyond = np.where(is_border, gap, np.maximum(gap - jump, 0.0))
    off = np.fmin(np.abs(here - ends.before), np.abs(here - ends.behind))
    mean, scatter, step = _around(disparity, known, place)
    cues = np.stack([
        np.log(distance), np.log(gap), _log(jump), np.log(1.0 + beyond), is_border.astype(np.float32), _log(scatter),
        _log(np.abs(here - mean)), _log(np.where(np.isfinite(off), off, np.abs(here - step))),
    ])  # fmt: skip
    return cues.astype(np.float32), place


def _log(pixels: NDArray[np.floating]) -> Floats:
    return np.asarray(np.log(_SMALL_PX + np.clip(pixels, 0.0, _FAR_PX)), np.float32)


def _ends(disparity: Floats, known: NDArray[np.bool_], place: NDArray[np.int64]) -> _Ends:
    width = disparity.shape[1]
    column = np.arange(width, dtype=np.int32)
    before = np.maximum.accumulate(np.where(known, column, -1), axis=1).ravel()[place]
    behind = np.minimum.accumulate(np.where(known, column, width)[:, ::-1], axis=1)[:, ::-1].ravel()[place]
    row, own = np.divmod(place, width)
    values = [
        np.where((at >= 0) & (at < width), disparity[row, np.clip(at, 0, width - 1)], np.float32(np.nan))
        for at in (before, behind)
    ]
    return _Ends((own - before).astype(np.float32), (behind - own).astype(np.float32), values[0], values[1])


def _around(disparity: Floats, known: NDArray[np.bool_], place: NDArray[np.int64]) -> tuple[Floats, Floats, Floats]:
    """Mean and standard deviation of matches in the window about each filled pixel, and the least of them."""
    box = (_AROUND, _AROUND)
    share = cv2.boxFilter(known.astype(np.float32), -1, box, borderType=cv2.BORDER_REFLECT).ravel()[place]
    mean = cv2.boxFilter(disparity, cv2.CV_64F, box, borderType=cv2.BORDER_REFLECT).ravel()[place]
    square = cv2.sqrBoxFilter(disparity, cv2.CV_64F, box, borderType=cv2.BORDER_REFLECT).ravel()[place]
    share = np.maximum(share, 1e-6)
    mean, square = mean / share, square / share
    least = cv2.erode(np.where(known, disparity, np.float32(1e6)), np.ones(box, np.uint8)).ravel()[place]
    return mean, np.sqrt(np.maximum(square - mean * mean, 0.0)), least


FILLED_TABLE = FilledTable(
    centers=(1.746, 3.388, -0.19, 2.972, 0.3667, -0.4485, 0.8039, -0.9563),
    spreads=(1.285, 1.409, 2.195, 1.726, 0.4816, 1.636, 2.102, 1.019),
    sigma=(-0.1903, -0.05061, -0.9014, 0.6004, 1.152, 0.367, 0.1762, 0.5789, 0.1047),
    half_width_95=(3.066, -0.06441, 0.1574, 0.07915, 0.2927, -0.09066, 0.1998, 0.44, -0.1766),
    confidence=(1.041, -0.03247, 0.7307, -0.4043, -0.9007, -0.3151, -0.1319, -0.5461, -0.06173),
)  # fmt: skip
