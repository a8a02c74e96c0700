"""Photographs of circles once more, with the centres that a camera gives them."""

from __future__ import annotations

from dataclasses import replace

from sfmapp.calibration.adjustment import TargetView
from sfmapp.calibration.circle_centers import recentered
from sfmapp.camera.camera import Camera
from sfmapp.pipelines.calibration.pictures import BoardPictures


def with_disk_centers(pictures: BoardPictures, camera: Camera) -> BoardPictures | None:
    """Photographs of a board whose disks have their centres by a camera, distortion and perspective; None where the
    board has no disks."""
    board = pictures.board
    seen = [n for n, one in enumerate(pictures.pictures) if one.unused is None and one.detection.disks is not None]
    if not seen:
        return None
    found = [pictures.pictures[n].detection for n in seen]
    views = [TargetView("", board.points[one.idx], one.xy) for one in found]
    centers = recentered(views, [one.disks for one in found if one.disks is not None], camera)
    every = list(pictures.pictures)
    for n, one, xy in zip(seen, found, centers, strict=True):
        every[n] = replace(every[n], detection=replace(one, xy=xy))
    return replace(pictures, pictures=tuple(every))
