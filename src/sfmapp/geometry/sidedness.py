"""Whether two pictures show one surface from the same side.

Three neighbouring points of an opaque surface go round the same way in every picture of it. A picture that shows its
mirror image has them the other way round, and so has one that would have to be taken from behind: both obey the
epipolar geometry of planes all the same, as a mirrored plane is the plane seen from its back. Points at different
depths may change sides, which makes noise, but no bias (the sidedness constraint of Ferrari, Tuytelaars and Van Gool,
"Simultaneous object recognition and segmentation by image exploration", ECCV 2004, for neighbours).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

# Fewer points make triangles of hulls alone.
_MIN_POINTS = 4


def triangles_kept(xy1: NDArray[np.float64], xy2: NDArray[np.float64]) -> tuple[int, int]:
    """How many Delaunay triangles of points in one picture go round the same way in another, and how many there are.

    Args:
        xy1, xy2: (N, 2) pixels of the same points.
    """
    if len(xy1) < _MIN_POINTS:
        return 0, 0
    corners = _triangles(xy1)
    first, second = _doubled_areas(xy1[corners]), _doubled_areas(xy2[corners])
    sides = np.sign(first) * np.sign(second)  # 0 where three points are one, or on a line
    return int((sides > 0).sum()), int((sides != 0).sum())


def _triangles(xy: NDArray[np.float64]) -> NDArray[np.int64]:
    """(T, 3) corners of the Delaunay triangles of points (N, 2); none where all lie on a line.

    By OpenCV, which is there: scipy.spatial takes 0.15 s and 30 MB to load, and twice as long for the triangles.
    """
    points = (xy - xy.min(axis=0) + 1.0).astype(np.float32)
    width, height = np.ceil(points.max(axis=0)).astype(int) + 2
    division = cv2.Subdiv2D((0, 0, int(width), int(height)))
    division.insert(points)
    found = np.asarray(division.getTriangleList(), np.float32).reshape(-1, 3, 2)
    # it gives corners by their coordinates, which it does not change: each a complex number, to look them up by
    known, corners = (np.ascontiguousarray(each).view(np.complex64)[..., 0] for each in (points, found))
    order = np.argsort(known, kind="stable")
    place = np.searchsorted(known[order], corners).clip(max=len(xy) - 1)
    is_known = (known[order[place]] == corners).all(axis=1)
    triangles: NDArray[np.int64] = order[place[is_known]]
    return triangles


def _doubled_areas(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signed, of triangles (T, 3, 2)."""
    (a, b), (c, d) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    areas: NDArray[np.float64] = a * d - b * c
    return areas
