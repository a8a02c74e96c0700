"""Fundamental matrices of many points, some of them wrong: refined on their inliers, and looked for beside the first.

Normalised so that pixels of both pictures are scaled alike, F is ``U diag(cos a, sin a, 0) V^T``: turns of U and of V
and the angle are its seven degrees of freedom (Bartoli and Sturm, PAMI 2004), and the Sampson error keeps its unit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.damped import judge_step, solve_damped, turn_columns
from sfmapp.geometry.dlt import normalizing
from sfmapp.geometry.epipolar import contiguous, sampson_error, sampson_errors, truncated_sums
from sfmapp.geometry.fit import CAUCHY_SIGMAS, HEAVY_TAILS, robust_sigma
from sfmapp.geometry.fundamental import epipolar_rows, rank_two
from sfmapp.geometry.relative_pose import sampson_normal_equations
from sfmapp.simd.copying import copy_into

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Samples of twice the seven that F needs, as Chum, Matas and Kittler have it; so many of the best are refined beside
# the first F on so many of its inliers, and the best of that on so many. With half of the matches wrong, twice the
# samples leave the same error.
_SAMPLES, _SIZE, _REFINED, _FEW, _MANY = 10, 14, 2, 300, 1000
# With so many inliers among the matches, samples lead nowhere else: photographs of four sets, 96 to 99.7 % right.
_CLEAN_SHARE = 0.9
# Of the fit with a loss that bends, which begins near its end: five leave the same error.
_BENT_STEPS = 3


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
        is_better, is_last, damping = judge_step(cost, new_cost, damping)
        if is_better:
            now, cost = new, new_cost
        if is_last:
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


class _Scaled(NamedTuple):
    """Points of both pictures, scaled alike and moved to their middle."""

    a: Array
    b: Array
    t1: Array
    t2: Array

    @staticmethod
    def of(xy1: Array, xy2: Array, pool: Ints | slice) -> _Scaled:
        """Of all, by the spread of a pool."""
        t1, t2 = normalizing(xy1[pool]), normalizing(xy2[pool])
        scale = 0.5 * (t1[0, 0] + t2[0, 0])
        for t in (t1, t2):
            t[:2, 2] *= scale / t[0, 0]
            t[0, 0] = t[1, 1] = scale
        a, b = (np.ascontiguousarray(xy * scale + t[:2, 2]) for xy, t in ((xy1, t1), (xy2, t2)))
        return _Scaled(a, b, t1, t2)

    @property
    def scale(self) -> float:
        return float(self.t1[0, 0])

    def scaled(self, fundamental: Array) -> Array:
        matrix: Array = np.linalg.inv(self.t2).T @ fundamental @ np.linalg.inv(self.t1)
        return matrix

    def in_pixels(self, matrix: Array) -> Array:
        f = self.t2.T @ matrix @ self.t1
        unit: Array = f / np.linalg.norm(f)
        return unit


def _states(matrices: Array) -> Array:
    """(K, 2, 7, 3) for the kernels, of matrices (K, 3, 3), in the first of two."""
    states = np.zeros((len(matrices), 2, 7, 3))
    # turns of both keep their orientation: a mirrored basis is as good
    u, s, states[:, 0, 3:6] = np.linalg.svd(matrices)
    states[:, 0, :3], states[:, 0, 6, 0] = u.swapaxes(1, 2), np.arctan2(s[:, 1], s[:, 0])
    return states


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
    points, e = _Scaled.of(xy1, xy2, slice(None)), np.empty((8, 3, 3))
    states = _states(points.scaled(fundamental)[None])[0]
    cost = _refine_on_inliers(states, points.a, points.b, points.scale * threshold, rounds, max_iterations, e)
    return points.in_pixels(e[0]), cost / points.scale**2


def polish_fundamental(
    fundamental: Array, xy1: Array, xy2: Array, threshold: float, seed: int = 0
) -> tuple[Array, Mask]:
    """F of least squared errors, truncated at the threshold, among those that samples of its inliers lead to, and the
    inliers (N,) of it: Chum, Matas and Kittler, "Locally optimized RANSAC", 2003, with inner samples.

    Two or three wrong matches in it hold an F where they fit, and it settles there; samples without them lead further.
    The number of inliers is no judge: at the rim of the threshold one may be lost to an F that is better for all
    others. Where errors have tails that are heavier than normal ones, as keypoints of photographs have, F is fitted to
    its inliers once more with a loss that bends, its scale by the median error.

    Args:
        fundamental: (3, 3) that explains most of what is right. xy1, xy2: (N, 2) matched pixels.
        threshold: largest Sampson distance of an inlier, pixels.
        seed: of the samples.
    """
    inlier = sampson_errors(fundamental, xy1, xy2) < threshold**2
    pool = np.flatnonzero(inlier)
    if len(pool) < 8:
        return fundamental, inlier
    points = _Scaled.of(xy1, xy2, pool)
    limit, start = points.scale * threshold, points.scaled(fundamental)
    few = pool[:: max(-(-len(pool) // _FEW), 1)]
    step = max(-(-len(pool) // _MANY), 1)
    a, b = points.a[::step], points.b[::step]
    states, e = _states(_starts(start, points, pool, few, limit, seed)), np.empty((8, 3, 3))
    tried = np.empty((len(states), 3, 3))
    for n, state in enumerate(states):
        _refine_on_inliers(state, points.a[few], points.b[few], limit, 2, 3, e)
        tried[n] = e[0]
    best = int(np.argmin(truncated_sums(tried, a, b, limit**2)))  # the first of equals
    _refine_on_inliers(states[best], *contiguous(a, b), limit, 8, 20, e)
    # what is worse on all matches, as it may be of few, is not taken
    first, last = truncated_sums(np.stack([start, e[0]]), points.a, points.b, limit**2)
    if not last < first:
        return fundamental, inlier
    _bend_to_tails(states[best], points, limit, e)
    f = points.in_pixels(e[0])
    return f, sampson_errors(f, xy1, xy2) < threshold**2


def _starts(start: Array, points: _Scaled, pool: Ints, few: Ints, limit: float, seed: int) -> Array:
    """(K, 3, 3) the start, and, where enough matches are wrong to have bent it, the best of samples among the pool,
    judged on a few of it."""
    if len(pool) > _CLEAN_SHARE * len(points.a):
        return start[None]
    found = _of_samples(points.a[pool], points.b[pool], seed)
    costs = truncated_sums(found, points.a[few], points.b[few], limit**2)
    return np.concatenate([start[None], found[np.argsort(costs, kind="stable")[:_REFINED]]])


def _bend_to_tails(states: Array, points: _Scaled, limit: float, e: Array) -> None:
    """The F of e[0] and states[0] fitted to all its inliers again, in place, where their errors have heavy tails."""
    squared = sampson_errors(e[0], points.a, points.b)
    inlier = squared < limit**2
    if inlier.sum() < 8:
        return
    sigma = max(robust_sigma(squared[inlier], 1), 1e-3 * limit)
    if math.sqrt(float(squared[inlier].mean())) >= HEAVY_TAILS * sigma:
        _refine(states, points.a[inlier], points.b[inlier], (CAUCHY_SIGMAS * sigma) ** 2, _BENT_STEPS, e)


def _of_samples(a: Array, b: Array, seed: int) -> Array:
    """(S, 3, 3) by the eight-point algorithm of samples among normalised points of which most are right."""
    drawn = np.random.default_rng([seed, len(a)]).integers(0, len(a), (_SAMPLES, _SIZE))
    rows = epipolar_rows(a[drawn], b[drawn])
    return rank_two(np.linalg.eigh(rows.swapaxes(1, 2) @ rows)[1][:, :, 0].reshape(-1, 3, 3))


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    points = np.array([[0.1, 0.2], [0.3, -0.1]])
    refine_fundamental_on_inliers(np.diag([1.0, 0.5, 0.0]), points, points, 1.0, rounds=1)
