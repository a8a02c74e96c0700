"""Perspective lenses with the radial and tangential distortion of Brown (1966), as OpenCV and COLMAP have it.

Distortion ``c[4:8]``: k1, k2, p1, p2. On the normalised plane (x, y) = (X/Z, Y/Z), with r2 = x^2 + y^2::

    x' = x (1 + k1 r2 + k2 r2^2) + 2 p1 x y + p2 (r2 + 2 x^2)
    y' = y (1 + k1 r2 + k2 r2^2) + 2 p2 x y + p1 (r2 + 2 y^2)
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@numba.njit(cache=True, nogil=True, inline="always")
def distort(c: Array, x: float, y: float) -> tuple[float, float]:
    """The point (x', y') of a point of the normalised plane."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (c[4] + r2 * c[5])
    return (
        x * radial + 2.0 * c[6] * x * y + c[7] * (r2 + 2.0 * x * x),
        y * radial + 2.0 * c[7] * x * y + c[6] * (r2 + 2.0 * y * y),
    )


@numba.njit(cache=True, nogil=True, inline="always")
def slopes(c: Array, x: float, y: float) -> tuple[float, float, float]:
    """Derivatives of :func:`distort`: of x' by x, of x' by y, which is that of y' by x, and of y' by y."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (c[4] + r2 * c[5])
    slope = 2.0 * (c[4] + 2.0 * r2 * c[5])
    a = radial + x * x * slope + 2.0 * c[6] * y + 6.0 * c[7] * x
    b = x * y * slope + 2.0 * c[6] * x + 2.0 * c[7] * y
    d = radial + y * y * slope + 2.0 * c[7] * x + 6.0 * c[6] * y
    return a, b, d


@numba.njit(cache=True, nogil=True, inline="always")
def jacobian(
    c: Array, x: float, y: float
) -> tuple[float, float, float, float, float, float, float, float, float, float, float, float, float]:
    """Image (x', y') of a point of the normalised plane, and its derivatives.

    Returns x', y', dx'/dx, dx'/dy = dy'/dx, dy'/dy, then those of x' and y' by k1, by k2, by p1 and by p2.
    """
    r2 = x * x + y * y
    radial = 1.0 + r2 * (c[4] + r2 * c[5])
    a, b, d = slopes(c, x, y)
    k1x, k1y = r2 * x, r2 * y
    p1x, p1y = 2.0 * x * y, r2 + 2.0 * y * y
    p2x = r2 + 2.0 * x * x
    # as a sum over the parameters: the products are needed anyway
    xd = x * radial + c[6] * p1x + c[7] * p2x
    yd = y * radial + c[6] * p1y + c[7] * p1x
    return xd, yd, a, b, d, k1x, k1y, r2 * k1x, r2 * k1y, p1x, p1y, p2x, p1x


@numba.njit(cache=True, nogil=True)
def undistort(c: Array, xd: float, yd: float) -> tuple[float, float]:
    """The point of the normalised plane whose image is (x', y'); NaN where the polynomial has no inverse."""
    if c[4] == 0.0 and c[5] == 0.0 and c[6] == 0.0 and c[7] == 0.0:
        return xd, yd
    x, y = xd, yd
    for _ in range(50):  # Newton on the two equations
        e0, e1 = distort(c, x, y)
        e0 -= xd
        e1 -= yd
        a, b, d = slopes(c, x, y)
        det = a * d - b * b
        # past the fold of the polynomial the map is not one to one
        if det <= 1e-9:
            return math.nan, math.nan
        dx = (d * e0 - b * e1) / det
        dy = (a * e1 - b * e0) / det
        x -= dx
        y -= dy
        if dx * dx + dy * dy < 1e-26:
            return x, y
    return math.nan, math.nan
