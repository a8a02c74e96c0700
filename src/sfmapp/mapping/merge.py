"""Joining two models that share images or points: the similarity between them, and the union in one world.

Tracks are the same in all models, so a track that is triangulated in two of them is a 3D-3D correspondence, and an
image registered in both gives rotation and position at once; what is left is the scale: the common points vote on it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3, similarity
from sfmapp.scene.reconstruction import Reconstruction

# Common points that must agree on the scale, and the probability that as many do by chance through one image. Where
# distances scatter by a third, eight of eight do within the tolerance in one case of four million, but of a hundred
# thirteen as a rule: the more there are, the more have to.
MIN_COMMON_POINTS, MAX_CHANCE = 8, 1e-4
# Depths of points near the edge of a model are good to a few per cent.
SCALE_TOLERANCE = 0.05


def similarity_through_image(
    target: Reconstruction, source: Reconstruction, image_idx: int
) -> tuple[NDArray[np.float64], int] | None:
    """The similarity between the worlds of two models, from an image that both have.

    Args:
        target, source: models over the same tracks.
        image_idx: registered in both.

    Returns:
        ``target_from_source`` (8,) as in :mod:`sfmapp.geometry.similarity`, and the number of common points that agree
        on the scale; None if fewer than MIN_COMMON_POINTS do, or no more than may by chance.
    """
    common = np.flatnonzero(target.is_triangulated & source.is_triangulated)
    if len(common) < MIN_COMMON_POINTS:
        return None
    in_target = rigid3.apply(target.cam_from_world[image_idx], target.point_xyz[common])
    in_source = rigid3.apply(source.cam_from_world[image_idx], source.point_xyz[common])
    cameras = (model.cameras[model.image_camera_idx[image_idx]] for model in (target, source))
    in_front = (in_target[:, 2] > 0) & (in_source[:, 2] > 0)
    if any(camera.is_wide for camera in cameras):  # it may see them behind it; their directions are compared below
        in_front[:] = True
    of_target, of_source = (np.log(np.linalg.norm(points[in_front], axis=1)) for points in (in_target, in_source))
    ratios = of_target - of_source
    if len(ratios) < MIN_COMMON_POINTS:
        return None
    # the ratio that most others agree with, then the median of those
    order = np.sort(ratios)
    ends = np.searchsorted(order, order + SCALE_TOLERANCE, side="right")
    agreeing = ends - np.searchsorted(order, order - SCALE_TOLERANCE)
    near = np.abs(ratios - order[np.argmax(agreeing)]) <= SCALE_TOLERANCE
    # directions count too: a common point must lie in the same direction from the shared image
    cosine = (in_target[in_front] * in_source[in_front]).sum(1) / (
        np.linalg.norm(in_target[in_front], axis=1) * np.linalg.norm(in_source[in_front], axis=1)
    )
    near &= cosine > np.cos(SCALE_TOLERANCE)
    if near.sum() < max(MIN_COMMON_POINTS, _fewest_beyond_chance(of_target, of_source)):
        return None
    scale = float(np.exp(np.median(ratios[near])))
    # through the frame of the shared image: source to camera, scaled, camera to target
    target_from_camera = np.append(rigid3.inverse(target.cam_from_world[image_idx]), scale)
    camera_from_source = np.append(source.cam_from_world[image_idx], 1.0)
    return similarity.compose(target_from_camera, camera_from_source), int(near.sum())


def _fewest_beyond_chance(of_target: NDArray[np.float64], of_source: NDArray[np.float64]) -> int:
    """How many of N ratios must lie within the tolerance of one of them to be no work of chance; logarithms (N,) of the
    distances in both models.

    If these had nothing to do with each other, their ratios would scatter by as much as both together, and a window
    about the most likely one would hold at most a share p of them: N windows, each with a binomial number of others.
    """
    # standard deviations by the quartiles, whatever the tails are
    scatter = float(np.hypot(*(np.subtract(*np.quantile(d, [0.75, 0.25])) / 1.349 for d in (of_target, of_source))))
    num = len(of_target)
    share = min(1.0, 2.0 * SCALE_TOLERANCE / (np.sqrt(2.0 * np.pi) * max(scatter, 1e-12)))
    chance = num * binomial_tails(num - 1, share)  # of so many others or more
    return 1 + int(np.argmax(np.append(chance, 0.0) <= MAX_CHANCE))


def binomial_tails(num: int, share: float) -> NDArray[np.float64]:
    """(num + 1,) probabilities that k or more of num happen, k = 0 ... num, where each does with probability share.

    Written out, for scipy.special takes 0.1 s to load, a tenth of mapping a few photographs.
    """
    if share >= 1.0:
        return np.ones(num + 1)
    k = np.arange(num + 1)
    log_factorial = np.append(0.0, np.cumsum(np.log(k[1:])))
    log_chance = log_factorial[-1] - log_factorial - log_factorial[::-1]
    log_chance += k * np.log(share) + (num - k) * np.log1p(-share)
    return np.cumsum(np.exp(log_chance)[::-1])[::-1]


def merge(target: Reconstruction, source: Reconstruction, target_from_source: NDArray[np.float64]) -> Reconstruction:
    """A copy of the target with the images, points and observations that only the source has.

    Args:
        target, source: models over the same tracks.
        target_from_source: (8,) as returned by :func:`similarity_through_image`.
    """
    out = target.copy()
    new = np.flatnonzero(source.is_registered & ~target.is_registered)
    out.cam_from_world[new] = similarity.transform_poses(target_from_source, source.cam_from_world[new])
    points = np.flatnonzero(source.is_triangulated & ~target.is_triangulated)
    out.point_xyz[points] = similarity.apply(target_from_source, source.point_xyz[points])
    is_new = np.zeros(len(out.point_xyz), bool)
    is_new[points] = True
    taken = is_new[out.tracks.obs_track_idx]
    out.obs_is_inlier[taken] = source.obs_is_inlier[taken]
    out.point_rgb[points] = source.point_rgb[points]
    # cameras that the target has not met come as the source refined them
    known = np.isin(np.arange(len(out.cameras)), target.image_camera_idx[target.is_registered])
    for camera_idx in np.unique(source.image_camera_idx[new]):
        if not known[camera_idx]:
            out.cameras[camera_idx] = source.cameras[camera_idx]
    return out


def find_merge(target: Reconstruction, source: Reconstruction) -> tuple[NDArray[np.float64], int] | None:
    """The similarity between two models through the shared image that most common points agree with, or None."""
    shared = np.flatnonzero(target.is_registered & source.is_registered)
    found = [similarity_through_image(target, source, int(i)) for i in shared]
    return max((f for f in found if f is not None), key=lambda f: f[1], default=None)


def num_linking_points(union: Reconstruction, new: NDArray[np.bool_], old: NDArray[np.bool_]) -> int:
    """Points of a union that both a new and an old image (masks, (I,) bool) observe: what holds it together."""
    used, image, track = union.obs_is_inlier, union.tracks.obs_image_idx, union.tracks.obs_track_idx
    seen = np.zeros((2, union.tracks.num_tracks), bool)
    seen[0, track[used & new[image]]] = True
    seen[1, track[used & old[image]]] = True
    return int(seen.all(axis=0).sum())
