"""From the clouds of a model without a calibration to ``recording.rrd``."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

from sfmapp.uncalibrated.clouds import Clouds, boxed
from sfmapp.viewer.recording import RecordingReport, draw_in_child
from sfmapp.viewer.uncalibrated_replay import CloudsReplay


def record_clouds(path: Path, clouds: Clouds, title: str) -> RecordingReport:
    """Write a recording in a child process; never raises for what happens there."""
    start = time.monotonic()
    none = np.zeros((0, 3))
    metric, centers = (none, none) if clouds.metric is None else boxed(clouds.metric, clouds.centers)
    replay = CloudsReplay(
        title, boxed(clouds.found, none)[0], boxed(clouds.mapped, none)[0], metric, clouds.rgb, centers
    )
    try:
        with tempfile.TemporaryDirectory(prefix="recording-", dir=path.parent) as name:
            replay.save(Path(name))
            problem = draw_in_child("clouds", Path(name), path, 1, 120.0)
    except OSError as error:
        problem = error.strerror or str(error)
    size = path.stat().st_size if not problem else 0
    return RecordingReport(None if problem else path, size, time.monotonic() - start, problem)
