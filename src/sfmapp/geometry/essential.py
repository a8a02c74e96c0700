"""Essential matrices and what is known of them: from F, by five points, and the relative pose with its covariance.

``x2^T E x1 = 0`` of normalised image points, E = [t]x R up to scale, in the conventions of
:mod:`sfmapp.geometry.epipolar`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry import five_point, rigid3
from sfmapp.geometry.dlt import homogeneous
from sfmapp.geometry.epipolar import (
    choose_in_front,
    decompose_essential,
    essential_from_pose,
    nearest_essential,
    sampson_errors,
)
from sfmapp.geometry.fit import FitInfo, inverse_or_none, matched_points
from sfmapp.geometry.fundamental import sampson_jacobian
from sfmapp.geometry.relative_pose import refine_relative_pose

Array = NDArray[np.float64]


def essential_of_cameras(fundamental: Array, k1: Array, k2: Array) -> tuple[Array, FitInfo]:
    """E nearest to ``K2^T F K1``, and the singular values that this has: (s, s, 0) where F and the cameras fit.

    The literature that writes ``x1^T F x2 = 0`` has ``E = K1^T F K2``: all of it transposed. ``condition`` is the first
    singular value over the second, which is 1 where the calibration is right and F exact.
    """
    product = k2.T @ fundamental @ k1
    values: Array = np.asarray(np.linalg.svd(product, compute_uv=False), np.float64)
    values /= max(float(values[0]), 1e-300)
    info = FitInfo(np.zeros(0, np.bool_), 1, float(1.0 / max(values[1], 1e-300)), values, 1)
    return nearest_essential(product), info


def find_essential(
    xn1: ArrayLike, xn2: ArrayLike, threshold: float, *, max_trials: int = 2000, seed: int = 0
) -> tuple[Array, FitInfo]:
    """E by RANSAC over samples of five (Nister, PAMI 2004), refined on its inliers.

    Args:
        xn1, xn2: (N, 2) normalised image points of matches, N >= 8: with fewer, what five allow cannot be told apart.
        threshold: Sampson distance of an inlier in normalised units: pixels over focal length.

    Returns:
        E (3, 3) of unit norm, NaN where no sample has a solution; ``sigma_px`` in normalised units, the (9, 9)
        covariance of its entries, of rank five, and ``num_iterations``, the most samples that may have been drawn.

    Raises:
        ValueError: fewer than eight points, or some that are not finite.
    """
    a, b = matched_points(xn1, xn2, 8, "the search for an essential matrix")
    rays = [homogeneous(x) / np.linalg.norm(homogeneous(x), axis=1, keepdims=True) for x in (a, b)]
    found = five_point.find_essential(rays[0], rays[1], threshold, max_trials, seed)
    if found is None:
        return np.full((3, 3), np.nan), FitInfo(np.zeros(len(a), np.bool_), max_trials, math.nan, np.zeros(0), 0)
    inlier = sampson_errors(found, a, b) < threshold**2
    if inlier.sum() < 8:
        return found, FitInfo(inlier, max_trials, math.nan, np.zeros(0), 1)
    start, _, _ = choose_in_front(decompose_essential(found), a[inlier], b[inlier])
    pose = refine_relative_pose(start, a[inlier], b[inlier], threshold)
    e = essential_from_pose(pose)
    inlier = sampson_errors(e, a, b) < threshold**2
    # five numbers are fitted, and an inlier has one equation
    noise = math.sqrt(float(sampson_errors(e, a[inlier], b[inlier]).sum()) / max(int(inlier.sum()) - 5, 1))
    of_pose = pose_covariance(pose, a[inlier], b[inlier], noise)
    by_step = pose_slopes(pose)[1:].reshape(5, 9).T / math.sqrt(2.0)
    covariance = None if of_pose is None else by_step @ of_pose @ by_step.T
    return e, FitInfo(inlier, max_trials, math.nan, np.zeros(0), 1, noise, covariance)


def pose_slopes(cam2_from_cam1: Array) -> Array:
    """(6, 3, 3) E = [t]x R, and its derivatives by a turn of R on the left and by t (unit) along :func:`tangent`."""
    rotation, t = rigid3.rotation_matrix(cam2_from_cam1), cam2_from_cam1[4:]
    e = rigid3.skew(t) @ rotation
    turns = [rigid3.skew(t) @ rigid3.skew(axis) @ rotation for axis in np.eye(3)]
    shifts = [rigid3.skew(axis) @ rotation for axis in tangent(t)]
    return np.stack([e, *turns, *shifts])


def tangent(t: Array) -> Array:
    """(2, 3) orthonormal directions in which a unit vector can move."""
    basis: Array = np.linalg.svd(t.reshape(1, 3))[2][1:]
    return basis


def moved_pose(cam2_from_cam1: Array, step: Array) -> Array:
    """The pose (7,) with unit translation a step (5,) further: a turn on the left, and t along :func:`tangent`."""
    t = cam2_from_cam1[4:] + step[3:] @ tangent(cam2_from_cam1[4:])
    return rigid3.from_matrix(rigid3.exp_so3(step[:3]) @ rigid3.rotation_matrix(cam2_from_cam1), t / np.linalg.norm(t))


def pose_covariance(cam2_from_cam1: Array, xn1: Array, xn2: Array, noise: float) -> Array | None:
    """(5, 5) covariance of a relative pose at the least Sampson error, in the steps of :func:`moved_pose`; None where
    the points leave the pose open.

    Args:
        cam2_from_cam1: (7,) with unit translation. xn1, xn2: (N, 2) normalised image points of inliers.
        noise: standard deviation of one of their coordinates.
    """
    slopes = pose_slopes(cam2_from_cam1)
    _, jacobian = sampson_jacobian(slopes[0], slopes[1:], xn1, xn2)
    cofactor = inverse_or_none(jacobian.T @ jacobian)
    return None if cofactor is None else noise**2 * cofactor


def refine_pose(cam2_from_cam1: Array, xn1: Array, xn2: Array, noise: float) -> tuple[Array, float, Array | None]:
    """The relative pose (7,) of least Sampson error of inliers, that error summed over squares, and its covariance."""
    # beyond three sigmas a point counts less: among inliers that is a wrong match in two hundred
    pose = refine_relative_pose(cam2_from_cam1, xn1, xn2, 3.0 * noise)
    left = sampson_errors(pose_slopes(pose)[0], xn1, xn2)
    return pose, float(left.sum()), pose_covariance(pose, xn1, xn2, noise)
