"""From frame to frame: follow the points, measure the pose, and say when a keyframe is due."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.pose import refine_pose
from sfmapp.camera.camera import Camera, pixels_to_normalized, project
from sfmapp.geometry import rigid3
from sfmapp.geometry.noise import sigma_of_lengths
from sfmapp.geometry.resection import estimate_pose
from sfmapp.odometry.frontend.active_tracks import ActiveTracks, References, follow
from sfmapp.odometry.frontend.chaining import chain_pose
from sfmapp.odometry.frontend.pyramid import Pyramid
from sfmapp.odometry.frontend.row_motion import RowMotion
from sfmapp.odometry.frontend.small_image import align_small_images
from sfmapp.odometry.map.local_map import LocalMap
from sfmapp.odometry.options import OdometryOptions

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Fewest points that a pose is believed to, and their share among the points that were found: a third of what chance
# would leave in a bad match is still far below.
MIN_INLIERS, _MIN_INLIER_SHARE = 15, 0.3
# Points whose residual is longer than that many robust sigmas, within these bounds in pixels, are outliers.
_OUTLIER_SIGMAS, _OUTLIER_RANGE_PX = 5.0, (1.5, 4.0)
# A prediction has failed when fewer than this share of the tracks is found with it.
_MIN_FOUND = 0.5
# Unmapped tracks farther from their epipolar line than that have slid off their point.
_MAX_EPIPOLAR_PX = 1.5
# Levels at which the search begins: near a good prediction, and after a bad one.
_NEAR_LEVEL, _FAR_LEVEL = 2, 4


@dataclass(frozen=True)
class Tracked:
    """A frame whose pose was measured.

    Attributes:
        pose: (7,) cam_from_world. covariance: (6, 6) as of ``refine_pose``.
        tracks: what is followed from here; outliers are gone. is_mapped: (N,) which of them measured the pose.
        num_found, num_inliers: of the mapped tracks. num_followed: tracks found, mapped or not.
        residual_px: robust standard deviation of the residuals of the inliers.
    """

    pose: Array
    covariance: Array
    tracks: ActiveTracks
    is_mapped: Mask
    num_found: int
    num_inliers: int
    num_followed: int
    residual_px: float


def track(
    local: LocalMap, tracks: ActiveTracks, pose: Array, step: Array, previous: Pyramid, pyramid: Pyramid,
    readout: float = 0.0,
) -> Tracked | None:  # fmt: skip
    """Measure the pose of a new frame.

    Args:
        tracks: as they were in the last frame.
        pose: (7,) cam_from_world of the last frame. step: (7,) predicted pose of the new frame from the last.
        previous, pyramid: the images of both.
        readout: of the rows of the new frame, as a share of the time since the last one; 0: all at once.

    Returns:
        None if the pose cannot be measured.
    """
    xyz, mapped = local.points_of(tracks)
    references = local.references(tracks)
    most = (tracks, np.zeros(len(tracks), bool))
    for start, level in _predictions(local, pose, step, previous, pyramid):
        followed, found = follow(tracks, xyz, local.camera, start, references, local.images, pyramid, level)
        if found.sum() > most[1].sum():
            most = (followed, found)
        if found.sum() < _MIN_FOUND * len(tracks) and level == _NEAR_LEVEL:
            continue
        usable = found & mapped
        measured = _measure_by_rows(local.camera, pose, start, xyz[usable], followed.xy[usable], readout)
        if measured is not None:
            break
    else:
        followed, found = most
        measured = _chained(local.camera, followed.subset(found), references, xyz[found], mapped[found])
        if measured is None:
            return None
    tracks, mapped, xyz = followed.subset(found), mapped[found], xyz[found]
    new_pose, covariance, inlier, sigma = measured
    keep = np.ones(len(tracks), bool)
    keep[mapped] = inlier
    rows, free = RowMotion(readout, rigid3.compose(new_pose, rigid3.inverse(pose))), tracks.subset(~mapped)
    straight = free.moved(free.xy - rows.shift_px(local.camera, new_pose, xyz[~mapped], free.xy))
    keep[~mapped] = _near_epipolar_lines(local, straight, new_pose)
    return Tracked(
        new_pose,
        covariance,
        tracks.subset(keep),
        mapped[keep],
        int(mapped.sum()),
        int(inlier.sum()),
        len(tracks),
        sigma,
    )


def _chained(
    camera: Camera, tracks: ActiveTracks, references: References, xyz: Array, mapped: Mask
) -> tuple[Array, Array, Mask, float] | None:
    """What :func:`measure_pose` returns, where too few points of the map are left for that."""
    pose = chain_pose(camera, tracks, references, np.where(mapped[:, None], xyz, np.nan))
    if pose is None:
        return None
    error = np.linalg.norm(project(camera, rigid3.apply(pose, xyz[mapped])) - tracks.xy[mapped], axis=1)
    return pose, np.full((6, 6), np.inf), error < _OUTLIER_RANGE_PX[1], float("nan")


def _predictions(
    local: LocalMap, pose: Array, step: Array, previous: Pyramid, pyramid: Pyramid
) -> Iterator[tuple[Array, int]]:
    """Poses (7,) to begin with, and the level to search from: steady motion, the turn that the images as a whole show,
    no motion. The later ones are only worked out if they are asked for."""
    predicted = rigid3.compose(step, pose)
    yield predicted, _NEAR_LEVEL
    rotation = align_small_images(previous, pyramid, local.camera.focal)
    if rotation is not None:
        yield rigid3.compose(rigid3.from_matrix(rotation, np.zeros(3)), pose), _FAR_LEVEL
    yield predicted, _FAR_LEVEL
    yield pose, _FAR_LEVEL


def measure_pose(camera: Camera, start: Array, xyz: Array, xy: Array) -> tuple[Array, Array, Mask, float] | None:
    """Robust pose from points in the map: refined from a start, by RANSAC where that finds too few that agree.

    Returns:
        (7,) cam_from_world, (6, 6) covariance, (N,) inliers and the robust sigma of their residuals in pixels, or None.
    """
    if len(xyz) < MIN_INLIERS:
        return None
    canonical = camera.canonical
    best = refine_pose(canonical, start, xyz, xy, inlier_px=_OUTLIER_RANGE_PX[1])
    if best.is_inlier.sum() < 0.6 * len(xyz):
        normalized = pixels_to_normalized(camera, xy)
        sampled = estimate_pose(xyz, normalized, 3.0 / camera.focal, max_iterations=1000)
        if sampled is not None and sampled.num_inliers >= MIN_INLIERS:
            other = refine_pose(canonical, sampled.cam_from_world, xyz, xy, inlier_px=_OUTLIER_RANGE_PX[1])
            if other.is_inlier.sum() > best.is_inlier.sum():
                best = other
    error = np.linalg.norm(project(camera, rigid3.apply(best.cam_from_world, xyz)) - xy, axis=1)
    if best.is_inlier.sum() < max(MIN_INLIERS, _MIN_INLIER_SHARE * len(xyz)):
        return None
    sigma = sigma_of_lengths(error[best.is_inlier])
    inlier = error < np.clip(_OUTLIER_SIGMAS * sigma, *_OUTLIER_RANGE_PX)
    if inlier.sum() < MIN_INLIERS:
        return None
    return best.cam_from_world, best.covariance, inlier, sigma


def _measure_by_rows(
    camera: Camera, before: Array, start: Array, xyz: Array, xy: Array, readout: float
) -> tuple[Array, Array, Mask, float] | None:
    """What :func:`measure_pose` returns, of points taken back to where they were in the middle of the readout.

    The motion while rows are read is that since the frame before, first as it is foretold, then as it was measured.

    Args:
        before: (7,) cam_from_world of the frame before. readout: share of the time since then.
    """
    measured = measure_pose(camera, start, xyz, xy - _shift_since(camera, before, start, xyz, xy, readout))
    if measured is None or not readout:
        return measured
    pose = measured[0]
    return measure_pose(camera, pose, xyz, xy - _shift_since(camera, before, pose, xyz, xy, readout))


def _shift_since(camera: Camera, before: Array, pose: Array, xyz: Array, xy: Array, readout: float) -> Array:
    return RowMotion(readout, rigid3.compose(pose, rigid3.inverse(before))).shift_px(camera, pose, xyz, xy)


def _near_epipolar_lines(local: LocalMap, tracks: ActiveTracks, pose: Array) -> Mask:
    """(N,) which unmapped tracks are near the epipolar lines of their reference keyframes (Sampson's distance)."""
    references = local.references(tracks)
    rotation, translation = references.camera_from(pose)
    k = references.position(tracks.reference)
    there = np.column_stack([tracks.reference_ray, np.ones(len(tracks))])
    here = np.column_stack([pixels_to_normalized(local.camera, tracks.xy), np.ones(len(tracks))])
    turned = np.einsum("nij,nj->ni", rotation[k], there)
    line = np.cross(translation[k], turned)
    other = np.einsum("nji,nj->ni", rotation[k], np.cross(here, translation[k]))
    gradient2 = (line[:, :2] ** 2).sum(1) + (other[:, :2] ** 2).sum(1)
    limit = (_MAX_EPIPOLAR_PX / local.camera.focal) ** 2
    is_near: Mask = (line * here).sum(1) ** 2 <= limit * gradient2
    return is_near


def keyframe_reason(local: LocalMap, tracked: Tracked, num_mapped_before: int, options: OdometryOptions) -> str | None:
    """Why this frame should become a keyframe, or None.

    Args:
        num_mapped_before: mapped tracks right after the last keyframe.
    """
    num_mapped = int(tracked.is_mapped.sum())
    if num_mapped < options.keyframe_loss * num_mapped_before:
        return f"{num_mapped} of {num_mapped_before} mapped points are left"
    last = local.keyframes.keyframes[-1]
    common, here, there = np.intersect1d(tracked.tracks.point_id, last.point_id, True, return_indices=True)
    if len(common) < 0.6 * len(last.point_id):
        return f"{len(common)} of {len(last.point_id)} tracks of the last keyframe are left"
    rays = np.column_stack([pixels_to_normalized(local.camera, last.xy[there, 0]), np.ones(len(common))])
    turn = rigid3.rotation_matrix(tracked.pose) @ rigid3.rotation_matrix(last.rig_from_world).T
    still = project(local.camera, rays @ turn.T)
    shift = np.linalg.norm(still - tracked.tracks.xy[here], axis=1)
    parallax = float(np.nanmedian(shift)) / local.camera.width
    if parallax > options.keyframe_parallax:
        return f"parallax of {100 * parallax:.1f} % of the width"
    return None
