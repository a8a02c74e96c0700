"""The files that every way to calibrate ends in."""

from __future__ import annotations

from pathlib import Path

from sfmapp.calibration.file import write_calibration
from sfmapp.calibration.report import CameraFileReport
from sfmapp.calibration.result import CameraCalibration
from sfmapp.camera_files.writing import write_camera_files

CALIBRATION = "calibration.json"


def write_camera(folder: Path, calibration: CameraCalibration, name: str = "camera") -> list[CameraFileReport]:
    """Write ``calibration.json`` and the same camera for other programs beside it; each of these is read back.

    Args:
        name: of the camera, in the files that have names.

    Raises:
        InputError: the folder cannot be written.
    """
    write_calibration(folder / CALIBRATION, calibration)
    written = write_camera_files(folder, calibration.camera, name)
    return [
        CameraFileReport(name=one.name, program=one.program, max_px=one.max_px, reason=one.reason) for one in written
    ]
