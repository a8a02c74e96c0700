"""Relative poses that pairs have by themselves, held against those of a model at the noise of their matches.

A map may be bent and explain nearly all matches within the tolerance of verification, several times their noise: one
that began with a pair which a few matches of things that look alike had bent, or two parts that were joined at a wrong
scale. What each pair shows by itself speaks against it: a relative pose of its own that comes much nearer to its
matches than that of the model, which a wrong lens or a moving thing does not give to many pairs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import bearings
from sfmapp.contradictions import Contradiction
from sfmapp.geometry import epipolar, rigid3
from sfmapp.geometry.fit import robust_sigma
from sfmapp.mapping.focal import matched_pixels
from sfmapp.mapping.report import NUM_NAMED, NamedPair
from sfmapp.mapping.tracks import USELESS_CONFIGS
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.search import Ransac, essentials_of_samples, relative_pose_at_noise
from sfmapp.matching.two_view import error_threshold_px
from sfmapp.scene.correspondences import Correspondences, TwoViewConfig
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

SUBJECT = "relative poses of pairs"

# Pairs of fewer matches are left out, and of the others those with most of them are enough to tell.
_MIN_MATCHES, _MOST_PAIRS = 45, 100
# A pair is looked at closely where its matches are so many times as far from the model as from its own F, which has
# two numbers more to fit and may be bent as well.
_LOOKED_AT = 1.1
# Squared residuals count up to three standard deviations.
_MOST_SQUARED = 9.0
# A model is bent where pairs gain more than this in the mean over their matches. Right models of films of three
# rendered rooms and of two sets of photographs have 0.014 and less, two of a fourth room that were bent by a tenth of
# their size 0.93 and 0.11. Sets that had no part in the choice: four of photographs 0.010 and less, two right towns
# 0.000 and 0.022, one that was put together wrongly 0.10.
_BENT = 0.04
# A pair speaks against it from here on: of right models no pair of 45 matches gained more than 0.35, and few 0.2.
_AGAINST = 0.2


class _Motion(NamedTuple):
    """What a pair says: gain in log-likelihood by its own relative pose, of each match; and how far that is from the
    model's: an angle in degrees and the way of the second centre in the unit of the model."""

    pair_idx: int
    num_matches: int
    gain: float
    turn_deg: float
    shift: float


def contradiction_of(model: Reconstruction, correspondences: Correspondences) -> list[Contradiction]:
    """That a model is bent by what its pairs show, in a list of one or none."""
    found = _motions(model, correspondences)
    if not found:
        return []
    matches, gains = (np.array([motion[k] for motion in found], np.float64) for k in (1, 2))
    mean = float((matches * gains).sum() / matches.sum())
    if mean <= _BENT:
        return []
    against = sorted((motion for motion in found if motion.gain > _AGAINST), key=lambda m: -m.gain * m.num_matches)
    if not against:
        return []
    named = [
        NamedPair(
            images=[model.image_names[i] for i in correspondences.pair_image_idx[motion.pair_idx]],
            num_matches=motion.num_matches,
        )
        for motion in against[:NUM_NAMED]
    ]
    turn, shift = (float(np.median([motion[k] for motion in against])) for k in (3, 4))
    centers = model.centers[model.is_registered]
    spread = max(float(np.sqrt(((centers - centers.mean(0)) ** 2).sum(1).mean())), 1e-12)
    first, second = named[0].images
    message = (
        f"the model is bent: {len(against)} of {len(found)} pairs come much nearer to their matches by relative poses "
        f"of their own, turned from the model's by {turn:.1f} degrees in the median, {first} and {second} first"
    )
    return [
        Contradiction(
            SUBJECT,
            message,
            "things that look alike may have been confused, or views with little parallax bent the model: add "
            "photographs from farther apart, or give a calibration",
            {
                "num_pairs": len(found), "num_pairs_against": len(against), "mean_gain": mean, "limit": _BENT,
                "median_turn_deg": turn, "median_shift_share": shift / spread, "pairs": named,
            },
            # about and along each axis
            rotation_sigma_deg=turn / np.sqrt(3.0), position_sigma_share=shift / spread / np.sqrt(3.0),
        )
    ]  # fmt: skip


def _motions(model: Reconstruction, correspondences: Correspondences) -> list[_Motion]:
    """Of the pairs with most matches between images of the model that are more than a turn on the spot."""
    images = correspondences.pair_image_idx
    without = (*USELESS_CONFIGS, TwoViewConfig.PANORAMIC)
    useful = model.is_registered[images].all(axis=1) & ~np.isin(correspondences.config, without)
    useful &= correspondences.num_inliers >= _MIN_MATCHES
    pairs = np.flatnonzero(useful)
    pairs = pairs[np.argsort(-correspondences.num_inliers[pairs], kind="stable")][:_MOST_PAIRS]
    found = [_motion(model, correspondences, int(p)) for p in pairs]
    return [motion for motion in found if motion is not None]


def _motion(model: Reconstruction, correspondences: Correspondences, pair_idx: int) -> _Motion | None:
    first, second = (int(i) for i in correspondences.pair_image_idx[pair_idx])
    cameras = (model.cameras[model.image_camera_idx[first]], model.cameras[model.image_camera_idx[second]])
    if any(camera.is_wide for camera in cameras):
        return None
    x1, x2 = bearings(cameras, matched_pixels(model.tracks, correspondences, pair_idx))
    valid = ~(np.isnan(x1) | np.isnan(x2)).any(axis=1)
    x1, x2 = x1[valid], x2[valid]
    in_model = rigid3.compose(model.cam_from_world[second], rigid3.inverse(model.cam_from_world[first]))
    length = float(np.linalg.norm(in_model[4:]))
    if len(x1) < _MIN_MATCHES or length == 0.0:
        return None
    in_model[4:] /= length
    essential = epipolar.essential_from_pose(in_model)
    by_model = epipolar.sampson_errors(essential, x1, x2)
    # twice the tolerance of verification: pairs that are off by more are told by verified_pairs, or overruled there
    threshold = error_threshold_px(*cameras, MatchingOptions()) / (cameras[0].focal + cameras[1].focal)
    if np.median(by_model) > (4.0 * threshold) ** 2:
        return None
    fundamental = correspondences.fundamental[pair_idx]
    if np.isfinite(fundamental).all():
        by_f = epipolar.sampson_errors(cameras[1].k_matrix.T @ fundamental @ cameras[0].k_matrix, x1, x2)
        if np.median(by_model) <= _LOOKED_AT**2 * np.median(by_f):
            return _Motion(pair_idx, len(x1), 0.0, 0.0, 0.0)
    candidates = np.concatenate([essential[None], essentials_of_samples(x1, x2, Ransac(0, 0))])
    own = relative_pose_at_noise(candidates, x1, x2, threshold)
    if own is None:
        return _Motion(pair_idx, len(x1), 0.0, 0.0, 0.0)
    by_own = epipolar.sampson_errors(epipolar.essential_from_pose(own), x1, x2)
    variance = max(robust_sigma(by_own, 1), 1e-3 * threshold) ** 2
    costs = [float(np.minimum(squared / variance, _MOST_SQUARED).mean()) / 2.0 for squared in (by_model, by_own)]
    between = rigid3.compose(own, rigid3.inverse(in_model))
    turn = float(rigid3.rotation_angle_deg(rigid3.rotation_matrix(between)))
    shift = length * float(np.linalg.norm(rigid3.center(own) - rigid3.center(in_model)))
    return _Motion(pair_idx, len(x1), costs[0] - costs[1], turn, shift)
