"""``calibration.json``: a calibration as a file, which ``--camera`` takes as well.

Beside the camera in COLMAP's terms (``model``, ``width``, ``height``, ``params``), which is all that
:mod:`sfmapp.camera_files` looks for, it has the covariances, so that two calibrations can be compared.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.documents import read_document, write_document
from sfmapp.calibration.result import CameraCalibration, ViewFit
from sfmapp.camera_files.opencv_lens import CalibratedCamera
from sfmapp.camera_files.photographs import GivenCameras, Photograph, read_given_cameras
from sfmapp.errors import InputError
from sfmapp.formats.colmap_model import checked_camera
from sfmapp.formats.text_input import read_json_object
from sfmapp.reporting import Report

CALIBRATION, FORMAT = "calibration.json", "sfmapp calibration 1"
# of the largest eigenvalue: what is less below zero is rounding
_ROUNDING = 1e-9


class CalibrationView(Report):
    """A photograph of a calibration.

    Attributes:
        cam_from_target: qx qy qz qw tx ty tz, in the unit of the target; absent without a target.
        num_used: of ``num_points``, those that count.
        rms_px: of these; absent without any.
        problem: why it is odd, or was left aside.
    """

    name: str
    num_points: int
    num_used: int
    rms_px: float | None = None
    cam_from_target: Sequence[float] | None = None
    problem: str | None = None


class CalibrationDocument(Report):
    """``calibration.json``: one camera, in pixels whose centres are at halves.

    Attributes:
        format: this form and its version.
        params: in the order of COLMAP's model.
        sigmas: standard deviations of the parameters by their names.
        covariance: (P, P).
        frame_covariance: (P + 6, P + 6), of the parameters and the frame of the camera: turn in radians, shift in the
            unit of the targets.
        noise_px: standard deviation of a measured coordinate.
        method: how it was got.
        distances: nearest, median and farthest distance of the points, in the unit of the targets.
    """

    format: str
    model: str
    width: int
    height: int
    params: Sequence[float]
    sigmas: Mapping[str, float]
    covariance: Sequence[Sequence[float]]
    noise_px: float
    degrees_of_freedom: int
    method: str
    views: Sequence[CalibrationView]
    warnings: Sequence[str]
    frame_covariance: Sequence[Sequence[float]] | None = None
    distances: Sequence[float] | None = None


def document_of(calibration: CameraCalibration) -> CalibrationDocument:
    """A calibration in plain values."""
    camera = calibration.camera
    return CalibrationDocument(
        format=FORMAT,
        model=camera.model.name,
        width=camera.width,
        height=camera.height,
        params=camera.params.tolist(),
        sigmas=dict(zip(calibration.param_names, calibration.sigmas.tolist(), strict=True)),
        covariance=calibration.covariance.tolist(),
        noise_px=calibration.noise_px,
        degrees_of_freedom=calibration.degrees_of_freedom,
        method=calibration.method,
        views=[_view(view) for view in calibration.views],
        warnings=list(calibration.warnings),
        frame_covariance=None if calibration.frame_covariance is None else calibration.frame_covariance.tolist(),
        distances=None if calibration.distances is None else list(calibration.distances),
    )


def _view(view: ViewFit) -> CalibrationView:
    return CalibrationView(
        name=view.name,
        num_points=len(view.xy),
        num_used=int(view.is_used.sum()),
        rms_px=view.rms_px if view.is_used.any() else None,
        cam_from_target=None if view.cam_from_target is None else view.cam_from_target.tolist(),
        problem=view.problem,
    )


def write_calibration(path: Path, calibration: CameraCalibration) -> None:
    """Write ``calibration.json``. Raises InputError if it cannot be written."""
    write_document(path, document_of(calibration))


def read_calibration_file(path: Path) -> CameraCalibration:
    """The calibration of a ``calibration.json``, or of the folder that holds one; its views have no residuals.

    Raises:
        InputError: it cannot be read, or is no such file: what was expected, and found.
    """
    return _read(path / CALIBRATION if path.is_dir() else path, None)


def find_calibration(given: str) -> CameraCalibration | None:
    """The calibration that sfmapp has written in what a user gives for a camera, as :func:`read_calibration_file` reads
    it; None where that is another program's file, or parameters.

    Raises:
        InputError: it cannot be read.
    """
    path = Path(given) / CALIBRATION if Path(given).is_dir() else Path(given)
    if path.suffix.lower() != ".json" or not path.is_file():
        return None
    fields = read_json_object(path)
    return _read(path, fields) if fields.get("format") == FORMAT else None


def read_given_camera(given: str) -> tuple[GivenCameras, CameraCalibration | None]:
    """The cameras of what a user gives for one, read once, and with it what sfmapp knows of its own: how sure it is.

    Raises:
        InputError: the file cannot be read, or holds no camera.
        UsageError: neither a file nor a camera.
    """
    calibration = find_calibration(given)
    if calibration is None:
        return read_given_cameras(given), None
    camera = CalibratedCamera(calibration.camera)
    return GivenCameras(given, {"": lambda _: camera}), calibration


def covariance_at(calibration: CameraCalibration, root: str, photograph: Photograph) -> NDArray[np.float64]:
    """(P, P) covariance of the camera's parameters in the pixels of a photograph that it took, which may be smaller or
    turned against those that it was calibrated with.

    Args:
        root: folder of the photograph.

    Raises:
        InputError: a photograph of another shape.
    """
    camera = calibration.camera

    def params_of(params: NDArray[np.float64]) -> NDArray[np.float64]:
        one = CalibratedCamera(camera.with_params(params))
        return GivenCameras("camera", {"": lambda _: one}).of_photographs(root, [photograph])[0].camera.params

    # scaling and turning are affine, so that differences of any size are their slopes
    steps = np.where(calibration.sigmas > 0.0, calibration.sigmas, 1e-3)
    middle = params_of(camera.params)
    slopes = np.stack(
        [(params_of(camera.params + step) - middle) / step.sum() for step in np.diag(steps)], axis=1
    )  # fmt: skip
    found: NDArray[np.float64] = slopes @ calibration.covariance @ slopes.T
    return found


def _read(path: Path, fields: Mapping[str, Any] | None) -> CameraCalibration:
    document = read_document(
        path, CalibrationDocument, FORMAT, "a calibration that sfmapp has written",
        "give OUT or OUT/calibration.json of sfmapp calibrate: other files do not say how sure they are", fields,
    )  # fmt: skip
    camera = checked_camera(path, 0, document.model, document.width, document.height, document.params)
    num = len(camera.params)
    frame = document.frame_covariance
    distances = document.distances
    if distances is not None and not (len(distances) == 3 and np.isfinite(distances).all() and min(distances) > 0):
        raise InputError(f"{path}: distances: expected three numbers above zero, found {distances}")
    return CameraCalibration(
        camera=camera,
        covariance=_covariance(f"{path}: covariance", document.covariance, num),
        method=document.method,
        noise_px=document.noise_px,
        degrees_of_freedom=document.degrees_of_freedom,
        views=tuple(_read_view(f"{path}: {view.name}", view) for view in document.views),
        frame_covariance=None if frame is None else _covariance(f"{path}: frame_covariance", frame, num + 6),
        distances=None if distances is None else (distances[0], distances[1], distances[2]),
        warnings=tuple(document.warnings),
    )


def _read_view(place: str, view: CalibrationView) -> ViewFit:
    pose = None if view.cam_from_target is None else np.array(view.cam_from_target, np.float64)
    if pose is not None and (pose.shape != (7,) or not np.isfinite(pose).all()):
        raise InputError(f"{place}: expected a pose of seven numbers, found {view.cam_from_target}")
    nothing = np.zeros((0, 2))
    return ViewFit(view.name, pose, nothing, nothing, np.zeros(0, np.bool_), view.problem)


def _covariance(place: str, value: Sequence[Sequence[float]], num: int) -> NDArray[np.float64]:
    rows = [len(row) for row in value]
    matrix = np.array(value, np.float64) if rows == [num] * num else np.full((num, num), np.nan)
    if not np.isfinite(matrix).all() or not np.allclose(matrix, matrix.T, rtol=1e-6, atol=0.0):
        raise InputError(f"{place}: expected {num} x {num} finite numbers, symmetric, found {str(value)[:80]}")
    # of the correlations: parameters have units that are many powers of ten apart
    scale = np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    values = np.linalg.eigvalsh(matrix / scale[:, None] / scale[None, :])
    if (np.diag(matrix) < 0).any() or values[0] < -_ROUNDING * num:
        raise InputError(f"{place}: expected a covariance, found one with a negative variance")
    return matrix
