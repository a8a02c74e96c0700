"""What of a known map looks alike: where else in it a keyframe could have been taken, and which things it holds twice.

A frame tells which places it looks like only as far as recognition finds them, and of two equal places one may fall
just short. The map itself tells it once more.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
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
# 0.25 to 0.35, that to the most similar other one of a furnished room at 0.6 (5 % are below 0.43).
_TWIN_DISTANCE = 0.5
# A cluster is there twice if this share of its landmarks have their twins together: so it is of 83 % of the clusters of
# a hall of equal bays, and of 8 % of those of a room.
_TWIN_SHARE = 0.25
_SIFT_NORM2 = 512 * 512


class LookAlikes:
    """The doubles of a map, found where they are asked for.

    Args:
        places: the keyframes as they are remembered. pictures: of keyframes, (H, W) uint8 by position.

    Attributes:
        cluster: (P,) which cluster a landmark belongs to, neighbours in a cube; -1 for what is no place's landmark.
    """

    def __init__(self, keyframes: KeyframeMap, places: PlaceIndex, pictures: Mapping[int, Bytes]) -> None:
        self._keyframes, self._places, self._pictures = keyframes, places, pictures
        described: dict[int, Bytes] = {}
        for keyframe in keyframes.keyframes:
            if keyframe.frame_idx in places:
                place = places[keyframe.frame_idx]
                for point, row in zip(place.point_id.tolist(), place.descriptors, strict=True):
                    described.setdefault(point, row)
        self._ids: Ids = np.array(sorted(described), np.int64)
        self._ids = self._ids[keyframes.is_triangulated(self._ids)]
        self._descriptors = np.array([described[k] for k in self._ids.tolist()], np.float32).reshape(-1, 128)
        self._xyz = keyframes.point_xyz[self._ids]
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
        new = clusters[~self._is_known[clusters]]
        if not len(new):
            return self._is_repeated[clusters]
        mine = np.flatnonzero(np.isin(self.cluster[self._ids], new))
        least = _SIFT_NORM2 * (1.0 - 0.5 * _TWIN_DISTANCE**2)
        products = self._descriptors[mine] @ self._descriptors.T
        first, twin = np.nonzero(products > least)
        apart = ((self._xyz[mine[first]] - self._xyz[twin]) ** 2).sum(1) > (2.0 * self._edge) ** 2
        first, twin = first[apart], twin[apart]
        owner = self.cluster[self._ids[mine]]
        for c in new.tolist():
            rows = np.flatnonzero(owner[first] == c)
            at, whose = self._xyz[twin[rows]], first[rows]
            # as many landmarks as have a twin within one ball
            near = ((at[:, None] - at[None]) ** 2).sum(2) < self._edge**2
            most = max((len(np.unique(whose[n])) for n in near), default=0)
            self._is_repeated[c] = most >= _TWIN_SHARE * np.count_nonzero(owner == c)
        self._is_known[new] = True
        return self._is_repeated[clusters]

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
