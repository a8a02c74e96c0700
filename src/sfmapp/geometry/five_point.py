"""The essential matrix of unit rays in any direction: RANSAC over five pairs of them.

Five pairs leave E in a four-dimensional space; its determinant and trace constraints are ten cubics in three unknowns,
which a Groebner basis turns into an eigenvalue problem of size ten: Stewenius, Engels and Nister, "Recent developments
on direct relative orientation", ISPRS Journal 60, 2006. Nothing in it asks that a ray has a point on the plane z = 1.
Samples are scored as by Torr and Zisserman, "MLESAC", CVIU 2000 (MSAC), on the angles of the rays.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.epipolar import nearest_essential, ray_sampson_error

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Monomials of degree one, two and three in x, y, z as exponents, the cubic ones in the order of the Groebner basis.
_LINEAR = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0))
_SQUARE = (
    (2, 0, 0), (1, 1, 0), (0, 2, 0), (1, 0, 1), (0, 1, 1), (0, 0, 2), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0),
)  # fmt: skip
_CUBE = (
    (3, 0, 0), (2, 1, 0), (1, 2, 0), (0, 3, 0), (2, 0, 1), (1, 1, 1), (0, 2, 1), (1, 0, 2), (0, 1, 2), (0, 0, 3),
    *_SQUARE,
)  # fmt: skip


def _products(first: tuple[tuple[int, ...], ...], second: tuple[tuple[int, ...], ...]) -> Ints:
    """(len(first), 4) where the product of two monomials stands: among the squares, or the cubes."""
    target = _SQUARE if first is _LINEAR else _CUBE
    return np.array([[target.index(tuple(np.add(a, b).tolist())) for b in second] for a in first])


_TO_SQUARE, _TO_CUBE = _products(_LINEAR, _LINEAR), _products(_SQUARE, _LINEAR)
# multiplied by x, a basis of the quotient ring (the last ten cubic monomials) turns into these, of which the first six
# are leading monomials, known by elimination, and the others are in the basis
_REDUCED = np.array([_CUBE.index((a + 1, b, c)) for a, b, c in _SQUARE])


def find_essential(rays1: Array, rays2: Array, threshold: float, max_trials: int, seed: int) -> Array | None:
    """E of unit norm by RANSAC, or None with fewer than eight pairs or where no sample has a solution.

    Args:
        rays1, rays2: (N, 3) unit rays of both cameras; wrong pairs are expected among them.
        threshold: Sampson distance of an inlier in radians.
        max_trials: most samples; fewer where one without a wrong pair has been drawn with probability 0.999.
        seed: the same gives the same answer.
    """
    if len(rays1) < 8:
        return None
    samples = np.random.default_rng([seed, len(rays1)]).integers(0, len(rays1), (max_trials, 5))
    a, b = (np.ascontiguousarray(rays, np.float64) for rays in (rays1, rays2))
    found, best = _search(a, b, threshold * threshold, samples)
    return nearest_essential(best) if found else None


@numba.njit(cache=True, nogil=True)
def _search(a: Array, b: Array, limit: float, samples: Ints) -> tuple[bool, Array]:
    best, found = np.zeros((3, 3)), False
    best_cost, needed = math.inf, samples.shape[0]
    trial = 0
    while trial < needed:
        sample = samples[trial]
        trial += 1
        if len(np.unique(sample)) < 5:
            continue
        for essential in essentials_of_five(a[sample], b[sample]):
            cost, inliers = 0.0, 0
            for i in range(a.shape[0]):
                error = ray_sampson_error(essential, a[i, 0], a[i, 1], a[i, 2], b[i, 0], b[i, 1], b[i, 2])
                inliers += error < limit
                cost += min(error, limit)
                if cost >= best_cost:
                    break
            if cost < best_cost:
                best_cost, found = cost, True
                best[:] = essential
                share = (inliers / a.shape[0]) ** 5
                if share > 0.0:
                    wanted = math.log(0.001) / math.log1p(-share) if share < 1.0 else 0.0
                    needed = min(needed, trial + int(min(wanted, 1e9)))
    return found, best


@numba.njit(cache=True, nogil=True)
def essentials_of_five(a: Array, b: Array) -> Array:
    """(K, 3, 3) essential matrices, K <= 10, that five pairs of rays (5, 3) allow."""
    rows = np.empty((5, 9))
    for i in range(5):
        for k in range(3):
            for m in range(3):
                rows[i, 3 * k + m] = b[i, k] * a[i, m]
    _, singular, vt = np.linalg.svd(rows, True)
    if not singular[4] > 1e-12 * singular[0]:
        return np.empty((0, 3, 3))
    basis = np.ascontiguousarray(vt[5:])
    constraints = _constraints(basis)
    left = np.ascontiguousarray(constraints[:, :10])
    if not abs(np.linalg.det(left)) > 1e-300:
        return np.empty((0, 3, 3))
    reduced = np.linalg.solve(left, np.ascontiguousarray(constraints[:, 10:]))
    action = np.zeros((10, 10))
    for k in range(10):
        place = _REDUCED[k]
        if place < 10:
            action[k] = -reduced[place]
        else:
            action[k, place - 10] = 1.0
    if not np.isfinite(action).all():
        return np.empty((0, 3, 3))
    values, vectors = np.linalg.eig(action.astype(np.complex128))
    out = np.empty((10, 3, 3))
    count = 0
    for k in range(10):
        if abs(values[k].imag) > 1e-9 * max(1.0, abs(values[k].real)) or abs(vectors[9, k]) < 1e-12:
            continue
        # the last four of the basis are x, y, z and 1
        essential = basis[3].copy()
        for m in range(3):
            essential += (vectors[6 + m, k] / vectors[9, k]).real * basis[m]
        out[count] = essential.reshape(3, 3) / np.linalg.norm(essential)
        count += 1
    return out[:count]


@numba.njit(cache=True, nogil=True)
def _constraints(basis: Array) -> Array:
    """(10, 20) coefficients of E E^T E - tr(E E^T) E / 2 and det E, where E = x B0 + y B1 + z B2 + B3, basis (4, 9)."""
    out = np.zeros((10, 20))
    square = np.zeros((3, 3, 10))  # E E^T
    for i in range(3):
        for j in range(3):
            for k in range(3):
                _add_square(basis[:, 3 * i + k], basis[:, 3 * j + k], 1.0, square[i, j])
    trace = square[0, 0] + square[1, 1] + square[2, 2]
    for i in range(3):
        square[i, i] -= 0.5 * trace
    for i in range(3):
        for j in range(3):
            for k in range(3):
                _add_cube(square[i, k], basis[:, 3 * k + j], out[3 * i + j])
    for i in range(3):  # the determinant by its last row
        j, k = (i + 1) % 3, (i + 2) % 3
        minor = np.zeros(10)
        _add_square(basis[:, j], basis[:, 3 + k], 1.0, minor)
        _add_square(basis[:, k], basis[:, 3 + j], -1.0, minor)
        _add_cube(minor, basis[:, 6 + i], out[9])
    return out


@numba.njit(cache=True, nogil=True)
def _add_square(p: Array, q: Array, factor: float, out: Array) -> None:
    """Add the product of two linear polynomials (4,)."""
    for i in range(4):
        for j in range(4):
            out[_TO_SQUARE[i, j]] += factor * p[i] * q[j]


@numba.njit(cache=True, nogil=True)
def _add_cube(p: Array, q: Array, out: Array) -> None:
    """Add the product of a quadratic polynomial (10,) and a linear one (4,)."""
    for i in range(10):
        for j in range(4):
            out[_TO_CUBE[i, j]] += p[i] * q[j]
