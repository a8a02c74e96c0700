"""Which way is up, judged from how photographs are taken."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3


def up_direction(cam_from_world: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """(3,) unit vector that was probably up when the photographs (I, 7), NaN allowed, were taken.

    People hold cameras level: up is the direction most nearly perpendicular to the horizontal axes of all images
    (Szeliski, "Image alignment and stitching", 2006, section 5), on the side of their tops. Where the cameras all look
    the same way, or were held both upright and across, the mean of the tops has to do. If the tops point all around
    and the sides of the images do not, the pictures lie on their sides.
    """
    if cam_from_world is None or np.isnan(cam_from_world[:, 0]).all():
        return np.array([0.0, -1.0, 0.0])
    rotation = rigid3.rotation_matrix(cam_from_world[~np.isnan(cam_from_world[:, 0])])
    upright, across = -rotation[:, 1], rotation[:, 0]
    # how far the axes leave one line, as a mean squared sine: 0.2 for 100 degrees around an object
    spread, axes = _principal_axes(across)
    if _principal_axes(upright)[0][1] > 0.2 and spread[1] < 0.05:
        # which side is up cannot be seen, but people look down on things more often than up at them
        axis = axes[:, 2] if rotation[:, 2].sum(0) @ axes[:, 2] <= 0 else -axes[:, 2]
        upright, across = across * np.sign(across @ axis)[:, None], upright
    mean = upright.mean(0)
    length = float(np.linalg.norm(mean))
    top = mean / length if length > 1e-6 else np.array([0.0, -1.0, 0.0])
    values, vectors = _principal_axes(across)
    level = vectors[:, 0] * (1.0 if vectors[:, 0] @ top >= 0 else -1.0)
    # the plane of the horizontal axes is known once they turn by some 15 degrees: sin(15 deg)^2 = 0.07
    is_clear = values[1] > 0.07 and values[1] > 4 * values[0]
    return level if is_clear and level @ top > np.cos(np.radians(30)) else top


def _principal_axes(axes: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Eigenvalues (3,), ascending, of sum 1, and eigenvectors (columns) of the mean outer product of N unit vectors."""
    values, vectors = np.linalg.eigh(axes.T @ axes / len(axes))
    return values, vectors
