"""Are two calibrations of the same camera? By where they put the same rays, and by how sure both are of it.

Two calibrations may differ by a turn of the camera, which no picture shows: the best one is taken out first, as in
mrcal's ``mrcal-show-projection-diff``. What is left is a difference in pixels, place by place, whose covariance follows
from those of both parameters with the same turn taken out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.result import CameraCalibration
from sfmapp.calibration.uncertainty import image_grid
from sfmapp.camera.camera import Camera, pixels_to_rays, project, project_jacobian
from sfmapp.errors import InputError
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

_GRID = (25, 19)
_TURNS = 20
# of the largest spread: below it, what is not linear in the parameters would count as a difference
_RANK = 1e-3
# one pair of the same camera in a thousand is called different
_DIFFERENT = 1e-3
# a thousandth of a pixel matters to nobody: two files of one result are the same
_NOTHING_PX = 1e-3


@dataclass(frozen=True)
class Comparison:
    """How two cameras differ over the picture.

    Attributes:
        xy: (N, 2) pixels of the first.
        difference: (N, 2) where the second puts what the first sees there, less that place; NaN where one has no ray.
        sigma: (N,) standard deviation of a coordinate of it, by both calibrations.
        turn_deg: of the rotation that was taken out.
        chi2, degrees_of_freedom, chance: of the whole difference if the cameras were the same.
        is_same: as far as the sigmas tell.
    """

    xy: Array
    difference: Array
    sigma: Array
    turn_deg: float
    chi2: float
    degrees_of_freedom: int
    chance: float

    @property
    def is_same(self) -> bool:
        return self.chance > _DIFFERENT or float(np.nanmax(self.length)) < _NOTHING_PX

    @property
    def length(self) -> Array:
        """(N,) of the difference in pixels."""
        return np.hypot(self.difference[:, 0], self.difference[:, 1])


def compare(a: CameraCalibration, b: CameraCalibration) -> Comparison:
    """Compare the projections of two calibrations.

    Raises:
        InputError: they are for pictures of different sizes, or hardly any ray is in both.
    """
    from scipy.stats import chi2  # heavy to load, and densifying, for one, imports this module

    xy, difference, rotation = projection_difference(a.camera, b.camera)
    is_known = np.isfinite(difference).all(1)
    rays = pixels_to_rays(a.camera, xy)
    turned = rays @ rotation.T
    # a change of a parameter moves the projection of the first away from, and of the second towards, the difference
    roots = [_derivative(one.camera, own[is_known]) @ _root(one.covariance) for one, own in ((a, rays), (b, turned))]
    # the difference is this matrix times numbers of variance 1: its singular values say along what it varies
    spread = np.concatenate(roots, 2)
    vectors, values, _ = np.linalg.svd(spread.reshape(-1, spread.shape[2]), full_matrices=False)
    is_large = values > _RANK * values[0]
    along = vectors[:, is_large].T @ difference[is_known].ravel()
    statistic = float((along**2 / values[is_large] ** 2).sum())
    dof = int(is_large.sum())
    sigma = np.full(len(xy), np.nan)
    sigma[is_known] = np.sqrt((spread**2).sum(2).mean(1))
    angle = float(rigid3.rotation_angle_deg(rotation))
    return Comparison(xy, difference, sigma, angle, statistic, dof, float(chi2.sf(statistic, dof)))


def projection_difference(a: Camera, b: Camera) -> tuple[Array, Array, Array]:
    """Where two cameras put the same rays, after the best turn of the one against the other.

    Returns:
        (N, 2) pixels of the first all over its picture; (N, 2) where the second puts what the first sees there, less
        that place, NaN where one of them has no ray; (3, 3) the turn of rays of the first.

    Raises:
        InputError: they are for pictures of different sizes, or hardly any ray is in both.
    """
    if (a.width, a.height) != (b.width, b.height):
        raise InputError(
            f"expected two calibrations for pictures of one size, found {a.width}x{a.height} and {b.width}x{b.height}",
            "compare calibrations of the same mode of the camera",
        )
    xy = image_grid(a, _GRID)
    rays = pixels_to_rays(a, xy)
    is_known = np.isfinite(rays).all(1) & np.isfinite(pixels_to_rays(b, xy)).all(1)
    if is_known.sum() < len(xy) // 4:
        raise InputError("expected cameras that see the same, found hardly a place of the picture where both have rays")
    rotation = _best_rotation(b, rays[is_known], xy[is_known])
    difference = project(b, rays @ rotation.T) - xy
    difference[~(is_known & np.isfinite(difference).all(1))] = np.nan
    return xy, difference, rotation


def _root(covariance: Array) -> Array:
    """(P, P) whose product with its transpose is a covariance; a parameter that was held has a row of zeros."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    inverse = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0)
    values, vectors = np.linalg.eigh(covariance * inverse[:, None] * inverse)
    found: Array = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return found


def _derivative(camera: Camera, rays: Array) -> Array:
    """(N, 2, P) of projections by the parameters, less what the best turn of all rays makes up for."""
    _, by_ray, by_param = project_jacobian(camera, rays)
    by_turn = -by_ray @ rigid3.skew(rays)
    turn = np.linalg.lstsq(by_turn.reshape(-1, 3), by_param.reshape(-1, by_param.shape[2]), rcond=None)[0]
    found: Array = by_param - by_turn @ turn
    return found


def _best_rotation(camera: Camera, rays: Array, xy: Array) -> Array:
    """(3, 3) turn of rays (N, 3) that brings their projections nearest to pixels (N, 2): Gauss and Newton."""
    rotation = np.eye(3)
    for _ in range(_TURNS):
        turned = rays @ rotation.T
        projected, by_ray, _ = project_jacobian(camera, turned)
        is_known = np.isfinite(projected).all(1)
        by_turn = -by_ray[is_known] @ rigid3.skew(turned[is_known])
        off = (xy - projected)[is_known]
        step = np.linalg.lstsq(by_turn.reshape(-1, 3), off.ravel(), rcond=None)[0]
        rotation = rigid3.exp_so3(step) @ rotation
        if np.linalg.norm(step) < 1e-12:
            break
    return rotation
