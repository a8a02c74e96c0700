"""Photographs in memory, described like those of a folder."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.errors import InputError
from sfmapp.images.cameras import SIGMA_USER_PARAMS, Shot, group_cameras
from sfmapp.images.exif import ExifFacts
from sfmapp.images.image_set import ImageOptions, ImageRecord, ImageSet, ImageSource
from sfmapp.images.pixels import checked_pixels
from sfmapp.images.report import CameraPrior


@dataclass(frozen=True)
class ArraySource:
    """An :class:`ImageSource` of arrays.

    Attributes:
        images: pixels by name.
        masks: masks by name; images without one are used whole.
    """

    images: Mapping[str, NDArray[Any]]
    masks: Mapping[str, NDArray[Any]]

    @property
    def names(self) -> Sequence[str]:
        """See :class:`ImageSource`."""
        return list(self.images)

    def pixels(self, name: str) -> NDArray[Any]:
        """See :class:`ImageSource`."""
        return self.images[name]

    def mask(self, name: str) -> NDArray[Any] | None:
        """See :class:`ImageSource`."""
        return self.masks.get(name)


def describe_source(source: ImageSource, options: ImageOptions | None = None) -> tuple[ImageSet, Sequence[CameraPrior]]:
    """The images of a source in its own order, with their cameras.

    Args:
        source: every image of it is looked at once.
        options: what is known about the cameras; names and sizes count as they do for files without EXIF.

    Returns:
        The set, whose ``root`` is None, and what is known of each camera.

    Raises:
        InputError: two images of one name, a name that leads out of its folder, or an array that is no picture.
    """
    options = options or ImageOptions()
    names = list(source.names)
    if len(set(names)) < len(names):
        raise InputError(f"images: expected unique names, found {len(names) - len(set(names))} of them twice")
    records = [_described(source, name, options) for name in names]
    shots = [Shot(record.name, record.width, record.height, ExifFacts()) for record in records]
    cameras, camera_idx, entries, _ = group_cameras(shots, options)
    images = tuple(replace(record, camera_idx=idx) for record, idx in zip(records, camera_idx, strict=True))
    return ImageSet(images, tuple(cameras)), entries


def check_size(record: ImageRecord, camera: Camera) -> None:
    """Raises InputError if an image has not the size of a camera."""
    if (record.width, record.height) != (camera.width, camera.height):
        raise InputError(
            f"{record.name}: {record.width}x{record.height} pixels, but its camera has {camera.width}x{camera.height}"
        )


def known_camera(camera: Camera) -> Camera:
    """A camera that a user gives: its focal length is known, whatever source it does or does not name."""
    if camera.focal_source != "default":
        return camera
    return replace(camera, focal_source="user", focal_sigma=camera.focal_sigma or SIGMA_USER_PARAMS * camera.focal)


def _described(source: ImageSource, name: str, options: ImageOptions) -> ImageRecord:
    pure = PurePosixPath(name)
    if not name or pure.is_absolute() or ".." in pure.parts:
        raise InputError(f"images: expected names relative to one folder, found {name!r}")
    pixels = checked_pixels(name, source.pixels(name))
    digest = hashlib.blake2b(f"{pixels.dtype} {pixels.shape}".encode(), digest_size=16)
    digest.update(pixels.data)
    if (mask := source.mask(name)) is not None:
        digest.update(np.ascontiguousarray(mask).data)
    height, width = pixels.shape[:2]
    has_alpha = pixels.ndim == 3 and pixels.shape[2] == 4 and options.use_alpha
    return ImageRecord(name, Path(name), width, height, digest=digest.hexdigest(), has_alpha=has_alpha, source=source)
