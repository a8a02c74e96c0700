"""Pose and focal length from points of one plane in one photograph, whatever the radial distortion of its lens.

Distortion moves a pixel along the line from the centre of the picture, and so does a change of the focal length: the
direction from the centre tells the rotation and two parts of the translation alone (Tsai, "A versatile camera
calibration technique for high-accuracy 3D machine vision metrology using off-the-shelf TV cameras and lenses", IEEE
Journal of Robotics and Automation 3(4), 1987, the case of a plane).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.dlt import homogeneous, normalizing

Array = NDArray[np.float64]

MIN_POINTS = 5
"""Five unknowns up to scale, an equation each."""


@dataclass(frozen=True)
class PlaneView:
    """A plane in front of a camera with square pixels.

    Attributes:
        rotation: (3, 3) camera from plane, whose points have z = 0. translation: (3,).
        focal_px: without regard to the distortion.
        misfit: mean squared error of the linear equations of focal length and depth, to rank solutions by.
    """

    rotation: Array
    translation: Array
    focal_px: float
    misfit: float

    @property
    def tilt_deg(self) -> float:
        """Between the plane's normal and the optical axis. A plane that is seen frontally, at 0, does not tell the
        focal length: twice of it at twice the distance is the same picture."""
        return float(np.degrees(np.arccos(min(abs(self.rotation[2, 2]), 1.0))))


def views_of_plane(plane_xy: Array, centered_xy: Array) -> list[PlaneView]:
    """The views that agree with the directions in which points are seen, the one that fits best first; none of points
    on a line, or where no focal length fits.

    Args:
        plane_xy: (N, 2) in the plane, N >= 5. centered_xy: (N, 2) pixels from the principal point.
    """
    of_plane = normalizing(plane_xy)
    points = homogeneous(plane_xy) @ of_plane.T
    u, v = centered_xy.T
    # v (r11 x + r12 y + tx) = u (r21 x + r22 y + ty); Tsai divides by ty, which the axis in the plane y = 0 makes zero
    rows = np.concatenate([v[:, None] * points, -u[:, None] * points], 1) / max(
        float(np.abs(centered_xy).max()), 1e-300
    )
    _, values, vt = np.linalg.svd(rows)
    if len(values) < 5 or not values[4] > 1e-12 * values[0]:
        return []
    upper = vt[5].reshape(2, 3) @ of_plane
    found = []
    for sign in (1.0, -1.0):
        for rotation, shift in _rotations(sign * upper):
            found += _with_depth(rotation, shift, plane_xy, centered_xy)
    return sorted(found, key=lambda view: view.misfit)


def _rotations(upper: Array) -> list[tuple[Array, Array]]:
    """Rotations (3, 3) whose first rows begin as two rows (2, 2) do, up to a common factor, and (tx, ty) by it."""
    a, b = upper[0, :2], upper[1, :2]
    aa, bb, ab = a @ a, b @ b, a @ b
    # the rest of both rows closes their lengths and their right angle: (q - aa)(q - bb) = ab^2 for the squared factor q
    q = 0.5 * (aa + bb + np.sqrt((aa - bb) ** 2 + 4.0 * ab**2))
    if not q > 0.0:
        return []
    first, second = np.sqrt(np.maximum([1.0 - aa / q, 1.0 - bb / q], 0.0))
    second *= -np.sign(ab) if ab else 1.0
    found = []
    for turn in (1.0, -1.0):
        rows = np.array([[*a / np.sqrt(q), turn * first], [*b / np.sqrt(q), turn * second]])
        u, _, vt = np.linalg.svd(np.vstack([rows, np.cross(*rows)]))
        found.append((u @ vt, upper[:, 2] / np.sqrt(q)))
    return found


def _with_depth(rotation: Array, shift: Array, plane_xy: Array, centered_xy: Array) -> list[PlaneView]:
    """Focal length and depth by f p - (u, v) tz = (u, v) w, with p and w what rotation and shift make of the points."""
    p = plane_xy @ rotation[:2, :2].T + shift
    w = plane_xy @ rotation[2, :2]
    rows = np.stack([p.ravel(), -centered_xy.ravel()], 1)
    right = (centered_xy * w[:, None]).ravel()
    scale = np.linalg.norm(rows, axis=0)
    if not (scale > 0.0).all():
        return []
    solution, _, rank, _ = np.linalg.lstsq(rows / scale, right, rcond=None)
    focal, depth = solution / scale
    if rank < 2 or not (focal > 0.0 and (w + depth > 0.0).all()):
        return []
    misfit = float((((rows @ [focal, depth] - right).reshape(-1, 2) / (w + depth)[:, None]) ** 2).mean())
    return [PlaneView(rotation, np.append(shift, depth), float(focal), misfit)]
