"""Which image comes next, and its pose."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.pose import RefinedPose, refine_pose
from sfmapp.camera.camera import bearings, pixels_to_normalized
from sfmapp.geometry import resection, rigid3
from sfmapp.mapping.options import MappingOptions
from sfmapp.scene.reconstruction import Reconstruction

PYRAMID_LEVELS = 6

# Focal lengths to try for a camera that nothing is known about, as factors on its prior: 1 first, then outwards.
_FACTORS = np.geomspace(1.0, 4.0, 9)
FOCAL_SCALES = np.unique(np.concatenate([_FACTORS, 1 / _FACTORS]))
FOCAL_SCALES = FOCAL_SCALES[np.argsort(np.abs(np.log(FOCAL_SCALES)), kind="stable")]


@dataclass(frozen=True)
class Registration:
    """What came of the attempt to register an image.

    Attributes:
        image_idx: the image.
        num_correspondences: keypoints whose tracks are triangulated.
        num_inliers: how many of them agree with the pose.
        cam_from_world: (7,) float64, or None if the attempt failed.
        focal_px: focal length found for the image's camera, None if it was not searched.
        position_sigma: standard deviation of the position along its least certain axis, with the focal length free if
            it was searched, as a share of the median distance of the points that agree; infinite if nothing holds it.
        reason: why it failed, with the numbers; empty if it succeeded.
    """

    image_idx: int
    num_correspondences: int
    num_inliers: int
    cam_from_world: NDArray[np.float64] | None
    focal_px: float | None = None
    position_sigma: float = math.inf
    reason: str = ""


@numba.njit(cache=True, nogil=True)
def visibility_scores(
    images: NDArray[np.int64],
    image_ptr: NDArray[np.int64],
    image_obs: NDArray[np.int64],
    obs_track_idx: NDArray[np.int32],
    obs_xy: NDArray[np.float64],
    point_xyz: NDArray[np.float64],
    image_size: NDArray[np.float64],
    scores: NDArray[np.int64],
    counts: NDArray[np.int64],
) -> None:
    """Pyramid scores (Schoenberger and Frahm, CVPR 2016, section 4.2) and counts of the visible triangulated points.

    The image is divided into 2^l x 2^l cells, l = 1..6; every occupied cell scores 2^l x 2^l: many points, well spread,
    score most.
    """
    side = 1 << PYRAMID_LEVELS
    occupied = np.zeros((PYRAMID_LEVELS + 1, side * side), np.int64)
    for n in range(len(images)):
        i = images[n]
        score = 0
        count = 0
        for index in range(image_ptr[i], image_ptr[i + 1]):
            o = image_obs[index]
            if np.isnan(point_xyz[obs_track_idx[o], 0]):
                continue
            count += 1
            x = min(side - 1, max(0, int(obs_xy[o, 0] / image_size[i, 0] * side)))
            y = min(side - 1, max(0, int(obs_xy[o, 1] / image_size[i, 1] * side)))
            for level in range(PYRAMID_LEVELS, 0, -1):
                cell = (y << PYRAMID_LEVELS) + x
                if occupied[level, cell] == n + 1:
                    break  # then it is occupied at all coarser levels too
                occupied[level, cell] = n + 1
                score += 1 << (2 * level)
                x >>= 1
                y >>= 1
        scores[n] = score
        counts[n] = count


class NextImages:
    """Ranks unregistered images of one growing model; what each sees is counted again only where it has changed."""

    def __init__(self, reconstruction: Reconstruction) -> None:
        num_images = len(reconstruction.image_names)
        self._scores, self._counts = np.zeros(num_images, np.int64), np.zeros(num_images, np.int64)
        self._was_triangulated = np.zeros(reconstruction.tracks.num_tracks, bool)
        self._is_stale = np.zeros(num_images, bool)  # nothing is triangulated: all scores are zero

    def rank(
        self, reconstruction: Reconstruction, candidates: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Candidates sorted by pyramid score, best first, with their scores and numbers of visible points."""
        tracks, is_triangulated = reconstruction.tracks, reconstruction.is_triangulated
        changed = np.flatnonzero(is_triangulated != self._was_triangulated)
        self._was_triangulated = is_triangulated
        self._is_stale[tracks.obs_image_idx[tracks.observations_of_tracks(changed)]] = True
        stale = candidates[self._is_stale[candidates]]
        self._is_stale[stale] = False
        sizes = np.array([(c.width, c.height) for c in reconstruction.cameras], np.float64)
        scores, counts = np.zeros(len(stale), np.int64), np.zeros(len(stale), np.int64)
        visibility_scores(
            stale, tracks.image_ptr, tracks.image_obs, tracks.obs_track_idx, tracks.obs_xy, reconstruction.point_xyz,
            sizes[reconstruction.image_camera_idx], scores, counts,
        )  # fmt: skip
        self._scores[stale], self._counts[stale] = scores, counts
        order = np.lexsort((candidates, -self._scores[candidates]))
        ranked = candidates[order]
        return ranked, self._scores[ranked], self._counts[ranked]


def register_image(
    reconstruction: Reconstruction, image_idx: int, options: MappingOptions, *, max_error_px: float, search_focal: bool
) -> Registration:
    """Pose of an image from the points that it sees; the reconstruction is not changed.

    Args:
        reconstruction: the map so far.
        image_idx: an unregistered image.
        options: thresholds.
        max_error_px: largest reprojection error of an inlier.
        search_focal: try other focal lengths too, as nothing is known about this camera yet.
    """
    tracks = reconstruction.tracks
    obs = tracks.observations_of_image(image_idx)
    obs = obs[reconstruction.is_triangulated[tracks.obs_track_idx[obs]]]
    if len(obs) < options.min_pose_inliers:
        return Registration(
            image_idx, len(obs), 0, None,
            reason=f"sees {len(obs)} points of the map, at least {options.min_pose_inliers} are needed",
        )  # fmt: skip
    camera = reconstruction.cameras[reconstruction.image_camera_idx[image_idx]]
    xyz = reconstruction.point_xyz[tracks.obs_track_idx[obs]]
    max_error, needed = max_error_px / camera.focal, _needed_inliers(len(obs), options)
    if search_focal:
        normalized = pixels_to_normalized(camera, tracks.obs_xy[obs])
        found = resection.estimate_pose_and_focal(xyz, normalized, max_error, FOCAL_SCALES)
    else:
        rays = bearings([camera], [tracks.obs_xy[obs]])[0]
        found = resection.estimate_pose(xyz, rays, max_error, min_inliers=needed)
    if found is None or found.num_inliers < needed:
        num_inliers = found.num_inliers if found is not None else 0
        reason = f"{num_inliers} of {len(obs)} points agree with one pose, at least {needed} are needed"
        return Registration(image_idx, len(obs), num_inliers, None, reason=reason)
    refined = refine_pose(
        camera.with_focal(camera.focal * found.focal_scale).canonical, found.cam_from_world, xyz,
        tracks.obs_xy[obs], scale_px=0.5 * max_error_px, inlier_px=max_error_px,
        focal_sigma_px=math.inf if search_focal else 0.0,
    )  # fmt: skip
    focal_px = float(refined.canonical[:2].mean()) if search_focal else None
    return Registration(
        image_idx, len(obs), int(refined.is_inlier.sum()), refined.cam_from_world, focal_px,
        _position_sigma(refined, xyz[refined.is_inlier]),
    )  # fmt: skip


def _position_sigma(refined: RefinedPose, xyz: NDArray[np.float64]) -> float:
    """Standard deviation of a refined position along its least certain axis, in median distances of its points.

    The centre -R^T t moves by -R^T v with the translation, which the turn of the axes does not lengthen.
    """
    if len(xyz) == 0 or not np.isfinite(refined.covariance).all():
        return math.inf
    variance = float(np.linalg.eigvalsh(refined.covariance[3:6, 3:6])[-1])
    distance = float(np.median(np.linalg.norm(rigid3.apply(refined.cam_from_world, xyz), axis=1)))
    sigma = math.sqrt(max(variance, 0.0)) / distance if distance > 0 else math.inf
    return sigma if math.isfinite(sigma) else math.inf


def _needed_inliers(num_correspondences: int, options: MappingOptions) -> int:
    """Fewer than twice the least number of inliers must be a clear majority."""
    least, ratio = options.min_pose_inliers, options.min_pose_inlier_ratio
    clear = max(least, int(np.ceil(ratio * num_correspondences)))
    return min(clear, max(2 * least, int(np.ceil(0.5 * ratio * num_correspondences))))
