"""Whether two pictures show one surface from the same side.

Three neighbouring points of an opaque surface go round the same way in every picture of it. A picture that shows its
mirror image has them the other way round, and so has one that would have to be taken from behind: both obey the
epipolar geometry of planes all the same, as a mirrored plane is the plane seen from its back. Points at different
depths may change sides, which makes noise, but no bias (the sidedness constraint of Ferrari, Tuytelaars and Van Gool,
"Simultaneous object recognition and segmentation by image exploration", ECCV 2004, for neighbours).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Fewer points make triangles of hulls alone.
_MIN_POINTS = 4


def triangles_kept(xy1: NDArray[np.float64], xy2: NDArray[np.float64]) -> tuple[int, int]:
    """How many Delaunay triangles of points in one picture go round the same way in another, and how many there are.

    Args:
        xy1, xy2: (N, 2) pixels of the same points.
    """
    from scipy.spatial import Delaunay, QhullError

    if len(xy1) < _MIN_POINTS:
        return 0, 0
    try:
        corners = Delaunay(xy1).simplices
    except QhullError:  # all on a line
        return 0, 0
    first, second = _doubled_areas(xy1[corners]), _doubled_areas(xy2[corners])
    sides = np.sign(first) * np.sign(second)  # 0 where three points are one, or on a line
    return int((sides > 0).sum()), int((sides != 0).sum())


def _doubled_areas(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signed, of triangles (T, 3, 2)."""
    (a, b), (c, d) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    areas: NDArray[np.float64] = a * d - b * c
    return areas
