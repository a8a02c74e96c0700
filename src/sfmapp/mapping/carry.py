"""A finished model over the tracks of more photographs, from where mapping goes on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.scene.reconstruction import Reconstruction

Ints = NDArray[np.int64]

_SHIFT = np.int64(32)


def carried(model: Reconstruction, empty: Reconstruction) -> Reconstruction:
    """Poses, cameras and points of a finished model over other tracks; no observation supports a point yet.

    A track that joins several points of the model takes the place of the one that most of its observations are of; a
    point whose track has fallen apart is where each part is.

    Args:
        model: whose observations name keypoints by their positions among the features.
        empty: images, among them those of the model by their names, cameras and tracks; nothing of it is changed.
    """
    out = empty.copy()
    place = {name: i for i, name in enumerate(out.image_names)}
    registered = model.registered_idx
    image = np.full(len(model.image_names), -1, np.int64)
    image[registered] = [place[model.image_names[i]] for i in registered]
    out.cam_from_world[image[registered]] = model.cam_from_world[registered]
    for i in registered:
        whose = out.image_camera_idx[image[i]]
        known = model.cameras[model.image_camera_idx[i]]
        out.cameras[whose] = replace(out.cameras[whose], params=known.params)
    track, point = _same_points(model, out, image)
    out.point_xyz[track] = model.point_xyz[point]
    return out


def _same_points(model: Reconstruction, out: Reconstruction, image: Ints) -> tuple[Ints, Ints]:
    """Tracks (N,) that observations of the model's points (N,) are in, each track once.

    Args:
        image: of the model's images in the other's, -1 for what is not registered.
    """
    old, new = model.tracks, out.tracks
    supports = model.obs_is_inlier & model.is_triangulated[old.obs_track_idx]
    obs = np.flatnonzero(supports & (image >= 0)[old.obs_image_idx])
    wanted = (image[old.obs_image_idx[obs]] << _SHIFT) | old.obs_feature_idx[obs]
    there = (new.obs_image_idx.astype(np.int64) << _SHIFT) | new.obs_feature_idx
    order = np.argsort(there, kind="stable")
    at = np.minimum(np.searchsorted(there[order], wanted), max(len(order) - 1, 0))
    if not len(order):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    found = there[order[at]] == wanted
    both = np.stack([new.obs_track_idx[order[at[found]]], old.obs_track_idx[obs[found]]], 1).astype(np.int64)
    pairs, votes = np.unique(both, axis=0, return_counts=True)
    ranked = np.lexsort((pairs[:, 1], -votes, pairs[:, 0]))
    first = ranked[np.unique(pairs[ranked, 0], return_index=True)[1]]
    return pairs[first, 0], pairs[first, 1]
