"""Relative poses of two calibrated views, refined: the Sampson error over their five degrees of freedom.

``x2^T E x1 = 0`` with E = [t]x R and t of unit length, in the conventions of :mod:`sfmapp.geometry.epipolar`; points
are normalised image points (N, 2), or unit rays (N, 3) whose errors are angles in radians.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.damped import judge_step, solve_damped, turn_columns
from sfmapp.geometry.epipolar import contiguous, depths_of_rays, ray_sampson_error, sampson_error
from sfmapp.simd.copying import copy_into

Array = NDArray[np.float64]


@numba.njit(cache=True, nogil=True)
def _tangent_plane(t: Array, out: Array) -> None:
    """Orthonormal basis (3, 2) of the plane that touches the unit sphere at t."""
    x, y, z = abs(t[0]), abs(t[1]), abs(t[2])
    k = 0 if x <= y and x <= z else (1 if y <= z else 2)
    i, j = (k + 1) % 3, (k + 2) % 3
    norm = math.sqrt(t[i] * t[i] + t[j] * t[j])
    out[k, 0], out[i, 0], out[j, 0] = 0.0, -t[j] / norm, t[i] / norm
    for m in range(3):
        n, p = (m + 1) % 3, (m + 2) % 3
        out[m, 1] = t[n] * out[p, 0] - t[p] * out[n, 0]


@numba.njit(cache=True, nogil=True)
def _essential_and_slopes(r: Array, t: Array, tangent: Array, e: Array) -> None:
    """E = [t]x R in e[0] and its derivatives along exp(w) R and t + tangent b in e[1:], (6, 3, 3)."""
    for k in range(3):
        for m in range(6):
            # column k of R, turned about axis m - 1 for the three of w; then crossed with t or a tangent
            x, y, z = r[0, k], r[1, k], r[2, k]
            if m == 1:
                x, y, z = 0.0, -z, y
            elif m == 2:
                x, y, z = z, 0.0, -x
            elif m == 3:
                x, y, z = -y, x, 0.0
            tx, ty, tz = t[0], t[1], t[2]
            if m > 3:
                tx, ty, tz = tangent[0, m - 4], tangent[1, m - 4], tangent[2, m - 4]
            e[m, 0, k] = ty * z - tz * y
            e[m, 1, k] = tz * x - tx * z
            e[m, 2, k] = tx * y - ty * x


@numba.njit(cache=True, nogil=True, inline="always")
def sampson_normal_equations(num: int, e: Array, xn1: Array, xn2: Array, scale2: float, h: Array, g: Array) -> float:
    """Gauss-Newton system of the Cauchy-weighted Sampson error of points; returns the cost.

    It is written into its callers, where the number of unknowns is a constant: a third of the time is saved by that.

    Args:
        num: K.
        e: (K + 1, 3, 3) the matrix, and its derivatives by K numbers.
        xn1, xn2: (N, 2). scale2: squared residual at which a weight has halved.
        h, g: (K, K), of which the lower triangle is filled in, and (K,).
    """
    jacobian = np.empty(num)
    for k in range(num):
        g[k] = 0.0
        for m in range(num):
            h[k, m] = 0.0
    cost, product = 0.0, 1.0
    for i in range(xn1.shape[0]):
        x, y, u, v = xn1[i, 0], xn1[i, 1], xn2[i, 0], xn2[i, 1]
        a = e[0, 0, 0] * x + e[0, 0, 1] * y + e[0, 0, 2]
        b = e[0, 1, 0] * x + e[0, 1, 1] * y + e[0, 1, 2]
        c = e[0, 2, 0] * x + e[0, 2, 1] * y + e[0, 2, 2]
        d = e[0, 0, 0] * u + e[0, 1, 0] * v + e[0, 2, 0]
        f = e[0, 0, 1] * u + e[0, 1, 1] * v + e[0, 2, 1]
        s2 = a * a + b * b + d * d + f * f
        if s2 <= 0.0:
            continue
        s = 1.0 / math.sqrt(s2)
        residual = (u * a + v * b + c) * s
        ratio = residual * residual / scale2
        weight = 1.0 / (1.0 + ratio)
        product *= 1.0 + ratio
        if product > 1e100:  # one logarithm for many points
            cost += math.log(product)
            product = 1.0
        # the residual's derivatives by the entries of the matrix
        bend = residual * s * s
        p, q, r, t = s * u - bend * a, s * v - bend * b, bend * d, bend * f
        e00, e01, e10, e11, e20, e21 = p * x - u * r, p * y - u * t, q * x - v * r, q * y - v * t, s * x - r, s * y - t
        for k in range(num):
            m = k + 1
            row1 = e00 * e[m, 0, 0] + e01 * e[m, 0, 1] + p * e[m, 0, 2]
            row2 = e10 * e[m, 1, 0] + e11 * e[m, 1, 1] + q * e[m, 1, 2]
            row3 = e20 * e[m, 2, 0] + e21 * e[m, 2, 1] + s * e[m, 2, 2]
            jacobian[k] = row1 + row2 + row3
        for k in range(num):
            g[k] += weight * jacobian[k] * residual
            for m in range(k + 1):
                h[k, m] += weight * jacobian[k] * jacobian[m]
    return cost + math.log(product)


@numba.njit(cache=True, nogil=True)
def _normal_equations_of_rays(e: Array, rays1: Array, rays2: Array, scale2: float, h: Array, g: Array) -> float:
    """:func:`sampson_normal_equations` with unit rays (N, 3), of the error on the unit spheres."""
    jacobian = np.empty(5)
    g[:], h[:] = 0.0, 0.0
    cost = 0.0
    line1, line2, slope1, slope2 = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(rays1.shape[0]):
        a, b = rays1[i], rays2[i]
        _lines(e[0], a, b, line1, line2)
        product = line2[0] * b[0] + line2[1] * b[1] + line2[2] * b[2]
        s2 = -2.0 * product * product
        for k in range(3):
            s2 += line1[k] * line1[k] + line2[k] * line2[k]
        if s2 <= 0.0:
            continue
        s = 1.0 / math.sqrt(s2)
        residual = product * s
        ratio = residual * residual / scale2
        weight = 1.0 / (1.0 + ratio)
        cost += math.log1p(ratio)
        for k in range(5):
            _lines(e[k + 1], a, b, slope1, slope2)
            change = slope2[0] * b[0] + slope2[1] * b[1] + slope2[2] * b[2]
            longer = -2.0 * product * change
            for m in range(3):
                longer += line1[m] * slope1[m] + line2[m] * slope2[m]
            jacobian[k] = s * (change - residual * s * longer)
        for k in range(5):
            g[k] += weight * jacobian[k] * residual
            for m in range(k + 1):
                h[k, m] += weight * jacobian[k] * jacobian[m]
    return cost


@numba.njit(cache=True, nogil=True)
def _lines(e: Array, a: Array, b: Array, line1: Array, line2: Array) -> None:
    """E^T b and E a."""
    for k in range(3):
        line1[k] = e[0, k] * b[0] + e[1, k] * b[1] + e[2, k] * b[2]
        line2[k] = e[k, 0] * a[0] + e[k, 1] * a[1] + e[k, 2] * a[2]


@numba.njit(cache=True, nogil=True)
def _linearize_pose(
    r: Array, t: Array, xn1: Array, xn2: Array, scale2: float, tangent: Array, h: Array, g: Array
) -> float:
    e = np.empty((6, 3, 3))
    _essential_and_slopes(r, t, tangent, e)
    if xn1.shape[1] == 3:
        return _normal_equations_of_rays(e, xn1, xn2, scale2, h, g)
    return sampson_normal_equations(5, e, xn1, xn2, scale2, h, g)


@numba.njit(cache=True, nogil=True)
def _move_pose(r: Array, t: Array, tangent: Array, step: Array, new_r: Array, new_t: Array) -> None:
    """exp(w) R by Rodrigues' formula column by column, and t moved in its tangent plane and back to the sphere."""
    turn_columns(step, r, new_r)
    norm = 0.0
    for k in range(3):
        new_t[k] = t[k] + tangent[k, 0] * step[3] + tangent[k, 1] * step[4]
        norm += new_t[k] * new_t[k]
    for k in range(3):
        new_t[k] /= math.sqrt(norm)


@numba.njit(cache=True, nogil=True)
def _refine_pose(rotations: Array, ts: Array, xn1: Array, xn2: Array, scale2: float, max_iterations: int) -> int:
    """Levenberg-Marquardt from rotations[0] and ts[0] of (2, 3, 3) and (2, 3); returns where the result is, 0 or 1."""
    h, g, factor, step = np.empty((2, 5, 5)), np.empty((2, 5)), np.empty((5, 5)), np.empty(5)
    tangent = np.empty((2, 3, 2))
    now = 0
    _tangent_plane(ts[now], tangent[now])
    cost = _linearize_pose(rotations[now], ts[now], xn1, xn2, scale2, tangent[now], h[now], g[now])
    damping = 1e-4
    for _ in range(max_iterations):
        new, new_cost = 1 - now, math.inf
        if solve_damped(h[now], g[now], damping, factor, step):
            _move_pose(rotations[now], ts[now], tangent[now], step, rotations[new], ts[new])
            _tangent_plane(ts[new], tangent[new])
            new_cost = _linearize_pose(rotations[new], ts[new], xn1, xn2, scale2, tangent[new], h[new], g[new])
        is_better, is_last, damping = judge_step(cost, new_cost, damping)
        if is_better:
            now, cost = new, new_cost
        if is_last:
            break
    return now


def refine_relative_pose(
    cam2_from_cam1: ArrayLike, xn1: Array, xn2: Array, scale: float, max_iterations: int = 20
) -> Array:
    """Levenberg-Marquardt on the Cauchy-weighted Sampson error over the five degrees of freedom of a relative pose.

    Args:
        cam2_from_cam1: (7,) start with a non-zero translation.
        xn1, xn2: (N, 2) normalised image points, or (N, 3) unit rays; outliers are borne by the robust weight.
        scale: residual, in normalised units or radians, at which a point's weight has halved.

    Returns:
        (7,) pose with unit translation; its cost is never above that of the start.
    """
    pose = np.asarray(cam2_from_cam1, np.float64)
    rotations, ts = np.empty((2, 3, 3)), np.empty((2, 3))
    rotations[0], ts[0] = rigid3.rotation_matrix(pose), pose[4:] / np.linalg.norm(pose[4:])
    best = _refine_pose(rotations, ts, *contiguous(xn1, xn2), scale * scale, max_iterations)
    return rigid3.from_matrix(rotations[best], ts[best])


@numba.njit(cache=True, nogil=True)
def _errors_in_front(e: Array, r: Array, t: Array, xn1: Array, xn2: Array, parallel: float, out: Array) -> None:
    is_ray = xn1.shape[1] == 3
    for i in range(xn1.shape[0]):
        x, y, u, v = xn1[i, 0], xn1[i, 1], xn2[i, 0], xn2[i, 1]
        z, w = (xn1[i, 2], xn2[i, 2]) if is_ray else (1.0, 1.0)
        depth1, depth2, across, along = depths_of_rays(r, t, x, y, z, u, v, w)
        if (depth1 > 0.0 and depth2 > 0.0) or (along > 0.0 and across <= parallel * along):
            out[i] = ray_sampson_error(e, x, y, z, u, v, w) if is_ray else sampson_error(e, x, y, u, v)
        else:
            out[i] = math.inf


@numba.njit(cache=True, nogil=True)
def _refine_on_inliers(
    rotations: Array, ts: Array, xn1: Array, xn2: Array, threshold: float, first_gate: float, rounds: int,
    max_iterations: int, errors: Array,
) -> None:  # fmt: skip
    """The pose in rotations[0] and ts[0], in place, and (N,) its squared errors; see :func:`refine_on_inliers`."""
    n, width = xn1.shape
    a, b, inside = np.empty((n, width)), np.empty((n, width)), np.zeros(n, np.bool_)
    e, tangent = np.empty((6, 3, 3)), np.zeros((3, 2))
    for k in range(rounds + 1):
        _essential_and_slopes(rotations[0], ts[0], tangent, e)
        _errors_in_front(e[0], rotations[0], ts[0], xn1, xn2, threshold, errors)
        if k == rounds:
            return
        gate = first_gate if k == 0 else threshold
        count, has_changed = 0, k == 0
        for i in range(n):
            is_inlier = errors[i] < gate * gate
            has_changed = has_changed or is_inlier != inside[i]
            inside[i] = is_inlier
            if is_inlier:
                for m in range(width):
                    a[count, m], b[count, m] = xn1[i, m], xn2[i, m]
                count += 1
        if count < 8 or not has_changed:
            return
        # nearly squares: which matches are inliers is decided by the threshold alone
        scale2 = 4.0 * threshold * threshold
        if _refine_pose(rotations, ts, a[:count], b[:count], scale2, max_iterations) == 1:
            copy_into(rotations[0], rotations[1])
            copy_into(ts[0], ts[1])


def refine_on_inliers(
    cam2_from_cam1: Array, xn1: Array, xn2: Array, threshold: float, *, first_gate: float, rounds: int,
    max_iterations: int = 20,
) -> tuple[Array, Array]:  # fmt: skip
    """A relative pose fitted to its inliers, which are looked for anew after each fit, until they no longer change.

    A point behind a camera is none: half of the wrong matches that lie near their line would be. Of far points noise
    puts half behind the cameras: they stay, as their rays are parallel within the threshold.

    Args:
        cam2_from_cam1: (7,) start with a non-zero translation.
        xn1, xn2: (N, 2) normalised image points, or (N, 3) unit rays.
        threshold: largest Sampson distance of an inlier. first_gate: that of the first round.
        rounds: most fits; none with fewer than eight inliers. max_iterations: of each.

    Returns:
        (7,) pose with unit translation; (N,) squared Sampson distances to it, infinite behind a camera.
    """
    rotations, ts, errors = np.empty((2, 3, 3)), np.empty((2, 3)), np.empty(len(xn1))
    rotations[0] = rigid3.rotation_matrix(cam2_from_cam1)
    ts[0] = cam2_from_cam1[4:] / np.linalg.norm(cam2_from_cam1[4:])
    _refine_on_inliers(
        rotations, ts, *contiguous(xn1, xn2), threshold, first_gate, rounds, max_iterations, errors
    )  # fmt: skip
    return rigid3.from_matrix(rotations[0], ts[0]), errors


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    points, pose = np.array([[0.1, 0.2], [0.3, -0.1]]), np.array([0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0])
    refine_relative_pose(pose, points, points, 1.0, max_iterations=1)
    refine_on_inliers(pose, points, points, 1.0, first_gate=1.0, rounds=1)
