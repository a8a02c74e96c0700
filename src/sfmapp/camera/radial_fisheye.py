"""Fisheye lenses whose image radius is an odd polynomial of the angle (Kannala and Brandt, PAMI 2006).

Distortion ``c[4:8]``: k1 to k4. A ray at the angle theta from the axis is imaged at the radius::

    theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)

which is also that of a point of the normalised plane at the radius tan(theta).
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@numba.njit(cache=True, nogil=True, inline="always")
def stretch(c: Array, r: float) -> float:
    """Radius in the image for one on the normalised plane, at the radius r there."""
    if r < 1e-8:
        return 1.0
    theta = math.atan(r)
    t2 = theta * theta
    return theta * (1.0 + t2 * (c[4] + t2 * (c[5] + t2 * (c[6] + t2 * c[7])))) / r


@numba.njit(cache=True, nogil=True, inline="always")
def jacobian(
    c: Array, x: float, y: float
) -> tuple[float, float, float, float, float, float, float, float, float, float, float, float, float]:
    """Image (x', y') of a point of the normalised plane, and its derivatives.

    Returns x', y', dx'/dx, dx'/dy = dy'/dx, dy'/dy, then those of x' and y' by k1, by k2, by k3 and by k4.
    """
    r2 = x * x + y * y
    r = math.sqrt(r2)
    if r < 1e-8:
        s, slope, q = 1.0, 2.0 * (c[4] - 1.0 / 3.0), 0.0
        t2 = r2
    else:
        theta = math.atan(r)
        t2 = theta * theta
        q = theta * t2 / r
        s = theta * (1.0 + t2 * (c[4] + t2 * (c[5] + t2 * (c[6] + t2 * c[7])))) / r
        rate = 1.0 + t2 * (3.0 * c[4] + t2 * (5.0 * c[5] + t2 * (7.0 * c[6] + t2 * 9.0 * c[7])))
        slope = (rate / (1.0 + r2) - s) / r2
    k1x, k1y = q * x, q * y
    k2x, k2y = t2 * k1x, t2 * k1y
    k3x, k3y = t2 * k2x, t2 * k2y
    return (
        s * x, s * y, s + x * x * slope, x * y * slope, s + y * y * slope, k1x, k1y, k2x, k2y, k3x, k3y,
        t2 * k3x, t2 * k3y,
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def angle_of(c: Array, rd: float, start: float) -> float:
    """Angle from the axis that is imaged at the radius rd > 0; NaN where the polynomial has no inverse."""
    theta = start
    for _ in range(20):
        t2 = theta * theta
        value = theta * (1.0 + t2 * (c[4] + t2 * (c[5] + t2 * (c[6] + t2 * c[7])))) - rd
        slope = 1.0 + t2 * (3.0 * c[4] + t2 * (5.0 * c[5] + t2 * (7.0 * c[6] + t2 * 9.0 * c[7])))
        if slope <= 1e-6:
            return math.nan
        step = value / slope
        theta -= step
        if abs(step) < 1e-13:
            break
    return theta if theta > 0.0 else math.nan


@numba.njit(cache=True, nogil=True)
def undistort(c: Array, xd: float, yd: float) -> tuple[float, float]:
    """The point of the normalised plane whose image is (x', y'); NaN where there is none within 88 degrees."""
    rd = math.sqrt(xd * xd + yd * yd)
    if rd < 1e-8:
        return xd, yd
    theta = angle_of(c, rd, min(rd, 1.5))
    # beyond 88 degrees the normalised plane is no useful chart
    if not theta <= 1.536:
        return math.nan, math.nan
    scale = math.tan(theta) / rd
    return xd * scale, yd * scale
