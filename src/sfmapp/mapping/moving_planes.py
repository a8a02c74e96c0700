"""Something flat in every picture that is no part of the scene: its matches, told by the pairs that show the scene.

A poster held into every photograph, or a bonnet, matches best between photographs that share nothing else, which then
look as if they were taken from one place. But where the scene prevails, the geometry of a pair knows nothing of the
plane, and the tracks of the plane run through such pairs, off their epipolar lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.scene.correspondences import Correspondences, TwoViewConfig
from sfmapp.scene.tracks import Tracks

# Pairs that one plane or one turn explains, and pairs with a geometry of their own.
_FLAT = (TwoViewConfig.PLANAR, TwoViewConfig.PANORAMIC, TwoViewConfig.PLANAR_OR_PANORAMIC)
_GENERAL = (TwoViewConfig.CALIBRATED, TwoViewConfig.UNCALIBRATED)
# A geometry that so many matches agree on is believed against those of others.
_MIN_INLIERS = 50
# Distance from the epipolar lines as a share of the diagonal: twice the tolerance of verification.
_MAX_ERROR_SHARE = 0.004
# A flat pair is of a moving plane if most of its matches, and enough of them, lie on tracks that contradict the scene;
# so many such pairs are no accident.
_MIN_SHARE, _MIN_MATCHES, _MIN_PAIRS = 0.5, 30, 3


def without_moving_planes(
    correspondences: Correspondences, tracks: Tracks, cameras: Sequence[Camera], image_camera_idx: NDArray[np.int32]
) -> tuple[Correspondences, int]:
    """Correspondences without what moves by itself in many photographs.

    Args:
        correspondences: verified matches.
        tracks: that they make.
        cameras, image_camera_idx: for the sizes of the images.

    Returns:
        The same object, and 0, where there is nothing to take out; else others, and the number of flat pairs that were
        of a moving plane. Pairs that lose nearly all matches fail.
    """
    c = correspondences
    is_general = np.isin(c.config, _GENERAL) & (c.num_inliers >= _MIN_INLIERS)
    is_flat = np.isin(c.config, _FLAT) & (c.num_inliers >= _MIN_MATCHES)
    is_general &= np.isfinite(c.fundamental).all(axis=(1, 2))
    if is_flat.sum() < _MIN_PAIRS or not is_general.any():
        return c, 0
    moving = _contradicting_tracks(c, np.flatnonzero(is_general), tracks, cameras, image_camera_idx)
    is_moving = np.concatenate([_of_moving_tracks(c, p, tracks, moving) for p in range(c.num_pairs)])
    pair_of_match = np.repeat(np.arange(c.num_pairs), np.diff(c.pair_ptr))
    num_moving = np.bincount(pair_of_match[is_moving], minlength=c.num_pairs)
    of_plane = is_flat & (num_moving >= _MIN_MATCHES) & (num_moving > _MIN_SHARE * c.num_inliers)
    if of_plane.sum() < _MIN_PAIRS:
        return c, 0
    # what such a pair has besides is chance, and what others have of the plane is not of the scene
    dropped = is_moving | of_plane[pair_of_match]
    left = np.bincount(pair_of_match[~dropped], minlength=c.num_pairs)
    pruned = replace(
        c,
        pair_ptr=np.concatenate([[0], np.cumsum(left)]),
        matches=c.matches[~dropped],
        config=np.where(of_plane, np.int8(TwoViewConfig.DEGENERATE), c.config).astype(np.int8),
    )
    return pruned, int(of_plane.sum())


def _contradicting_tracks(
    c: Correspondences,
    general: NDArray[np.int64],
    tracks: Tracks,
    cameras: Sequence[Camera],
    image_camera_idx: NDArray[np.int32],
) -> NDArray[np.bool_]:
    """(T,) bool: tracks that more of the pairs with a general geometry contradict than support."""
    images = c.pair_image_idx[general].astype(np.int64)
    keys = images[:, 0] * tracks.num_images + images[:, 1]
    order = np.argsort(keys)
    diagonal = np.array([np.hypot(camera.width, camera.height) for camera in cameras])[image_camera_idx]
    limit = _MAX_ERROR_SHARE * diagonal[images].max(axis=1)
    balance = _balance(
        tracks.track_ptr, tracks.obs_image_idx, tracks.obs_xy, tracks.num_images, keys[order],
        np.ascontiguousarray(c.fundamental[general][order]), limit[order] ** 2,
    )  # fmt: skip
    return balance < 0


@numba.njit(cache=True, nogil=True)
def _balance(
    track_ptr: NDArray[np.int64],
    obs_image_idx: NDArray[np.int32],
    obs_xy: NDArray[np.float64],
    num_images: int,
    keys: NDArray[np.int64],
    fundamental: NDArray[np.float64],
    limit2: NDArray[np.float64],
) -> NDArray[np.int64]:
    """(T,) pairs of observations within the epipolar tolerance less those beyond it; keys i * num_images + j sorted."""
    out = np.zeros(len(track_ptr) - 1, np.int64)
    for t in range(len(out)):
        for a in range(track_ptr[t], track_ptr[t + 1]):
            for b in range(a + 1, track_ptr[t + 1]):
                key = obs_image_idx[a] * num_images + obs_image_idx[b]
                p = np.searchsorted(keys, key)
                if p == len(keys) or keys[p] != key:
                    continue
                f = fundamental[p]
                x, y, u, v = obs_xy[a, 0], obs_xy[a, 1], obs_xy[b, 0], obs_xy[b, 1]
                l0 = f[0, 0] * x + f[0, 1] * y + f[0, 2]
                l1 = f[1, 0] * x + f[1, 1] * y + f[1, 2]
                l2 = f[2, 0] * x + f[2, 1] * y + f[2, 2]
                m0 = f[0, 0] * u + f[1, 0] * v + f[2, 0]
                m1 = f[0, 1] * u + f[1, 1] * v + f[2, 1]
                product = u * l0 + v * l1 + l2
                out[t] += 1 if product * product <= limit2[p] * (l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1) else -1
    return out


def _of_moving_tracks(
    c: Correspondences, pair_idx: int, tracks: Tracks, moving: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """(K,) bool: matches of a pair both of whose keypoints lie on contradicting tracks."""
    matches = c.matches_of_pair(pair_idx)
    result = np.ones(len(matches), bool)
    for side in range(2):
        obs = tracks.observations_of_image(c.pair_image_idx[pair_idx, side])
        features = tracks.obs_feature_idx[obs]
        is_moving = np.zeros(1 + max(features.max(initial=0), matches[:, side].max(initial=0)), bool)
        is_moving[features] = moving[tracks.obs_track_idx[obs]]
        result &= is_moving[matches[:, side]]
    return result
