"""The equidistant image of a ray, which the fisheye families bend further: the angle from the axis is the radius.

It covers all directions but the one straight behind, where the whole circle of radius pi is one point.
"""

from __future__ import annotations

import math

import numba


@numba.njit(cache=True, nogil=True)
def project(x: float, y: float, z: float) -> tuple[float, float]:
    """Image point (a, b) of a ray, |(a, b)| its angle from the axis in radians; NaN straight behind."""
    rho = math.sqrt(x * x + y * y)
    if rho <= 1e-12 * abs(z):
        return (x / z, y / z) if z > 0.0 else (math.nan, math.nan)
    scale = math.atan2(rho, z) / rho
    return scale * x, scale * y


@numba.njit(cache=True, nogil=True)
def jacobian(x: float, y: float, z: float) -> tuple[float, float, float, float, float, float]:
    """Derivatives of :func:`project` by the ray: da/dx, da/dy = db/dx, db/dy, da/dz, db/dz, and angle / distance."""
    rho2 = x * x + y * y
    inverse2 = 1.0 / (rho2 + z * z)
    if rho2 <= 1e-24 * z * z:
        scale, bend = 1.0 / z, 0.0
    else:
        rho = math.sqrt(rho2)
        scale = math.atan2(rho, z) / rho
        bend = (z * inverse2 - scale) / rho2
    return scale + x * x * bend, x * y * bend, scale + y * y * bend, -x * inverse2, -y * inverse2, scale


@numba.njit(cache=True, nogil=True)
def unproject(a: float, b: float) -> tuple[float, float, float]:
    """Unit ray of an image point; NaN beyond the direction straight behind."""
    angle = math.sqrt(a * a + b * b)
    if not angle < math.pi:
        return math.nan, math.nan, math.nan
    scale = math.sin(angle) / angle if angle > 1e-8 else 1.0
    return scale * a, scale * b, math.cos(angle)
