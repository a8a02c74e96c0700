"""What moves otherwise than a plane that most matches of a pair lie on.

Something flat that is in every picture and no part of the scene, such as a poster, the bonnet of a car or the wall
behind a turntable, can win the search for one epipolar geometry: a plane leaves two degrees of freedom, which fit some
of the other matches by chance. The matches that the plane leaves over then have a geometry of their own.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.fundamental_refinement import polish_fundamental
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.search import Ransac, find_fundamental, is_significant, plane_of_matches

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Share of the inliers of the epipolar geometry that must lie on the plane: below it the plane did not choose it.
PLANE_SHARE = 0.5
# Of the matches off the plane the second geometry must explain so many times as many as the first does. The right
# geometry of a plane with relief explains nearly all that another one can.
_MIN_GAIN = 1.25
# Fewer, as a share of those on the plane, may be anything that moves through a flat scene.
_MIN_SHARE = 0.15


def has_second_motion(
    xy1: Array,
    xy2: Array,
    inlier_f: Mask,
    threshold: float,
    extent: tuple[float, float],
    options: MatchingOptions,
    ransac: Ransac,
) -> bool:
    """Whether a plane has chosen the epipolar geometry of matches that on the whole have another."""
    _, inlier_h = plane_of_matches(xy1, xy2, inlier_f, threshold, ransac, PLANE_SHARE)
    return geometry_off_plane(xy1, xy2, inlier_f, inlier_h, threshold, extent, options, ransac) is not None


def geometry_off_plane(
    xy1: Array,
    xy2: Array,
    inlier_f: Mask,
    inlier_h: Mask,
    threshold: float,
    extent: tuple[float, float],
    options: MatchingOptions,
    ransac: Ransac,
) -> Array | None:
    """The epipolar geometry of the matches that a plane leaves over, if they move otherwise.

    Args:
        xy1, xy2: (N, 2) float64 matched pixels.
        inlier_f: (N,) bool, those that the epipolar geometry found first explains; inlier_h: those on the plane.
        threshold, extent: as of :func:`is_significant`.

    Returns:
        F (3, 3), or None.
    """
    on_plane = int(inlier_h.sum())
    if on_plane <= PLANE_SHARE * inlier_f.sum():
        return None
    rest = np.flatnonzero(~inlier_h)
    needed = max(options.min_inliers, _MIN_GAIN * inlier_f[rest].sum(), _MIN_SHARE * on_plane)
    if len(rest) < needed:
        return None
    a, b = xy1[rest], xy2[rest]
    found = find_fundamental(a, b, threshold, ransac, needed / len(rest))
    if found is None:
        return None
    fundamental, explained = polish_fundamental(found, a, b, threshold, ransac.seed)
    if explained.sum() < needed or not is_significant(explained, threshold, extent):
        return None
    return fundamental
