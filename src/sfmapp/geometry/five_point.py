"""The essential matrix of unit rays in any direction: RANSAC over five pairs of them.

Five pairs leave E in a four-dimensional space; its determinant and trace constraints are ten cubics in three unknowns
x, y, z, which elimination turns into one equation of degree ten in z: Nister, "An efficient solution to the five-point
relative pose problem", PAMI 2004. Nothing in it asks that a ray has a point on the plane z = 1.
Samples are scored as by Torr and Zisserman, "MLESAC", CVIU 2000 (MSAC), on the angles of the rays.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.epipolar import nearest_essential, ray_sampson_error
from sfmapp.simd.copying import copy_into

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
# Monomials that are eliminated, and what is left of x, of y and of neither, by falling powers of z. The last six of the
# first, two and two, differ by the factor z alone, which leaves three equations linear in x and y.
_ELIMINATED = np.array([_CUBE.index(m) for m in (
    (3, 0, 0), (0, 3, 0), (2, 1, 0), (1, 2, 0),
    (2, 0, 1), (2, 0, 0), (0, 2, 1), (0, 2, 0), (1, 1, 1), (1, 1, 0))])  # fmt: skip
_LEFT = np.array([_CUBE.index(m) for m in (
    (1, 0, 2), (1, 0, 1), (1, 0, 0), (0, 1, 2), (0, 1, 1), (0, 1, 0),
    (0, 0, 3), (0, 0, 2), (0, 0, 1), (0, 0, 0))])  # fmt: skip


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
    essentials = np.empty((10, 3, 3))
    trial = 0
    while trial < needed:
        sample = samples[trial]
        trial += 1
        if len(np.unique(sample)) < 5:
            continue
        for n in range(fill_essentials(a, b, sample, essentials)):
            essential = essentials[n]
            cost, inliers = 0.0, 0
            for i in range(a.shape[0]):
                error = ray_sampson_error(essential, a[i, 0], a[i, 1], a[i, 2], b[i, 0], b[i, 1], b[i, 2])
                inliers += error < limit
                cost += min(error, limit)
                if cost >= best_cost:
                    break
            if cost < best_cost:
                best_cost, found = cost, True
                copy_into(best, essential)
                share = (inliers / a.shape[0]) ** 5
                if share > 0.0:
                    wanted = math.log(0.001) / math.log1p(-share) if share < 1.0 else 0.0
                    needed = min(needed, trial + int(min(wanted, 1e9)))
    return found, best


@numba.njit(cache=True, nogil=True)
def essentials_of_samples(a: Array, b: Array, samples: Ints) -> Array:
    """(K, 3, 3) what :func:`fill_essentials` finds of each sample (S, 5) of pairs of rays (N, 3)."""
    out = np.empty((10 * samples.shape[0], 3, 3))
    count = 0
    for n in range(samples.shape[0]):
        count += fill_essentials(a, b, samples[n], out[count:])
    return out[:count]


@numba.njit(cache=True, nogil=True)
def fill_essentials(a: Array, b: Array, sample: Ints, out: Array) -> int:
    """Fill in the essential matrices that five pairs of rays allow; returns how many, 10 at most.

    Whole arrays are not computed with here: what numba brings for that takes longer to compile than all the rest.

    Args:
        a, b: (N, 3) rays of both cameras; sample: (5,) positions of the pairs.
        out: (>= 10, 3, 3), filled.
    """
    columns, basis, constraints = np.empty((9, 5)), np.empty((4, 9)), np.empty((10, 20))
    for i in range(5):
        n = sample[i]
        for k in range(3):
            for m in range(3):
                columns[3 * k + m, i] = b[n, k] * a[n, m]
    if not _fill_null_space(columns, basis):
        return 0
    found = _constraints(basis)
    for i in range(10):
        for k in range(10):
            constraints[i, k], constraints[i, 10 + k] = found[i, _ELIMINATED[k]], found[i, _LEFT[k]]
    if not _eliminate(constraints):
        return 0
    linear = _linear_in_two(constraints)
    roots = _real_roots(_determinant(linear))
    count = 0
    for n in range(roots.shape[0]):
        z = roots[n]
        x, y, w = _null_vector(linear, z)
        if w == 0.0:
            continue
        square = 0.0
        for i in range(9):
            value = (x / w) * basis[0, i] + (y / w) * basis[1, i] + z * basis[2, i] + basis[3, i]
            out[count, i // 3, i % 3] = value
            square += value * value
        length = math.sqrt(square)
        for i in range(9):
            out[count, i // 3, i % 3] /= length
        count += 1
    return count


# by hand, as numba's LAPACK loads scipy.linalg, which takes longer than the five rays of a whole reconstruction
@numba.njit(cache=True, nogil=True)
def _fill_null_space(columns: Array, out: Array) -> bool:
    """Fill ``out`` (4, 9) with an orthonormal basis of what is orthogonal to all columns (9, 5), which are overwritten;
    whether they are independent. Householder's reflections with the longest column next."""
    num, count = columns.shape
    scale = 0.0
    for k in range(count):
        longest, length = k, -1.0
        for m in range(k, count):
            square = 0.0
            for i in range(k, num):
                square += columns[i, m] * columns[i, m]
            if square > length:
                longest, length = m, square
        length = math.sqrt(length)
        scale = length if k == 0 else scale
        if not length > 1e-12 * scale:
            return False
        for i in range(num):
            columns[i, k], columns[i, longest] = columns[i, longest], columns[i, k]
        columns[k, k] += math.copysign(length, columns[k, k])  # now the normal of the mirror, from row k on
        for m in range(k + 1, count):
            _reflect(columns, k, columns[:, m])
    for n in range(num - count):
        out[n] = 0.0
        out[n, count + n] = 1.0
        for k in range(count - 1, -1, -1):
            _reflect(columns, k, out[n])
    return True


@numba.njit(cache=True, nogil=True)
def _reflect(columns: Array, k: int, vector: Array) -> None:
    """Reflect by the normal that is in column k from row k on."""
    dot, square = 0.0, 0.0
    for i in range(k, columns.shape[0]):
        dot += columns[i, k] * vector[i]
        square += columns[i, k] * columns[i, k]
    for i in range(k, columns.shape[0]):
        vector[i] -= 2.0 * dot / square * columns[i, k]


@numba.njit(cache=True, nogil=True)
def _eliminate(equations: Array) -> bool:
    """Make the left square of equations (n, m) the identity, by Gauss and Jordan with the largest pivot of a column
    next; whether it is regular."""
    num, width = equations.shape
    for k in range(num):
        pivot = k
        for i in range(k + 1, num):
            if abs(equations[i, k]) > abs(equations[pivot, k]):
                pivot = i
        if not abs(equations[pivot, k]) > 1e-30:
            return False
        for j in range(k, width):
            equations[k, j], equations[pivot, j] = equations[pivot, j], equations[k, j]
        inverse = 1.0 / equations[k, k]
        for j in range(k, width):
            equations[k, j] *= inverse
        for i in range(num):
            factor = equations[i, k]
            if i == k or factor == 0.0:
                continue
            for j in range(k, width):
                equations[i, j] -= factor * equations[k, j]
    return True


@numba.njit(cache=True, nogil=True)
def _linear_in_two(reduced: Array) -> Array:
    """(3, 3, 5) coefficients, by rising powers of z, of three equations ``a(z) x + b(z) y + c(z) = 0``, from what is
    left behind the ten eliminated columns."""
    out = np.zeros((3, 3, 5))
    for i in range(3):
        one, other = reduced[4 + 2 * i], reduced[5 + 2 * i]  # the first less z times the second
        for k in range(3):
            degree, start = (3, 6) if k == 2 else (2, 3 * k)
            for power in range(degree + 1):
                out[i, k, power] += one[10 + start + degree - power]
                out[i, k, power + 1] -= other[10 + start + degree - power]
    return out


@numba.njit(cache=True, nogil=True)
def _determinant(linear: Array) -> Array:
    """(11,) coefficients, by rising powers, of the determinant of a matrix (3, 3, 5) of polynomials."""
    out, minor = np.zeros(11), np.empty(8)
    for i in range(3):
        a, b = linear[(i + 1) % 3], linear[(i + 2) % 3]
        minor[:] = 0.0
        for k in range(4):
            for m in range(4):
                minor[k + m] += a[0, k] * b[1, m] - a[1, k] * b[0, m]
        for k in range(5):
            for m in range(7):
                out[k + m] += linear[i, 2, k] * minor[m]
    return out


@numba.njit(cache=True, nogil=True)
def _null_vector(linear: Array, z: float) -> tuple[float, float, float]:
    """What the three equations at z are solved by, up to scale: the longest product of two of them."""
    rows = np.zeros((3, 3))
    for i in range(3):
        for k in range(3):
            for power in range(4, -1, -1):
                rows[i, k] = rows[i, k] * z + linear[i, k, power]
    best, x, y, w = -1.0, 0.0, 0.0, 0.0
    for i in range(3):
        a, b = rows[i], rows[(i + 1) % 3]
        p, q, r = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
        if p * p + q * q + r * r > best:
            best, x, y, w = p * p + q * q + r * r, p, q, r
    return x, y, w


@numba.njit(cache=True, nogil=True)
def _real_roots(polynomial: Array) -> Array:
    """Simple real roots of a polynomial (n + 1,), by rising powers: those within one, and those of the reversed one."""
    n = polynomial.shape[0] - 1
    out, found, reversed_polynomial = np.empty(2 * n), np.empty(n), np.empty(n + 1)
    for k in range(n + 1):
        reversed_polynomial[k] = polynomial[n - k]
    count = 0
    for is_reversed in range(2):
        for k in range(_roots_within_one(reversed_polynomial if is_reversed else polynomial, found)):
            if is_reversed and abs(found[k]) < 1e-12:
                continue
            out[count] = 1.0 / found[k] if is_reversed else found[k]
            count += 1
    return out[:count]


@numba.njit(cache=True, nogil=True)
def _roots_within_one(polynomial: Array, out: Array) -> int:
    """Fill in the roots in (-1, 1); returns how many. Those of each derivative part those of the one before."""
    n = polynomial.shape[0] - 1
    derivatives = np.zeros((n + 1, n + 1))  # the k-th in row k
    for m in range(n + 1):
        derivatives[0, m] = polynomial[m]
    for k in range(1, n + 1):
        for m in range(n + 1 - k):
            derivatives[k, m] = (m + 1) * derivatives[k - 1, m + 1]
    bounds = np.empty(n + 2)
    count = 0
    for k in range(n - 1, -1, -1):
        bounds[0] = -1.0
        for m in range(count):
            bounds[m + 1] = out[m]
        bounds[count + 1] = 1.0
        last = count + 1
        count = 0
        low = _value(derivatives[k], n - k, bounds[0])
        for m in range(last):
            high = _value(derivatives[k], n - k, bounds[m + 1])
            if (low < 0.0) != (high < 0.0):
                out[count] = _root_between(derivatives[k], derivatives[k + 1], n - k, bounds[m], bounds[m + 1], low)
                count += 1
            low = high
    return count


@numba.njit(cache=True, nogil=True)
def _value(polynomial: Array, degree: int, x: float) -> float:
    total = polynomial[degree]
    for k in range(degree - 1, -1, -1):
        total = total * x + polynomial[k]
    return float(total)


@numba.njit(cache=True, nogil=True)
def _root_between(polynomial: Array, slope: Array, degree: int, low: float, high: float, at_low: float) -> float:
    """Newton's method, or a bisection where it would leave the interval, over which the sign changes once."""
    x = 0.5 * (low + high)
    for _ in range(80):
        value = _value(polynomial, degree, x)
        if (value < 0.0) == (at_low < 0.0):
            low = x
        else:
            high = x
        steep = _value(slope, degree - 1, x)
        new = x - value / steep if steep != 0.0 else low
        if not low < new < high:
            new = 0.5 * (low + high)
        if abs(new - x) <= 1e-15 * (1.0 + abs(x)):
            return new
        x = new
    return x


@numba.njit(cache=True, nogil=True)
def _constraints(basis: Array) -> Array:
    """(10, 20) coefficients of E E^T E - tr(E E^T) E / 2 and det E, where E = x B0 + y B1 + z B2 + B3, basis (4, 9)."""
    out = np.zeros((10, 20))
    square = np.zeros((3, 3, 10))  # E E^T
    for i in range(3):
        for j in range(3):
            for k in range(3):
                _add_square(basis[:, 3 * i + k], basis[:, 3 * j + k], 1.0, square[i, j])
    for n in range(10):
        half = 0.5 * (square[0, 0, n] + square[1, 1, n] + square[2, 2, n])
        for i in range(3):
            square[i, i, n] -= half
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


def compile_kernels() -> None:
    """Run the kernel of samples once, so that numba compiles or loads it now."""
    rays = np.random.default_rng(0).normal(size=(2, 5, 3))
    essentials_of_samples(rays[0], rays[1], np.arange(5)[None])
