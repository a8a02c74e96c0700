"""Cameras of the fields that calibration files have, under all the names that these go by.

Files written by or for OpenCV (EuRoC, Kalibr, ROS, KITTI, TUM, our own calib.json) put pixel centres at whole numbers:
half a pixel is added to the principal point in :func:`camera_from_opencv` and nowhere else. COLMAP's files and
``--camera MODEL,PARAMETERS`` are in our own rule.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, simple_camera
from sfmapp.camera.models import PARAM_NAMES, kind_of
from sfmapp.camera.names import CameraModel
from sfmapp.camera_files.lens_types import (
    LensType,
    is_without_distortion,
    lens_type,
    named_coefficients,
    type_fields,
)
from sfmapp.camera_files.opencv_lens import (
    SIGMA_CALIBRATED,
    CalibratedCamera,
    Size,
    camera_from_colmap,
    camera_from_opencv,
)
from sfmapp.camera_files.slam_settings import orb_slam_fields, vins_fields
from sfmapp.errors import InputError, UsageError
from sfmapp.formats.text_input import nearest_rotation
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Fields = dict[str, Any]

_MATRIX_NAMES = ("K", "camera_matrix", "cameraMatrix", "Camera_Matrix", "intrinsic_matrix", "intrinsics", "intrinsic")
_DISTORTION_NAMES = (
    "distortion_coefficients", "distortion_coeffs", "distCoeffs", "dist_coeffs", "dist_coeff", "distortion", "dist",
    "D", "Distortion_Coefficients",
)  # fmt: skip
_SIZE_PAIRS = (("width", "height"), ("image_width", "image_height"))
_SIZE_NAMES = ("resolution", "image_size", "imageSize", "size")
_PROJECTION = re.compile(r"P\d")
_KNOWN_FORMS = (
    "known are calib.json, cameras.json, transforms.json, cameras.txt and .bin, sensor.yaml, camchain.yaml, "
    "camera_info.yaml, OpenCV's yml and xml"
)


def is_calibration_path(given: str) -> bool:
    """Whether what a user gives for a camera is a file or folder; False: it is to be read as ``MODEL,PARAMETERS``.

    Raises:
        InputError: evidently a path, with nothing there.
    """
    if os.path.exists(given):
        return True
    if "," not in given and any(c in given for c in "./\\"):
        raise InputError(f"camera {given}: expected a calibration file, found no such file")
    return False


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


# --------------------------------------------------------------------------------------------- the cameras of a file


def common_fields(place: str, fields: Fields) -> Fields:
    """The fields of settings of SLAM systems by their common names; others as they are."""
    return vins_fields(place, orb_slam_fields(place, fields))


def cameras_in(place: str, fields: Fields) -> dict[str, Fields]:
    """The fields of each camera that a file holds, by its name in the file; of a file with one, by the empty name.

    Args:
        fields: as of :func:`read_fields`.

    Raises:
        InputError: there is no camera.
    """
    fields = common_fields(place, fields)
    listed = fields.get("cameras")
    if isinstance(listed, list):
        return {_name_of_listed(number, entry): entry for number, entry in enumerate(listed)}
    projections = [name for name in fields if _PROJECTION.fullmatch(name)]
    if "P0" in projections:
        return {f"image_{name[1:]}": {"intrinsics": rectified_intrinsics(place, fields, name)} for name in projections}
    pair = opencv_pair(fields)
    if pair:
        return {f"cam{n}": section for n, section in enumerate(pair)}
    if _holds_camera(fields):
        return {"": fields}
    sections = {
        str(name): {**type_fields(fields), **section}
        for name, section in fields.items()
        if isinstance(section, dict) and _holds_camera(section)
    }
    return sections or _refuse_form(place, fields)


def _name_of_listed(number: int, entry: Fields) -> str:
    if "id" in entry:
        return f"camera {entry['id']}"
    return f"camera of {entry['files'][0]}" if "files" in entry else f"camera {number}"


def _holds_camera(fields: Mapping[str, Any]) -> bool:
    return "fx" in fields or any(name in fields for name in (*_MATRIX_NAMES, "params"))


def is_of_camera(name: str) -> bool:
    """Whether a field says anything of a camera, and not of its place or its name."""
    of_size = (*(name for pair in _SIZE_PAIRS for name in pair), *_SIZE_NAMES)
    return (
        name in (*_MATRIX_NAMES, *_DISTORTION_NAMES, *of_size, "fx", "fy", "cx", "cy", "params")
        or bool(type_fields({name: None}))
        or re.fullmatch(r"k[1-6]|p[12]|s[1-4]|tau_?[xyXY]", name) is not None
    )


def opencv_pair(fields: Fields) -> list[Fields]:
    """The cameras of OpenCV's ``M1``, ``D1``, ``M2``, ``D2`` (or ``K1``, ``K2``); none where it is not that."""
    letter = "M" if "M1" in fields else "K"
    shared = {key: value for key, value in fields.items() if "size" in key or "width" in key or "height" in key}
    shared |= type_fields(fields)
    found = [n for n in (1, 2) if f"{letter}{n}" in fields] if f"{letter}1" in fields else []
    return [{**shared, "K": fields[f"{letter}{n}"], "D": fields.get(f"D{n}", [])} for n in found]


def rectified_projection(place: str, fields: Fields, name: str) -> Array:
    """(3, 4) KITTI's ``P0``, ``P1``, ...: K [I | t] of rectified images. Raises InputError for another matrix."""
    matrix = numbers(f"{place}: {name}", fields[name], (3, 4))
    if matrix[0, 1] or matrix[1, 0] or matrix[2, :3].tolist() != [0, 0, 1]:
        raise InputError(f"{place}: {name}: expected K [I | t] with a K without skew, found {matrix.tolist()}")
    return matrix


def rectified_intrinsics(place: str, fields: Fields, name: str) -> list[float]:
    """fx, fy, cx, cy of :func:`rectified_projection`."""
    values: list[float] = rectified_projection(place, fields, name)[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return values


# --------------------------------------------------------------------------------------------- a camera of its fields


def camera_of_fields(place: str, fields: dict[str, Any], image_size: Size) -> CalibratedCamera:
    """One camera of a section, at the size that the section states, or else at that of the images."""
    size = stated_size(place, fields) or image_size
    if isinstance(fields.get("params"), list) and isinstance(fields.get("model"), str):
        covariance = _covariance(place, fields.get("covariance"))
        params = numbers(place, fields["params"], None)
        return camera_from_colmap(place, fields["model"].upper(), size, params, covariance)
    nested = [fields[name] for name in (*_MATRIX_NAMES, *_DISTORTION_NAMES) if isinstance(fields.get(name), dict)]
    sections = [fields, *nested]
    lens = lens_type(place, sections)
    intrinsics, coefficients = _intrinsics(place, fields), _coefficients(place, fields, lens)
    if coefficients.any() and is_without_distortion(sections):
        raise InputError(
            f"{place}: expected no coefficients of a lens without distortion, found {coefficients}",
            "name the distortion model, or remove the coefficients",
        )
    return camera_from_opencv(place, size, intrinsics, coefficients, lens == LensType.FISHEYE)


def _covariance(place: str, values: Any) -> Array | None:
    """Rows of equal length; None for none."""
    if not isinstance(values, list) or not values:
        return None
    rows = [numbers(f"{place}: covariance", row, None) for row in values]
    if {len(row) for row in rows} != {len(rows)}:
        raise InputError(f"{place}: covariance: expected a square matrix, found rows of {[len(row) for row in rows]}")
    return np.array(rows)


def _intrinsics(place: str, fields: dict[str, Any]) -> Array:
    """(4,) fx, fy, cx, cy."""
    if all(name in fields for name in ("fx", "fy", "cx", "cy")):
        return np.array([numbers(f"{place}: {name}", [fields[name]], (1,))[0] for name in ("fx", "fy", "cx", "cy")])
    name = next((name for name in _MATRIX_NAMES if name in fields), None)
    if name is None:
        _refuse_form(place, fields)
    if isinstance(fields[name], dict) and "fx" in fields[name]:
        return _intrinsics(f"{place}: {name}", fields[name])
    values = numbers(f"{place}: {name}", fields[name], None)
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
        return numbers(f"{place}: {name}", fields[name], None)
    section = fields if name is None else fields[name]
    return numbers(f"{place}: k1, k2, p1, p2, ...", named_coefficients(place, section, lens), None)


def stated_size(place: str, fields: Fields) -> Size | None:
    """Width and height of the images that a camera was calibrated with; None where that is not said."""
    pairs = (("width", "height"), ("image_width", "image_height"))
    found = next(([fields[w], fields[h]] for w, h in pairs if w in fields and h in fields), None)
    if found is None:
        found = next((fields[key] for key in ("resolution", "image_size", "imageSize", "size") if key in fields), None)
    if found is None:
        return None
    width, height = numbers(f"{place}: image size", found, (2,))
    if not (width % 1 == 0 and height % 1 == 0 and min(width, height) > 0 and max(width, height) < 1e6):
        raise InputError(f"{place}: expected an image size in pixels, found {width:g} x {height:g}")
    return int(width), int(height)


def oddity(camera: Camera) -> str | None:
    """What is odd about a calibration that is unlike that of any camera; None for nothing."""
    if camera.model == CameraModel.EQUIRECTANGULAR:  # its numbers are the size of the picture
        return None
    fx, fy, cx, cy = camera.canonical[:4]
    long_side = max(camera.width, camera.height)
    # 0.2 is a fisheye lens of the widest kind, 20 a telescope
    is_odd = not (0.2 * long_side < min(fx, fy) <= max(fx, fy) < 20 * long_side)
    if is_odd or not (0 < cx < camera.width and 0 < cy < camera.height):
        text = f"fx {fx:.4g}, fy {fy:.4g}, cx {cx:.4g}, cy {cy:.4g} for {camera.width}x{camera.height} pixels"
        return f"the calibration is unlike that of any camera: {text}"
    return None


def read_pose(place: str, value: Any) -> Array:
    """(7,) pose of a rigid 4 x 4 matrix in any of the forms that files have. Raises InputError if it is none."""
    matrix = numbers(place, value, (4, 4))
    if not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-9):
        raise InputError(f"{place}: expected a last row of 0 0 0 1, found {matrix[3].tolist()}")
    return rigid3.from_matrix(nearest_rotation(place, matrix[:3, :3]), matrix[:3, 3])


def numbers(place: str, value: Any, shape: tuple[int, ...] | None) -> Array:
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
        values = np.array([math.nan if isinstance(item, bool) or item is None else float(item) for item in flat])
    except (TypeError, ValueError, OverflowError):
        values = np.array([math.nan])
    if not np.isfinite(values).all() or (shape is not None and values.size != math.prod(shape)):
        wanted = "finite numbers" if shape is None else f"{' x '.join(map(str, shape))} finite numbers"
        raise InputError(f"{place}: expected {wanted}, found {json.dumps(value, default=str)[:80]}")
    return values if shape is None else values.reshape(shape)


def _refuse_form(place: str, fields: dict[str, Any]) -> NoReturn:
    raise InputError(
        f"{place}: expected a calibration (fx, fy, cx, cy; or intrinsics, K or camera_matrix), found "
        f"{', '.join(map(str, list(fields)[:8])) or 'nothing'}",
        "known are calib.json, cameras.txt, sensor.yaml, camchain.yaml, camera_info.yaml, OpenCV's yml and xml",
    )
