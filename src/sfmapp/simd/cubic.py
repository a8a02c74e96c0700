"""Cubic interpolation, for every kernel that reads pictures between their pixels."""

from __future__ import annotations

import numba


@numba.njit(cache=True, nogil=True, inline="always")
def cubic_weights(t: float) -> tuple[float, float, float, float]:
    """Of four pixels in a row, for a place that is t beyond the second.

    Keys, IEEE ASSP 1981, with a = -1/2, which is exact for parabolas. OpenCV's, with a = -3/4 and on a grid of 1/32
    pixel, moves edges by up to a twentieth of a pixel, back and forth.
    """
    return (
        t * (-0.5 + t * (1.0 - 0.5 * t)),
        1.0 + t * t * (1.5 * t - 2.5),
        t * (0.5 + t * (2.0 - 1.5 * t)),
        t * t * (0.5 * t - 0.5),
    )
