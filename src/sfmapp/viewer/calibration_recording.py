"""From a calibration to ``recording.rrd``: boards in front of the camera, and what is left on each photograph."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.result import CameraCalibration
from sfmapp.geometry import rigid3
from sfmapp.viewer.calibration_replay import CalibrationReplay
from sfmapp.viewer.recording import RecordingReport, record_in_child

Array = NDArray[np.float64]


def record_calibration(
    path: Path, made: CameraCalibration, outline: Array, photographs: dict[str, str], title: str
) -> RecordingReport:
    """Write a recording in a child process; never raises for what happens there.

    Args:
        outline: (4, 3) corners of the board in its frame.
        photographs: files by name of the view.
    """
    views = [view for view in made.views if view.cam_from_target is not None]
    ptr = np.concatenate([[0], np.cumsum([len(view.xy) for view in views])]).astype(np.int64)
    canonical = made.camera.canonical
    poses = np.array([view.cam_from_target for view in views]).reshape(-1, 7)
    replay = CalibrationReplay(
        title=title,
        names=[view.name for view in views],
        size=np.array([made.camera.width, made.camera.height], np.float64),
        focal=canonical[:2],
        center=canonical[2:4],
        ptr=ptr,
        xy=np.concatenate([view.xy for view in views]) if views else np.zeros((0, 2)),
        residuals=np.concatenate([view.residuals for view in views]) if views else np.zeros((0, 2)),
        is_used=np.concatenate([view.is_used for view in views]) if views else np.zeros(0, np.bool_),
        corners=np.array([rigid3.apply(pose, outline) for pose in poses]).reshape(-1, 4, 3),
        paths=[photographs.get(view.name, "") for view in views],
    )
    return record_in_child(path, "calibration", lambda _: replay)
