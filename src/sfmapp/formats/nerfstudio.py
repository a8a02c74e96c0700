"""nerfstudio's transforms.json: world_from_cam matrices with OpenGL's camera axes (x right, y up, z backward).

Its pixel convention is ours (top-left pixel centre at 0.5, 0.5): its own conversion from COLMAP takes cx and cy over
as they are. That conversion also turns the world (``applied_transform``), because COLMAP's worlds tend to have y down
and nerfstudio wants z up; files written here do the same and look alike.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.camera.lens import BROWN, EQUIRECTANGULAR, RADIAL_FISHEYE
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError, UsageError
from sfmapp.formats.atomic import replaced_file
from sfmapp.formats.colmap_model import checked_camera
from sfmapp.formats.ply import write_ply
from sfmapp.formats.ply_reader import read_ply_geometry
from sfmapp.formats.text_input import finite_array, nearest_rotation, read_json_object
from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.tracks import make_tracks

_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
_APPLIED = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # (x, y, z) to (x, z, -y)
_DISTORTION = {
    CameraModel.OPENCV: ("k1", "k2", "p1", "p2"), CameraModel.OPENCV_FISHEYE: ("k1", "k2", "k3", "k4"),
    CameraModel.EQUIRECTANGULAR: (),
}  # fmt: skip
_ALIASES = {"PINHOLE": "OPENCV", "SIMPLE_PINHOLE": "OPENCV", "SIMPLE_RADIAL": "OPENCV", "RADIAL": "OPENCV"}
_OF_FAMILY = {
    BROWN: CameraModel.OPENCV, RADIAL_FISHEYE: CameraModel.OPENCV_FISHEYE, EQUIRECTANGULAR: CameraModel.EQUIRECTANGULAR,
}  # fmt: skip
POINTS_NAME = "sparse_pc.ply"


def write_nerfstudio(path: str | Path, reconstruction: Reconstruction, image_folder: str = "images") -> None:
    """Write transforms.json and, beside it, the points as ``sparse_pc.ply``. Observations are not part of the format.

    Args:
        path: the JSON file.
        reconstruction: only registered images are written.
        image_folder: where the images lie, seen from the JSON file.

    Raises:
        UsageError: a camera is neither perspective with k1, k2, p1, p2, nor fisheye with k1..k4, nor a panorama.
    """
    path = Path(path)
    registered = reconstruction.registered_idx
    intrinsics = [_intrinsics(camera) for camera in reconstruction.cameras]
    used = sorted({int(i) for i in reconstruction.image_camera_idx[registered]})
    shared = intrinsics[used[0]] if len(used) == 1 else {}
    world_from_cam = rigid3.inverse(reconstruction.cam_from_world)
    frames = []
    for image in registered.tolist():
        matrix = np.eye(4)
        matrix[:3, :3] = _APPLIED @ rigid3.rotation_matrix(world_from_cam[image]) @ _OPENGL_FROM_OPENCV
        matrix[:3, 3] = _APPLIED @ world_from_cam[image, 4:]
        own = {} if shared else intrinsics[reconstruction.image_camera_idx[image]]
        name = PurePosixPath(image_folder) / reconstruction.image_names[image]
        frames.append({"file_path": str(name), "transform_matrix": matrix.tolist(), **own})
    points = np.flatnonzero(reconstruction.is_triangulated)
    applied = np.concatenate([_APPLIED, np.zeros((3, 1))], 1).tolist()
    document = {**shared, "applied_transform": applied, "ply_file_path": POINTS_NAME, "frames": frames}
    write_ply(
        path.with_name(POINTS_NAME), reconstruction.point_xyz[points] @ _APPLIED.T, reconstruction.point_rgb[points]
    )
    with replaced_file(path) as beside:
        beside.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _intrinsics(camera: Camera) -> dict[str, Any]:
    model = _OF_FAMILY.get(BROWN if camera.is_pinhole else camera.family)
    if model is None:
        raise UsageError(
            f"nerfstudio's transforms.json cannot hold a {camera.model.name} camera",
            "write undistorted photographs with sfmapp undistort and export those, or export colmap-bin",
        )
    fx, fy, cx, cy, *distortion = camera.canonical[:8].tolist()
    size = {"camera_model": model.name, "w": camera.width, "h": camera.height}
    return size | {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy} | dict(zip(_DISTORTION[model], distortion, strict=False))


def read_nerfstudio(path: str | Path) -> Reconstruction:
    """Read poses, cameras (equal ones shared) and, where the file names them, points without observations.

    Names are the ``file_path`` entries with forward slashes; the applied transform and scale are undone. Points that
    are not finite are left out.

    Raises:
        InputError: the file is not JSON of this form, a matrix is not rigid, a camera is not one of ours, or two
            frames name the same file.
    """
    path = Path(path)
    document = read_json_object(path)
    names, poses = _poses(path, document)
    cameras: dict[tuple[float, ...], int] = {}
    camera_list: list[Camera] = []
    camera_idx = []
    for camera in _cameras(path, document):
        key = (camera.model, camera.width, camera.height, *camera.params.tolist())
        if key not in cameras:
            cameras[key] = len(camera_list)
            camera_list.append(camera)
        camera_idx.append(cameras[key])
    xyz, rgb = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    if document.get("ply_file_path") is not None:
        points = read_ply_geometry(_inside(path, document["ply_file_path"]))
        rotation, shift, scale = _applied(path, document)
        xyz = (points.xyz[points.is_finite] / scale - shift) @ rotation
        rgb = (np.zeros(points.xyz.shape, np.uint8) if points.rgb is None else points.rgb)[points.is_finite]
    none = np.zeros(0, np.int64)
    tracks = make_tracks(len(names), len(xyz), none, none, none, np.zeros((0, 2)))
    return Reconstruction(
        camera_list, names, np.array(camera_idx, np.int32), poses, tracks, xyz, np.zeros(0, bool), rgb
    )


def read_nerfstudio_poses(path: str | Path) -> tuple[list[str], NDArray[np.float64], list[Camera] | None]:
    """Names and poses (N, 7) as :func:`read_nerfstudio` gives them, of files whose cameras and points need not be ours.

    Returns:
        Names, cam_from_world, and the camera of each frame; None where the file does not say them, as those of the
        synthetic NeRF scenes, or has others than ours.

    Raises:
        InputError: the file is not JSON of this form, a matrix is not rigid, or two frames name the same file.
    """
    path = Path(path)
    document = read_json_object(path)
    names, poses = _poses(path, document)
    try:
        return names, poses, _cameras(path, document)
    except InputError:
        return names, poses, None


def read_nerfstudio_cameras(path: str | Path) -> tuple[list[str], list[Camera]]:
    """Names of the frames, as :func:`read_nerfstudio` gives them, and the camera of each.

    Raises:
        InputError: the file is not JSON of this form, or a camera is not one of ours.
    """
    path = Path(path)
    document = read_json_object(path)
    return _poses(path, document)[0], _cameras(path, document)


def _poses(path: Path, document: Mapping[str, Any]) -> tuple[list[str], NDArray[np.float64]]:
    """Names of N frames and their poses (N, 7)."""
    frames = document.get("frames")
    if not isinstance(frames, list):
        raise InputError(f"{path}: expected a list of frames, found {type(frames).__name__}")
    applied = _applied(path, document)
    names, poses = [], []
    for position, frame in enumerate(frames):
        place = f"{path}: frame {position}"
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str) or not frame["file_path"]:
            raise InputError(f"{place}: expected an object with file_path")
        names.append(frame["file_path"].replace("\\", "/").removeprefix("./"))  # Windows has other slashes
        poses.append(_pose(place, frame.get("transform_matrix"), *applied))
    if len(set(names)) < len(names):
        raise InputError(
            f"{path}: expected every file_path once, found {sorted(n for n in names if names.count(n) > 1)[0]!r} twice"
        )
    return names, np.array(poses, np.float64).reshape(-1, 7)


def _cameras(path: Path, document: Mapping[str, Any]) -> list[Camera]:
    """The camera of each frame."""
    return [_camera(path, f"{path}: frame {n}", {**document, **frame}) for n, frame in enumerate(document["frames"])]


def _inside(path: Path, name: Any) -> Path:
    """A file that JSON from outside names has to lie beside it."""
    if not isinstance(name, str) or PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
        raise InputError(f"{path}: expected ply_file_path to lie beside the file, found {str(name)[:80]!r}")
    return path.parent / name


def _applied(path: Path, document: Mapping[str, Any]) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Rotation R (3, 3), shift t (3,) and scale s that made the world of the file of the original: s (R x + t)."""
    scale = float(finite_array(f"{path}: applied_scale", document.get("applied_scale", 1.0), ()))
    if not scale > 0.0:
        raise InputError(f"{path}: expected an applied_scale above 0, found {scale}")
    value = document.get("applied_transform")
    if value is None:
        return np.eye(3), np.zeros(3), scale
    rows = value[:3] if isinstance(value, list) else value
    matrix = finite_array(f"{path}: applied_transform", rows, (3, 4))
    return nearest_rotation(f"{path}: applied_transform", matrix[:, :3], 1e-6), matrix[:, 3], scale


def _pose(
    place: str, value: Any, rotation: NDArray[np.float64], shift: NDArray[np.float64], scale: float
) -> NDArray[np.float64]:
    """(7,) cam_from_world of a transform_matrix."""
    rows = value[:3] if isinstance(value, list) and len(value) == 4 else value
    matrix = finite_array(f"{place}: transform_matrix", rows, (3, 4))
    world_from_cam = rotation.T @ nearest_rotation(f"{place}: transform_matrix", matrix[:, :3]) @ _OPENGL_FROM_OPENCV
    return rigid3.inverse(rigid3.from_matrix(world_from_cam, rotation.T @ (matrix[:, 3] / scale - shift)))


def _camera(path: Path, place: str, entries: Mapping[str, Any]) -> Camera:
    """The camera of a frame from its own entries and the shared ones."""
    # instant-ngp has a flag in place of a name
    name = entries.get("camera_model", "OPENCV_FISHEYE" if entries.get("is_fisheye") is True else "OPENCV")
    name = _ALIASES.get(name, name) if isinstance(name, str) else str(name)
    if name not in (model.name for model in _DISTORTION):
        expected = "OPENCV, OPENCV_FISHEYE or EQUIRECTANGULAR"
        raise InputError(f"{place}: expected camera_model {expected}, found {name[:40]!r}")

    def number(key: str, default: float | None = None) -> float:
        if key not in entries and default is not None:
            return default
        if key not in entries:
            raise InputError(f"{place}: expected {key}, found none here or at the top of the file")
        return float(finite_array(f"{place}: {key}", entries[key], ()))

    width, height = number("w"), number("h")
    if width % 1 or height % 1:
        raise InputError(f"{place}: expected a whole number of pixels, found {width} x {height}")
    if name == CameraModel.EQUIRECTANGULAR.name:
        return checked_camera(path, entries.get("file_path", ""), name, int(width), int(height), [width, height])
    if "fl_x" not in entries and "camera_angle_x" in entries:  # the form of the synthetic NeRF scenes
        angle = number("camera_angle_x")
        if not 0 < angle < math.pi:
            raise InputError(f"{place}: expected camera_angle_x from 0 to pi, found {angle}")
        fx = width / 2 / math.tan(angle / 2)
    else:
        fx = number("fl_x")
    names = _DISTORTION[CameraModel[name]]
    for extra in ("k3", "k4", "k5", "k6"):
        if extra not in names and number(extra, 0.0) != 0.0:
            raise InputError(f"{place}: expected no {extra} in a camera of model {name}, found {entries[extra]}")
    center = (number("cx", width / 2), number("cy", height / 2))
    params = [fx, number("fl_y", fx), *center, *(number(key, 0.0) for key in names)]
    return checked_camera(path, entries.get("file_path", ""), name, int(width), int(height), params)
