"""What of a map looks alike: where else in it a keyframe could have been taken, and which things it holds twice.

A frame tells which places it looks like only as far as recognition finds them, and of two equal places one may fall
just short. The map itself tells it once more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry.loops.place_recognition import Bytes, Ids, PlaceIndex, View
from sfmapp.odometry.loops.pose_graph import keyframe_depths
from sfmapp.odometry.loops.relocalize import (
    RelocalizeOptions,
    is_elsewhere,
    locate,
    position_of,
    shared_points,
)
from sfmapp.odometry.map.keyframe_map import KeyframeMap

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Keyframes that share so many points see the same thing, and not its like.
_SHARED = 15
# Edge of the cubes that make landmarks a cluster, in median depths.
_CLUSTER_DEPTHS = 0.2
# Landmarks are twins below this distance of their unit descriptors: that of one landmark seen twice has its median at
# 0.25 to 0.35, that to the most similar other one of a furnished room at 0.6. Most of them that count of one landmark.
_TWIN_DISTANCE, _NUM_TWINS = 0.5, 4
# Clusters that are taken to be there twice by chance: they only speak for no place.
_CHANCE = 0.1
_SIFT_NORM2 = 512 * 512
# Landmarks that are held against all others at a time.
_BLOCK = 256


class LookAlikes:
    """The doubles of a map, found where they are asked for.

    Args:
        places: the keyframes as they are remembered. pictures: of keyframes, (H, W) uint8 by position, for
            :meth:`around`.
        same: (8,) similarity that takes a place of the map to another one which may be the same: what it takes onto its
            like is there once. None: no places are the same.

    Attributes:
        cluster: (P,) which cluster a landmark belongs to, neighbours in a cube; -1 for what is no place's landmark.
    """

    def __init__(
        self, keyframes: KeyframeMap, places: PlaceIndex, pictures: Mapping[int, Bytes], same: Array | None = None
    ) -> None:
        self._keyframes, self._places, self._pictures = keyframes, places, pictures
        seen = [places[k.frame_idx] for k in keyframes.keyframes if k.frame_idx in places]
        ids = np.concatenate([np.zeros(0, np.int64), *[place.point_id for place in seen]])
        # each as it looked first
        self._ids, first = np.unique(ids, return_index=True)
        known = keyframes.is_triangulated(self._ids)
        self._ids, first = self._ids[known], first[known]
        described = np.concatenate([np.zeros((0, 128), np.uint8), *[place.descriptors for place in seen]])
        self._descriptors = described[first].astype(np.float32)
        self._xyz = keyframes.point_xyz[self._ids]
        self._as_same = None if same is None else similarity.apply(same, self._xyz)
        depths = keyframe_depths(keyframes)
        self._edge = _CLUSTER_DEPTHS * (float(np.median(depths)) if len(depths) else 1.0)
        self.cluster: Ids = np.full(keyframes.num_points, -1, np.int64)
        num_clusters = 0
        if len(self._ids):
            cubes = np.floor(self._xyz / self._edge).astype(np.int64)
            self.cluster[self._ids] = np.unique(cubes, axis=0, return_inverse=True)[1].reshape(-1)
            num_clusters = int(self.cluster.max()) + 1
        self._is_known, self._is_repeated = np.zeros(num_clusters, bool), np.zeros(num_clusters, bool)
        self._motions: dict[int, list[Array]] = {}

    def is_repeated(self, clusters: Ids) -> Mask:
        """(C,) which clusters have a like elsewhere in the map."""
        self._find_twins(clusters[~self._is_known[clusters]])
        return self._is_repeated[clusters]

    def _find_twins(self, clusters: Ids) -> None:
        """Find out which of some clusters have a like."""
        if not len(clusters):
            return
        mine = np.flatnonzero(np.isin(self.cluster[self._ids], clusters))
        owner = self.cluster[self._ids[mine]]
        least = _SIFT_NORM2 * (1.0 - 0.5 * _TWIN_DISTANCE**2)
        found = []
        for block in range(0, len(mine), _BLOCK):
            products = self._descriptors[mine[block : block + _BLOCK]] @ self._descriptors.T
            first, twin = np.nonzero(products > least)
            apart = ((self._xyz[mine[block + first]] - self._xyz[twin]) ** 2).sum(1) > (2.0 * self._edge) ** 2
            if self._as_same is not None:
                off = self._xyz[mine[block + first]] - self._as_same[twin]
                apart &= (off**2).sum(1) > (2.0 * self._edge) ** 2
            first, twin = first[apart], twin[apart]
            order = np.lexsort((-products[first, twin], first))
            first, twin = first[order], twin[order]
            rank = np.arange(len(first)) - np.searchsorted(first, first)
            found.append(np.stack([block + first, twin])[:, rank < _NUM_TWINS])
        first, twin = np.concatenate(found, 1)
        for c in clusters.tolist():
            rows = owner[first] == c
            self._is_repeated[c] = self._are_together(first[rows], self._xyz[twin[rows]], int((owner == c).sum()))
        self._is_known[clusters] = True

    def _are_together(self, first: Ids, at: Array, num: int) -> bool:
        """Whether more of the landmarks of a cluster have twins in one ball than do by chance.

        Twins by chance lie where any landmark lies: that k of n landmarks with t twins each have one in the ball around
        another twin is expected less than C(n, k) t^k p^(k - 1) times, p being the share of all landmarks in it.

        Args:
            first: (T,) whose twins. at: (T, 3) where these are. num: of landmarks of the cluster.
        """
        if len(first) < 2:
            return False
        near = ((at[:, None] - at[None]) ** 2).sum(2) < self._edge**2
        together = np.array([len(np.unique(first[n])) for n in near])
        most = int(together.max())
        if most < 2:
            return False
        center = at[int(together.argmax())]
        share = float((((self._xyz - center) ** 2).sum(1) < self._edge**2).mean())
        log_expected = math.log(math.comb(num, most)) + most * math.log(len(first) / num) + (most - 1) * math.log(share)
        return log_expected < math.log(_CHANCE)

    def around(self, frame_idx: int, depth: float) -> list[Array]:
        """Motions (7,) of the world that take what a keyframe sees to its likes.

        Args:
            frame_idx: the frame that the keyframe is. depth: of what it sees.
        """
        if frame_idx not in self._motions:
            position = position_of(self._keyframes, frame_idx)
            self._motions[frame_idx] = self._look(position, depth) if position in self._pictures else []
        return self._motions[frame_idx]

    def _look(self, position: int, depth: float) -> list[Array]:
        keyframe, options = self._keyframes.keyframes[position], RelocalizeOptions()
        place = self._places[keyframe.frame_idx]
        view = View(self._pictures[position], place.xy.astype(np.float64), place.point_id)
        shared = shared_points(self._keyframes, position)
        same = [k.frame_idx for k, n in zip(self._keyframes.keyframes, shared, strict=True) if n >= _SHARED]
        motions = []
        for candidate in self._places.query(keyframe.frame_idx, same):
            located = locate(self._keyframes, self._places, view, candidate, options, 0.0)
            if located is not None and is_elsewhere(keyframe.rig_from_world, located.cam_from_world, depth):
                motions.append(rigid3.compose(rigid3.inverse(located.cam_from_world), keyframe.rig_from_world))
        return motions
