"""Where the crossings of a board are in pictures, once a camera is known: measured along edges that the lens bends.

A crossing is the point that its surroundings are symmetric about (:mod:`sfmapp.calibration.symmetry`). In a straight
window the middle of a chord is beside its bent edge, so the point moves to the inside of the bend, and what else is
drawn in the fields, markers above all, comes into it: by a hundredth of a pixel in most places, by two tenths where a
strong barrel distortion is strongest. That is no noise: all photographs have it in the same places, it passes for
distortion, and no residual shows it. With a camera and poses the window follows the board.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.adjustment import TargetView, observations_of, refine
from sfmapp.calibration.start import posed
from sfmapp.calibration.symmetry import symmetric_points
from sfmapp.camera.camera import Camera, project
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

# step of the differences that tell how an edge bends, of the window's reach
_STEP = 0.5


@dataclass(frozen=True)
class CrossingWindow:
    """What a crossing is measured in.

    Attributes:
        spacing: side of a field, in the unit of the board.
        reach: (2,) how far the window goes along the edges, and how far from the nearer of them, in fields.
        largest_px: half of the window at most, pixels.
    """

    spacing: float
    reach: Array
    largest_px: float


@dataclass(frozen=True)
class EdgeCourse:
    """How edges leave N crossings in a picture; NaN where the lens does not see them.

    Attributes:
        axes: (N, 2, 2) pixels along a field's two sides, rows.
        curves: (N, 3, 2) pixels that s^2, s t and t^2 add, s and t in fields along the two sides.
    """

    axes: Array
    curves: Array

    def largest_bend_px(self, window: CrossingWindow) -> float:
        """How far an edge is from its tangent where the window ends, pixels, at most."""
        lengths = np.linalg.norm(self.axes, axis=2)
        half = np.minimum(window.reach[0], window.largest_px / lengths)
        bend = np.linalg.norm(self.curves[:, ::2], axis=2) * half**2
        return float(np.nanmax(bend, initial=0.0))


def edge_courses(views: Sequence[TargetView], camera: Camera, window: CrossingWindow) -> list[EdgeCourse]:
    """The edges at all crossings of V views, by a camera that is known and the poses that fit it."""
    placed = refine(posed(camera, views), observations_of(views), hold_camera=True)
    return [
        edge_course(camera, pose, view.xyz, window)
        for view, pose in zip(views, placed.cam_from_target, strict=True)
    ]  # fmt: skip


def edge_course(camera: Camera, cam_from_board: Array, xyz: Array, window: CrossingWindow) -> EdgeCourse:
    """The edges at crossings xyz (N, 3) in the plane of a board that is at cam_from_board (7,)."""
    h = _STEP * float(window.reach[0])
    places = np.array([[0, 0], [h, 0], [-h, 0], [0, h], [0, -h], [h, h], [h, -h], [-h, h], [-h, -h]])
    offsets = window.spacing * np.concatenate([places, np.zeros((9, 1))], 1)
    with np.errstate(all="ignore"):
        o, e, w, n, s, ne, se, nw, sw = (project(camera, rigid3.apply(cam_from_board, xyz + one)) for one in offsets)
    axes = np.stack([e - w, n - s], 1) / (2.0 * h)
    curves = np.stack([0.5 * (e + w) - o, 0.25 * (ne - se - nw + sw), 0.5 * (n + s) - o], 1) / h**2
    return EdgeCourse(axes, curves)


def measured_along_edges(gray: Pixels, xy: Array, course: EdgeCourse, window: CrossingWindow) -> Array:
    """Crossings (N, 2) near pixels xy (N, 2) in a picture (H, W), centres at halves.

    A crossing whose surroundings the lens does not see, or that is not found again, keeps what it had.
    """
    is_seen = np.isfinite(np.concatenate([course.axes, course.curves], 1)).all((1, 2))
    found = np.empty((int(is_seen.sum()), 2))
    symmetric_points(
        gray, xy[is_seen] - 0.5, course.axes[is_seen], course.curves[is_seen], window.reach, window.largest_px, found
    )
    again = xy.copy()
    again[is_seen] = np.where(np.isfinite(found), found + 0.5, xy[is_seen])
    return again
