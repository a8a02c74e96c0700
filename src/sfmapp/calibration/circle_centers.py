"""Where the centres of circles are in pictures, once a camera is known: the exact image of each disk.

The centre of mass of a disk's image is not the image of its centre (Heikkila, "Geometric camera calibration using
circular control points", PAMI 2000). Before anything is known of the camera, :func:`sfmapp.calibration.circles.
disk_bias` takes away what the points around tell of it, to the fourth order of the radius, which from 60 degrees on is
not enough. With a camera and poses the outline of each disk is projected, distortion and all, and its centre of mass
follows from Green's theorem; what that is off by is taken from the measured one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.adjustment import TargetView, observations_of, refine
from sfmapp.calibration.start import posed
from sfmapp.camera.camera import Camera, project
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

# Points of an outline: sums over a whole turn are exact up to harmonics of half as many.
_OUTLINE = 32


@dataclass(frozen=True)
class DiskMarks:
    """What was measured of N disks.

    Attributes:
        mass: (N, 2) centres of mass of their images, pixels, centres at halves.
        area: (N,) of these, square pixels.
    """

    mass: Array
    area: Array


def disk_images(camera: Camera, cam_from_board: Array, centers: Array, radius: float) -> tuple[Array, Array]:
    """Centres of mass (N, 2) and areas (N,) of the images of disks that lie in the plane of a board; NaN where the lens
    does not see one whole.

    Args:
        cam_from_board: (7,). centers: (N, 3) with z = 0 for a flat board. radius: in the unit of these.
    """
    angle = 2.0 * np.pi * np.arange(_OUTLINE) / _OUTLINE
    circle = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(_OUTLINE)], 1)
    outline = (centers[:, None] + circle).reshape(-1, 3)
    seen = project(camera, rigid3.apply(cam_from_board, outline)).reshape(len(centers), _OUTLINE, 2)
    middle = seen.mean(1, keepdims=True)
    x, y = np.moveaxis(seen - middle, 2, 0)
    # derivatives by the angle, of the series that goes through all points
    turns = 1j * np.fft.rfftfreq(_OUTLINE, 1.0 / _OUTLINE)
    turns[-1] = 0.0
    dx, dy = (np.fft.irfft(turns * np.fft.rfft(values, axis=1), _OUTLINE, axis=1) for values in (x, y))
    step = 2.0 * np.pi / _OUTLINE
    area = 0.5 * step * (x * dy - y * dx).sum(1)
    moment = np.stack([(x * x * dy).sum(1), -(y * y * dx).sum(1)], 1) * (0.5 * step)
    return middle[:, 0] + moment / area[:, None], np.abs(area)


def recentered(views: Sequence[TargetView], marks: Sequence[DiskMarks], camera: Camera) -> list[Array]:
    """Images (N, 2) of the centres of disks in V photographs, by a camera that is known and the poses that fit it.

    Args:
        views: with what was taken for these images so far. marks: of the same disks.

    The radius is that of all disks together: the median of what their areas say. A disk that the lens does not see
    whole keeps what it had.
    """
    placed = refine(posed(camera, views), observations_of(views), hold_camera=True)
    poses = placed.cam_from_target
    radius = 1e-3 * max(float(np.ptp(view.xyz, axis=0).max()) for view in views)
    for _ in range(2):
        sizes = [
            np.sqrt(mark.area / disk_images(camera, pose, view.xyz, radius)[1])
            for view, mark, pose in zip(views, marks, poses, strict=True)
        ]
        radius *= float(np.nanmedian(np.concatenate(sizes)))
    found = []
    for view, mark, pose in zip(views, marks, poses, strict=True):
        bias = disk_images(camera, pose, view.xyz, radius)[0] - project(camera, rigid3.apply(pose, view.xyz))
        found.append(np.where(np.isfinite(bias), mark.mass - bias, view.xy))
    return found
