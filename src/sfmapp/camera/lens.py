"""The two lens models as scalar kernels: from the normalised image plane to pixels and back.

A camera is its canonical row of eight numbers, ``fx, fy, cx, cy, d0, d1, d2, d3``, and a flag: perspective lenses use
d = k1, k2, p1, p2 (Brown 1966 as in OpenCV), fisheye lenses d = k1..k4 (Kannala and Brandt, PAMI 2006).
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@numba.njit(cache=True, nogil=True, inline="always")
def distort(fisheye: bool, c: Array, x: float, y: float) -> tuple[float, float]:
    """Pixel of the normalised image point (x, y) = (X/Z, Y/Z); c is a canonical row."""
    if fisheye:
        r = math.sqrt(x * x + y * y)
        if r < 1e-8:
            s = 1.0
        else:
            theta = math.atan(r)
            t2 = theta * theta
            s = theta * (1.0 + t2 * (c[4] + t2 * (c[5] + t2 * (c[6] + t2 * c[7])))) / r
        return c[0] * s * x + c[2], c[1] * s * y + c[3]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (c[4] + r2 * c[5])
    u = x * radial + 2.0 * c[6] * x * y + c[7] * (r2 + 2.0 * x * x)
    v = y * radial + 2.0 * c[7] * x * y + c[6] * (r2 + 2.0 * y * y)
    return c[0] * u + c[2], c[1] * v + c[3]


@numba.njit(cache=True, nogil=True)
def undistort(fisheye: bool, c: Array, u: float, v: float) -> tuple[float, float]:
    """Normalised image point of a pixel, NaN where the lens polynomial has no inverse there."""
    xd = (u - c[2]) / c[0]
    yd = (v - c[3]) / c[1]
    if c[4] == 0.0 and c[5] == 0.0 and c[6] == 0.0 and c[7] == 0.0 and not fisheye:
        return xd, yd
    if fisheye:
        rd = math.sqrt(xd * xd + yd * yd)
        if rd < 1e-8:
            return xd, yd
        theta = min(rd, 1.5)
        for _ in range(20):
            t2 = theta * theta
            value = theta * (1.0 + t2 * (c[4] + t2 * (c[5] + t2 * (c[6] + t2 * c[7])))) - rd
            slope = 1.0 + t2 * (3.0 * c[4] + t2 * (5.0 * c[5] + t2 * (7.0 * c[6] + t2 * 9.0 * c[7])))
            if slope <= 1e-6:
                return math.nan, math.nan
            step = value / slope
            theta -= step
            if abs(step) < 1e-13:
                break
        # beyond 88 degrees the normalised plane is no useful chart
        if theta <= 0.0 or theta > 1.536:
            return math.nan, math.nan
        scale = math.tan(theta) / rd
        return xd * scale, yd * scale
    x, y = xd, yd
    for _ in range(50):  # Newton on the two equations of the Brown model
        r2 = x * x + y * y
        radial = 1.0 + r2 * (c[4] + r2 * c[5])
        slope = 2.0 * (c[4] + 2.0 * r2 * c[5])
        e0 = x * radial + 2.0 * c[6] * x * y + c[7] * (r2 + 2.0 * x * x) - xd
        e1 = y * radial + 2.0 * c[7] * x * y + c[6] * (r2 + 2.0 * y * y) - yd
        a = radial + x * x * slope + 2.0 * c[6] * y + 6.0 * c[7] * x
        b = x * y * slope + 2.0 * c[6] * x + 2.0 * c[7] * y
        d = radial + y * y * slope + 2.0 * c[7] * x + 6.0 * c[6] * y
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
