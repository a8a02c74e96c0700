"""Two views of a scene: fundamental and essential matrices, relative poses, rays that meet.

Everywhere ``x2^T F x1 = 0`` and ``x2^T E x1 = 0``, and the pose is ``cam2_from_cam1`` (7,) as in
:mod:`sfmapp.geometry.rigid3`. Pixels ``xy`` are (N, 2) float64 in any frame as long as F is in the same one; ``xn`` are
normalised image points (N, 2), that is (X/Z, Y/Z). HZ stands for Hartley and Zisserman, "Multiple View Geometry", 2004.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry import rigid3

Array = NDArray[np.float64]


def normalizing_transform(xy: Array, weights: Array | None = None) -> Array:
    """(3, 3) similarity that moves the centroid of pixels (N, 2) to 0 and their rms distance to sqrt 2.

    Hartley, "In defense of the eight-point algorithm", PAMI 1997. The weights (N,) only weigh the statistics.
    """
    w = np.ones(len(xy)) if weights is None else weights
    total = max(float(w.sum()), 1e-300)
    mean = w @ xy / total
    rms = math.sqrt(float(w @ ((xy - mean) ** 2).sum(1)) / total)
    s = math.sqrt(2.0) / rms if rms > 0 else 1.0
    return np.array([[s, 0.0, -s * mean[0]], [0.0, s, -s * mean[1]], [0.0, 0.0, 1.0]])


def fundamental_from_points(xy1: Array, xy2: Array, weights: Array | None = None) -> Array:
    """Normalised eight-point algorithm (HZ algorithm 11.1): F (3, 3) of rank two and unit norm.

    Args:
        xy1, xy2: (N, 2) corresponding pixels, N >= 8.
        weights: (N,) factor on the squared algebraic residual of each; 1 / (Sampson's denominator) makes the minimum
            that of Sampson's error once the weights have settled.
    """
    if len(xy1) < 8:
        raise ValueError(f"the eight-point algorithm takes at least 8 points, got {len(xy1)}")
    t1, t2 = normalizing_transform(xy1, weights), normalizing_transform(xy2, weights)
    a = xy1 * t1[0, 0] + t1[:2, 2]
    b = xy2 * t2[0, 0] + t2[:2, 2]
    one = np.ones(len(a))
    design = np.stack([b[:, 0] * a[:, 0], b[:, 0] * a[:, 1], b[:, 0], b[:, 1] * a[:, 0], b[:, 1] * a[:, 1], b[:, 1],
                       a[:, 0], a[:, 1], one], 1)  # fmt: skip
    weighted = design if weights is None else design * weights[:, None]
    # the eigenvector of the 9 x 9 normal matrix: the points are normalised, so squaring costs no digits that matter
    f = np.linalg.eigh(design.T @ weighted)[1][:, 0].reshape(3, 3)
    u, s, vt = np.linalg.svd(f)
    f = t2.T @ (u[:, :2] * s[:2]) @ vt[:2] @ t1
    return f / np.linalg.norm(f)


def essential_from_fundamental(fundamental: Array, k1: Array, k2: Array) -> Array:
    """The essential matrix nearest to ``K2^T F K1``: singular values (1, 1, 0) over sqrt 2, so of unit norm."""
    return nearest_essential(k2.T @ fundamental @ k1)


def fundamental_from_essential(essential: Array, k1: Array, k2: Array) -> Array:
    """``K2^-T E K1^-1`` of unit norm (HZ 9.12)."""
    f = np.linalg.inv(k2).T @ essential @ np.linalg.inv(k1)
    return f / np.linalg.norm(f)


def nearest_essential(matrix: Array) -> Array:
    """The essential matrix nearest in the Frobenius norm up to scale, of unit norm."""
    u, _, vt = np.linalg.svd(matrix)
    return (u[:, :2] @ vt[:2]) / math.sqrt(2.0)


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


def sampson_errors(matrix: Array, xy1: Array, xy2: Array) -> Array:
    """(N,) squared Sampson distances to the epipolar geometry, in the units of the points squared (HZ 11.9)."""
    out = np.empty(len(xy1))
    _sampson_errors(*(np.ascontiguousarray(a, np.float64) for a in (matrix, xy1, xy2)), out)
    return out


def sampson_weights(fundamental: Array, xy1: Array, xy2: Array) -> Array:
    """(N,) weights, largest 1, that turn algebraic residuals of F into Sampson's; for fundamental_from_points."""
    line2 = xy1 @ fundamental[:2, :2].T + fundamental[:2, 2]
    line1 = xy2 @ fundamental[:2, :2] + fundamental[2, :2]
    denominator = (line2**2).sum(1) + (line1**2).sum(1)
    weights = 1.0 / np.maximum(denominator, max(1e-12 * float(denominator.max()), 1e-300))
    return weights / weights.max()


@numba.njit(cache=True, nogil=True)
def _ray_depths(rotation: Array, t: Array, xn1: Array, xn2: Array, depths: Array, angles: Array) -> None:
    for i in range(xn1.shape[0]):
        x, y = xn1[i, 0], xn1[i, 1]
        a0 = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2]
        a1 = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2]
        a2 = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2]
        b0, b1 = xn2[i, 0], xn2[i, 1]
        aa = a0 * a0 + a1 * a1 + a2 * a2
        bb = b0 * b0 + b1 * b1 + 1.0
        ab = a0 * b0 + a1 * b1 + a2
        at = a0 * t[0] + a1 * t[1] + a2 * t[2]
        bt = b0 * t[0] + b1 * t[1] + t[2]
        c0, c1, c2 = a1 - a2 * b1, a2 * b0 - a0, a0 * b1 - a1 * b0
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
        xn1, xn2: (N, 2) normalised image points.

    Returns:
        (N, 2) depths along z in camera 1 and 2, negative behind the camera, NaN where the rays are parallel;
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
        xn1, xn2: (N, 2) normalised image points.

    Returns:
        The pose (7,), (N,) which points lie in front of both cameras, (N,) angles between the rays in radians.
        The first of equals wins.
    """
    tried = [ray_depths(pose, xn1, xn2) for pose in poses]
    in_front = np.array([(depths > 0).all(1) for depths, _ in tried])
    best = int(np.argmax(in_front.sum(1)))
    return poses[best], in_front[best], tried[best][1]


@numba.njit(cache=True, nogil=True)
def _pose_normal_equations(
    r: Array, t: Array, xn1: Array, xn2: Array, scale2: float, tangent: Array, h: Array, g: Array
) -> float:
    """Gauss-Newton system (5, 5) of the Cauchy-weighted Sampson error for exp(w) R, t + tangent b; returns the cost."""
    e = np.empty((3, 3))
    for k in range(3):
        e[0, k] = t[1] * r[2, k] - t[2] * r[1, k]
        e[1, k] = t[2] * r[0, k] - t[0] * r[2, k]
        e[2, k] = t[0] * r[1, k] - t[1] * r[0, k]
    jacobian = np.empty(5)
    h[:] = 0.0
    g[:] = 0.0
    cost = 0.0
    for i in range(xn1.shape[0]):
        x, y, u, v = xn1[i, 0], xn1[i, 1], xn2[i, 0], xn2[i, 1]
        a = e[0, 0] * x + e[0, 1] * y + e[0, 2]
        b = e[1, 0] * x + e[1, 1] * y + e[1, 2]
        c = e[2, 0] * x + e[2, 1] * y + e[2, 2]
        d = e[0, 0] * u + e[1, 0] * v + e[2, 0]
        f = e[0, 1] * u + e[1, 1] * v + e[2, 1]
        s2 = a * a + b * b + d * d + f * f
        if s2 <= 0.0:
            continue
        s = 1.0 / math.sqrt(s2)
        residual = (u * a + v * b + c) * s
        ratio = residual * residual / scale2
        weight = 1.0 / (1.0 + ratio)
        cost += math.log1p(ratio)
        # the numerator is b2 . (t x a1) with a1 = R x1, b2 = x2; Sampson's denominator is held still, as is usual
        p0 = r[0, 0] * x + r[0, 1] * y + r[0, 2]
        p1 = r[1, 0] * x + r[1, 1] * y + r[1, 2]
        p2 = r[2, 0] * x + r[2, 1] * y + r[2, 2]
        q0, q1, q2 = v * t[2] - t[1], t[0] - u * t[2], u * t[1] - v * t[0]  # b2 x t
        jacobian[0] = (p1 * q2 - p2 * q1) * s
        jacobian[1] = (p2 * q0 - p0 * q2) * s
        jacobian[2] = (p0 * q1 - p1 * q0) * s
        m0, m1, m2 = p1 - p2 * v, p2 * u - p0, p0 * v - p1 * u  # a1 x b2
        jacobian[3] = (m0 * tangent[0, 0] + m1 * tangent[1, 0] + m2 * tangent[2, 0]) * s
        jacobian[4] = (m0 * tangent[0, 1] + m1 * tangent[1, 1] + m2 * tangent[2, 1]) * s
        for k in range(5):
            g[k] += weight * jacobian[k] * residual
            for m in range(k, 5):
                h[k, m] += weight * jacobian[k] * jacobian[m]
    for k in range(5):
        for m in range(k):
            h[k, m] = h[m, k]
    return cost


def refine_relative_pose(
    cam2_from_cam1: ArrayLike, xn1: Array, xn2: Array, scale: float, max_iterations: int = 10
) -> Array:
    """Levenberg-Marquardt on the Cauchy-weighted Sampson error over the five degrees of freedom of a relative pose.

    Args:
        cam2_from_cam1: (7,) start with a non-zero translation.
        xn1, xn2: (N, 2) normalised image points; outliers are borne by the robust weight.
        scale: residual, in normalised units, at which a point's weight has halved.

    Returns:
        (7,) pose with unit translation; its cost is never above that of the start.
    """
    pose = np.asarray(cam2_from_cam1, np.float64)
    r, t = rigid3.rotation_matrix(pose), pose[4:] / np.linalg.norm(pose[4:])
    a, b = _contiguous(xn1, xn2)
    h, g = np.empty((5, 5)), np.empty(5)
    damping = 1e-4
    tangent = _tangent_of(t)
    cost = _pose_normal_equations(r, t, a, b, scale * scale, tangent, h, g)
    for _ in range(max_iterations):
        try:
            step = -np.linalg.solve(h + damping * np.diag(np.diag(h)) + 1e-15 * np.trace(h) * np.eye(5), g)
        except np.linalg.LinAlgError:
            break
        new_r = np.ascontiguousarray(rigid3.exp_so3(step[:3]) @ r)
        new_t = t + tangent @ step[3:]
        new_t /= np.linalg.norm(new_t)
        new_tangent, new_h, new_g = _tangent_of(new_t), np.empty((5, 5)), np.empty(5)
        new_cost = _pose_normal_equations(new_r, new_t, a, b, scale * scale, new_tangent, new_h, new_g)
        if not new_cost < cost:
            damping *= 10.0
            if damping > 1e3:
                break
            continue
        converged = cost - new_cost < 1e-8 * cost
        r, t, tangent, h, g, cost = new_r, new_t, new_tangent, new_h, new_g, new_cost
        damping = max(damping * 0.1, 1e-9)
        if converged:
            break
    return rigid3.from_matrix(r, t)


def _tangent_of(t: Array) -> Array:
    """(3, 2) orthonormal basis of the plane that touches the sphere at t."""
    helper = np.zeros(3)
    helper[np.argmin(np.abs(t))] = 1.0
    first = np.cross(t, helper)
    first /= np.linalg.norm(first)
    return np.ascontiguousarray(np.stack([first, np.cross(t, first)], 1))


def _contiguous(*arrays: ArrayLike) -> tuple[Array, ...]:
    return tuple(np.ascontiguousarray(a, np.float64) for a in arrays)


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    points = np.array([[0.1, 0.2], [0.3, -0.1]])
    sampson_errors(np.eye(3), points, points)
    ray_depths(rigid3.IDENTITY, points, points)
    refine_relative_pose([0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0], points, points, 1.0, max_iterations=1)
