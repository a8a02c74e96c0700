"""The enhanced unified camera model (Khomutenko, Garcia and Martinet, RA-L 2016), in closed form both ways.

Distortion ``c[4:6]``: alpha, beta. With d = sqrt(beta (x^2 + y^2) + z^2) the image of a ray is
``(x, y) / (alpha d + (1 - alpha) z)``. The unified model of Geyer, Barreto and Mei is the one with beta = 1.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@numba.njit(cache=True, nogil=True)
def project(c: Array, x: float, y: float, z: float) -> tuple[float, float]:
    """Image (x', y') of a ray; NaN outside of the cone in which the model is one to one."""
    alpha = c[4]
    d = math.sqrt(c[5] * (x * x + y * y) + z * z)
    below = alpha * d + (1.0 - alpha) * z
    limit = (1.0 - alpha) / alpha if alpha > 0.5 else alpha / (1.0 - alpha)
    if not (z > -limit * d and below > 0.0):
        return math.nan, math.nan
    return x / below, y / below


@numba.njit(cache=True, nogil=True)
def ray_jacobian(c: Array, x: float, y: float, z: float, J: Array) -> None:
    """Fill the row J, see :mod:`sfmapp.camera.lens`."""
    alpha, beta = c[4], c[5]
    rho2 = x * x + y * y
    d = math.sqrt(beta * rho2 + z * z)
    s = 1.0 / (alpha * d + (1.0 - alpha) * z)
    bend = -s * s * alpha * beta / d
    by_z = -s * s * (alpha * z / d + 1.0 - alpha)
    J[0], J[1] = s * x, s * y
    J[2], J[3], J[4] = s + bend * x * x, bend * x * y, by_z * x
    J[5], J[6], J[7] = bend * x * y, s + bend * y * y, by_z * y
    by_alpha, by_beta = -s * s * (d - z), -s * s * alpha * rho2 / (2.0 * d)
    J[8], J[9] = by_alpha * x, by_alpha * y
    J[10], J[11] = by_beta * x, by_beta * y


@numba.njit(cache=True, nogil=True)
def unproject(c: Array, xd: float, yd: float) -> tuple[float, float, float]:
    """Unit ray of an image point; NaN beyond the radius at which the image ends."""
    alpha, beta = c[4], c[5]
    r2 = xd * xd + yd * yd
    square = 1.0 - (2.0 * alpha - 1.0) * beta * r2
    if not square >= 0.0:
        return math.nan, math.nan, math.nan
    z = (1.0 - alpha * alpha * beta * r2) / (alpha * math.sqrt(square) + 1.0 - alpha)
    norm = 1.0 / math.sqrt(r2 + z * z)
    return xd * norm, yd * norm, z * norm
