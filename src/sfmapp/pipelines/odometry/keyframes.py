"""What is looked at again in the images of keyframes: their greys, for the points, and markers, for the scale."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Event
from sfmapp.odometry.inertial.markers import MarkerDetector, MarkerSightings
from sfmapp.odometry.result import MapResult, OdometryResult
from sfmapp.odometry.snapshot import FrameSnapshot, MapSnapshot

# A keyframe's image is kept this small: a thousand keyframes take ten megabytes.
_THUMBNAIL_PX = 10_000


@dataclass(frozen=True)
class _Seen:
    """One keyframe: its image shrunk, the size it had, and the markers in it."""

    small: NDArray[np.uint8]
    size: tuple[int, int]
    marker_id: NDArray[np.int64]
    corners: NDArray[np.float64]


@dataclass
class KeyframeWatch:
    """Listener that looks at the images of keyframes while they are at hand.

    Attributes:
        detector: of markers; None if none are wanted.
    """

    detector: MarkerDetector | None = None
    _wanted: set[int] = field(default_factory=set)
    _seen: dict[int, _Seen] = field(default_factory=dict)

    def __call__(self, event: Event) -> None:
        snapshot = event.data.get("snapshot")
        if isinstance(snapshot, MapSnapshot):
            self._wanted |= set(snapshot.keyframe_frame_idx.tolist()) - self._seen.keys()
        elif isinstance(snapshot, FrameSnapshot):
            if snapshot.frame_idx in self._wanted:
                self._seen[snapshot.frame_idx] = self._look(snapshot.image)
            self._wanted.clear()  # frames do not come again

    def _look(self, image: NDArray[np.uint8]) -> _Seen:
        import cv2

        height, width = image.shape
        shrink = min(1.0, (_THUMBNAIL_PX / (height * width)) ** 0.5)
        size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
        marker_id, corners = np.zeros(0, np.int64), np.zeros((0, 4, 2))
        if self.detector is not None:
            marker_id, corners = self.detector.detect(image)
        small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
        return _Seen(small, (width, height), marker_id, corners)

    def sightings(self, entry: MapResult) -> MarkerSightings:
        """The markers that were seen in a map's keyframes."""
        images, ids, corners = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros((0, 4, 2))]
        for frame_idx, image_idx in zip(entry.keyframe_frame_idx.tolist(), entry.keyframe_image_idx, strict=True):
            if (seen := self._seen.get(frame_idx)) is not None:
                images.append(np.full(len(seen.marker_id), image_idx, np.int64))
                ids.append(seen.marker_id)
                corners.append(seen.corners)
        return MarkerSightings(np.concatenate(images), np.concatenate(ids), np.concatenate(corners))

    def colour(self, result: OdometryResult) -> None:
        """Give the points of all maps the mean grey of where the keyframes saw them."""
        for entry in result.maps:
            self._colour(entry)

    def _colour(self, entry: MapResult) -> None:
        model = entry.reconstruction
        tracks, total = model.tracks, np.zeros(model.tracks.num_tracks)
        count = np.zeros(model.tracks.num_tracks)
        for frame_idx, image_idx in zip(entry.keyframe_frame_idx.tolist(), entry.keyframe_image_idx, strict=True):
            if (seen := self._seen.get(frame_idx)) is None:
                continue
            obs = tracks.observations_of_image(int(image_idx))
            small = np.array(seen.small.shape[::-1])
            xy = (tracks.obs_xy[obs] * small / seen.size).astype(np.int64)
            inside = ((xy >= 0) & (xy < small)).all(1)
            track, (column, row) = tracks.obs_track_idx[obs[inside]], xy[inside].T
            np.add.at(total, track, seen.small[row, column])
            np.add.at(count, track, 1)
        # a point that only other images saw is neither black nor white
        grey = np.where(count > 0, total / np.maximum(count, 1), 128).astype(np.uint8)
        model.point_rgb = np.repeat(grey[:, None], 3, 1)
