"""A rig as a rerun recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr

from sfmapp.geometry import rigid3
from sfmapp.images.image_set import ImageRecord
from sfmapp.images.pixels import read_gray
from sfmapp.viewer.calibration_rrd import ENLARGED, SHOWN_PX
from sfmapp.viewer.rig_replay import RigReplay
from sfmapp.viewer.rrd_file import recording_file

# of the cameras in turn: the board as each of them has it; they lie on each other where the shot was of one moment
_COLORS = ((74, 127, 212), (230, 150, 40), (42, 157, 74), (150, 90, 200))
_USED, _LEFT_OUT = (42, 157, 74), (209, 55, 44)


def write_rig_rrd(replay: RigReplay, output: Path) -> None:
    """Write the cameras where they sit, and shot by shot the board as each camera has it, with the photographs and
    their residuals, fifty times as long."""
    with recording_file(output, "sfmapp_calibrate_rig", replay.title) as recording:
        recording.log("/", rr.ViewCoordinates.RDF, static=True)
        for c, name in enumerate(replay.names):
            _log_camera(recording, replay, c, name)
        for shot in np.unique(replay.shot).tolist():
            recording.set_time("shot", sequence=shot)
            views = np.flatnonzero(replay.shot == shot)
            absent = set(range(len(replay.names))) - set(replay.camera[views].tolist())
            for c in absent:
                recording.log(f"boards/{replay.names[c]}", rr.Clear(recursive=True))
                recording.log(f"rig/{replay.names[c]}/seen", rr.Clear(recursive=True))
            for c in sorted(set(replay.camera[views].tolist())):
                _log_views(recording, replay, c, views[replay.camera[views] == c])


def _scale(replay: RigReplay, camera: int) -> float:
    return min(1.0, SHOWN_PX / float(replay.sizes[camera].max()))


def _log_camera(recording: rr.RecordingStream, replay: RigReplay, camera: int, name: str) -> None:
    scale, rig_from_cam = _scale(replay, camera), rigid3.inverse(replay.cam_from_rig[camera])
    width, height = (round(float(side) * scale) for side in replay.sizes[camera])
    recording.log(
        f"rig/{name}", rr.Transform3D(translation=rig_from_cam[4:], quaternion=rr.Quaternion(xyzw=rig_from_cam[:4])),
        rr.Pinhole(
            focal_length=(replay.focals[camera] * scale).tolist(),
            principal_point=(replay.centers[camera] * scale).tolist(), width=width, height=height,
            image_plane_distance=0.05,
        ),
        static=True,
    )  # fmt: skip


def _log_views(recording: rr.RecordingStream, replay: RigReplay, camera: int, views: np.ndarray) -> None:
    """The boards that a camera sees in a shot, and its photograph."""
    import cv2

    name, scale = replay.names[camera], _scale(replay, camera)
    problem = next((replay.problems[v] for v in views if replay.problems[v]), "")
    color = _LEFT_OUT if problem else _COLORS[camera % len(_COLORS)]
    outlines = [np.concatenate([replay.corners[v], replay.corners[v][:1]]) for v in views]
    recording.log(f"boards/{name}", rr.LineStrips3D(outlines, colors=[color] * len(outlines), radii=-2.0))
    path = replay.paths[views[0]]
    if path:
        width, height = (int(side) for side in replay.sizes[camera])
        gray = read_gray(ImageRecord(Path(path).name, Path(path), width, height))
        size = (round(width * scale), round(height * scale))
        photograph = rr.Image(cv2.resize(gray, size, interpolation=cv2.INTER_AREA))
        recording.log(f"rig/{name}/seen/photograph", photograph)
    rows = np.concatenate([np.arange(replay.ptr[v], replay.ptr[v + 1]) for v in views])
    xy, residuals = replay.xy[rows] * scale, np.nan_to_num(replay.residuals[rows]) * scale
    colors = np.where(replay.is_used[rows, None], [_USED], [_LEFT_OUT]).astype(np.uint8)
    recording.log(f"rig/{name}/seen/points", rr.Points2D(xy, colors=colors, radii=2.0))
    arrows = rr.Arrows2D(origins=xy, vectors=ENLARGED * residuals, colors=colors)
    recording.log(f"rig/{name}/seen/residuals", arrows)
    if problem:
        recording.log("odd", rr.TextLog(problem, level="WARN"))
