"""What a score of cues means: quantiles of true errors, as ``benchmarks/stereo_sigma.py`` fitted them.

The pairs of the fit are rendered, so that their disparities are exact, with sensors whose noise and exposure differ and
rows that are off by what a calibration leaves; no photograph is among them. How it does on photographs with known
disparities is in ``benchmarks/results/stereo_sigma.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float32]

# cues beyond so many of their standard deviations over the pairs of the fit are taken as that: a quadratic is not to be
# followed where there was nothing
_LIMIT = 4.0


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

    def score(self, cues: Map) -> Map:
        """(N,) of cues (N, C): about the log of the error in pixels."""
        weights, count = np.asarray(self.weights, np.float32), len(self.centers)
        normal = self.normalised(cues)
        products = np.zeros((count, count), np.float32)
        products[np.triu_indices(count)] = weights[count + 1 :]
        score: Map = weights[0] + ((normal @ products + weights[1 : count + 1]) * normal).sum(1)
        return score

    def normalised(self, cues: NDArray[np.floating]) -> Map:
        """Cues (N, C) less their means, in standard deviations, no farther than the fit is to be followed."""
        centers, spreads = (np.asarray(values, np.float32) for values in (self.centers, self.spreads))
        normal: Map = np.clip((cues - centers) / spreads, -_LIMIT, _LIMIT).astype(np.float32)
        return normal

    def read(self, cues: Map) -> tuple[Map, Map, Map]:
        """Sigma, 95 per cent half width and confidence (N,) of cues (N, C), between the scores of the table by their
        logarithm, and beyond them as at its ends."""
        score = self.score(cues)
        sigma, half_width = (
            np.exp(np.interp(score, self.scores, np.log(values))).astype(np.float32)
            for values in (self.sigmas, self.half_widths_95)
        )
        return sigma, half_width, np.interp(score, self.scores, self.confidences).astype(np.float32)


ERROR_TABLE = ErrorTable(
    centers=(
        0.026542, -2.0805, -1.4041, -1.8265, -1.3135, -1.9497, 0.92805, -0.58956, 1.9205,
    ),
    spreads=(
        1.3077, 1.4459, 0.89254, 0.67353, 0.82521, 0.82742, 0.14972, 0.90687, 0.89311,
    ),
    weights=(
        -1.6802, 0.17984, 0.38775, 0.073828, -0.055889, 0.066045, 0.32227, -0.23648, 0.15061,
        0.35531, 0.024321, 0.15916, -0.15717, -0.015846, 0.070368, -0.03281, 0.0054326, -0.02326,
        0.15656, 0.13974, 0.09577, -0.15019, 0.077339, -0.087292, -0.03079, 0.0024604, 0.12018,
        0.03611, -0.0042104, 0.026523, -0.029205, 0.017106, 0.013454, 0.10684, 0.020337, 0.061196,
        -0.024195, 0.007628, 0.017409, -0.10254, -0.094858, -0.033104, -0.066346, -0.016855, 0.038802,
        0.10503, 0.066702, -0.060099, -0.13202, -0.013923, 0.010488, -0.0064976, 0.047314, 0.019642,
        0.057413,
    ),
    scores=(
        -2.5741, -2.3888, -2.2691, -2.1616, -2.0561, -1.9478, -1.8365, -1.7204, -1.5973,
        -1.4662, -1.3215, -1.1592, -0.98657, -0.79097, -0.52809, -0.17311, 0.68299,
    ),
    sigmas=(
        0.084604, 0.099177, 0.11217, 0.12963, 0.15277, 0.18021, 0.2108, 0.24435, 0.28688,
        0.3329, 0.39742, 0.47855, 0.56776, 0.7052, 0.95361, 1.478, 4.725,
    ),
    half_widths_95=(
        0.18388, 0.22493, 0.26179, 0.30939, 0.36906, 0.46178, 0.5729, 0.67677, 0.83756,
        1.007, 1.2714, 1.6881, 2.3629, 3.2197, 5.0343, 9.6341, 28.913,
    ),
    confidences=(
        0.9976, 0.9962, 0.9944, 0.99245, 0.99062, 0.98502, 0.97932, 0.9739, 0.96247,
        0.9493, 0.92792, 0.89745, 0.86273, 0.805, 0.69721, 0.53533, 0.32076,
    ),
)  # fmt: skip
