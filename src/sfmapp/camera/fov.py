"""The field-of-view model (Devernay and Faugeras, "Straight lines have to be straight", 2001).

Distortion ``c[4]``: omega. A ray at the angle theta from the axis is imaged at the radius
``atan(2 tan(omega / 2) tan(theta)) / omega``, continued beyond a right angle.

COLMAP replaces this by the first terms of a series where omega^2 or the squared radius tan(theta)^2 is below 1e-4, and
for a small omega with the wrong sign; here it is exact throughout.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Below this omega the first terms of the series are exact to rounding.
_SMALL = 1e-4


@numba.njit(cache=True, nogil=True)
def _radius(omega: float, rho: float, z: float) -> float:
    """Image radius of a ray; NaN where there is none."""
    if abs(omega) < _SMALL:
        if not z > 0.0:
            return math.nan
        r = rho / z
        return r * (1.0 + omega * omega * (1.0 / 12.0 - r * r / 3.0))
    return math.atan2(2.0 * math.tan(0.5 * omega) * rho, z) / omega


@numba.njit(cache=True, nogil=True)
def project(c: Array, x: float, y: float, z: float) -> tuple[float, float]:
    """Image (x', y') of a ray; NaN straight behind, and behind at all with a vanishing omega."""
    rho = math.sqrt(x * x + y * y)
    if rho <= 1e-12 * abs(z):
        if not z > 0.0:
            return math.nan, math.nan
        scale = _radius(c[4], 1e-9, 1.0) / (1e-9 * z)
    else:
        scale = _radius(c[4], rho, z) / rho
    return scale * x, scale * y


@numba.njit(cache=True, nogil=True)
def ray_jacobian(c: Array, x: float, y: float, z: float, J: Array) -> None:
    """Fill the row J, see :mod:`sfmapp.camera.lens`."""
    omega, rho2 = c[4], x * x + y * y
    rho = math.sqrt(rho2)
    if abs(omega) < _SMALL:
        r2 = rho2 / (z * z)
        by_rho = (1.0 + omega * omega * (1.0 / 12.0 - r2)) / z
        by_z = -by_rho * rho / z
        by_omega = rho / z * omega * (1.0 / 6.0 - 2.0 / 3.0 * r2)
    else:
        m = 2.0 * math.tan(0.5 * omega)
        inverse = 1.0 / (z * z + m * m * rho2)
        by_rho, by_z = m * z * inverse / omega, -m * rho * inverse / omega
        by_omega = (rho * z * inverse * (1.0 + 0.25 * m * m) - math.atan2(m * rho, z) / omega) / omega
    J[0], J[1] = project(c, x, y, z)
    if rho <= 1e-12 * abs(z):
        scale, bend, ex, ey = by_rho, 0.0, 0.0, 0.0
    else:
        ex, ey = x / rho, y / rho
        scale = _radius(omega, rho, z) / rho
        bend = (by_rho - scale) / rho2
    J[2], J[3], J[4] = scale + x * x * bend, x * y * bend, ex * by_z
    J[5], J[6], J[7] = x * y * bend, scale + y * y * bend, ey * by_z
    J[8], J[9] = ex * by_omega, ey * by_omega


@numba.njit(cache=True, nogil=True)
def unproject(c: Array, xd: float, yd: float) -> tuple[float, float, float]:
    """Unit ray of an image point; NaN beyond the direction straight behind."""
    omega, rd = c[4], math.sqrt(xd * xd + yd * yd)
    if abs(omega) < _SMALL:
        r2 = rd * rd
        r = rd * (1.0 - omega * omega * (1.0 / 12.0 - r2 / 3.0))
        rho, z = r, 1.0
    else:
        angle = abs(omega) * rd
        if not angle < math.pi:
            return math.nan, math.nan, math.nan
        rho, z = math.sin(angle), 2.0 * math.tan(0.5 * abs(omega)) * math.cos(angle)
    norm = 1.0 / math.sqrt(rho * rho + z * z)
    if rd < 1e-12:
        return 0.0, 0.0, 1.0
    return xd / rd * rho * norm, yd / rd * rho * norm, z * norm
