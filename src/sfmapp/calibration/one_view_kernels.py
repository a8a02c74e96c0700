"""Kernels of one photograph against points with known places: the fit, the slopes it leaves, what each point weighs."""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera import lens
from sfmapp.geometry.damped import solve_damped, turn_columns
from sfmapp.simd.copying import copy_into

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

POSE = 6

_MAX_STEPS = 200
# Of the cost, by which a last step makes it less: it is a hundred-thousandth of a sigma, and the next would be smaller.
_TOLERANCE = 1e-12
# Of its own variance, what a point has to leave to the others to be checked by them.
_UNCHECKED = 1e-6
# Residuals below are rounding, pixels.
_EXACT_PX = 1e-8


class Problem(NamedTuple):
    """What a fit is to: N points and Q pieces of knowledge of P parameters, F of which are free.

    Attributes:
        canonical_from: (FAMILY, P) the canonical row of parameters. family: of lenses.
        free: (F,) positions of the free parameters.
        xyz, xy: (N, 3), (N, 2). is_used: (N,) which of them are fitted.
        middle, rows: (P,), (Q, P) of the prior.
        noise_px: of a coordinate.
        period: width of a panorama, whose left and right borders are one line; 0 for none.
    """

    canonical_from: Array
    family: int
    free: NDArray[np.int64]
    xyz: Array
    xy: Array
    is_used: Bools
    middle: Array
    rows: Array
    noise_px: float
    period: float


@numba.njit(cache=True, nogil=True)
def descend(problem: Problem, params: Array, rotation: Array, translation: Array) -> None:
    """Levenberg and Marquardt's method over the free parameters and the pose, in place."""
    num = problem.free.shape[0] + POSE
    h, g, new_h, new_g = np.empty((num, num)), np.empty(num), np.empty((num, num)), np.empty(num)
    factor, step = np.empty((num, num)), np.empty(num)
    new_params, new_rotation, new_translation = params.copy(), rotation.copy(), translation.copy()
    damping, cost = 1e-3, _linearize(problem, params, rotation, translation, h, g)
    for _ in range(_MAX_STEPS):
        if not np.isfinite(cost):
            return
        new_cost = np.inf
        if solve_damped(h, g, damping, factor, step):
            _move(problem, params, rotation, translation, step, new_params, new_rotation, new_translation)
            new_cost = _linearize(problem, new_params, new_rotation, new_translation, new_h, new_g)
        # at the bottom, rounding decides which of two costs is the less
        is_settled = abs(cost - new_cost) <= _TOLERANCE * cost
        if new_cost <= cost:
            cost, damping = new_cost, max(damping * 0.1, 1e-15)
            copy_into(params, new_params)
            copy_into(rotation, new_rotation)
            copy_into(translation, new_translation)
            h, new_h, g, new_g = new_h, h, new_g, g
        else:
            damping = max(damping * 10.0, 1e-6)
        if is_settled or damping > 1e12:
            return


@numba.njit(cache=True, nogil=True)
def _move(
    problem: Problem, params: Array, rotation: Array, translation: Array, step: Array, new_params: Array,
    new_rotation: Array, new_translation: Array,
) -> None:  # fmt: skip
    """The state after a step (F + 6,): of the free parameters, and ``x_cam <- exp(w) x_cam + v``."""
    num = problem.free.shape[0]
    copy_into(new_params, params)
    for k in range(num):
        new_params[problem.free[k]] += step[k]
    column = new_translation.reshape(3, 1)
    turn_columns(step[num : num + 3], rotation, new_rotation)
    turn_columns(step[num : num + 3], translation.reshape(3, 1), column)
    for k in range(3):
        new_translation[k] += step[num + 3 + k]


@numba.njit(cache=True, nogil=True)
def _canonical(problem: Problem, params: Array, row: Array) -> None:
    for i in range(lens.FAMILY):
        row[i] = 0.0
        for k in range(params.shape[0]):
            row[i] += problem.canonical_from[i, k] * params[k]
    row[lens.FAMILY] = problem.family


@numba.njit(cache=True, nogil=True)
def _slots(problem: Problem) -> NDArray[np.int64]:
    """(F, 2) the places of the canonical row that a free parameter is in; -1 for no second one."""
    out = np.full((problem.free.shape[0], 2), -1, np.int64)
    for k in range(out.shape[0]):
        found = 0
        for i in range(lens.FAMILY):
            if problem.canonical_from[i, problem.free[k]] != 0.0 and found < 2:
                out[k, found] = i
                found += 1
    return out


@numba.njit(cache=True, nogil=True)
def _slope_of_point(
    problem: Problem, slots: NDArray[np.int64], row: Array, rotation: Array, translation: Array, n: int, out: Array,
    slope: Array, residual: Array,
) -> None:  # fmt: skip
    """Fill the slopes (2, F + 6) of a point's pixel and its residual (2,); out (40,) is scratch."""
    num_free = problem.free.shape[0]
    px, py, pz = problem.xyz[n, 0], problem.xyz[n, 1], problem.xyz[n, 2]
    x = rotation[0, 0] * px + rotation[0, 1] * py + rotation[0, 2] * pz + translation[0]
    y = rotation[1, 0] * px + rotation[1, 1] * py + rotation[1, 2] * pz + translation[1]
    z = rotation[2, 0] * px + rotation[2, 1] * py + rotation[2, 2] * pz + translation[2]
    lens.project_jacobian(row, x, y, z, out)
    for c in range(2):
        a, b, d = out[2 + 3 * c], out[3 + 3 * c], out[4 + 3 * c]
        for k in range(num_free):
            i, j = slots[k, 0], slots[k, 1]
            slope[c, k] = out[8 + 2 * i + c] * problem.canonical_from[i, problem.free[k]]
            if j >= 0:
                slope[c, k] += out[8 + 2 * j + c] * problem.canonical_from[j, problem.free[k]]
        # of a turn w the point moves by w x p
        slope[c, num_free] = y * d - z * b
        slope[c, num_free + 1] = z * a - x * d
        slope[c, num_free + 2] = x * b - y * a
        slope[c, num_free + 3], slope[c, num_free + 4], slope[c, num_free + 5] = a, b, d
        residual[c] = problem.xy[n, c] - out[c]
    if problem.period > 0.0:
        residual[0] -= problem.period * np.round(residual[0] / problem.period)


@numba.njit(cache=True, nogil=True)
def _linearize(problem: Problem, params: Array, rotation: Array, translation: Array, h: Array, g: Array) -> float:
    """Cost, half the sum of squares, and the lower triangle of its Gauss-Newton system; infinite where the lens does
    not see a point that is used."""
    free = problem.free
    num_free = free.shape[0]
    num = num_free + POSE
    row, out, slope, residual = np.empty(lens.ROW), np.empty(lens.JACOBIAN), np.empty((2, num)), np.empty(2)
    _canonical(problem, params, row)
    slots = _slots(problem)
    h[:], g[:] = 0.0, 0.0
    cost, weight = 0.0, 1.0 / problem.noise_px**2
    for n in range(problem.xyz.shape[0]):
        if not problem.is_used[n]:
            continue
        _slope_of_point(problem, slots, row, rotation, translation, n, out, slope, residual)
        r0, r1 = residual[0], residual[1]
        if not (np.isfinite(r0) and np.isfinite(r1)):
            return np.inf
        cost += weight * (r0 * r0 + r1 * r1)
        for i in range(num):
            s0, s1 = weight * slope[0, i], weight * slope[1, i]
            g[i] -= s0 * r0 + s1 * r1
            for j in range(i + 1):
                h[i, j] += s0 * slope[0, j] + s1 * slope[1, j]
    for q in range(problem.rows.shape[0]):
        off = 0.0
        for k in range(params.shape[0]):
            off += problem.rows[q, k] * (params[k] - problem.middle[k])
        cost += off * off
        for i in range(num_free):
            g[i] += problem.rows[q, free[i]] * off
            for j in range(i + 1):
                h[i, j] += problem.rows[q, free[i]] * problem.rows[q, free[j]]
    return 0.5 * cost


@numba.njit(cache=True, nogil=True)
def slopes(problem: Problem, params: Array, rotation: Array, translation: Array, slope: Array, residual: Array) -> None:
    """Fill slopes (N, 2, F + 6) and residuals (N, 2) of all points, used or not; residuals are NaN where the lens does
    not see them."""
    row, out = np.empty(lens.ROW), np.empty(lens.JACOBIAN)
    _canonical(problem, params, row)
    slots = _slots(problem)
    for n in range(problem.xyz.shape[0]):
        _slope_of_point(problem, slots, row, rotation, translation, n, out, slope[n], residual[n])


@numba.njit(cache=True, nogil=True)
def slope_changes(
    problem: Problem, params: Array, rotation: Array, translation: Array, steps: Array, slope: Array, changes: Array
) -> None:
    """Fill changes (N, 2, K, F + 6) of the slopes (N, 2, F + 6) along steps (K, F + 6), by differences."""
    new_params, new_rotation, new_translation = params.copy(), rotation.copy(), translation.copy()
    new_slope, residual = np.empty(slope.shape), np.empty((slope.shape[0], 2))
    for k in range(steps.shape[0]):
        _move(problem, params, rotation, translation, steps[k], new_params, new_rotation, new_translation)
        slopes(problem, new_params, new_rotation, new_translation, new_slope, residual)
        for n in range(slope.shape[0]):
            for c in range(2):
                for i in range(slope.shape[2]):
                    changes[n, c, k, i] = new_slope[n, c, i] - slope[n, c, i]


@numba.njit(cache=True, nogil=True)
def deletions(
    slope: Array, residual: Array, is_used: Bools, cofactor: Array, degrees: float, squares: float, given_px: float,
    statistic: Array, distance: Array,
) -> None:  # fmt: skip
    """Fill F statistics (N,) and distances (N,) of points left out one by one: NaN where nothing checks a point.

    Args:
        cofactor: (U, U) of the unknowns, for residuals of one pixel.
        given_px: noise that is known; 0 where the residuals of the rest tell it.
    """
    num = cofactor.shape[0]
    moved = np.empty(num)
    for n in range(residual.shape[0]):
        statistic[n] = distance[n] = math.nan
        r0, r1 = residual[n, 0], residual[n, 1]
        if not (math.isfinite(r0) and math.isfinite(r1)):
            statistic[n] = distance[n] = math.inf
            continue
        a = b = d = 0.0
        for c in range(2):
            for i in range(num):
                moved[i] = 0.0
                for j in range(num):
                    moved[i] += cofactor[i, j] * slope[n, c, j]
            for i in range(num):
                if c == 0:
                    a += slope[n, 0, i] * moved[i]
                    b += slope[n, 1, i] * moved[i]
                else:
                    d += slope[n, 1, i] * moved[i]
        sign = -1.0 if is_used[n] else 1.0
        a, b, d = 1.0 + sign * a, sign * b, 1.0 + sign * d
        least = 0.5 * (a + d) - math.sqrt(0.25 * (a - d) ** 2 + b * b)
        if not least > _UNCHECKED:
            continue
        # r^T S^-1 r is the same square for both kinds: of a fitted point S is I - H, of another I + H
        det = a * d - b * b
        s0, s1 = (d * r0 - b * r1) / det, (a * r1 - b * r0) / det
        square = r0 * s0 + r1 * s1
        distance[n] = math.sqrt(s0 * s0 + s1 * s1) if is_used[n] else math.sqrt(r0 * r0 + r1 * r1)
        if given_px > 0.0:
            statistic[n] = 0.5 * square / (given_px**2 + _EXACT_PX**2)
            continue
        rest = degrees - 2.0 if is_used[n] else degrees
        if rest >= 1.0:
            left = max(squares - square, 0.0) if is_used[n] else squares
            statistic[n] = 0.5 * square / (left / rest + _EXACT_PX**2)
