"""The pose of a camera from points with known positions and the unit rays, in any direction, that see them.

Three of them leave at most four poses: Grunert's solution of 1841, as in Haralick, Lee, Ottenberg and Nolle, "Review
and analysis of solutions of the three point perspective pose estimation problem", IJCV 13, 1994, its distances polished
by Newton's method. Samples are scored by the distances of rays on the unit sphere (MSAC).
"""

from __future__ import annotations

import math
from functools import lru_cache

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.simd.copying import copy_into

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

_FIRST_TRIALS = 256


def find_pose(xyz: Array, rays: Array, max_error: float, confidence: float, max_trials: int) -> Array | None:
    """``cam_from_world`` (7,) by RANSAC, the same at every call; None if no sample has a solution.

    Args:
        xyz: (N, 3) points in the world. rays: (N, 3) unit rays in the camera.
        max_error: largest distance of an inlier on the unit sphere: an angle in radians.
        confidence: wanted probability that one sample without a wrong pair was drawn.
        max_trials: bound on the number of samples.
    """
    points, directions = (np.ascontiguousarray(a, np.float64) for a in (xyz, rays))
    # to draw ten thousand takes longer than to search a few dozen, which are the first of these
    for num in (min(_FIRST_TRIALS, max_trials), max_trials):
        samples = _samples(len(xyz), num)
        trials, rotation, translation = _search(points, directions, max_error * max_error, confidence, samples)
        found = trials > 0
        if trials < num:
            break
    return rigid3.from_matrix(rotation, translation) if found else None


@lru_cache(maxsize=64)
def _samples(count: int, num: int) -> Ints:
    """(num, 3) of so many points; that two are the same is allowed for, as such a sample has no pose."""
    return np.random.default_rng([0, count]).integers(0, count, (num, 3))


def squared_errors(cam_from_world: Array, xyz: Array, rays: Array) -> Array:
    """(N,) squared distances on the unit sphere between rays (N, 3) and the points (N, 3) that they see."""
    seen = rigid3.apply(cam_from_world, xyz)
    with np.errstate(divide="ignore", invalid="ignore"):
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    return np.asarray(((seen - rays) ** 2).sum(axis=1))


@numba.njit(cache=True, nogil=True)
def _search(xyz: Array, rays: Array, limit: float, confidence: float, samples: Ints) -> tuple[int, Array, Array]:
    """Trials until enough were drawn, all of them if that was not reached, 0 without a pose; rotation, translation."""
    rotation, translation = np.eye(3), np.zeros(3)
    found, best_cost, needed, trial = False, math.inf, samples.shape[0], 0
    rotations, translations = np.empty((4, 3, 3)), np.empty((4, 3))
    while trial < needed:
        sample = samples[trial]
        trial += 1
        for k in range(poses_of_three(xyz[sample], rays[sample], rotations, translations)):
            r, t = rotations[k], translations[k]
            cost, inliers = 0.0, 0
            for i in range(xyz.shape[0]):
                error, norm = 0.0, 0.0
                along = 0.0
                for a in range(3):
                    seen = r[a, 0] * xyz[i, 0] + r[a, 1] * xyz[i, 1] + r[a, 2] * xyz[i, 2] + t[a]
                    norm += seen * seen
                    along += seen * rays[i, a]
                # |a - b|^2 = 2 - 2 a.b of unit vectors
                error = max(2.0 - 2.0 * along / math.sqrt(max(norm, 1e-300)), 0.0)
                inliers += error <= limit
                cost += min(error, limit)
                if cost >= best_cost:
                    break
            if cost < best_cost:
                best_cost, found = cost, True
                copy_into(rotation, r)
                copy_into(translation, t)
                share = (inliers / xyz.shape[0]) ** 3
                if share > 0.0:
                    wanted = math.log(1.0 - confidence) / math.log1p(-share) if share < 1.0 else 0.0
                    needed = min(needed, trial + int(min(wanted, 1e9)))
    return trial if found else 0, rotation, translation


@numba.njit(cache=True, nogil=True)
def poses_of_three(xyz: Array, rays: Array, rotations: Array, translations: Array) -> int:
    """Fill rotations (4, 3, 3) and translations (4, 3) with the poses that three points (3, 3) and the unit rays (3, 3)
    that see them allow; how many there are, none where the points lie on a line."""
    a2, b2, c2 = _squared_distance(xyz, 1, 2), _squared_distance(xyz, 0, 2), _squared_distance(xyz, 0, 1)
    frame = np.empty((3, 3))
    if not _frame(xyz[0], xyz[1], xyz[2], frame):
        return 0
    cos_a, cos_b, cos_c = _cosine(rays, 1, 2), _cosine(rays, 0, 2), _cosine(rays, 0, 1)
    d, e, f = (a2 - c2) / b2, (a2 + c2) / b2, c2 / b2
    quartic = np.empty(5)
    quartic[0] = (d - 1.0) ** 2 - 4.0 * f * cos_a**2
    quartic[1] = 4.0 * (d * (1.0 - d) * cos_b - (1.0 - e) * cos_a * cos_c + 2.0 * f * cos_a**2 * cos_b)
    quartic[2] = 2.0 * (
        d * d - 1.0 + 2.0 * d * d * cos_b**2 + 2.0 * (1.0 - f) * cos_a**2 - 4.0 * e * cos_a * cos_b * cos_c
        + 2.0 * (1.0 - a2 / b2) * cos_c**2
    )  # fmt: skip
    quartic[3] = 4.0 * (-d * (1.0 + d) * cos_b + 2.0 * a2 / b2 * cos_c**2 * cos_b - (1.0 - e) * cos_a * cos_c)
    quartic[4] = (1.0 + d) ** 2 - 4.0 * a2 / b2 * cos_c**2
    for k in range(5):
        if not abs(quartic[0]) > 1e-14 * abs(quartic[k]):
            return 0
    companion = np.zeros((4, 4), np.complex128)
    for k in range(4):
        companion[0, k] = -quartic[k + 1] / quartic[0]
        if k < 3:
            companion[k + 1, k] = 1.0
    roots = np.linalg.eigvals(companion)
    sides, distance, seen, turned = np.array([a2, b2, c2]), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    cosines = np.array([cos_a, cos_b, cos_c])
    count = 0
    for k in range(4):
        v = roots[k].real
        # a double root that rounding has split is polished below
        if abs(roots[k].imag) > 1e-4 * max(1.0, abs(v)) or v <= 0.0 or abs(cos_c - v * cos_a) < 1e-12:
            continue
        u = ((d - 1.0) * v * v - 2.0 * d * cos_b * v + 1.0 + d) / (2.0 * (cos_c - v * cos_a))
        between = 1.0 + v * v - 2.0 * v * cos_b  # nothing where two points are seen along one ray
        if u <= 0.0 or not between > 0.0:
            continue
        distance[0] = math.sqrt(b2 / between)
        distance[1], distance[2] = u * distance[0], v * distance[0]
        if not _polish(distance, cosines, sides):
            continue
        for i in range(3):
            seen[i] = distance[i] * rays[i]
        if not _frame(seen[0], seen[1], seen[2], turned):
            continue
        for i in range(3):
            for j in range(3):
                rotations[count, i, j] = (
                    turned[0, i] * frame[0, j] + turned[1, i] * frame[1, j] + turned[2, i] * frame[2, j]
                )
        for i in range(3):
            translations[count, i] = seen[0, i] - (
                rotations[count, i, 0] * xyz[0, 0] + rotations[count, i, 1] * xyz[0, 1]
                + rotations[count, i, 2] * xyz[0, 2]
            )  # fmt: skip
        count += 1
    return count


@numba.njit(cache=True, nogil=True)
def _polish(distance: Array, cosines: Array, sides: Array) -> bool:
    """Newton's method on the three laws of cosines, in place; False where it does not meet them."""
    for _ in range(5):
        x, y, z = distance[0], distance[1], distance[2]
        e0 = y * y + z * z - 2.0 * y * z * cosines[0] - sides[0]
        e1 = x * x + z * z - 2.0 * x * z * cosines[1] - sides[1]
        e2 = x * x + y * y - 2.0 * x * y * cosines[2] - sides[2]
        # rows (0, p, q), (r, 0, s), (m, n, 0) of half the derivative
        p, q = y - z * cosines[0], z - y * cosines[0]
        r, s = x - z * cosines[1], z - x * cosines[1]
        m, n = x - y * cosines[2], y - x * cosines[2]
        det = p * s * m + q * r * n
        if not abs(det) > 1e-300:
            return False
        e0, e1, e2 = 0.5 * e0, 0.5 * e1, 0.5 * e2
        distance[0] -= (-n * s * e0 + n * q * e1 + p * s * e2) / det
        distance[1] -= (m * s * e0 - m * q * e1 + q * r * e2) / det
        distance[2] -= (n * r * e0 + m * p * e1 - p * r * e2) / det
    x, y, z = distance[0], distance[1], distance[2]
    off = (
        abs(y * y + z * z - 2.0 * y * z * cosines[0] - sides[0])
        + abs(x * x + z * z - 2.0 * x * z * cosines[1] - sides[1])
        + abs(x * x + y * y - 2.0 * x * y * cosines[2] - sides[2])
    )
    return bool(min(x, y, z) > 0.0 and off < 1e-6 * (sides[0] + sides[1] + sides[2]))


@numba.njit(cache=True, nogil=True)
def _squared_distance(xyz: Array, i: int, j: int) -> float:
    total = 0.0
    for k in range(3):
        total += (xyz[i, k] - xyz[j, k]) ** 2
    return total


@numba.njit(cache=True, nogil=True)
def _cosine(rays: Array, i: int, j: int) -> float:
    return float(rays[i, 0] * rays[j, 0] + rays[i, 1] * rays[j, 1] + rays[i, 2] * rays[j, 2])


@numba.njit(cache=True, nogil=True)
def _frame(a: Array, b: Array, c: Array, out: Array) -> bool:
    """Orthonormal rows of the triangle's first side, its normal, and what is at right angles to both; False on a
    line."""
    for k in range(3):
        out[0, k], out[1, k] = b[k] - a[k], c[k] - a[k]
    norm = math.sqrt(out[0, 0] ** 2 + out[0, 1] ** 2 + out[0, 2] ** 2)
    side = math.sqrt(out[1, 0] ** 2 + out[1, 1] ** 2 + out[1, 2] ** 2)
    if not min(norm, side) > 0.0:
        return False
    for k in range(3):
        out[0, k] /= norm
    for k in range(3):
        m, n = (k + 1) % 3, (k + 2) % 3
        out[2, k] = out[0, m] * out[1, n] - out[0, n] * out[1, m]
    norm = math.sqrt(out[2, 0] ** 2 + out[2, 1] ** 2 + out[2, 2] ** 2)
    if not norm > 1e-9 * side:
        return False
    for k in range(3):
        out[2, k] /= norm
    for k in range(3):
        m, n = (k + 1) % 3, (k + 2) % 3
        out[1, k] = out[2, m] * out[0, n] - out[2, n] * out[0, m]
    return True
