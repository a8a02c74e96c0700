"""How far matched pixels of two calibrated cameras are from their epipolar geometry, whatever the lenses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, pixels_to_rays
from sfmapp.geometry import epipolar

Array = NDArray[np.float64]

# Pixels to both sides over which rays are differenced: lenses are smooth over more than that.
_STEP_PX = 0.5


def epipolar_errors(cameras: tuple[Camera, Camera], cam2_from_cam1: Array, xy1: Array, xy2: Array) -> Array:
    """(N,) signed errors, pixels: how far the measured pixels (N, 2) of both have to move, together, for their rays to
    meet.

    Sampson's distance (HZ 11.9) with the derivatives of the rays by the pixels, so it is of pixels as they were
    measured and of any lens; of pinhole cameras it is the usual one. NaN where a lens has no inverse.
    """
    essential = epipolar.essential_from_pose(cam2_from_cam1)
    rays = [pixels_to_rays(camera, xy) for camera, xy in zip(cameras, (xy1, xy2), strict=True)]
    lines = (rays[1] @ essential, rays[0] @ essential.T)
    square = np.zeros(len(xy1))
    for camera, xy, line in zip(cameras, (xy1, xy2), lines, strict=True):
        for step in _STEP_PX * np.eye(2):
            ahead, behind = pixels_to_rays(camera, xy + step), pixels_to_rays(camera, xy - step)
            square += ((line * (ahead - behind)).sum(1) / (2.0 * _STEP_PX)) ** 2
    algebraic = (rays[1] * (rays[0] @ essential.T)).sum(1)
    found: Array = algebraic / np.sqrt(np.maximum(square, 1e-300))
    return found
