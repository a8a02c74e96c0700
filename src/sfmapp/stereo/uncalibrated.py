"""A pair of photographs of which no camera is known, made into a rig by its matches alone.

F has seven numbers. Two pinholes with square pixels and their principal points in the middle, a pose up to scale and a
focal length each have seven as well, so that any F whose cameras are near such ones is met exactly, and the rotations
that rectify them distort little: the quasi-Euclidean rectification of Fusiello and Irsara (Machine Vision and
Applications 2011), with two focal lengths for their one. These are what makes the least distortion, held near common
ones where matches do not tell them; depths remain projective.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, simple_camera
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError
from sfmapp.geometry import epipolar, rigid3
from sfmapp.geometry.dlt import homogeneous
from sfmapp.geometry.epipolar import sampson_errors
from sfmapp.geometry.fit import CAUCHY_SIGMAS, cauchy, minimize, robust_sigma
from sfmapp.geometry.fundamental import sampson_jacobian
from sfmapp.geometry.fundamental_refinement import polish_fundamental
from sfmapp.matching.search import (
    Ransac,
    find_fundamental,
    find_homography,
    is_significant,
)
from sfmapp.scene.rig import Rig
from sfmapp.stereo.sparse_matches import PairMatches

Array = NDArray[np.float64]
Size = tuple[int, int]

_TRIALS, _SEEDS, _ROUNDS = 2000, (0, 1, 2), 50
# of an inlier of F, at a picture of 2,000 pixels across; and the least
_THRESHOLD_SHARE, _LEAST_THRESHOLD_PX = 1.5 / 2000.0, 1.0
# focal lengths that are tried, in longer sides: from wide lenses to portraits; e-fold by which they may be off, and by
# which those of two cameras differ
_FOCALS, _FOCAL_SIGMA, _RATIO_SIGMA = (0.6, 0.9, 1.4, 2.2), 0.7, 0.2
# inliers that seven numbers are asked to rest on; share of them that a homography may explain before F is open
_LEAST_INLIERS, _PLANE_SHARE = 30, 0.9


@dataclass(frozen=True)
class UncalibratedRig:
    """What matches tell of a pair.

    Attributes:
        rig: two pinholes and the pose of the second, for a baseline of one. is_inlier: (N,) bool of the matches.
        rms_px: Sampson distance of inliers.
    """

    rig: Rig
    is_inlier: NDArray[np.bool_]
    rms_px: float


def rig_from_matches(matches: PairMatches, sizes: tuple[Size, Size]) -> UncalibratedRig:
    """Two cameras that see matches as they are seen.

    Args:
        matches: of the photographs as they were taken, right and wrong ones.
        sizes: width and height of both.

    Raises:
        InputError: too little is found in both, or all of it lies on one plane or at infinity.
    """
    fundamental, inlier, threshold = _fundamental(matches, sizes)
    left, right = matches.left[inlier], matches.right[inlier]
    homography = find_homography(left, right, threshold, Ransac(_TRIALS, _SEEDS[0]))
    if homography is not None:
        moved = homogeneous(left) @ homography.T
        off = np.hypot(*(moved[:, :2] / moved[:, 2:] - right).T)
        if (off < 2.0 * threshold).mean() > _PLANE_SHARE:
            raise InputError(
                "all that is found in both photographs lies on one plane, or the camera turned on the spot: matches do "
                "not tell how to rectify them",
                "give --camera with the calibration of both cameras",
            )
    found = [_fitted(fundamental, left, right, sizes, share) for share in _FOCALS]
    _, numbers, start = min(found, key=lambda one: one[0])
    rig = _rig(numbers, start, sizes, (left, right))
    squared = sampson_errors(_matrix(numbers, start, sizes), left, right)
    return UncalibratedRig(rig, inlier, float(np.sqrt(squared.mean())))


def _fundamental(matches: PairMatches, sizes: tuple[Size, Size]) -> tuple[Array, NDArray[np.bool_], float]:
    """The F of most inliers over some seeds, the inliers, and their threshold."""
    threshold = max(_THRESHOLD_SHARE * math.hypot(*sizes[0]), _LEAST_THRESHOLD_PX)
    best: tuple[Array, NDArray[np.bool_]] | None = None
    for seed in _SEEDS if len(matches) >= _LEAST_INLIERS else ():
        f = find_fundamental(matches.left, matches.right, threshold, Ransac(_TRIALS, seed))
        if f is None:
            continue
        f, inlier = polish_fundamental(f, matches.left, matches.right, threshold, seed)
        if best is None or inlier.sum() > best[1].sum():
            best = f, inlier
    if best is None or best[1].sum() < _LEAST_INLIERS or not is_significant(best[1], threshold, sizes[1]):
        count = 0 if best is None else int(best[1].sum())
        raise InputError(
            f"expected two photographs of one scene, found {count} of {len(matches)} matches that fit together",
            "give photographs that overlap and show texture, or --camera with the calibration of both cameras",
        )
    return best[0], best[1], threshold


def _k_matrix(size: Size, log_focal: float) -> Array:
    focal = math.exp(log_focal)
    return np.array([[focal, 0.0, 0.5 * size[0]], [0.0, focal, 0.5 * size[1]], [0.0, 0.0, 1.0]])


def _pose(numbers: Array, start: Array) -> tuple[Array, Array]:
    """Rotation and unit translation of the second camera, some turn (3,) and shift (3,) from a start (7,)."""
    t = start[4:] + numbers[3:6]
    return rigid3.exp_so3(numbers[:3]) @ rigid3.rotation_matrix(start), t / np.linalg.norm(t)


def _matrix(numbers: Array, start: Array, sizes: tuple[Size, Size]) -> Array:
    """F of turn, shift and two logarithms of focal lengths (8,)."""
    rotation, t = _pose(numbers, start)
    k1, k2 = (_k_matrix(size, value) for size, value in zip(sizes, numbers[6:], strict=True))
    return epipolar.fundamental_from_essential(rigid3.skew(t) @ rotation, k1, k2)


def _fitted(
    fundamental: Array, left: Array, right: Array, sizes: tuple[Size, Size], share: float
) -> tuple[float, Array, Array]:
    """Cost, numbers (8,) and the pose that they begin from, of the cameras of least Sampson error near focal lengths of
    so many longer sides."""
    logs = np.log([share * max(size) for size in sizes])
    k1, k2 = (_k_matrix(size, value) for size, value in zip(sizes, logs, strict=True))
    poses = epipolar.decompose_essential(epipolar.essential_from_fundamental(fundamental, k1, k2))
    xn = [(xy - k[:2, 2]) / k[0, 0] for xy, k in ((left, k1), (right, k2))]
    start, _, _ = epipolar.choose_in_front(poses, xn[0], xn[1])
    noise = max(robust_sigma(sampson_errors(fundamental, left, right), 1), 0.02)
    middle = np.log([1.2 * max(size) for size in sizes])

    def linearize(numbers: Array) -> tuple[float, Array, Array]:
        slopes = np.stack([
            (_matrix(numbers + step, start, sizes) - _matrix(numbers - step, start, sizes)) / 2e-6
            for step in 1e-6 * np.eye(8)
        ])  # fmt: skip
        residual, jacobian = sampson_jacobian(_matrix(numbers, start, sizes), slopes, left, right)
        cost, weights = cauchy(residual**2 / noise**2, CAUCHY_SIGMAS)
        weighted = jacobian * (weights / noise**2)[:, None]
        gap, away = numbers[6] - numbers[7] - (middle[0] - middle[1]), numbers[6:].mean() - middle.mean()
        prior = np.zeros((2, 8))
        prior[0, 6:], prior[1, 6:] = (1.0 / _RATIO_SIGMA, -1.0 / _RATIO_SIGMA), 0.5 / _FOCAL_SIGMA
        off = np.array([gap / _RATIO_SIGMA, away / _FOCAL_SIGMA])
        # the length of the shift is free: it is held where it is
        along = np.zeros(8)
        along[3:6] = _pose(numbers, start)[1]
        hessian = weighted.T @ jacobian + prior.T @ prior + 1e6 * np.outer(along, along)
        return cost + float(off @ off), hessian, weighted.T @ residual + prior.T @ off

    numbers, _, _ = minimize(
        np.concatenate([np.zeros(6), logs]), linearize, lambda at, step: np.asarray(at + step), _ROUNDS
    )
    return linearize(numbers)[0], numbers, start


def _rig(numbers: Array, start: Array, sizes: tuple[Size, Size], ends: tuple[Array, Array]) -> Rig:
    """The two cameras; which of them is to the left is told by what is in front of both."""
    rotation, t = _pose(numbers, start)
    xn = [
        (xy - 0.5 * np.array(size)) / math.exp(value) for xy, size, value in zip(ends, sizes, numbers[6:], strict=True)
    ]
    second, _, _ = epipolar.choose_in_front(rigid3.from_matrix(np.stack([rotation] * 2), np.stack([t, -t])), *xn)
    cameras: tuple[Camera, ...] = tuple(
        simple_camera(CameraModel.SIMPLE_PINHOLE, *size, math.exp(value))
        for size, value in zip(sizes, numbers[6:], strict=True)
    )
    return Rig(cameras, np.array([rigid3.IDENTITY, second]))
