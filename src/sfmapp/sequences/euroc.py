"""The layout of EuRoC MAV (Burri et al., IJRR 2016): ``mav0`` with cameras, IMU and ground truth, times in nanoseconds.

``T_BS`` of a sensor takes points of its own frame to that of the body.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera_files.fields import read_pose
from sfmapp.camera_files.reading import Calibration, read_calibration
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.formats.clocks import Times, parse_time, read_column
from sfmapp.formats.flat_yaml import read_flat_yaml
from sfmapp.formats.trajectory_input import TrajectoryFile, read_trajectory
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import STAGE, GroundTruth, Imu
from sfmapp.scene.rig import Rig
from sfmapp.sequences.files import (
    Recording,
    Size,
    common_size,
    confined,
    frame_names,
    in_order,
    list_images,
    read_number_table,
    read_rows,
    warn_of_missing,
)

Array = NDArray[np.float64]

# Poses of the body, best first. What a laser tracker alone saw (leica0) is positions without rotations.
_GROUND_TRUTH_FOLDERS = ("state_groundtruth_estimate0", "mocap0", "vicon0")
USUAL_NOISE = {
    "gyroscope_noise_density": 1.7e-4,
    "accelerometer_noise_density": 2.0e-3,
    "gyroscope_random_walk": 1.9e-5,
    "accelerometer_random_walk": 3.0e-3,
}
"""Noise of a common MEMS IMU (EuRoC's ADIS16448), for recordings that do not state it: rad/s/sqrt(Hz), m/s^2/sqrt(Hz),
rad/s^2/sqrt(Hz), m/s^3/sqrt(Hz); in the order of :class:`~sfmapp.images.sequence.Imu`."""


def find_mav(folder: Path) -> Path | None:
    """The folder that holds ``cam0``: this one or ``mav0`` in it; None if it is not laid out so."""
    for candidate in (folder / "mav0", folder):
        if (candidate / "cam0" / "data").is_dir() or (candidate / "cam0" / "data.csv").is_file():
            return candidate
    return None


def read_euroc_sequence(mav: Path, events: Events, only: str | None = None) -> Recording:
    """A ``mav0`` folder: ``cam0`` and, where it is there, ``cam1``, paired by time; IMU and ground truth.

    Args:
        only: the one camera to use, such as ``cam1``; None: both.

    Raises:
        InputError: no image can be read, or a file is not what it should be.
    """
    cameras = [only] if only else [name for name in ("cam0", "cam1") if (mav / name).is_dir()]
    tables = [_read_frames(mav / name, events) for name in cameras]
    if len(tables) == 2 and not tables[0].keys() & tables[1].keys():
        events.warned(STAGE, f"{mav / 'cam1'} is not used: none of its timestamps is one of cam0")
        cameras, tables = cameras[:1], tables[:1]
    stamps = list(tables[0])
    if len(tables) == 2:
        lonely = [tables[0][stamp].name for stamp in tables[0] if stamp not in tables[1]]
        warn_of_missing(events, "frames of cam0 have no partner of the same time in cam1", lonely)
    # V2_03_difficult lacks a tenth of cam1: such a frame is played with cam0 alone
    frames = [tuple(table[stamp] for table in tables if stamp in table) for stamp in stamps]
    first = [frame[0] for frame in frames]
    sizes = tuple(
        common_size([frame[i] for frame in frames if i < len(frame)], str(mav / name / "data"))
        for i, name in enumerate(cameras)
    )
    times = read_column(str(mav / cameras[0]), [parse_time(stamp) for stamp in stamps], "ns")
    calibration = _read_rig(mav, cameras, sizes)
    body_from_cam = calibration.body_from_cam if calibration else None
    imu, ground_truth, notes = None, None, list[str]()
    if (mav / "imu0" / "data.csv").is_file():
        if body_from_cam is None:
            events.warned(STAGE, f"{mav / 'imu0'} is not used: no calibration gives its pose (T_BS)")
        else:
            imu, note = read_imu(mav / "imu0" / "data.csv", body_from_cam, times)
            notes.append(note)
    for name in _GROUND_TRUTH_FOLDERS:
        if (mav / name / "data.csv").is_file():
            file = read_trajectory(mav / name / "data.csv", like=times.seconds, is_euroc=True)
            ground_truth = euroc_ground_truth(file, body_from_cam)
            notes.append(file.note)
            break
    names = frame_names(mav, first)
    told = tuple(note for note in notes if note)
    return Recording("euroc", mav, names, times, frames, sizes, calibration, imu, ground_truth, notes=told)


def _read_frames(camera: Path, events: Events) -> dict[str, Path]:
    """Files by their times as written, in the order of the list."""
    if not (camera / "data.csv").is_file():
        paths = list_images(camera / "data")
        if not all(re.fullmatch(r"\d{1,20}(\.\d+)?", path.stem) for path in paths):
            raise InputError(
                f"{camera / 'data.csv'}: expected a list of times and files, or images whose names are times, found "
                "neither"
            )
        return {path.stem: path for path in paths}
    found: dict[str, Path] = {}
    missing: list[str] = []
    for position, (number, fields) in enumerate(read_rows(camera / "data.csv", ",")):
        place = f"{camera / 'data.csv'}:{number}"
        try:
            parse_time(fields[0])
        except ValueError:
            if position == 0:  # names of the columns
                continue
            raise InputError(f"{place}: expected a time and a file name, found {','.join(fields)[:80]!r}") from None
        name = fields[1] if len(fields) > 1 and fields[1] else f"{fields[0]}.png"
        path = confined(camera / "data", name, place)
        if path.is_file():
            found.setdefault(fields[0], path)
        else:
            missing.append(name)
    warn_of_missing(events, f"files that {camera.name}/data.csv names are not there", missing)
    return found


def _read_rig(mav: Path, cameras: list[str], sizes: tuple[Size, ...]) -> Calibration | None:
    """What the ``sensor.yaml`` of the cameras say together; one camera where the other's pose is not known."""
    files = [mav / name / "sensor.yaml" for name in cameras]
    if not files[0].is_file():
        return None
    parts = [read_calibration(path, [size]) for path, size in zip(files, sizes, strict=True) if path.is_file()]
    notes = tuple(note for part in parts for note in part.notes)
    first, body = parts[0].rig, parts[0].body_from_cam
    if len(parts) < 2 or body is None or parts[1].body_from_cam is None:
        return replace(parts[0], notes=notes)
    second = rigid3.compose(rigid3.inverse(parts[1].body_from_cam), body)
    rig = Rig((first.cameras[0], parts[1].rig.cameras[0]), np.array([rigid3.IDENTITY, second]))
    return replace(parts[0], rig=rig, lenses=(parts[0].lenses[0], parts[1].lenses[0]), notes=notes)


def read_imu(path: Path, body_from_cam: Array, frames: Times | None = None) -> tuple[Imu, str]:
    """Measurements of ``data.csv`` (time in ns, gyro in rad/s, accelerometer in m/s^2), noise of ``sensor.yaml`` by it;
    and a note if its times are in another unit.

    Args:
        body_from_cam: (7,) pose of the first camera in the frame of the body, which ``T_BS`` of the IMU relates to.
        frames: times of the frames on the same clock; None if they are not known.

    Raises:
        InputError: a file cannot be read or is not what it should be.
    """
    stamps, table = read_number_table(path, 7)
    like, origin = (None, None) if frames is None else (frames.seconds, frames.origin)
    times = read_column(str(path), stamps, "ns", like, origin)
    table[:, 0] = times.seconds
    fields: dict[str, Any] = {}
    if (path.parent / "sensor.yaml").is_file():
        fields = read_flat_yaml(path.parent / "sensor.yaml")
    body_from_imu = read_pose(f"{path.parent / 'sensor.yaml'}: T_BS", fields["T_BS"]) if "T_BS" in fields else None
    imu_from_cam = (
        body_from_cam if body_from_imu is None else rigid3.compose(rigid3.inverse(body_from_imu), body_from_cam)
    )
    noise = {}
    for name, usual in USUAL_NOISE.items():
        value = fields.get(name, usual)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1e3:
            raise InputError(f"{path.parent / 'sensor.yaml'}: {name}: expected a number of 0 or more, found {value!r}")
        noise[name] = float(value)
    _, kept = np.unique(table[:, 0], return_index=True)
    table = table[kept]
    if len(table) < 2:
        raise InputError(f"{path}: expected measurements at two times at least, found {len(table)}")
    imu = Imu(
        table[:, 0],
        table[:, 1:4].copy(),
        table[:, 4:7].copy(),
        imu_from_cam,
        noise["gyroscope_noise_density"],
        noise["accelerometer_noise_density"],
        noise["gyroscope_random_walk"],
        noise["accelerometer_random_walk"],
        None if origin is None or times.elapsed_s is None else times.elapsed_s[kept],
    )
    return imu, times.note


def euroc_ground_truth(file: TrajectoryFile, body_from_cam: Array | None) -> GroundTruth:
    """Poses of the body of a trajectory as poses of the camera.

    Args:
        body_from_cam: (7,); None: the poses are taken for the camera's own. ``sensor.yaml`` beside the file may say
            with ``T_BS`` that the poses are of something else on the body (a marker).

    Raises:
        InputError: that file is not what it should be.
    """
    world_from_cam, has_pose = file.trajectory.world_from_body, file.trajectory.has_pose
    times = file.trajectory.timestamps_s
    assert times is not None
    sensor = file.path.parent / "sensor.yaml"
    fields = read_flat_yaml(sensor) if sensor.is_file() else {}
    if "T_BS" in fields:
        world_from_cam = rigid3.compose(world_from_cam, rigid3.inverse(read_pose(f"{sensor}: T_BS", fields["T_BS"])))
    if body_from_cam is not None:
        world_from_cam = rigid3.compose(world_from_cam, body_from_cam)
    return in_order(GroundTruth(times[has_pose], rigid3.inverse(world_from_cam[has_pose])))
