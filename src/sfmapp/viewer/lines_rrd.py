"""Lines of photographs as a rerun recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from sfmapp.images.image_set import ImageRecord
from sfmapp.images.pixels import read_gray
from sfmapp.viewer.calibration_rrd import log_camera
from sfmapp.viewer.lines_replay import LinesReplay
from sfmapp.viewer.rrd_file import recording_file

# of the directions, in their order, as on the page; lines of none are grey
_COLORS = np.array([(229, 60, 50), (60, 180, 75), (50, 110, 240), (240, 170, 20), (180, 60, 210), (20, 190, 200)])
_NO_DIRECTION = (150, 150, 150)
# planes of so many lines of each direction are drawn, the longest: they are in the order of their length
_MOST_PLANES = 12
# how far from the camera planes reach and arrows, in its picture's distance
_REACH, _ARROW = 3.0, 2.0


def write_lines_rrd(replay: LinesReplay, output: Path) -> None:
    """Write, photograph by photograph, its lines in the colours of their directions, the planes of the longest through
    the camera's centre, and the directions that these planes share."""
    with recording_file(output, "sfmapp_calibrate", replay.title) as recording:
        scale = log_camera(recording, replay, image_plane_distance=1.0)
        for v in range(len(replay.names)):
            recording.set_time("photograph", sequence=v)
            _log_photograph(recording, replay, v, scale)


def _log_photograph(recording: rr.RecordingStream, replay: LinesReplay, v: int, scale: float) -> None:
    import cv2

    width, height = (int(side) for side in replay.size)
    gray = read_gray(ImageRecord(replay.names[v], Path(replay.paths[v]), width, height))
    size = (round(width * scale), round(height * scale))
    recording.log("camera/photograph", rr.Image(cv2.resize(gray, size, interpolation=cv2.INTER_AREA)))
    own = slice(int(replay.ptr[v]), int(replay.ptr[v + 1]))
    member, colors = replay.member[own], _colors(replay.member[own])
    recording.log("camera/lines", rr.LineStrips2D(list(replay.points[own] * scale), colors=colors, radii=1.0))
    directions = replay.directions[int(replay.direction_ptr[v]) : int(replay.direction_ptr[v + 1])]
    # a direction has two ends: the one in front of the camera is where its lines vanish in the picture
    directions = directions * np.where(directions[:, 2:] < 0.0, -1.0, 1.0)
    counts = np.bincount(member[member >= 0], minlength=len(directions))
    recording.log(
        "directions",
        rr.Arrows3D(
            origins=np.zeros_like(directions), vectors=_ARROW * directions, colors=_colors(np.arange(len(directions))),
            labels=[f"{count} lines" for count in counts],
        ),
    )  # fmt: skip
    for k in range(len(_COLORS)):
        mine = np.flatnonzero(member == k)[:_MOST_PLANES]
        rays = _REACH * replay.rays[own][mine]
        known = np.isfinite(rays).all((1, 2))
        recording.log(f"planes/{k}", _fan(rays[known], (*_COLORS[k].tolist(), 60)))


def _fan(rays: NDArray[np.float64], color: tuple[int, ...]) -> rr.Mesh3D:
    """Triangles from the camera's centre to the ends (N, 2, 3) of lines."""
    corners = np.concatenate([np.zeros((len(rays), 1, 3)), rays], 1).reshape(-1, 3)
    triangles = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
    colors = np.broadcast_to(np.array(color, np.uint8), (len(corners), 4))
    return rr.Mesh3D(vertex_positions=corners, triangle_indices=triangles, vertex_colors=colors)


def _colors(member: NDArray[np.int64]) -> NDArray[np.uint8]:
    """(N, 3) of directions; -1 for none."""
    colors = np.where(member[:, None] < 0, np.array(_NO_DIRECTION), _COLORS[member % len(_COLORS)])
    return colors.astype(np.uint8)
