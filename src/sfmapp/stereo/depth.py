"""From disparities, or from pixels of two cameras as they stand, to depth and points."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.camera.camera import Camera, pixels_to_normalized
from sfmapp.errors import UsageError
from sfmapp.geometry import rigid3
from sfmapp.geometry.two_rays import Method, PointsInfo, triangulate_pair
from sfmapp.stereo.result import RectifiedGeometry

Array = NDArray[np.float64]
Map = NDArray[np.float32]


def depth_of_disparity(disparity: ArrayLike, geometry: RectifiedGeometry) -> Map:
    """Depth along the optical axis of the rectified cameras, Z = f B / (d + doffs).

    Args:
        disparity: of any shape, pixels, NaN where unknown.

    Returns:
        The same shape, float32, in the unit of the baseline; NaN where the disparity is unknown or says that the point
        is at infinity or beyond it.

    Raises:
        UsageError: the geometry has no baseline.
    """
    from_infinity = _from_infinity(disparity, geometry)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = geometry.focal * baseline_of(geometry) / from_infinity
    return np.asarray(np.where(from_infinity > 0.0, depth, np.nan), np.float32)


def disparity_of_depth(depth: ArrayLike, geometry: RectifiedGeometry) -> Map:
    """The inverse of :func:`depth_of_disparity`; NaN where the depth is not above zero."""
    z = np.asarray(depth, np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        disparity = geometry.focal * baseline_of(geometry) / z - geometry.doffs
    return np.asarray(np.where(z > 0.0, disparity, np.nan), np.float32)


def points_of_depth(depth: Map, geometry: RectifiedGeometry) -> Map:
    """Points (H, W, 3) float32 of a depth map (H, W), in the frame of the rectified left camera: x right, y down, z
    forward; NaN where the depth is."""
    height, width = depth.shape
    x = (np.arange(width, dtype=np.float32) + 0.5 - geometry.cx) / geometry.focal
    y = (np.arange(height, dtype=np.float32) + 0.5 - geometry.cy) / geometry.focal
    points = np.empty((height, width, 3), np.float32)
    np.multiply(depth, x, out=points[:, :, 0], casting="same_kind")
    np.multiply(depth, y[:, None], out=points[:, :, 1], casting="same_kind")
    points[:, :, 2] = depth
    return points


def points_of_rays(
    cameras: tuple[Camera, Camera], right_from_left: ArrayLike, xy_left: ArrayLike, xy_right: ArrayLike,
    method: Method = "nonlinear", noise_px: float | None = None,
) -> tuple[Array, PointsInfo]:  # fmt: skip
    """Points of matched pixels of two calibrated photographs that nobody has rectified: of any lens but those that see
    behind themselves, of axes that converge or not.

    Args:
        cameras: left and right, intrinsics with their lens.
        right_from_left: (7,) pose of the right camera.
        xy_left, xy_right: (N, 2) corresponding pixels of the photographs.
        method: as in :func:`~sfmapp.geometry.two_rays.triangulate_pair`.
        noise_px: standard deviation of a coordinate, for the covariance; taken to the rays by the mean focal length.

    Returns:
        (N, 3) in the frame of the left camera, and what is known of them.
    """
    seen = [pixels_to_normalized(camera, xy) for camera, xy in zip(cameras, (xy_left, xy_right), strict=True)]
    first = np.eye(3, 4)
    second = rigid3.to_matrix(right_from_left)
    focal = 0.5 * (cameras[0].focal + cameras[1].focal)
    noise = None if noise_px is None else noise_px / focal
    return triangulate_pair(first, second, seen[0], seen[1], method, noise)


def baseline_of(geometry: RectifiedGeometry) -> float:
    """Of a rig that has one. Raises UsageError without."""
    if geometry.baseline is None:
        raise UsageError(
            "expected a baseline, found none: disparities alone tell depth only up to a projective transformation",
            "give a rig file, or --baseline with its unit",
        )
    return geometry.baseline


def _from_infinity(disparity: ArrayLike, geometry: RectifiedGeometry) -> Array:
    shifted: Array = np.asarray(disparity, np.float64) + geometry.doffs
    return shifted
