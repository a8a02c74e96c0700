"""Points of one frame, followed through those after it by the tracker of odometry."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfmapp.odometry.frontend.alignment import align_patches
from sfmapp.odometry.frontend.corners import find_corners
from sfmapp.odometry.frontend.pyramid import Pyramid
from sfmapp.odometry.frontend.small_image import align_small_images
from sfmapp.video.motion import Apart, incoherence, motion_between

Array = NDArray[np.float64]

_NUM_POINTS, _MIN_DISTANCE_PX = 300, 12.0
# Fewer tell nothing of a motion.
MIN_POINTS = 12
# Patches that look less alike are others (see ``odometry/frontend/active_tracks.py``).
_MIN_LIKENESS = 0.6
# A share of the points that has to be found in the next frame: less are chance.
_MIN_FOUND = 0.3
# Patches of unrelated pictures are found as well, wherever: from frame to frame, points move by less than this share of
# the longer side beside each other.
_MAX_INCOHERENCE = 0.03
# From frame to frame a point drifts; its patch in the first frame puts it back, from no farther than this.
_MAX_DRIFT_PX = 2.0
# Field of view of about 53 degrees, for the turn between two frames of which the tracker knows nothing else.
_FOCAL = 1.0


class Follower:
    """Points of a frame where they are in the last one that was followed.

    Attributes:
        first: pyramid of the frame that they were found in. last: of the last one in which they were.
        first_xy, xy: (N, 2) pixels of those that are left, there and here.
        num_found: points that there were. step: their median motion in the last frame, as a share of the longer side.
    """

    def __init__(self, first: Pyramid) -> None:
        self.first = self.last = first
        self.first_xy = find_corners(first, np.empty((0, 2)), _NUM_POINTS, min_distance_px=_MIN_DISTANCE_PX)
        self.xy = self.first_xy.copy()
        self.num_found, self.step = len(self.xy), 0.0

    @property
    def has_points(self) -> bool:
        """Whether there are enough to tell a motion."""
        return len(self.xy) >= MIN_POINTS

    @property
    def share_left(self) -> float:
        """Share of the points that are still followed."""
        return len(self.xy) / max(self.num_found, 1)

    def follow(self, frame: Pyramid) -> bool:
        """Find the points in another frame; False, and all stays as it was, where too few are found."""
        if not self.has_points:
            return False
        xy, found = self._found(frame, self.xy)
        if not self._are_enough(xy, found):
            turn = align_small_images(self.last, frame, _FOCAL * max(frame.shape))
            if turn is not None:
                xy, found = self._found(frame, _turned(self.xy, turn, frame.shape))
        if not self._are_enough(xy, found):
            return False
        before, self.first_xy = self.xy[found], self.first_xy[found]
        self.xy, self.last = self._without_drift(frame, xy[found]), frame
        self.step = float(np.median(np.linalg.norm(self.xy - before, axis=1))) / max(frame.shape)
        return True

    def _are_enough(self, xy: Array, found: NDArray[np.bool_]) -> bool:
        if int(found.sum()) < max(MIN_POINTS, _MIN_FOUND * len(found)):
            return False
        return incoherence(self.xy[found], xy[found], max(self.first.shape)) < _MAX_INCOHERENCE

    def _found(self, frame: Pyramid, guess: Array) -> tuple[Array, NDArray[np.bool_]]:
        at = align_patches(self.last, self.xy, frame, guess)
        height, width = frame.shape
        is_inside = ((at.xy >= 0) & (at.xy < (width, height))).all(axis=1)
        return at.xy, at.is_converged & (at.zncc > _MIN_LIKENESS) & is_inside

    def _without_drift(self, frame: Pyramid, xy: Array) -> Array:
        at = align_patches(self.first, self.first_xy, frame, xy, coarsest_level=0)
        is_near = np.linalg.norm(at.xy - xy, axis=1) < _MAX_DRIFT_PX
        is_same = at.is_converged & (at.zncc > _MIN_LIKENESS) & is_near
        return np.where(is_same[:, None], at.xy, xy)

    def apart(self) -> Apart:
        """How far the last frame is from the first."""
        if not self.has_points:
            return Apart(0.0, 1.0, 0.0)
        return motion_between(self.first_xy, self.xy, self.first.shape)


def _turned(xy: Array, rotation: Array, shape: tuple[int, int]) -> Array:
    """Where points (N, 2) are once the camera has turned."""
    focal, middle = _FOCAL * max(shape), np.array([shape[1], shape[0]]) / 2
    rays = np.column_stack([(xy - middle) / focal, np.ones(len(xy))]) @ rotation.T
    return np.ascontiguousarray(rays[:, :2] / np.maximum(rays[:, 2:], 0.1) * focal + middle)
