"""Two views of a scene: fundamental and essential matrices, relative poses, rays that meet.

Everywhere ``x2^T F x1 = 0`` and ``x2^T E x1 = 0``, and the pose is ``cam2_from_cam1`` (7,) as in
:mod:`sfmapp.geometry.rigid3`. Pixels ``xy`` are (N, 2) float64 in any frame as long as F is in the same one; ``xn`` are
normalised image points (N, 2), that is (X/Z, Y/Z). Where it is said, they may be unit rays (N, 3) instead, which see in
every direction: a point then lies in front of a camera if it lies along its ray, errors are angles in radians, and
depths are distances. HZ stands for Hartley and Zisserman, "Multiple View Geometry", 2004.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.damped import solve_damped, turn_columns

Array = NDArray[np.float64]


def essential_from_fundamental(fundamental: Array, k1: Array, k2: Array) -> Array:
    """The essential matrix nearest to ``K2^T F K1``: singular values (1, 1, 0) over sqrt 2, so of unit norm."""
    return nearest_essential(k2.T @ fundamental @ k1)


def fundamental_from_essential(essential: Array, k1: Array, k2: Array) -> Array:
    """``K2^-T E K1^-1`` of unit norm (HZ 9.12)."""
    f = np.linalg.inv(k2).T @ essential @ np.linalg.inv(k1)
    unit: Array = f / np.linalg.norm(f)
    return unit


def nearest_essential(matrix: Array) -> Array:
    """The essential matrix nearest in the Frobenius norm up to scale, of unit norm."""
    u, _, vt = np.linalg.svd(matrix)
    essential: Array = (u[:, :2] @ vt[:2]) / math.sqrt(2.0)
    return essential


def essential_from_pose(cam2_from_cam1: ArrayLike) -> Array:
    """``[t]x R`` of unit norm (HZ 9.11)."""
    pose = np.asarray(cam2_from_cam1, np.float64)
    e = rigid3.skew(pose[4:]) @ rigid3.rotation_matrix(pose)
    norm = np.linalg.norm(e)
    return e / norm if norm > 0 else e


def decompose_essential(essential: Array) -> Array:
    """(4, 7) poses cam2_from_cam1 with unit translation that share an essential matrix (HZ result 9.19)."""
    u, _, vt = np.linalg.svd(essential)
    u = u * np.sign(np.linalg.det(u))
    vt = vt * np.sign(np.linalg.det(vt))
    w = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    rotations = np.stack([u @ w @ vt, u @ w @ vt, u @ w.T @ vt, u @ w.T @ vt])
    return rigid3.from_matrix(rotations, np.stack([u[:, 2], -u[:, 2], u[:, 2], -u[:, 2]]))


@numba.njit(cache=True, nogil=True)
def _sampson_errors(f: Array, xy1: Array, xy2: Array, out: Array) -> None:
    for i in range(xy1.shape[0]):
        x, y, u, v = xy1[i, 0], xy1[i, 1], xy2[i, 0], xy2[i, 1]
        a = f[0, 0] * x + f[0, 1] * y + f[0, 2]
        b = f[1, 0] * x + f[1, 1] * y + f[1, 2]
        c = f[2, 0] * x + f[2, 1] * y + f[2, 2]
        d = f[0, 0] * u + f[1, 0] * v + f[2, 0]
        e = f[0, 1] * u + f[1, 1] * v + f[2, 1]
        r = u * a + v * b + c
        denominator = a * a + b * b + d * d + e * e
        out[i] = r * r / denominator if denominator > 0.0 else math.inf


@numba.njit(cache=True, nogil=True)
def ray_sampson_error(e: Array, x: float, y: float, z: float, u: float, v: float, w: float) -> float:
    """The same of the unit rays (x, y, z) and (u, v, w), radians squared: the gradient is that on both unit spheres."""
    a = e[0, 0] * x + e[0, 1] * y + e[0, 2] * z
    b = e[1, 0] * x + e[1, 1] * y + e[1, 2] * z
    c = e[2, 0] * x + e[2, 1] * y + e[2, 2] * z
    d = e[0, 0] * u + e[1, 0] * v + e[2, 0] * w
    f = e[0, 1] * u + e[1, 1] * v + e[2, 1] * w
    g = e[0, 2] * u + e[1, 2] * v + e[2, 2] * w
    r = u * a + v * b + w * c
    denominator = a * a + b * b + c * c + d * d + f * f + g * g - 2.0 * r * r
    return r * r / denominator if denominator > 0.0 else math.inf


@numba.njit(cache=True, nogil=True)
def _ray_sampson_errors(e: Array, a: Array, b: Array, out: Array) -> None:
    for i in range(a.shape[0]):
        out[i] = ray_sampson_error(e, a[i, 0], a[i, 1], a[i, 2], b[i, 0], b[i, 1], b[i, 2])


def sampson_errors(matrix: Array, xy1: Array, xy2: Array) -> Array:
    """(N,) squared Sampson distances to the epipolar geometry, in the units of the points squared (HZ 11.9).

    Of unit rays (N, 3), with E as the matrix, radians squared.
    """
    out = np.empty(len(xy1))
    kernel = _ray_sampson_errors if xy1.shape[1] == 3 else _sampson_errors
    kernel(np.ascontiguousarray(matrix, np.float64), *_contiguous(xy1, xy2), out)
    return out


@numba.njit(cache=True, nogil=True)
def _ray_depths(rotation: Array, t: Array, xn1: Array, xn2: Array, depths: Array, angles: Array) -> None:
    is_ray = xn1.shape[1] == 3
    for i in range(xn1.shape[0]):
        x, y, z = xn1[i, 0], xn1[i, 1], xn1[i, 2] if is_ray else 1.0
        a0 = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
        a1 = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
        a2 = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
        b0, b1, b2 = xn2[i, 0], xn2[i, 1], xn2[i, 2] if is_ray else 1.0
        aa = a0 * a0 + a1 * a1 + a2 * a2
        bb = b0 * b0 + b1 * b1 + b2 * b2
        ab = a0 * b0 + a1 * b1 + a2 * b2
        at = a0 * t[0] + a1 * t[1] + a2 * t[2]
        bt = b0 * t[0] + b1 * t[1] + b2 * t[2]
        c0, c1, c2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
        det = c0 * c0 + c1 * c1 + c2 * c2  # |a x b|^2 = aa bb - ab^2 without the cancellation
        angles[i] = math.atan2(math.sqrt(det), ab)
        # below 1e-6 radians the depth is noise in double precision
        if det > 1e-12 * aa * bb:
            depths[i, 0] = (ab * bt - bb * at) / det
            depths[i, 1] = (aa * bt - ab * at) / det
        else:
            depths[i, 0] = depths[i, 1] = math.nan


def ray_depths(cam2_from_cam1: ArrayLike, xn1: Array, xn2: Array) -> tuple[Array, Array]:
    """Where pairs of rays come closest (the linear midpoint), and the angles between them.

    Args:
        cam2_from_cam1: (7,) pose; the depths are in the unit of its translation.
        xn1, xn2: (N, 2) normalised image points, or (N, 3) unit rays.

    Returns:
        (N, 2) depths along z in camera 1 and 2, along the rays where these are given, negative behind the camera, NaN
        where the rays are parallel;
        (N,) angles in radians, 0 to pi.
    """
    pose = np.asarray(cam2_from_cam1, np.float64)
    depths, angles = np.empty((len(xn1), 2)), np.empty(len(xn1))
    rotation = np.ascontiguousarray(rigid3.rotation_matrix(pose))
    _ray_depths(rotation, np.ascontiguousarray(pose[4:]), *_contiguous(xn1, xn2), depths, angles)
    return depths, angles


def choose_in_front(poses: Array, xn1: Array, xn2: Array) -> tuple[Array, NDArray[np.bool_], Array]:
    """The pose that has the most points in front of both cameras.

    Args:
        poses: (K, 7) candidates for cam2_from_cam1.
        xn1, xn2: (N, 2) normalised image points, or (N, 3) unit rays.

    Returns:
        The pose (7,), (N,) which points lie in front of both cameras, (N,) angles between the rays in radians.
        The first of equals wins.
    """
    tried = [ray_depths(pose, xn1, xn2) for pose in poses]
    in_front = np.array([(depths > 0).all(1) for depths, _ in tried])
    best = int(np.argmax(in_front.sum(1)))
    return poses[best], in_front[best], tried[best][1]


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


@numba.njit(cache=True, nogil=True)
def _pose_normal_equations(
    r: Array, t: Array, xn1: Array, xn2: Array, scale2: float, tangent: Array, h: Array, g: Array
) -> float:
    """Gauss-Newton system (5, 5), lower triangle, of the Cauchy-weighted Sampson error; returns the cost."""
    e, jacobian = np.empty((6, 3, 3)), np.empty(5)
    _essential_and_slopes(r, t, tangent, e)
    for k in range(5):
        g[k] = 0.0
        for m in range(5):
            h[k, m] = 0.0
    cost = 0.0
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
        cost += math.log1p(ratio)
        for k in range(5):
            m = k + 1
            da = e[m, 0, 0] * x + e[m, 0, 1] * y + e[m, 0, 2]
            db = e[m, 1, 0] * x + e[m, 1, 1] * y + e[m, 1, 2]
            dc = e[m, 2, 0] * x + e[m, 2, 1] * y + e[m, 2, 2]
            dd = e[m, 0, 0] * u + e[m, 1, 0] * v + e[m, 2, 0]
            df = e[m, 0, 1] * u + e[m, 1, 1] * v + e[m, 2, 1]
            jacobian[k] = s * (u * da + v * db + dc - residual * s * (a * da + b * db + d * dd + f * df))
        for k in range(5):
            g[k] += weight * jacobian[k] * residual
            for m in range(k + 1):
                h[k, m] += weight * jacobian[k] * jacobian[m]
    return cost


@numba.njit(cache=True, nogil=True)
def _pose_normal_equations_of_rays(
    r: Array, t: Array, rays1: Array, rays2: Array, scale2: float, tangent: Array, h: Array, g: Array
) -> float:
    """:func:`_pose_normal_equations` with unit rays (N, 3), of the error on the unit spheres."""
    e, jacobian = np.empty((6, 3, 3)), np.empty(5)
    _essential_and_slopes(r, t, tangent, e)
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
    if xn1.shape[1] == 3:
        return _pose_normal_equations_of_rays(r, t, xn1, xn2, scale2, tangent, h, g)
    return _pose_normal_equations(r, t, xn1, xn2, scale2, tangent, h, g)


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
        if not new_cost < cost:
            damping *= 10.0
            if damping > 1e3:
                break
            continue
        has_converged = cost - new_cost < 1e-6 * cost
        now, cost = new, new_cost
        damping = max(damping * 0.1, 1e-9)
        if has_converged:
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
    best = _refine_pose(rotations, ts, *_contiguous(xn1, xn2), scale * scale, max_iterations)
    return rigid3.from_matrix(rotations[best], ts[best])


def _contiguous(xy1: ArrayLike, xy2: ArrayLike) -> tuple[Array, Array]:
    return np.ascontiguousarray(xy1, np.float64), np.ascontiguousarray(xy2, np.float64)


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    points = np.array([[0.1, 0.2], [0.3, -0.1]])
    sampson_errors(np.eye(3), points, points)
    ray_depths(rigid3.IDENTITY, points, points)
    refine_relative_pose([0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0], points, points, 1.0, max_iterations=1)
