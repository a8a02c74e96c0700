"""The similarity that brings a model to measured places of its cameras, and its covariance.

Coordinates of places are x east, y north, z up in metres. A place may have no height: its sigma is infinite then.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Gauss-Newton settles in five; it is linear for turns up to about this.
_MAX_ROUNDS, _LONGEST_TURN_RAD = 20, 0.5
# A height that is unknown is held to that of the frame's origin within this, in metres.
UNKNOWN_M = 1000.0


@dataclass(frozen=True)
class Level:
    """What is known of the vertical beside places: ``up`` (3,) unit vector, good to ``sigma_rad``, and whence."""

    up: Array
    sigma_rad: float
    source: str


class LevelOfImage(NamedTuple):
    """The vertical as one image sees it: ``level.up`` is in that camera's frame."""

    image_idx: int
    level: Level


@dataclass(frozen=True)
class Similarity:
    """``place = mean + scale R (center - origin)``.

    Attributes:
        rotation: (3, 3); scale; origin: (3,) in the model; mean: (3,) in the world.
        covariance: (7, 7) of rotation (radians about east, north, up, on the left), log scale, mean (metres), with
            places as good as their sigmas say.
        redundancy: (n, 3) share of each residual's variance that the fit leaves: 1 for what had no part in it.
    """

    rotation: Array
    scale: float
    origin: Array
    mean: Array
    covariance: Array
    redundancy: Array

    def apply(self, xyz: Array) -> Array:
        """Places (n, 3) of points (n, 3)."""
        return self.scale * (xyz - self.origin) @ self.rotation.T + self.mean

    @property
    def world_from_model(self) -> Array:
        """(8,) quaternion x y z w, translation, scale, as of :mod:`sfmapp.geometry.similarity`."""
        pose = rigid3.from_matrix(self.rotation, self.mean - self.scale * self.rotation @ self.origin)
        return np.append(pose, self.scale)


def fit_similarity(
    centers: Array, places: Array, sigma: Array, is_used: Mask, start: Similarity, level: Level | None = None
) -> Similarity | None:
    """Maximum-likelihood similarity by Gauss-Newton steps.

    Args:
        centers: (n, 3) in the model; places: (n, 3); sigma: (n, 3) of the places, infinite for none.
        is_used: (n,) bool.
        start: near it.
        level: more about the vertical.

    Returns:
        None where nothing determines it.
    """
    weight = np.where(is_used[:, None], sigma**-2.0, 0.0)
    total = weight.sum(1)
    origin = (total[:, None] * centers).sum(0) / total.sum()
    rotation, scale, mean = start.rotation, start.scale, start.apply(origin[None])[0]
    known = np.where(weight > 0, places, 0.0)
    for _ in range(_MAX_ROUNDS):
        turned = scale * (centers - origin) @ rotation.T
        jacobian = np.zeros((len(centers), 3, 7))
        jacobian[:, :, :3] = -rigid3.skew(turned)
        jacobian[:, :, 3] = turned
        jacobian[:, :, 4:] = np.eye(3)
        residual = np.where(weight > 0, turned + mean - known, 0.0)
        information = np.einsum("nai,na,naj->ij", jacobian, weight, jacobian)
        gradient = np.einsum("nai,na,na->i", jacobian, weight, residual)
        # where no height is known nothing else holds the model
        information[6, 6] += UNKNOWN_M**-2
        gradient[6] += mean[2] * UNKNOWN_M**-2
        if level is not None:
            up = rotation @ level.up
            slope = -rigid3.skew(up[None])[0][:2] / level.sigma_rad
            information[:3, :3] += slope.T @ slope
            gradient[:3] += slope.T @ up[:2] / level.sigma_rad
        solved = newton_step(information, gradient)
        if solved is None:
            return None
        step, covariance, length = solved
        # a turn about the line that places lie on is open, and beyond this no small one
        turn = float(np.linalg.norm(step[:3]))
        step = step * min(1.0, _LONGEST_TURN_RAD / max(turn, 1e-300))
        rotation = rigid3.exp_so3(step[:3]) @ rotation
        scale *= float(np.exp(np.clip(step[3], -1.0, 1.0)))
        mean = mean + step[4:]
        if length < 1e-6:
            break
    leverage = np.einsum("nai,ij,naj->na", jacobian, covariance, jacobian) * weight
    return Similarity(rotation, scale, origin, mean, covariance, 1.0 - leverage)


def newton_step(information: Array, gradient: Array) -> tuple[Array, Array, float] | None:
    """The step (N,), the covariance (N, N) and the largest part of the step in units of what its unknown alone would be
    known to; None where the information does not determine the unknowns."""
    # a scale of its own for every unknown: metres, radians and shares
    root = np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information / np.outer(root, root)
    if np.linalg.cond(scaled) > 1e12:
        return None
    covariance = np.linalg.inv(scaled) / np.outer(root, root)
    step = -covariance @ gradient
    return step, covariance, float(np.abs(step * root).max())


def student(freedom: float) -> float:
    """By what a sigma from so many degrees of freedom is to be multiplied for 1.96 of it to hold 95 %.

    Quantile of Student's t over that of the normal distribution; Abramowitz and Stegun 26.7.5.
    """
    z = 1.959964
    return 1.0 + (z**2 + 1) / (4 * freedom) + (5 * z**4 + 16 * z**2 + 3) / (96 * freedom**2)


def closed_form(x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Similarities (k) of point sets (k, m, 3): rotations (k, 3, 3), scales (k,), shifts (k, 3). Umeyama 1991.

    Points on a line give one of the rotations that fit.
    """
    mean_x, mean_y = x.mean(1), y.mean(1)
    dx, dy = x - mean_x[:, None], y - mean_y[:, None]
    u, d, vt = np.linalg.svd(np.einsum("kni,knj->kij", dy, dx))
    sign = np.ones_like(d)
    sign[:, 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation = np.einsum("kij,kj,kjl->kil", u, sign, vt)
    scale = (d * sign).sum(1) / np.maximum((dx**2).sum((1, 2)), 1e-300)
    shift = mean_y - scale[:, None] * np.einsum("kij,kj->ki", rotation, mean_x)
    return rotation, scale, shift
