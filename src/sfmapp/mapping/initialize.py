"""The first two images: which pair to start from, and the model it makes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import epipolar, rigid3
from sfmapp.mapping.options import MappingOptions
from sfmapp.scene.camera import pixels_to_normalized
from sfmapp.scene.correspondences import Correspondences, TwoViewConfig
from sfmapp.scene.reconstruction import Reconstruction

# Configurations that a model can start from; a plane needs known intrinsics, which its reason says.
_STARTABLE = (TwoViewConfig.CALIBRATED, TwoViewConfig.UNCALIBRATED, TwoViewConfig.PLANAR, TwoViewConfig.MULTIPLE)
# Ranking looks closely at this many of the pairs with most matches: enough to choose from, bounded on large sets.
MAX_RANKED = 60
# Beyond this median angle a wider baseline does not make a better start (COLMAP's 16 degrees).
ENOUGH_ANGLE_DEG = 16.0


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
            return f"median angle {self.median_angle_deg:.2f} degrees, {min_angle_deg:.2f} wanted"
        return ""

    def describe(self, names: list[str]) -> dict[str, Any]:
        """The pair for the report."""
        return {
            "images": [names[i] for i in self.image_idx],
            "num_matches": self.num_matches,
            "num_points": self.num_points,
            "median_angle_deg": round(self.median_angle_deg, 3),
        }


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
    ranked = [_examine(reconstruction, correspondences, int(p), options) for p in pairs]
    return sorted(ranked, key=lambda pair: -pair.score)


def _examine(
    reconstruction: Reconstruction, correspondences: Correspondences, pair_idx: int, options: MappingOptions
) -> InitialPair:
    """Relative pose of a pair with the cameras as they are now, and what it would give."""
    first, second = (int(i) for i in correspondences.pair_image_idx[pair_idx])
    num_matches = int(correspondences.num_inliers[pair_idx])
    nothing = np.full(7, np.nan)
    config = TwoViewConfig(int(correspondences.config[pair_idx]))
    if config not in _STARTABLE:
        reason = f"{config.name.lower()}: the pair shows no depth"
        return InitialPair((first, second), num_matches, 0, 0.0, nothing, reason)
    xy1, xy2 = matched_pixels(reconstruction, correspondences, pair_idx)
    cameras = [reconstruction.cameras[reconstruction.image_camera_idx[i]] for i in (first, second)]
    x1, x2 = (pixels_to_normalized(c, xy) for c, xy in zip(cameras, (xy1, xy2), strict=True))
    max_error = options.max_reprojection_error_px / (0.5 * (cameras[0].focal + cameras[1].focal))
    pose = epipolar.estimate_relative_pose(x1, x2, max_error)
    if pose is None:
        return InitialPair((first, second), num_matches, 0, 0.0, nothing, "no essential matrix")
    median = float(np.degrees(np.median(pose.angles_rad))) if len(pose.angles_rad) else 0.0
    return InitialPair((first, second), num_matches, len(pose.angles_rad), median, pose.cam2_from_cam1)


def matched_pixels(
    reconstruction: Reconstruction, correspondences: Correspondences, pair_idx: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(K, 2) pixels of the verified matches of a pair in both images, as far as their tracks kept them together."""
    tracks = reconstruction.tracks
    sides = []
    for side in range(2):
        image_idx = correspondences.pair_image_idx[pair_idx, side]
        obs = tracks.observations_of_image(image_idx)
        size = 1 + max(
            int(tracks.obs_feature_idx[obs].max(initial=0)), int(correspondences.matches_of_pair(pair_idx)[:, side].max())
        )
        obs_of_feature = np.full(size, -1)
        obs_of_feature[tracks.obs_feature_idx[obs]] = obs
        sides.append(obs_of_feature[correspondences.matches_of_pair(pair_idx)[:, side]])
    kept = (sides[0] >= 0) & (sides[1] >= 0)
    first, second = sides[0][kept], sides[1][kept]
    together = tracks.obs_track_idx[first] == tracks.obs_track_idx[second]
    return tracks.obs_xy[first[together]], tracks.obs_xy[second[together]]


def initialize_from_pair(reconstruction: Reconstruction, pair: InitialPair) -> None:
    """Place the first image at the origin and the second one unit away, in place."""
    first, second = pair.image_idx
    reconstruction.cam_from_world[first] = rigid3.IDENTITY
    reconstruction.cam_from_world[second] = pair.cam2_from_cam1
