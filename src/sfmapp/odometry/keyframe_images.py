"""What the images of keyframes are looked at for besides tracking, while they are at hand: greys and markers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.odometry.inertial.markers import MarkerDetector, MarkerSightings
from sfmapp.scene.reconstruction import Reconstruction

Indices = NDArray[np.int64]

# A keyframe's image is kept this small: a thousand keyframes take ten megabytes.
_THUMBNAIL_PX = 10_000


@dataclass(frozen=True)
class _Seen:
    """One keyframe: its image shrunk, the size it had, and the markers in it."""

    small: NDArray[np.uint8]
    size: tuple[int, int]
    marker_id: Indices
    corners: NDArray[np.float64]


class KeyframeImages:
    """Thumbnails of keyframes and the markers that they show.

    Args:
        detector: of markers; None if none are wanted.
    """

    def __init__(self, detector: MarkerDetector | None = None) -> None:
        self._detector = detector
        self._seen: dict[int, _Seen] = {}

    def look(self, frame_idx: int, image: NDArray[np.uint8]) -> None:
        """Note what the image (H, W) of the rig's first camera shows in a frame that has become a keyframe."""
        import cv2

        height, width = image.shape
        shrink = min(1.0, (_THUMBNAIL_PX / (height * width)) ** 0.5)
        size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
        marker_id, corners = np.zeros(0, np.int64), np.zeros((0, 4, 2))
        if self._detector is not None:
            marker_id, corners = self._detector.detect(image)
        small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
        self._seen[frame_idx] = _Seen(small, (width, height), marker_id, corners)

    def sightings(self, frame_idx: Indices, image_idx: Indices) -> MarkerSightings:
        """The markers in the keyframes of a map.

        Args:
            frame_idx, image_idx: (K,) the frame that each keyframe is, and its image in the reconstruction.
        """
        none = MarkerSightings.none()
        images, ids, corners = [none.image_idx], [none.marker_id], [none.corners]
        for frame, image in zip(frame_idx.tolist(), image_idx, strict=True):
            if (seen := self._seen.get(frame)) is not None:
                images.append(np.full(len(seen.marker_id), image, np.int64))
                ids.append(seen.marker_id)
                corners.append(seen.corners)
        return MarkerSightings(np.concatenate(images), np.concatenate(ids), np.concatenate(corners))

    def colors(self, model: Reconstruction, frame_idx: Indices, image_idx: Indices) -> NDArray[np.uint8]:
        """(T, 3) the mean grey of each point where the keyframes saw it.

        Args:
            model: the map. frame_idx, image_idx: as of :meth:`sightings`.
        """
        tracks, total = model.tracks, np.zeros(model.tracks.num_tracks)
        count = np.zeros(model.tracks.num_tracks)
        for frame, image in zip(frame_idx.tolist(), image_idx, strict=True):
            if (seen := self._seen.get(frame)) is None:
                continue
            obs = tracks.observations_of_image(int(image))
            small = np.array(seen.small.shape[::-1])
            xy = (tracks.obs_xy[obs] * small / seen.size).astype(np.int64)
            inside = ((xy >= 0) & (xy < small)).all(1)
            track, (column, row) = tracks.obs_track_idx[obs[inside]], xy[inside].T
            np.add.at(total, track, seen.small[row, column])
            np.add.at(count, track, 1)
        # a point that only other images saw is neither black nor white
        grey = np.where(count > 0, total / np.maximum(count, 1), 128).astype(np.uint8)
        return np.repeat(grey[:, None], 3, 1)
