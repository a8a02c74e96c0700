"""Bundler's output, version 0.3 (Snavely, "Bundler v0.4 user's manual", 2010).

Its cameras look down their negative z axis with y up, its pixels are counted from the principal point with y up, and
its lens is a focal length and two radial coefficients. It does not say where the principal point lies in the image:
most programs take the centre.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.camera.lens import BROWN
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError, UsageError
from sfmapp.formats.atomic import replaced_file
from sfmapp.formats.text_input import nearest_rotation, plain_numbers, read_limited_text
from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.tracks import make_tracks

Array = NDArray[np.float64]

_BUNDLER_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])
_HEADER = "# Bundle file v0.3"
_LIST_NAME = "list.txt"


def write_bundler(path: str | Path, reconstruction: Reconstruction) -> None:
    """Write the registered images, the points and their inliers; beside them, as COLMAP does, names: ``NAME.list.txt``.

    Raises:
        UsageError: a camera has what the format cannot hold: tangential or fisheye distortion, two focal lengths; or
            an image name holds white space.
    """
    path = Path(path)
    registered = reconstruction.registered_idx
    for idx in np.unique(reconstruction.image_camera_idx[registered]):
        _refuse_loss(reconstruction.cameras[idx], int(idx))
    names = [reconstruction.image_names[image] for image in registered]
    for name in names:
        if name.split() != [name]:
            raise UsageError(f"Bundler's list.txt ends a name at white space, which {name!r} holds", "rename the image")
    lines = [_HEADER, f"{len(registered)} {np.count_nonzero(reconstruction.is_triangulated)}"]
    for image in registered:
        camera = reconstruction.cameras[reconstruction.image_camera_idx[image]]
        pose = reconstruction.cam_from_world[image]
        lines.append(_text([camera.canonical[0], camera.canonical[4], camera.canonical[5]]))
        lines += [_text(row) for row in (_BUNDLER_FROM_OPENCV @ rigid3.rotation_matrix(pose)).tolist()]
        lines.append(_text((_BUNDLER_FROM_OPENCV @ pose[4:]).tolist()))
    lines += _point_lines(reconstruction, registered)
    with replaced_file(path) as beside:
        beside.write_text("\n".join([*lines, ""]), encoding="utf-8")
    with replaced_file(list_path(path)) as beside:
        beside.write_text("\n".join([*names, ""]), encoding="utf-8")


def list_path(path: Path) -> Path:
    """Where the names of a bundle file's images are written."""
    return path.with_name(f"{path.name}.{_LIST_NAME}")


def _refuse_loss(camera: Camera, idx: int) -> None:
    fx, fy, _, _, _, _, p1, p2 = camera.canonical[:8]
    lost = []
    if camera.family != BROWN and not camera.is_pinhole:
        lost.append(f"{camera.model.name.replace('_', ' ').lower()} lens")
    elif p1 or p2:
        lost.append(f"tangential distortion p1 = {p1:.3g}, p2 = {p2:.3g}")
    if fx != fy:
        lost.append(f"separate focal lengths fx = {fx:.2f}, fy = {fy:.2f}")
    if lost:
        raise UsageError(
            f"Bundler's format cannot hold camera {idx} ({camera.model.name}): it would lose its {' and '.join(lost)}",
            "export colmap-text or nerfstudio, or reconstruct with SIMPLE_RADIAL or RADIAL",
        )


def _point_lines(reconstruction: Reconstruction, registered: NDArray[np.int64]) -> list[str]:
    tracks = reconstruction.tracks
    position = np.full(len(reconstruction.image_names), -1)
    position[registered] = np.arange(len(registered))
    centers = np.array([camera.canonical[2:4] for camera in reconstruction.cameras]).reshape(-1, 2)
    centered = (tracks.obs_xy - centers[reconstruction.image_camera_idx[tracks.obs_image_idx]]) * [1, -1]
    lines = []
    for t in np.flatnonzero(reconstruction.is_triangulated):
        obs = np.arange(tracks.track_ptr[t], tracks.track_ptr[t + 1])
        obs = obs[reconstruction.obs_is_inlier[obs]]
        views = [f"{position[tracks.obs_image_idx[o]]} {tracks.obs_feature_idx[o]} {_text(centered[o])}" for o in obs]
        lines.append(_text(reconstruction.point_xyz[t]))
        lines.append(" ".join(map(str, reconstruction.point_rgb[t])))
        lines.append(" ".join([str(len(views)), *views]))
    return lines


def _text(values: Array | list[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def read_bundler(
    path: str | Path, image_sizes: NDArray[np.integer] | None = None, principal_points: Array | None = None
) -> Reconstruction:
    """Read cameras, points and observations; names come from ``NAME.list.txt`` or ``list.txt`` beside it.

    Images share a camera (RADIAL) where their numbers are equal. A focal length of zero is Bundler's sign for an image
    that was not registered.

    Args:
        image_sizes: (I, 2) width and height in pixels, which the format does not hold. None: the smallest image around
            the centre that holds all observations, so that pixels are right up to a shift.
        principal_points: (I, 2) pixels; None: the centre of each image.

    Raises:
        InputError: another version, truncated, not finite, indices out of range, or names that do not fit.
    """
    path = Path(path)
    text = read_limited_text(path)
    head, _, body = text.partition("\n")
    if head.strip() != _HEADER:
        raise InputError(f"{path}: expected {_HEADER!r} in the first line, found {head[:40]!r}")
    try:
        values = np.array(plain_numbers(body.split()), np.float64)
    except ValueError:
        raise InputError(f"{path}: expected nothing but numbers after the first line") from None
    if len(values) < 2 or not np.isfinite(values).all() or (values[:2] < 0).any() or (values[:2] % 1).any():
        raise InputError(f"{path}: expected the numbers of cameras and points, then finite numbers")
    num_images, num_points = int(values[0]), int(values[1])
    if 15 * num_images + 7 * num_points > len(values) - 2:
        raise InputError(
            f"{path}: truncated: expected {num_images} cameras and {num_points} points, found {len(values)} numbers"
        )
    cameras = values[2 : 2 + 15 * num_images].reshape(-1, 15)
    xyz, rgb, obs_point, views = _read_points(path, values[2 + 15 * num_images :], num_points)
    wrong = (views[:, :2] % 1 != 0).any(1) | (views[:, :2] < 0).any(1) | (views[:, :2] >= [num_images, 2**31]).any(1)
    if wrong.any():
        raise InputError(
            f"{path}: expected views of {num_images} cameras, found {views[np.argmax(wrong), :2].tolist()}"
        )
    image, feature = (views[:, column].astype(np.int64) for column in (0, 1))
    sizes = _image_sizes(path, image_sizes, num_images, views)
    centers = sizes / 2 if principal_points is None else np.asarray(principal_points, np.float64).reshape(-1, 2)
    camera_list, camera_idx, poses = _read_cameras(path, cameras, sizes, centers)
    xy = views[:, 2:] * [1, -1] + centers[image]
    tracks = make_tracks(num_images, num_points, obs_point, image, feature, xy)
    inliers = np.isfinite(poses[tracks.obs_image_idx, 0])
    return Reconstruction(camera_list, _names(path, num_images), camera_idx, poses, tracks, xyz, inliers, rgb)


def _image_sizes(path: Path, given: NDArray[np.integer] | None, num_images: int, views: Array) -> Array:
    """(I, 2) width and height."""
    if given is not None:
        if np.shape(given) != (num_images, 2):
            raise InputError(f"{path}: expected the sizes of {num_images} images, found {np.shape(given)}")
        return np.asarray(given, np.float64)
    half = np.ones((num_images, 2))
    np.maximum.at(half, views[:, 0].astype(np.int64), np.abs(views[:, 2:]))
    if (half > 1e6).any():
        raise InputError(f"{path}: expected pixels within a million of the centre, found {half.max():.3g}")
    return 2 * np.ceil(half)


def _read_points(
    path: Path, values: Array, num_points: int
) -> tuple[Array, NDArray[np.uint8], NDArray[np.int64], Array]:
    """Points (T, 3), colours (T, 3), and of all views the point (O,) and camera, key, x, y (O, 4)."""
    heads = np.empty((num_points, 7))
    views = []
    pos = 0
    for t in range(num_points):
        head = values[pos : pos + 7]
        count = head[6] if len(head) == 7 else -1.0
        if count < 0 or count % 1 or 4 * count > len(values) - pos - 7:
            raise InputError(f"{path}: truncated: expected {num_points} points and their views, found {t}")
        heads[t] = head
        pos += 7
        views.append(values[pos : pos + 4 * int(count)].reshape(-1, 4))
        pos += 4 * int(count)
    if pos != len(values):
        raise InputError(f"{path}: expected the end after {num_points} points, found {len(values) - pos} more numbers")
    rgb = heads[:, 3:6]
    if ((rgb < 0) | (rgb > 255) | (rgb % 1 != 0)).any():
        raise InputError(f"{path}: expected colours from 0 to 255")
    obs_point = np.repeat(np.arange(num_points), heads[:, 6].astype(np.int64))
    return heads[:, :3].copy(), rgb.astype(np.uint8), obs_point, np.concatenate([*views, np.zeros((0, 4))])


def _read_cameras(
    path: Path, rows: Array, sizes: Array, centers: Array
) -> tuple[list[Camera], NDArray[np.int32], Array]:
    """Cameras, the camera of each image, and poses (I, 7), NaN where unregistered."""
    cameras: list[Camera] = []
    known: dict[tuple[float, ...], int] = {}
    camera_idx = np.empty(len(rows), np.int32)
    poses = np.full((len(rows), 7), np.nan)
    for i, row in enumerate(rows):
        place = f"{path}: camera {i}"
        width, height = (int(side) for side in sizes[i])
        key = (width, height, *centers[i], *row[:3])
        if row[0] < 0:
            raise InputError(f"{place}: expected a positive focal length, found {row[0]}")
        if key not in known:
            known[key] = len(cameras)
            focal = row[0] or 1.2 * max(width, height)
            params = np.array([focal, *centers[i], *row[1:3]])
            cameras.append(Camera(CameraModel.RADIAL, width, height, params, focal_source="file"))
        camera_idx[i] = known[key]
        if row[0] > 0:
            rotation = nearest_rotation(place, row[3:12].reshape(3, 3))
            poses[i] = rigid3.from_matrix(_BUNDLER_FROM_OPENCV @ rotation, _BUNDLER_FROM_OPENCV @ row[12:])
    return cameras, camera_idx, poses


def _names(path: Path, num_images: int) -> list[str]:
    """First words of the lines of the list (a focal length may follow), or numbers where there is no list."""
    file = list_path(path) if list_path(path).is_file() else path.with_name(_LIST_NAME)
    if not file.is_file():
        return [f"{i:06d}" for i in range(num_images)]
    names = [line.split()[0] for line in read_limited_text(file).splitlines() if line.strip()]
    if len(names) != num_images or len(set(names)) < num_images:
        raise InputError(f"{file}: expected {num_images} different names, found {len(set(names))} in {len(names)}")
    return names
