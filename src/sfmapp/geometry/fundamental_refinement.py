"""Fundamental matrices of many points, some of them wrong: refined on their inliers, and looked for beside the first.

Normalised so that pixels of both pictures are scaled alike, F is ``U diag(cos a, sin a, 0) V^T``: turns of U and of V
and the angle are its seven degrees of freedom (Bartoli and Sturm, PAMI 2004), and the Sampson error keeps its unit.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.damped import solve_damped, turn_columns
from sfmapp.geometry.dlt import normalizing
from sfmapp.geometry.epipolar import sampson_error, sampson_errors, truncated_sums
from sfmapp.geometry.fundamental import epipolar_rows, rank_two
from sfmapp.geometry.relative_pose import sampson_normal_equations
from sfmapp.simd.copying import copy_into

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Samples of twice the seven that F needs, as Chum, Matas and Kittler have it; so many of the best are refined beside
# the first F on so many of its inliers, and the best of that on so many. With half of the matches wrong, twice the
# samples leave the same error.
_SAMPLES, _SIZE, _REFINED, _FEW, _MANY = 10, 14, 2, 300, 1000


@numba.njit(cache=True, nogil=True)
def _matrix_and_slopes(state: Array, e: Array) -> None:
    """F in e[0] and its derivatives by turns of U^T and V^T on the left, and by the angle, in e[1:], (8, 3, 3).

    The state (7, 3) holds the rows of U^T, those of V^T, and the angle in state[6, 0].
    """
    c, s = math.cos(state[6, 0]), math.sin(state[6, 0])
    for i in range(3):
        u1, u2, u3 = state[0, i], state[1, i], state[2, i]
        for j in range(3):
            v1, v2, v3 = state[3, j], state[4, j], state[5, j]
            e[0, i, j] = c * u1 * v1 + s * u2 * v2
            e[1, i, j] = -s * u3 * v2
            e[2, i, j] = c * u3 * v1
            e[3, i, j] = s * u1 * v2 - c * u2 * v1
            e[4, i, j] = -s * u2 * v3
            e[5, i, j] = c * u1 * v3
            e[6, i, j] = s * u2 * v1 - c * u1 * v2
            e[7, i, j] = c * u2 * v2 - s * u1 * v1


@numba.njit(cache=True, nogil=True)
def _refine(states: Array, a: Array, b: Array, scale2: float, max_iterations: int, e: Array) -> None:
    """Levenberg-Marquardt from states[0] of (2, 7, 3), and back into it; Cauchy-weighted Sampson error."""
    h, g, factor, step = np.empty((2, 7, 7)), np.empty((2, 7)), np.empty((7, 7)), np.empty(7)
    now, damping = 0, 1e-4
    _matrix_and_slopes(states[now], e)
    cost = sampson_normal_equations(7, e, a, b, scale2, h[now], g[now])
    for _ in range(max_iterations):
        new, new_cost = 1 - now, math.inf
        if solve_damped(h[now], g[now], damping, factor, step):
            turn_columns(step[:3], states[now, :3], states[new, :3])
            turn_columns(step[3:6], states[now, 3:6], states[new, 3:6])
            states[new, 6, 0] = states[now, 6, 0] + step[6]
            _matrix_and_slopes(states[new], e)
            new_cost = sampson_normal_equations(7, e, a, b, scale2, h[new], g[new])
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
    if now == 1:
        copy_into(states[0], states[1])
    _matrix_and_slopes(states[0], e)


@numba.njit(cache=True, nogil=True)
def _refine_on_inliers(
    states: Array, a: Array, b: Array, threshold: float, rounds: int, max_iterations: int, e: Array
) -> float:
    """States[0] fitted to its inliers until these no longer change, F into e[0]; returns the truncated error."""
    n, limit = a.shape[0], threshold * threshold
    c, d, inside = np.empty((n, 2)), np.empty((n, 2)), np.zeros(n, np.bool_)
    _matrix_and_slopes(states[0], e)
    for k in range(rounds + 1):
        count, has_changed, total = 0, k == 0, 0.0
        for i in range(n):
            error = sampson_error(e[0], a[i, 0], a[i, 1], b[i, 0], b[i, 1])
            total += min(error, limit)
            has_changed = has_changed or (error < limit) != inside[i]
            inside[i] = error < limit
            if inside[i]:
                for m in range(2):
                    c[count, m], d[count, m] = a[i, m], b[i, m]
                count += 1
        if k == rounds or count < 8 or not has_changed:
            break
        # nearly squares: which matches are inliers is decided by the threshold alone
        _refine(states, c[:count], d[:count], 4.0 * limit, max_iterations, e)
    return total


def refine_fundamental_on_inliers(
    fundamental: Array, xy1: Array, xy2: Array, threshold: float, *, rounds: int, max_iterations: int = 20
) -> tuple[Array, float]:
    """F of least squared Sampson error over its inliers, which are looked for anew after each fit.

    Args:
        fundamental: (3, 3) start. xy1, xy2: (N, 2) corresponding pixels.
        threshold: largest Sampson distance of an inlier, pixels.
        rounds: most fits; none with fewer than eight inliers. max_iterations: of each.

    Returns:
        F (3, 3) of unit norm, and the sum of the squared errors of all points, each no more than the threshold's.
    """
    t1, t2 = normalizing(xy1), normalizing(xy2)
    scale = 0.5 * (t1[0, 0] + t2[0, 0])
    for t in (t1, t2):
        t[:2, 2] *= scale / t[0, 0]
        t[0, 0] = t[1, 1] = scale
    u, s, vt = np.linalg.svd(np.linalg.inv(t2).T @ fundamental @ np.linalg.inv(t1))
    states, e = np.zeros((2, 7, 3)), np.empty((8, 3, 3))
    # turns of both keep their orientation: a mirrored basis is as good
    states[0, :3], states[0, 3:6], states[0, 6, 0] = u.T, vt, math.atan2(s[1], s[0])
    a, b = (np.ascontiguousarray(xy * scale + t[:2, 2]) for xy, t in ((xy1, t1), (xy2, t2)))
    cost = _refine_on_inliers(states, a, b, scale * threshold, rounds, max_iterations, e)
    f = t2.T @ e[0] @ t1
    return f / np.linalg.norm(f), cost / scale**2


def polish_fundamental(
    fundamental: Array, xy1: Array, xy2: Array, threshold: float, seed: int = 0
) -> tuple[Array, Mask]:
    """F of least squared errors, truncated at the threshold, among those that samples of its inliers lead to, and the
    inliers (N,) of it: Chum, Matas and Kittler, "Locally optimized RANSAC", 2003, with inner samples.

    Two or three wrong matches in it hold an F where they fit, and it settles there; samples without them lead further.
    The number of inliers is no judge: at the rim of the threshold one may be lost to an F that is better for all
    others.

    Args:
        fundamental: (3, 3) that explains most of what is right. xy1, xy2: (N, 2) matched pixels.
        threshold: largest Sampson distance of an inlier, pixels.
        seed: of the samples.
    """
    inlier = sampson_errors(fundamental, xy1, xy2) < threshold**2
    pool = np.flatnonzero(inlier)
    if len(pool) < 8:
        return fundamental, inlier
    few = pool[:: max(-(-len(pool) // _FEW), 1)]
    a, b = xy1[few], xy2[few]
    found = _of_samples(xy1[pool], xy2[pool], seed)
    best = np.argsort(truncated_sums(found, a, b, threshold**2), kind="stable")[:_REFINED]
    starts = [
        refine_fundamental_on_inliers(start, a, b, threshold, rounds=2, max_iterations=3)[0]
        for start in (fundamental, *found[best])
    ]
    step = max(-(-len(pool) // _MANY), 1)
    a, b = xy1[::step], xy2[::step]
    start = starts[int(np.argmin(truncated_sums(np.stack(starts), a, b, threshold**2)))]  # the first of equals
    f, _ = refine_fundamental_on_inliers(start, a, b, threshold, rounds=8)
    # what is worse on all matches, as it may be of few, is not taken
    first, last = truncated_sums(np.stack([fundamental, f]), xy1, xy2, threshold**2)
    if not last < first:
        return fundamental, inlier
    return f, sampson_errors(f, xy1, xy2) < threshold**2


def _of_samples(xy1: Array, xy2: Array, seed: int) -> Array:
    """(S, 3, 3) by the normalised eight-point algorithm of samples among points of which most are right."""
    t1, t2 = normalizing(xy1), normalizing(xy2)
    drawn = np.random.default_rng([seed, len(xy1)]).integers(0, len(xy1), (_SAMPLES, _SIZE))
    rows = epipolar_rows(xy1[drawn] * t1[0, 0] + t1[:2, 2], xy2[drawn] * t2[0, 0] + t2[:2, 2])
    vectors = np.linalg.eigh(rows.swapaxes(1, 2) @ rows)[1]
    found: Array = t2.T @ rank_two(vectors[:, :, 0].reshape(-1, 3, 3)) @ t1
    return found


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    points = np.array([[0.1, 0.2], [0.3, -0.1]])
    refine_fundamental_on_inliers(np.diag([1.0, 0.5, 0.0]), points, points, 1.0, rounds=1)
