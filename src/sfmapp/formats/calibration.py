"""Calibrations of one camera or of a pair, in the forms that people have them.

Files written by or for OpenCV (EuRoC, Kalibr, ROS, KITTI, TUM, our own calib.json) put pixel centres at whole numbers:
half a pixel is added to the principal point here and nowhere else. COLMAP's files and ``--camera`` are in our own rule.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError, UsageError
from sfmapp.formats.colmap_model import checked_camera
from sfmapp.formats.flat_yaml import parse_flat_yaml
from sfmapp.formats.text_input import nearest_rotation, read_json_object, read_limited_text
from sfmapp.geometry import rigid3
from sfmapp.scene.camera import PARAM_NAMES, Camera, CameraModel, simple_camera
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]
Size = tuple[int, int]

# Trust in a calibration that somebody else made, relative to the focal length: as for camera_params of photographs.
_SIGMA_CALIBRATED = 0.01
_LARGEST_BYTES = 1 << 22

_MATRIX_NAMES = ("K", "camera_matrix", "cameraMatrix", "Camera_Matrix", "intrinsic_matrix", "intrinsics", "intrinsic")
_DISTORTION_NAMES = (
    "distortion_coefficients", "distortion_coeffs", "distCoeffs", "dist_coeffs", "dist_coeff", "distortion", "dist",
    "D", "Distortion_Coefficients",
)  # fmt: skip
_SCALAR_DISTORTION = ("k1", "k2", "p1", "p2", "k3")
_FISHEYE_NAMES = ("equidistant", "fisheye", "kannala_brandt", "kb4", "opencv_fisheye")
_PERSPECTIVE_NAMES = (
    "radtan", "radial-tangential", "plumb_bob", "rational_polynomial", "brown", "brown_conrady", "opencv", "pinhole",
    "none", "",
)  # fmt: skip
_PAIR_NAMES = (("cam0", "cam1"), ("left", "right"), ("camera_0", "camera_1"), ("image_0", "image_1"))


@dataclass(frozen=True)
class Calibration:
    """What a calibration says.

    Attributes:
        rig: one camera, or two with their poses in metres.
        body_from_cam: (7,) pose that takes points of the first camera to the frame of the body or IMU; None if unknown.
        frames_per_second: None if it does not say.
        notes: what was changed on the way (a lens fitted, a size scaled), one line each.
    """

    rig: Rig
    body_from_cam: Array | None = None
    frames_per_second: float | None = None
    notes: tuple[str, ...] = ()


def camera_from_text(text: str, size: Size) -> Camera:
    """The camera of ``MODEL,PARAMETER,...``: COLMAP's names and order, pixels with centres at halves.

    Raises:
        UsageError: not a model, or not its parameters.
    """
    name, *fields = (field.strip() for field in text.split(","))
    models = ", ".join(CameraModel.__members__)
    if name.upper() not in CameraModel.__members__:
        raise UsageError(
            f"camera is {text!r}, which is neither a file nor begins with a camera model", f"models are {models}"
        )
    model = CameraModel[name.upper()]
    expected = ",".join((model.name, *PARAM_NAMES[model]))
    try:
        params = np.array([float(field) for field in fields])
    except ValueError:
        raise UsageError(f"camera is {text!r}, expected numbers: {expected}") from None
    if len(params) != len(PARAM_NAMES[model]):
        raise UsageError(
            f"camera is {text!r}: {model.name} has {len(PARAM_NAMES[model])} parameters, found {len(params)}", expected
        )
    focals = params[[name.startswith("f") for name in PARAM_NAMES[model]]]
    if not np.isfinite(params).all() or not (focals > 0).all():
        raise UsageError(f"camera is {text!r}, expected finite numbers and positive focal lengths: {expected}")
    camera = simple_camera(model, *size, 1.0, source="user").with_params(params)
    return replace(camera, focal_sigma=_SIGMA_CALIBRATED * camera.focal)


def camera_from_opencv(
    place: str, size: Size, intrinsics: Sequence[float] | Array, coefficients: Sequence[float] | Array, fisheye: bool
) -> tuple[Camera, str | None]:
    """A camera of numbers in OpenCV's terms, and a note if the lens had to be fitted.

    Args:
        place: begins the messages.
        intrinsics: fx, fy, cx, cy; pixel centres at whole numbers.
        coefficients: k1, k2, p1, p2, k3, ... as ``cv2.projectPoints`` has them, or k1..k4 of a fisheye lens.

    Raises:
        InputError: numbers that no lens has, or a lens with no inverse in the picture.
    """
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    lens = [float(value) for value in coefficients]
    while lens and lens[-1] == 0.0:
        lens.pop()
    note = None
    if not all(map(math.isfinite, (fx, fy, cx, cy, *lens))) or min(fx, fy) <= 0:
        raise InputError(f"{place}: expected finite numbers and positive focal lengths, found {fx, fy, cx, cy, *lens}")
    if fisheye:
        if len(lens) > 4:
            raise InputError(f"{place}: expected 4 coefficients of a fisheye lens, found {len(lens)}")
        model, params = "OPENCV_FISHEYE", [fx, fy, cx, cy, *lens, *[0.0] * (4 - len(lens))]
    elif not lens:
        model, params = "PINHOLE", [fx, fy, cx, cy]
    elif len(lens) <= 4:
        model, params = "OPENCV", [fx, fy, cx, cy, *lens, *[0.0] * (4 - len(lens))]
    else:
        params, rms, largest = _nearest_opencv(place, size, np.array([fx, fy, cx, cy]), np.array(lens))
        model = "OPENCV"
        note = (
            f"{place}: a lens of {len(lens)} coefficients was fitted with k1, k2, p1, p2:"
            f" {rms:.3f} px rms over the picture, {largest:.3f} px at most"
        )
    params[2:4] = [params[2] + 0.5, params[3] + 0.5]
    camera = checked_camera(Path(place), 0, model, *size, params)
    return replace(camera, focal_sigma=_SIGMA_CALIBRATED * camera.focal), note


def _nearest_opencv(place: str, size: Size, intrinsics: Array, lens: Array) -> tuple[list[float], float, float]:
    """OPENCV parameters (pixel centres at whole numbers) that come nearest in the picture; rms and largest error in
    pixels. Gauss-Newton over a grid of pixels; the start, the lens cut off behind p2, is near in practice."""
    import cv2

    width, height = size
    matrix = np.array([[intrinsics[0], 0, intrinsics[2]], [0, intrinsics[1], intrinsics[3]], [0, 0, 1]])
    # OpenCV takes 4, 5, 8, 12 or 14
    wanted = next((count for count in (5, 8, 12, 14) if count >= len(lens)), 0)
    if not wanted:
        raise InputError(f"{place}: expected at most 14 coefficients of a lens, found {len(lens)}")
    full = np.concatenate([lens, np.zeros(wanted - len(lens))])
    grid = np.stack(np.meshgrid(np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 25)), -1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    rays = cv2.undistortPoints(grid, matrix, full, criteria=criteria).reshape(-1, 2)
    homogeneous = np.concatenate([rays, np.ones((len(rays), 1))], 1)
    back = cv2.projectPoints(homogeneous, np.zeros(3), np.zeros(3), matrix, full)[0].reshape(-1, 2)
    pixels = grid.reshape(-1, 2)
    good = np.abs(back - pixels).max(1) < 1e-3
    if good.sum() < 0.9 * len(good):
        raise InputError(f"{place}: the lens has no inverse in a picture of {width}x{height}: {lens.tolist()}")
    x, y, pixels = rays[good, 0], rays[good, 1], pixels[good]
    r2 = x * x + y * y
    zero, one = np.zeros_like(x), np.ones_like(x)
    params = np.concatenate([intrinsics, lens[:4]])
    for _ in range(20):
        fx, fy, cx, cy, k1, k2, p1, p2 = params
        radial = 1 + r2 * (k1 + r2 * k2)
        u, v = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
        residual = np.concatenate([fx * u + cx - pixels[:, 0], fy * v + cy - pixels[:, 1]])
        du = [u, zero, one, zero, fx * x * r2, fx * x * r2 * r2, fx * 2 * x * y, fx * (r2 + 2 * x * x)]
        dv = [zero, v, zero, one, fy * y * r2, fy * y * r2 * r2, fy * (r2 + 2 * y * y), fy * 2 * x * y]
        step = np.linalg.lstsq(np.concatenate([np.stack(du, 1), np.stack(dv, 1)]), residual, rcond=None)[0]
        params = params - step
        if np.abs(step).max() < 1e-10:
            break
    error = np.hypot(*residual.reshape(2, -1))
    return params.tolist(), float(np.sqrt(np.mean(error**2))), float(error.max())


def scaled_to(place: str, camera: Camera, size: Size) -> tuple[Camera, str | None]:
    """The camera for images of another size but the same shape, and a note if that was needed.

    Raises:
        InputError: the shapes differ: the images were cut, or the calibration is of another camera.
    """
    if (camera.width, camera.height) == size:
        return camera, None
    scale = size[0] / camera.width
    if abs(camera.height * scale - size[1]) > 1.0:
        raise InputError(
            f"{place}: expected a calibration for images of {size[0]}x{size[1]} pixels, found one for "
            f"{camera.width}x{camera.height}",
            "calibrate the camera at the size of the images, or give --camera",
        )
    is_length = [name[0] in "fc" for name in PARAM_NAMES[camera.model]]
    sigma = camera.focal_sigma and camera.focal_sigma * scale
    params = np.where(is_length, camera.params * scale, camera.params)
    note = f"{place}: calibrated at {camera.width}x{camera.height}, scaled to the images' {size[0]}x{size[1]}"
    return replace(camera, width=size[0], height=size[1], params=params, focal_sigma=sigma), note


def read_calibration(path: str | Path, image_sizes: Sequence[Size]) -> Calibration:
    """Read a calibration, whichever form it has.

    Known are: ``calib.json`` (fx, fy, cx, cy, or K; k1, k2, p1, p2, k3, or dist; width, height; baseline; fps; or two
    such objects ``cam0`` and ``cam1``), COLMAP's ``cameras.txt`` (its first camera), EuRoC's ``sensor.yaml``, Kalibr's
    ``camchain.yaml``, ROS's ``camera_info.yaml``, OpenCV's yml and xml (``camera_matrix`` or ``M1``, ``D1``, ``M2``,
    ``D2``, ``R``, ``T``), KITTI's ``calib.txt``, and plain text of ``fx fy cx cy [k1 k2 p1 p2 [k3]]`` or of the 3 x 3
    matrix.

    Args:
        image_sizes: (width, height) of the images of each camera that is wanted; a calibration of another size but the
            same shape is scaled.

    Returns:
        As many cameras as are wanted and known.

    Raises:
        InputError: the file cannot be read, has none of these forms, or does not fit the images.
    """
    path = Path(path)
    if path.suffix.lower() == ".json":
        return calibration_from_fields(str(path), read_json_object(path, _LARGEST_BYTES), image_sizes)
    text = read_limited_text(path, _LARGEST_BYTES)
    if text.lstrip().startswith("<"):
        return calibration_from_fields(str(path), _fields_of_xml(str(path), text), image_sizes)
    rows = [
        line.split() for line in text.replace(",", " ").splitlines() if line.strip() and line.lstrip()[0] not in "#%"
    ]
    if rows and len(rows[0]) >= 5 and rows[0][1] in CameraModel.__members__:
        return _from_colmap(str(path), rows[0], image_sizes)
    if rows and all(re.fullmatch(r"[-+.\deE]+", field) for row in rows for field in row):
        return _from_plain_numbers(str(path), [field for row in rows for field in row], image_sizes)
    return calibration_from_fields(str(path), parse_flat_yaml(text, str(path)), image_sizes)


def _from_colmap(place: str, fields: list[str], image_sizes: Sequence[Size]) -> Calibration:
    try:
        width, height, params = int(fields[2]), int(fields[3]), [float(field) for field in fields[4:]]
    except ValueError:
        raise InputError(
            f"{place}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, found {' '.join(fields)[:80]}"
        ) from None
    camera = checked_camera(Path(place), fields[0], fields[1], width, height, params)
    return _of_cameras(place, [replace(camera, focal_sigma=_SIGMA_CALIBRATED * camera.focal)], image_sizes)


def _from_plain_numbers(place: str, fields: list[str], image_sizes: Sequence[Size]) -> Calibration:
    try:
        values = [float(field) for field in fields]
    except ValueError:
        values = []
    if len(values) == 9 and values[6:] == [0, 0, 1]:
        values = [values[0], values[4], values[2], values[5]]
    if len(values) not in (4, 8, 9):
        raise InputError(
            f"{place}: expected fx fy cx cy, with k1 k2 p1 p2 and k3 or without, or a 3 x 3 matrix, found "
            f"{len(fields)} numbers"
        )
    camera, note = camera_from_opencv(place, image_sizes[0], values[:4], values[4:], False)
    return _of_cameras(place, [camera], image_sizes, notes=(note,) if note else ())


def calibration_from_fields(place: str, fields: dict[str, Any], image_sizes: Sequence[Size]) -> Calibration:
    """As :func:`read_calibration`, of a JSON-able object; ``place`` begins the messages."""
    rate = fields.get("fps", fields.get("rate_hz"))
    fps = float(rate) if isinstance(rate, int | float) and 0 < rate < 1e6 else None
    # settings of ORB-SLAM
    for prefix in ("Camera.", "Camera1."):
        if f"{prefix}fx" in fields:
            fields = {key.removeprefix(prefix): value for key, value in fields.items()}
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


def _from_one(place: str, fields: dict[str, Any], image_sizes: Sequence[Size]) -> Calibration:
    camera, note = _camera(place, fields, image_sizes[0])
    notes = (note,) if note else ()
    body = None
    if "T_BS" in fields:
        body = read_pose(f"{place}: T_BS", fields["T_BS"])
    elif "T_cam_imu" in fields:
        body = rigid3.inverse(read_pose(f"{place}: T_cam_imu", fields["T_cam_imu"]))
    right = _beside(place, fields)
    if right is None:
        return _of_cameras(place, [camera], image_sizes, body, notes=notes)
    return _of_cameras(place, [camera, camera], image_sizes, body, [right], notes)


def _beside(place: str, fields: dict[str, Any]) -> Array | None:
    """(7,) pose of the right camera of a rectified pair, from its baseline in metres; None if none is given."""
    baseline = next((fields[name] for name in ("baseline", "baseline_m") if name in fields), None)
    if baseline is None:
        return None
    if not isinstance(baseline, int | float) or not 0 < baseline < 1e3:
        raise InputError(f"{place}: expected a baseline in metres, found {baseline!r}")
    return np.array([0.0, 0.0, 0.0, 1.0, -float(baseline), 0.0, 0.0])


def _from_sections(place: str, fields: dict[str, Any], pair: Sequence[str], image_sizes: Sequence[Size]) -> Calibration:
    """``cam0`` and perhaps ``cam1`` as sections: Kalibr's camchain, and whoever writes alike."""
    cameras, bodies = [], []
    notes: list[str] = []
    chain = None
    for position, name in enumerate(pair[: len(image_sizes)]):
        section = fields.get(name)
        if not isinstance(section, dict):
            break
        one = _from_one(f"{place}: {name}", section, [image_sizes[position]])
        cameras.append(one.rig.cameras[0])
        notes.extend(one.notes)
        bodies.append(one.body_from_cam)
        if "T_cn_cnm1" in section and position == 1:
            chain = read_pose(f"{place}: {name}: T_cn_cnm1", section["T_cn_cnm1"])
    others = []
    if len(cameras) == 2:
        if chain is None and bodies[0] is not None and bodies[1] is not None:
            chain = rigid3.compose(rigid3.inverse(bodies[1]), bodies[0])
        if chain is None:
            chain = _beside(place, fields)
        if chain is None:
            cameras = cameras[:1]
            notes.append(f"{place}: it does not say where {pair[1]} sits")
        else:
            others = [chain]
    return _of_cameras(place, cameras, image_sizes, bodies[0], others, tuple(notes))


def _from_opencv_pair(place: str, fields: dict[str, Any], image_sizes: Sequence[Size]) -> Calibration:
    letter = "M" if "M1" in fields else "K"
    cameras: list[Camera] = []
    notes: list[str] = []
    for position in range(min(2, len(image_sizes))):
        names = {"K": fields.get(f"{letter}{position + 1}"), "D": fields.get(f"D{position + 1}", [])}
        shared = {key: value for key, value in fields.items() if "size" in key or "width" in key or "height" in key}
        camera, note = _camera(f"{place}: {letter}{position + 1}", {**shared, **names}, image_sizes[position])
        cameras.append(camera)
        notes.extend([note] if note else [])
    others = []
    if len(cameras) == 2:
        if "R" in fields and "T" in fields:
            rotation = nearest_rotation(f"{place}: R", _numbers(f"{place}: R", fields["R"], (3, 3)))
            others = [rigid3.from_matrix(rotation, _numbers(f"{place}: T", fields["T"], (3,)))]
        else:
            cameras = cameras[:1]
            notes.append(f"{place}: it does not say where the second camera sits (no R and T)")
    return _of_cameras(place, cameras, image_sizes, None, others, tuple(notes))


def _from_projections(place: str, fields: dict[str, Any], image_sizes: Sequence[Size], first: int) -> Calibration:
    """KITTI's P0..P3: projections (3, 4) of points in the frame of camera 0 into rectified images."""
    cameras, positions = [], []
    for position in range(min(2, len(image_sizes))):
        name = f"P{first + position}"
        if name not in fields:
            if position == 0:
                raise InputError(f"{place}: expected a line '{name}: ' with 12 numbers, found {', '.join(fields)}")
            break
        matrix = _numbers(f"{place}: {name}", fields[name], (3, 4))
        if matrix[0, 1] or matrix[1, 0] or matrix[2, :3].tolist() != [0, 0, 1]:
            raise InputError(f"{place}: {name}: expected K [I | t] with a K without skew, found {matrix.tolist()}")
        intrinsics = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
        cameras.append(camera_from_opencv(f"{place}: {name}", image_sizes[position], intrinsics, [], False)[0])
        positions.append(np.linalg.solve(matrix[:, :3], matrix[:, 3]))
    others = [np.array([0.0, 0.0, 0.0, 1.0, *(position - positions[0])]) for position in positions[1:]]
    if others and not np.linalg.norm(others[0][4:]) > 1e-6:
        cameras, others = cameras[:1], []
    body = np.array([0.0, 0.0, 0.0, 1.0, *-positions[0]])
    return _of_cameras(place, cameras, image_sizes, body, others)


def kitti_calibration(path: Path, image_sizes: Sequence[Size], first: int) -> Calibration:
    """Cameras ``first`` and the one behind it of KITTI's calib.txt; ``body`` is camera 0, whose poses KITTI gives.

    Raises:
        InputError: the file cannot be read, or holds no such projections.
    """
    fields = parse_flat_yaml(read_limited_text(path, _LARGEST_BYTES), str(path))
    return _from_projections(str(path), fields, image_sizes, first)


def _of_cameras(
    place: str,
    cameras: list[Camera],
    image_sizes: Sequence[Size],
    body_from_cam: Array | None = None,
    others: Sequence[Array] = (),
    notes: tuple[str, ...] = (),
) -> Calibration:
    """Cameras scaled to their images; ``others`` are the poses of those behind the first, in the frame of the first."""
    fitted = [scaled_to(place, camera, size) for camera, size in zip(cameras, image_sizes, strict=False)]
    poses = np.array([rigid3.IDENTITY, *others])[: len(fitted)]
    notes += tuple(note for _, note in fitted if note)
    return Calibration(Rig(tuple(camera for camera, _ in fitted), poses), body_from_cam, notes=notes)


def _camera(place: str, fields: dict[str, Any], image_size: Size) -> tuple[Camera, str | None]:
    """One camera of a section, at the size that the section states, or else at that of the images."""
    size = _size(place, fields) or image_size
    if isinstance(fields.get("params"), list) and isinstance(fields.get("model"), str):
        camera = checked_camera(Path(place), 0, fields["model"].upper(), *size, _numbers(place, fields["params"], None))
        return replace(camera, focal_sigma=_SIGMA_CALIBRATED * camera.focal), None
    name = str(fields.get("distortion_model", fields.get("distortion_type", ""))).lower()
    if name not in _FISHEYE_NAMES + _PERSPECTIVE_NAMES:
        raise InputError(f"{place}: expected a distortion model such as radtan or equidistant, found {name!r}")
    if str(fields.get("camera_model", "pinhole")).lower() not in ("pinhole", *_FISHEYE_NAMES):
        raise InputError(f"{place}: expected camera_model pinhole, found {fields['camera_model']!r}")
    fisheye = name in _FISHEYE_NAMES or str(fields.get("camera_model", "")).lower() in _FISHEYE_NAMES
    return camera_from_opencv(place, size, _intrinsics(place, fields), _coefficients(place, fields), fisheye)


def _intrinsics(place: str, fields: dict[str, Any]) -> Array:
    """(4,) fx, fy, cx, cy."""
    if all(name in fields for name in ("fx", "fy", "cx", "cy")):
        return np.array([_numbers(f"{place}: {name}", [fields[name]], (1,))[0] for name in ("fx", "fy", "cx", "cy")])
    name = next((name for name in _MATRIX_NAMES if name in fields), None)
    if name is None:
        _refuse_form(place, fields)
    if isinstance(fields[name], dict) and "fx" in fields[name]:
        return _intrinsics(f"{place}: {name}", fields[name])
    values = _numbers(f"{place}: {name}", fields[name], None)
    if len(values) == 4:
        return values
    if len(values) != 9:
        raise InputError(f"{place}: {name}: expected fx, fy, cx, cy or a 3 x 3 matrix, found {len(values)} numbers")
    if values[1] or values[3] or values[6:].tolist() != [0, 0, 1]:
        raise InputError(f"{place}: {name}: expected no skew and a last row of 0 0 1, found {values.tolist()}")
    return values[[0, 4, 2, 5]]


def _coefficients(place: str, fields: dict[str, Any]) -> Array:
    name = next((name for name in _DISTORTION_NAMES if fields.get(name) is not None), None)
    if name is not None and not (isinstance(fields[name], dict) and "k1" in fields[name]):
        return _numbers(f"{place}: {name}", fields[name], None)
    section = fields if name is None else fields[name]
    known = [section.get(key, 0.0) for key in _SCALAR_DISTORTION]
    return _numbers(f"{place}: k1, k2, p1, p2, k3", known, None)


def _size(place: str, fields: dict[str, Any]) -> Size | None:
    pairs = (("width", "height"), ("image_width", "image_height"))
    found = next(([fields[w], fields[h]] for w, h in pairs if w in fields and h in fields), None)
    if found is None:
        found = next((fields[key] for key in ("resolution", "image_size", "imageSize", "size") if key in fields), None)
    if found is None:
        return None
    width, height = _numbers(f"{place}: image size", found, (2,))
    if not (width % 1 == 0 and height % 1 == 0 and min(width, height) > 0 and max(width, height) < 1e6):
        raise InputError(f"{place}: expected an image size in pixels, found {width:g} x {height:g}")
    return int(width), int(height)


def read_pose(place: str, value: Any) -> Array:
    """(7,) pose of a rigid 4 x 4 matrix in any of the forms that files have. Raises InputError if it is none."""
    matrix = _numbers(place, value, (4, 4))
    if not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-9):
        raise InputError(f"{place}: expected a last row of 0 0 0 1, found {matrix[3].tolist()}")
    return rigid3.from_matrix(nearest_rotation(place, matrix[:3, :3]), matrix[:3, 3])


def _numbers(place: str, value: Any, shape: tuple[int, ...] | None) -> Array:
    """Finite numbers from nested lists, text, or OpenCV's and ROS's ``{rows, cols, data}``; None: flat, any number."""
    flat: list[Any] = []

    def gather(part: Any, depth: int) -> None:
        if isinstance(part, dict):
            part = part.get("data")
        if isinstance(part, str):
            part = part.split()
        if isinstance(part, int | float):
            part = [part]
        if not isinstance(part, list) or depth > 3:
            raise InputError(f"{place}: expected numbers, found {json.dumps(value, default=str)[:80]}")
        for item in part:
            if isinstance(item, list):
                gather(item, depth + 1)
            else:
                flat.append(item)

    gather(value, 0)
    try:
        numbers = np.array([math.nan if isinstance(item, bool) or item is None else float(item) for item in flat])
    except (TypeError, ValueError, OverflowError):
        numbers = np.array([math.nan])
    if not np.isfinite(numbers).all() or (shape is not None and numbers.size != math.prod(shape)):
        wanted = "finite numbers" if shape is None else f"{' x '.join(map(str, shape))} finite numbers"
        raise InputError(f"{place}: expected {wanted}, found {json.dumps(value, default=str)[:80]}")
    return numbers if shape is None else numbers.reshape(shape)


def _refuse_form(place: str, fields: dict[str, Any]) -> NoReturn:
    raise InputError(
        f"{place}: expected a calibration (fx, fy, cx, cy; or intrinsics, K or camera_matrix), found "
        f"{', '.join(map(str, list(fields)[:8])) or 'nothing'}",
        "known are calib.json, cameras.txt, sensor.yaml, camchain.yaml, camera_info.yaml, OpenCV's yml and xml",
    )


def _fields_of_xml(place: str, text: str) -> dict[str, Any]:
    """The nested elements of an XML file as objects. Entities, which can grow without bound, are refused."""
    from xml.etree import ElementTree

    if "<!" in re.sub("<!--.*?-->", "", text, flags=re.DOTALL):
        raise InputError(f"{place}: expected XML without document types and entities")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{place}: expected XML: {error}") from None

    def fields_of(element: ElementTree.Element, depth: int) -> Any:
        if depth > 10:
            raise InputError(f"{place}: expected no more than 10 levels of XML")
        if len(element):
            return {child.tag: fields_of(child, depth + 1) for child in element}
        content = (element.text or "").strip()
        try:
            return float(content)
        except ValueError:
            return content

    value = fields_of(root, 0)
    if not isinstance(value, dict):
        raise InputError(f"{place}: expected XML with elements, found text")
    return value
