"""Perspective lenses with OpenCV's full distortion: a rational radial part, tangential parts and a thin prism.

Distortion ``c[4:16]``: k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, in OpenCV's order. On the normalised plane, with
r2 = x^2 + y^2::

    q  = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3)
    x' = x q + 2 p1 x y + p2 (r2 + 2 x^2) + s1 r2 + s2 r2^2
    y' = y q + 2 p2 x y + p1 (r2 + 2 y^2) + s3 r2 + s4 r2^2

With k4 alone the radial part is the division model turned round: the ideal point divided gives the image.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera import newton

Array = NDArray[np.float64]


@numba.njit(cache=True, nogil=True)
def _radial(c: Array, r2: float) -> tuple[float, float, float]:
    """(q, dq / dr2, denominator); NaN beyond a pole of the quotient."""
    top = 1.0 + r2 * (c[4] + r2 * (c[5] + r2 * c[8]))
    below = 1.0 + r2 * (c[9] + r2 * (c[10] + r2 * c[11]))
    if below <= 0.0:
        return math.nan, math.nan, math.nan
    q = top / below
    top_slope = c[4] + r2 * (2.0 * c[5] + 3.0 * r2 * c[8])
    below_slope = c[9] + r2 * (2.0 * c[10] + 3.0 * r2 * c[11])
    return q, (top_slope - q * below_slope) / below, below


@numba.njit(cache=True, nogil=True)
def _bend(c: Array, x: float, y: float) -> tuple[float, float, float, float, float, float]:
    """Image (x', y') of a point of the normalised plane, and dx'/dx, dx'/dy, dy'/dx, dy'/dy."""
    r2 = x * x + y * y
    q, slope, _ = _radial(c, r2)
    return _bent(c, x, y, r2, q, slope)


@numba.njit(cache=True, nogil=True)
def _bent(
    c: Array, x: float, y: float, r2: float, q: float, slope: float
) -> tuple[float, float, float, float, float, float]:
    """What :func:`_bend` gives, of the radial part q and its slope at r2."""
    prism_x, prism_y = 2.0 * (c[12] + 2.0 * r2 * c[13]), 2.0 * (c[14] + 2.0 * r2 * c[15])
    return (
        x * q + 2.0 * c[6] * x * y + c[7] * (r2 + 2.0 * x * x) + r2 * (c[12] + r2 * c[13]),
        y * q + 2.0 * c[7] * x * y + c[6] * (r2 + 2.0 * y * y) + r2 * (c[14] + r2 * c[15]),
        q + 2.0 * x * x * slope + 2.0 * c[6] * y + 6.0 * c[7] * x + x * prism_x,
        2.0 * x * y * slope + 2.0 * c[6] * x + 2.0 * c[7] * y + y * prism_x,
        2.0 * x * y * slope + 2.0 * c[7] * y + 2.0 * c[6] * x + x * prism_y,
        q + 2.0 * y * y * slope + 2.0 * c[7] * x + 6.0 * c[6] * y + y * prism_y,
    )


@numba.njit(cache=True, nogil=True)
def project(c: Array, x: float, y: float, z: float) -> tuple[float, float]:
    """Image (x', y') of a ray; NaN behind."""
    if not z > 0.0:
        return math.nan, math.nan
    xd, yd, _, _, _, _ = _bend(c, x / z, y / z)
    return xd, yd


@numba.njit(cache=True, nogil=True)
def ray_jacobian(c: Array, x: float, y: float, z: float, J: Array) -> None:
    """Fill the row J, see :mod:`sfmapp.camera.lens`; J[0] is NaN where :func:`project` is."""
    if not z > 0.0:
        J[0] = J[1] = math.nan
        return
    iz = 1.0 / z
    u, v = x * iz, y * iz
    r2 = u * u + v * v
    q, slope, below = _radial(c, r2)
    J[0], J[1], xx, xy, yx, yy = _bent(c, u, v, r2, q, slope)
    J[2], J[3], J[4] = xx * iz, xy * iz, -(xx * u + xy * v) * iz
    J[5], J[6], J[7] = yx * iz, yy * iz, -(yx * u + yy * v) * iz
    by_top, by_below = r2 / below, -q * r2 / below
    for top, under in ((0, 5), (1, 6), (4, 7)):  # k1 k4, k2 k5, k3 k6
        J[8 + 2 * top], J[9 + 2 * top] = u * by_top, v * by_top
        J[8 + 2 * under], J[9 + 2 * under] = u * by_below, v * by_below
        by_top, by_below = by_top * r2, by_below * r2
    J[12], J[13] = 2.0 * u * v, r2 + 2.0 * v * v
    J[14], J[15] = r2 + 2.0 * u * u, 2.0 * u * v
    J[24], J[25], J[26], J[27] = r2, 0.0, r2 * r2, 0.0
    J[28], J[29], J[30], J[31] = 0.0, r2, 0.0, r2 * r2


@numba.njit(cache=True, nogil=True)
def unproject(c: Array, xd: float, yd: float) -> tuple[float, float, float]:
    """Unit ray of an image point; NaN where the lens has no inverse."""
    x, y = xd, yd
    for _ in range(100):
        u, v, xx, xy, yx, yy = _bend(c, x, y)
        x, y, moved2 = newton.step(x, y, u - xd, v - yd, xx, xy, yx, yy)
        if moved2 < 1e-26 * (1.0 + x * x + y * y):
            norm = 1.0 / math.sqrt(x * x + y * y + 1.0)
            return x * norm, y * norm, norm
    return math.nan, math.nan, math.nan
