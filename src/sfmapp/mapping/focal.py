"""A first focal length from pairs of images, where neither the user nor EXIF knows one.

Each pair with its fundamental matrix has, for a trial focal length, a best relative pose; what its matches lose
against the best trial is the pair's evidence. Summed over many pairs with a wide prior this is a profile likelihood in
one unknown (cf. Sturm et al., "Focal length calibration from two views", ECCV 2005, which reads it off one F). The
asymmetry of the singular values of K^T F K (Mendonca and Cipolla, CVPR 1999) misleads where the optical axes meet or
the motion is planar, as on a turntable; the likelihood is merely flat there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, pixels_to_normalized
from sfmapp.geometry import epipolar, rigid3
from sfmapp.geometry.relative_pose import refine_relative_pose
from sfmapp.mapping.report import FocalReport
from sfmapp.scene.correspondences import Correspondences, TwoViewConfig
from sfmapp.scene.tracks import Tracks

Array = NDArray[np.float64]

# Multiples of max(width, height): 120 to 14 degrees of view across the longer side, in steps of 1.38; around the best
# of them steps of 1.08, about what the first adjustment needs.
COARSE_RATIOS = np.geomspace(0.3, 4.0, 9)
FINE_STEPS = np.geomspace(1 / 1.26, 1.26, 7)
# Log-normal prior around the default 1.2 max(w, h): one sigma reaches from 0.66 to 2.2, phone wide to short tele.
PRIOR_RATIO, PRIOR_LOG_SIGMA = 1.2, 0.6
# Bounds on the work: the strongest pairs, and an even sample of their matches.
MAX_PAIRS, MAX_MATCHES = 20, 150


def estimate_focal_ratio(
    cameras: list[Camera], image_camera_idx: NDArray[np.int32], correspondences: Correspondences, tracks: Tracks
) -> tuple[float | None, FocalReport]:
    """The focal length as a multiple of max(width, height) that the pairs of default cameras agree on.

    Args:
        cameras, image_camera_idx: of the images; only cameras whose focal_source is ``default`` take part.
        correspondences: verified pairs with fundamental matrices.
        tracks: the observations behind them.

    Returns:
        The ratio, or None where the pairs do not prefer one clearly to the default, and the numbers behind that.
    """
    unknown = np.array([c.focal_source == "default" and not c.is_fixed for c in cameras], bool)
    pairs = np.flatnonzero(
        unknown[image_camera_idx[correspondences.pair_image_idx]].all(axis=1)
        & np.isin(correspondences.config, (TwoViewConfig.UNCALIBRATED, TwoViewConfig.CALIBRATED))
        & np.isfinite(correspondences.fundamental[:, 0, 0])
    )
    pairs = pairs[np.argsort(-correspondences.num_inliers[pairs], kind="stable")][:MAX_PAIRS]
    if len(pairs) == 0:
        return None, FocalReport(num_pairs=0)
    samples = [_sample(image_camera_idx, correspondences, tracks, int(pair)) for pair in pairs]
    coarse = _total_loss(COARSE_RATIOS, cameras, samples)
    fine_ratios = COARSE_RATIOS[np.argmin(coarse)] * FINE_STEPS
    fine = _total_loss(fine_ratios, cameras, samples)
    ratio, least = float(fine_ratios[np.argmin(fine)]), float(fine.min())
    at_default = float(_total_loss(np.array([PRIOR_RATIO]), cameras, samples)[0])
    report = FocalReport(num_pairs=len(pairs), ratio=ratio, loss=least, loss_at_default=at_default)
    # a log-likelihood ratio of 4.5 is three standard deviations
    return (ratio if at_default - least > 4.5 else None), report


def matched_pixels(
    tracks: Tracks, correspondences: Correspondences, pair_idx: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(K, 2) pixels of the verified matches of a pair in both images, as far as tracks hold them together."""
    matches = correspondences.matches_of_pair(pair_idx)
    sides = []
    for side in range(2):
        obs = tracks.observations_of_image(correspondences.pair_image_idx[pair_idx, side])
        features = tracks.obs_feature_idx[obs]
        obs_of_feature = np.full(1 + max(features.max(initial=0), matches[:, side].max(initial=0)), -1)
        obs_of_feature[features] = obs
        sides.append(obs_of_feature[matches[:, side]])
    tracked = (sides[0] >= 0) & (sides[1] >= 0)
    first, second = sides[0][tracked], sides[1][tracked]
    together = tracks.obs_track_idx[first] == tracks.obs_track_idx[second]
    return tracks.obs_xy[first[together]], tracks.obs_xy[second[together]]


@dataclass(frozen=True)
class _Sample:
    """A pair as the search needs it: its F, which cameras took it, and some of its matched pixels."""

    fundamental: Array
    camera_idx: tuple[int, int]
    pixels: tuple[Array, Array]


def _sample(
    image_camera_idx: NDArray[np.int32], correspondences: Correspondences, tracks: Tracks, pair_idx: int
) -> _Sample:
    first, second = (int(image_camera_idx[i]) for i in correspondences.pair_image_idx[pair_idx])
    xy1, xy2 = matched_pixels(tracks, correspondences, pair_idx)
    step = max(1, len(xy1) // MAX_MATCHES)
    return _Sample(correspondences.fundamental[pair_idx], (first, second), (xy1[::step], xy2[::step]))


def _total_loss(ratios: Array, cameras: list[Camera], samples: list[_Sample]) -> Array:
    """(K,) negative log of posterior for each trial ratio, up to a constant."""
    total: Array = 0.5 * (np.log(ratios / PRIOR_RATIO) / PRIOR_LOG_SIGMA) ** 2
    total += [_loss(float(ratio), cameras, samples) for ratio in ratios]
    return total


def _loss(ratio: float, cameras: list[Camera], samples: list[_Sample]) -> float:
    """Robust negative log-likelihood of the matches of all pairs for a trial focal length."""
    taking_part = {idx for sample in samples for idx in sample.camera_idx}
    trials = {i: cameras[i].with_focal(ratio * max(cameras[i].width, cameras[i].height)) for i in taking_part}
    focals = {i: trial.focal for i, trial in trials.items()}
    matrices = {i: trial.k_matrix for i, trial in trials.items()}
    k1, k2 = (np.array([matrices[sample.camera_idx[side]] for sample in samples]) for side in range(2))
    fundamentals = np.array([sample.fundamental for sample in samples])
    poses = epipolar.decompose_essential(epipolar.essential_from_fundamental(fundamentals, k1, k2))
    rotations, loss = rigid3.rotation_matrix(poses), 0.0
    for n, sample in enumerate(samples):
        focal = 0.5 * sum(focals[i] for i in sample.camera_idx)
        x1, x2 = (pixels_to_normalized(trials[i], xy) for i, xy in zip(sample.camera_idx, sample.pixels, strict=True))
        pose = poses[n, epipolar.most_in_front(rotations[n], poses[n, :, 4:], x1, x2)]
        # keypoints are good to about a pixel; a smaller scale would call model errors such as distortion evidence
        pose = refine_relative_pose(pose, x1, x2, 1.0 / focal, max_iterations=4)
        squared = epipolar.sampson_errors(epipolar.essential_from_pose(pose), x1, x2) * focal**2
        loss += float(np.log1p(squared).sum())
    return loss
