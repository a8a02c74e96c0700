"""The reconstruction as users hold it: the arrays that all stages work on, and light views of images and points."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.covariance import Covariances, estimate_covariances
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import Varying
from sfmapp.camera.camera import Camera
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.formats.colmap import has_model, read_model, write_model, write_model_text
from sfmapp.geometry.rigid3 import Rigid3
from sfmapp.scene import reconstruction as arrays

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass
class Reconstruction(arrays.Reconstruction):
    """Cameras, poses, and points beside their tracks, as flat arrays over images (I), tracks (T), observations (O).

    An image is known by its name or its position, a point by the position of its track, which is its id as long as the
    tracks stay what they are; COLMAP's files have the same numbers plus one. Views (:meth:`image`, :attr:`points`,
    :meth:`observations_of_track`) are made when they are asked for and look at the arrays as they are then.

    Attributes:
        cameras: C intrinsics, few; immutable, to be replaced whole.
        image_names: I names, relative to the folder of the photographs, with forward slashes.
        image_camera_idx: (I,) int32 position in ``cameras``.
        cam_from_world: (I, 7) float64, quaternion x y z w and translation; NaN where unregistered.
        tracks: which keypoints show the same point, :class:`Tracks`.
        point_xyz: (T, 3) float64, world; NaN where not triangulated.
        obs_is_inlier: (O,) bool: the observation supports its point.
        point_rgb: (T, 3) uint8.
        rig: which images share a rig's pose; None if every image has a pose of its own.
        keypoints: for each image (N, 2) pixels of all of its keypoints, also of those without a point; None where only
            tracked ones are known.

    Example:
        >>> model = sfmapp.load("out/")
        >>> model.image("a.jpg").cam_from_world.center
        >>> model.points.xyz, model.points.error_px
        >>> model.save("copy/sparse/0")
    """

    keypoints: list[Array] | None = None

    @classmethod
    def of(cls, model: arrays.Reconstruction, keypoints: list[Array] | None = None) -> Reconstruction:
        """The same reconstruction, arrays shared, with views; ``keypoints`` as above."""
        if isinstance(model, cls) and keypoints is None:
            return model
        shared = {field.name: getattr(model, field.name) for field in fields(arrays.Reconstruction)}
        return cls(**shared, keypoints=keypoints)

    def image(self, name: str | int) -> ImageView:
        """What is known of one image.

        Args:
            name: of the image, or its position.

        Raises:
            InputError: there is no such image; the message names the nearest ones.
        """
        return ImageView(self, self.image_position(name))

    @property
    def images(self) -> list[ImageView]:
        """Views of all I images, registered or not."""
        return [ImageView(self, idx) for idx in range(len(self.image_names))]

    def image_position(self, name: str | int) -> int:
        """Position of an image, by name or checked. Raises InputError as :meth:`image` does."""
        if isinstance(name, str):
            if name in self.image_names:
                return self.image_names.index(name)
            from difflib import get_close_matches

            near = get_close_matches(name, self.image_names, 3, 0.0) or ["nothing: there are no images"]
            raise InputError(f"image {name!r}: expected a name of the reconstruction, such as {', '.join(near)}")
        if not 0 <= name < len(self.image_names):
            raise InputError(f"image {name}: expected a position from 0 to {len(self.image_names) - 1}")
        return int(name)

    def camera(self, of: str | int) -> Camera:
        """The camera with a position in ``cameras``, or the one that took the image with a name.

        Raises:
            InputError: there is none.
        """
        if isinstance(of, str):
            camera: Camera = self.cameras[self.image_camera_idx[self.image_position(of)]]
            return camera
        if not 0 <= of < len(self.cameras):
            raise InputError(
                f"camera {of}: expected a position from 0 to {len(self.cameras) - 1}, or a name of an image"
            )
        return self.cameras[of]

    @property
    def points(self) -> Points:
        """The triangulated points."""
        return Points(self, np.flatnonzero(self.is_triangulated))

    def observations_of_track(self, track_id: int) -> Observations:
        """Where the images see a point.

        Args:
            track_id: position of its track, as in ``points.ids`` and ``image(...).track_ids``.

        Raises:
            InputError: there is no such track.
        """
        if not 0 <= track_id < self.tracks.num_tracks:
            raise InputError(f"track {track_id}: expected a position from 0 to {self.tracks.num_tracks - 1}")
        return Observations(self, np.arange(self.tracks.track_ptr[track_id], self.tracks.track_ptr[track_id + 1]))

    def save(self, folder: str | os.PathLike[str], *, text: bool = False) -> None:
        """Write the registered part as a COLMAP model, which COLMAP 3.x and 4.x read. The folder appears at once.

        Args:
            folder: where cameras, images, points3D, rigs and frames go; other files in it stay.
            text: as text files, in place of binary ones.

        Raises:
            InputError: the folder cannot be written.
            UsageError: an image name that a text file cannot hold.
        """
        (write_model_text if text else write_model)(Path(folder), self, self.keypoints)

    def covariance(
        self,
        options: AdjustOptions | None = None,
        *,
        sigma_px: float | None = None,
        constant_images: Iterable[str | int] = (),
    ) -> Covariances:
        """How well poses, intrinsics and points are determined: their marginal covariances, at the minimum.

        Args:
            options: which intrinsics are free, and the loss, as they were in the last ``adjust_bundle``.
            sigma_px: noise of one coordinate of an observation in pixels; None: estimated from the residuals.
            constant_images: names or positions of images whose poses are taken as exact. None of them: the gauge is
                that of inner constraints, in which the errors of all poses together are least.

        Returns:
            The covariances; ``of_point``, ``of_image`` and ``of_camera`` look one up. Memory is that of two dense
            matrices over all unknowns of poses and cameras.

        Raises:
            InputError: an image that is not there.

        Example:
            >>> covariances = model.covariance()
            >>> numpy.sqrt(numpy.diag(covariances.of_point(model.points.ids[0])))  # sigmas in units of the world
        """
        variable = self.is_registered
        variable[[self.image_position(name) for name in constant_images]] = False
        varying = Varying(images=variable)
        return estimate_covariances(self, options or AdjustOptions(), sigma_px=sigma_px, varying=varying)


@dataclass(frozen=True)
class ImageView:
    """One image of a reconstruction.

    Attributes:
        reconstruction: which one; the view reads its arrays.
        idx: position of the image in it.
    """

    reconstruction: Reconstruction
    idx: int

    @property
    def name(self) -> str:
        """Relative to the folder of the photographs."""
        return self.reconstruction.image_names[self.idx]

    @property
    def camera(self) -> Camera:
        """What took it."""
        camera: Camera = self.reconstruction.cameras[self.reconstruction.image_camera_idx[self.idx]]
        return camera

    @property
    def is_registered(self) -> bool:
        """It has a pose."""
        return not np.isnan(self.reconstruction.cam_from_world[self.idx, 0])

    @property
    def cam_from_world(self) -> Rigid3 | None:
        """The pose; None where the image is not registered."""
        return Rigid3(self.reconstruction.cam_from_world[self.idx]) if self.is_registered else None

    @property
    def observations(self) -> Observations:
        """All its keypoints that are in a track, one observation each."""
        model = self.reconstruction
        return Observations(model, model.tracks.observations_of_image(self.idx))

    @property
    def track_ids(self) -> Ints:
        """(K,) tracks of the points that the image supports."""
        model, obs = self.reconstruction, self.observations.idx
        return model.tracks.obs_track_idx[obs[model.obs_is_inlier[obs]]].astype(np.int64)


@dataclass(frozen=True)
class Points:
    """The triangulated points (P) of a reconstruction.

    Attributes:
        reconstruction: which one; the view reads its arrays.
        ids: (P,) int64, positions of their tracks, ascending.
    """

    reconstruction: Reconstruction
    ids: Ints

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def xyz(self) -> Array:
        """(P, 3) world."""
        return self.reconstruction.point_xyz[self.ids]

    @property
    def rgb(self) -> NDArray[np.uint8]:
        """(P, 3)."""
        return self.reconstruction.point_rgb[self.ids]

    @property
    def num_images(self) -> Ints:
        """(P,) images whose observation supports the point."""
        model = self.reconstruction
        return np.bincount(model.tracks.obs_track_idx[model.obs_is_inlier], minlength=model.tracks.num_tracks)[self.ids]

    @property
    def error_px(self) -> Array:
        """(P,) mean length of the residuals of those observations in pixels; NaN where there are none."""
        model, used = self.reconstruction, self.reconstruction.obs_is_inlier
        track, num_tracks = model.tracks.obs_track_idx[used], model.tracks.num_tracks
        total = np.bincount(track, model.errors_px()[used], num_tracks)[self.ids]
        count = self.num_images
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)


@dataclass(frozen=True)
class Observations:
    """Some observations (K) of a reconstruction, of one image or of one track.

    Attributes:
        reconstruction: which one; the view reads its arrays.
        idx: (K,) int64 positions of the observations.
    """

    reconstruction: Reconstruction
    idx: Ints

    def __len__(self) -> int:
        return len(self.idx)

    @property
    def image_idx(self) -> Ints:
        """(K,) positions of the images."""
        return self.reconstruction.tracks.obs_image_idx[self.idx].astype(np.int64)

    @property
    def image_names(self) -> list[str]:
        """K names."""
        return [self.reconstruction.image_names[i] for i in self.image_idx]

    @property
    def track_ids(self) -> Ints:
        """(K,) positions of the tracks."""
        return self.reconstruction.tracks.obs_track_idx[self.idx].astype(np.int64)

    @property
    def feature_idx(self) -> Ints:
        """(K,) positions among the keypoints of their images."""
        return self.reconstruction.tracks.obs_feature_idx[self.idx].astype(np.int64)

    @property
    def xy(self) -> Array:
        """(K, 2) pixels."""
        return self.reconstruction.tracks.obs_xy[self.idx]

    @property
    def is_inlier(self) -> NDArray[np.bool_]:
        """(K,) bool: it supports its point."""
        return self.reconstruction.obs_is_inlier[self.idx]

    @property
    def residuals_px(self) -> Array:
        """(K, 2) projected minus observed pixels; NaN where the image or the point is missing, or behind the camera."""
        return self.reconstruction.residuals_px()[self.idx]


def load(path: str | os.PathLike[str], *, model: int = 0, events: Events | None = None) -> Reconstruction:
    """Read a reconstruction: of a workspace of ``reconstruct`` or ``track_sequence`` (its keyframes), or of COLMAP.

    Args:
        path: the workspace, or the folder of a COLMAP model, binary or text, or the one above its ``sparse/0``.
        model: which of several; 0 is the largest.
        events: warned of what a model holds that was left out.

    Returns:
        The reconstruction; every observation of a file is an inlier.

    Raises:
        InputError: no such model, or a file that is truncated, malformed or of a camera model that is not known.

    Example:
        >>> reconstruction = sfmapp.load("colmap/sparse/0")
        >>> report = sfmapp.adjust_bundle(reconstruction)
        >>> reconstruction.save("refined/sparse/0")
    """
    folder = Path(path)
    if not has_model(folder) or model:
        folder = folder / "sparse" / str(model)
        if not has_model(folder):
            found = "no such folder" if not Path(path).is_dir() else f"no model in it, nor in {folder}"
            raise InputError(f"{path}: expected a workspace of sfmapp or a COLMAP model, found {found}")
    found_model, keypoints = read_model(folder, events)
    return Reconstruction.of(found_model, keypoints)
