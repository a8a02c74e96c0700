"""Verification of a pair: which matches does one geometry explain, and which geometry is it?

The decision follows COLMAP's two-view geometry (Schoenberger and Frahm, "Structure-from-motion revisited", CVPR 2016):
F, E and H are each estimated robustly and their inlier counts compared.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import epipolar, homography, rigid3
from sfmapp.matching.options import MatchingOptions
from sfmapp.scene.camera import Camera, pixels_to_normalized
from sfmapp.scene.correspondences import TwoViewConfig

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# COLMAP's figures for captions and time stamps burnt into photos: matches within a tenth of the diagonal from the
# border, moved all alike, and at least seven in ten of all.
_WATERMARK_BORDER_SHARE = 0.1
_WATERMARK_MIN_SHARE = 0.7


def _no_matrix() -> Array:
    return np.full((3, 3), np.nan)


@dataclass
class TwoViewGeometry:
    """What verification found out about a pair of images.

    Attributes:
        config: its kind; UNDEFINED with too few matches to try, DEGENERATE if no model explains enough of them.
        is_inlier: (N,) bool, the matches that the winning model explains.
        fundamental, essential, homography: (3, 3), NaN where not estimated; see Correspondences.
        cam2_from_cam1: (7,) pose with unit translation, NaN where there is none. Its translation is zero if PANORAMIC.
        median_angle_deg: median angle between the rays of the inliers, NaN without a pose.
        num_inliers_f, num_inliers_e, num_inliers_h: how many matches each model explains.
    """

    config: TwoViewConfig
    is_inlier: Mask
    fundamental: Array = field(default_factory=_no_matrix)
    essential: Array = field(default_factory=_no_matrix)
    homography: Array = field(default_factory=_no_matrix)
    cam2_from_cam1: Array = field(default_factory=lambda: np.full(7, np.nan))
    median_angle_deg: float = math.nan
    num_inliers_f: int = 0
    num_inliers_e: int = 0
    num_inliers_h: int = 0


def error_threshold_px(camera1: Camera, camera2: Camera, options: MatchingOptions) -> float:
    """Inlier threshold of a pair in pixels.

    COLMAP's 4 px are meant for photos of about two megapixels (2000 px across the diagonal). What stretches residuals
    beyond the keypoint noise is unmodelled lens distortion, which grows with the image, and a band of a fixed share of
    the image catches chance matches at a fixed rate: so the threshold scales, but not below the noise of large blobs.
    """
    if options.max_error_px is not None:
        return options.max_error_px
    diagonal = max(math.hypot(c.width, c.height) for c in (camera1, camera2))
    return min(max(0.002 * diagonal, 2.0), 8.0)


def verify_pair(
    xy1: Array, xy2: Array, camera1: Camera, camera2: Camera, options: MatchingOptions, *, seed: int
) -> TwoViewGeometry:
    """Find the geometry of a pair and the matches that it explains.

    Args:
        xy1, xy2: (N, 2) float64 matched pixels, best matches in any order.
        camera1, camera2: their focals are trusted if their source is not ``default``, else only used for the pose.
        seed: state of the random generator, 0 to 2^31 - 1; the same seed gives the same answer on any thread.
    """
    none = np.zeros(len(xy1), bool)
    if len(xy1) < max(options.min_inliers, 8):
        return TwoViewGeometry(TwoViewConfig.UNDEFINED, none)
    threshold = error_threshold_px(camera1, camera2, options)
    xn1, xn2 = pixels_to_normalized(camera1, xy1), pixels_to_normalized(camera2, xy2)
    ransac = _Ransac(options.max_ransac_trials, seed)
    result = TwoViewGeometry(TwoViewConfig.DEGENERATE, none)
    fundamental, inlier_f = _estimate_fundamental(xy1, xy2, threshold, ransac)
    homography_, inlier_h = _estimate_homography(xy1, xy2, threshold, ransac)
    scale = 2.0 * threshold / (camera1.focal + camera2.focal)
    essential, inlier_e = _estimate_essential(xn1, xn2, scale, ransac)
    result.fundamental, result.num_inliers_f = fundamental, int(inlier_f.sum())
    result.homography, result.num_inliers_h = homography_, int(inlier_h.sum())
    result.essential, result.num_inliers_e = essential, int(inlier_e.sum())
    is_calibrated = camera1.focal_source != "default" and camera2.focal_source != "default"
    _classify(result, inlier_f, inlier_e, inlier_h, is_calibrated, options)
    if result.config == TwoViewConfig.DEGENERATE:
        return result
    if _is_watermark(xy1, xy2, result.is_inlier, camera1, camera2, threshold):
        result.config = TwoViewConfig.WATERMARK
        return result
    _add_pose(result, xn1, xn2, camera1, camera2, scale)
    return result


def _classify(
    result: TwoViewGeometry,
    inlier_f: Mask,
    inlier_e: Mask,
    inlier_h: Mask,
    is_calibrated: bool,
    options: MatchingOptions,
) -> None:
    num_f, num_e, num_h = result.num_inliers_f, result.num_inliers_e, result.num_inliers_h
    if is_calibrated and num_e >= options.min_inliers and num_e >= options.min_e_f_ratio * num_f:
        result.config, result.is_inlier, reference = TwoViewConfig.CALIBRATED, inlier_e, num_e
        if num_f > num_e:
            result.is_inlier = inlier_f
    elif num_f >= options.min_inliers:
        result.config, result.is_inlier, reference = TwoViewConfig.UNCALIBRATED, inlier_f, num_f
    elif num_h >= options.min_inliers:
        result.config, result.is_inlier, reference = TwoViewConfig.PLANAR_OR_PANORAMIC, inlier_h, num_h
    else:
        return
    if num_h > options.max_h_ratio * reference:
        result.config = TwoViewConfig.PLANAR_OR_PANORAMIC
        if num_h > result.is_inlier.sum():
            result.is_inlier = inlier_h


@dataclass(frozen=True)
class _Ransac:
    max_trials: int
    seed: int

    def params(self, threshold: float) -> Any:
        """MAGSAC++ scores (Barath et al., CVPR 2020) with inner local optimisation, in OpenCV's USAC framework."""
        import cv2

        params = cv2.UsacParams()
        params.confidence = 0.999
        params.maxIterations = self.max_trials
        params.threshold = threshold
        params.score = cv2.SCORE_METHOD_MAGSAC
        params.loMethod = cv2.LOCAL_OPTIM_SIGMA
        params.final_polisher = cv2.MAGSAC
        params.sampler = cv2.SAMPLING_UNIFORM
        params.isParallel = False
        params.randomGeneratorState = self.seed
        return params


def _first_matrix(found: Any) -> Array | None:
    """OpenCV returns None, an empty array, or several 3 x 3 solutions stacked."""
    if found is None or found.shape[0] < 3 or not np.isfinite(found[:3]).all():
        return None
    matrix = np.ascontiguousarray(found[:3], np.float64)
    norm = np.linalg.norm(matrix)
    return matrix / norm if norm > 0 else None


def _estimate_fundamental(xy1: Array, xy2: Array, threshold: float, ransac: _Ransac) -> tuple[Array, Mask]:
    import cv2

    try:
        f = _first_matrix(cv2.findFundamentalMat(xy1, xy2, ransac.params(threshold))[0])
    except cv2.error:  # coincident points can leave it without a single valid sample
        f = None
    if f is None:
        return _no_matrix(), np.zeros(len(xy1), bool)
    inlier = epipolar.sampson_errors(f, xy1, xy2) < threshold**2
    for _ in range(2):  # polish on all inliers; Sampson's weights settle in two rounds
        if inlier.sum() < 8:
            break
        refined = epipolar.fundamental_from_points(
            xy1[inlier], xy2[inlier], _sampson_weights(f, xy1[inlier], xy2[inlier])
        )
        refined_inlier = epipolar.sampson_errors(refined, xy1, xy2) < threshold**2
        if refined_inlier.sum() < inlier.sum():
            break
        f, inlier = refined, refined_inlier
    return f, inlier


def _sampson_weights(f: Array, xy1: Array, xy2: Array) -> Array:
    line2 = xy1 @ f[:2, :2].T + f[:2, 2]
    line1 = xy2 @ f[:2, :2] + f[2, :2]
    denominator = (line2**2).sum(1) + (line1**2).sum(1)
    weights = 1.0 / np.maximum(denominator, 1e-12 * denominator.max())
    return weights / weights.max()


def _estimate_essential(xn1: Array, xn2: Array, threshold: float, ransac: _Ransac) -> tuple[Array, Mask]:
    import cv2

    valid = np.isfinite(xn1).all(1) & np.isfinite(xn2).all(1)
    inlier = np.zeros(len(xn1), bool)
    if valid.sum() < 8:
        return _no_matrix(), inlier
    a, b = np.ascontiguousarray(xn1[valid]), np.ascontiguousarray(xn2[valid])
    eye, no_distortion = np.eye(3), np.zeros(4)
    try:
        found = cv2.findEssentialMat(a, b, eye, eye, no_distortion, no_distortion, ransac.params(threshold))[0]
    except cv2.error:
        found = None
    e = _first_matrix(found)
    if e is None:
        return _no_matrix(), inlier
    e = epipolar.nearest_essential(e)
    inlier[valid] = epipolar.sampson_errors(e, a, b) < threshold**2
    return e, inlier


def _estimate_homography(xy1: Array, xy2: Array, threshold: float, ransac: _Ransac) -> tuple[Array, Mask]:
    import cv2

    try:
        h = _first_matrix(cv2.findHomography(xy1, xy2, ransac.params(threshold))[0])
    except cv2.error:
        h = None
    if h is None:
        return _no_matrix(), np.zeros(len(xy1), bool)
    return h, homography.transfer_errors(h, xy1, xy2) < threshold**2


def _is_watermark(xy1: Array, xy2: Array, inlier: Mask, camera1: Camera, camera2: Camera, threshold: float) -> bool:
    in_border = inlier.copy()
    for xy, camera in ((xy1, camera1), (xy2, camera2)):
        border = _WATERMARK_BORDER_SHARE * math.hypot(camera.width, camera.height)
        size = np.array([camera.width, camera.height])
        in_border &= ((xy < border) | (xy > size - border)).any(1)
    num_inliers = inlier.sum()
    if in_border.sum() < _WATERMARK_MIN_SHARE * num_inliers:
        return False
    # with more than half of them moved alike, the median is one of those
    shift = (xy2 - xy1)[in_border]
    moved_alike = np.linalg.norm(shift - np.median(shift, axis=0), axis=1) < threshold
    return bool(moved_alike.sum() >= _WATERMARK_MIN_SHARE * num_inliers)


def _add_pose(result: TwoViewGeometry, xn1: Array, xn2: Array, camera1: Camera, camera2: Camera, scale: float) -> None:
    """Relative pose of the winning model, and whether a planar pair is rather a rotation."""
    valid = result.is_inlier & np.isfinite(xn1).all(1) & np.isfinite(xn2).all(1)
    a, b = np.ascontiguousarray(xn1[valid]), np.ascontiguousarray(xn2[valid])
    k1, k2 = camera1.k_matrix, camera2.k_matrix
    if result.config == TwoViewConfig.PLANAR_OR_PANORAMIC:
        rotation = _rotation_only(a, b, scale)
        if rotation is not None:
            result.config = TwoViewConfig.PANORAMIC
            result.cam2_from_cam1 = rigid3.from_matrix(rotation, np.zeros(3))
            result.median_angle_deg = 0.0
            return
        result.config = TwoViewConfig.PLANAR
        candidates = homography.poses_from_homography(result.homography, k1, k2)
    else:
        candidates = np.empty((0, 7))
    if len(candidates) == 0:
        essential = result.essential
        if result.config != TwoViewConfig.CALIBRATED and np.isfinite(result.fundamental).all():
            essential = epipolar.essential_from_fundamental(result.fundamental, k1, k2)
        if not np.isfinite(essential).all():
            return
        candidates = epipolar.decompose_essential(essential)
    pose, _, _ = epipolar.choose_in_front(candidates, a, b)
    pose = epipolar.refine_relative_pose(pose, a, b, 0.5 * scale)
    depths, angles = epipolar.ray_depths(pose, a, b)
    in_front = (depths > 0).all(1)
    result.cam2_from_cam1 = pose
    result.essential = epipolar.essential_from_pose(pose)
    result.median_angle_deg = float(np.degrees(np.median(angles[in_front]))) if in_front.any() else 0.0


def _rotation_only(xn1: Array, xn2: Array, scale: float) -> Array | None:
    """The rotation that explains nine in ten points, if there is one."""
    weights = np.ones(len(xn1))
    for _ in range(3):
        rotation = homography.rotation_from_rays(xn1, xn2, weights)
        error = homography.transfer_errors(rotation, xn1, xn2)
        weights = 1.0 / (1.0 + np.minimum(error, 1e12) / scale**2)
    return rotation if (error < scale**2).mean() > 0.9 else None
