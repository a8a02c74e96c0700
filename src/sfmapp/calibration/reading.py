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

from sfmapp.calibration.lens_types import LensType, is_without_distortion, lens_type, named_coefficients, type_fields
from sfmapp.calibration.opencv_lens import (
    SIGMA_CALIBRATED,
    CalibratedCamera,
    FullLens,
    Size,
    camera_from_colmap,
    camera_from_opencv,
    scaled_to,
)
from sfmapp.calibration.slam_settings import orb_slam_fields, vins_fields
from sfmapp.camera.camera import PARAM_NAMES, Camera, CameraModel, simple_camera
from sfmapp.camera.models import kind_of
from sfmapp.camera.names import MODEL_NAMES
from sfmapp.errors import InputError, UsageError
from sfmapp.formats.flat_yaml import parse_flat_yaml
from sfmapp.formats.text_input import nearest_rotation, read_json_object, read_limited_text
from sfmapp.geometry import rigid3
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]

_LARGEST_BYTES = 1 << 22

_MATRIX_NAMES = ("K", "camera_matrix", "cameraMatrix", "Camera_Matrix", "intrinsic_matrix", "intrinsics", "intrinsic")
_DISTORTION_NAMES = (
    "distortion_coefficients", "distortion_coeffs", "distCoeffs", "dist_coeffs", "dist_coeff", "distortion", "dist",
    "D", "Distortion_Coefficients",
)  # fmt: skip
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
    """

    rig: Rig
    body_from_cam: Array | None = None
    frames_per_second: float | None = None
    lenses: tuple[FullLens | None, ...] = (None, None)
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
    focals = params[[kind_of(name) in ("focal", "size") for name in PARAM_NAMES[model]]]
    if not np.isfinite(params).all() or not (focals > 0).all():
        raise UsageError(f"camera is {text!r}, expected finite numbers and positive focal lengths: {expected}")
    camera = simple_camera(model, *size, 1.0, source="user").with_params(params)
    return replace(camera, focal_sigma=SIGMA_CALIBRATED * camera.focal)


def read_calibration(path: str | Path, image_sizes: Sequence[Size]) -> Calibration:
    """Read a calibration, whichever form it has.

    Known are: ``calib.json`` (fx, fy, cx, cy, or K; k1, k2, p1, p2, k3 and so on, or dist; model; width, height;
    baseline; fps; or two such objects ``cam0`` and ``cam1``), COLMAP's ``cameras.txt`` (its first camera), EuRoC's
    ``sensor.yaml``, Kalibr's ``camchain.yaml``, ROS's ``camera_info.yaml``, OpenCV's yml and xml (``camera_matrix`` or
    ``M1``, ``D1``, ``M2``, ``D2``, ``R``, ``T``), settings of ORB-SLAM and VINS-Fusion, KITTI's ``calib.txt``, and
    plain text of ``fx fy cx cy [k1 k2 p1 p2 [k3]]`` or of the 3 x 3 matrix. What they call the lens counts: see
    :mod:`sfmapp.calibration.lens_types`.

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
    if rows and len(rows[0]) >= 4 and rows[0][1] in MODEL_NAMES:
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
    return _of_cameras(place, [camera_from_colmap(place, fields[1], (width, height), params)], image_sizes)


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
    camera = camera_from_opencv(place, image_sizes[0], values[:4], values[4:], False)
    return _of_cameras(place, [camera], image_sizes)


def calibration_from_fields(place: str, fields: dict[str, Any], image_sizes: Sequence[Size]) -> Calibration:
    """As :func:`read_calibration`, of a JSON-able object; ``place`` begins the messages."""
    fields = vins_fields(place, orb_slam_fields(place, fields))
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


def _from_one(place: str, fields: dict[str, Any], image_sizes: Sequence[Size]) -> Calibration:
    camera = _camera(place, fields, image_sizes[0])
    return _of_cameras(place, [camera, camera], image_sizes, _body_from_cam(place, fields), _beside(place, fields))


def _body_from_cam(place: str, fields: dict[str, Any]) -> Array | None:
    """(7,) from EuRoC's ``T_BS`` or Kalibr's ``T_cam_imu``, whose body is the IMU."""
    if "T_BS" in fields:
        return read_pose(f"{place}: T_BS", fields["T_BS"])
    if "T_cam_imu" in fields:
        return rigid3.inverse(read_pose(f"{place}: T_cam_imu", fields["T_cam_imu"]))
    return None


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
    cameras: list[CalibratedCamera] = []
    bodies: list[Array | None] = []
    chain = None
    for position, name in enumerate(pair[: len(image_sizes)]):
        section = fields.get(name)
        if not isinstance(section, dict):
            break
        cameras.append(_camera(f"{place}: {name}", {**type_fields(fields), **section}, image_sizes[position]))
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
    return _of_cameras(place, cameras, image_sizes, bodies[0], chain)


def _from_opencv_pair(place: str, fields: dict[str, Any], image_sizes: Sequence[Size]) -> Calibration:
    letter = "M" if "M1" in fields else "K"
    cameras: list[CalibratedCamera] = []
    for position in range(min(2, len(image_sizes))):
        if f"{letter}{position + 1}" not in fields:
            break
        names = {"K": fields.get(f"{letter}{position + 1}"), "D": fields.get(f"D{position + 1}", [])}
        shared = {key: value for key, value in fields.items() if "size" in key or "width" in key or "height" in key}
        shared |= type_fields(fields)
        cameras.append(_camera(f"{place}: {letter}{position + 1}", {**shared, **names}, image_sizes[position]))
    second = None
    if "R" in fields and "T" in fields:
        rotation = nearest_rotation(f"{place}: R", _numbers(f"{place}: R", fields["R"], (3, 3)))
        second = rigid3.from_matrix(rotation, _numbers(f"{place}: T", fields["T"], (3,)))
    return _of_cameras(place, cameras, image_sizes, None, second)


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
        cameras.append(camera_from_opencv(f"{place}: {name}", image_sizes[position], intrinsics, [], False))
        positions.append(np.linalg.solve(matrix[:, :3], matrix[:, 3]))
    second = None
    if len(positions) > 1 and np.linalg.norm(positions[1] - positions[0]) > 1e-6:
        second = np.array([0.0, 0.0, 0.0, 1.0, *(positions[1] - positions[0])])
    body = np.array([0.0, 0.0, 0.0, 1.0, *-positions[0]])
    return _of_cameras(place, cameras, image_sizes, body, second)


def kitti_calibration(path: Path, image_sizes: Sequence[Size], first: int) -> Calibration:
    """Cameras ``first`` and the one behind it of KITTI's calib.txt; ``body`` is camera 0, whose poses KITTI gives.

    Raises:
        InputError: the file cannot be read, or holds no such projections.
    """
    fields = parse_flat_yaml(read_limited_text(path, _LARGEST_BYTES), str(path))
    return _from_projections(str(path), fields, image_sizes, first)


def _of_cameras(
    place: str,
    cameras: list[CalibratedCamera],
    image_sizes: Sequence[Size],
    body_from_cam: Array | None = None,
    second: Array | None = None,
) -> Calibration:
    """The cameras scaled to their images; without the pose of the second in the frame of the first, the first alone."""
    known = cameras if second is not None else cameras[:1]
    fitted = [scaled_to(place, camera, size) for camera, size in zip(known, image_sizes, strict=False)]
    poses = np.array([rigid3.IDENTITY] if len(fitted) < 2 else [rigid3.IDENTITY, second])
    return Calibration(
        Rig(tuple(one.camera for one in fitted), poses),
        body_from_cam,
        lenses=tuple(one.lens for one in fitted),
        notes=tuple(note for one in fitted for note in one.notes),
    )


def _camera(place: str, fields: dict[str, Any], image_size: Size) -> CalibratedCamera:
    """One camera of a section, at the size that the section states, or else at that of the images."""
    size = _size(place, fields) or image_size
    if isinstance(fields.get("params"), list) and isinstance(fields.get("model"), str):
        return camera_from_colmap(place, fields["model"].upper(), size, _numbers(place, fields["params"], None))
    nested = [fields[name] for name in (*_MATRIX_NAMES, *_DISTORTION_NAMES) if isinstance(fields.get(name), dict)]
    sections = [fields, *nested]
    lens = lens_type(place, sections)
    intrinsics, coefficients = _intrinsics(place, fields), _coefficients(place, fields, lens)
    if coefficients.any() and is_without_distortion(sections):
        raise InputError(
            f"{place}: expected no coefficients of a lens without distortion, found {coefficients}",
            "name the distortion model, or take the coefficients away",
        )
    return camera_from_opencv(place, size, intrinsics, coefficients, lens == LensType.FISHEYE)


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


def _coefficients(place: str, fields: dict[str, Any], lens: LensType | None) -> Array:
    """Coefficients in OpenCV's order: a list, or numbers with names, in a section of their own or beside the others."""
    name = next((name for name in _DISTORTION_NAMES if fields.get(name) is not None), None)
    if name is not None and not (isinstance(fields[name], dict) and "k1" in fields[name]):
        return _numbers(f"{place}: {name}", fields[name], None)
    section = fields if name is None else fields[name]
    return _numbers(f"{place}: k1, k2, p1, p2, ...", named_coefficients(place, section, lens), None)


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
