"""The poses that many points allow, all at once: the error in space as a function of the rotation alone.

With unit rays d and the projector A = I - d d^T across each, the error of a pose in space is sum |A (R X + t)|^2 (Lu,
Hager and Mjolsness, "Fast and globally convergent pose estimation from video images", PAMI 2000). The best t is linear
in R, which leaves a quadratic form in the nine entries of R, of constant size for any number of points (Terzakis and
Lourakis, "A consistently fast and globally optimal solution to the perspective-n-point problem", ECCV 2020). Its minima
over rotations are found from starts that are spread evenly over all of them, so none is missed, and a second one that
is nearly as good, as a plane seen from afar has, is told and not hidden. Rays may point in any direction, and points
lie on a plane or not.
"""

from __future__ import annotations

import itertools
import math
from functools import cache

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.damped import invert, solve_damped, turn_columns
from sfmapp.geometry.dlt import triangle
from sfmapp.simd.copying import copy_into

Array = NDArray[np.float64]

MIN_POINTS = 3
_MAX_STEPS = 70
# Angles in radians: below which a start has come to a minimum that is known, two minima are one, one has settled.
_ALIKE, _SAME, _SETTLED = 0.03, 1e-3, 1e-10


def poses_of_points(xyz: Array, rays: Array) -> Array:
    """Poses (K, 7) ``cam_from_world`` at the minima of the error in space, the best first.

    Three points have up to four, four or more of them usually one, on a plane two. Only those that see every point
    ahead along its ray are given.

    Args:
        xyz: (N, 3) points in the world, N >= 3, not on a line.
        rays: (N, 3) unit rays in the camera, in any direction.
    """
    starts = _starts()
    poses = np.empty((len(starts), 7))
    num = _search(np.ascontiguousarray(xyz, np.float64), np.ascontiguousarray(rays, np.float64), starts, poses)
    return poses[:num]


@numba.njit(cache=True, nogil=True)
def _search(xyz: Array, rays: Array, starts: Array, poses: Array) -> int:
    """Fill poses (K, 7) from starts (K, 3, 3), the best first; how many there are."""
    count = xyz.shape[0]
    middle, local, spread = np.zeros(3), np.empty((count, 3)), 0.0
    for n in range(count):
        for i in range(3):
            middle[i] += xyz[n, i] / count
    for n in range(count):
        for i in range(3):
            local[n, i] = xyz[n, i] - middle[i]
            spread += local[n, i] ** 2 / count
    spread = math.sqrt(spread)
    if not spread > 0.0:
        return 0
    for n in range(count):
        for i in range(3):
            local[n, i] /= spread
    rows, shift = np.zeros((max(3 * count, 9), 9)), np.empty((3, 9))
    if not _reduce(local, rays, rows, shift):  # all rays are one
        return 0
    rotations, errors = np.empty(starts.shape), np.empty(starts.shape[0])
    num = _descend(rows[:9], starts, rotations, errors)
    kept, translation, found = np.empty(num, np.int64), np.empty(3), 0
    num_kept = 0
    for k in np.argsort(errors[:num]):
        if _nearest(rotations[k], rotations, kept[:num_kept]) < _SAME:
            continue
        kept[num_kept] = k
        num_kept += 1
        r = rotations[k]
        for i in range(3):
            translation[i] = 0.0
            for m in range(9):
                translation[i] += shift[i, m] * r[m // 3, m % 3]
        if _are_ahead(local, rays, r, translation):
            quaternion_of(r, poses[found])
            for i in range(3):
                poses[found, 4 + i] = spread * translation[i] - (
                    r[i, 0] * middle[0] + r[i, 1] * middle[1] + r[i, 2] * middle[2]
                )
            found += 1
    return found


@numba.njit(cache=True, nogil=True)
def _nearest(rotation: Array, others: Array, which: NDArray[np.int64]) -> float:
    """Least angle between a rotation and some of others (K, 3, 3), radians; their distance is sqrt(8) sin of half of
    it."""
    least = math.inf
    for k in which:
        square = 0.0
        for i in range(3):
            for j in range(3):
                square += (rotation[i, j] - others[k, i, j]) ** 2
        least = min(least, square)
    return 2.0 * math.asin(min(math.sqrt(least / 8.0), 1.0))


@numba.njit(cache=True, nogil=True)
def _are_ahead(xyz: Array, rays: Array, r: Array, t: Array) -> bool:
    """Whether all points are seen along their rays and none against them."""
    for n in range(xyz.shape[0]):
        along = 0.0
        for i in range(3):
            along += rays[n, i] * (r[i, 0] * xyz[n, 0] + r[i, 1] * xyz[n, 1] + r[i, 2] * xyz[n, 2] + t[i])
        if not along > 0.0:
            return False
    return True


@numba.njit(cache=True, nogil=True)
def quaternion_of(m: Array, out: Array) -> None:
    """Fill the unit quaternion (4,), x y z w with w >= 0, of a rotation; as :func:`sfmapp.geometry.rigid3.quaternion`,
    in kernels."""
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    best, largest = 3, trace
    for i in range(3):
        if m[i, i] > largest:
            best, largest = i, m[i, i]
    if best == 3:
        out[0], out[1], out[2] = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
        out[3] = 1.0 + trace
    else:
        i, j, k = best, (best + 1) % 3, (best + 2) % 3
        out[i] = 1.0 + 2.0 * m[i, i] - trace
        out[j], out[k], out[3] = m[j, i] + m[i, j], m[k, i] + m[i, k], m[k, j] - m[j, k]
    norm = math.copysign(math.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2 + out[3] ** 2), out[3])
    for i in range(4):
        out[i] /= norm


@numba.njit(cache=True, nogil=True)
def _reduce(xyz: Array, rays: Array, rows: Array, shift: Array) -> bool:
    """Fill the first nine rows (M, 9) with a triangle of which |rows vec(R)|^2 is the error in space at the best
    translation, shift (3, 9) times vec(R), rows of R first; False where the rays leave the translation open."""
    total, of_turn, inverse = np.zeros((3, 3)), np.zeros((3, 9)), np.empty((3, 3))
    for n in range(xyz.shape[0]):
        for i in range(3):
            for j in range(3):
                across = (1.0 if i == j else 0.0) - rays[n, i] * rays[n, j]
                total[i, j] += across
                for k in range(3):
                    # R X = (I kron X^T) vec(R)
                    rows[3 * n + i, 3 * j + k] = across * xyz[n, k]
                    of_turn[i, 3 * j + k] += across * xyz[n, k]
    if not invert(total, 1e12, inverse):
        return False
    for i in range(3):
        for k in range(9):
            shift[i, k] = -(
                inverse[i, 0] * of_turn[0, k] + inverse[i, 1] * of_turn[1, k] + inverse[i, 2] * of_turn[2, k]
            )
    for n in range(xyz.shape[0]):
        for k in range(9):
            along = rays[n, 0] * shift[0, k] + rays[n, 1] * shift[1, k] + rays[n, 2] * shift[2, k]
            for i in range(3):
                rows[3 * n + i, k] += shift[i, k] - rays[n, i] * along
    triangle(rows)
    for i in range(9):
        for k in range(i):
            rows[i, k] = 0.0
    return True


@cache
def _starts() -> Array:
    """(60, 3, 3) rotations of an icosahedron: no rotation is further than 44.5 degrees from one of them."""
    golden = (1.0 + np.sqrt(5.0)) / 2.0
    corners = np.array([p for a in (1, -1) for b in (golden, -golden) for p in ((0, a, b), (a, b, 0), (b, 0, a))])
    corners /= np.linalg.norm(corners, axis=1, keepdims=True)
    # an edge, with what is at right angles to it, goes to each of the 60 directed edges
    nearest = np.partition(corners @ corners.T, -6, axis=1)[:, -6].mean()
    frames = []
    for i, j in itertools.permutations(range(12), 2):
        if corners[i] @ corners[j] > nearest - 1e-6:
            x = corners[i]
            z = np.cross(x, corners[j])
            z /= np.linalg.norm(z)
            frames.append(np.stack([x, np.cross(z, x), z], 1))
    starts: Array = np.array(frames) @ frames[0].T
    return starts


@numba.njit(cache=True, nogil=True)
def _descend(rows: Array, starts: Array, rotations: Array, errors: Array) -> int:
    """Levenberg and Marquardt's method from each start (K, 3, 3), until it settles or comes to where another has;
    fills rotations (K, 3, 3) and values (K,), and how many have settled; where none has, the least is one."""
    num, least = 0, math.inf
    h, g, new_h, new_g = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    factor, step, rotation, tried = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    deepest = np.empty((3, 3))
    # the trace of R_i^T R_j is 1 + 2 cos of the angle between them
    is_alike = 1.0 + 2.0 * math.cos(_ALIKE)
    for k in range(starts.shape[0]):
        copy_into(rotation, starts[k])
        damping, last, is_known = 1e-3, math.inf, False
        error = _linearize(rows, rotation, h, g)
        for _ in range(_MAX_STEPS):
            # a multiple of the unit matrix: along a valley the own diagonal would be no damping at all
            scale = (h[0, 0] + h[1, 1] + h[2, 2]) / 3.0 + 1e-300
            for i in range(3):
                h[i, i] += damping * scale
            is_solved = solve_damped(h, g, 0.0, factor, step)
            for i in range(3):
                h[i, i] -= damping * scale
            if is_solved:
                last = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
                turn_columns(step, rotation, tried)
                new_error = _linearize(rows, tried, new_h, new_g)
            if is_solved and new_error <= error:
                copy_into(rotation, tried)
                error = new_error
                h, new_h, g, new_g = new_h, h, new_g, g
                damping = max(0.1 * damping, 1e-12)
            else:
                damping = min(10.0 * damping, 1e12)
            for m in range(num):
                along = 0.0
                for i in range(3):
                    for j in range(3):
                        along += rotation[i, j] * rotations[m, i, j]
                is_known = is_known or along >= is_alike
            if is_known or last < _SETTLED:
                break
        # what still moves is on its way along a valley to a minimum that another start finds
        if not is_known and last < _SAME:
            copy_into(rotations[num], rotation)
            errors[num] = error
            num += 1
        elif num == 0 and error < least:
            least = error
            copy_into(deepest, rotation)
    if num == 0 and least < math.inf:
        copy_into(rotations[0], deepest)
        errors[0] = least
        return 1
    return num


@numba.njit(cache=True, nogil=True)
def _linearize(rows: Array, r: Array, h: Array, g: Array) -> float:
    """Squared error of a rotation, and its Gauss-Newton system by a turn w, R <- exp(w) R."""
    h[:], g[:] = 0.0, 0.0
    error = 0.0
    for m in range(rows.shape[0]):
        left = s0 = s1 = s2 = 0.0
        for k in range(3):
            a, b, c = rows[m, k], rows[m, 3 + k], rows[m, 6 + k]
            x, y, z = r[0, k], r[1, k], r[2, k]
            left += a * x + b * y + c * z
            # (a, b, c) . (w x column) = w . (column x (a, b, c))
            s0 += y * c - z * b
            s1 += z * a - x * c
            s2 += x * b - y * a
        error += left * left
        g[0] += s0 * left
        g[1] += s1 * left
        g[2] += s2 * left
        # the lower triangle, which is what is solved
        h[0, 0] += s0 * s0
        h[1, 0] += s1 * s0
        h[1, 1] += s1 * s1
        h[2, 0] += s2 * s0
        h[2, 1] += s2 * s1
        h[2, 2] += s2 * s2
    return error
