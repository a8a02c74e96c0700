"""Cameras that are known from elsewhere, to hold a result against."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.errors import InputError
from sfmapp.evaluation.poses import match_names
from sfmapp.formats.colmap import has_model, read_model_poses
from sfmapp.formats.colmap_model import checked_camera
from sfmapp.formats.middlebury_multiview import find_middlebury, read_middlebury
from sfmapp.formats.nerfstudio import read_nerfstudio_poses
from sfmapp.formats.text_input import finite_array, nearest_rotation, read_json_object
from sfmapp.formats.trajectory_input import read_tum
from sfmapp.geometry import rigid3

_LARGEST_PX = 1e9
# what a folder is looked through for
_INSIDE = ("", "sparse/0", "sparse", "colmap/sparse/0", "transforms.json", "cameras.json")


@dataclass(frozen=True)
class GroundTruth:
    """Reference cameras.

    Attributes:
        path: the file or folder that they come from.
        names: N names of images, as the file has them; of a trajectory, the timestamps.
        cam_from_world: (N, 7) float64, quaternion x y z w and translation, in the file's own world.
        cameras: N intrinsics in COLMAP's pixel convention; None where the file holds none, or others than ours.
    """

    path: Path
    names: tuple[str, ...]
    cam_from_world: NDArray[np.float64]
    cameras: tuple[Camera, ...] | None

    def for_images(self, image_names: Sequence[str]) -> GroundTruth:
        """The same with the names of our images, where they are found; other entries keep theirs.

        Names are matched in full, then by file name, then without the suffix, then as numbers (timestamps); where all
        this finds nothing, by the whole number that a name ends in (``00003`` and ``mask_00003.png``).

        Raises:
            InputError: not a single image is found.
        """
        index = match_names(image_names, self.names)
        number_of = {_number(PurePosixPath(name).stem): i for i, name in enumerate(image_names)}
        for k in np.flatnonzero(index < 0):
            number = _number(self.names[k])
            if not math.isnan(number) and number in number_of and number_of[number] not in index:
                index[k] = number_of[number]
        if not (index >= 0).any():
            index = _by_last_number(image_names, self.names)
        if not (index >= 0).any():
            raise InputError(
                f"{self.path}: expected cameras of images such as {', '.join(image_names[:3])}; found "
                f"{', '.join(self.names[:3]) or 'none'}: no name fits",
                "names are compared without folder and suffix",
            )
        names = [image_names[i] if i >= 0 else name for i, name in zip(index, self.names, strict=True)]
        return replace(self, names=tuple(names))


def _by_last_number(names: Sequence[str], reference_names: Sequence[str]) -> NDArray[np.int64]:
    """Positions in ``names`` of reference names, by the digits that they end in; -1 where they are not unique."""

    def places(of: Sequence[str]) -> dict[int, list[int]]:
        found: dict[int, list[int]] = {}
        for i, name in enumerate(of):
            if match := re.search(r"(\d+)\D*$", PurePosixPath(name).stem):
                found.setdefault(int(match[1]), []).append(i)
        return found

    ours, theirs = places(names), places(reference_names)
    index = np.full(len(reference_names), -1, np.int64)
    for number, of in theirs.items():
        if len(of) == len(ours.get(number, ())) == 1:
            index[of[0]] = ours[number][0]
    return index


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def read_ground_truth(path: str | Path) -> GroundTruth:
    """Read reference cameras: a COLMAP model, ``cameras.json``, ``transforms.json``, Middlebury's ``NAME_par.txt``, a
    folder with one of them, or a trajectory.

    ``cameras.json`` holds a list ``cameras`` of ``file``, ``R_w2c``, ``t_w2c`` (``x_cam = R X + t``), ``K`` and
    ``dist`` (k1, k2, p1, p2 or null), with pixel centres at whole numbers as OpenCV has them: half a pixel is added to
    the principal point. Trajectories are TUM's (see :func:`read_tum`).

    Raises:
        InputError: the path does not exist, or what is there has none of these forms.
    """
    path = Path(path)
    if path.is_dir():
        inside = [path / name for name in _INSIDE if has_model(path / name) or (path / name).is_file()]
        path = next(iter(inside), find_middlebury(path) or path)
    if path.is_dir():
        return _ground_truth(path, *read_model_poses(path))
    if not path.exists():
        raise InputError(f"{path}: expected a COLMAP model, cameras.json or TUM trajectory, found nothing")
    if path.name.endswith("_par.txt"):
        return _ground_truth(path, *read_middlebury(path))
    if path.suffix.lower() != ".json":
        names, poses = read_tum(path)
        if not names:
            raise InputError(f"{path}: expected lines of 8 numbers (TUM trajectory), found none")
        return GroundTruth(path, tuple(names), poses, None)
    document = read_json_object(path)
    if "frames" in document:
        return _ground_truth(path, *read_nerfstudio_poses(path))
    return _from_cameras_json(path, document)


def _ground_truth(
    path: Path, names: list[str], poses: NDArray[np.float64], cameras: list[Camera] | None
) -> GroundTruth:
    return GroundTruth(path, tuple(names), poses, None if cameras is None else tuple(cameras))


def _from_cameras_json(path: Path, document: dict[str, Any]) -> GroundTruth:
    entries = document.get("cameras")
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path}: expected a list of cameras (or of frames), found {', '.join(list(document)[:6])}")
    names, poses, cameras = [], [], []
    for position, entry in enumerate(entries):
        place = f"{path}: camera {position}"
        if not isinstance(entry, dict) or not isinstance(entry.get("file"), str):
            raise InputError(f"{place}: expected an object with the name of its file")
        names.append(entry["file"])
        if "R_cam_to_world" in entry:  # a pure rotation: all cameras in one place
            rotation = finite_array(f"{place}: R_cam_to_world", entry["R_cam_to_world"], (3, 3)).T
            translation = np.zeros(3)
        else:
            rotation = finite_array(f"{place}: R_w2c", entry.get("R_w2c"), (3, 3))
            translation = finite_array(f"{place}: t_w2c", entry.get("t_w2c"), (3,))
        poses.append(rigid3.from_matrix(nearest_rotation(place, rotation), translation))
        if entry.get("K", document.get("K")) is not None:
            cameras.append(_json_camera(path, place, {**document, **entry}))
    if len(set(names)) < len(names):
        raise InputError(f"{path}: expected every file once, found one twice")
    known = tuple(cameras) if len(cameras) == len(names) else None
    return GroundTruth(path, tuple(names), np.array(poses).reshape(-1, 7), known)


def _json_camera(path: Path, place: str, entry: dict[str, Any]) -> Camera:
    matrix = finite_array(f"{place}: K", entry["K"], (3, 3))
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5
    if matrix[0, 1] or matrix[1, 0] or matrix[2].tolist() != [0, 0, 1]:
        raise InputError(f"{place}: expected K without skew and with a last row of 0 0 1, found {matrix.tolist()}")
    if not (np.abs(matrix) < _LARGEST_PX).all():
        raise InputError(f"{place}: expected K in pixels, found {matrix.tolist()}")
    # where the size is not given, the principal point is taken for the centre
    width = float(finite_array(f"{place}: width", entry.get("width", round(2 * cx)), ()))
    height = float(finite_array(f"{place}: height", entry.get("height", round(2 * cy)), ()))
    if width % 1 or height % 1:
        raise InputError(f"{place}: expected a whole number of pixels, found {width} x {height}")
    size = (int(width), int(height))
    if entry.get("dist") is None:
        return checked_camera(path, entry["file"], "PINHOLE", *size, [fx, fy, cx, cy])
    distortion = entry["dist"]
    if not isinstance(distortion, list) or not 4 <= len(distortion) <= 8 or any(distortion[4:]):
        raise InputError(f"{place}: expected dist as k1, k2, p1, p2 (and zeros), found {str(distortion)[:80]}")
    coefficients = finite_array(f"{place}: dist", distortion[:4], (4,))
    return checked_camera(path, entry["file"], "OPENCV", *size, [fx, fy, cx, cy, *coefficients])
