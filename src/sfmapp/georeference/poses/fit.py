"""The similarity that brings a model to known poses of its cameras, and the poses that do not fit.

Each pose tells the rotation alone; two tell scale and place as well. Residuals of a pose are six numbers: the place of
the camera minus the known one, in the world, and the rotation vector from the known rotation to that of the camera.
Their covariance is that of the known pose, and of the camera's place in a model that photographs alone have made.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from sfmapp.geometry import rigid3, similarity
from sfmapp.georeference.fit import newton_step, student

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Six numbers of a pose: one right one in a thousand is beyond.
MAX_POSE_CHI2 = float(chi2.isf(1e-3, 6))
# median length of three normal numbers, in standard deviations
_MEDIAN_LENGTH = float(np.sqrt(chi2.median(3)))
# Two poses are a similarity; five more numbers than unknowns begin to tell a wrong one from right ones.
MIN_REDUNDANT_POSES = 4
# Where too few poses say how good they are, and nobody else: a place to a hundredth of the extent, a turn to a degree.
_GUESS_SHARE, _GUESS_RAD = 0.01, float(np.radians(1.0))
# No pose is better than this: of the extent, and in radians. Files give six digits.
_LEAST_SHARE, _LEAST_RAD = 1e-6, 1e-6
_MAX_ROUNDS = 20
# groups of the six numbers with a sigma of their own
GROUPS = (slice(0, 3), slice(3, 6))


class KnownPoses(NamedTuple):
    """Known poses of images (m,), cam_from_world (m, 7) in their own frame.

    ``sigma`` (2,): of a place along each axis, in its unit, and of a rotation about each axis, radians, as stated or
    guessed; ``is_stated`` (2,).
    """

    image_idx: NDArray[np.int64]
    cam_from_world: Array
    sigma: Array
    is_stated: Mask


def known_poses(
    image_idx: NDArray[np.int64], cam_from_world: Array, sigma: float | None, sigma_rad: float | None
) -> KnownPoses:
    """Known poses with sigmas as stated, or with such to begin with."""
    least = _least(cam_from_world)
    guess = np.array([_GUESS_SHARE * rigid3.spread(cam_from_world), _GUESS_RAD])
    stated = np.array([np.nan if sigma is None else sigma, np.nan if sigma_rad is None else sigma_rad])
    is_stated = np.isfinite(stated)
    return KnownPoses(image_idx, cam_from_world, np.maximum(np.where(is_stated, stated, guess), least), is_stated)


@dataclass(frozen=True)
class PoseFit:
    """A similarity, and the poses (m,) that agree with it.

    Attributes:
        world_from_model: (8,); covariance: (7, 7) of rotation (radians, on the left), log scale and the mean place.
        is_inlier: (m,) bool.
        residual: (m, 6).
        sigma: (2,) of known places along each axis and of rotations about each axis, as found.
        squares: (m,) of normalised residuals: 6 on average for right poses.
        own: (m, 6, 6) covariances of the model's own poses; zeros where they are not known.
    """

    world_from_model: Array
    covariance: Array
    is_inlier: Mask
    residual: Array
    sigma: Array
    squares: Array
    own: Array


def pose_residuals(cam_from_world: Array, known: Array) -> Array:
    """(m, 6) of poses (m, 7) against known ones (m, 7)."""
    turn = rigid3.rotation_matrix(known).transpose(0, 2, 1) @ rigid3.rotation_matrix(cam_from_world)
    return np.concatenate([rigid3.center(cam_from_world) - rigid3.center(known), rigid3.log_so3(turn)], 1)


def robust_pose_fit(cam_from_model: Array, known: KnownPoses, own: Array | None = None) -> PoseFit | None:
    """The similarity that most known poses agree with; it begins with the centres alone
    (:func:`~sfmapp.geometry.similarity.align_poses_robust`).

    Sigmas of known poses are those that were stated, unless the residuals refute them, else those that the residuals
    show beside the model's own errors.

    Args:
        cam_from_model: (m, 7) of the images of ``known``.
        own: (m, 6, 6) covariances of these, in the order of residuals and in the unit of the known poses; None where
            they are not known: they are then taken for a part of the errors of known poses.

    Returns:
        None where poses determine no similarity: fewer than two, or all in one place.
    """
    num = len(known.image_idx)
    own = np.zeros((num, 6, 6)) if own is None else own
    variance = np.diagonal(own, axis1=1, axis2=2)
    try:
        world_from_model = similarity.align_poses_robust(cam_from_model, known.cam_from_world).b_from_a
    except ValueError:
        return None
    is_redundant = num >= MIN_REDUNDANT_POSES
    residual = pose_residuals(similarity.transform_poses(world_from_model, cam_from_model), known.cam_from_world)
    sigma = _robust_sigmas(residual, known) if is_redundant else known.sigma
    is_inlier = np.ones(num, bool)
    for n in range(_MAX_ROUNDS):
        previous, old = is_inlier, sigma
        squares = _squares(residual, own, sigma)
        is_inlier = squares <= MAX_POSE_CHI2 if is_redundant else np.ones(num, bool)
        total = np.sqrt(variance + np.repeat(sigma, 3) ** 2)
        found = _fit(cam_from_model, known.cam_from_world, total, is_inlier, world_from_model)
        if found is None:
            return None
        world_from_model, covariance, residual, redundancy = found
        # until the set of inliers is about right only the robust scale is safe
        if is_redundant and n:
            sigma = _sigmas(residual[is_inlier], redundancy[is_inlier], variance[is_inlier], known)
        if n > 1 and np.array_equal(previous, is_inlier) and np.allclose(old, sigma, rtol=1e-3):
            break
    squares = _squares(residual, own, sigma)
    is_inlier = squares <= MAX_POSE_CHI2 if is_redundant else np.ones(num, bool)
    return PoseFit(world_from_model, covariance, is_inlier, residual, sigma, squares, own)


def _squares(residual: Array, own: Array, sigma: Array) -> Array:
    """(m,) squared normalised residuals (m, 6)."""
    total = own + np.diag(np.repeat(sigma, 3) ** 2)
    squares: Array = np.einsum("ni,ni->n", residual, np.linalg.solve(total, residual[:, :, None])[:, :, 0])
    return squares


def _sigmas(residual: Array, redundancy: Array, variance: Array, known: KnownPoses) -> Array:
    """(2,) sigmas of known poses by which residuals (m, 6) are what they should be beside the model's own variances."""
    found = known.sigma.copy()
    for k, group in enumerate(GROUPS):
        squares, own = residual[:, group] ** 2, variance[:, group]
        freedom = float(redundancy[:, group].sum())
        if freedom < 3.0:
            continue

        def ratio(sigma: float, squares: Array = squares, own: Array = own, freedom: float = freedom) -> float:
            return float((squares / (sigma**2 + own)).sum()) / freedom

        # within three standard deviations of the mean of chi square, what was stated stands
        stated = max(ratio(float(known.sigma[k])), 1e-300)
        if known.is_stated[k] and abs(np.log(stated)) <= 3.0 * np.sqrt(2.0 / freedom):
            continue
        low, high = 0.0, float(np.sqrt(squares.sum() / freedom))  # at which the ratio is one or less
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if ratio(middle) > 1.0 else (low, middle)
        # what residuals cannot tell from nothing beside the model's own errors
        unseen = float(np.sqrt(own.mean() * np.sqrt(2.0 / freedom)))
        found[k] = max(high * student(freedom), unseen)
    bounded: Array = np.maximum(found, _least(known.cam_from_world))
    return bounded


def _fit(
    cam_from_model: Array, known: Array, sigma: Array, is_used: Mask, start: Array
) -> tuple[Array, Array, Array, Array] | None:
    """Maximum-likelihood similarity by Gauss-Newton steps, covariance (7, 7), residuals and redundancy (m, 6)."""
    if is_used.sum() < 2:
        return None
    weight = np.where(is_used[:, None], sigma**-2.0, 0.0)
    world_from_model = start
    for _ in range(_MAX_ROUNDS):
        poses = similarity.transform_poses(world_from_model, cam_from_model)
        centers, residual = rigid3.center(poses), pose_residuals(poses, known)
        origin = (weight[:, :1] * centers).sum(0) / weight[:, 0].sum()
        arm = centers - origin
        jacobian = np.zeros((len(poses), 6, 7))
        jacobian[:, :3, :3], jacobian[:, :3, 3], jacobian[:, :3, 4:] = -rigid3.skew(arm), arm, np.eye(3)
        jacobian[:, 3:, :3] = -np.eye(3)  # residuals turn cam_from_world, the step world_from_cam
        information = np.einsum("nai,na,naj->ij", jacobian, weight, jacobian)
        gradient = np.einsum("nai,na,na->i", jacobian, weight, residual)
        solved = newton_step(information, gradient)
        if solved is None:
            return None
        step, covariance, length = solved
        growth = float(np.exp(np.clip(step[3], -1.0, 1.0)))
        turn = rigid3.exp_so3(step[:3])
        moved = similarity.from_parts(turn, origin + step[4:] - growth * turn @ origin, growth)
        world_from_model = similarity.compose(moved, world_from_model)
        if length < 1e-6:
            break
    poses = similarity.transform_poses(world_from_model, cam_from_model)
    leverage = np.einsum("nai,ij,naj->na", jacobian, covariance, jacobian) * weight
    return world_from_model, covariance, pose_residuals(poses, known), 1.0 - leverage


def _robust_sigmas(residual: Array, known: KnownPoses) -> Array:
    """(2,) sigmas by the median lengths of residuals (m, 6), with the correction for few values of Rousseeuw and Leroy
    1987, page 202."""
    lengths = [np.median(np.linalg.norm(residual[:, group], axis=1)) for group in GROUPS]
    few = 1.0 + 5.0 / max(len(residual) - 2, 1)
    return np.maximum(few * np.array(lengths) / _MEDIAN_LENGTH, _least(known.cam_from_world))


def _least(cam_from_world: Array) -> Array:
    """(2,) no file is better."""
    return np.array([_LEAST_SHARE * rigid3.spread(cam_from_world), _LEAST_RAD])
