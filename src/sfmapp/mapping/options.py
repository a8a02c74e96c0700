"""Options of the mapping stage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class MappingOptions:
    """What incremental mapping accepts and when it adjusts. Pixel thresholds are for the full-size image."""

    min_initial_inliers: int = 100
    """Verified matches an initial pair should have; halved step by step, with a note, if no pair reaches it."""
    min_initial_angle_deg: float = 8.0
    """Median triangulation angle an initial pair should have; halved with the inliers if no pair reaches it."""
    min_pose_inliers: int = 15
    """2D-3D correspondences that must agree with the pose of an image, when it is registered and ever after."""
    min_pose_inlier_ratio: float = 0.5
    """Share of the 2D-3D correspondences that must agree with the pose of a new image. They are verified matches: a low
    share means that others, consistent as well, contradict it. Half of it will do with twice min_pose_inliers."""
    max_pose_error_px: float = 8.0
    """Largest reprojection error of an inlier while a pose is searched: the map is not yet adjusted to the image."""
    max_reprojection_error_px: float = 4.0
    """Largest reprojection error of an observation that supports its point, whatever the noise."""
    max_reprojection_error_sigmas: float = 6.0
    """The same in robust standard deviations of the residuals, which bounds it where keypoints are precise."""
    min_triangulation_angle_deg: float = 1.5
    """Smallest angle under which two images must see a point."""
    local_window: int = 10
    """Images adjusted around a new one; the rest is held fixed. Up to twice as many are simply adjusted globally."""
    global_growth: float = 1.15
    """Growth factor of the number of images or points after which everything is adjusted."""
    refine_principal_point: Literal["auto", "always", "never"] = "auto"
    """Refine principal points in the final adjustment, for cameras that three or more images share. auto: only where
    nothing is known of the camera (no EXIF, no user): such images may have been cropped or rectified, while the files
    of a camera are centred to about a per cent, which is the convention of the field to trust."""
    principal_point_sigma: float = 0.02
    """Standard deviation of that prior as a share of the longer side: lenses are decentred by 1 %, crops by more."""
    min_model_images: int = 3
    """Images a model needs to be kept. Two are kept only if there are only two."""
    multiple_models: bool = True
    """Go on with the images that are left over when a model cannot grow any more."""
    estimate_focal: bool = True
    """Search a first focal length from the pairs where neither the user nor EXIF knows one."""
