"""Any lens as scalar kernels: from the normalised image plane to pixels and back.

A camera is its row of :data:`ROW` numbers: ``fx, fy, cx, cy``, twelve of distortion, and the number of the family that
says what they mean. The families have a module each.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera import brown, radial_fisheye

Array = NDArray[np.float64]

# The row of a camera, and the place of the family in it.
ROW, FAMILY = 17, 16
# The families.
BROWN, RADIAL_FISHEYE = 0, 1


@numba.njit(cache=True, nogil=True, inline="always")
def distort(c: Array, x: float, y: float) -> tuple[float, float]:
    """Pixel of the normalised image point (x, y) = (X/Z, Y/Z); c is the row of a camera."""
    if c[FAMILY] == RADIAL_FISHEYE:
        s = radial_fisheye.stretch(c, math.sqrt(x * x + y * y))
        return c[0] * s * x + c[2], c[1] * s * y + c[3]
    xd, yd = brown.distort(c, x, y)
    return c[0] * xd + c[2], c[1] * yd + c[3]


@numba.njit(cache=True, nogil=True)
def undistort(c: Array, u: float, v: float) -> tuple[float, float]:
    """Normalised image point of a pixel, NaN where the lens has no inverse there."""
    xd = (u - c[2]) / c[0]
    yd = (v - c[3]) / c[1]
    if c[FAMILY] == RADIAL_FISHEYE:
        return radial_fisheye.undistort(c, xd, yd)
    return brown.undistort(c, xd, yd)
