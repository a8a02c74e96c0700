"""The files that every way to calibrate ends in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.file import CALIBRATION, write_calibration
from sfmapp.calibration.report import CameraFileReport
from sfmapp.calibration.result import CameraCalibration
from sfmapp.camera_files.writing import write_camera_files
from sfmapp.viewer.calibration_recording import record_calibration
from sfmapp.viewer.recording import RecordingReport
from sfmapp.workspace.job import FAILED, WRITTEN, Job


def write_recording(
    job: Job, made: CameraCalibration, outline: NDArray[np.float64], photographs: dict[str, str], title: str
) -> None:
    """Write ``recording.rrd``, or warn why there is none; arguments as of
    :func:`~sfmapp.viewer.calibration_recording.record_calibration`."""
    note_recording(job, record_calibration(job.workspace.recording, made, outline, photographs, title))


def note_recording(job: Job, told: RecordingReport) -> None:
    """Say in the manifest whether there is a recording; a failure is a warning."""
    job.workspace.note(recording=FAILED if told.problem else WRITTEN)
    if told.problem:
        job.events.warned("recording", f"no recording: {told.problem}")


def outline_of(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 3) corners of points (N, 3) of a board, in its plane z = 0."""
    low, high = points.min(0), points.max(0)
    return np.array([[low[0], low[1], 0.0], [high[0], low[1], 0.0], [high[0], high[1], 0.0], [low[0], high[1], 0.0]])


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
