"""A second reader of COLMAP models, COLMAP's own: to check what we wrote with code that is not ours."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sfmapp.errors import InputError
from sfmapp.formats.colmap_model import checked_camera
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.tracks import make_tracks


def read_with_pycolmap(folder: str | Path) -> Reconstruction:
    """Cameras, poses and points of a model, in ascending order of their ids, as pycolmap reads them; no observations.

    Raises:
        InputError: pycolmap cannot read it.
    """
    import pycolmap

    folder = Path(folder)
    try:
        model = pycolmap.Reconstruction(str(folder))
    except (ValueError, RuntimeError, IndexError) as error:
        raise InputError(f"{folder}: pycolmap cannot read it: {str(error)[:200]}") from error
    camera_ids, image_ids = sorted(model.cameras), sorted(model.images)
    cameras = [
        checked_camera(folder, i, c.model.name, c.width, c.height, c.params)
        for i, c in ((i, model.cameras[i]) for i in camera_ids)
    ]
    images = [model.images[i] for i in image_ids]
    poses = [image.cam_from_world() for image in images]
    points = model.points3D
    points = [points[i] for i in sorted(points)]
    none = np.zeros(0, np.int64)
    return Reconstruction(
        cameras,
        [image.name for image in images],
        np.searchsorted(camera_ids, [image.camera_id for image in images]).astype(np.int32),
        np.array([[*pose.rotation.quat, *pose.translation] for pose in poses]).reshape(-1, 7),
        make_tracks(len(images), len(points), none, none, none, np.zeros((0, 2))),
        np.array([point.xyz for point in points]).reshape(-1, 3),
        np.zeros(0, bool),
        np.array([point.color for point in points], np.uint8).reshape(-1, 3),
    )
