"""Square markers of OpenCV's dictionaries."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import UsageError


@cache
def dictionary_of(name: str) -> Any:
    """A predefined dictionary of ``cv2.aruco`` by its name, such as ``DICT_4X4_50``. Raises UsageError without one."""
    import cv2

    known = {entry.upper(): entry for entry in dir(cv2.aruco) if entry.startswith("DICT_")}
    if name.upper() not in known:
        raise UsageError(f"dictionary of markers is {name!r}, expected one of {', '.join(sorted(known))}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, known[name.upper()]))


def marker_bits(dictionary: str, number: int, border: int) -> NDArray[np.bool_]:
    """(N, N) cells of a marker with a border of so many cells, True for white. Raises UsageError if it has none."""
    known = dictionary_of(dictionary)
    if not 0 <= number < len(known.bytesList):
        raise UsageError(f"{dictionary} has {len(known.bytesList)} markers, the board needs more than {number}")
    side = known.markerSize + 2 * border
    found: NDArray[np.bool_] = known.generateImageMarker(number, side, borderBits=border) > 127
    return found
