"""The pinhole whose axes are not at right angles: a calibration matrix with all of its five numbers.

Distortion ``c[4]``: s, the number beside fx in the matrix, in pixels (Hartley and Zisserman, section 6.1).
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@numba.njit(cache=True, nogil=True)
def project(c: Array, x: float, y: float, z: float) -> tuple[float, float]:
    """Image (x', y') of a ray, in units of the focal lengths; NaN behind."""
    if not z > 0.0:
        return math.nan, math.nan
    return (x + c[4] / c[0] * y) / z, y / z


@numba.njit(cache=True, nogil=True)
def ray_jacobian(c: Array, x: float, y: float, z: float, J: Array) -> None:
    """Fill the row J, see :mod:`sfmapp.camera.lens`."""
    ratio = c[4] / c[0]
    J[0], J[1] = (x + ratio * y) / z, y / z
    J[2], J[3], J[4] = 1.0 / z, ratio / z, -J[0] / z
    J[5], J[6], J[7] = 0.0, 1.0 / z, -J[1] / z
    J[8], J[9] = y / z / c[0], 0.0


@numba.njit(cache=True, nogil=True)
def unproject(c: Array, xd: float, yd: float) -> tuple[float, float, float]:
    """Unit ray of an image point."""
    x = xd - c[4] / c[0] * yd
    norm = 1.0 / math.sqrt(x * x + yd * yd + 1.0)
    return x * norm, yd * norm, norm
