"""From lines in photographs to ``recording.rrd``: the lines, their projection planes, and where they vanish."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sfmapp.calibration.line_refinement import Lines
from sfmapp.camera.camera import Camera, pixels_to_rays
from sfmapp.viewer.lines_replay import LinesReplay
from sfmapp.viewer.recording import RecordingReport, record_in_child


def record_lines(
    path: Path, camera: Camera, photos: Sequence[Lines], files: Sequence[tuple[str, str]], title: str
) -> RecordingReport:
    """Write a recording in a child process; never raises for what happens there.

    Args:
        photos: V photographs with their lines.
        files: name and path of each.
    """
    points = np.concatenate([photo.arcs.points for photo in photos])
    ends = pixels_to_rays(camera, points[:, [0, -1]].reshape(-1, 2)).reshape(-1, 2, 3)
    directions = [np.zeros((0, 3)) if photo.world is None else photo.world.directions for photo in photos]
    canonical = camera.canonical
    replay = LinesReplay(
        title=title,
        names=[name for name, _ in files],
        paths=[file for _, file in files],
        size=np.array([camera.width, camera.height], np.float64),
        focal=canonical[:2],
        center=canonical[2:4],
        ptr=_ends_of([len(photo.arcs) for photo in photos]),
        points=points,
        member=np.concatenate([photo.member for photo in photos]).astype(np.int64),
        rays=ends,
        direction_ptr=_ends_of([len(one) for one in directions]),
        directions=np.concatenate(directions),
    )
    return record_in_child(path, "lines", lambda _: replay)


def _ends_of(counts: Sequence[int]) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
