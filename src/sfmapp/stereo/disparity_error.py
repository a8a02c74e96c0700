"""How far off each disparity may be, told from the pictures and the disparities round it.

No matcher knows its own error: costs are truncated, aggregated and smoothed, and a wrong match may be as sharp as a
right one. So nine cues, which are the same for all matchers, are taken at the disparity that was found: what the
zero-mean NCC of a window says of noise over curvature (Foerstner's error of least-squares matching, the log of
sqrt((1 - ncc) / -ncc'')), of its peak and of the place of its maximum, and how disparities scatter about (for cues of
this kind see Hu and Mordohai, "A quantitative evaluation of confidence measures for stereo vision", PAMI 2012). They
come to one score, a quadratic whose weights were fitted to the logarithm of true errors, and the score to three numbers
by curves of quantiles, so that the statements hold as frequencies: 68 and 95 per cent of the errors are inside, and so
many are below one pixel. What a calibration leaves is the same for neighbours and shows in no cue: it is added.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.images.pixels import as_gray
from sfmapp.stereo.error_table import ERROR_TABLE, ErrorTable
from sfmapp.stereo.filled_error import FILLED_TABLE, filled_cues
from sfmapp.stereo.result import DisparityMap, PixelState, RectifiedPair

Map = NDArray[np.float32]

CUES = ("theory", "mismatch", "off peak", "scatter", "wide scatter", "outlying", "known", "background", "texture")

# window of the NCC, of the near and of the wide scatter, and of the search for a background, pixels
_WINDOW, _NEAR, _WIDE, _AROUND = 7, 5, 11, 13
# variance of a picture that is nothing but rounding and read-out noise, squared grey levels
_DARK_VARIANCE = 0.5
# of NCC: floors below which neither mismatch nor curvature are measured by 49 pixels of 8 bits
_LEAST = 1e-3
# beyond so many pixels a neighbour is another surface, however far
_FAR_PX = 32.0
# What calibration and rectification leave of disparities, a share of the width, 0.13 px of 752: bends that a lens
# model has not, and rows that are a little off. Each of the three photographs of the benchmark alone would choose
# between 1.25e-4 and 2.5e-4. What moves all disparities alike is the covariance of the calibration's part.
RESIDUAL_SHARE = 1.75e-4
# rows of a band: what is held at a time is its width times this times some thirty maps, whatever the height, and most
# of that stays in the cache
_BAND = 64


@dataclass(frozen=True)
class DisparityError:
    """Of each pixel (H, W) float32; NaN where there is no disparity.

    Attributes:
        sigma: the error is below it in 68 per cent of the pixels that are given this one, pixels.
        half_width_95: the same in 95 per cent. More than twice as much where the match itself is in doubt.
        confidence: share of such pixels whose error is below one pixel, 0 to 1; 0 where there is no disparity.
    """

    sigma: Map
    half_width_95: Map
    confidence: Map


def disparity_error(
    pair: RectifiedPair, found: DisparityMap, *, table: ErrorTable = ERROR_TABLE, threads: int = 1
) -> DisparityError:
    """The error of each disparity, by what the pictures say of matches and by what lies about filled ones.

    ``RESIDUAL_SHARE`` of the width is in sigma and half width; the covariance of the calibration is not, but in
    :func:`~sfmapp.stereo.uncertainty.depth_sigma`.

    Args:
        table: what scores mean, fitted by ``benchmarks/stereo_sigma.py``. threads: bands of rows at a time.
    """
    residual = RESIDUAL_SHARE * found.disparity.shape[1]
    shape = found.disparity.shape
    result = DisparityError(*(np.full(shape, value, np.float32) for value in (np.nan, np.nan, 0.0)))

    def fill(band: tuple[slice, slice, slice]) -> None:
        wide, inner, rows = band
        cues, known = match_cues(pair, found, wide)
        told = with_residual(table.read(cues[:, inner]), residual)
        for field, values in zip((result.sigma, result.half_width_95, result.confidence), told, strict=True):
            np.copyto(field[rows], values, where=known[inner])

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(fill, _bands(shape[0])))
    if (found.state == PixelState.FILLED).any():
        cues, place = filled_cues(found)
        told = with_residual(FILLED_TABLE.read(cues), residual)
        for field, values in zip((result.sigma, result.half_width_95, result.confidence), told, strict=True):
            field.ravel()[place] = values
    return result


def with_residual(told: tuple[Map, Map, Map], residual_px: float) -> tuple[Map, Map, Map]:
    """Sigma, half width and confidence with the standard deviation of something that they do not know of."""
    sigma, half_width, confidence = told
    return np.hypot(sigma, np.float32(residual_px)), np.hypot(half_width, np.float32(1.96 * residual_px)), confidence


def match_cues(pair: RectifiedPair, found: DisparityMap, rows: slice = slice(None)) -> tuple[Map, NDArray[np.bool_]]:
    """The cues (9, R, W) of the rows asked for, in the order of ``CUES``, and which pixels (R, W) were matched. Within
    ``_AROUND`` // 2 of the first and the last row windows reach beyond them, and are mirrored."""
    left, right = (as_gray(picture[rows]).astype(np.float32) for picture in (pair.left, pair.right))
    known = (found.state[rows] == PixelState.MATCHED) & np.isfinite(found.disparity[rows])
    disparity = np.where(known, found.disparity[rows], np.float32(0.0))
    return cues_of(left, _shifted(right, disparity), disparity, known), known


def cues_of(picture: Map, seen: Iterable[Map], disparity: Map, known: NDArray[np.bool_]) -> Map:
    """The cues (9, H, W) of a picture (H, W) float32, of what others show at its disparities, and these.

    Args:
        picture: grey values; what is not known of it becomes zero.
        seen: three pictures (H, W), used up one by one: what another photograph shows where the disparity is one pixel
            less, as it is, and one more.
        disparity: (H, W) pixels, zero where it is not known.
        known: (H, W).
    """
    cues = np.empty((len(CUES), *disparity.shape), np.float32)
    _correlation_cues(cues, picture, seen, known)
    _scatter_cues(cues, disparity, known)
    return cues


def _shifted(right: Map, disparity: Map) -> Iterator[Map]:
    """What the right picture shows at a disparity of one pixel less, at this one, and at one of one pixel more."""
    import cv2

    height, width = disparity.shape
    y = np.repeat(np.arange(height, dtype=np.float32)[:, None], width, axis=1)
    # whole pixels and parts of one: those are the same for all three
    place, part = cv2.convertMaps(np.arange(width, dtype=np.float32) - disparity, y, cv2.CV_16SC2)
    place[..., 0] += 2
    for _ in range(3):
        place[..., 0] -= 1
        yield cv2.remap(right, place, part, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _correlation_cues(cues: Map, left: Map, pictures: Iterable[Map], known: NDArray[np.bool_]) -> None:
    """What the zero-mean NCC of a window says, of the disparity and of one pixel more and less."""
    (farther, here, nearer), variance = correlations(left, pictures, known)
    curvature = np.maximum(2.0 * here - farther - nearer, np.float32(_LEAST))
    mismatch = np.maximum(1.0 - here, np.float32(_LEAST))
    nearer -= farther
    nearer *= 0.5
    nearer /= curvature
    np.log((mismatch + np.float32(_LEAST)) / curvature, out=cues[0])
    np.log(mismatch, out=cues[1])
    np.log(np.minimum(np.abs(nearer, out=nearer), 1.0) + np.float32(0.05), out=cues[2])
    np.log(variance, out=cues[8])
    cues[0] *= 0.5
    cues[8] *= 0.5


def correlations(picture: Map, pictures: Iterable[Map], known: NDArray[np.bool_]) -> tuple[list[Map], Map]:
    """The zero-mean NCC of the window about each pixel with each of some pictures (H, W), and the window's variance in
    squared grey values. Each pixel of the window goes by its own disparity, so that slanted surfaces match as well as
    others; where it has none (``known``) it does not count, and ``picture`` becomes zero."""
    mask = known.astype(np.float32)
    share = np.maximum(window_mean(mask, _WINDOW), np.float32(1e-6))
    picture *= mask
    own_mean = window_mean(picture, _WINDOW) / share
    own_variance = _variance(window_mean(picture * picture, _WINDOW), share, own_mean)
    ncc = []
    for seen in pictures:
        seen *= mask
        mean = window_mean(seen, _WINDOW)
        mean /= share
        both = window_mean(picture * seen, _WINDOW)
        both /= share
        both -= own_mean * mean
        variance = _variance(window_mean(np.square(seen, out=seen), _WINDOW), share, mean)
        variance *= own_variance
        both /= np.sqrt(variance, out=variance)
        ncc.append(both)
    return ncc, own_variance


def _variance(square: Map, share: Map, mean: Map) -> Map:
    """Of grey values of windows, from the mean of their squares over all pixels and their mean over known ones."""
    square /= share
    square -= mean * mean
    np.maximum(square, np.float32(0.0), out=square)
    square += np.float32(_DARK_VARIANCE)
    return square


def _scatter_cues(cues: Map, disparity: Map, known: NDArray[np.bool_]) -> None:
    """How disparities scatter in a small and in a wide window, how far this one is from their mean, how many are
    known, and how far behind something stands."""
    import cv2

    mask = known.astype(np.float32)
    for cue, side in ((3, _NEAR), (4, _WIDE)):
        share = np.maximum(window_mean(mask, side), np.float32(1e-6))
        # squares of disparities of some hundred pixels leave no digits for their scatter in single precision
        mean = cv2.boxFilter(disparity, cv2.CV_64F, (side, side), borderType=cv2.BORDER_REFLECT)
        square = cv2.sqrBoxFilter(disparity, cv2.CV_64F, (side, side), borderType=cv2.BORDER_REFLECT)
        mean /= share  # disparities are zero where they are not known
        square /= share
        square -= mean * mean
        np.sqrt(np.maximum(square, 0.0, out=square), out=cues[cue], casting="same_kind")
    np.abs(disparity - mean, out=cues[5], casting="same_kind")
    cues[3:6] += np.float32(0.05)
    np.log(cues[3:6], out=cues[3:6])
    cues[6] = share
    nearest_to_background = np.where(known, disparity, np.float32(np.inf))
    np.subtract(disparity, cv2.erode(nearest_to_background, np.ones((_AROUND, _AROUND), np.uint8)), out=cues[7])
    np.clip(cues[7], 0.0, _FAR_PX, out=cues[7])
    cues[7] += np.float32(0.1)
    np.log(cues[7], out=cues[7])


def _bands(height: int) -> Iterator[tuple[slice, slice, slice]]:
    """Bands with the rows that their windows reach: those, the band in them, and the band in the picture."""
    margin = _AROUND // 2
    for start in range(0, height, _BAND):
        end = min(start + _BAND, height)
        first = max(start - margin, 0)
        yield slice(first, min(end + margin, height)), slice(start - first, end - first), slice(start, end)


def window_mean(values: NDArray[Any], side: int) -> NDArray[Any]:
    """Mean of each pixel's window (H, W), mirrored at the border; of the type of the values."""
    import cv2

    mean: NDArray[Any] = cv2.boxFilter(values, -1, (side, side), normalize=True, borderType=cv2.BORDER_REFLECT)
    return mean
