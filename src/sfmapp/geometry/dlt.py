"""The direct linear transform: projection matrices from points with known places, and the cameras that are in them.

Each point gives two rows of a linear system in the twelve entries of ``P``, with x ~ P X (Abdel-Aziz and Karara 1971;
Sutherland 1974). Points and pixels are normalised first, without which the system is too badly scaled to be solved
(Hartley, "In defense of the eight-point algorithm", PAMI 1997; Hartley and Zisserman, algorithm 7.1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MIN_POINTS = 6
"""Eleven unknowns, two equations each."""

# Of inverse iteration, which gains a factor of two at worst where the solution stands out from noise at all.
_MAX_ROUNDS, _SETTLED = 100, 1e-13


@dataclass(frozen=True)
class LinearProjection:
    """A projection matrix and how firmly the points hold it.

    Attributes:
        matrix: (3, 4), with the third row's first three entries of unit length and a positive determinant of the first
            three columns; the third coordinate of P X is then the depth, if a camera has taken the picture.
        singular_values: of the normalised system, descending: 12 of the homogeneous one, of which the last is what is
            left; 11 of the inhomogeneous.
        noise_level: what those would be that noise alone makes, see :attr:`rank`.
    """

    matrix: Array
    singular_values: Array
    noise_level: float

    @property
    def rank(self) -> int:
        """How many combinations of the entries the points tell: singular values above what noise alone makes. Eleven
        is all; 8 on a plane, 5 on a line."""
        return int((self.singular_values[:11] > self.noise_level).sum())


def normalizing(points: Array) -> Array:
    """(D + 1, D + 1) similarity that brings the middle of points (N, D) to the origin and their mean squared distance
    from it to D. Points that are all one keep their scale."""
    num_axes, num = points.shape[1], max(len(points), 1)
    middle = points.sum(0) / num
    rms = math.sqrt(float(((points - middle) ** 2).sum()) / num)
    scale = math.sqrt(num_axes) / rms if rms > 0.0 else 1.0
    out = np.diag([scale] * num_axes + [1.0])
    out[:num_axes, num_axes] = -scale * middle
    return out


def homogeneous(points: Array) -> Array:
    """Points (..., D) with a one behind: (..., D + 1)."""
    return np.concatenate([points, np.ones((*points.shape[:-1], 1))], -1)


def projection_rows(xyz1: Array, xy: Array) -> Array:
    """(..., 2 N, 12) system A with A p = 0, of points (..., N, 4) and their pixels (..., N, 2)."""
    rows = np.zeros((*xyz1.shape[:-1], 2, 12))
    rows[..., 0, :4] = rows[..., 1, 4:8] = xyz1
    rows[..., 8:] = -xy[..., None] * xyz1[..., None, :]
    return rows.reshape(*xyz1.shape[:-2], -1, 12)


def find_projection(
    xyz: Array, xy: Array, *, is_inhomogeneous: bool = False, noise_px: float = 0.0
) -> LinearProjection:
    """The projection matrix that fits N >= 6 points best, algebraically.

    Args:
        xyz: (N, 3) in the world. xy: (N, 2) pixels.
        is_inhomogeneous: solve 2N x 11 with the last entry of the normalised matrix held at one, by least squares, and
            not 2N x 12 under |p| = 1. It fails where the middle of the points lies in the camera's own plane, which for
            a camera that sees them all is nowhere.
        noise_px: the least standard deviation of a pixel coordinate. What is left of the system says more only where
            its rank is full: on a plane, a matrix can always be found that leaves nothing.

    Returns:
        Also for points that leave the matrix open, on a plane for one: look at its rank.
    """
    of_xyz, of_xy = normalizing(xyz), normalizing(xy)
    rows = projection_rows(homogeneous(xyz) @ of_xyz.T, homogeneous(xy) @ of_xy[:2].T)
    if is_inhomogeneous:
        solution, _, _, singular_values = np.linalg.lstsq(rows[:, :11], -rows[:, 11], rcond=None)
        entries = np.append(solution, 1.0)
    else:
        values, vt = _right_vectors(rows)
        singular_values = np.pad(values, (0, 12 - len(values)))
        entries = vt[11]
    matrix = np.linalg.solve(of_xy, entries.reshape(3, 4)) @ of_xyz
    # the pixels' noise enters the last four columns, times the points; 2N - 11 numbers are left to tell it
    left = rows @ (entries / np.linalg.norm(entries.reshape(3, 4)[2]))
    sigma = np.linalg.norm(left) / np.sqrt(max(len(rows) - 11, 1))
    points = homogeneous(xyz) @ of_xyz.T
    level = max(sigma, noise_px * of_xy[0, 0], 1e-13) * np.sqrt(2.0 * np.linalg.eigvalsh(points.T @ points)[-1])
    return LinearProjection(_scaled(matrix), np.asarray(singular_values, np.float64), float(level))


def find_projections(xyz: Array, xy: Array) -> Array:
    """(S, 3, 4) projection matrices of S samples of M points (S, M, 3) and pixels (S, M, 2), by the homogeneous system;
    scaled as that of :class:`LinearProjection`. What a bad sample gives is a matrix that fits nothing."""
    of_xyz, of_xy = normalizing(xyz.reshape(-1, 3)), normalizing(xy.reshape(-1, 2))
    rows = projection_rows(homogeneous(xyz) @ of_xyz.T, homogeneous(xy) @ of_xy[:2].T)
    entries = _least_vectors(rows)
    return _scaled(np.linalg.solve(of_xy, entries.reshape(-1, 3, 4)) @ of_xyz)


def homography_rows(xy1: Array, xy: Array) -> Array:
    """(..., 2 N, 9) system A with A h = 0, of points of a plane (..., N, 3) and their pixels (..., N, 2)."""
    rows = np.zeros((*xy1.shape[:-1], 2, 9))
    rows[..., 0, :3] = rows[..., 1, 3:6] = xy1
    rows[..., 6:] = -xy[..., None] * xy1[..., None, :]
    return rows.reshape(*xy1.shape[:-2], -1, 9)


def find_homographies(source: Array, target: Array) -> Array:
    """(S, 3, 3) maps of S samples of M >= 4 points of a plane (S, M, 2) to their pixels (S, M, 2), of unit norm, by the
    homogeneous system 2 M x 9; the weights of the first point are positive."""
    of_source, of_target = normalizing(source.reshape(-1, 2)), normalizing(target.reshape(-1, 2))
    rows = homography_rows(homogeneous(source) @ of_source.T, homogeneous(target) @ of_target[:2].T)
    entries = _least_vectors(rows)
    found = np.linalg.solve(of_target, entries.reshape(-1, 3, 3)) @ of_source
    weight = (found[:, 2] * homogeneous(source)[:, 0]).sum(1)
    scaled: Array = found * (np.where(weight < 0.0, -1.0, 1.0) / np.linalg.norm(found, axis=(1, 2)))[:, None, None]
    return scaled


def find_homography(source: Array, target: Array) -> Array:
    """(3, 3) map of N >= 4 points of a plane (N, 2) to their pixels (N, 2); its last number is 1, or 0.

    The normalised DLT (Hartley and Zisserman, algorithm 4.2).
    """
    found: Array = find_homographies(source[None], target[None])[0]
    return found / found[2, 2] if found[2, 2] != 0 else found


def _right_vectors(rows: Array) -> tuple[Array, Array]:
    """Singular values (..., min(M, N)) and all right singular vectors (..., N, N) of systems (..., M, N)."""
    # left vectors are not used, and there are as many as rows
    _, values, vt = np.linalg.svd(rows, full_matrices=rows.shape[-2] < rows.shape[-1])
    return values, vt


@numba.njit(cache=True, nogil=True)
def _least_vectors(systems: Array) -> Array:
    """(S, N) unit vectors that systems (S, M, N) make least: Householder's triangle of each, then inverse iteration.

    They are the last right singular vectors, for a fraction of what LAPACK takes for systems as small.
    """
    num, count, size = systems.shape
    found, a = np.empty((num, size)), np.empty((max(count, size), size))
    for s in range(num):
        for m in range(a.shape[0]):
            for i in range(size):
                a[m, i] = systems[s, m, i] if m < count else 0.0
        largest = triangle(a)
        for i in range(size):
            if not abs(a[i, i]) > 1e-15 * largest:
                a[i, i] = 1e-15 * largest + 1e-300
        _inverse_iteration(a, found[s])
    return found


@numba.njit(cache=True, nogil=True)
def triangle(a: Array) -> float:
    """Bring a system (M, N), M >= N, to upper triangular form in place; its largest pivot. What is below the diagonal
    is left over."""
    largest = 0.0
    for k in range(a.shape[1]):
        norm = 0.0
        for m in range(k, a.shape[0]):
            norm += a[m, k] * a[m, k]
        norm = math.sqrt(norm)
        if norm > 0.0:
            pivot = -norm if a[k, k] > 0.0 else norm
            head = a[k, k] - pivot
            for i in range(k + 1, a.shape[1]):
                total = head * a[k, i]
                for m in range(k + 1, a.shape[0]):
                    total += a[m, k] * a[m, i]
                total /= pivot * head
                a[k, i] += total * head
                for m in range(k + 1, a.shape[0]):
                    a[m, i] += total * a[m, k]
            a[k, k] = pivot
        largest = max(largest, abs(a[k, k]))
    return largest


@numba.njit(cache=True, nogil=True)
def _inverse_iteration(r: Array, x: Array) -> None:
    """Fill the unit vector (N,) that an upper triangle (N, N) makes least."""
    size, change = x.shape[0], 1.0
    y, before = np.empty(size), np.empty(size)
    for i in range(size):
        x[i] = 1.0 / (1.0 + i)
    for _ in range(_MAX_ROUNDS):
        for i in range(size):
            before[i] = x[i]
        for i in range(size):  # R^T y = x
            total = x[i]
            for k in range(i):
                total -= r[k, i] * y[k]
            y[i] = total / r[i, i]
        norm = 0.0
        for i in range(size):
            norm = max(norm, abs(y[i]))
        for i in range(size):
            y[i] /= norm
        for i in range(size - 1, -1, -1):  # R x = y
            total = y[i]
            for k in range(i + 1, size):
                total -= r[i, k] * x[k]
            x[i] = total / r[i, i]
        norm = along = 0.0
        for i in range(size):
            norm += x[i] * x[i]
            along += x[i] * before[i]
        norm = math.copysign(math.sqrt(norm), along)
        change = 0.0
        for i in range(size):
            x[i] /= norm
            change = max(change, abs(x[i] - before[i]))
        if change < _SETTLED:
            return


def _scaled(matrix: Array) -> Array:
    length = np.linalg.norm(matrix[..., 2, :3], axis=-1)
    sign = np.where(np.linalg.det(matrix[..., :3]) < 0.0, -1.0, 1.0)
    scaled: Array = matrix * (sign / np.where(length > 0.0, length, 1.0))[..., None, None]
    return scaled


def decompose_projection(matrix: Array) -> tuple[Array, Array, Array]:
    """K, R and t of a projection matrix (3, 4) ~ K (R | t), by RQ (Hartley and Zisserman, 6.2.4).

    Returns:
        K (3, 3) upper triangular with a positive diagonal and a one in its last place, skew in K[0, 1]; R (3, 3) a
        rotation, det R = 1; t (3,). Any real matrix of full rank has such parts, also one that no camera gives: points
        then lie behind it.

    Raises:
        ValueError: the first three columns are singular: a camera at infinity.
    """
    scaled = _scaled(matrix)
    if not np.linalg.cond(scaled[:, :3]) < 1e12:
        raise ValueError("the first three columns of the projection matrix are singular: its camera is at infinity")
    # RQ is QR with rows and columns turned round
    q, r = np.linalg.qr(scaled[::-1, :3].T)
    k, rotation = r.T[::-1, ::-1], q.T[::-1]
    signs = np.sign(np.diag(k))
    k, rotation = k * signs, signs[:, None] * rotation
    return k / k[2, 2], rotation, np.linalg.solve(k, scaled[:, 3])
