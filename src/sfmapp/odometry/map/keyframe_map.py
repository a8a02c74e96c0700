"""The map that grows while the camera moves: keyframes and points as flat arrays."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.rig import Rig, RigImages
from sfmapp.scene.tracks import make_tracks

Array = NDArray[np.float64]


@dataclass
class Keyframe:
    """A frame that the map is built on.

    Attributes:
        frame_idx, timestamp_s, name: which frame it is.
        rig_from_world: (7,) float64, pose of the rig's first camera.
        point_id: (N,) int64 ascending, the points (tracks) seen; a point is in the map once it is triangulated.
        xy: (N, S, 2) float64 where each camera of the rig saw it, pixels; NaN where it did not.
        is_inlier: (N, S) bool: agrees with the map.
        row_shift: (N, 2) pixels by which a rolling shutter has moved what the first camera saw; the map is adjusted to
            what is left without that. None: nothing.
    """

    frame_idx: int
    timestamp_s: float
    name: str
    rig_from_world: Array
    point_id: NDArray[np.int64]
    xy: Array
    is_inlier: NDArray[np.bool_]
    row_shift: Array | None = None

    def straight_xy(self, sensor: int) -> Array:
        """(N, 2) where a camera of the rig would have seen the points, had it read all its rows at once."""
        xy: Array = self.xy[:, sensor]
        return xy if self.row_shift is None or sensor else xy - self.row_shift


@dataclass
class KeyframeMap:
    """Keyframes and points.

    Attributes:
        rig: the cameras.
        keyframes: K, in the order of time.
        point_xyz: (P, 3) float64 world, by point id; NaN where not triangulated. Grows with :meth:`new_points`.
        num_points: ids given out so far (``point_xyz`` has room for more).
        num_known: the first so many keyframes are those of a map that was there before: only the closing adjustment
            may move them.
        num_known_points: ids below that are its points.
    """

    rig: Rig
    keyframes: list[Keyframe] = field(default_factory=list)
    point_xyz: Array = field(default_factory=lambda: np.full((1024, 3), np.nan))
    num_points: int = 0
    num_known: int = 0
    num_known_points: int = 0
    _num_observations: NDArray[np.int32] = field(default_factory=lambda: np.zeros(1024, np.int32))
    _num_known_observations: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))

    def append(self, keyframe: Keyframe) -> None:
        """Add a keyframe."""
        self.keyframes.append(keyframe)
        self.count(keyframe.point_id, np.isfinite(keyframe.xy[:, :, 0]).sum(1))

    def count(self, point_id: NDArray[np.int64], observations: NDArray[np.integer] | NDArray[np.bool_]) -> None:
        """Points (N,), each at most once, are seen so many times more."""
        self._num_observations[point_id] += observations.astype(np.int32)

    def remove(self, position: int) -> Keyframe:
        """Drop a keyframe; those after it move up. What it saw of points that others see stays in the map."""
        keyframe = self.keyframes.pop(position)
        self.count(keyframe.point_id, -np.isfinite(keyframe.xy[:, :, 0]).sum(1))
        return keyframe

    def recount(self) -> None:
        """Count afresh how often points are seen, after ids have changed."""
        self._num_observations = np.zeros(len(self.point_xyz), np.int32)
        for keyframe in self.keyframes:
            self.count(keyframe.point_id, np.isfinite(keyframe.xy[:, :, 0]).sum(1))

    def num_observations(self, point_id: NDArray[np.int64]) -> NDArray[np.int32]:
        """(N,) how often points are seen, outliers included."""
        return self._num_observations[point_id]

    def hold_known(self) -> None:
        """All keyframes and points so far are those of a map that was there before."""
        self.num_known, self.num_known_points = len(self.keyframes), self.num_points
        self._num_known_observations = self._num_observations[: self.num_points].copy()

    def hold_same_known(self, other: KeyframeMap) -> None:
        """The known keyframes and points of another map are the first of this one, too."""
        self.num_known, self.num_known_points = other.num_known, other.num_known_points
        self._num_known_observations = other._num_known_observations

    def num_own_observations(self, point_id: NDArray[np.int64]) -> NDArray[np.int32]:
        """(N,) how often points are seen by other keyframes than those of a known map."""
        own = self._num_observations[point_id]
        known = point_id < len(self._num_known_observations)
        own[known] -= self._num_known_observations[point_id[known]]
        return own

    def new_points(self, count: int) -> NDArray[np.int64]:
        """Ids of so many new points, not triangulated yet."""
        first, self.num_points = self.num_points, self.num_points + count
        if self.num_points > len(self.point_xyz):
            room = np.full((max(self.num_points, 2 * len(self.point_xyz)), 3), np.nan)
            room[: len(self.point_xyz)] = self.point_xyz
            self._num_observations = np.pad(self._num_observations, (0, len(room) - len(self.point_xyz)))
            self.point_xyz = room
        return np.arange(first, self.num_points)

    def is_triangulated(self, point_id: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(N,) bool."""
        known: NDArray[np.bool_] = np.isfinite(self.point_xyz[point_id, 0])
        return known

    def reconstruction(self, keyframe_idx: NDArray[np.int64]) -> tuple[Reconstruction, NDArray[np.int64]]:
        """The given keyframes (ascending) and what they see, as a reconstruction, and the ids of its points.

        Image S k + s is what camera s took at the k-th given keyframe; tracks are in the order of their ids.
        """
        num_sensors = len(self.rig.cameras)
        chosen = [self.keyframes[k] for k in keyframe_idx]
        images, feature, ids, xy, inlier = [], [], [], [], []
        for k, keyframe in enumerate(chosen):
            for s in range(num_sensors):
                seen = np.isfinite(keyframe.xy[:, s, 0])
                images.append(np.full(int(seen.sum()), num_sensors * k + s, np.int32))
                feature.append(np.flatnonzero(seen))
                ids.append(keyframe.point_id[seen])
                xy.append(keyframe.straight_xy(s)[seen])
                inlier.append(keyframe.is_inlier[seen, s])
        all_ids = np.concatenate(ids)
        point_id, track = np.unique(all_ids, return_inverse=True)
        image, num_images = np.concatenate(images), num_sensors * len(chosen)
        inlier_by_order = np.concatenate(inlier)[np.lexsort((image, track))]
        tracks = make_tracks(num_images, len(point_id), track, image, np.concatenate(feature), np.concatenate(xy))
        sensors = np.tile(np.arange(num_sensors, dtype=np.int32), len(chosen))
        names = [k.name if s == 0 else f"camera{s}/{k.name}" for k in chosen for s in range(num_sensors)]
        model = Reconstruction.empty(list(self.rig.cameras), names, sensors, tracks)
        rig_from_world = np.array([k.rig_from_world for k in chosen]).reshape(-1, 7)
        model.cam_from_world = rigid3.compose(
            np.tile(self.rig.cam_from_rig, (len(chosen), 1)), np.repeat(rig_from_world, num_sensors, 0)
        )
        model.point_xyz = self.point_xyz[point_id]
        model.obs_is_inlier = inlier_by_order & model.is_triangulated[tracks.obs_track_idx]
        if num_sensors > 1:
            frames = np.repeat(np.arange(len(chosen), dtype=np.int32), num_sensors)
            model.rig = RigImages(frames, sensors, self.rig.cam_from_rig)
        return model, point_id
