"""Cameras of Middlebury's multi-view sets (Seitz et al., CVPR 2006): ``NAME_par.txt``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError
from sfmapp.formats.text_input import nearest_rotation, plain_numbers, read_limited_text
from sfmapp.geometry import rigid3

# the name of the image, K and R row by row, t
_FIELDS = 22


def find_middlebury(folder: Path) -> Path | None:
    """The file of a folder; None if it has none, or several."""
    found = sorted(folder.glob("*_par.txt"))
    return found[0] if len(found) == 1 else None


def read_middlebury(path: Path) -> tuple[list[str], NDArray[np.float64], list[Camera]]:
    """Names of N images, their poses cam_from_world (N, 7), and their cameras.

    Each line is ``NAME k11 ... k33 r11 ... r33 t1 t2 t3`` of a camera K [R t] that has the centre of the first pixel at
    (0, 0); half a pixel is added. The file says nothing of the size of the images: the cameras' is twice the principal
    point.

    Raises:
        InputError: a line that is none of these, or another number of lines than the first one says.
    """
    rows = [line.split() for line in read_limited_text(path).splitlines() if line.strip()]
    if rows and len(rows[0]) == 1 and rows[0][0].isdecimal():
        count = int(rows.pop(0)[0])
        if count != len(rows):
            raise InputError(f"{path}: expected {count} cameras, as its first line says, found {len(rows)}")
    if not rows:
        raise InputError(f"{path}: expected a line for each image, found none")
    names, poses, cameras = [], [], []
    for row in rows:
        place = f"{path}: {row[0][:80]}"
        try:
            values = np.array(plain_numbers(row[1:]))
        except ValueError:
            values = np.zeros(0)
        if len(row) != _FIELDS or len(values) != _FIELDS - 1 or not np.isfinite(values).all():
            raise InputError(f"{place}: expected NAME and {_FIELDS - 1} finite numbers of K, R and t")
        k, rotation = values[:9].reshape(3, 3), nearest_rotation(place, values[9:18].reshape(3, 3))
        if k[1, 0] or k[0, 1] or k[2].tolist() != [0.0, 0.0, 1.0] or min(k[0, 0], k[1, 1]) <= 0.0:
            raise InputError(f"{place}: expected K without skew and with a last row of 0 0 1, found {k.tolist()}")
        names.append(row[0])
        poses.append(rigid3.from_matrix(rotation, values[18:]))
        width, height = max(1, round(2.0 * k[0, 2])), max(1, round(2.0 * k[1, 2]))
        params = np.array([k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5])
        cameras.append(Camera(CameraModel.PINHOLE, width, height, params, focal_source="file"))
    if len(set(names)) < len(names):
        raise InputError(f"{path}: expected every image once, found one twice")
    return names, np.array(poses).reshape(-1, 7), cameras
