"""Parts of a large match graph, each mapped by itself: what a part is given, and what it comes to.

A part has its own images, numbered anew, the matches between them, and those of the tracks of all that they see twice:
a point that several parts have is one track in all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.tracks import Tracks, make_tracks

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Part:
    """Some of the images of a run, to be mapped by themselves.

    Attributes:
        image_idx: (K,) their positions in the run, ascending; all else counts by positions in the part.
        image_names, image_camera_idx: of the K images.
        cameras: those of these images. camera_idx: (C,) their positions in the run.
        correspondences: verified matches between them.
        tracks: what at least two of them see. track_idx: (T,) positions of these tracks in the run, ascending.
    """

    image_idx: Ints
    image_names: list[str]
    image_camera_idx: NDArray[np.int32]
    cameras: list[Camera]
    camera_idx: Ints
    correspondences: Correspondences
    tracks: Tracks
    track_idx: Ints

    @staticmethod
    def of(empty: Reconstruction, correspondences: Correspondences, image_idx: Ints) -> Part:
        """The part of some images (K,), ascending, of a run.

        Args:
            empty: all images of the run, their cameras and tracks.
            correspondences: all verified matches.
        """
        tracks, track_idx = _seen_twice(empty.tracks, image_idx)
        whose = empty.image_camera_idx[image_idx]
        camera_idx, camera_of = np.unique(whose, return_inverse=True)
        return Part(
            image_idx, [empty.image_names[i] for i in image_idx], camera_of.astype(np.int32),
            [empty.cameras[c] for c in camera_idx], camera_idx.astype(np.int64),
            _between(correspondences, len(empty.image_names), image_idx), tracks, track_idx,
        )  # fmt: skip


@dataclass(frozen=True)
class Submap:
    """A part, and a model that it came to.

    Attributes:
        part: with the run's positions of images, cameras and tracks.
        model: over the tracks of the part.
    """

    part: Part
    model: Reconstruction

    @property
    def registered_idx(self) -> Ints:
        """Positions in the run of the images that the model holds, ascending."""
        return self.part.image_idx[self.model.registered_idx]

    @property
    def triangulated_idx(self) -> Ints:
        """Positions in the run of the tracks that the model has points of, ascending."""
        return self.part.track_idx[self.model.is_triangulated]

    @property
    def num_observations(self) -> Ints:
        """(T,) observations that support each point."""
        tracks = self.model.tracks
        return np.bincount(tracks.obs_track_idx[self.model.obs_is_inlier], minlength=tracks.num_tracks)

    def places_of_images(self, image_idx: Ints) -> Ints:
        """Positions in the part of images of the run that it has."""
        return np.searchsorted(self.part.image_idx, image_idx)

    def places_of_tracks(self, track_idx: Ints) -> Ints:
        """Positions in the part of tracks of the run that it has."""
        return np.searchsorted(self.part.track_idx, track_idx)

    def tracks_seen(self, place: int) -> Ints:
        """Tracks of the part that support points in the image at a position in the part."""
        tracks = self.model.tracks
        obs = tracks.observations_of_image(place)
        return tracks.obs_track_idx[obs[self.model.obs_is_inlier[obs]]].astype(np.int64)


def _seen_twice(tracks: Tracks, image_idx: Ints) -> tuple[Tracks, Ints]:
    """The tracks that at least two of some images see, with the observations of these, and the tracks' positions."""
    place = np.full(tracks.num_images, -1)
    place[image_idx] = np.arange(len(image_idx))
    obs = np.concatenate([np.zeros(0, np.int64), *(tracks.observations_of_image(int(i)) for i in image_idx)])
    track_idx, track, counts = np.unique(tracks.obs_track_idx[obs], return_inverse=True, return_counts=True)
    twice = counts >= 2
    number = np.cumsum(twice) - 1
    kept = twice[track]
    obs, track = obs[kept], number[track[kept]]
    own = make_tracks(
        len(image_idx), int(twice.sum()), track, place[tracks.obs_image_idx[obs]], tracks.obs_feature_idx[obs],
        tracks.obs_xy[obs],
    )  # fmt: skip
    return own, track_idx[twice].astype(np.int64)


def _between(correspondences: Correspondences, num_images: int, image_idx: Ints) -> Correspondences:
    """The pairs between some images, which are numbered by their places among these."""
    place = np.full(num_images, -1)
    place[image_idx] = np.arange(len(image_idx))
    pairs = place[correspondences.pair_image_idx]
    kept = (pairs >= 0).all(axis=1)
    counts = correspondences.num_inliers
    chosen = {
        name: getattr(correspondences, name)[kept]
        for name in (
            "config", "fundamental", "essential", "homography", "cam2_from_cam1", "median_angle_deg", "num_putative",
            "num_inliers_f", "num_inliers_e", "num_inliers_h",
        )
    }  # fmt: skip
    return replace(
        correspondences, pair_image_idx=pairs[kept].astype(np.int32),
        pair_ptr=np.concatenate([[0], np.cumsum(counts[kept])]),
        matches=correspondences.matches[np.repeat(kept, counts)],
        **chosen,
    )  # fmt: skip
