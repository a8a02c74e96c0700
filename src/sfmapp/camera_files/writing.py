"""A camera of ours in the files that other programs read: COLMAP, OpenCV, Kalibr, ROS.

OpenCV, Kalibr and ROS put pixel centres at whole numbers: half a pixel is taken from the principal point here, and put
back by :mod:`sfmapp.camera_files.fields`. A lens that a program has no words for is not bent into one that it has:
there is no file then, and a reason.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera import lens
from sfmapp.camera.camera import Camera, pixels_to_rays, project
from sfmapp.camera_files.fields import camera_of_fields, cameras_in
from sfmapp.camera_files.files import read_fields
from sfmapp.camera_files.opencv_lens import exact_camera
from sfmapp.formats.atomic import replaced_file

Array = NDArray[np.float64]

# places along each side of the picture where a camera that is read back is compared
_STEPS = 33
# OpenCV's order, as places among the twelve numbers of distortion of the rational family, which is the same
_OPENCV_COUNTS = (5, 8, 12)


@dataclass(frozen=True)
class WrittenCamera:
    """A camera file and what came of reading it back.

    Attributes:
        name: of the file.
        program: that it is for.
        max_px: largest difference of a pixel between the camera and what was read back; None where nothing was written.
        reason: why nothing was written; None where it was.
    """

    name: str
    program: str
    max_px: float | None = None
    reason: str | None = None


@dataclass(frozen=True)
class OpenCVTerms:
    """A camera in OpenCV's terms: pixel centres at whole numbers, and coefficients (4, 5, 8 or 12)."""

    intrinsics: Sequence[float]
    coefficients: Sequence[float]
    is_fisheye: bool

    @property
    def matrix(self) -> list[float]:
        """(9,) rows of the calibration matrix."""
        fx, fy, cx, cy = self.intrinsics
        return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]


def write_camera_files(folder: Path, camera: Camera, name: str = "camera") -> list[WrittenCamera]:
    """Write a camera into a folder in every form that can hold it, and read each back.

    Args:
        name: of the camera, in the files that have names.

    Returns:
        An entry for each of cameras.txt (COLMAP), opencv.yaml, camchain.yaml (Kalibr) and camera_info.yaml (ROS).

    Raises:
        InputError: the folder cannot be written.
    """
    forms: tuple[tuple[str, str, Callable[[Camera, str], str | None]], ...] = (
        ("cameras.txt", "COLMAP", _colmap),
        ("opencv.yaml", "OpenCV", _opencv),
        ("camchain.yaml", "Kalibr", _kalibr),
        ("camera_info.yaml", "ROS", _ros),
    )
    written = []
    for file_name, program, text_of in forms:
        text = text_of(camera, name)
        path = folder / file_name
        if text is None:
            path.unlink(missing_ok=True)  # of an earlier run with another lens
            reason = f"{program} has no words for the lens {camera.model.name}"
            written.append(WrittenCamera(file_name, program, reason=reason))
            continue
        with replaced_file(path) as beside:
            beside.write_text(text, encoding="utf-8")
        written.append(WrittenCamera(file_name, program, _difference_px(camera, path)))
    return written


def _difference_px(camera: Camera, path: Path) -> float:
    """Largest distance between a pixel and where the camera that a file holds puts its ray."""
    (section,) = cameras_in(str(path), read_fields(path)).values()
    found = camera_of_fields(str(path), section, (camera.width, camera.height))
    read = found.camera if found.stated is None else exact_camera(found.stated)
    assert read is not None  # nothing here writes a tilted sensor
    return difference_px(camera, read)


def difference_px(camera: Camera, read: Camera) -> float:
    """Largest difference, of a coordinate of pixels over the picture of a camera, between it and another."""
    steps = np.linspace(0.0, 1.0, _STEPS)
    xy = np.stack(np.meshgrid(steps * camera.width, steps * camera.height), axis=-1).reshape(-1, 2)
    rays = pixels_to_rays(camera, xy)
    is_known = np.isfinite(rays).all(1)
    return float(np.abs(project(read, rays[is_known]) - xy[is_known]).max(initial=0.0))


def terms_of(camera: Camera) -> OpenCVTerms | None:
    """A camera in OpenCV's terms; None for a lens that OpenCV does not have."""
    fx, fy, cx, cy, *rest = camera.canonical[: lens.FAMILY].tolist()
    intrinsics = (fx, fy, cx - 0.5, cy - 0.5)
    if camera.family == lens.RADIAL_FISHEYE:
        return OpenCVTerms(intrinsics, rest[:4], True)
    if camera.is_pinhole and camera.family != lens.SKEW:
        return OpenCVTerms(intrinsics, [0.0] * 4, False)
    if camera.family == lens.BROWN:
        return OpenCVTerms(intrinsics, rest[:4], False)
    if camera.family == lens.RATIONAL:
        count = next(n for n in _OPENCV_COUNTS if not any(rest[n:]))
        return OpenCVTerms(intrinsics, rest[:count], False)
    return None


def number_list(values: Sequence[float]) -> str:
    """Numbers as YAML has them, none rounded."""
    # the shortest text that is the same number again
    return "[" + ", ".join(repr(float(value)) for value in values) + "]"


def _colmap(camera: Camera, name: str) -> str | None:
    if not camera.model.is_colmaps:
        return None
    values = " ".join(repr(float(value)) for value in camera.params)
    head = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    return f"{head}# Number of cameras: 1\n1 {camera.model.name} {camera.width} {camera.height} {values}\n"


def _opencv(camera: Camera, name: str) -> str | None:
    terms = terms_of(camera)
    if terms is None:
        return None

    kind = "fisheye" if terms.is_fisheye else "pinhole"
    return (
        f"%YAML:1.0\n---\nimage_width: {camera.width}\nimage_height: {camera.height}\ncamera_model: {kind}\n"
        f"camera_matrix: {opencv_matrix(3, 3, terms.matrix)}"
        f"distortion_coefficients: {opencv_matrix(1, len(terms.coefficients), terms.coefficients)}"
    )


def opencv_matrix(rows: int, cols: int, values: Sequence[float]) -> str:
    """A matrix as OpenCV's YAML has it, to be put behind its name."""
    return f"!!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: {number_list(values)}\n"


def _kalibr(camera: Camera, name: str) -> str | None:
    section = kalibr_section(camera, name)
    return None if section is None else f"cam0:\n{section}"


def kalibr_section(camera: Camera, name: str) -> str | None:
    """What Kalibr's camchain says of a camera; None for a lens that it does not have."""
    terms = terms_of(camera)
    if terms is None or len(terms.coefficients) > 4:
        return None
    kind = "equidistant" if terms.is_fisheye else "radtan"
    return (
        f"  camera_model: pinhole\n  intrinsics: {number_list(terms.intrinsics)}\n  distortion_model: {kind}\n"
        f"  distortion_coeffs: {number_list(terms.coefficients)}\n  resolution: [{camera.width}, {camera.height}]\n"
        f"  rostopic: /{name}/image_raw\n"
    )


def _ros(camera: Camera, name: str) -> str | None:
    fx, fy, cx, cy = camera.canonical[:4].tolist()
    projection = np.array([[fx, 0.0, cx - 0.5, 0.0], [0.0, fy, cy - 0.5, 0.0], [0.0, 0.0, 1.0, 0.0]])
    return camera_info(camera, name, np.eye(3), projection)


def camera_info(camera: Camera, name: str, rotation: Array, projection: Array) -> str | None:
    """ROS's camera_info of a camera, with the rotation (3, 3) and the projection (3, 4) of its rectified pictures; None
    for a lens that ROS has no words for."""
    terms = terms_of(camera)
    if terms is None or len(terms.coefficients) > 8:
        return None
    values = [*terms.coefficients]
    kind = "equidistant"
    if not terms.is_fisheye:
        values += [0.0] * ((5 if len(values) <= 5 else 8) - len(values))
        kind = "plumb_bob" if len(values) == 5 else "rational_polynomial"

    def matrix(field: str, rows: int, cols: int, entries: Sequence[float]) -> str:
        return f"{field}:\n  rows: {rows}\n  cols: {cols}\n  data: {number_list(entries)}\n"

    return (
        f"image_width: {camera.width}\nimage_height: {camera.height}\ncamera_name: {name}\n"
        + matrix("camera_matrix", 3, 3, terms.matrix)
        + f"distortion_model: {kind}\n"
        + matrix("distortion_coefficients", 1, len(values), values)
        + matrix("rectification_matrix", 3, 3, rotation.ravel().tolist())
        + matrix("projection_matrix", 3, 4, projection.ravel().tolist())
    )
