"""What reprojections alone leave open: where the whole is, how it is turned, and how large it is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.problem import Problem
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]


def similarity_motions(poses: Array, middle: Array, size: float) -> Array:
    """(7, I, 6) what infinitesimal similarities of the world do to poses (I, 7): turns and scale about a middle (3,),
    between them shifts by a size."""
    rotation = rigid3.rotation_matrix(poses)
    from_middle = np.einsum("nij,j->ni", rotation, middle) + poses[:, 4:]
    motions = np.zeros((7, len(poses), 6))
    motions[:3, :, :3] = -rotation.transpose(2, 0, 1)
    motions[:3, :, 3:] = -(rigid3.skew(from_middle) @ rotation).transpose(2, 0, 1)
    motions[3:6, :, 3:] = -size * rotation.transpose(2, 0, 1)
    motions[6, :, 3:] = from_middle
    return motions


def similarity_basis(poses: Array) -> tuple[Array, Array]:
    """What infinitesimal similarities of the world do to poses (I, 7), and the constraint of the nearest one.

    Returns basis (7, I * 6), rows for turns, shifts and scale about the mean centre, all of the size of the scene, and
    constraint (7, I * 6), whose product with the errors vanishes in the gauge of inner constraints.
    """
    centers = rigid3.center(poses)
    mean = centers.mean(0)
    size = max(float(np.sqrt(((centers - mean) ** 2).sum(1).mean())), 1e-12)
    basis = similarity_motions(poses, mean, size)
    weight = np.repeat([size * size, 1.0], 3)
    return basis.reshape(7, -1), (basis * weight).reshape(7, -1)


def moves_into_gauge(basis: Array, constraint: Array) -> Array:
    """(k, N) how much of each freedom takes errors (N,) into the gauge of a constraint: they are there without
    ``basis.T @ (moves @ errors)``, as in inner constraints (Triggs et al., "Bundle Adjustment", 1999, section 9).

    Args:
        basis: (k, N) what the freedoms do. constraint: (k, N) rows whose products with errors vanish in the gauge.
    """
    return np.asarray(np.linalg.solve(constraint @ basis.T, constraint), np.float64)


class StepsInGauge:
    """Takes out of steps what a similarity of the whole would do as well: of all steps that come to the same, a damped
    system has the shortest in the metric of its damping."""

    def __init__(self, problem: Problem, num_freedoms: int, diagonal: Array) -> None:
        """num_freedoms: 7, 6 with a baseline, 0 where something holds the whole. diagonal: (B * 8,) of the damping."""
        poses = problem.poses[problem.pose_block >= 0]
        place = (problem.pose_block[problem.pose_block >= 0][:, None] * 8 + np.arange(6)).ravel()
        self._basis = np.zeros((num_freedoms, len(diagonal)))
        if num_freedoms:
            self._basis[:, place] = similarity_basis(poses)[0][:num_freedoms]
        self._weighted = self._basis * diagonal
        self._inverse = np.linalg.inv(self._weighted @ self._basis.T)

    def of(self, step: Array) -> Array:
        """The shortest (B * 8,) that comes to the same."""
        shortest: Array = step - (self._inverse @ (self._weighted @ step)) @ self._basis
        return shortest

    def of_gradient(self, gradient: Array) -> Array:
        """What a gradient (B * 8,) says of such steps."""
        shown: Array = gradient - (self._inverse @ (self._basis @ gradient)) @ self._weighted
        return shown
