"""Fisheye lenses with tangential parts and a thin prism on top of the radial polynomial, in COLMAP's two forms.

Both bend the equidistant image point (a, b) of a ray, t2 = a^2 + b^2 being its squared angle from the axis.

The classic one (THIN_PRISM_FISHEYE; Weng et al. 1992), ``c[4:12]``: k1, k2, p1, p2, k3, k4, sx1, sy1::

    a' = a (1 + k1 t2 + k2 t2^2 + k3 t2^3 + k4 t2^4) + 2 p1 a b + p2 (t2 + 2 a^2) + sx1 t2
    b' = b (1 + k1 t2 + k2 t2^2 + k3 t2^3 + k4 t2^4) + 2 p2 a b + p1 (t2 + 2 b^2) + sy1 t2

The other (RAD_TAN_THIN_PRISM_FISHEYE, Project Aria's), ``c[4:16]``: k0 to k5, p0, p1, s0 to s3, bends the radially
distorted point (m, n) = (a, b) (1 + k0 t2 + ... + k5 t2^6), with r2 = m^2 + n^2::

    a' = m + 2 p1 m n + p0 (r2 + 2 m^2) + s0 r2 + s1 r2^2
    b' = n + 2 p0 m n + p1 (r2 + 2 n^2) + s2 r2 + s3 r2^2
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera import equidistant, newton

Array = NDArray[np.float64]


@numba.njit(cache=True, nogil=True)
def _bend_classic(c: Array, a: float, b: float) -> tuple[float, float, float, float, float, float]:
    t2 = a * a + b * b
    radial = 1.0 + t2 * (c[4] + t2 * (c[5] + t2 * (c[8] + t2 * c[9])))
    slope = 2.0 * (c[4] + t2 * (2.0 * c[5] + t2 * (3.0 * c[8] + 4.0 * t2 * c[9])))
    p1, p2 = c[6], c[7]
    return (
        a * radial + 2.0 * p1 * a * b + p2 * (t2 + 2.0 * a * a) + c[10] * t2,
        b * radial + 2.0 * p2 * a * b + p1 * (t2 + 2.0 * b * b) + c[11] * t2,
        radial + a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a + 2.0 * c[10] * a,
        a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b + 2.0 * c[10] * b,
        a * b * slope + 2.0 * p2 * b + 2.0 * p1 * a + 2.0 * c[11] * a,
        radial + b * b * slope + 2.0 * p2 * a + 6.0 * p1 * b + 2.0 * c[11] * b,
    )


@numba.njit(cache=True, nogil=True)
def _radial_of_six(c: Array, t2: float) -> tuple[float, float]:
    """The radial factor of k0 to k5, and its derivative by t2."""
    radial = slope = 0.0
    for k in range(9, 3, -1):
        slope = slope * t2 + radial
        radial = radial * t2 + c[k]
    return 1.0 + radial * t2, radial + t2 * slope


@numba.njit(cache=True, nogil=True)
def _tilt(c: Array, m: float, n: float) -> tuple[float, float, float, float, float, float]:
    """Image of a radially distorted point, and its derivatives by that point."""
    r2 = m * m + n * n
    p0, p1 = c[10], c[11]
    prism_x, prism_y = 2.0 * (c[12] + 2.0 * r2 * c[13]), 2.0 * (c[14] + 2.0 * r2 * c[15])
    return (
        m + 2.0 * p1 * m * n + p0 * (r2 + 2.0 * m * m) + r2 * (c[12] + r2 * c[13]),
        n + 2.0 * p0 * m * n + p1 * (r2 + 2.0 * n * n) + r2 * (c[14] + r2 * c[15]),
        1.0 + 2.0 * p1 * n + 6.0 * p0 * m + m * prism_x,
        2.0 * p1 * m + 2.0 * p0 * n + n * prism_x,
        2.0 * p0 * n + 2.0 * p1 * m + m * prism_y,
        1.0 + 2.0 * p0 * m + 6.0 * p1 * n + n * prism_y,
    )


@numba.njit(cache=True, nogil=True)
def _bend_aria(c: Array, a: float, b: float) -> tuple[float, float, float, float, float, float]:
    t2 = a * a + b * b
    radial, slope = _radial_of_six(c, t2)
    slope *= 2.0
    u, v, mm, mn, nm, nn = _tilt(c, a * radial, b * radial)
    ma, mb, nb = radial + a * a * slope, a * b * slope, radial + b * b * slope
    return u, v, mm * ma + mn * mb, mm * mb + mn * nb, nm * ma + nn * mb, nm * mb + nn * nb


@numba.njit(cache=True, nogil=True)
def _bend(c: Array, classic: bool, a: float, b: float) -> tuple[float, float, float, float, float, float]:
    """Image (a', b') of an equidistant image point, and da'/da, da'/db, db'/da, db'/db."""
    return _bend_classic(c, a, b) if classic else _bend_aria(c, a, b)


@numba.njit(cache=True, nogil=True)
def project(c: Array, classic: bool, x: float, y: float, z: float) -> tuple[float, float]:
    """Image of a ray; NaN straight behind."""
    a, b = equidistant.project(x, y, z)
    u, v, _, _, _, _ = _bend(c, classic, a, b)
    return u, v


@numba.njit(cache=True, nogil=True)
def ray_jacobian(c: Array, classic: bool, x: float, y: float, z: float, J: Array) -> None:
    """Fill the row J, see :mod:`sfmapp.camera.lens`."""
    a, b = equidistant.project(x, y, z)
    ax, ay, by, az, bz, _ = equidistant.jacobian(x, y, z)
    J[0], J[1], aa, ab, ba, bb = _bend(c, classic, a, b)
    J[2], J[3], J[4] = aa * ax + ab * ay, aa * ay + ab * by, aa * az + ab * bz
    J[5], J[6], J[7] = ba * ax + bb * ay, ba * ay + bb * by, ba * az + bb * bz
    t2, power = a * a + b * b, 1.0
    if classic:
        for k in (0, 1, 4, 5):
            power *= t2
            J[8 + 2 * k], J[9 + 2 * k] = a * power, b * power
        J[12], J[13] = 2.0 * a * b, t2 + 2.0 * b * b
        J[14], J[15] = t2 + 2.0 * a * a, 2.0 * a * b
        J[20], J[21], J[22], J[23] = t2, 0.0, 0.0, t2
        return
    radial, _ = _radial_of_six(c, t2)
    m, n = a * radial, b * radial
    _, _, mm, mn, nm, nn = _tilt(c, m, n)
    for k in range(6):
        power *= t2
        J[8 + 2 * k], J[9 + 2 * k] = (mm * a + mn * b) * power, (nm * a + nn * b) * power
    r2 = m * m + n * n
    J[20], J[21] = r2 + 2.0 * m * m, 2.0 * m * n
    J[22], J[23] = 2.0 * m * n, r2 + 2.0 * n * n
    J[24], J[25], J[26], J[27] = r2, 0.0, r2 * r2, 0.0
    J[28], J[29], J[30], J[31] = 0.0, r2, 0.0, r2 * r2


@numba.njit(cache=True, nogil=True)
def unproject(c: Array, classic: bool, xd: float, yd: float) -> tuple[float, float, float]:
    """Unit ray of an image point; NaN where the lens has no inverse."""
    a, b = xd, yd
    for _ in range(100):
        u, v, aa, ab, ba, bb = _bend(c, classic, a, b)
        a, b, moved2 = newton.step(a, b, u - xd, v - yd, aa, ab, ba, bb)
        if moved2 < 1e-26:
            return equidistant.unproject(a, b)
    return math.nan, math.nan, math.nan
