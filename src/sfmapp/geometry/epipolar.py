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

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


def essential_from_fundamental(fundamental: Array, k1: Array, k2: Array) -> Array:
    """The essential matrices (..., 3, 3) nearest to ``K2^T F K1``: singular values (1, 1, 0) over sqrt 2, so of unit
    norm."""
    return nearest_essential(np.swapaxes(k2, -1, -2) @ fundamental @ k1)


def fundamental_from_essential(essential: Array, k1: Array, k2: Array) -> Array:
    """``K2^-T E K1^-1`` of unit norm (HZ 9.12)."""
    f = np.linalg.inv(k2).T @ essential @ np.linalg.inv(k1)
    unit: Array = f / np.linalg.norm(f)
    return unit


def nearest_essential(matrix: Array) -> Array:
    """The essential matrices (..., 3, 3) nearest in the Frobenius norm up to scale, of unit norm."""
    u, _, vt = np.linalg.svd(matrix)
    essential: Array = (u[..., :2] @ vt[..., :2, :]) / math.sqrt(2.0)
    return essential


def essential_from_pose(cam2_from_cam1: ArrayLike) -> Array:
    """``[t]x R`` of unit norm (HZ 9.11)."""
    pose = np.asarray(cam2_from_cam1, np.float64)
    e = rigid3.skew(pose[4:]) @ rigid3.rotation_matrix(pose)
    norm = np.linalg.norm(e)
    return e / norm if norm > 0 else e


def decompose_essential(essential: Array) -> Array:
    """(..., 4, 7) poses cam2_from_cam1 with unit translation that share an essential matrix (..., 3, 3) (HZ 9.19)."""
    u, _, vt = np.linalg.svd(essential)
    u = u * np.sign(np.linalg.det(u))[..., None, None]
    vt = vt * np.sign(np.linalg.det(vt))[..., None, None]
    w = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turns, t = rigid3.quaternion(np.stack([u @ w @ vt, u @ w.T @ vt], -3)), u[..., 2]
    return np.concatenate([turns[..., [0, 0, 1, 1], :], np.stack([t, -t, t, -t], -2)], -1)


@numba.njit(cache=True, nogil=True)
def sampson_error(f: Array, x: float, y: float, u: float, v: float) -> float:
    """Squared Sampson distance of the points (x, y) and (u, v) (HZ 11.9); infinite where no line is one."""
    a = f[0, 0] * x + f[0, 1] * y + f[0, 2]
    b = f[1, 0] * x + f[1, 1] * y + f[1, 2]
    c = f[2, 0] * x + f[2, 1] * y + f[2, 2]
    d = f[0, 0] * u + f[1, 0] * v + f[2, 0]
    e = f[0, 1] * u + f[1, 1] * v + f[2, 1]
    r = u * a + v * b + c
    denominator = a * a + b * b + d * d + e * e
    return r * r / denominator if denominator > 0.0 else math.inf


@numba.njit(cache=True, nogil=True)
def _sampson_errors(f: Array, xy1: Array, xy2: Array, out: Array) -> None:
    for i in range(xy1.shape[0]):
        out[i] = sampson_error(f, xy1[i, 0], xy1[i, 1], xy2[i, 0], xy2[i, 1])


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
    kernel(np.ascontiguousarray(matrix, np.float64), *contiguous(xy1, xy2), out)
    return out


@numba.njit(cache=True, nogil=True)
def _truncated_sums(matrices: Array, xy1: Array, xy2: Array, limit: float, out: Array) -> None:
    is_ray = xy1.shape[1] == 3
    for k in range(matrices.shape[0]):
        total = 0.0
        for i in range(xy1.shape[0]):
            a, b = xy1[i], xy2[i]
            if is_ray:
                total += min(ray_sampson_error(matrices[k], a[0], a[1], a[2], b[0], b[1], b[2]), limit)
            else:
                total += min(sampson_error(matrices[k], a[0], a[1], b[0], b[1]), limit)
        out[k] = total


def truncated_sums(matrices: Array, xy1: Array, xy2: Array, limit: float) -> Array:
    """(K,) sums over the points of :func:`sampson_errors`, none above a limit, of (K, 3, 3) matrices."""
    out = np.empty(len(matrices))
    _truncated_sums(np.ascontiguousarray(matrices, np.float64), *contiguous(xy1, xy2), limit, out)
    return out


@numba.njit(cache=True, nogil=True)
def depths_of_rays(
    rotation: Array, t: Array, x: float, y: float, z: float, b0: float, b1: float, b2: float
) -> tuple[float, float, float, float]:
    """Depths of one pair of rays, NaN where they are parallel, and tangent's two sides of the angle between them."""
    a0 = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
    a1 = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
    a2 = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
    aa = a0 * a0 + a1 * a1 + a2 * a2
    bb = b0 * b0 + b1 * b1 + b2 * b2
    ab = a0 * b0 + a1 * b1 + a2 * b2
    at = a0 * t[0] + a1 * t[1] + a2 * t[2]
    bt = b0 * t[0] + b1 * t[1] + b2 * t[2]
    c0, c1, c2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    det = c0 * c0 + c1 * c1 + c2 * c2  # |a x b|^2 = aa bb - ab^2 without the cancellation
    # below 1e-6 radians the depth is noise in double precision
    if det > 1e-12 * aa * bb:
        return (ab * bt - bb * at) / det, (aa * bt - ab * at) / det, math.sqrt(det), ab
    return math.nan, math.nan, math.sqrt(det), ab


@numba.njit(cache=True, nogil=True)
def _ray_depths(rotation: Array, t: Array, xn1: Array, xn2: Array, depths: Array, angles: Array) -> None:
    is_ray = xn1.shape[1] == 3
    for i in range(xn1.shape[0]):
        z1, z2 = (xn1[i, 2], xn2[i, 2]) if is_ray else (1.0, 1.0)
        depths[i, 0], depths[i, 1], across, along = depths_of_rays(
            rotation, t, xn1[i, 0], xn1[i, 1], z1, xn2[i, 0], xn2[i, 1], z2
        )
        angles[i] = math.atan2(across, along)


@numba.njit(cache=True, nogil=True)
def _count_in_front(rotations: Array, ts: Array, xn1: Array, xn2: Array, counts: Ints) -> None:
    is_ray = xn1.shape[1] == 3
    for k in range(rotations.shape[0]):
        counts[k] = 0
        for i in range(xn1.shape[0]):
            z1, z2 = (xn1[i, 2], xn2[i, 2]) if is_ray else (1.0, 1.0)
            first, second, _, _ = depths_of_rays(
                rotations[k], ts[k], xn1[i, 0], xn1[i, 1], z1, xn2[i, 0], xn2[i, 1], z2
            )
            if first > 0.0 and second > 0.0:
                counts[k] += 1


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
    _ray_depths(rotation, np.ascontiguousarray(pose[4:]), *contiguous(xn1, xn2), depths, angles)
    return depths, angles


def most_in_front(rotations: Array, ts: Array, xn1: Array, xn2: Array) -> int:
    """Which of K poses, rotations (K, 3, 3) and translations (K, 3) of cam2_from_cam1, has the most points (N, 2), or
    (N, 3) unit rays, in front of both cameras; the first of equals."""
    counts = np.empty(len(rotations), np.int64)
    _count_in_front(*contiguous(rotations, ts), *contiguous(xn1, xn2), counts)
    return int(np.argmax(counts))


def choose_in_front(poses: Array, xn1: Array, xn2: Array) -> tuple[Array, NDArray[np.bool_], Array]:
    """The pose that has the most points in front of both cameras.

    Args:
        poses: (K, 7) candidates for cam2_from_cam1.
        xn1, xn2: (N, 2) normalised image points, or (N, 3) unit rays.

    Returns:
        The pose (7,), (N,) which points lie in front of both cameras, (N,) angles between the rays in radians.
        The first of equals wins.
    """
    poses = np.asarray(poses, np.float64)
    best = poses[most_in_front(rigid3.rotation_matrix(poses), poses[:, 4:], xn1, xn2)]
    depths, angles = ray_depths(best, xn1, xn2)
    return best, (depths[:, 0] > 0) & (depths[:, 1] > 0), angles


def contiguous(xy1: ArrayLike, xy2: ArrayLike) -> tuple[Array, Array]:
    """Both as kernels take them."""
    return np.ascontiguousarray(xy1, np.float64), np.ascontiguousarray(xy2, np.float64)


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    points = np.array([[0.1, 0.2], [0.3, -0.1]])
    sampson_errors(np.eye(3), points, points)
    truncated_sums(np.eye(3)[None], points, points, 1.0)
    choose_in_front(rigid3.IDENTITY[None], points, points)
