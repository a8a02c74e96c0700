"""Relative pose of a camera on a vehicle that moves in a plane: one, two or three points instead of five.

Scaramuzza, "1-Point-RANSAC structure from motion for vehicle-mounted cameras by exploiting non-holonomic constraints",
IJCV 2011, section 3; Ortin and Montiel, "Indoor robot motion based on monocular images", Robotica 2001; Choi and Kim,
"Fast and reliable minimal relative pose estimation under planar motion", IVC 2018.

The camera turns by theta about the plane's normal u and moves along cos(phi) a + sin(phi) b, where (a, b, u) is a
right-handed basis. A ray is p a + q b + h u. With psi = theta - phi the epipolar constraint x2^T [t]x R x1 = 0 reads

    sin(phi) p2 h1 - cos(phi) q2 h1 + sin(psi) h2 p1 + cos(psi) h2 q1 = 0,

linear in two unit vectors. Points level with the camera (h = 0) say nothing. By how many points a motion is told:

- three: the four numbers are found up to their scale, and their two lengths, which should be equal, are left free;
- two: equal lengths leave a quadratic, so at most two essential matrices;
- one: a car with steered front wheels goes along a circle (Ackermann). A camera over the rear axle, which looks where
  the car goes, then moves half as far from its forward direction alpha as it turns, phi = alpha + pi + theta / 2 and
  psi = theta / 2 - alpha - pi, which makes the constraint linear in (sin(theta / 2), cos(theta / 2)). For a camera
  elsewhere this is a guess, which the refinement of both angles mends.
"""

from __future__ import annotations

import math
from typing import Literal

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.damped import judge_step, solve_damped
from sfmapp.geometry.epipolar import choose_in_front, ray_depths, sampson_error, sampson_errors
from sfmapp.geometry.relative_pose import sampson_normal_equations
from sfmapp.simd.copying import copy_into

Array = NDArray[np.float64]
NumPoints = Literal[1, 2, 3]

# Two points all good with 30 % inliers: 0.09. 300 samples miss them all with a probability of 5e-13.
MAX_SAMPLES = 300
# Stop when the chance that no sample was good falls below this.
_MISS = 1e-6
# A minimal sample whose determinant is below this share of its entries' product says nothing in double precision.
_SINGULAR = 1e-9


def estimate_planar_motion(
    xn1: ArrayLike,
    xn2: ArrayLike,
    max_error: float,
    up_in_cam: ArrayLike = (0.0, -1.0, 0.0),
    seed: int = 0,
    *,
    num_points: NumPoints = 2,
    forward_in_cam: ArrayLike = (0.0, 0.0, 1.0),
) -> tuple[Array, NDArray[np.bool_]] | None:
    """RANSAC over one, two or three points (MSAC score on Sampson's error); both angles are refined on the inliers.

    Args:
        xn1, xn2: (N, 2) normalised image points (X/Z, Y/Z) of one camera at two moments.
        max_error: Sampson distance of an inlier, normalised units (pixels over the focal length).
        up_in_cam: (3,) normal of the plane of motion in the camera's frame, of any length and sign.
        seed: same seed, same result.
        num_points: in a sample. One: of a vehicle that goes along circles, see the module.
        forward_in_cam: (3,) where such a vehicle goes, in the camera's frame; its part along the plane counts.

    Returns:
        ``cam2_from_cam1`` (7,) with unit translation and (N,) bool inliers: within ``max_error`` and not clearly
        behind a camera. None where no sample determines a motion. A standing or purely turning camera
        gives an arbitrary direction, as with the five-point algorithm: ask for parallax first.
    """
    first, second = (np.ascontiguousarray(a, np.float64) for a in (xn1, xn2))
    if len(first) < num_points:
        return None
    basis = _basis(np.asarray(up_in_cam, np.float64))
    ahead = basis[:2] @ np.asarray(forward_in_cam, np.float64)
    if not np.linalg.norm(ahead) > 0:
        raise ValueError("forward_in_cam must not be along up_in_cam")
    rays1 = np.column_stack([first, np.ones(len(first))]) @ basis.T
    rays2 = np.column_stack([second, np.ones(len(second))]) @ basis.T
    samples = np.random.default_rng([seed, 0x2B17]).random((MAX_SAMPLES, num_points))
    angles = np.empty(2)
    forward = math.atan2(ahead[1], ahead[0])
    if not _search(rays1, rays2, basis, forward, first, second, samples, max_error**2, angles):
        return None
    pose, is_inlier = _inliers(basis, angles, first, second, max_error)
    for _ in range(5):  # the set of inliers settles in two or three rounds
        if is_inlier.sum() < 2:
            break
        _refine(basis, first[is_inlier], second[is_inlier], (0.5 * max_error) ** 2, angles)
        previous, (pose, is_inlier) = is_inlier, _inliers(basis, angles, first, second, max_error)
        if np.array_equal(previous, is_inlier):
            break
    return pose, is_inlier


def _inliers(basis: Array, angles: Array, xn1: Array, xn2: Array, max_error: float) -> tuple[Array, NDArray[np.bool_]]:
    """The pose with more points in front of the cameras, and which points agree with it."""
    is_close = sampson_errors(_essential(basis, angles), xn1, xn2) <= max_error**2
    poses = np.stack([_pose(basis, angles), _pose(basis, angles + math.pi)])
    pose, _, _ = choose_in_front(poses, xn1[is_close], xn2[is_close])
    depths, ray_angles = ray_depths(pose, xn1, xn2)
    # of the far points noise puts half behind the cameras: they stay, or the near half of the noise would be left
    return pose, is_close & ~((depths < 0).any(1) & (ray_angles > max_error))


def _basis(up: Array) -> Array:
    """Rows a, b, u of a right-handed orthonormal basis (3, 3)."""
    norm = np.linalg.norm(up)
    if not norm > 0:
        raise ValueError("up_in_cam must not be zero")
    u = up / norm
    a = np.eye(3)[np.argmin(np.abs(u))]
    a = a - (a @ u) * u
    a /= np.linalg.norm(a)
    return np.ascontiguousarray(np.stack([a, np.cross(u, a), u]))


def _pose(basis: Array, angles: Array) -> Array:
    phi, psi = angles
    translation = math.cos(phi) * basis[0] + math.sin(phi) * basis[1]
    return rigid3.from_matrix(rigid3.exp_so3((phi + psi) * basis[2]), translation)


def _essential(basis: Array, angles: Array) -> Array:
    """E of unit translation for the angles (phi, psi)."""
    a, b, u = basis
    (sin_phi, sin_psi), (cos_phi, cos_psi) = np.sin(angles), np.cos(angles)
    return np.outer(sin_phi * a - cos_phi * b, u) + np.outer(u, sin_psi * a + cos_psi * b)


@numba.njit(cache=True, nogil=True)
def _row(rays1: Array, rays2: Array, i: int) -> tuple[float, float, float, float]:
    """What the i-th point says of (sin phi, cos phi, sin psi, cos psi): its product with them vanishes."""
    h1, h2 = rays1[i, 2], rays2[i, 2]
    return rays2[i, 0] * h1, -rays2[i, 1] * h1, h2 * rays1[i, 0], h2 * rays1[i, 1]


@numba.njit(cache=True, nogil=True)
def _solve_one(rays1: Array, rays2: Array, i: int, forward: float, out: Array) -> int:
    """Angles (phi, psi) of one point and a way along a circle into out[0]; returns how many solutions there are."""
    p, q, r, s = _row(rays1, rays2, i)
    alpha = forward + math.pi
    sine, cosine = math.sin(alpha), math.cos(alpha)
    of_sine = cosine * p - sine * q + cosine * r + sine * s
    of_cosine = sine * p + cosine * q - sine * r + cosine * s
    size = p * p + q * q + r * r + s * s
    if of_sine * of_sine + of_cosine * of_cosine <= _SINGULAR * _SINGULAR * size:
        return 0
    # of both ends of the line through the origin the one that turns by less than half round
    half = math.atan(-of_cosine / of_sine) if of_sine != 0.0 else 0.5 * math.pi
    out[0, 0], out[0, 1] = alpha + half, half - alpha
    return 1


@numba.njit(cache=True, nogil=True)
def _solve_two(rays1: Array, rays2: Array, i: int, j: int, out: Array) -> int:
    """Angles (phi, psi) of two points into out (2, 2); returns how many solutions there are."""
    # A (sin phi, cos phi) + B (sin psi, cos psi) = 0, hence (sin phi, cos phi) = M (sin psi, cos psi)
    a00, a01 = rays2[i, 0] * rays1[i, 2], -rays2[i, 1] * rays1[i, 2]
    a10, a11 = rays2[j, 0] * rays1[j, 2], -rays2[j, 1] * rays1[j, 2]
    b00, b01 = rays2[i, 2] * rays1[i, 0], rays2[i, 2] * rays1[i, 1]
    b10, b11 = rays2[j, 2] * rays1[j, 0], rays2[j, 2] * rays1[j, 1]
    det = a00 * a11 - a01 * a10
    if abs(det) <= _SINGULAR * math.sqrt((a00 * a00 + a01 * a01) * (a10 * a10 + a11 * a11)):
        return 0
    m00, m01 = (a01 * b10 - a11 * b00) / det, (a01 * b11 - a11 * b01) / det
    m10, m11 = (a10 * b00 - a00 * b10) / det, (a10 * b01 - a00 * b11) / det
    # |M y|^2 = |y|^2 for y = (sin psi, cos psi): a quadratic form in y that vanishes
    c_ss = m00 * m00 + m10 * m10 - 1.0
    c_sc = m00 * m01 + m10 * m11
    c_cc = m01 * m01 + m11 * m11 - 1.0
    root2 = c_sc * c_sc - c_ss * c_cc
    if root2 < 0.0:
        return 0
    root = math.sqrt(root2)
    # of the two forms of the root the one that does not cancel: y ~ (q, c_ss) and (c_cc, q)
    q = -(c_sc + root) if c_sc >= 0.0 else -(c_sc - root)
    for k in range(2):
        s, c = (q, c_ss) if k == 0 else (c_cc, q)
        out[k, 0] = math.atan2(m00 * s + m01 * c, m10 * s + m11 * c)
        out[k, 1] = math.atan2(s, c)
    return 2


@numba.njit(cache=True, nogil=True)
def _solve_three(rays1: Array, rays2: Array, i: int, j: int, k: int, out: Array) -> int:
    """Angles (phi, psi) of three points into out[0]; returns how many solutions there are."""
    a0, a1, a2, a3 = _row(rays1, rays2, i)
    b0, b1, b2, b3 = _row(rays1, rays2, j)
    c0, c1, c2, c3 = _row(rays1, rays2, k)
    # the vector across three others in four dimensions: minors of two rows, then of three
    m01, m02, m03 = b0 * c1 - b1 * c0, b0 * c2 - b2 * c0, b0 * c3 - b3 * c0
    m12, m13, m23 = b1 * c2 - b2 * c1, b1 * c3 - b3 * c1, b2 * c3 - b3 * c2
    sin_phi = a1 * m23 - a2 * m13 + a3 * m12
    cos_phi = -(a0 * m23 - a2 * m03 + a3 * m02)
    sin_psi = a0 * m13 - a1 * m03 + a3 * m01
    cos_psi = -(a0 * m12 - a1 * m02 + a2 * m01)
    size2 = (a0 * a0 + a1 * a1 + a2 * a2 + a3 * a3) * (b0 * b0 + b1 * b1 + b2 * b2 + b3 * b3)
    size2 *= c0 * c0 + c1 * c1 + c2 * c2 + c3 * c3
    # where one of the two lengths vanishes that angle says nothing
    least = _SINGULAR * _SINGULAR * size2
    if sin_phi * sin_phi + cos_phi * cos_phi <= least or sin_psi * sin_psi + cos_psi * cos_psi <= least:
        return 0
    out[0, 0], out[0, 1] = math.atan2(sin_phi, cos_phi), math.atan2(sin_psi, cos_psi)
    return 1


@numba.njit(cache=True, nogil=True)
def _solve(rays1: Array, rays2: Array, sample: Array, forward: float, out: Array) -> int:
    """Angles (phi, psi) of a sample of one, two or three numbers in [0, 1) into out (2, 2); how many there are."""
    n = rays1.shape[0]
    i = int(sample[0] * n)
    if sample.shape[0] == 1:
        return _solve_one(rays1, rays2, i, forward, out)
    j = int(sample[1] * (n - 1))
    j += 1 if j >= i else 0
    if sample.shape[0] == 2:
        return _solve_two(rays1, rays2, i, j, out)
    k = int(sample[2] * (n - 2))
    k += 1 if k >= min(i, j) else 0
    k += 1 if k >= max(i, j) else 0
    return _solve_three(rays1, rays2, i, j, k, out)


@numba.njit(cache=True, nogil=True)
def _fill_essential(basis: Array, phi: float, psi: float, e: Array) -> None:
    """E in e[0] and its derivatives by phi and psi in e[1] and e[2], (3, 3, 3)."""
    sp, cp, ss, cs = math.sin(phi), math.cos(phi), math.sin(psi), math.cos(psi)
    for r in range(3):
        for c in range(3):
            left_a, left_b = basis[0, r] * basis[2, c], basis[1, r] * basis[2, c]
            right_a, right_b = basis[2, r] * basis[0, c], basis[2, r] * basis[1, c]
            e[1, r, c] = cp * left_a + sp * left_b
            e[2, r, c] = cs * right_a - ss * right_b
            e[0, r, c] = sp * left_a - cp * left_b + ss * right_a + cs * right_b


@numba.njit(cache=True, nogil=True)
def _search(
    rays1: Array, rays2: Array, basis: Array, forward: float, xn1: Array, xn2: Array, samples: Array,
    max_error2: float, best: Array,
) -> bool:  # fmt: skip
    """RANSAC over samples drawn beforehand (S, K) in [0, 1); best angles (2,); False if none had a solution."""
    n = xn1.shape[0]
    angles, e = np.empty((2, 2)), np.empty((3, 3, 3))
    best_cost, limit, found = math.inf, float(samples.shape[0]), False
    for s in range(samples.shape[0]):
        if s >= limit:
            break
        for k in range(_solve(rays1, rays2, samples[s], forward, angles)):
            _fill_essential(basis, angles[k, 0], angles[k, 1], e)
            cost, inliers = 0.0, 0
            for m in range(n):
                error = sampson_error(e[0], xn1[m, 0], xn1[m, 1], xn2[m, 0], xn2[m, 1])
                inliers += error < max_error2
                cost += min(error, max_error2)
                if cost >= best_cost:
                    break
            if cost < best_cost:
                best_cost, found = cost, True
                best[0], best[1] = angles[k, 0], angles[k, 1]
                good = min(inliers / n, 0.999999) ** samples.shape[1]
                limit = math.log(_MISS) / math.log1p(-good) if good > 0.0 else limit
    return found


@numba.njit(cache=True, nogil=True)
def _refine(basis: Array, xn1: Array, xn2: Array, scale2: float, angles: Array) -> None:
    """Levenberg-Marquardt over (phi, psi), in place."""
    e, h, g, factor = np.empty((3, 3, 3)), np.empty((2, 2, 2)), np.empty((2, 2)), np.empty((2, 2))
    trial, step = np.empty(2), np.empty(2)
    now, damping = 0, 1e-4
    _fill_essential(basis, angles[0], angles[1], e)
    cost = sampson_normal_equations(2, e, xn1, xn2, scale2, h[now], g[now])
    for _ in range(20):
        new, new_cost = 1 - now, math.inf
        if solve_damped(h[now], g[now], damping, factor, step):
            trial[0], trial[1] = angles[0] + step[0], angles[1] + step[1]
            _fill_essential(basis, trial[0], trial[1], e)
            new_cost = sampson_normal_equations(2, e, xn1, xn2, scale2, h[new], g[new])
        is_better, is_last, damping = judge_step(cost, new_cost, damping)
        if is_better:
            copy_into(angles, trial)
            now, cost = new, new_cost
        if is_last:
            return


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    points = np.array([[0.1, 0.2], [0.3, -0.1], [-0.2, 0.3]])
    estimate_planar_motion(points, points + 0.01, 1.0)
