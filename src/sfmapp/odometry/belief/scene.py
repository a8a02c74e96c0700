"""What is asked of a known map again and again: where its places were taken from, how deep they see, and what."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.odometry.loops.look_alikes import LookAlikes
from sfmapp.odometry.loops.place_recognition import Bytes, PlaceIndex
from sfmapp.odometry.loops.pose_graph import keyframe_depths
from sfmapp.odometry.loops.relocalize import LocalPoints, local_points, position_of
from sfmapp.odometry.map.keyframe_map import KeyframeMap
from sfmapp.odometry.map.known_map import PREFIX

Array = NDArray[np.float64]


class KnownScene:
    """A known map as it is now: to be made again when it has other keyframes.

    Args:
        places: its keyframes as they are remembered. pictures: of keyframes, (H, W) uint8 by position.

    Attributes:
        frame_idx: (L,) of the keyframes that are places. depth: (L,) median depths of what they see.
        look_alikes: what it holds twice. point_xyz: (N, 3) its landmarks.
    """

    def __init__(self, keyframes: KeyframeMap, places: PlaceIndex, pictures: Mapping[int, Bytes]) -> None:
        self.keyframes, self.num_keyframes, self._places = keyframes, len(keyframes.keyframes), places
        self.look_alikes = LookAlikes(keyframes, places, pictures)
        known = [k for k, keyframe in enumerate(keyframes.keyframes) if keyframe.frame_idx in places]
        self.frame_idx = np.array([keyframes.keyframes[k].frame_idx for k in known], np.int64)
        pose = np.array([keyframes.keyframes[k].rig_from_world for k in known]).reshape(-1, 7)
        self.depth = keyframe_depths(keyframes)[known]
        self._center, self._axis = rigid3.center(pose), rigid3.rotation_matrix(pose)[:, 2]
        xyz = keyframes.point_xyz[: keyframes.num_points]
        self.point_xyz = xyz[np.isfinite(xyz[:, 0])]
        self._points: dict[int, LocalPoints] = {}

    def depth_at(self, frame_idx: int) -> float:
        """Median depth of what a known keyframe sees."""
        return float(self.depth[np.flatnonzero(self.frame_idx == frame_idx)[0]])

    def name_of(self, frame_idx: int) -> str:
        """Name of a known keyframe, as the map has it."""
        return self.keyframes.keyframes[position_of(self.keyframes, frame_idx)].name.removeprefix(PREFIX)

    def nearest(self, pose: Array) -> int:
        """Row of the place that looks from nearest in nearly the same direction: distance over its depth, plus radians
        between the axes."""
        distance = np.linalg.norm(self._center - rigid3.center(pose), axis=1) / self.depth
        turn = np.arccos(np.clip(self._axis @ rigid3.rotation_matrix(pose)[2], -1.0, 1.0))
        return int(np.argmin(distance + turn))

    def points(self, row: int, num_neighbors: int) -> LocalPoints:
        """The landmarks around a place."""
        if row not in self._points:
            self._points[row] = local_points(self.keyframes, self._places, int(self.frame_idx[row]), num_neighbors)
        return self._points[row]
