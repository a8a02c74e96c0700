"""Photographs of a board once more, with the points that a camera gives them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.adjustment import TargetView
from sfmapp.calibration.bent_edges import edge_courses, measured_along_edges
from sfmapp.calibration.circle_centers import recentered
from sfmapp.calibration.detection import window_of
from sfmapp.camera.camera import Camera
from sfmapp.pipelines.calibration.pictures import BoardPictures

# pixels by which an edge leaves its tangent in the window: a crossing is off by a quarter of it, a hundredth of a
# pixel, which the best photographs do not measure
_LEAST_BEND_PX = 0.04


def with_points_by(camera: Camera, pictures: BoardPictures, threads: int) -> BoardPictures | None:
    """Photographs of a board with the points that a camera gives them: centres of disks by distortion and perspective,
    crossings along their edges, as the lens bends them. None where that changes nothing.

    Args:
        camera: of these photographs. pictures: as they were found. threads: that read them again.
    """
    seen = [n for n, one in enumerate(pictures.pictures) if one.unused is None]
    board = pictures.board
    found = [pictures.pictures[n].detection for n in seen]
    views = [TargetView("", board.points[one.idx], one.xy) for one in found]
    if window_of(board) is None:
        marks = [one.disks for one in found if one.disks is not None]
        points: list[NDArray[np.float64]] | None = recentered(views, marks, camera) if views else None
    else:
        points = _along_edges(camera, pictures, views, seen, threads)
    if points is None:
        return None
    every = list(pictures.pictures)
    for n, one, xy in zip(seen, found, points, strict=True):
        every[n] = replace(every[n], detection=replace(one, xy=xy))
    return replace(pictures, pictures=tuple(every))


def _along_edges(
    camera: Camera, pictures: BoardPictures, views: list[TargetView], seen: list[int], threads: int
) -> list[NDArray[np.float64]] | None:
    """Crossings of the pictures seen, read again; None where all edges are straight in their windows."""
    window = window_of(pictures.board)
    assert window is not None
    courses = edge_courses(views, camera, window)
    if max((course.largest_bend_px(window) for course in courses), default=0.0) < _LEAST_BEND_PX:
        return None

    def again(k: int) -> NDArray[np.float64]:
        read = pictures.pictures[seen[k]].read
        return views[k].xy if read is None else measured_along_edges(read(), views[k].xy, courses[k], window)

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(again, range(len(views))))
