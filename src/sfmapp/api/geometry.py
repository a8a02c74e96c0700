"""The parts: one bundle adjustment, one pose, one pair, some points."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.adjust import solver
from sfmapp.adjust.options import AdjustOptions, AdjustReport
from sfmapp.adjust.pose import refine_pose
from sfmapp.adjust.problem import Varying
from sfmapp.api.reconstruction import Reconstruction
from sfmapp.camera.camera import Camera, pixels_to_rays, project
from sfmapp.errors import InputError, NoReconstructionError
from sfmapp.events import Events
from sfmapp.geometry import resection, rigid3
from sfmapp.geometry.resection import PoseMethod
from sfmapp.geometry.rigid3 import Rigid3
from sfmapp.geometry.triangulation import Observed, triangulate_tracks
from sfmapp.matching import two_view
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.search import Ransac
from sfmapp.matching.two_view import TwoViewGeometry
from sfmapp.scene import reconstruction as arrays
from sfmapp.scene.tracks import make_tracks
from sfmapp.workspace.options import num_threads

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class PoseEstimate:
    """A pose and how well points hold it.

    Attributes:
        cam_from_world: the pose.
        is_inlier: (N,) bool, the correspondences that agree with it.
        covariance: (6, 6) over rotation (radians) and translation of ``x_cam <- exp(w) x_cam + v``, from the residuals
            of the inliers; infinite where they do not hold it.
        camera: what was given.
    """

    cam_from_world: Rigid3
    is_inlier: Bools
    covariance: Array
    camera: Camera


@dataclass(frozen=True)
class TriangulatedPoints:
    """Points that several views see.

    Attributes:
        xyz: (N, 3) world; NaN where the views do not agree on a point, or see it under too small an angle.
        is_inlier: (I, N) bool, the observations that support their point.
    """

    xyz: Array
    is_inlier: Bools


def adjust_bundle(
    reconstruction: arrays.Reconstruction,
    options: AdjustOptions | None = None,
    *,
    constant_images: Iterable[str | int] = (),
    constant_cameras: Iterable[int] = (),
    constant_points: ArrayLike | None = None,
    prior_cameras: Sequence[Camera] | None = None,
    events: Events | None = None,
    threads: int | None = None,
) -> AdjustReport:
    """Minimise the reprojection errors of the inlier observations over poses, intrinsics and points, in place.

    Without anything held constant the gauge is free: the result is the nearest of all that are equally good.

    Args:
        reconstruction: its poses, points and cameras are replaced; whatever is constant keeps its bits.
        options: the loss, which intrinsics are free, and when to stop.
        constant_images: names or positions of images whose poses stay.
        constant_cameras: positions of cameras whose intrinsics stay, beside those with ``is_fixed``.
        constant_points: (K,) ids of points that stay, or (T,) bool.
        prior_cameras: C cameras as they were known beforehand: Gaussian priors, ``focal_sigma`` for focal lengths, the
            options' sigmas for the rest. None: no priors.
        events: can ask to stop.
        threads: at most this many; None: as many as there are cores. The result does not depend on it.

    Returns:
        Costs, steps and counts.

    Raises:
        InputError: an image, camera or point that is not there.
        InterruptedRunError: on cancellation; the reconstruction then holds the best state so far.

    Example:
        >>> reconstruction = sfmapp.load("colmap/sparse/0")
        >>> report = sfmapp.adjust_bundle(reconstruction, constant_images=[0])
        >>> report.initial_cost, report.final_cost  # square pixels
    """
    named = Reconstruction.of(reconstruction)
    images = reconstruction.is_registered
    images[[named.image_position(name) for name in constant_images]] = False
    cameras = ~_mask(constant_cameras, len(reconstruction.cameras), "camera")
    held = None if constant_points is None else _mask(constant_points, reconstruction.tracks.num_tracks, "point")
    return solver.adjust_bundle(
        reconstruction, options or AdjustOptions(), varying=Varying(images, cameras, constant_points=held),
        prior_cameras=prior_cameras, threads=num_threads(threads), events=events,
    )  # fmt: skip


def triangulate(
    cam_from_world: Sequence[Rigid3] | Array,
    cameras: Camera | Sequence[Camera],
    xy: ArrayLike,
    *,
    max_error_px: float = 4.0,
    min_angle_deg: float = 1.5,
) -> TriangulatedPoints:
    """Triangulate points from their pixels in views with known poses.

    Every pair of views of a point proposes one; the proposal that most views agree with is refined over them.

    Args:
        cam_from_world: I poses, or (I, 7) quaternion x y z w and translation.
        cameras: one for all views, or I of them.
        xy: (I, N, 2) pixels of N points in the views; NaN where a view does not see a point.
        max_error_px: largest reprojection error of an observation that supports its point.
        min_angle_deg: smallest angle between the rays of an accepted point.

    Returns:
        Points, and which observations support them.

    Raises:
        InputError: shapes that do not fit each other.

    Example:
        >>> found = sfmapp.triangulate([pose1, pose2], camera, [xy1, xy2])
        >>> found.xyz[~numpy.isnan(found.xyz[:, 0])]
    """
    poses = np.array([np.asarray(pose, np.float64) for pose in cam_from_world]).reshape(-1, 7)
    pixels = np.asarray(xy, np.float64)
    lenses = [cameras] * len(poses) if isinstance(cameras, Camera) else list(cameras)
    if pixels.ndim != 3 or pixels.shape[0] != len(poses) or pixels.shape[2] != 2 or len(lenses) != len(poses):
        raise InputError(
            f"triangulate: expected a camera and pixels (I, N, 2) for each of {len(poses)} poses, found {len(lenses)} "
            f"cameras and {pixels.shape}"
        )
    view, point = np.nonzero(np.isfinite(pixels).all(axis=2))
    tracks = make_tracks(len(poses), pixels.shape[1], point, view, point, pixels[view, point])
    empty = arrays.Reconstruction.empty(
        lenses, [str(i) for i in range(len(poses))], np.arange(len(poses), dtype=np.int32), tracks
    )
    empty.cam_from_world[:] = poses
    triangulate_tracks(
        np.arange(tracks.num_tracks), Observed(tracks.track_ptr, tracks.obs_image_idx, tracks.obs_xy), empty.views(),
        max_error_px, math.radians(min_angle_deg), empty.point_xyz, empty.obs_is_inlier,
    )  # fmt: skip
    is_inlier = np.zeros(pixels.shape[:2], bool)
    is_inlier[tracks.obs_image_idx, tracks.obs_track_idx] = empty.obs_is_inlier
    return TriangulatedPoints(empty.point_xyz, is_inlier)


def estimate_pose(
    xyz: ArrayLike, xy: ArrayLike, camera: Camera, *, max_error_px: float = 8.0, inlier_px: float = 4.0,
    method: PoseMethod = "p3p",
) -> PoseEstimate:  # fmt: skip
    """Pose of a calibrated camera from 3D points and their pixels (PnP): RANSAC over P3P, refined on all inliers.

    The result is the same at every call. :func:`sfmapp.calibration.locate.locate_camera` takes more time over few
    points that a hand has marked: it finds the noise, names wrong points, and tells a second pose that fits as well.

    Args:
        xyz: (N, 3) points in the world, N >= 4.
        xy: (N, 2) pixels that see them; wrong ones are expected among them.
        camera: with its lens.
        max_error_px: largest reprojection error of an inlier while the pose is searched.
        inlier_px: the same of the refined pose.
        method: ``p3p``, or ``all``: from all points at once, where none of them is far wrong.

    Returns:
        The pose, its inliers and its covariance.

    Raises:
        InputError: arrays of other shapes, or NaN in the points.
        NoReconstructionError: no pose that four points or more agree with.

    Example:
        >>> found = sfmapp.estimate_pose(model.points.xyz[idx], pixels, camera)
        >>> found.cam_from_world.center, found.is_inlier.sum()
    """
    points, pixels = np.asarray(xyz, np.float64), np.asarray(xy, np.float64)
    if points.shape != (len(points), 3) or pixels.shape != (len(points), 2) or not np.isfinite(points).all():
        raise InputError(
            f"estimate_pose: expected finite points (N, 3) and pixels (N, 2), found {points.shape} and {pixels.shape}"
        )
    found = resection.estimate_pose(
        points, pixels_to_rays(camera, pixels), max_error_px / camera.focal, method=method
    )  # fmt: skip
    if found is None:
        raise NoReconstructionError(
            f"none of the poses that were tried agrees with four of {len(points)} points",
            "check the camera, and that pixels and points belong together row by row",
        )
    refined = refine_pose(
        camera.canonical, found.cam_from_world, points[found.is_inlier], pixels[found.is_inlier],
        inlier_px=inlier_px,
    )  # fmt: skip
    errors = np.linalg.norm(project(camera, rigid3.apply(refined.cam_from_world, points)) - pixels, axis=1)
    return PoseEstimate(Rigid3(refined.cam_from_world), errors <= inlier_px, refined.covariance, camera)


def verify_pair(
    xy1: ArrayLike,
    xy2: ArrayLike,
    camera1: Camera,
    camera2: Camera | None = None,
    options: MatchingOptions | None = None,
    *,
    seed: int = 0,
) -> TwoViewGeometry:
    """Estimate the two-view geometry of an image pair, and which of its matches are inliers.

    F, E and H are estimated robustly (MAGSAC++) and compared, as in COLMAP's two-view geometry.

    Args:
        xy1, xy2: (N, 2) matched pixels.
        camera1, camera2: of the two views; None: the same. A focal length whose ``focal_source`` is ``default`` counts
            as a guess: the fundamental matrix then decides.
        options: thresholds.
        seed: of RANSAC.

    Returns:
        Kind, inliers (N,), matrices, relative pose (unit translation) and triangulation angle.

    Raises:
        InputError: arrays of other shapes, NaN or infinity.

    Example:
        >>> geometry = sfmapp.verify_pair(xy1, xy2, camera)
        >>> geometry.config.name, geometry.is_inlier.sum(), sfmapp.Rigid3(geometry.cam2_from_cam1)
    """
    first, second = (np.ascontiguousarray(xy, np.float64) for xy in (xy1, xy2))
    is_finite = np.isfinite(first).all() and np.isfinite(second).all()
    if first.ndim != 2 or first.shape[1] != 2 or second.shape != first.shape or not is_finite:
        raise InputError(
            f"verify_pair: expected two arrays of finite pixels (N, 2), found {first.shape} and {second.shape}"
        )
    options = options or MatchingOptions()
    ransac = Ransac(options.max_ransac_trials, seed & 0x7FFFFFFF)
    return two_view.verify_pair(first, second, camera1, camera2 or camera1, options, ransac)


def _mask(given: ArrayLike | Iterable[int], count: int, what: str) -> Bools:
    """(count,) bool of positions or of a mask. Raises InputError for a position that is not there."""
    array = np.asarray(given if isinstance(given, np.ndarray) else list(given))  # type: ignore[arg-type]
    if array.dtype == bool and array.shape == (count,):
        return array.copy()
    out = np.zeros(count, bool)
    if array.size:
        if array.dtype.kind not in "iu" or array.min() < 0 or array.max() >= count:
            raise InputError(f"{what}: expected positions from 0 to {count - 1}, found {array}")
        out[array] = True
    return out
