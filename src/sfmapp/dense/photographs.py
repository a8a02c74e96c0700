"""The photographs of a model: where they are, how they are held, and which of them are copies of others."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.camera.models import PARAM_NAMES
from sfmapp.errors import InputError, listed
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.geometry.orientation import upright_size
from sfmapp.images.folder import describe_images
from sfmapp.images.image_set import ImageOptions, ImageRecord
from sfmapp.scene.reconstruction import Reconstruction

STAGE = "views"
_NAMES_SHOWN = 3
# shares of the extent of all cameras within which those of equal files, and those of other copies, are in one place
SAME_FILE_PLACE, SAME_PLACE = 1e-2, 1e-4
SAME_TURN_DEG = 1.0


@dataclass(frozen=True)
class Photographs:
    """The registered images of a model that have a photograph (V), in the model's order.

    Attributes:
        image_idx: (V,) positions in the model.
        records: V of them.
        cameras: V of them, in pixels of the photograph as it is held.
        missing: (name, reason) of registered images that have none.
        copies: names of images that are left out because another one holds the same pixels, or has the same pose.
    """

    image_idx: NDArray[np.int64]
    records: tuple[ImageRecord, ...]
    cameras: tuple[Camera, ...]
    missing: tuple[tuple[str, str], ...]
    copies: tuple[str, ...]


def find_photographs(
    model: Reconstruction,
    folder: Path,
    options: ImageOptions,
    *,
    is_upright: bool,
    with_copies: bool = False,
    threads: int = 1,
    events: Events | None = None,
) -> Photographs:
    """Find the photograph of every registered image.

    Args:
        model: cameras, names and poses.
        folder: that the names are relative to.
        options: masks and limits.
        is_upright: pixels are counted in the photograph turned as EXIF says (old workspaces of sfmapp); False: as
            stored. Where only one of the two has the shape of the camera's image, that one it is.
        with_copies: keep images that are copies of others.
        threads: files that are read at a time.
        events: told of photographs that are missing and of copies.

    Raises:
        InputError: none is there, or one has another shape than its camera's image.
    """
    events = events or Events()
    registered = model.registered_idx
    names = [model.image_names[i] for i in registered]
    records, missing = describe_images(folder, names, options, threads=threads)
    if missing:
        _tell_missing(folder, missing, len(names), events)
    found: list[tuple[int, ImageRecord, Camera]] = []
    for image, record in zip(registered, records, strict=True):
        if record is not None:
            held = _as_held(record, model.cameras[model.image_camera_idx[image]], is_upright)
            found.append((int(image), *held))
    if options.mask_path is not None and not any(record.mask_path for _, record, _ in found):
        name = found[0][1].name
        raise InputError(
            f"no mask in {options.mask_path} fits any image", f"expected for example {options.mask_path}/{name}.png"
        )
    kept, copies = (found, []) if with_copies else _without_copies(found, model.cam_from_world)
    if copies:
        events.warned(STAGE, f"{listed(copies)}: copies of other images in the same place, left out", names=copies)
    return Photographs(
        np.array([image for image, _, _ in kept], np.int64), tuple(record for _, record, _ in kept),
        tuple(camera for _, _, camera in kept), tuple(missing), tuple(copies),
    )  # fmt: skip


def _tell_missing(folder: Path, missing: list[tuple[str, str]], num_images: int, events: Events) -> None:
    listed = "; ".join(f"{name}: {reason}" for name, reason in missing[:_NAMES_SHOWN])
    if len(missing) > _NAMES_SHOWN:
        listed += "; ..."
    text = f"{len(missing)} of {num_images} images of the model are not in {folder} ({listed})"
    if len(missing) == num_images:
        raise InputError(text, "give the folder of the photographs with --images DIR; names are relative to it")
    events.warned(STAGE, text, names=[name for name, _ in missing])


def _as_held(record: ImageRecord, camera: Camera, is_upright: bool) -> tuple[ImageRecord, Camera]:
    """The record turned as the camera has it, and the camera in pixels of the photograph, which may be smaller."""
    stored = record
    width, height = upright_size(record.orientation, record.width, record.height)
    upright = replace(record, width=width, height=height, orientation=1, turn=record.orientation)
    for held in (upright, stored) if is_upright else (stored, upright):
        scale = np.array([held.width / camera.width, held.height / camera.height])
        if abs(held.width - camera.width * scale[1]) <= 1.0 or abs(held.height - camera.height * scale[0]) <= 1.0:
            return held, camera if (scale == 1.0).all() else scaled_camera(camera, held.width, held.height)
    raise InputError(
        f"{record.path}: {stored.width}x{stored.height} pixels, but its camera in the model has "
        f"{camera.width}x{camera.height}",
        "give the folder of the photographs that the model was made of",
    )


def scaled_camera(camera: Camera, width: int, height: int) -> Camera:
    """The same camera for an image of another size, in pixels."""
    x, y = width / camera.width, height / camera.height
    factor = {"f": (x + y) / 2.0, "fx": x, "cx": x, "fy": y, "cy": y, "w": x, "h": y, "s": x}
    params = [v * factor.get(name, 1.0) for name, v in zip(PARAM_NAMES[camera.model], camera.params, strict=True)]
    return replace(camera, width=width, height=height, params=np.array(params))


def _without_copies(
    found: list[tuple[int, ImageRecord, Camera]], cam_from_world: NDArray[np.float64]
) -> tuple[list[tuple[int, ImageRecord, Camera]], list[str]]:
    """The first of each set of equal files in about the same place, and of photographs with the same pose, as copies in
    another encoding have: to trust a patch in a photograph and in its copy is to trust it twice."""
    poses = cam_from_world[[image for image, _, _ in found]]
    center, rotation = rigid3.center(poses), rigid3.rotation_matrix(poses)
    extent = float(np.linalg.norm(np.ptp(center, axis=0))) if len(found) else 0.0
    kept: list[int] = []
    copies = []
    for i, (_, record, _) in enumerate(found):
        apart = np.linalg.norm(center[kept] - center[i], axis=1)
        turned = rigid3.rotation_angle_deg(rotation[kept] @ rotation[i].T)
        same_file = np.array([found[j][1].digest == record.digest for j in kept], bool)
        same_pose = (apart <= SAME_PLACE * extent) & (turned < SAME_TURN_DEG)
        if (same_pose | (same_file & (apart <= SAME_FILE_PLACE * extent))).any():
            copies.append(record.name)
        else:
            kept.append(i)
    return [found[i] for i in kept], copies
