"""Tracks: which keypoints of which images show the same point, as flat arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Tracks:
    """Observations sorted by track, then by image.

    Attributes:
        obs_image_idx: (O,) int32, position of the image in the reconstruction.
        obs_feature_idx: (O,) int32, position of the keypoint among those of its image.
        obs_xy: (O, 2) float64, pixels.
        obs_track_idx: (O,) int32, ascending.
        track_ptr: (T + 1,) int64; the observations of track t are ``track_ptr[t]:track_ptr[t + 1]``.
        image_ptr: (I + 1,) int64 and image_obs: (O,) int64; the observations of image i are
            ``image_obs[image_ptr[i]:image_ptr[i + 1]]``, ascending.
    """

    obs_image_idx: NDArray[np.int32]
    obs_feature_idx: NDArray[np.int32]
    obs_xy: NDArray[np.float64]
    obs_track_idx: NDArray[np.int32]
    track_ptr: NDArray[np.int64]
    image_ptr: NDArray[np.int64]
    image_obs: NDArray[np.int64]

    @property
    def num_tracks(self) -> int:
        """T."""
        return len(self.track_ptr) - 1

    @property
    def num_images(self) -> int:
        """I."""
        return len(self.image_ptr) - 1

    @property
    def num_observations(self) -> int:
        """O."""
        return len(self.obs_image_idx)

    def observations_of_image(self, image_idx: int) -> NDArray[np.int64]:
        """(K,) positions of the observations of an image."""
        return self.image_obs[self.image_ptr[image_idx] : self.image_ptr[image_idx + 1]]


def make_tracks(
    num_images: int,
    num_tracks: int,
    obs_track_idx: NDArray[np.integer],
    obs_image_idx: NDArray[np.integer],
    obs_feature_idx: NDArray[np.integer],
    obs_xy: NDArray[np.floating],
) -> Tracks:
    """Sort observations by track and image and index both orders.

    Args:
        num_images, num_tracks: how many there are; both may exceed what is observed.
        obs_track_idx, obs_image_idx, obs_feature_idx: (O,) integers in any order.
        obs_xy: (O, 2) pixels.
    """
    order = np.lexsort((obs_feature_idx, obs_image_idx, obs_track_idx))
    track_idx = np.ascontiguousarray(obs_track_idx[order], np.int32)
    image_idx = np.ascontiguousarray(obs_image_idx[order], np.int32)
    image_obs = np.argsort(image_idx, kind="stable").astype(np.int64)
    return Tracks(
        obs_image_idx=image_idx,
        obs_feature_idx=np.ascontiguousarray(obs_feature_idx[order], np.int32),
        obs_xy=np.ascontiguousarray(obs_xy[order], np.float64),
        obs_track_idx=track_idx,
        track_ptr=_offsets(track_idx, num_tracks),
        image_ptr=_offsets(image_idx, num_images),
        image_obs=image_obs,
    )


def _offsets(index: NDArray[np.int32], count: int) -> NDArray[np.int64]:
    offsets = np.zeros(count + 1, np.int64)
    np.cumsum(np.bincount(index, minlength=count), out=offsets[1:])
    return offsets
