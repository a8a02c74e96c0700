"""From the clouds of a model without a calibration to ``recording.rrd``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sfmapp.uncalibrated.clouds import Clouds, boxed
from sfmapp.viewer.recording import RecordingReport, record_in_child
from sfmapp.viewer.uncalibrated_replay import CloudsReplay


def record_clouds(path: Path, clouds: Clouds, title: str) -> RecordingReport:
    """Write a recording in a child process; never raises for what happens there."""
    none = np.zeros((0, 3))
    metric, centers = (none, none) if clouds.metric is None else boxed(clouds.metric, clouds.centers)
    replay = CloudsReplay(
        title, boxed(clouds.found, none)[0], boxed(clouds.mapped, none)[0], metric, clouds.rgb, centers
    )
    return record_in_child(path, "clouds", lambda _: replay, timeout_s=120.0)
