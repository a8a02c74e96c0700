"""From whatever users have to photographs with cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.images import load
from sfmapp.images.arrays import check_size, known_camera
from sfmapp.images.image_set import ImageOptions, ImageSet
from sfmapp.images.load import Images


def load_images(
    images: Images,
    options: ImageOptions | None = None,
    *,
    camera: Camera | None = None,
    masks: Mapping[str, NDArray[Any]] | None = None,
    events: Events | None = None,
    threads: int | None = None,
) -> ImageSet:
    """Describe photographs: their names, sizes and cameras. Pixels are read when a stage wants them.

    Args:
        images: a folder, a glob pattern or a ``.txt`` list of files; or arrays by name, (H, W) grey, (H, W, 3) RGB or
            (H, W, 4) RGBA of uint8 or uint16; or an :class:`ImageSource`.
        options: what is known about the cameras, and masks of files.
        camera: what took all of them, in place of the options. Its parameters count as known to a per cent, exactly
            where ``is_fixed``.
        masks: of arrays, by name, (H, W), zero or False where nothing may be detected.
        events: told of progress, of files that are skipped, and of how cameras were assigned.
        threads: files that are read at a time; None: as many as there are processors, 8 at most.

    Returns:
        The set; ``root`` is the folder that the names are relative to.

    Raises:
        InputError: the source does not exist, an array is no picture, or the camera is of another size.
        UsageError: options that contradict the images.

    Example:
        >>> images = sfmapp.load_images({"left": left, "right": right}, camera=camera)
    """
    if masks is not None and not isinstance(images, Mapping):
        raise InputError("masks: expected images as arrays by name; of files, options.mask_path names the masks")
    if isinstance(images, ImageSet):
        found = images
    else:
        found, _ = load.load_images(images, options or ImageOptions(), events or Events(), masks=masks, threads=threads)
    return found if camera is None else _taken_by(found, camera)


def _taken_by(images: ImageSet, camera: Camera) -> ImageSet:
    for record in images.images:
        check_size(record, camera)
    return replace(
        images, images=tuple(replace(r, camera_idx=0) for r in images.images), cameras=(known_camera(camera),)
    )
