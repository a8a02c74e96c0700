"""Cameras that are mounted together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.scene.camera import Camera


@dataclass(frozen=True)
class Rig:
    """Cameras and where they sit. The rig's frame is that of its first camera.

    Attributes:
        cameras: S intrinsics, one for each sensor.
        cam_from_rig: (S, 7) float64 poses; the first is the identity. Metres where the rig was calibrated in metres.
    """

    cameras: tuple[Camera, ...]
    cam_from_rig: NDArray[np.float64]

    @staticmethod
    def single(camera: Camera) -> Rig:
        """A rig of one camera."""
        return Rig((camera,), np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]]))

    @property
    def is_stereo(self) -> bool:
        """More than one camera: lengths are known."""
        return len(self.cameras) > 1


@dataclass(frozen=True)
class RigImages:
    """Which images of a reconstruction were taken together, by which sensor of one rig.

    Attributes:
        frame_idx: (I,) int32, images with the same number share one rig pose; -1 for an image that is on no rig.
        sensor_idx: (I,) int32, position in ``cam_from_rig``; 0 for an image on no rig.
        cam_from_rig: (S, 7) float64, known and constant; the first is the identity.
    """

    frame_idx: NDArray[np.int32]
    sensor_idx: NDArray[np.int32]
    cam_from_rig: NDArray[np.float64]
