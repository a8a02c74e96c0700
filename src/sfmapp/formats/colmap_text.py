"""COLMAP's text model files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.errors import InputError
from sfmapp.formats.colmap_binary import poses_wxyz
from sfmapp.formats.colmap_model import (
    NO_POINTS_NOTE,
    NO_RIGS_NOTE,
    ColmapModel,
    Keypoints,
    PosedImages,
    checked_camera,
    checked_names,
    checked_poses,
)
from sfmapp.formats.colmap_rigs import Frame, Rig, add_rig, add_sensor, poses_from_frames
from sfmapp.formats.text_input import plain_numbers, read_limited_text
from sfmapp.geometry import rigid3

_LARGEST_ID = 2**53  # ids pass through float64, which is exact up to here


def write_text(folder: Path, model: ColmapModel) -> None:
    """Write cameras, rigs, frames, images and points3D .txt into an existing folder; numbers round-trip exactly.

    Raises:
        UsageError: an image name holds white space.
    """
    checked_names(model.image_names)
    cameras = [
        f"{camera_id} {camera.model.name} {camera.width} {camera.height} {_numbers(camera.params)}"
        for camera_id, camera in zip(model.camera_ids, model.cameras, strict=True)
    ]
    rigs = []
    for rig_id, rig in model.rigs.items():
        reference, *others = rig.sensor_from_rig
        sensors = [f"{rig_id} {len(rig.sensor_from_rig)} CAMERA {reference}"]
        sensors += [f"CAMERA {i} 1 {_numbers(poses_wxyz(rig.sensor_from_rig[i][None])[0])}" for i in others]
        rigs.append(" ".join(sensors))
    frames = []
    for frame in model.frames:
        data = " ".join(f"CAMERA {camera_id} {image_id}" for camera_id, image_id in frame.camera_image_ids)
        pose = _numbers(poses_wxyz(frame.rig_from_world[None])[0])
        frames.append(f"{frame.frame_id} {frame.rig_id} {pose} {len(frame.camera_image_ids)} {data}")
    images = []
    for i, pose in enumerate(poses_wxyz(model.cam_from_world)):
        image_id, camera_id = model.image_ids[i], model.image_camera_ids[i]
        images.append(f"{image_id} {_numbers(pose)} {camera_id} {model.image_names[i]}")
        pairs = zip(model.points2d_xy[i].tolist(), model.points2d_point_ids[i].tolist(), strict=True)
        images.append(" ".join(f"{x!r} {y!r} {point_id}" for (x, y), point_id in pairs))
    track = np.stack([model.track_image_ids, model.track_point2d_idx], 1)
    points = []
    for i, (r, g, b) in enumerate(model.point_rgb.tolist()):
        elements = track[model.track_ptr[i] : model.track_ptr[i + 1]].ravel().tolist()
        line = f"{model.point_ids[i]} {_numbers(model.point_xyz[i])} {r} {g} {b} {float(model.point_error_px[i])!r}"
        points.append(" ".join([line, *map(str, elements)]))
    heads = {
        "cameras": "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
        "rigs": "RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[]",
        "frames": "FRAME_ID, RIG_ID, RIG_FROM_WORLD[QW, QX, QY, QZ, TX, TY, TZ], NUM_DATA_IDS, DATA_IDS[]",
        "images": "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then X, Y, POINT3D_ID of its keypoints",
        "points3D": "POINT3D_ID, X, Y, Z, R, G, B, ERROR, then IMAGE_ID, POINT2D_IDX of its track",
    }
    bodies = {"cameras": cameras, "rigs": rigs, "frames": frames, "images": images, "points3D": points}
    for name, lines in bodies.items():
        (folder / f"{name}.txt").write_text("\n".join([f"# {heads[name]}", *lines, ""]), encoding="utf-8")


def _numbers(values: NDArray[np.float64]) -> str:
    return " ".join(map(repr, values.tolist()))


def read_text_images(folder: Path) -> PosedImages:
    """The images of a text model, with rigs and frames or without. Raises InputError for anything malformed."""
    ids, camera_ids, names, poses, xy, point_ids = _read_images(folder / "images.txt")
    rigs, frames, notes = dict[int, Rig](), list[Frame](), tuple[str, ...]()
    if (folder / "frames.txt").exists() and (folder / "rigs.txt").exists():
        rigs = _read_rigs(folder / "rigs.txt")
        frames = _read_frames(folder / "frames.txt")
        poses = poses_from_frames(folder / "frames.txt", ids, camera_ids, rigs, frames)
    elif (folder / "frames.txt").exists():
        notes = (NO_RIGS_NOTE,)
    return PosedImages(ids, camera_ids, names, poses, xy, point_ids, rigs, frames, notes)


def read_text_cameras(folder: Path) -> tuple[NDArray[np.int64], list[Camera]]:
    """Ids and cameras."""
    return _read_cameras(folder / "cameras.txt")


def read_text(folder: Path) -> ColmapModel:
    """Read a text model, with rigs and frames or without. Raises InputError for anything malformed."""
    images = read_text_images(folder)
    camera_ids, cameras = read_text_cameras(folder)
    notes = images.notes
    table, tracks = np.zeros((0, 8)), list[NDArray[np.int64]]()
    if (folder / "points3D.txt").exists():
        table, tracks = _read_points(folder / "points3D.txt")
    else:
        notes += (NO_POINTS_NOTE,)
    lengths = np.array([len(track) for track in tracks], np.int64)
    flat = np.concatenate([*tracks, np.zeros((0, 2), np.int64)])
    return ColmapModel(
        camera_ids, cameras, images.ids, images.camera_ids, images.names, images.cam_from_world, images.points2d_xy,
        images.points2d_point_ids,
        table[:, 0].astype(np.int64), table[:, 1:4].copy(), table[:, 4:7].astype(np.uint8), table[:, 7].copy(),
        np.concatenate([[0], np.cumsum(lengths)]), flat[:, 0].copy(), flat[:, 1].copy(),
        images.rigs, images.frames, notes,
    )  # fmt: skip


def _lines(path: Path) -> list[str]:
    # not splitlines(), which also ends a line at characters that a name may hold
    return read_limited_text(path).split("\n")


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith("#")


def _records(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Place (for messages) and fields of every line that is neither empty nor a comment."""
    for number, line in enumerate(_lines(path), 1):
        if line.strip() and not _is_comment(line):
            yield f"{path}:{number}", line.split()


def _floats(place: str, fields: list[str], what: str) -> NDArray[np.float64]:
    """(N,) finite numbers."""
    try:
        values = np.array(plain_numbers(fields), np.float64)
    except ValueError:
        raise InputError(f"{place}: expected numbers for {what}, found {' '.join(fields)[:80]!r}") from None
    if not np.isfinite(values).all():
        raise InputError(f"{place}: expected finite numbers for {what}, found NaN or infinity")
    return values


def _ints(place: str, fields: list[str], what: str, low: int = 0, high: int = _LARGEST_ID) -> list[int]:
    """Whole numbers from low to high."""
    try:
        values = [int(field) for field in fields]
        if any("_" in field for field in fields):  # 1_000 is a number to Python alone
            raise ValueError
    except ValueError:
        raise InputError(f"{place}: expected whole numbers for {what}, found {' '.join(fields)[:80]!r}") from None
    if any(not low <= value <= high for value in values):
        raise InputError(f"{place}: expected {what} from {low} to {high}, found {' '.join(fields)[:80]!r}")
    return values


def _need(place: str, fields: list[str], count: int, what: str) -> None:
    if len(fields) < count:
        raise InputError(f"{place}: expected at least {count} fields of {what}, found {len(fields)}")


def _no_more(place: str, fields: list[str], what: str) -> None:
    if fields:
        raise InputError(f"{place}: expected the end of the line after {what}, found {' '.join(fields)[:80]!r}")


def _read_cameras(path: Path) -> tuple[NDArray[np.int64], list[Camera]]:
    """Ids and cameras."""
    ids, cameras = [], []
    for place, fields in _records(path):
        _need(place, fields, 5, "a camera")
        camera_id, width, height = _ints(place, [fields[0], *fields[2:4]], "a camera")
        params = _floats(place, fields[4:], "the parameters of a camera")
        ids.append(camera_id)
        cameras.append(checked_camera(path, camera_id, fields[1], width, height, params))
    return np.array(ids, np.int64), cameras


def _read_images(
    path: Path,
) -> tuple[NDArray[np.int64], NDArray[np.int64], list[str], NDArray[np.float64], Keypoints, list[NDArray[np.int64]]]:
    """Image ids, camera ids, names, poses (I, 7), keypoints and their point ids."""
    ids: list[int] = []
    camera_ids: list[int] = []
    names: list[str] = []
    poses, xy, point_ids = [], [], []
    lines = enumerate(_lines(path), 1)
    for number, line in lines:
        if not line.strip() or _is_comment(line):
            continue
        place = f"{path}:{number}"
        fields = line.split(maxsplit=9)
        _need(place, fields, 10, "an image")
        image_id, camera_id = _ints(place, [fields[0], fields[8]], "ids of an image")
        ids.append(image_id)
        camera_ids.append(camera_id)
        names.append(fields[9].rstrip())
        poses.append(_floats(place, fields[1:8], "a pose"))
        # the line that follows belongs to the image even if it is empty
        number, line = next(((n, text) for n, text in lines if not _is_comment(text)), (number, ""))
        keypoints = line.split()
        if len(keypoints) % 3:
            raise InputError(
                f"{path}:{number}: expected three fields per keypoint of image {names[-1]!r}, found "
                f"{len(keypoints)} in all",
                "every image takes two lines, of which the second may be empty",
            )
        table = _floats(f"{path}:{number}", keypoints, f"the keypoints of image {names[-1]!r}")
        table = table.reshape(-1, 3)
        if ((table[:, 2] < -1) | (table[:, 2] > _LARGEST_ID) | (table[:, 2] % 1 != 0)).any():
            raise InputError(f"{path}:{number}: expected -1 or the id of a point in every third field")
        xy.append(table[:, :2].copy())
        point_ids.append(table[:, 2].astype(np.int64))
    id_array = np.array(ids, np.int64)
    checked = checked_poses(path, "image", id_array, np.array(poses).reshape(-1, 7))
    return id_array, np.array(camera_ids, np.int64), names, checked, xy, point_ids


def _read_points(path: Path) -> tuple[NDArray[np.float64], list[NDArray[np.int64]]]:
    """Table (P, 8) of id, xyz, rgb, error, and P tracks (K, 2)."""
    heads, tracks = [], []
    for place, fields in _records(path):
        _need(place, fields, 8, "a point")
        _ints(place, fields[:1], "the id of a point")
        heads.append(_floats(place, fields[:7], "a point"))
        color = heads[-1][4:]
        if ((color < 0) | (color > 255) | (color % 1 != 0)).any():  # COLMAP takes 127.0 as well
            raise InputError(f"{place}: expected a colour of whole numbers from 0 to 255, found {color.tolist()}")
        track = _ints(place, fields[8:], "a track", 0, 2**32 - 1)
        if len(track) % 2:
            raise InputError(f"{place}: expected two fields per observation, found {len(track)} in all")
        tracks.append(np.array(track, np.int64).reshape(-1, 2))
        heads[-1] = np.append(heads[-1], _error_px(place, fields[7]))
    return np.array(heads).reshape(-1, 8), tracks


def _error_px(place: str, field: str) -> float:
    try:
        return float(field)
    except ValueError:
        raise InputError(f"{place}: expected a number for the error of a point, found {field[:40]!r}") from None


def _read_rigs(path: Path) -> dict[int, Rig]:
    rigs: dict[int, Rig] = {}
    for place, fields in _records(path):
        _need(place, fields, 2, "a rig")
        rig_id, num_sensors = _ints(place, fields[:2], "a rig")
        sensors: dict[int, NDArray[np.float64]] = {}
        rest = fields[2:]
        for i in range(num_sensors):
            _need(place, rest, 2 if i == 0 else 3, "a sensor")
            kind, (sensor_id,), pose = rest[0], _ints(place, rest[1:2], "a sensor"), rigid3.IDENTITY
            has_pose = i > 0 and bool(_ints(place, rest[2:3], "whether a sensor has a pose", 0, 1)[0])
            rest = rest[2:] if i == 0 else rest[3:]
            if has_pose:
                _need(place, rest, 7, "the pose of a sensor")
                values = _floats(place, rest[:7], "the pose of a sensor")[None]
                pose = checked_poses(path, "sensor", np.array([sensor_id]), values)[0]
                rest = rest[7:]
            if kind == "CAMERA" and (i == 0 or has_pose):
                add_sensor(path, sensors, sensor_id, pose)
        _no_more(place, rest, f"rig {rig_id} of {num_sensors} sensors")
        add_rig(path, rigs, rig_id, sensors)
    return rigs


def _read_frames(path: Path) -> list[Frame]:
    frames = []
    for place, fields in _records(path):
        _need(place, fields, 10, "a frame")
        frame_id, rig_id, num_data = _ints(place, [*fields[:2], fields[9]], "a frame")
        _need(place, fields[10:], 3 * num_data, "the data of a frame")
        values = _floats(place, fields[2:9], "a pose")[None]
        pose = checked_poses(path, "frame", np.array([frame_id]), values)[0]
        _no_more(place, fields[10 + 3 * num_data :], f"frame {frame_id} of {num_data} data")
        images = []
        for kind, *ids in zip(fields[10::3], fields[11::3], fields[12::3], strict=False):
            sensor_id, data_id = _ints(place, ids, "the data of a frame")
            if kind == "CAMERA":
                images.append((sensor_id, data_id))
        frames.append(Frame(frame_id, rig_id, pose, images))
    return frames
