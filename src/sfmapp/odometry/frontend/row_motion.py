"""What a rolling shutter does to the points of one frame, by the motion from the frame before it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, project
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RowMotion:
    """A camera that moves steadily while it reads the rows of a frame.

    Attributes:
        readout: time from the first row to the last as a share of the time since the frame before; 0: all at once.
        step: (7,) the motion from that frame to this one, pose from pose.
    """

    readout: float = 0.0
    step: Array = field(default_factory=rigid3.IDENTITY.copy)

    def shift_px(self, camera: Camera, pose: Array, xyz: Array, xy: Array) -> Array:
        """(N, 2) how far points move in the image between the middle of the readout and their rows; zero where that is
        not known.

        Args:
            pose: (7,) cam_from_world of the frame. xyz: (N, 3) points in the world. xy: (N, 2) pixels where they are.
        """
        if not self.readout:
            return np.zeros_like(xy)
        before = rigid3.compose(rigid3.inverse(self.step), pose)
        here, there = (project(camera, rigid3.apply(p, xyz)) for p in (before, pose))
        return by_rows(camera, there - here, xy, self.readout)


def by_rows(camera: Camera, motion: Array, xy: Array, readout: float) -> Array:
    """(N, 2) of points at pixels (N, 2) that move so far (N, 2) in a time of which the readout is a share; zero where
    that is not finite."""
    shift = motion * (readout * (xy[:, 1] / camera.height - 0.5))[:, None]
    return np.where(np.isfinite(shift), shift, 0.0)
