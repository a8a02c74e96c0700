"""Options of the mapping stage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sfmapp.option_checks import SHARE, Range, check_options, positive

_RANGES = {
    "min_initial_inliers": Range(5, 100_000),
    "min_initial_angle_deg": positive(90.0),
    "min_pose_inliers": Range(3, 100_000),  # three points are the fewest that a pose can be had from
    "min_pose_inlier_ratio": SHARE,
    "max_pose_error_px": positive(1000.0),
    "max_reprojection_error_px": positive(1000.0),
    "max_reprojection_error_sigmas": Range(1.0, 1000.0),
    "min_triangulation_angle_deg": Range(0.0, 90.0),
    "local_window": Range(2, 10_000),
    "global_growth": Range(1.0, 100.0),
    "principal_point_sigma": positive(1.0),
    "min_model_images": Range(2, 100_000),
}


@dataclass(frozen=True)
class MappingOptions:
    """What incremental mapping accepts and when it adjusts. Pixel thresholds are for the full-size image.

    Attributes:
        min_initial_inliers: Verified matches an initial pair should have; halved step by step, with a note, if no pair
            reaches it.
        min_initial_angle_deg: Median triangulation angle an initial pair should have; halved with the inliers if no
            pair reaches it.
        min_pose_inliers: 2D-3D correspondences that must agree with the pose of an image, when it is registered and
            ever after.
        min_pose_inlier_ratio: Share of the 2D-3D correspondences that must agree with the pose of a new image. They are
            verified matches: a low share means that others, consistent as well, contradict it. Half of it will do with
            twice min_pose_inliers.
        max_pose_error_px: Largest reprojection error of an inlier while a pose is searched: the map is not yet adjusted
            to the image.
        max_reprojection_error_px: Largest reprojection error of an observation that supports its point, whatever the
            noise.
        max_reprojection_error_sigmas: The same in robust standard deviations of the residuals, which bounds it where
            keypoints are precise.
        min_triangulation_angle_deg: Smallest angle under which two images must see a point.
        local_window: Images adjusted around a new one; the rest is held fixed. Up to twice as many are simply adjusted
            globally.
        global_growth: Growth factor of the number of images or points after which everything is adjusted.
        refine_principal_point: Refine principal points in the final adjustment, for cameras that three or more images
            share. auto: only where nothing is known of the camera (no EXIF, no user): such images may have been cropped
            or rectified, while the files of a camera are centred to about a per cent, which is the convention of the
            field to trust.
        principal_point_sigma: Standard deviation of that prior as a share of the longer side: lenses are decentred by 1
            %, crops by more.
        min_model_images: Images a model needs to be kept. Two are kept only if there are only two.
        multiple_models: Start another model with the images that are left over when one cannot grow any more.
        estimate_focal: Estimate an initial focal length from verified pairs where neither the user nor EXIF gives one.
    """

    min_initial_inliers: int = 100
    min_initial_angle_deg: float = 8.0
    min_pose_inliers: int = 15
    min_pose_inlier_ratio: float = 0.5
    max_pose_error_px: float = 8.0
    max_reprojection_error_px: float = 4.0
    max_reprojection_error_sigmas: float = 6.0
    min_triangulation_angle_deg: float = 1.5
    local_window: int = 10
    global_growth: float = 1.15
    refine_principal_point: Literal["auto", "always", "never"] = "auto"
    principal_point_sigma: float = 0.02
    min_model_images: int = 3
    multiple_models: bool = True
    estimate_focal: bool = True

    def __post_init__(self) -> None:
        check_options("mapping", self, _RANGES)
