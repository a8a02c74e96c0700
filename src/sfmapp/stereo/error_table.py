"""What a score of cues means: quantiles of true errors, as ``benchmarks/stereo_sigma.py`` fitted them.

The pairs of the fit are rendered, so that their disparities are exact, with sensors whose noise and exposure differ and
rows that are off by what a calibration leaves; no photograph is among them. How it does on photographs with known
disparities is in ``benchmarks/results/stereo_sigma.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float32]

# cues beyond so many of their standard deviations over the pairs of the fit are taken as that: a quadratic is not to be
# followed where there was nothing
_LIMIT = 4.0
# pixels at a time, so that their cues stay in the nearest cache
_BLOCK = 512


@dataclass(frozen=True)
class ErrorTable:
    """From C cues to a score, and from K scores to errors.

    Attributes:
        centers, spreads: (C,) means and standard deviations of the cues over the pairs of the fit.
        weights: (1 + C + C (C + 1) / 2,) of 1, the C cues so normalised, and their products.
        scores: (K,) ascending.
        sigmas, half_widths_95: (K,) pixels, 68 and 95 per cent of the errors are below them at these scores.
        confidences: (K,) share of errors below one pixel.
    """

    centers: Sequence[float]
    spreads: Sequence[float]
    weights: Sequence[float]
    scores: Sequence[float]
    sigmas: Sequence[float]
    half_widths_95: Sequence[float]
    confidences: Sequence[float]

    def normalised(self, cues: NDArray[np.floating]) -> Map:
        """Cues (C, N) less their means, in standard deviations, no farther than the fit is to be followed."""
        centers, spreads = (np.asarray(values, np.float32)[:, None] for values in (self.centers, self.spreads))
        normal: Map = np.clip((cues - centers) / spreads, -_LIMIT, _LIMIT).astype(np.float32)
        return normal

    def read(self, cues: Map) -> tuple[Map, Map, Map]:
        """Sigma, 95 per cent half width and confidence (...,) of cues (C, ...), between the scores of the table by
        their logarithm, and beyond them as at its ends."""
        values = np.stack([np.log(self.sigmas), np.log(self.half_widths_95), np.asarray(self.confidences)])
        slopes = np.diff(values) / np.diff(self.scores)
        turns = np.diff(slopes, prepend=0.0)
        told = np.empty((3, int(np.prod(cues.shape[1:]))), np.float32)
        flat = np.ascontiguousarray(cues.reshape(len(cues), -1), np.float32)
        centers, spreads, weights = (np.array(row, np.float32) for row in (self.centers, self.spreads, self.weights))
        _read(flat, centers, spreads, weights, np.array(self.scores), values[:, 0].copy(), turns, told)
        np.exp(told[:2], out=told[:2])
        sigma, half_width, confidence = told.reshape(3, *cues.shape[1:])
        return sigma, half_width, confidence


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _read(
    cues: Map, centers: Map, spreads: Map, weights: Map, scores: NDArray[np.float64], first: NDArray[np.float64],
    turns: NDArray[np.float64], told: Map,
) -> None:  # fmt: skip
    """Three curves (3, N) at the scores of cues (C, N): straight between ``scores`` (K,), each the sum of its value at
    the first and of what its slope changes by from there on, ``turns`` (3, K - 1). Block by block, in vectors."""
    count, size = cues.shape
    normal, part, score = np.empty((count, _BLOCK), np.float32), np.empty(_BLOCK, np.float32), np.empty(_BLOCK)
    value, total = np.empty(_BLOCK, np.float32), np.empty(_BLOCK)
    for start in range(0, size, _BLOCK):
        length = min(_BLOCK, size - start)
        for c in range(count):
            for x in range(length):
                far = (cues[c, start + x] - centers[c]) / spreads[c]
                normal[c, x] = min(max(far, np.float32(-_LIMIT)), np.float32(_LIMIT))
        value[:] = weights[0]
        term = count + 1
        for i in range(count):
            part[:] = weights[1 + i]
            for j in range(i, count):
                weight = weights[term]
                term += 1
                for x in range(length):
                    part[x] += weight * normal[j, x]
            for x in range(length):
                value[x] += part[x] * normal[i, x]
        for x in range(length):
            score[x] = min(max(np.float64(value[x]), scores[0]), scores[-1])
        for curve in range(3):
            total[:] = first[curve]
            for k in range(len(scores) - 1):
                turn, place = turns[curve, k], scores[k]
                for x in range(length):
                    total[x] += turn * max(score[x] - place, 0.0)
            for x in range(length):
                told[curve, start + x] = total[x]


ERROR_TABLE = ErrorTable(
    centers=(
        -0.086061, -2.1424, -1.4975, -1.8439, -1.3382, -2.028, 0.92944, -0.58034, 1.9217,
    ),
    spreads=(
        1.2071, 1.437, 0.86175, 0.60146, 0.74972, 0.74359, 0.14265, 0.82175, 0.88426,
    ),
    weights=(
        -1.7372, 0.21417, 0.33087, 0.081706, -0.039996, 0.087607, 0.25392, -0.22677, 0.10047,
        0.31447, 0.0027675, 0.14444, -0.14057, -0.033549, 0.086255, -0.02889, 0.0046584, -0.0099471,
        0.12765, 0.12188, 0.081944, -0.082679, 0.063616, -0.099517, -0.04929, 0.00039503, 0.13865,
        0.029614, 0.0034006, 0.030529, -0.03113, 0.0064715, 0.0055574, 0.097513, 0.036736, 0.028365,
        -0.0096622, 0.013577, 0.00024561, -0.049241, -0.072892, -0.024271, -0.051741, -0.031984, 0.043794,
        0.064223, 0.052356, -0.025992, -0.14232, -0.017868, 0.013865, -0.041876, 0.060879, 0.016128,
        0.085572,
    ),
    scores=(
        -2.5749, -2.4028, -2.2903, -2.189, -2.0892, -1.9854, -1.8777, -1.7673, -1.6539,
        -1.5347, -1.4074, -1.2665, -1.122, -0.96015, -0.74828, -0.45573, 0.31604,
    ),
    sigmas=(
        0.084192, 0.09363, 0.10713, 0.12718, 0.14793, 0.17595, 0.20579, 0.23894, 0.27614,
        0.31554, 0.36396, 0.41862, 0.49007, 0.57824, 0.7202, 1.0511, 2.9765,
    ),
    half_widths_95=(
        0.1782, 0.21143, 0.24762, 0.29634, 0.34855, 0.46247, 0.56306, 0.67729, 0.79528,
        0.90205, 1.0766, 1.3465, 1.7476, 2.1729, 3.0627, 5.453, 17.914,
    ),
    confidences=(
        0.9984, 0.9973, 0.9959, 0.9951, 0.9935, 0.98855, 0.98285, 0.9775, 0.9669,
        0.958, 0.9425, 0.92525, 0.89847, 0.86533, 0.80308, 0.66244, 0.41295,
    ),
)  # fmt: skip
