"""Corners of markers with known places, found in a photograph."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.markers import dictionary_of

Array = NDArray[np.float64]


def find_marker_points(
    gray: NDArray[np.uint8], dictionary: str, places: Mapping[int, Array]
) -> tuple[list[str], Array, Array, list[int]]:
    """Names (``ID/CORNER``), places (N, 3) and pixels (N, 2) of the corners of markers in a picture (H, W), and the ids
    of those that were found without a known place. A marker that is seen twice is left out: one of the two is none.

    Args:
        dictionary: of ``cv2.aruco``. places: by id, (4, 3) corners clockwise from the marker's own top left.

    Raises:
        UsageError: no such dictionary.
    """
    markers = find_markers(gray, dictionary)
    seen = [number for number, _ in markers]
    names, xyz, xy = list[str](), [np.zeros((0, 3))], [np.zeros((0, 2))]
    for number, corners in markers:
        if number in places and seen.count(number) == 1:
            names += [f"{number}/{corner}" for corner in range(4)]
            xyz.append(places[number])
            xy.append(corners)
    return names, np.concatenate(xyz), np.concatenate(xy), sorted(set(seen) - set(places))


def find_markers(gray: NDArray[np.uint8], dictionary: str) -> list[tuple[int, Array]]:
    """Markers in a picture (H, W): id, and pixels (4, 2) of the corners clockwise from the marker's own top left.

    Raises:
        UsageError: no such dictionary.
    """
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary_of(dictionary), parameters).detectMarkers(gray)
    numbers = [] if ids is None else [int(number) for number in np.ravel(ids)]
    # OpenCV puts the centre of a pixel at its index
    return [
        (number, np.asarray(found, np.float64).reshape(4, 2) + 0.5)
        for number, found in zip(numbers, corners, strict=False)
    ]
