"""The noise of image coordinates, estimated so that outliers hardly count."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Median of the length of a vector of two independent normal coordinates of standard deviation 1 (Rayleigh).
_RAYLEIGH_MEDIAN = 1.1774


def sigma_of_lengths(lengths: NDArray[np.floating]) -> float:
    """Standard deviation of one coordinate of residuals, from their lengths (N,), of which there is one at least."""
    return float(np.median(lengths)) / _RAYLEIGH_MEDIAN
