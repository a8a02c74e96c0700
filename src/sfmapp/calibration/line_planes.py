"""Lines of one photograph as planes through the camera's centre, under the division model.

Pixels count from the principal point in units of half the picture's diagonal, R. The division model lifts a pixel to
``s = (x, y, 1 + lambda (x^2 + y^2))``, its ray for the focal length 1 (Fitzgibbon, CVPR 2001). The points of a straight
line have ``m . s = 0``: a circle in the photograph. For the focal length f, in units of R, the ray is (x, y, f s_z),
the normal of the projection plane (m_x, m_y, m_z / f), and a direction v of the world vanishes at ``p = (v_x, v_y, v_z
/ f)``, which the line meets where ``m . p = 0``. So all that does not need f is computed once.

The literature also writes the model as x' = cx + (x - cx)(sqrt(1 + 4 r d) - 1)/(2 r d) with d the squared distance of
the straight point from the centre: that is r = -lambda.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DivisionLens:
    """A lens in units of half the picture's diagonal.

    Attributes:
        strength: lambda R^2, without dimension: the radius of the corner becomes 1 / (1 + lambda R^2) times as large.
            Negative for a barrel.
        center: (2,) pixels.
        radius_px: R.
    """

    strength: float
    center: Array
    radius_px: float

    def lift(self, points: Array) -> Array:
        """(..., 3) lifted points of pixels (..., 2)."""
        xy = (points - self.center) / self.radius_px
        return np.concatenate([xy, 1.0 + self.strength * (xy**2).sum(-1, keepdims=True)], -1)

    def gradients(self, lifted: Array, normals: Array) -> Array:
        """(N, K, 2) gradient, by the pixel, of ``m . s`` for normals (N, 3) at lifted points (N, K, 3)."""
        inner = 2.0 * self.strength * normals[:, None, 2:]
        gradients: Array = (normals[:, None, :2] + inner * lifted[..., :2]) / self.radius_px
        return gradients

    def slopes(self, lifted: Array, normals: Array) -> Array:
        """(N, K) length of the gradient."""
        slopes: Array = np.maximum(np.sqrt((self.gradients(lifted, normals) ** 2).sum(-1)), 1e-12)
        return slopes


def fit_planes(lens: DivisionLens, points: Array) -> tuple[Array, Array, Array]:
    """The plane of each line.

    Args:
        points: (N, K, 2) pixels along each line.

    Returns:
        (N, 3) unit normals m, (N, 3, 3) their covariance for points that are off by 1 px together (sigma^2 times it for
        other errors; all points of a line count as one, for their errors are not independent), and (N,) the rms
        distance of the points from the line in pixels.
    """
    lifted = lens.lift(points)
    weights = np.ones(lifted.shape[:2])
    for _ in range(3):
        weighted = lifted * weights[..., None]
        moments = np.einsum("nki,nkj->nij", weighted, weighted) / points.shape[1]
        values, vectors = np.linalg.eigh(moments)
        normals = vectors[:, :, 0]
        weights = 1.0 / lens.slopes(lifted, normals)
    inverse = 1.0 / np.maximum(values[:, 1:], 1e-12)
    covariance = np.einsum("nik,nk,njk->nij", vectors[:, :, 1:], inverse, vectors[:, :, 1:])
    residuals = np.einsum("nki,ni->nk", lifted, normals) * weights
    return normals, covariance, np.sqrt((residuals**2).mean(1))


def on_lines(lens: DivisionLens, points: Array) -> Array:
    """(N, K, 2) the places nearest to pixels (N, K, 2) on the best image of a straight line through each."""
    normals = fit_planes(lens, points)[0]
    lifted = lens.lift(points)
    gradients = lens.gradients(lifted, normals)
    square = np.maximum((gradients**2).sum(-1, keepdims=True), 1e-24)
    moved: Array = points - np.einsum("nki,ni->nk", lifted, normals)[..., None] * gradients / square
    return moved


@dataclass(frozen=True)
class FittedLines:
    """The best images of straight lines for given points, through a vanishing point each or through none.

    Attributes:
        residuals: (N, K) signed distances in pixels.
        coefficients: (N, 2) or (N, 3) of the normals, in the basis of those that are allowed.
        tangents: (N, K, T) orthonormal: how residuals change with the normals; what they span is no error.
    """

    residuals: Array
    coefficients: Array
    tangents: Array


def fit_lines(lens: DivisionLens, points: Array, vanishing: Array | None) -> FittedLines:
    """The best lines for pixels (N, K, 2), through vanishing points (N, 3) or, without any, free."""
    basis = _allowed_normals(len(points), vanishing)
    lifted = lens.lift(points)
    coordinates = lifted @ basis
    weights = np.ones(lifted.shape[:2])
    for _ in range(3):
        weighted = coordinates * weights[..., None]
        _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", weighted, weighted))
        weights = 1.0 / lens.slopes(lifted, np.einsum("nij,nj->ni", basis, vectors[:, :, 0]))
    coefficients = vectors[:, :, 0]
    weighted = coordinates * weights[..., None]
    tangents, _ = np.linalg.qr(weighted @ vectors[:, :, 1:])
    return FittedLines(np.einsum("nki,ni->nk", weighted, coefficients), coefficients, tangents)


def distances(lens: DivisionLens, points: Array, vanishing: Array | None, coefficients: Array) -> Array:
    """(N, K) signed distances in pixels of points (N, K, 2) from lines whose coefficients :func:`fit_lines` found for a
    lens and vanishing points nearby."""
    normals = np.einsum("nij,nj->ni", _allowed_normals(len(points), vanishing), coefficients)
    lifted = lens.lift(points)
    result: Array = np.einsum("nki,ni->nk", lifted, normals) / lens.slopes(lifted, normals)
    return result


def _allowed_normals(num: int, vanishing: Array | None) -> Array:
    """(N, 3, 2) or (N, 3, 3) bases of normals."""
    return np.broadcast_to(np.eye(3), (num, 3, 3)) if vanishing is None else _planes_through(vanishing)


def _planes_through(vanishing: Array) -> Array:
    """(N, 3, 2) bases of the normals that are at right angles to vectors (N, 3)."""
    unit = vanishing / np.linalg.norm(vanishing, axis=1, keepdims=True)
    least = np.eye(3)[np.abs(unit).argmin(1)]
    first = np.cross(unit, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(unit, first)], 2)
