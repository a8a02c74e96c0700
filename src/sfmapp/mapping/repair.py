"""Parts of a model that hang loosely on the rest: found by the points that are torn, and joined again.

Where a few photographs came in together with wrong poses, they agree with each other and with next to nothing else:
points that they see as well as the rest are points for one of the two sides only. Their pairs with the rest may still
pass, as an epipolar line is long. Such a part is taken out whole and joined again as if it were a model of its own.
"""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Events
from sfmapp.mapping.join import find_joint, holds_together, unite
from sfmapp.mapping.mapper import STAGE, Mapper
from sfmapp.mapping.options import MappingOptions
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.reconstruction import Reconstruction

# Share of the points seen by two images that must hold for both if they are to hold each other: a sound model has more
# than 0.7 even where mismatches are many, two parts at wrong places less than a fifth.
MIN_HELD = 0.5
# Counts between all pairs of images are kept in an array; beyond so many images this would be more than 0.2 GB.
MAX_IMAGES = 5000


def repaired(
    model: Reconstruction,
    correspondences: Correspondences,
    mapper_of: Callable[[Reconstruction], Mapper],
    options: MappingOptions,
    events: Events,
) -> Reconstruction:
    """The model with its loose parts joined again where more points hold then, else as it is."""
    for part in loose_parts(model, options.min_pose_inliers):
        rest = model.is_registered & ~part
        halves = [_only(model, side, mapper_of) for side in (rest, part)]
        joint = find_joint(halves[0], halves[1], correspondences, options)
        if joint.reason:
            continue
        union = unite(halves[0], halves[1], joint, mapper_of, options)
        before, after = (_held_between(each, rest, part) for each in (model, union))
        if after <= before or holds_together(union, halves[0], halves[1], correspondences, options):
            continue
        events.decided(
            STAGE,
            f"{int(part.sum())} weakly connected images were joined to the model again: they now share {after} points "
            f"with the rest, {before} before",
        )
        model = union
    return model


def loose_parts(model: Reconstruction, min_points: int) -> list[NDArray[np.bool_]]:
    """(I,) bool images of each part that the largest one does not hold though they see the same points; few points
    (fewer than ``min_points``) hold nothing, and a part of one image has no points of its own.
    """
    if len(model.image_names) > MAX_IMAGES:
        return []
    seen, held = _points_between(model)
    holds = (held >= min_points) & (held >= MIN_HELD * seen)
    label = np.full(len(seen), -1)
    for i in model.registered_idx:
        if label[i] < 0:
            reached = np.arange(len(seen)) == i
            while (more := reached | holds[reached].any(axis=0)).sum() > reached.sum():
                reached = more
            label[reached] = i
    labels, sizes = np.unique(label[label >= 0], return_counts=True)
    if len(labels) < 2:
        return []
    largest = label == labels[np.argmax(sizes)]
    parts = [label == part for part, size in zip(labels, sizes, strict=True) if size >= 2]
    return [
        part for part in parts
        if not (part & largest).any() and seen[np.ix_(part, model.is_registered & ~part)].max() >= 2 * min_points
    ]  # fmt: skip


def _only(
    model: Reconstruction, images: NDArray[np.bool_], mapper_of: Callable[[Reconstruction], Mapper]
) -> Reconstruction:
    """The model of some of its images, with the points that these alone make."""
    part = model.copy()
    part.cam_from_world[~images] = np.nan
    part.point_xyz[:] = np.nan
    part.obs_is_inlier[:] = False
    mapper_of(part).triangulate_images(np.flatnonzero(images).tolist())
    return part


def _held_between(model: Reconstruction, first: NDArray[np.bool_], second: NDArray[np.bool_]) -> int:
    """Points that images of both sides support."""
    tracks, used = model.tracks, model.obs_is_inlier
    holds = np.zeros((2, tracks.num_tracks), bool)
    for n, side in enumerate((first, second)):
        holds[n, tracks.obs_track_idx[used & side[tracks.obs_image_idx]]] = True
    return int(holds.all(axis=0).sum())


def _points_between(model: Reconstruction) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """(I, I) points of the model that two registered images see, and (I, I) those that both support."""
    num_images = len(model.image_names)
    seen, held = np.zeros((num_images, num_images), np.int32), np.zeros((num_images, num_images), np.int32)
    tracks = model.tracks
    _count_points(
        tracks.track_ptr, tracks.obs_image_idx, model.obs_is_inlier, model.is_registered, model.is_triangulated, seen,
        held,
    )  # fmt: skip
    return seen, held


@numba.njit(cache=True, nogil=True)
def _count_points(
    track_ptr: NDArray[np.int64],
    obs_image_idx: NDArray[np.int32],
    obs_is_inlier: NDArray[np.bool_],
    is_registered: NDArray[np.bool_],
    is_triangulated: NDArray[np.bool_],
    seen: NDArray[np.int32],
    held: NDArray[np.int32],
) -> None:
    for t in range(len(track_ptr) - 1):
        if not is_triangulated[t]:
            continue
        for a in range(track_ptr[t], track_ptr[t + 1]):
            i = obs_image_idx[a]
            if not is_registered[i]:
                continue
            for b in range(a + 1, track_ptr[t + 1]):
                j = obs_image_idx[b]
                if not is_registered[j]:
                    continue
                seen[i, j] += 1
                seen[j, i] += 1
                if obs_is_inlier[a] and obs_is_inlier[b]:
                    held[i, j] += 1
                    held[j, i] += 1


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    from sfmapp.scene.synthetic import make_scene

    loose_parts(make_scene(0, 3, 60).observed, 1)
