"""Verification of a pair: which matches does one geometry explain, and which geometry is it?

The decision follows COLMAP's two-view geometry (Schoenberger and Frahm, "Structure-from-motion revisited", CVPR 2016):
F, E and H are each estimated robustly and their inlier counts compared.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, pixels_to_normalized, pixels_to_rays
from sfmapp.geometry import epipolar, five_point, homography, rigid3
from sfmapp.geometry.fundamental_refinement import polish_fundamental
from sfmapp.geometry.turned_views import turn_at_focal, turn_costs
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.search import (
    Ransac,
    best_relative_pose,
    essentials_of_samples,
    find_essential,
    find_fundamental,
    is_significant,
    is_significant_of_rays,
    plane_of_matches,
)
from sfmapp.matching.second_motion import PLANE_SHARE, geometry_off_plane
from sfmapp.scene.correspondences import TwoViewConfig

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Ints = NDArray[np.int64]

# COLMAP's figures for captions and time stamps burnt into photos: matches within a tenth of the diagonal from the
# border, moved all alike, and at least seven in ten of all.
_WATERMARK_BORDER_SHARE = 0.1
_WATERMARK_MIN_SHARE = 0.7
# Wrong matches that F takes up and E cannot, as it has two more numbers to fit.
_FREER = 2
# Samples of seven right matches that a search for F should have met: with that many it missed all with a probability of
# 0.001. Where it had fewer, F may have gone astray, and five matches are more often right than seven.
_SURE_SAMPLES = 6.9
# Two views that a rotation explains so well have no baseline.
_TURNED_SHARE = 0.9


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
        num_moving_alone: matches that were set aside, as they lie on a plane that moves otherwise than all else.
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
    num_moving_alone: int = 0


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
    xy1: Array,
    xy2: Array,
    camera1: Camera,
    camera2: Camera,
    options: MatchingOptions,
    ransac: Ransac,
    fundamental: Array | None = None,
) -> TwoViewGeometry:
    """Find the geometry of a pair and the matches that it explains.

    Where one of the cameras sees beyond its normalised plane, the essential matrix of unit rays is all that is looked
    for, and F and H stay NaN: no matrix maps pixels of what lies behind a camera.

    Args:
        xy1, xy2: (N, 2) float64 matched pixels.
        camera1, camera2: their focals are trusted if their source is not ``default``, else only used for the pose.
        ransac: the same gives the same answer on any thread.
        fundamental: (3, 3) that was polished on these matches, in place of a search.
    """
    if camera1.is_wide or camera2.is_wide:
        return _verify_rays(xy1, xy2, camera1, camera2, options, ransac)
    return verify_front(xy1, xy2, camera1, camera2, options, ransac, fundamental)


def verify_front(
    xy1: Array,
    xy2: Array,
    camera1: Camera,
    camera2: Camera,
    options: MatchingOptions,
    ransac: Ransac,
    fundamental: Array | None = None,
) -> TwoViewGeometry:
    """:func:`verify_pair` on what lies up to 88 degrees from the axes, however wide the lenses are."""
    if len(xy1) < max(options.min_inliers, 8):
        return TwoViewGeometry(TwoViewConfig.UNDEFINED, np.zeros(len(xy1), bool))
    result, inliers = _verify(xy1, xy2, camera1, camera2, options, ransac, fundamental)
    threshold, extent = error_threshold_px(camera1, camera2, options), (camera2.width, camera2.height)
    off_plane = geometry_off_plane(xy1, xy2, inliers.f, inliers.h, threshold, extent, options, ransac)
    if off_plane is None:
        return result
    kept = np.flatnonzero(~inliers.h)
    second, others = _verify(xy1[kept], xy2[kept], camera1, camera2, options, ransac, off_plane)
    # the plane may be a wall of the scene and the rest a thing that moves: what lies on neither tells
    off_both = ~others.h
    has_depth = (others.f & off_both).sum() > (inliers.f[kept] & off_both).sum()
    if second.config == TwoViewConfig.PLANAR:  # a facade has more than a plane that only turned
        on_plane = inliers.h
        plane, _ = _verify(xy1[on_plane], xy2[on_plane], camera1, camera2, options, ransac, None)
        has_depth &= plane.config in (TwoViewConfig.PANORAMIC, TwoViewConfig.WATERMARK)
    elif second.config not in (TwoViewConfig.CALIBRATED, TwoViewConfig.UNCALIBRATED):
        has_depth = False
    if not has_depth:
        return result
    is_inlier = np.zeros(len(xy1), bool)
    is_inlier[kept] = second.is_inlier
    second.is_inlier, second.num_moving_alone = is_inlier, int(inliers.h.sum())
    return second


def _verify(
    xy1: Array,
    xy2: Array,
    camera1: Camera,
    camera2: Camera,
    options: MatchingOptions,
    ransac: Ransac,
    fundamental: Array | None,
) -> tuple[TwoViewGeometry, _Inliers]:
    """The geometry that explains most matches, at least eight, and the inliers of each model."""
    result = TwoViewGeometry(TwoViewConfig.UNDEFINED, np.zeros(len(xy1), bool))
    threshold = error_threshold_px(camera1, camera2, options)
    inliers = _Inliers(*(np.zeros(len(xy1), bool) for _ in range(3)))
    if fundamental is None:
        fundamental = find_fundamental(xy1, xy2, threshold, ransac, min(options.min_inliers / len(xy1), 1.0))
        if fundamental is not None:
            fundamental, _ = polish_fundamental(fundamental, xy1, xy2, threshold, ransac.seed)
    if fundamental is not None:
        result.fundamental, inliers.f = fundamental, epipolar.sampson_errors(fundamental, xy1, xy2) < threshold**2
        if not is_significant(inliers.f, threshold, (camera2.width, camera2.height)):
            inliers.f[:] = False
    # a homography that holds where F does not is still worth having, so it looks at all matches in that case
    pool, least_share = inliers.f, PLANE_SHARE
    if not pool.any():
        pool, least_share = np.ones(len(xy1), bool), min(options.min_inliers / len(xy1), 1.0)
    result.homography, inliers.h = plane_of_matches(xy1, xy2, pool, threshold, ransac, least_share)
    poses = _RelativePoses(xy1, xy2, camera1, camera2, threshold)
    is_calibrated = camera1.focal_source != "default" and camera2.focal_source != "default"
    _estimate_pose(result, inliers, poses, is_calibrated, ransac, options)
    if not is_significant(inliers.e, threshold, (camera2.width, camera2.height)):
        inliers.e[:] = False
    result.num_inliers_f, result.num_inliers_e, result.num_inliers_h = (
        int(mask.sum()) for mask in (inliers.f, inliers.e, inliers.h)
    )
    _classify(result, inliers, is_calibrated, options)
    if result.config == TwoViewConfig.DEGENERATE:
        result.essential, result.cam2_from_cam1 = _no_matrix(), np.full(7, np.nan)
        return result, inliers
    _tell_planar_apart(result, inliers.h, poses, is_calibrated)
    if _is_watermark(xy1, xy2, result.is_inlier, camera1, camera2, threshold):
        result.config = TwoViewConfig.WATERMARK
    if np.isfinite(result.cam2_from_cam1).all() and result.config != TwoViewConfig.PANORAMIC:
        depths, angles = epipolar.ray_depths(result.cam2_from_cam1, *poses.subset(result.is_inlier))
        in_front = (depths > 0).all(1)
        result.median_angle_deg = float(np.degrees(np.median(angles[in_front]))) if in_front.any() else 0.0
    return result, inliers


@dataclass
class _Inliers:
    f: Mask
    e: Mask
    h: Mask


def _classify(result: TwoViewGeometry, inliers: _Inliers, is_calibrated: bool, options: MatchingOptions) -> None:
    num_f, num_e, num_h = result.num_inliers_f, result.num_inliers_e, result.num_inliers_h
    result.config = TwoViewConfig.DEGENERATE
    if is_calibrated and num_e >= options.min_inliers and num_e >= options.min_e_f_ratio * (num_f - _FREER):
        result.config = TwoViewConfig.CALIBRATED
        result.is_inlier = inliers.e if num_e >= num_f else inliers.f
    elif num_f >= options.min_inliers:
        result.config, result.is_inlier = TwoViewConfig.UNCALIBRATED, inliers.f
    elif num_h >= options.min_inliers:
        result.is_inlier = inliers.h
    if num_h >= options.min_inliers and num_h > options.max_h_ratio * result.is_inlier.sum():
        result.config = TwoViewConfig.PLANAR_OR_PANORAMIC
        if num_h > result.is_inlier.sum():
            result.is_inlier = inliers.h


class _RelativePoses:
    """Scores and refines candidates for the relative pose of a pair on a fixed subset of its matches."""

    # Enough that the pose is limited by the focal, not by the points; the adjustment has the last word anyway.
    max_points = 1000

    def __init__(
        self, xy1: Array, xy2: Array, camera1: Camera, camera2: Camera, threshold: float, *, on_rays: bool = False
    ) -> None:
        self.k1, self.k2 = camera1.k_matrix, camera2.k_matrix
        find = pixels_to_rays if on_rays else pixels_to_normalized
        self.xn1, self.xn2 = find(camera1, xy1), find(camera2, xy2)
        self.is_valid = np.isfinite(self.xn1).all(1) & np.isfinite(self.xn2).all(1)
        self.scale = 2.0 * threshold / (camera1.focal + camera2.focal)

    def subset(self, mask: Mask) -> tuple[Array, Array]:
        idx = self.thinned(mask, mask)
        return self.xn1[idx], self.xn2[idx]

    def thinned(self, mask: Mask, counted: Mask) -> Ints:
        """Positions of every so many of a mask, that of those counted (N,) no more than max_points are left."""
        step = max(-(-int((counted & self.is_valid).sum()) // self.max_points), 1)
        return np.flatnonzero(mask & self.is_valid)[::step]


def _estimate_pose(
    result: TwoViewGeometry,
    inliers: _Inliers,
    poses: _RelativePoses,
    is_calibrated: bool,
    ransac: Ransac,
    options: MatchingOptions,
) -> None:
    """Relative pose and E from all that can suggest one: F and samples among its inliers, the homography of a plane,
    and a search for E where F may have gone astray."""
    mask = inliers.f if inliers.f.any() else inliers.h
    idx = poses.thinned(np.ones(len(mask), bool) if is_calibrated else mask, mask)
    xn1, xn2 = poses.xn1[idx], poses.xn2[idx]
    pool = np.flatnonzero(mask[idx])
    if len(pool) < 8:
        return
    essentials = [essentials_of_samples(xn1[pool], xn2[pool], ransac)]
    if inliers.f.any():
        essentials.append(epipolar.essential_from_fundamental(result.fundamental, poses.k1, poses.k2)[None])
    if inliers.h.sum() > 0.5 * mask.sum():  # a plane leaves F undetermined, and with it the pose that F suggests
        motions = homography.motions_from_homography(result.homography, poses.k1, poses.k2).poses
        essentials += [epipolar.essential_from_pose(pose)[None] for pose in motions]
    # with few points, wrong poses exist that come within the threshold of all: half of it tells them from the right
    # one; a camera that is only guessed needs all of it
    limit = 0.5 * poses.scale if is_calibrated else poses.scale
    pose = best_relative_pose(np.concatenate(essentials), pool, xn1, xn2, limit)
    if pose is None:
        return
    explained = epipolar.sampson_errors(epipolar.essential_from_pose(pose), xn1[pool], xn2[pool]) < poses.scale**2
    is_astray = ransac.max_trials * mask.mean() ** 7 < _SURE_SAMPLES or explained.mean() < options.min_e_f_ratio
    if is_calibrated and is_astray:
        # of what E explains, a part of the matches that were left out of xn1 is
        needed = max(options.min_inliers, options.min_e_f_ratio * (inliers.f.sum() - _FREER))
        found = find_essential(xn1, xn2, 0.5 * poses.scale, ransac, min(needed / len(mask), 1.0))
        if found is not None:
            both = np.stack([epipolar.essential_from_pose(pose), found])
            pose = best_relative_pose(both, np.arange(len(xn1)), xn1, xn2, limit)
            assert pose is not None
    result.cam2_from_cam1, result.essential = pose, epipolar.essential_from_pose(pose)
    inliers.e = epipolar.sampson_errors(result.essential, poses.xn1, poses.xn2) < poses.scale**2


def _verify_rays(
    xy1: Array, xy2: Array, camera1: Camera, camera2: Camera, options: MatchingOptions, ransac: Ransac
) -> TwoViewGeometry:
    """The essential matrix that explains most matches of views in all directions, or the rotation between them."""
    result = TwoViewGeometry(TwoViewConfig.UNDEFINED, np.zeros(len(xy1), bool))
    if len(xy1) < max(options.min_inliers, 8):
        return result
    threshold = error_threshold_px(camera1, camera2, options)
    poses = _RelativePoses(xy1, xy2, camera1, camera2, threshold, on_rays=True)
    a, b = poses.subset(np.ones(len(xy1), bool))
    # half the threshold, as for the essential matrix of a plane: of the poses within it the better one
    essential = five_point.find_essential(a, b, 0.5 * poses.scale, ransac.max_trials, ransac.seed)
    result.config = TwoViewConfig.DEGENERATE
    if essential is None:
        return result
    pool = np.flatnonzero(epipolar.sampson_errors(essential, a, b) < poses.scale**2)
    pose = best_relative_pose(essential[None], pool, a, b, 0.5 * poses.scale)
    if pose is None:
        return result
    essential = epipolar.essential_from_pose(pose)
    depths, angles = epipolar.ray_depths(pose, poses.xn1, poses.xn2)
    # a great circle goes all round: what lies far away is in front of both within the noise
    meets = (depths > 0).all(1) | (angles <= poses.scale)
    inlier = meets & (epipolar.sampson_errors(essential, poses.xn1, poses.xn2) < poses.scale**2)  # False for NaN
    result.num_inliers_e = int(inlier.sum())
    if result.num_inliers_e < options.min_inliers or not is_significant_of_rays(inlier, poses.scale):
        return result
    result.config, result.is_inlier, result.essential, result.cam2_from_cam1 = (
        TwoViewConfig.CALIBRATED, inlier, essential, pose,
    )  # fmt: skip
    result.median_angle_deg = float(np.degrees(np.median(angles[inlier])))
    rotation, is_turned = _turn_of_rays(*poses.subset(inlier), poses.scale)
    if is_turned.mean() > _TURNED_SHARE:
        result.config, result.essential, result.median_angle_deg = TwoViewConfig.PANORAMIC, _no_matrix(), 0.0
        result.cam2_from_cam1 = rigid3.from_matrix(rotation, np.zeros(3))
    elif _is_watermark(xy1, xy2, inlier, camera1, camera2, threshold):
        result.config = TwoViewConfig.WATERMARK
    return result


def _turn_of_rays(a: Array, b: Array, scale: float) -> tuple[Array, Mask]:
    """The rotation (3, 3) that takes most of the unit rays a (N, 3) to b, and which are within the scale (radians)."""
    weights = np.ones(len(a))
    for _ in range(3):
        rotation = homography.rotation_from_rays(a, b, weights)
        error = ((a @ rotation.T - b) ** 2).sum(1) / scale**2
        weights = 1.0 / (1.0 + error)
    return rotation, error < 1.0


def _is_watermark(xy1: Array, xy2: Array, inlier: Mask, camera1: Camera, camera2: Camera, threshold: float) -> bool:
    in_border = inlier.copy()
    for xy, camera in ((xy1, camera1), (xy2, camera2)):
        border = _WATERMARK_BORDER_SHARE * math.hypot(camera.width, camera.height)
        x, y = xy.T
        in_border &= (x < border) | (x > camera.width - border) | (y < border) | (y > camera.height - border)
    num_inliers = inlier.sum()
    if in_border.sum() < _WATERMARK_MIN_SHARE * num_inliers:
        return False
    # with more than half of them moved alike, the median is one of those
    shift = (xy2 - xy1)[in_border]
    moved_alike = np.linalg.norm(shift - np.median(shift, axis=0), axis=1) < threshold
    return bool(moved_alike.sum() >= _WATERMARK_MIN_SHARE * num_inliers)


def _tell_planar_apart(result: TwoViewGeometry, inlier_h: Mask, poses: _RelativePoses, is_calibrated: bool) -> None:
    """Decide PLANAR or PANORAMIC: does a rotation alone explain nine in ten of what a homography does?

    If so, there is no parallax, and what no homography explains is wrong even if an epipolar line passes by. The focal
    need not be known: a pure rotation shows itself at one focal or another. A guess of 1.2 times the larger side is
    right within a factor of two for nearly all lenses, a focal from EXIF within 30 %.
    """
    if result.config != TwoViewConfig.PLANAR_OR_PANORAMIC:
        return
    result.config = TwoViewConfig.PLANAR
    a, b = poses.subset(inlier_h)
    few = slice(None, None, max(len(a) // 200, 1))
    log_focal, reach = 0.0, math.log(1.3 if is_calibrated else 2.0)
    for _ in range(3):  # a grid within a grid leaves 2 % of focal, then 0.5 %
        rotation, errors = turn_at_focal(a, b, poses.scale, log_focal)
        if (errors < 1.0).mean() > _TURNED_SHARE:
            result.config, result.is_inlier = TwoViewConfig.PANORAMIC, inlier_h
            result.cam2_from_cam1 = rigid3.from_matrix(rotation, np.zeros(3))
            result.essential, result.median_angle_deg = _no_matrix(), 0.0
            return
        trials = log_focal + reach * np.linspace(-1.0, 1.0, 9)
        log_focal = float(trials[np.argmin(turn_costs(a[few], b[few], poses.scale, trials))])
        reach *= 0.25
