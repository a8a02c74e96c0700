"""Two views that only turned: the rotation that explains most matches, at several focal lengths, in kernels.

The rotation of least weighted squared error between rays is the eigenvector of the largest eigenvalue of a symmetric
4x4 matrix (Horn, "Closed-form solution of absolute orientation using unit quaternions", JOSA A 1987). The eigenvalue is
the largest root of a quartic, just below the sum of the weights, from which Newton's method falls to it (Theobald,
"Rapid calculation of RMSDs using a quaternion-based characteristic polynomial", Acta Cryst. A 2005).
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.epipolar import contiguous

Array = NDArray[np.float64]

# Fits with Cauchy weights, the first of which has equal ones; and Newton's steps, which are three or four.
_FITS, _MAX_STEPS = 3, 30


def turn_at_focal(xn1: Array, xn2: Array, scale: float, log_focal: float) -> tuple[Array, Array]:
    """The rotation (3, 3) that fits best at a multiple of the focal length, and (N,) squared errors.

    Args:
        xn1, xn2: (N, 2) normalised image points, some of them wrong.
        scale: residual at which a weight has halved, in their units.
        log_focal: logarithm of the multiple.

    Returns:
        The errors, each the larger of both directions, are in units of the scale.
    """
    rotation, errors = np.empty((3, 3)), np.empty(len(xn1))
    _turn_at_focal(*contiguous(xn1, xn2), scale, math.exp(-log_focal), rotation, errors)
    return rotation, errors


def turn_costs(xn1: Array, xn2: Array, scale: float, log_focals: Array) -> Array:
    """(K,) sums of the errors of :func:`turn_at_focal`, each no more than 1, at several focal lengths (K,)."""
    costs = np.empty(len(log_focals))
    _turn_costs(*contiguous(xn1, xn2), scale, np.exp(-log_focals), costs)
    return costs


@numba.njit(cache=True, nogil=True)
def _turn_costs(xn1: Array, xn2: Array, scale: float, factors: Array, costs: Array) -> None:
    rotation, errors = np.empty((3, 3)), np.empty(xn1.shape[0])
    for k in range(factors.shape[0]):
        _turn_at_focal(xn1, xn2, scale, factors[k], rotation, errors)
        total = 0.0
        for i in range(errors.shape[0]):
            total += min(errors[i], 1.0)
        costs[k] = total


@numba.njit(cache=True, nogil=True)
def _turn_at_focal(xn1: Array, xn2: Array, scale: float, factor: float, rotation: Array, errors: Array) -> None:
    """Fill the rotation and the errors of points that are scaled by a factor."""
    limit = (scale * factor) ** 2
    product = np.empty((3, 3))
    for fit in range(_FITS):
        for k in range(9):
            product[k // 3, k % 3] = 0.0
        total = 0.0
        for i in range(xn1.shape[0]):
            x, y, u, v = factor * xn1[i, 0], factor * xn1[i, 1], factor * xn2[i, 0], factor * xn2[i, 1]
            weight = 1.0 if fit == 0 else 1.0 / (1.0 + errors[i])
            total += weight
            weight /= math.sqrt((x * x + y * y + 1.0) * (u * u + v * v + 1.0))
            for k in range(3):
                target = weight * (u if k == 0 else v if k == 1 else 1.0)
                product[k, 0] += target * x
                product[k, 1] += target * y
                product[k, 2] += target
        _nearest_rotation(product, total, rotation)
        for i in range(xn1.shape[0]):
            x, y, u, v = factor * xn1[i, 0], factor * xn1[i, 1], factor * xn2[i, 0], factor * xn2[i, 1]
            errors[i] = min(_turned_error(rotation, x, y, u, v) / limit, 1e12)


@numba.njit(cache=True, nogil=True)
def _turned_error(r: Array, x: float, y: float, u: float, v: float) -> float:
    """The larger of the squared distances of R x1 from x2 and of R^T x2 from x1; infinite behind a camera."""
    depth = r[2, 0] * x + r[2, 1] * y + r[2, 2]
    back = r[0, 2] * u + r[1, 2] * v + r[2, 2]
    if depth <= 0.0 or back <= 0.0:
        return math.inf
    du = (r[0, 0] * x + r[0, 1] * y + r[0, 2]) / depth - u
    dv = (r[1, 0] * x + r[1, 1] * y + r[1, 2]) / depth - v
    dx = (r[0, 0] * u + r[1, 0] * v + r[2, 0]) / back - x
    dy = (r[0, 1] * u + r[1, 1] * v + r[2, 1]) / back - y
    error: float = max(du * du + dv * dv, dx * dx + dy * dy)
    return error


@numba.njit(cache=True, nogil=True)
def _nearest_rotation(m: Array, total: float, out: Array) -> None:
    """Fill the rotation R of largest trace of R^T M, M (3, 3) the sum of w b a^T of unit vectors, total that of w."""
    n = np.empty((4, 4))
    n[0, 0] = m[0, 0] + m[1, 1] + m[2, 2]
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        n[0, k + 1] = n[k + 1, 0] = m[j, i] - m[i, j]
        n[k + 1, k + 1] = m[k, k] - m[i, i] - m[j, j]
        n[i + 1, j + 1] = n[j + 1, i + 1] = m[i, j] + m[j, i]
    value = total  # no smaller than the largest eigenvalue
    # characteristic polynomial x^4 + c2 x^2 + c1 x + c0: the trace of n is zero
    c2 = 0.0
    for i in range(3):
        for j in range(3):
            c2 -= 2.0 * m[i, j] * m[i, j]
    c1 = -8.0 * _determinant3(m, 0, 1, 2, 0, 1, 2)
    c0 = 0.0
    for k in range(4):
        c0 += n[0, k] * _cofactor(n, 0, k)
    for _ in range(_MAX_STEPS):
        square = value * value
        slope = 4.0 * square * value + 2.0 * c2 * value + c1
        if not slope > 0.0:
            break
        step = (square * square + c2 * square + c1 * value + c0) / slope
        value -= step
        if abs(step) <= 1e-15 * total:
            break
    for k in range(4):
        n[k, k] -= value
    # a column of the adjugate, the longest
    best, w, x, y, z = -1.0, 1.0, 0.0, 0.0, 0.0
    for k in range(4):
        q0, q1, q2, q3 = _cofactor(n, k, 0), _cofactor(n, k, 1), _cofactor(n, k, 2), _cofactor(n, k, 3)
        square = q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3
        if square > best:
            best, w, x, y, z = square, q0, q1, q2, q3
    if not best > 0.0:
        best, w, x, y, z = 1.0, 1.0, 0.0, 0.0, 0.0
    s = 2.0 / best
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)
    out[1, 0], out[1, 1], out[1, 2] = s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)
    out[2, 0], out[2, 1], out[2, 2] = s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)


@numba.njit(cache=True, nogil=True)
def _determinant3(m: Array, r0: int, r1: int, r2: int, c0: int, c1: int, c2: int) -> float:
    """Of three rows and columns of a matrix."""
    value: float = (
        m[r0, c0] * (m[r1, c1] * m[r2, c2] - m[r1, c2] * m[r2, c1])
        - m[r0, c1] * (m[r1, c0] * m[r2, c2] - m[r1, c2] * m[r2, c0])
        + m[r0, c2] * (m[r1, c0] * m[r2, c1] - m[r1, c1] * m[r2, c0])
    )
    return value


@numba.njit(cache=True, nogil=True)
def _cofactor(n: Array, row: int, column: int) -> float:
    """Of a matrix (4, 4)."""
    r0, r1, r2 = (0 if row > 0 else 1), (1 if row > 1 else 2), (2 if row > 2 else 3)
    c0, c1, c2 = (0 if column > 0 else 1), (1 if column > 1 else 2), (2 if column > 2 else 3)
    minor = _determinant3(n, r0, r1, r2, c0, c1, c2)
    return minor if (row + column) % 2 == 0 else -minor


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    points = np.array([[0.1, 0.2], [0.3, -0.1]])
    turn_at_focal(points, points, 1.0, 0.0)
    turn_costs(points, points, 1.0, np.zeros(1))
