"""COLMAP's binary model files, little-endian, as COLMAP 4.2 and older versions write them."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.camera.models import PARAM_NAMES
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError
from sfmapp.formats.colmap_model import (
    NO_POINTS_NOTE,
    NO_RIGS_NOTE,
    ColmapModel,
    Keypoints,
    PosedImages,
    checked_camera,
    checked_poses,
)
from sfmapp.formats.colmap_rigs import Frame, Rig, add_rig, add_sensor, poses_from_frames
from sfmapp.geometry import rigid3

_POINT2D = np.dtype([("xy", "<f8", 2), ("point_id", "<i8")])
_POINT3D = np.dtype([("id", "<i8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<i8")])
_TRACK = np.dtype([("image_id", "<u4"), ("point2d_idx", "<u4")])
_CAMERA = 0  # COLMAP's sensor type


def write_binary(folder: Path, model: ColmapModel) -> None:
    """Write cameras, rigs, frames, images and points3D .bin into an existing folder."""
    (folder / "cameras.bin").write_bytes(_cameras_bytes(model))
    (folder / "rigs.bin").write_bytes(_rigs_bytes(model))
    (folder / "frames.bin").write_bytes(_frames_bytes(model))
    with (folder / "images.bin").open("wb") as file:
        file.writelines(_images_bytes(model))
    (folder / "points3D.bin").write_bytes(_points_bytes(model))


def read_binary_images(folder: Path) -> PosedImages:
    """The images of a binary model, with rigs and frames or without. Raises InputError for anything malformed."""
    ids, camera_ids, names, poses, xy, point_ids = _read_images(_Reader(folder / "images.bin"))
    rigs, frames, notes = dict[int, Rig](), list[Frame](), tuple[str, ...]()
    if (folder / "frames.bin").exists() and (folder / "rigs.bin").exists():
        rigs = _read_rigs(_Reader(folder / "rigs.bin"))
        frames = _read_frames(_Reader(folder / "frames.bin"))
        poses = poses_from_frames(folder / "frames.bin", ids, camera_ids, rigs, frames)
    elif (folder / "frames.bin").exists():
        notes = (NO_RIGS_NOTE,)
    return PosedImages(ids, camera_ids, names, poses, xy, point_ids, rigs, frames, notes)


def read_binary_cameras(folder: Path) -> tuple[NDArray[np.int64], list[Camera]]:
    """Ids and cameras."""
    return _read_cameras(_Reader(folder / "cameras.bin"))


def read_binary(folder: Path) -> ColmapModel:
    """Read a binary model, with rigs and frames or without. Raises InputError for anything malformed."""
    images = read_binary_images(folder)
    camera_ids, cameras = read_binary_cameras(folder)
    notes = images.notes
    if (folder / "points3D.bin").exists():
        points, track_ptr, track = _read_points(_Reader(folder / "points3D.bin"))
    else:
        points, track_ptr, track = np.zeros(0, _POINT3D), np.zeros(1, np.int64), np.zeros(0, _TRACK)
        notes += (NO_POINTS_NOTE,)
    return ColmapModel(
        camera_ids, cameras, images.ids, images.camera_ids, images.names, images.cam_from_world, images.points2d_xy,
        images.points2d_point_ids,
        points["id"].copy(), points["xyz"].copy(), points["rgb"].copy(), points["error"].copy(),
        track_ptr, track["image_id"].astype(np.int64), track["point2d_idx"].astype(np.int64),
        images.rigs, images.frames, notes,
    )  # fmt: skip


def _cameras_bytes(model: ColmapModel) -> bytes:
    parts = [struct.pack("<Q", len(model.cameras))]
    for camera_id, camera in zip(model.camera_ids, model.cameras, strict=True):
        parts.append(struct.pack("<IiQQ", camera_id, camera.model, camera.width, camera.height))
        parts.append(camera.params.astype("<f8").tobytes())
    return b"".join(parts)


def _rigs_bytes(model: ColmapModel) -> bytes:
    parts = [struct.pack("<Q", len(model.rigs))]
    for rig_id, rig in model.rigs.items():
        parts.append(struct.pack("<II", rig_id, len(rig.sensor_from_rig)))
        for n, (camera_id, pose) in enumerate(rig.sensor_from_rig.items()):
            # the reference, first, has no pose; all others have one
            parts.append(struct.pack("<iI", _CAMERA, camera_id))
            if n > 0:
                parts.append(struct.pack("<B7d", 1, *poses_wxyz(pose[None])[0]))
    return b"".join(parts)


def _frames_bytes(model: ColmapModel) -> bytes:
    parts = [struct.pack("<Q", len(model.frames))]
    poses = poses_wxyz(np.array([frame.rig_from_world for frame in model.frames]).reshape(-1, 7))
    for frame, pose in zip(model.frames, poses, strict=True):
        parts.append(struct.pack("<II7dI", frame.frame_id, frame.rig_id, *pose, len(frame.camera_image_ids)))
        parts.extend(struct.pack("<iIQ", _CAMERA, *ids) for ids in frame.camera_image_ids)
    return b"".join(parts)


def _images_bytes(model: ColmapModel) -> Iterator[bytes]:
    """Piece by piece: with the keypoints of thousands of images this is the one large file."""
    yield struct.pack("<Q", len(model.image_ids))
    poses = poses_wxyz(model.cam_from_world)
    for i, name in enumerate(model.image_names):
        points = np.empty(len(model.points2d_xy[i]), _POINT2D)
        points["xy"], points["point_id"] = model.points2d_xy[i], model.points2d_point_ids[i]
        yield struct.pack("<I7dI", model.image_ids[i], *poses[i], model.image_camera_ids[i])
        yield name.encode() + b"\0" + struct.pack("<Q", len(points))
        yield points.tobytes()


def _points_bytes(model: ColmapModel) -> bytes:
    """Heads of fixed size and tracks of any length alternate: a byte mask lays both out at once."""
    heads = np.empty(len(model.point_ids), _POINT3D)
    heads["id"], heads["xyz"], heads["rgb"] = model.point_ids, model.point_xyz, model.point_rgb
    heads["error"], heads["length"] = model.point_error_px, np.diff(model.track_ptr)
    track = np.empty(len(model.track_image_ids), _TRACK)
    track["image_id"], track["point2d_idx"] = model.track_image_ids, model.track_point2d_idx
    is_head = _head_mask(heads["length"])
    body = np.empty(len(is_head), np.uint8)
    body[is_head] = heads.view(np.uint8)
    body[~is_head] = track.view(np.uint8)
    return struct.pack("<Q", len(heads)) + body.tobytes()


def _head_mask(track_length: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(bytes of all points,) bool: the byte belongs to the head of a point and not to its track."""
    sizes = np.empty(2 * len(track_length), np.int64)
    sizes[0::2] = _POINT3D.itemsize
    sizes[1::2] = _TRACK.itemsize * track_length
    return np.repeat(np.tile([True, False], len(track_length)), sizes)


def poses_wxyz(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 7) poses in COLMAP's order, quaternion w x y z, from ours."""
    return np.concatenate([poses[:, 3:4], poses[:, :3], poses[:, 4:]], 1)


class _Reader:
    """A file in memory and a position in it; every step is checked against the end of the file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.pos = 0
        try:
            self.data = path.read_bytes()
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error

    def need(self, num_bytes: int, what: str) -> None:
        """Raise InputError unless that many bytes follow."""
        left = len(self.data) - self.pos
        if num_bytes > left:
            raise InputError(f"{self.path}: truncated: expected {num_bytes} bytes of {what}, found {left}")

    def unpack(self, form: str, what: str) -> tuple[Any, ...]:
        """The values of a struct format at the position."""
        size = struct.calcsize(form)
        self.need(size, what)
        values = struct.unpack_from(form, self.data, self.pos)
        self.pos += size
        return values

    def count(self, what: str, smallest_bytes: int, form: str = "<Q") -> int:
        """A count at the position; refused if so many entries of the smallest size do not fit in the file."""
        count: int
        (count,) = self.unpack(form, f"the number of {what}")
        left = len(self.data) - self.pos
        if count * smallest_bytes > left:
            raise InputError(
                f"{self.path}: expected {count} {what} of at least {smallest_bytes} bytes each, found {left} bytes"
            )
        return count

    def array(self, dtype: np.dtype[Any], count: int, what: str) -> NDArray[Any]:
        """A copy of that many entries at the position."""
        self.need(count * dtype.itemsize, what)
        values = np.frombuffer(self.data, dtype, count, self.pos).copy()
        self.pos += count * dtype.itemsize
        return values

    def text(self, what: str) -> str:
        """A string that ends with a zero byte."""
        end = self.data.find(b"\0", self.pos)
        if end < 0:
            raise InputError(f"{self.path}: truncated: expected a zero byte after {what}, found none")
        try:
            value = self.data[self.pos : end].decode()
        except UnicodeDecodeError:
            raise InputError(
                f"{self.path}: expected UTF-8 in {what}, found {self.data[self.pos : end][:40]!r}"
            ) from None
        if not value:
            raise InputError(f"{self.path}: expected {what}, found an empty string")
        self.pos = end + 1
        return value

    def finish(self) -> None:
        """Raise InputError if anything follows."""
        if self.pos != len(self.data):
            raise InputError(f"{self.path}: expected the end after {self.pos} bytes, found {len(self.data)} bytes")


def _read_cameras(reader: _Reader) -> tuple[NDArray[np.int64], list[Camera]]:
    """Ids and cameras."""
    ids, cameras = [], []
    for _ in range(reader.count("cameras", 24 + min(map(len, PARAM_NAMES.values())) * 8)):
        camera_id, model, width, height = reader.unpack("<IiQQ", "a camera")
        num_params = len(PARAM_NAMES[CameraModel(model)]) if model in CameraModel._value2member_map_ else 0
        params = reader.array(np.dtype("<f8"), num_params, f"the parameters of camera {camera_id}")
        ids.append(camera_id)
        cameras.append(checked_camera(reader.path, camera_id, model, width, height, params))
    reader.finish()
    return np.array(ids, np.int64), cameras


def _read_images(
    reader: _Reader,
) -> tuple[NDArray[np.int64], NDArray[np.int64], list[str], NDArray[np.float64], Keypoints, list[NDArray[np.int64]]]:
    """Image ids, camera ids, names, poses (I, 7), keypoints and their point ids."""
    heads, names, xy, point_ids = [], [], [], []
    for _ in range(reader.count("images", 64 + 2 + 8)):
        heads.append(reader.unpack("<I7dI", "an image"))
        names.append(reader.text(f"the name of image {heads[-1][0]}"))
        count = reader.count(f"keypoints of image {names[-1]!r}", _POINT2D.itemsize)
        points = reader.array(_POINT2D, count, f"the keypoints of {names[-1]!r}")
        if not np.isfinite(points["xy"]).all():
            raise InputError(f"{reader.path}: image {names[-1]!r}: expected finite keypoints, found NaN or infinity")
        if (points["point_id"] < -1).any():
            raise InputError(f"{reader.path}: image {names[-1]!r}: a keypoint names a point with an impossible id")
        xy.append(points["xy"].copy())
        point_ids.append(points["point_id"].copy())
    reader.finish()
    table = np.array(heads, np.float64).reshape(-1, 9)
    ids, camera_ids = table[:, 0].astype(np.int64), table[:, 8].astype(np.int64)
    return ids, camera_ids, names, checked_poses(reader.path, "image", ids, table[:, 1:8]), xy, point_ids


def _read_points(reader: _Reader) -> tuple[NDArray[Any], NDArray[np.int64], NDArray[Any]]:
    """Heads (P,) of _POINT3D, track_ptr (P + 1,), elements (O,) of _TRACK."""
    count = reader.count("points", _POINT3D.itemsize)
    start, data, end = reader.pos, reader.data, len(reader.data)
    pos = start
    lengths = np.empty(count, np.int64)
    unpack, head, element = struct.Struct("<Q").unpack_from, _POINT3D.itemsize, _TRACK.itemsize
    for i in range(count):
        if pos + head > end:
            raise InputError(f"{reader.path}: truncated: expected {count} points, found {i}")
        (length,) = unpack(data, pos + head - 8)
        pos += head + element * length
        if pos > end:
            raise InputError(f"{reader.path}: expected {length} observations of the point in place {i}, found fewer")
        lengths[i] = length
    reader.pos = pos
    reader.finish()
    body = np.frombuffer(data, np.uint8, pos - start, start)
    is_head = _head_mask(lengths)
    heads, track = body[is_head].view(_POINT3D), body[~is_head].view(_TRACK)
    if (heads["id"] < 0).any():
        raise InputError(f"{reader.path}: a point has an impossible id")
    if not np.isfinite(heads["xyz"]).all():
        first = heads["id"][np.argmax(~np.isfinite(heads["xyz"]).all(1))]
        raise InputError(f"{reader.path}: point {first}: expected finite coordinates, found NaN or infinity")
    return heads, np.concatenate([[0], np.cumsum(lengths)]), track


def _read_rigs(reader: _Reader) -> dict[int, Rig]:
    rigs: dict[int, Rig] = {}
    for _ in range(reader.count("rigs", 8)):
        rig_id, num_sensors = reader.unpack("<II", "a rig")
        sensors: dict[int, NDArray[np.float64]] = {}
        for i in range(num_sensors):
            sensor_type, sensor_id = reader.unpack("<iI", f"a sensor of rig {rig_id}")
            has_pose = i > 0 and reader.unpack("<B", f"a sensor of rig {rig_id}")[0]
            if i > 0 and not has_pose:
                continue
            pose = rigid3.IDENTITY
            if has_pose:
                values = np.array([reader.unpack("<7d", f"the pose of sensor {sensor_id}")])
                pose = checked_poses(reader.path, "sensor", np.array([sensor_id]), values)[0]
            if sensor_type == _CAMERA:
                add_sensor(reader.path, sensors, sensor_id, pose)
        add_rig(reader.path, rigs, rig_id, sensors)
    reader.finish()
    return rigs


def _read_frames(reader: _Reader) -> list[Frame]:
    frames = []
    for _ in range(reader.count("frames", 68)):
        frame_id, rig_id, *values = reader.unpack("<II7d", "a frame")
        pose = checked_poses(reader.path, "frame", np.array([frame_id]), np.array([values]))[0]
        data = [
            reader.unpack("<iIQ", f"the data of frame {frame_id}")
            for _ in range(reader.count(f"data of frame {frame_id}", 16, "<I"))
        ]
        images = [(sensor, image) for kind, sensor, image in data if kind == _CAMERA]
        frames.append(Frame(frame_id, rig_id, pose, images))
    reader.finish()
    return frames
