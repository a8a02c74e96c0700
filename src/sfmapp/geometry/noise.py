"""The noise of image coordinates, estimated so that outliers hardly count."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

# Median of the length of a vector of two independent normal coordinates of standard deviation 1 (Rayleigh).
_RAYLEIGH_MEDIAN = 1.1774


def sigma_of_lengths(lengths: NDArray[np.floating]) -> float:
    """Standard deviation of one coordinate of residuals, from their lengths (N,), of which there is one at least."""
    return float(np.median(lengths)) / _RAYLEIGH_MEDIAN


def exceeded_by_chance(num: int, chance: float) -> float:
    """What a sum of num squared standard normal numbers exceeds with a given chance: the quantile of chi-square.

    Its tails are finite sums (Abramowitz and Stegun 26.4.4-5), so that a process that wants one need not load
    scipy.special, which takes 0.1 s and 25 MB.
    """
    low, high = 0.0, 1.0
    while _tail(num, high) > chance:
        low, high = high, 2.0 * high
    while (middle := 0.5 * (low + high)) not in (low, high):
        low, high = (middle, high) if _tail(num, middle) > chance else (low, middle)
    return high


def _tail(num: int, x: float) -> float:
    """Chance that a sum of num squared standard normal numbers exceeds x."""
    total, k = (math.exp(-0.5 * x), 2) if num % 2 == 0 else (math.erfc(math.sqrt(0.5 * x)), 1)
    while k < num:
        total += math.exp(0.5 * (k * math.log(0.5 * x) - x) - math.lgamma(0.5 * k + 1.0))
        k += 2
    return total
