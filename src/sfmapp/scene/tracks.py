"""Tracks: which keypoints of which images show the same point, as flat arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.errors import InputError


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

    Example:
        >>> tracks = sfmapp.Tracks.from_observations([0, 0, 1, 1], [0, 1, 0, 1], xy)
        >>> model = sfmapp.Reconstruction(
        ...     [camera], ["a.jpg", "b.jpg"], numpy.zeros(2, int), poses, tracks, xyz, numpy.ones(4, bool)
        ... )
    """

    obs_image_idx: NDArray[np.int32]
    obs_feature_idx: NDArray[np.int32]
    obs_xy: NDArray[np.float64]
    obs_track_idx: NDArray[np.int32]
    track_ptr: NDArray[np.int64]
    image_ptr: NDArray[np.int64]
    image_obs: NDArray[np.int64]

    @staticmethod
    def from_observations(
        track_ids: ArrayLike, image_idx: ArrayLike, xy: ArrayLike, *, num_images: int | None = None
    ) -> Tracks:
        """Tracks of observations in any order.

        Args:
            track_ids: (O,) whole numbers from 0, which point each observation shows.
            image_idx: (O,) whole numbers from 0, positions of the images.
            xy: (O, 2) pixels.
            num_images: how many there are; None: as many as are observed in.

        Returns:
            The tracks; the keypoints of an image are numbered in the order of its observations.

        Raises:
            InputError: arrays of other shapes, negative numbers, pixels that are not finite, or a point that an image
                sees twice.
        """
        track, image, pixels = np.asarray(track_ids), np.asarray(image_idx), np.asarray(xy, np.float64)
        shape = (len(track),)
        if track.shape != shape or image.shape != shape or pixels.shape != (*shape, 2):
            raise InputError(
                f"tracks: expected (O,) ids, (O,) images and (O, 2) pixels, found {track.shape}, {image.shape} and "
                f"{pixels.shape}"
            )
        if len(track) and (
            track.dtype.kind not in "iu" or image.dtype.kind not in "iu" or min(track.min(), image.min()) < 0
        ):
            raise InputError("tracks: expected whole numbers from 0 for ids and images")
        largest = int(image.max(initial=-1)) + 1
        if not np.isfinite(pixels).all() or (num_images is not None and num_images < largest):
            raise InputError(f"tracks: expected finite pixels in at least {largest} images, found {num_images} or NaN")
        if len(np.unique(np.stack([track, image], 1), axis=0)) < len(track):
            raise InputError("tracks: expected at most one observation of each point in an image")
        order = np.argsort(image, kind="stable")
        feature = np.empty(len(track), np.int64)
        feature[order] = np.arange(len(track)) - np.searchsorted(image[order], image[order])
        num_tracks = int(track.max(initial=-1)) + 1
        return make_tracks(largest if num_images is None else num_images, num_tracks, track, image, feature, pixels)

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

    def observations_of_tracks(self, track_idx: NDArray[np.integer]) -> NDArray[np.int64]:
        """(K,) positions of the observations of tracks (N,), those of one after those of another."""
        begin = self.track_ptr[track_idx]
        count = self.track_ptr[track_idx + 1] - begin
        first = np.cumsum(count) - count
        return np.repeat(begin - first, count) + np.arange(int(count.sum()))


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
