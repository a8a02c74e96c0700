"""Panoramas of the whole sphere: longitude and latitude in radians are the coordinates of the image.

Longitude grows to the right and latitude downward, as x and y of the camera do; both vanish on its axis.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@numba.njit(cache=True, nogil=True)
def project(x: float, y: float, z: float) -> tuple[float, float]:
    """Longitude in (-pi, pi] and latitude of a ray; NaN for none."""
    level = math.sqrt(x * x + z * z)
    if level == 0.0 and y == 0.0:
        return math.nan, math.nan
    return math.atan2(x, z), math.atan2(y, level)


@numba.njit(cache=True, nogil=True)
def ray_jacobian(x: float, y: float, z: float, J: Array) -> None:
    """Fill the row J, see :mod:`sfmapp.camera.lens`; not finite at the poles."""
    level2 = x * x + z * z
    level, inverse2 = math.sqrt(level2), 1.0 / (level2 + y * y)
    J[0], J[1] = project(x, y, z)
    J[2], J[3], J[4] = z / level2, 0.0, -x / level2
    J[5], J[6], J[7] = -x * y / level * inverse2, level * inverse2, -y * z / level * inverse2


@numba.njit(cache=True, nogil=True)
def unproject(longitude: float, latitude: float) -> tuple[float, float, float]:
    """Unit ray."""
    level = math.cos(latitude)
    return level * math.sin(longitude), math.sin(latitude), level * math.cos(longitude)
