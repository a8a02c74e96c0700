"""The pose of a camera from points with known positions: RANSAC over P3P, with the focal length searched if unknown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import p3p, pnp, rigid3
from sfmapp.geometry.dlt import homogeneous

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Resection:
    """A pose and the correspondences that agree with it.

    Attributes:
        cam_from_world: (7,) float64.
        is_inlier: (N,) bool.
        focal_scale: factor on the focal length that the normalised points were made with; 1 unless it was searched.
    """

    cam_from_world: Array
    is_inlier: NDArray[np.bool_]
    focal_scale: float = 1.0

    @property
    def num_inliers(self) -> int:
        return int(self.is_inlier.sum())


# Samples end where a pose that enough agree with would have been drawn: with so much less, as the last step of OpenCV's
# loop, EPnP over the inliers, gains some; and never before so many samples, of which some are degenerate.
_BEFORE_REFINED, _LEAST_SAMPLES = 0.9, 100
# Points of a sample of OpenCV's loop, which tells four poses of three apart by a fourth.
_SAMPLE_SIZE = 4
# A pose of all inliers that fewer of them agree with than this share of a sample's is no refinement of it.
_LEAST_KEPT = 0.8

PoseMethod = Literal["p3p", "all"]
"""``p3p``: RANSAC over three points, for correspondences of which many may be wrong; ``all``: every point at once, with
three points or more of which none is wrong (:mod:`sfmapp.geometry.pnp`)."""


def estimate_pose(
    xyz: Array, normalized: Array, max_error: float, *, confidence: float = 0.9999, max_iterations: int = 10_000,
    min_inliers: int = 4, method: PoseMethod = "p3p",
) -> Resection | None:  # fmt: skip
    """Pose from 3D-2D correspondences by RANSAC over P3P (Fischler and Bolles, CACM 1981; OpenCV's loop), or from all.

    The result is the same at every call: OpenCV's loop starts from a fixed seed.

    Args:
        xyz: (N, 3) float64 points in the world.
        normalized: (N, 2) float64 undistorted image points X/Z, Y/Z, or (N, 3) unit rays in any direction; NaN where
            the lens has no inverse.
        max_error: largest distance of an inlier in the normalised image plane, or on the unit sphere.
        confidence: wanted probability that one all-inlier sample was drawn.
        max_iterations: bound on the number of samples.
        min_inliers: a pose that fewer agree with is of no use, and need not be found. It does not change one that more
            agree with: that many samples would have been drawn for it.
        method: whether some of the points may be wrong.

    Returns:
        The pose with at least four inliers in front of the camera (along their rays), or None.
    """
    if method == "all":
        return _pose_of_all(xyz, normalized, max_error)
    import cv2

    valid = np.flatnonzero(~np.isnan(normalized[:, 0]))
    if len(valid) < 4:
        return None
    max_iterations = min(max_iterations, _enough_samples(min_inliers / len(valid), confidence))
    if normalized.shape[1] == 3:
        pose = p3p.find_pose(xyz[valid], normalized[valid], max_error, confidence, max_iterations)
        if pose is None:
            return None
        is_inlier = p3p.squared_errors(pose, xyz, normalized) <= max_error**2  # False for NaN
        return Resection(pose, is_inlier) if is_inlier.sum() >= 4 else None
    try:
        found, rotation_vector, translation, sampled = cv2.solvePnPRansac(
            np.ascontiguousarray(xyz[valid]), np.ascontiguousarray(normalized[valid]), np.eye(3), None,
            flags=cv2.SOLVEPNP_P3P, reprojectionError=max_error, confidence=confidence, iterationsCount=max_iterations,
        )  # fmt: skip
    except cv2.error:  # degenerate samples only, such as points on a line
        return None
    if not found or not (np.isfinite(rotation_vector).all() and np.isfinite(translation).all()):
        return None
    pose = rigid3.from_matrix(rigid3.exp_so3(rotation_vector.ravel()), translation.ravel())
    in_camera = rigid3.apply(pose, xyz)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.linalg.norm(in_camera[:, :2] / in_camera[:, 2:] - normalized, axis=1)
    is_inlier = (in_camera[:, 2] > 0) & (error <= max_error)  # False for NaN
    if is_inlier.sum() < _LEAST_KEPT * len(sampled):  # the loop ends in EPnP over its inliers, which can lose a plane
        return estimate_pose(
            xyz, _rays(normalized), max_error, confidence=confidence, max_iterations=max_iterations,
            min_inliers=min_inliers,
        )  # fmt: skip
    return Resection(pose, is_inlier) if is_inlier.sum() >= 4 else None


def _enough_samples(share: float, confidence: float) -> int:
    """How many samples hold one of inliers alone with the given confidence, where so large a share of all agrees."""
    of_inliers = min(_BEFORE_REFINED * share, 1.0 - 1e-9) ** _SAMPLE_SIZE
    return max(_LEAST_SAMPLES, int(np.ceil(np.log(1.0 - confidence) / np.log1p(-of_inliers))))


def _rays(normalized: Array) -> Array:
    """(N, 3) unit rays of points (N, 2) of the normalised image plane, or of rays."""
    rays = normalized if normalized.shape[1] == 3 else homogeneous(normalized)
    unit: Array = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return unit


def _pose_of_all(xyz: Array, normalized: Array, max_error: float) -> Resection | None:
    valid = ~np.isnan(normalized[:, 0])
    if valid.sum() < 4:
        return None
    rays = _rays(normalized)
    poses = pnp.poses_of_points(xyz[valid], rays[valid])
    if not len(poses):
        return None
    is_inlier = p3p.squared_errors(poses[0], xyz, rays) <= max_error**2  # False for NaN
    return Resection(poses[0], is_inlier) if is_inlier.sum() >= 4 else None


def estimate_pose_and_focal(xyz: Array, normalized: Array, max_error: float, focal_scales: Array) -> Resection | None:
    """Pose and focal length: :func:`estimate_pose` over a grid of focal lengths, the one with most inliers wins.

    The lens distortion is taken as small: scaling the focal scales the normalised points.

    Args:
        xyz, normalized, max_error: as in :func:`estimate_pose`, made with a focal length f0.
        focal_scales: (K,) factors on f0 to try, the most plausible first; ties go to the earlier one, and the search
            ends at one that four fifths of the points agree with.
    """
    best: Resection | None = None
    for scale in focal_scales:
        found = estimate_pose(xyz, normalized / scale, max_error / scale, confidence=0.99, max_iterations=1000)
        if found is not None and (best is None or found.num_inliers > best.num_inliers):
            best = Resection(found.cam_from_world, found.is_inlier, float(scale))
            if found.num_inliers >= 0.8 * len(xyz):
                break
    return best
