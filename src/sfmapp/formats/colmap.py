"""COLMAP models: folders of cameras, images, points3D, rigs and frames, binary or text.

COLMAP's conventions are ours (cam_from_world, top-left pixel centre at 0.5, 0.5) but for the quaternion,
which its files hold as w x y z. See https://colmap.github.io/format.html.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.formats.atomic import replaced_folder
from sfmapp.formats.colmap_binary import read_binary, read_binary_cameras, read_binary_images, write_binary
from sfmapp.formats.colmap_model import Keypoints, check_unique, model_from_reconstruction, reconstruction_from_model
from sfmapp.formats.colmap_text import read_text, read_text_cameras, read_text_images, write_text
from sfmapp.scene.reconstruction import Reconstruction

_STEMS = ("cameras", "images", "points3D", "rigs", "frames")
# of a binary model, which is what we write
MODEL_FILES = tuple(f"{stem}.bin" for stem in _STEMS)
_FILES = frozenset(f"{stem}.{ending}" for stem in _STEMS for ending in ("bin", "txt"))


def write_model(folder: str | Path, reconstruction: Reconstruction, keypoints: Keypoints | None = None) -> None:
    """Write the registered part of a reconstruction as a binary model that COLMAP 3.x and 4.x read.

    The ids of images and cameras are positions plus one, that of a point is the position of its track plus one; a
    camera that serves as several sensors of a rig is written once for each. Images that share a rig's pose make one
    frame, every other image one of its own. The same input gives the same bytes. The folder appears at once; other
    files that lie in an older one stay.

    Args:
        folder: where the five files go.
        reconstruction: images without a pose and points without coordinates are left out.
        keypoints: for every image, registered or not, (N, 2) or wider, pixels: all become keypoints of the model, so
            that their positions agree with the database; tracked ones take the pixel from the tracks, which may have
            been refined. None: just the tracked ones, in the order of their positions.

    Raises:
        InputError: the folder cannot be written.
        ValueError: a pose or point is infinite, a keypoint belongs to two points, or a frame of the rig holds two
            images of one sensor.
    """
    model = model_from_reconstruction(reconstruction, keypoints)
    with replaced_folder(Path(folder), _FILES) as beside:
        write_binary(beside, model)


def write_model_text(folder: str | Path, reconstruction: Reconstruction, keypoints: Keypoints | None = None) -> None:
    """As :func:`write_model`, as text; numbers are printed so that reading gives the same bits.

    Raises:
        UsageError: an image name holds white space, at which COLMAP's reader would cut it off.
    """
    model = model_from_reconstruction(reconstruction, keypoints)
    with replaced_folder(Path(folder), _FILES) as beside:
        write_text(beside, model)


def is_model_file(path: Path) -> bool:
    """Whether a file is by its name one of a model, binary or text."""
    return path.name in _FILES


def has_model(folder: str | Path) -> bool:
    """Whether the folder holds the files of a model, binary or text."""
    return any((Path(folder) / f"images.{ending}").is_file() for ending in ("bin", "txt"))


def read_model_poses(folder: str | Path) -> tuple[list[str], NDArray[np.float64], list[Camera] | None]:
    """Names and poses of a model whose cameras and points need not be such as :func:`read_model` takes.

    Returns:
        Names of I images by ascending id, cam_from_world (I, 7), and the camera of each; None if one is of another
        model than ours, or malformed.

    Raises:
        InputError: the files of images, rigs or frames are missing, truncated or malformed.
    """
    folder = Path(folder)
    is_binary = _is_binary(folder)
    images = read_binary_images(folder) if is_binary else read_text_images(folder)
    check_unique(folder, "image", images.ids, images.names)
    order = np.argsort(images.ids)
    names, poses = [images.names[i] for i in order], images.cam_from_world[order]
    try:
        ids, cameras = (read_binary_cameras if is_binary else read_text_cameras)(folder)
        camera_of = dict(zip(ids.tolist(), cameras, strict=True))
        return names, poses, [camera_of[i] for i in images.camera_ids[order].tolist()]
    except (InputError, KeyError):
        return names, poses, None


def read_model(folder: str | Path, events: Events | None = None) -> tuple[Reconstruction, Keypoints]:
    """Read a model, binary (preferred, as COLMAP does) or text, with rigs and frames or without.

    Images, cameras and points stand in ascending order of their ids; every track element is an inlier. Images of rigs
    with several cameras are on the reconstruction's ``rig``. Where points or images were taken away, ids that still
    name them count as none; a model without a file of points has none.

    Args:
        folder: of the model.
        events: warned, once for each kind, of what was left out.

    Returns:
        The reconstruction, and for each image the pixels (N, 2) float64 of its keypoints.

    Raises:
        InputError: a file is missing, truncated, malformed or disagrees with the others, or a camera model is not ours.
    """
    folder = Path(folder)
    model = read_binary(folder) if _is_binary(folder) else read_text(folder)
    reconstruction, keypoints, notes = reconstruction_from_model(folder, model)
    for note in notes:
        (events or Events()).warned("model", f"{folder}: {note}")
    return reconstruction, keypoints


def _is_binary(folder: Path) -> bool:
    """Whether a model is binary. Raises InputError if the folder holds none of either kind."""
    if has_model(folder):
        return (folder / "images.bin").is_file()
    found = "no such folder" if not folder.is_dir() else ", ".join(sorted(p.name for p in folder.iterdir())[:8])
    raise InputError(
        f"{folder}: expected a COLMAP model (images.bin or images.txt), found {found or 'an empty folder'}"
    )
