"""The one-parameter division model (Fitzgibbon, CVPR 2001), in both directions in closed form.

Distortion ``c[4]``: k. The ray of an image point (x', y') at the radius r' is (x', y', 1 + k r'^2); a negative k makes
a lens whose rays may go beyond a right angle from the axis.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@numba.njit(cache=True, nogil=True)
def _scale(k: float, rho2: float, z: float) -> tuple[float, float]:
    """What takes (x, y) to the image, the smaller solution of k rho^2 s^2 - z s + 1 = 0, and the root in it."""
    square = z * z - 4.0 * k * rho2
    if not square > 0.0:
        return math.nan, math.nan
    root = math.sqrt(square)
    if z >= 0.0:
        return 2.0 / (z + root), root
    # the same without a difference of nearly equal numbers
    below = -4.0 * k * rho2
    return ((2.0 * (root - z)) / below if below > 0.0 else math.nan), root


@numba.njit(cache=True, nogil=True)
def project(c: Array, x: float, y: float, z: float) -> tuple[float, float]:
    """Image (x', y') of a ray; NaN where there is none."""
    s, _ = _scale(c[4], x * x + y * y, z)
    return s * x, s * y


@numba.njit(cache=True, nogil=True)
def ray_jacobian(c: Array, x: float, y: float, z: float, J: Array) -> None:
    """Fill the row J, see :mod:`sfmapp.camera.lens`."""
    k, rho2 = c[4], x * x + y * y
    s, root = _scale(k, rho2, z)
    s2 = s * s / root
    by_z = -0.5 * s2 * (root + z)
    J[0], J[1] = s * x, s * y
    J[2], J[3], J[4] = s + 2.0 * k * s2 * x * x, 2.0 * k * s2 * x * y, by_z * x
    J[5], J[6], J[7] = 2.0 * k * s2 * x * y, s + 2.0 * k * s2 * y * y, by_z * y
    J[8], J[9] = s2 * rho2 * x, s2 * rho2 * y


@numba.njit(cache=True, nogil=True)
def unproject(c: Array, xd: float, yd: float) -> tuple[float, float, float]:
    """Unit ray of an image point; NaN beyond the circle that the model maps to infinity."""
    r2 = xd * xd + yd * yd
    if c[4] * r2 >= 1.0:
        return math.nan, math.nan, math.nan
    z = 1.0 + c[4] * r2
    norm = 1.0 / math.sqrt(r2 + z * z)
    return xd * norm, yd * norm, z * norm
