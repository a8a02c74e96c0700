"""Calibrations of one camera or of a pair, in the forms that people have them.

Where one comes from, and how its camera is told from its fields, is in :mod:`sfmapp.camera_files.files` and
:mod:`sfmapp.camera_files.fields`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.camera.models import PARAM_NAMES
from sfmapp.camera_files.fields import (
    Fields,
    camera_of_fields,
    cameras_in,
    common_fields,
    numbers,
    opencv_pair,
    read_pose,
    rectified_projection,
)
from sfmapp.camera_files.files import read_fields
from sfmapp.camera_files.lens_types import type_fields
from sfmapp.camera_files.opencv_lens import (
    CalibratedCamera,
    FullLens,
    Size,
    camera_from_opencv,
    is_length,
    scaled_to,
)
from sfmapp.errors import InputError
from sfmapp.formats.text_input import nearest_rotation
from sfmapp.geometry import rigid3
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]

RIG_POSE_NAMES = ("turn_x", "turn_y", "turn_z", "x", "y", "z")
"""Of the unknowns of a pose in a rig's file: a small motion about the camera's own axes."""
_PAIR_NAMES = (("cam0", "cam1"), ("left", "right"), ("camera_0", "camera_1"), ("image_0", "image_1"))


@dataclass(frozen=True)
class Calibration:
    """What a calibration says.

    Attributes:
        rig: one camera, or two with their poses in metres.
        body_from_cam: (7,) pose that takes points of the first camera to the frame of the body or IMU; None if unknown.
        frames_per_second: None if it does not say.
        lenses: for each camera of the rig the lens whose frames are to be resampled to be its own; None for none.
        notes: what was changed on the way (a lens fitted, a size scaled), one line each.
        covariance: (P0 + P1 + 6,) squared, of two cameras that were calibrated together: parameters of the first, then
            of the second, then turn (radians) and shift of the second one's pose about its own axes; None: unknown.
    """

    rig: Rig
    body_from_cam: Array | None = None
    frames_per_second: float | None = None
    lenses: tuple[FullLens | None, ...] = (None, None)
    notes: tuple[str, ...] = ()
    covariance: Array | None = None


def read_calibration(path: str | Path, image_sizes: Sequence[Size]) -> Calibration:
    """Read a calibration, whichever form it has.

    Known are: ``calib.json`` (fx, fy, cx, cy, or K; k1, k2, p1, p2, k3 and so on, or dist; model; width, height;
    baseline; fps; or two such objects ``cam0`` and ``cam1``), COLMAP's ``cameras.txt``, ``cameras.bin`` or
    the folder of a model, ``cameras.json`` and ``transforms.json`` with one camera for all views, EuRoC's
    ``sensor.yaml``, Kalibr's ``camchain.yaml``, ROS's ``camera_info.yaml``, OpenCV's yml and xml (``camera_matrix`` or
    ``M1``, ``D1``, ``M2``, ``D2``, ``R``, ``T``), settings of ORB-SLAM and VINS-Fusion, KITTI's and
    Middlebury's ``calib.txt``, and plain text of
    ``fx fy cx cy [k1 k2 p1 p2 [k3]]`` or of the 3 x 3 matrix. What they call the lens counts: see
    :mod:`sfmapp.camera_files.lens_types`.

    Args:
        image_sizes: (width, height) of the images of each camera that is wanted; a calibration of another size but the
            same shape is scaled.

    Returns:
        As many cameras as are wanted and known.

    Raises:
        InputError: the file cannot be read, has none of these forms, or does not fit the images.
    """
    place, fields = str(path), read_fields(Path(path))
    if isinstance(fields.get("cameras"), list):
        return _from_list(place, fields, image_sizes)
    fields = common_fields(place, fields)
    rate = fields.get("fps", fields.get("rate_hz"))
    fps = float(rate) if isinstance(rate, int | float) and not isinstance(rate, bool) and 0 < rate < 1e6 else None
    if "P0" in fields:
        calibration = _from_projections(place, fields, image_sizes, 0)
    elif "M1" in fields or "K1" in fields:
        calibration = _from_opencv_pair(place, fields, image_sizes)
    else:
        pair = next((names for names in _PAIR_NAMES if isinstance(fields.get(names[0]), dict)), None)
        calibration = (
            _from_sections(place, fields, pair, image_sizes) if pair else _from_one(place, fields, image_sizes)
        )
    return replace(calibration, frames_per_second=fps)


def _from_list(place: str, fields: Fields, image_sizes: Sequence[Size]) -> Calibration:
    """The one camera of a COLMAP model, of ``cameras.json`` or of ``transforms.json``."""
    cameras = cameras_in(place, fields)
    if len(cameras) > 1:
        names = ", ".join(list(cameras)[:4])
        raise InputError(
            f"{place}: expected one camera for all frames, found {len(cameras)} different ones: {names}",
            "keep only the one that took them",
        )
    (section,) = cameras.values()
    return calibration_of(place, [camera_of_fields(place, section, image_sizes[0])], image_sizes)


def _from_one(place: str, fields: Fields, image_sizes: Sequence[Size]) -> Calibration:
    camera = camera_of_fields(place, fields, image_sizes[0])
    return calibration_of(place, [camera, camera], image_sizes, _body_from_cam(place, fields), _beside(place, fields))


def _body_from_cam(place: str, fields: Fields) -> Array | None:
    """(7,) from EuRoC's ``T_BS`` or Kalibr's ``T_cam_imu``, whose body is the IMU."""
    if "T_BS" in fields:
        return read_pose(f"{place}: T_BS", fields["T_BS"])
    if "T_cam_imu" in fields:
        return rigid3.inverse(read_pose(f"{place}: T_cam_imu", fields["T_cam_imu"]))
    return None


def _beside(place: str, fields: Fields) -> Array | None:
    """(7,) pose of the right camera of a rectified pair, from its baseline in metres; None if none is given."""
    baseline = next((fields[name] for name in ("baseline", "baseline_m") if name in fields), None)
    if baseline is None:
        return None
    if not isinstance(baseline, int | float) or not 0 < baseline < 1e3:
        raise InputError(f"{place}: expected a baseline in metres, found {baseline!r}")
    return np.array([0.0, 0.0, 0.0, 1.0, -float(baseline), 0.0, 0.0])


def _from_sections(place: str, fields: Fields, pair: Sequence[str], image_sizes: Sequence[Size]) -> Calibration:
    """``cam0`` and perhaps ``cam1`` as sections: Kalibr's camchain, and whoever writes alike."""
    cameras: list[CalibratedCamera] = []
    bodies: list[Array | None] = []
    chain = None
    for position, name in enumerate(pair[: len(image_sizes)]):
        section = fields.get(name)
        if not isinstance(section, dict):
            break
        cameras.append(camera_of_fields(f"{place}: {name}", {**type_fields(fields), **section}, image_sizes[position]))
        bodies.append(_body_from_cam(f"{place}: {name}", section))
        if "T_cn_cnm1" in section and position == 1:
            chain = read_pose(f"{place}: {name}: T_cn_cnm1", section["T_cn_cnm1"])
    if len(cameras) == 2:
        if chain is None and bodies[0] is not None and bodies[1] is not None:
            chain = rigid3.compose(rigid3.inverse(bodies[1]), bodies[0])
        if chain is None and "T_cam0_cam1" in fields:
            chain = rigid3.inverse(read_pose(f"{place}: T_cam0_cam1", fields["T_cam0_cam1"]))
        if chain is None:
            chain = _beside(place, fields)
    found = calibration_of(place, cameras, image_sizes, bodies[0], chain)
    if len(cameras) < 2 or "unknowns" not in fields or not found.rig.is_stereo:
        return found
    return replace(found, covariance=_joint_covariance(place, fields, pair, cameras, found.rig.cameras))


def _joint_covariance(
    place: str, fields: Fields, pair: Sequence[str], stated: Sequence[CalibratedCamera], scaled: Sequence[Camera]
) -> Array:
    """Of the two first cameras of a rig file that names its unknowns, for cameras scaled to their images."""
    names = fields["unknowns"]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"{place}: unknowns: expected a list of names, found {str(names)[:80]}")
    whole = numbers(f"{place}: covariance", fields.get("covariance"), (len(names), len(names)))
    wanted, by = [], []
    for name, one, other in zip(pair, stated, scaled, strict=True):
        wanted += [f"{name}.{param}" for param in PARAM_NAMES[other.model]]
        by.append(np.where(is_length(other.model), other.width / one.camera.width, 1.0))
    wanted += [f"{pair[1]}.{name}" for name in RIG_POSE_NAMES]
    missing = [name for name in wanted if name not in names]
    if missing:
        raise InputError(f"{place}: unknowns: expected {missing[0]} among them, found {', '.join(names[:6])}, ...")
    at = [names.index(name) for name in wanted]
    scale = np.concatenate([*by, np.ones(len(RIG_POSE_NAMES))])
    covariance: Array = whole[np.ix_(at, at)] * np.outer(scale, scale)
    return covariance


def _from_opencv_pair(place: str, fields: Fields, image_sizes: Sequence[Size]) -> Calibration:
    cameras = [
        camera_of_fields(f"{place}: camera {number}", section, size)
        for number, (section, size) in enumerate(zip(opencv_pair(fields), image_sizes, strict=False), 1)
    ]
    second = None
    if "R" in fields and "T" in fields:
        rotation = nearest_rotation(f"{place}: R", numbers(f"{place}: R", fields["R"], (3, 3)))
        second = rigid3.from_matrix(rotation, numbers(f"{place}: T", fields["T"], (3,)))
    return calibration_of(place, cameras, image_sizes, None, second)


def _from_projections(place: str, fields: Fields, image_sizes: Sequence[Size], first: int) -> Calibration:
    """KITTI's P0..P3: projections (3, 4) of points in the frame of camera 0 into rectified images."""
    cameras, positions = [], []
    for position in range(min(2, len(image_sizes))):
        name = f"P{first + position}"
        if name not in fields:
            if position == 0:
                raise InputError(f"{place}: expected a line '{name}: ' with 12 numbers, found {', '.join(fields)}")
            break
        matrix = rectified_projection(place, fields, name)
        intrinsics = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
        cameras.append(camera_from_opencv(f"{place}: {name}", image_sizes[position], intrinsics, [], False))
        positions.append(np.linalg.solve(matrix[:, :3], matrix[:, 3]))
    second = None
    if len(positions) > 1 and np.linalg.norm(positions[1] - positions[0]) > 1e-6:
        second = np.array([0.0, 0.0, 0.0, 1.0, *(positions[1] - positions[0])])
    body = np.array([0.0, 0.0, 0.0, 1.0, *-positions[0]])
    return calibration_of(place, cameras, image_sizes, body, second)


def kitti_calibration(path: Path, image_sizes: Sequence[Size], first: int) -> Calibration:
    """Cameras ``first`` and the one behind it of KITTI's calib.txt; ``body`` is camera 0, whose poses KITTI gives.

    Raises:
        InputError: the file cannot be read, or holds no such projections.
    """
    fields = read_fields(path)
    return _from_projections(str(path), fields, image_sizes, first)


def calibration_of(
    place: str,
    cameras: list[CalibratedCamera],
    image_sizes: Sequence[Size],
    body_from_cam: Array | None = None,
    second: Array | None = None,
) -> Calibration:
    """The cameras scaled to their images; without the pose of the second in the frame of the first, the first alone.

    Args:
        place: begins the message of a failure.
        cameras: one or two.
        image_sizes: (width, height) of the images of each camera that is wanted.
        body_from_cam: (7,) of the first; None if unknown.
        second: (7,) pose that takes points of the first camera to the second; None if unknown.

    Raises:
        InputError: a camera does not fit its images.
    """
    known = cameras if second is not None else cameras[:1]
    fitted = [scaled_to(place, camera, size) for camera, size in zip(known, image_sizes, strict=False)]
    poses = np.array([rigid3.IDENTITY] if len(fitted) < 2 else [rigid3.IDENTITY, second])
    return Calibration(
        Rig(tuple(one.camera for one in fitted), poses),
        body_from_cam,
        lenses=tuple(one.lens for one in fitted),
        notes=tuple(note for one in fitted for note in one.notes),
    )
