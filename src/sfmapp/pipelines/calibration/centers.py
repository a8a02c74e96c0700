"""Photographs of a board once more, with the points that a camera gives them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfmapp.calibration.adjustment import TargetView
from sfmapp.calibration.bent_edges import unbent
from sfmapp.calibration.circle_centers import recentered
from sfmapp.calibration.detection import window_of
from sfmapp.camera.camera import Camera
from sfmapp.pipelines.calibration.pictures import BoardPictures

# pixels; less than the best photographs measure a crossing to by a factor of three
_LEAST_SHIFT = 0.01


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


def with_unbent_crossings(pictures: BoardPictures, camera: Camera) -> BoardPictures | None:
    """Photographs of a board whose crossings are freed of the bend of their edges by a camera; None where there are no
    crossings, or none is a hundredth of a pixel off. ``pictures``: as they were found, not freed before."""
    board = pictures.board
    window = window_of(board)
    if window is None:
        return None
    seen = [n for n, one in enumerate(pictures.pictures) if one.unused is None]
    found = [pictures.pictures[n].detection for n in seen]
    views = [TargetView("", board.points[one.idx], one.xy) for one in found]
    crossings = unbent(views, camera, board.spacing, *window)
    largest = max(float(np.abs(xy - one.xy).max()) for xy, one in zip(crossings, found, strict=True))
    if largest < _LEAST_SHIFT:
        return None
    every = list(pictures.pictures)
    for n, one, xy in zip(seen, found, crossings, strict=True):
        every[n] = replace(every[n], detection=replace(one, xy=xy))
    return replace(pictures, pictures=tuple(every))
