"""COLMAP's rigs and frames, to and from the images of our reconstruction that share a rig's pose.

In COLMAP every camera belongs to one rig, alone or with others, and every image to one frame, which has the pose:
``cam_from_world = sensor_from_rig o rig_from_world``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.rig import RigImages


@dataclass(frozen=True)
class Rig:
    """Cameras mounted together: pose sensor_from_rig (7,) by camera id; the reference, first, has the identity."""

    sensor_from_rig: dict[int, NDArray[np.float64]]


@dataclass(frozen=True)
class Frame:
    """One shot of a rig: where the rig was, and camera id and image id of each photograph."""

    frame_id: int
    rig_id: int
    rig_from_world: NDArray[np.float64]
    camera_image_ids: list[tuple[int, int]]


@dataclass(frozen=True)
class Mounted:
    """How the registered images (R,) of a reconstruction stand in COLMAP's terms.

    Attributes:
        camera_ids: (C,) int64 ascending, with camera_idx (C,), position of each in the reconstruction: once plus one,
            and for what more the camera is than one sensor, a new id.
        image_camera_ids: (R,) int64.
        rigs: by id, which is that of the reference camera. frames: their ids are those of their first images.
    """

    camera_ids: NDArray[np.int64]
    camera_idx: NDArray[np.int64]
    image_camera_ids: NDArray[np.int64]
    rigs: dict[int, Rig]
    frames: list[Frame]


def mount_images(reconstruction: Reconstruction, registered: NDArray[np.int64]) -> Mounted:
    """Cameras, rigs and frames of the registered images; ids of images are positions plus one.

    Sensors that take pictures together make one rig, whose reference is the lowest of them.

    Raises:
        ValueError: one frame holds two images of one sensor and camera.
    """
    rig, camera_idx = reconstruction.rig, reconstruction.image_camera_idx[registered].astype(np.int64)
    frame, sensor = -1 - np.arange(len(registered)), np.full(len(registered), -1)
    if rig is not None:
        on_rig = rig.frame_idx[registered] >= 0
        frame[on_rig], sensor[on_rig] = rig.frame_idx[registered[on_rig]], rig.sensor_idx[registered[on_rig]]
    # what COLMAP calls a camera: one of ours, as one sensor
    kinds, kind = np.unique(np.stack([camera_idx, sensor], 1), axis=0, return_inverse=True)
    kind = kind.reshape(-1)
    again = np.append(False, kinds[1:, 0] == kinds[:-1, 0])[: len(kinds)]
    ids = kinds[:, 0] + 1
    ids[again] = len(reconstruction.cameras) + 1 + np.arange(int(again.sum()))
    groups: dict[int, list[int]] = {}
    for i, number in enumerate(frame.tolist()):
        groups.setdefault(number, []).append(i)
    reference = _references(kinds, [kind[members] for members in groups.values()])
    mounts: list[NDArray[np.float64]] = []
    for k, (_, at) in enumerate(kinds):
        origin = kinds[reference[k], 1]
        mounts.append(rigid3.IDENTITY if at == origin or rig is None else _between(rig.cam_from_rig, at, origin))
    rigs: dict[int, Rig] = {}
    for k in sorted(range(len(kinds)), key=lambda k: (ids[reference[k]], k != reference[k], ids[k])):
        rigs.setdefault(int(ids[reference[k]]), Rig({})).sensor_from_rig[int(ids[k])] = mounts[k]
    frames = []
    for members in groups.values():
        if len(np.unique(kind[members])) < len(members):
            names = [reconstruction.image_names[registered[i]] for i in members]
            raise ValueError(f"one frame holds two images of one sensor: {', '.join(names)}")
        origin = reference[kind[members[0]]]
        first = next((i for i in members if kind[i] == origin), members[0])
        pose = reconstruction.cam_from_world[registered[first]]
        if kind[first] != origin:
            pose = rigid3.compose(rigid3.inverse(mounts[kind[first]]), pose)
        data = sorted((int(ids[kind[i]]), int(registered[i]) + 1) for i in members)
        frames.append(Frame(int(registered[members[0]]) + 1, int(ids[origin]), pose, data))
    order = np.argsort(ids)
    return Mounted(ids[order], kinds[order, 0], ids[kind], rigs, frames)


def _between(cam_from_rig: NDArray[np.float64], sensor: int, origin: int) -> NDArray[np.float64]:
    """Pose of a sensor from another one; the bits of the table where that is the rig's own frame."""
    if np.array_equal(cam_from_rig[origin], rigid3.IDENTITY):
        as_given: NDArray[np.float64] = cam_from_rig[sensor]
        return as_given
    return rigid3.compose(cam_from_rig[sensor], rigid3.inverse(cam_from_rig[origin]))


def _references(kinds: NDArray[np.int64], frames: list[NDArray[np.int64]]) -> list[int]:
    """For each kind of camera (K, 2) the one of lowest sensor among those that frames connect it with."""
    rank = np.lexsort((kinds[:, 0], kinds[:, 1]))
    place = np.argsort(rank)
    parent = list(range(len(kinds)))

    def root(k: int) -> int:
        while parent[k] != k:
            parent[k] = parent[parent[k]]
            k = parent[k]
        return k

    for members in frames:
        for k in members[1:].tolist():
            a, b = sorted((root(int(members[0])), root(k)), key=lambda r: int(place[r]))
            parent[b] = a
    return [root(k) for k in range(len(kinds))]


def add_sensor(path: Path, sensors: dict[int, NDArray[np.float64]], camera_id: int, pose: NDArray[np.float64]) -> None:
    """Put a camera into a rig. Raises InputError if it is there already."""
    if camera_id in sensors:
        raise InputError(f"{path}: expected every camera once in a rig, found camera {camera_id} twice")
    sensors[camera_id] = pose


def add_rig(path: Path, rigs: dict[int, Rig], rig_id: int, sensors: dict[int, NDArray[np.float64]]) -> None:
    """Put a rig among the others. Raises InputError if its id is there already."""
    if rig_id in rigs:
        raise InputError(f"{path}: expected every rig id once, found rig {rig_id} twice")
    rigs[rig_id] = Rig(sensors)


def poses_from_frames(
    path: Path,
    image_ids: NDArray[np.int64],
    image_camera_ids: NDArray[np.int64],
    rigs: dict[int, Rig],
    frames: list[Frame],
) -> NDArray[np.float64]:
    """(I, 7) cam_from_world of images from the frames they belong to: where a model has frames, these are its poses.

    Frames may name images that the model no longer holds.
    """
    poses: dict[int, NDArray[np.float64]] = {}
    camera_of = dict(zip(image_ids.tolist(), image_camera_ids.tolist(), strict=True))
    if len({frame.frame_id for frame in frames}) < len(frames):
        raise InputError(f"{path}: expected every frame id once, found one twice")
    for frame in frames:
        if frame.rig_id not in rigs:
            raise InputError(f"{path}: a frame names rig {frame.rig_id}, which the rigs file does not hold")
        sensors = rigs[frame.rig_id].sensor_from_rig
        for camera_id, image_id in frame.camera_image_ids:
            if camera_id not in sensors:
                raise InputError(f"{path}: image {image_id}: camera {camera_id} is not part of rig {frame.rig_id}")
            if camera_of.get(image_id, camera_id) != camera_id:
                raise InputError(
                    f"{path}: frame {frame.frame_id} has image {image_id} of camera {camera_id}, but the images file "
                    f"has it of camera {camera_of[image_id]}"
                )
            if image_id in poses:
                raise InputError(f"{path}: expected every image in one frame, found image {image_id} in two")
            sensor_from_rig = sensors[camera_id]
            is_reference = np.array_equal(sensor_from_rig, rigid3.IDENTITY)
            pose = frame.rig_from_world
            poses[image_id] = pose if is_reference else rigid3.compose(sensor_from_rig, pose)
    missing = [int(image_id) for image_id in image_ids if int(image_id) not in poses]
    if missing:
        raise InputError(f"{path}: expected a frame for every image, found none for image {missing[0]}")
    return np.array([poses[int(image_id)] for image_id in image_ids]).reshape(-1, 7)


def rig_images(image_ids: NDArray[np.int64], rigs: dict[int, Rig], frames: list[Frame]) -> RigImages | None:
    """Which of the images (I,), by ascending ids, rigs of several cameras took; None if none of them.

    Frames are numbered by their first image. Sensor 0 is whatever sits at a rig's origin; the others are the different
    places on rigs, by id of rig and camera.
    """
    table, number = [rigid3.IDENTITY], {_bits(rigid3.IDENTITY): 0}
    for rig_id in sorted(rigs):
        for _, place in sorted(rigs[rig_id].sensor_from_rig.items()):
            if number.setdefault(_bits(place), len(table)) == len(table):
                table.append(place)
    position = {int(image_id): i for i, image_id in enumerate(image_ids)}
    shots = []
    for frame in frames:
        sensors = rigs[frame.rig_id].sensor_from_rig
        known = [(position[i], number[_bits(sensors[c])]) for c, i in frame.camera_image_ids if i in position]
        if len(sensors) > 1 and known:
            shots.append(sorted(known))
    if not shots:
        return None
    frame_idx, sensor_idx = np.full(len(image_ids), -1, np.int32), np.zeros(len(image_ids), np.int32)
    for n, shot in enumerate(sorted(shots)):
        for image, sensor in shot:
            frame_idx[image], sensor_idx[image] = n, sensor
    return RigImages(frame_idx, sensor_idx, np.array(table))


def _bits(pose: NDArray[np.float64]) -> bytes:
    """A key of a pose (7,); zeros have no sign."""
    return (pose + 0.0).tobytes()
