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

from sfmapp.geometry import rigid3
from sfmapp.geometry.damped import solve_damped, turn_columns

Array = NDArray[np.float64]

MIN_POINTS = 3
# All starts go so far, then those alone that are not on the way to the same minimum.
_FIRST_STEPS, _MAX_STEPS = 10, 60
# Angles in radians: below which two on their way are alike, two minima are one, and one has settled.
_ALIKE, _SAME, _SETTLED = 0.03, 1e-3, 1e-10


def poses_of_points(xyz: Array, rays: Array) -> Array:
    """Poses (K, 7) ``cam_from_world`` at the minima of the error in space, the best first.

    Three points have up to four, four or more of them usually one, on a plane two. Only those that see every point
    ahead along its ray are given.

    Args:
        xyz: (N, 3) points in the world, N >= 3, not on a line.
        rays: (N, 3) unit rays in the camera, in any direction.
    """
    middle = xyz.mean(0)
    spread = float(np.sqrt(((xyz - middle) ** 2).sum(1).mean()))
    if not spread > 0.0:
        return np.zeros((0, 7))
    local = (xyz - middle) / spread
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    total = across.sum(0)
    if not np.linalg.cond(total) < 1e12:  # all rays are one
        return np.zeros((0, 7))
    # R X = (I kron X^T) vec(R), rows first
    moved = np.einsum("nij,nk->nijk", across, local).reshape(-1, 3, 9)
    shift = -np.linalg.solve(total, moved.sum(0))
    rows = (moved + across @ shift).reshape(-1, 9)
    rotations = _minima(np.ascontiguousarray(np.linalg.qr(rows, mode="r") if len(rows) > 9 else rows))
    translations = rotations.reshape(-1, 9) @ shift.T
    seen = np.einsum("kij,nj->kni", rotations, local) + translations[:, None]
    is_ahead = ((seen * rays).sum(2) > 0.0).all(1)
    found = rotations[is_ahead]
    return rigid3.from_matrix(found, spread * translations[is_ahead] - found @ middle)


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


def _minima(rows: Array) -> Array:
    """(K, 3, 3) rotations where |rows vec(R)|^2 is least of those around, the best first."""
    rotation, error, _ = _descend(rows, _starts(), _FIRST_STEPS)
    rotation, error, last = _descend(rows, rotation[_distinct(rotation, error, _ALIKE)], _MAX_STEPS)
    # what still moves is on its way along a valley to a minimum that another start has found
    has_settled = last < _SAME
    rotation, error = rotation[has_settled], error[has_settled]
    kept = _distinct(rotation, error, _SAME)
    kept_rotations: Array = rotation[kept]
    return kept_rotations


@numba.njit(cache=True, nogil=True)
def _descend(rows: Array, starts: Array, max_steps: int) -> tuple[Array, Array, Array]:
    """Levenberg and Marquardt's method from each start (K, 3, 3): rotations, values (K,), last steps (K,)."""
    num = starts.shape[0]
    rotations, errors, lasts = starts.copy(), np.empty(num), np.full(num, np.inf)
    h, g, new_h, new_g = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    factor, step, tried = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for k in range(num):
        rotation, damping = rotations[k], 1e-3
        error = _linearize(rows, rotation, h, g)
        for _ in range(max_steps):
            # a multiple of the unit matrix: along a valley the own diagonal would be no damping at all
            scale = (h[0, 0] + h[1, 1] + h[2, 2]) / 3.0 + 1e-300
            for i in range(3):
                h[i, i] += damping * scale
            is_solved = solve_damped(h, g, 0.0, factor, step)
            for i in range(3):
                h[i, i] -= damping * scale
            if is_solved:
                lasts[k] = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
                turn_columns(step, rotation, tried)
                new_error = _linearize(rows, tried, new_h, new_g)
            if is_solved and new_error <= error:
                rotation[:], error = tried, new_error
                h, new_h, g, new_g = new_h, h, new_g, g
                damping = max(0.1 * damping, 1e-12)
            else:
                damping = min(10.0 * damping, 1e12)
            if lasts[k] < _SETTLED:
                break
        errors[k] = error
    return rotations, errors, lasts


@numba.njit(cache=True, nogil=True)
def _linearize(rows: Array, r: Array, h: Array, g: Array) -> float:
    """Squared error of a rotation, and its Gauss-Newton system by a turn w, R <- exp(w) R."""
    h[:], g[:] = 0.0, 0.0
    error, slope = 0.0, np.empty(3)
    for m in range(rows.shape[0]):
        left = 0.0
        slope[:] = 0.0
        for k in range(3):
            a, b, c = rows[m, k], rows[m, 3 + k], rows[m, 6 + k]
            x, y, z = r[0, k], r[1, k], r[2, k]
            left += a * x + b * y + c * z
            # (a, b, c) . (w x column) = w . (column x (a, b, c))
            slope[0] += y * c - z * b
            slope[1] += z * a - x * c
            slope[2] += x * b - y * a
        error += left * left
        for i in range(3):
            g[i] += slope[i] * left
            for j in range(3):
                h[i, j] += slope[i] * slope[j]
    return error


def _distinct(rotations: Array, errors: Array, angle: float) -> list[int]:
    """Positions of rotations that are further apart than an angle in radians, the best first."""
    flat = rotations.reshape(-1, 9)
    # the trace of R_i^T R_j is 1 + 2 cos of the angle between them
    is_near = flat @ flat.T >= 1.0 + 2.0 * np.cos(angle)
    kept: list[int] = []
    for k in np.argsort(errors, kind="stable"):
        if not is_near[k, kept].any():
            kept.append(int(k))
    return kept
