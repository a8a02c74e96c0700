"""The first two images: which pair to start from, and the model it makes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, bearings
from sfmapp.geometry import epipolar, rigid3
from sfmapp.geometry.homography import motions_from_homography
from sfmapp.geometry.relative_pose import refine_relative_pose
from sfmapp.mapping.focal import matched_pixels
from sfmapp.mapping.options import MappingOptions
from sfmapp.mapping.report import InitialPairReport
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.search import Ransac, essentials_of_samples, relative_pose_at_noise
from sfmapp.matching.two_view import error_threshold_px
from sfmapp.scene.correspondences import Correspondences, TwoViewConfig
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

# Configurations that a model can start from; a plane needs known intrinsics, which its reason says.
_STARTABLE = (TwoViewConfig.CALIBRATED, TwoViewConfig.UNCALIBRATED, TwoViewConfig.PLANAR, TwoViewConfig.MULTIPLE)
# Ranking looks closely at this many of the pairs with most matches: enough to choose from, bounded on large sets.
MAX_RANKED = 30
# Beyond this median angle a wider baseline does not make a better start (COLMAP's 16 degrees).
ENOUGH_ANGLE_DEG = 16.0

# Share of the matches inside a group of images that rotations explain if it turns on the spot; the rest are mismatches
# and pairs that are too small to be told.
MIN_ROTATION_SHARE = 0.8

# A relative pose whose median residual is so many times that of F, or less, is right: bent ones had 1.4 to 6 times that
# of the best pose (rooms 1 and 22 of benchmarks/video.py), where F may be bent as well. F has two numbers more to fit,
# and the focal length is known to 4 % by then.
_AS_GOOD_AS_F = 1.1


@dataclass(frozen=True)
class InitialPair:
    """A pair of images that a model might start from.

    Attributes:
        image_idx: the two images.
        num_matches: verified matches of the pair.
        num_points: matches that triangulate in front of both cameras.
        median_angle_deg: of those points.
        cam2_from_cam1: (7,) float64 with unit translation, NaN if there is none.
        reason: why it cannot be started from whatever the thresholds are; empty if it can.
    """

    image_idx: tuple[int, int]
    num_matches: int
    num_points: int
    median_angle_deg: float
    cam2_from_cam1: NDArray[np.float64]
    reason: str = ""

    @property
    def score(self) -> float:
        """Points, discounted where the angle is small; a rejected pair has none."""
        return 0.0 if self.reason else self.num_points * min(1.0, self.median_angle_deg / ENOUGH_ANGLE_DEG)

    def shortfall(self, min_inliers: int, min_angle_deg: float) -> str:
        """What the pair lacks of the given thresholds, in words; empty if nothing."""
        if self.num_points < min_inliers:
            return f"{self.num_points} points in front of both cameras, {min_inliers} wanted"
        if self.median_angle_deg < min_angle_deg:
            return (
                f"the images are too nearly from one place: lines of sight meet at {self.median_angle_deg:.2f} degrees "
                f"in the median, {min_angle_deg:.2f} wanted"
            )
        return ""

    def report(self, names: Sequence[str], reason: str) -> InitialPairReport:
        """The pair for the report, with what spoke against it when it was tried."""
        return InitialPairReport(
            images=[names[i] for i in self.image_idx],
            num_matches=self.num_matches,
            num_points=self.num_points,
            median_angle_deg=round(self.median_angle_deg, 3),
            reason=reason,
        )


def rank_initial_pairs(
    reconstruction: Reconstruction, correspondences: Correspondences, free: NDArray[np.bool_], options: MappingOptions
) -> list[InitialPair]:
    """Pairs of free images, the most promising first: many points under wide angles.

    Args:
        reconstruction: cameras and observations; nothing of it is changed.
        correspondences: verified matches.
        free: (I,) bool images that may be used.
        options: thresholds.
    """
    pairs = np.flatnonzero(
        free[correspondences.pair_image_idx].all(axis=1) & (correspondences.num_inliers >= options.min_pose_inliers)
    )
    inliers = correspondences.num_inliers[pairs]
    angles = np.nan_to_num(correspondences.median_angle_deg[pairs])
    startable = np.isin(correspondences.config[pairs], _STARTABLE)
    promise = inliers * (1.0 + np.minimum(angles, ENOUGH_ANGLE_DEG)) * np.where(startable, 1.0, 1e-6)
    pairs = pairs[np.argsort(-promise, kind="stable")][:MAX_RANKED]
    place = single_places(correspondences, len(reconstruction.image_names))
    ranked = [_examine(reconstruction, correspondences, int(p), place, options) for p in pairs]
    return sorted(ranked, key=lambda pair: -pair.score)


def initial_angles(options: MappingOptions) -> list[float]:
    """The median angle that an initial pair should have, and its halves: narrow ones make few points anyway."""
    angles = [options.min_initial_angle_deg]
    while angles[-1] >= options.min_triangulation_angle_deg:
        angles.append(angles[-1] / 2)
    return angles


def single_places(correspondences: Correspondences, num_images: int) -> NDArray[np.int64]:
    """(I,) int64 groups of images taken from one place, -1 for images that moved.

    Rotation-only pairs link images; a group counts if nearly all matches inside it are rotations. Neighbouring frames
    of a slow video are linked as well, but pairs further apart inside their group show parallax.
    """
    parent = np.arange(num_images)

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = int(parent[i])
        return i

    is_rotation = correspondences.config == TwoViewConfig.PANORAMIC
    for i, j in correspondences.pair_image_idx[is_rotation]:
        parent[root(int(i))] = root(int(j))
    group = np.array([root(i) for i in range(num_images)], np.int64)
    inside = group[correspondences.pair_image_idx]
    same = inside[:, 0] == inside[:, 1]
    inliers = correspondences.num_inliers * same
    everything = np.bincount(inside[:, 0], weights=inliers, minlength=num_images)
    rotations = np.bincount(inside[:, 0], weights=inliers * is_rotation, minlength=num_images)
    still = (rotations > 0) & (rotations >= MIN_ROTATION_SHARE * everything)
    return np.where(still[group], group, -1)


def _examine(
    reconstruction: Reconstruction,
    correspondences: Correspondences,
    pair_idx: int,
    place: NDArray[np.int64],
    options: MappingOptions,
) -> InitialPair:
    """Relative pose of a pair with the cameras as they are now, and what it would give."""
    first, second = (int(i) for i in correspondences.pair_image_idx[pair_idx])
    num_matches = int(correspondences.num_inliers[pair_idx])
    nothing = np.full(7, np.nan)
    config = TwoViewConfig(int(correspondences.config[pair_idx]))
    if config not in _STARTABLE:
        reason = f"{config.name.lower()}: the pair shows no depth"
        return InitialPair((first, second), num_matches, 0, 0.0, nothing, reason)
    if place[first] == place[second] >= 0:
        reason = "both images belong to a group from one place: its pairs are rotations without a baseline"
        return InitialPair((first, second), num_matches, 0, 0.0, nothing, reason)
    xy1, xy2 = matched_pixels(reconstruction.tracks, correspondences, pair_idx)
    camera1, camera2 = (reconstruction.cameras[reconstruction.image_camera_idx[i]] for i in (first, second))
    cameras = (camera1, camera2)
    x1, x2 = bearings(cameras, (xy1, xy2))
    valid = ~(np.isnan(x1) | np.isnan(x2)).any(axis=1)
    x1, x2 = x1[valid], x2[valid]
    focal = 0.5 * (cameras[0].focal + cameras[1].focal)
    enough = len(x1) >= options.min_pose_inliers
    pose = _pose_of_pair(correspondences, pair_idx, cameras, x1, x2) if enough else None
    if pose is None:
        return InitialPair((first, second), num_matches, 0, 0.0, nothing, "no relative pose")
    depths, angles = epipolar.ray_depths(pose, x1, x2)
    squared = epipolar.sampson_errors(epipolar.essential_from_pose(pose), x1, x2) * focal**2
    good = (depths > 0).all(axis=1) & (squared <= options.max_reprojection_error_px**2)
    median = float(np.degrees(np.median(angles[good]))) if good.any() else 0.0
    good &= angles >= np.radians(options.min_triangulation_angle_deg)
    return InitialPair((first, second), num_matches, int(good.sum()), median, pose)


def initialize_from_pair(reconstruction: Reconstruction, pair: InitialPair) -> None:
    """Place the first image at the origin and the second one unit away, in place."""
    first, second = pair.image_idx
    reconstruction.cam_from_world[first] = rigid3.IDENTITY
    reconstruction.cam_from_world[second] = pair.cam2_from_cam1


def _pose_of_pair(
    correspondences: Correspondences, pair_idx: int, cameras: tuple[Camera, Camera], x1: Array, x2: Array
) -> Array | None:
    """The refined relative pose (7,) of a pair, from what matching knows of it; None without any.

    Where a focal length was only guessed then, and F is of a plane or explains the matches better, the pose is searched
    for anew, and at the noise of the matches: there are often two valleys, in the wrong one of which the baseline is
    some 90 degrees off and rays meet under larger angles than they do, and a few matches of things that look alike bend
    it. In one rendered room 11 of 29 pairs lay in the wrong one at the true focal length, the first of the ranking
    among them; in another the first of a model was bent by 4 degrees.

    Args:
        cameras: of the two images, as they are now. x1, x2: matches, (N, 2) normalised image points or (N, 3) rays.
    """
    known = correspondences.cam2_from_cam1[pair_idx]
    candidates = [known] if np.isfinite(known).all() else []
    k1, k2 = (camera.k_matrix for camera in cameras)
    focal = 0.5 * (cameras[0].focal + cameras[1].focal)
    fundamental = correspondences.fundamental[pair_idx]
    has_f = np.isfinite(fundamental).all() and correspondences.config[pair_idx] != TwoViewConfig.PLANAR
    if has_f:
        candidates.extend(epipolar.decompose_essential(epipolar.essential_from_fundamental(fundamental, k1, k2)))
    pose = None
    if candidates:
        pose = refine_relative_pose(epipolar.choose_in_front(np.array(candidates), x1, x2)[0], x1, x2, 1.0 / focal)
    if not any(camera.focal_source == "default" and not camera.is_fixed for camera in cameras):
        return pose
    if pose is not None and has_f:
        matrices = (epipolar.essential_from_pose(pose), k2.T @ fundamental @ k1)
        by_pose, by_f = (float(np.median(epipolar.sampson_errors(matrix, x1, x2))) for matrix in matrices)
        if by_pose <= _AS_GOOD_AS_F**2 * by_f:
            return pose
    essentials = [epipolar.essential_from_pose(candidate)[None] for candidate in candidates]
    if correspondences.num_inliers_h[pair_idx] > 0.5 * len(x1):
        motions = motions_from_homography(correspondences.homography[pair_idx], k1, k2).poses
        essentials += [epipolar.essential_from_pose(motion)[None] for motion in motions]
    essentials.append(essentials_of_samples(x1, x2, Ransac(0, 0)))
    threshold = 0.5 * error_threshold_px(*cameras, MatchingOptions()) / focal
    return relative_pose_at_noise(np.concatenate(essentials), x1, x2, threshold)
