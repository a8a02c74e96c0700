"""Tracks from verified matches: union-find that never puts two keypoints of one image into one track."""

from __future__ import annotations

from collections.abc import Sequence

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.components import find_root
from sfmapp.mapping.report import TracksReport
from sfmapp.scene.correspondences import Correspondences, TwoViewConfig
from sfmapp.scene.features import Features
from sfmapp.scene.tracks import Tracks, make_tracks

# Pairs whose matches say nothing about depth or are not of the scene at all.
USELESS_CONFIGS = (TwoViewConfig.UNDEFINED, TwoViewConfig.DEGENERATE, TwoViewConfig.WATERMARK)


@numba.njit(cache=True, nogil=True)
def _join(
    first: NDArray[np.int64], second: NDArray[np.int64], image: NDArray[np.int32], stamp: NDArray[np.int64],
    parent: NDArray[np.int64], following: NDArray[np.int64],
) -> int:  # fmt: skip
    """Unite the keypoints of each match in the given order; a union that would hold an image twice is refused.

    Components are circular lists as well, so that walking the smaller one costs its length. Returns the refusals.

    Args:
        first, second: (M,) nodes of each match; image: (N,) of each node; stamp: a -1 for each image.
        parent, following: (N,) each node itself; parent ends as the root of each.
    """
    n = image.shape[0]
    size = np.empty(n, np.int64)
    for i in range(n):
        size[i] = 1
    refused = 0
    for m in range(first.shape[0]):
        a, b = find_root(parent, first[m]), find_root(parent, second[m])
        if a == b:
            continue
        if size[a] < size[b]:
            a, b = b, a
        node = b
        for _ in range(size[b]):
            stamp[image[node]] = m
            node = following[node]
        node = a
        conflict = False
        for _ in range(size[a]):
            if stamp[image[node]] == m:
                conflict = True
                break
            node = following[node]
        if conflict:
            refused += 1
            continue
        parent[b] = a
        size[a] += size[b]
        following[a], following[b] = following[b], following[a]
    for i in range(n):
        root = i
        while parent[root] != root:
            root = parent[root]
        parent[i] = root
    return refused


def build_tracks(correspondences: Correspondences, features: Sequence[Features]) -> tuple[Tracks, TracksReport]:
    """Join verified matches into tracks of at least two keypoints, at most one of each image.

    Matches of the pairs with most inliers are joined first, as they are the likeliest to be right; a later match that
    contradicts them is refused, which splits what a plain union-find would have merged.

    Args:
        correspondences: verified matches.
        features: of every image, in the order of the images.

    Returns:
        The tracks, ordered by their first observation, and a report of counts.
    """
    counts = np.array([len(f) for f in features], np.int64)
    offset = np.concatenate([[0], np.cumsum(counts)])
    image_of_node = np.repeat(np.arange(len(features), dtype=np.int32), counts)
    useful = ~np.isin(correspondences.config, USELESS_CONFIGS)
    pairs = np.flatnonzero(useful)
    pairs = pairs[np.argsort(-correspondences.num_inliers[pairs], kind="stable")]
    empty = np.zeros((0, 2), np.int64)
    edges = np.concatenate(
        [empty]
        + [correspondences.matches_of_pair(int(p)) + offset[correspondences.pair_image_idx[p]][None, :] for p in pairs]
    )
    parent = np.arange(len(image_of_node))
    stamp, following = np.full(len(features), -1), parent.copy()
    first, second = np.ascontiguousarray(edges.T)
    refused = _join(first, second, image_of_node, stamp, parent, following)

    size = np.bincount(parent, minlength=len(parent))[parent]
    nodes = np.flatnonzero(size >= 2)
    _, track_idx = np.unique(parent[nodes], return_inverse=True)
    num_tracks = int(track_idx.max()) + 1 if len(nodes) else 0
    feature_idx = nodes - offset[image_of_node[nodes]]
    xy = np.concatenate([np.zeros((0, 2))] + [f.keypoints[:, :2].astype(np.float64) for f in features])[nodes]
    tracks = make_tracks(len(features), num_tracks, track_idx, image_of_node[nodes], feature_idx, xy)
    report = TracksReport(
        num_tracks=num_tracks,
        num_observations=len(nodes),
        mean_track_length=len(nodes) / max(1, num_tracks),
        num_conflicting_matches=int(refused),
    )
    return tracks, report


def track_colors(tracks: Tracks, features: Sequence[Features]) -> NDArray[np.uint8]:
    """(T, 3) uint8 mean colour of the keypoints of each track."""
    sums = np.zeros((tracks.num_tracks, 3))
    for image_idx, feature in enumerate(features):
        obs = tracks.observations_of_image(image_idx)
        # a track holds an image at most once, so plain fancy indexing adds up right
        sums[tracks.obs_track_idx[obs]] += feature.rgb[tracks.obs_feature_idx[obs]]
    length = np.maximum(np.diff(tracks.track_ptr), 1)
    return np.round(sums / length[:, None]).astype(np.uint8)
