"""The four corners of a rectangle in a photograph: of one marker, or of four that stand at its corners."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.marker_points import find_markers
from sfmapp.errors import InputError, UsageError

Array = NDArray[np.float64]

_IDS_SHOWN = 12


def corners_of_markers(gray: NDArray[np.uint8], dictionary: str, ids: Sequence[int], name: str) -> Array:
    """(4, 2) pixels, clockwise from the top left: the corners of a marker, or of four the outermost ones.

    Args:
        gray: (H, W). dictionary: of ``cv2.aruco``.
        ids: one marker; or four, that at the top left, top right, bottom right and bottom left of the rectangle, each
            upright or not: of its corners the one farthest from the middle of the four counts.
        name: of the photograph, for messages.

    Raises:
        UsageError: another number of ids, one twice, or no such dictionary.
        InputError: a marker that is not found, or is found more than once.
    """
    if len(ids) not in (1, 4) or len(set(ids)) < len(ids):
        raise UsageError(
            f"markers {', '.join(map(str, ids))}: expected one, or four different ones at the corners of a rectangle",
            "--marker 7, or --marker 0,1,2,3 from the top left clockwise",
        )
    markers = find_markers(gray, dictionary)
    seen = sorted(number for number, _ in markers)
    for number in ids:
        count = seen.count(number)
        if count != 1:
            others = ", ".join(map(str, seen[:_IDS_SHOWN])) + (", ..." if len(seen) > _IDS_SHOWN else "")
            found = f"found it {count} times" if count else f"found {f'markers {others}' if seen else 'no marker'}"
            advice = (
                "take a photograph with one of them, or give --corners"
                if count
                else "check the id and the dictionary, and that its white margin is free, sharp and lit; or --corners"
            )
            raise InputError(f"{name}: expected marker {number} of {dictionary} once, {found}", advice)
    places = dict(markers)
    if len(ids) == 1:
        return places[ids[0]]
    middle = np.mean([places[number].mean(0) for number in ids], axis=0)
    farthest = [
        places[number][np.linalg.norm(places[number] - middle, axis=1).argmax()] for number in ids
    ]  # fmt: skip
    return np.array(farthest)
