"""Cameras that are mounted together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rig:
    """Cameras that are mounted rigidly together. The rig's frame is that of its first camera.

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

    @property
    def second_is_left(self) -> bool:
        """Of two cameras side by side, the second stands to the left of the first as that one sees it."""
        x, y, _ = rigid3.center(self.cam_from_rig[1])
        return bool(abs(x) >= abs(y) and x < 0.0)

    def reversed_pair(self) -> Rig:
        """Two cameras in the other order, in the frame of the second."""
        first, second = self.cameras
        return Rig((second, first), np.array([rigid3.IDENTITY, rigid3.inverse(self.cam_from_rig[1])]))


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

    @property
    def is_mounted(self) -> NDArray[np.bool_]:
        """(I,) bool: on a rig, with a pose that differs from the rig's."""
        moved: NDArray[np.bool_] = (self.cam_from_rig != rigid3.IDENTITY).any(1)
        return (self.frame_idx >= 0) & moved[self.sensor_idx]

    def rig_from_world(self, cam_from_world: Array) -> Array:
        """Poses (F, 7) of the rig at each frame from those of the images (I, 7), NaN for unregistered ones.

        The registered image with the lowest sensor speaks for its frame: an exact copy where that is sensor 0. NaN
        where there is none.
        """
        images = np.flatnonzero((self.frame_idx >= 0) & ~np.isnan(cam_from_world[:, 0]))
        images = images[np.lexsort((self.sensor_idx[images], self.frame_idx[images]))]
        frames, first = np.unique(self.frame_idx[images], return_index=True)
        images = images[first]
        out = np.full((int(self.frame_idx.max(initial=-1)) + 1, 7), np.nan)
        out[frames] = cam_from_world[images]
        away = self.is_mounted[images]
        mount = self.cam_from_rig[self.sensor_idx[images[away]]]
        out[frames[away]] = rigid3.compose(rigid3.inverse(mount), cam_from_world[images[away]])
        return out

    def cam_from_world(self, images: NDArray[np.integer], rig_from_world: Array) -> Array:
        """Poses (N, 7) of images (N,) of the rig from those of the rig (N, 7) when they were taken."""
        out = np.array(rig_from_world, np.float64)
        away = self.is_mounted[images]
        out[away] = rigid3.compose(self.cam_from_rig[self.sensor_idx[images[away]]], out[away])
        return out
