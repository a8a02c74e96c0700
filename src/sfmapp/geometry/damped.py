"""Steps of Levenberg and Marquardt's method for a few unknowns, and what they leave open, in kernels."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@numba.njit(cache=True, nogil=True)
def solve_damped(h: Array, g: Array, damping: float, factor: Array, step: Array) -> bool:
    """Cholesky solution of (H + damping diag(H)) step = -g from the lower triangle of H; False if it is singular.

    The length of g says how much of the others counts: H, factor and step may be larger.
    """
    n = g.shape[0]
    for i in range(n):
        for j in range(i + 1):
            total = h[i, j] * (1.0 + damping) if i == j else h[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if total <= 1e-15 * h[i, i] or total <= 0.0:
                    return False
                factor[i, i] = math.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    for i in range(n):
        total = -g[i]
        for k in range(i):
            total -= factor[i, k] * step[k]
        step[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            step[i] -= factor[k, i] * step[k]
        step[i] /= factor[i, i]
    return True


@numba.njit(cache=True, nogil=True)
def judge_step(cost: float, new_cost: float, damping: float) -> tuple[bool, bool, float]:
    """Whether a step is taken, whether it was the last, and the damping of the next.

    The last is one that gains less than a millionth, or that gains nothing although it was damped a thousandfold.
    """
    if not new_cost < cost:
        damping *= 10.0
        return False, damping > 1e3, damping
    return True, cost - new_cost < 1e-6 * cost, max(damping * 0.1, 1e-9)


@numba.njit(cache=True, nogil=True)
def turn_columns(w: Array, columns: Array, out: Array) -> None:
    """exp(w) times each column of a matrix (3, K), by Rodrigues' formula."""
    wx, wy, wz = w[0], w[1], w[2]
    angle = math.sqrt(wx * wx + wy * wy + wz * wz)
    a = math.sin(angle) / angle if angle > 1e-9 else 1.0
    b = 0.5 * (math.sin(0.5 * angle) / (0.5 * angle)) ** 2 if angle > 1e-9 else 0.5
    for k in range(columns.shape[1]):
        x, y, z = columns[0, k], columns[1, k], columns[2, k]
        cx, cy, cz = wy * z - wz * y, wz * x - wx * z, wx * y - wy * x
        out[0, k] = x + a * cx + b * (wy * cz - wz * cy)
        out[1, k] = y + a * cy + b * (wz * cx - wx * cz)
        out[2, k] = z + a * cz + b * (wx * cy - wy * cx)


@numba.njit(cache=True, nogil=True)
def invert(matrix: Array, limit: float, out: Array) -> bool:
    """Fill the inverse of a symmetric matrix (U, U), by Cholesky's factors of it scaled to a unit diagonal; False where
    it is not positive definite, or its condition, by Frobenius' norm, is above a limit."""
    n = matrix.shape[0]
    scale, lower = np.empty(n), np.zeros((n, n))
    for i in range(n):
        if not (matrix[i, i] > 0.0 and math.isfinite(matrix[i, i])):
            return False
        scale[i] = 1.0 / math.sqrt(matrix[i, i])
    size = 0.0
    for i in range(n):
        for j in range(i + 1):
            value = matrix[i, j] * scale[i] * scale[j]
            size += value * value if i == j else 2.0 * value * value
            for k in range(j):
                value -= lower[i, k] * lower[j, k]
            if i == j:
                if not value > 0.0:
                    return False
                lower[i, i] = math.sqrt(value)
            else:
                lower[i, j] = value / lower[j, j]
    for j in range(n):  # the inverse of the factor, in its place
        lower[j, j] = 1.0 / lower[j, j]
        for i in range(j + 1, n):
            total = 0.0
            for k in range(j, i):
                total -= lower[i, k] * lower[k, j]
            lower[i, j] = total / lower[i, i]
    inverse_size = 0.0
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, n):
                total += lower[k, i] * lower[k, j]
            inverse_size += total * total if i == j else 2.0 * total * total
            out[i, j] = out[j, i] = total * scale[i] * scale[j]
    return size * inverse_size < limit * limit
