"""The focal length of two photographs of which nothing is known: what their F tells, and how sure that is."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.self_calibration import focals_from_matches
from sfmapp.twoview.view import View

Array = NDArray[np.float64]

# of the longer side: how far a principal point may be from the middle
_CENTER_SHARE = 0.01
# What a lens with distortion does to it comes on top: over 46 pairs of three sets, whose noise and principal points ask
# for 0.3 to 18 per cent, errors were up to 4 per cent where these ask for less than one.
_LENS_SHARE = 0.02
# one that is no surer than this is left as it was
_MOST_SHARE = 0.15


def with_told_focal(views: tuple[View, View], matches: NDArray[np.int32], fundamental: Array) -> tuple[View, View]:
    """The views with the focal length that F tells them, if nothing else is known of it and F tells it.

    Args:
        matches: (V, 2) verified. fundamental: (3, 3) of them; NaN without one.
    """
    cameras = [view.camera for view in views]
    first, second = cameras
    size = max(first.width, first.height)
    is_one = (first.width, first.height, first.focal) == (second.width, second.height, second.focal)
    if not is_one or any(c.focal_source != "default" for c in cameras) or not np.isfinite(fundamental).all():
        return views
    xy1, xy2 = (np.ascontiguousarray(view.xy[matches[:, side]]) for side, view in enumerate(views))
    center = first.canonical[2:4]

    def told(moved: Array) -> tuple[float, float] | None:
        found = focals_from_matches(xy1, xy2, moved, moved, size, fundamental=fundamental)
        return None if found is None else (math.log(found.focals[0]), float(found.covariance[0, 0]))

    middle = told(center)
    if middle is None:
        return views
    variance = middle[1] + _LENS_SHARE**2
    for step in _CENTER_SHARE * size * np.eye(2):
        ahead, back = told(center + step), told(center - step)
        if ahead is None or back is None:
            return views
        variance += (0.5 * (ahead[0] - back[0])) ** 2 + (0.5 * (ahead[0] + back[0]) - middle[0]) ** 2
    if variance > _MOST_SHARE**2:
        return views
    focal = math.exp(middle[0])
    camera = replace(
        first.with_focal(focal), focal_sigma=focal * math.sqrt(variance), focal_source="photographs"
    )  # fmt: skip
    return replace(views[0], camera=camera), replace(views[1], camera=camera)
