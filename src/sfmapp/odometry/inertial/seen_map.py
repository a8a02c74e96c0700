"""What an inertial sensor is held against: a map as its images alone have it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.options import AdjustOptions
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SeenMap:
    """A map of one camera or rig as its images alone have it.

    Attributes:
        model: adjusted; image S k + s is that of sensor s at the k-th keyframe. Not changed.
        times_s: (K,) ascending, on the clock of the measurements or up to a second off, which is found.
        options: of its adjustment.
        noise_px: standard deviation of a pixel coordinate, were all errors independent: errors that tracks and images
            have in common make it larger than the residuals are (:mod:`sfmapp.odometry.map.covariance`).
        scale_sigma: relative standard deviation of its unit of length if that is the metre; None for an arbitrary one.
    """

    model: Reconstruction
    times_s: Array
    options: AdjustOptions
    noise_px: float
    scale_sigma: float | None = None

    @property
    def num_sensors(self) -> int:
        """S."""
        return len(self.model.image_names) // max(1, len(self.times_s))

    @property
    def poses(self) -> Array:
        """(K, 7) cam_from_map of the first camera."""
        return self.model.cam_from_world[:: self.num_sensors]

    @property
    def is_metric(self) -> bool:
        """Whether the unit of length is the metre."""
        return self.scale_sigma is not None
