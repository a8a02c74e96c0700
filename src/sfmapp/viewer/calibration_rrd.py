"""A calibration as a rerun recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr

from sfmapp.images.image_set import ImageRecord
from sfmapp.images.pixels import read_gray
from sfmapp.viewer.calibration_replay import CalibrationReplay
from sfmapp.viewer.lines_replay import LinesReplay
from sfmapp.viewer.rrd_file import recording_file

SHOWN_PX = 1024
ENLARGED = 50.0


def write_calibration_rrd(replay: CalibrationReplay, output: Path) -> None:
    """Write boards in front of the camera, one more a step, and each photograph with its residuals, fifty times as
    long."""
    import cv2

    with recording_file(output, "sfmapp_calibrate", replay.title) as recording:
        width, height = (int(side) for side in replay.size)
        scale = log_camera(recording, replay)
        for v, name in enumerate(replay.names):
            recording.set_time("view", sequence=v)
            own = slice(int(replay.ptr[v]), int(replay.ptr[v + 1]))
            closed = np.concatenate([replay.corners[v], replay.corners[v][:1]])
            recording.log(f"boards/{v:03d}", rr.LineStrips3D([closed], colors=[(74, 127, 212)], labels=[name]))
            recording.log("now", rr.LineStrips3D([closed], colors=[(209, 55, 44)], radii=-3.0))
            if replay.paths[v]:
                path = Path(replay.paths[v])
                gray = read_gray(ImageRecord(name, path, width, height))
                size = (round(width * scale), round(height * scale))
                recording.log("camera/photograph", rr.Image(cv2.resize(gray, size, interpolation=cv2.INTER_AREA)))
            xy, residuals, used = replay.xy[own] * scale, replay.residuals[own] * scale, replay.is_used[own]
            colors = np.where(used[:, None], [[42, 157, 74]], [[209, 55, 44]]).astype(np.uint8)
            recording.log("camera/points", rr.Points2D(xy, colors=colors, radii=2.0))
            known = np.nan_to_num(residuals)
            recording.log("camera/residuals", rr.Arrows2D(origins=xy, vectors=ENLARGED * known, colors=colors))
            rms = float(np.sqrt((known[used] ** 2).sum(1).mean())) / scale if used.any() else 0.0
            recording.log("plots/rms_px", rr.Scalars(rms))


def log_camera(
    recording: rr.RecordingStream, replay: CalibrationReplay | LinesReplay, image_plane_distance: float | None = None
) -> float:
    """The camera that was calibrated, at the origin; returns the factor of its pixels."""
    width, height = replay.size
    scale = min(1.0, SHOWN_PX / float(max(width, height)))
    recording.log("/", rr.ViewCoordinates.RDF, static=True)
    recording.log(
        "camera",
        rr.Pinhole(
            focal_length=(replay.focal * scale).tolist(), principal_point=(replay.center * scale).tolist(),
            width=round(width * scale), height=round(height * scale), image_plane_distance=image_plane_distance,
        ),
        static=True,
    )  # fmt: skip
    return scale
