"""How sharp a frame is, as far as that can be told from itself, and whether it shows anything.

Sharpness is the strength of differences between neighbouring pixels beside that of differences over a distance of
several pixels, in both directions. The latter are what the scene and its light make; blur takes from the former.
Frames of different scenes are not comparable by it, nor are those far apart: it is used between neighbours alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]

# Frames are followed at this many pixels along the longer side.
FOLLOWED_SIDE_PX = 640
_ROWS_BETWEEN = 4  # of so many rows and columns one is looked at
# A frame with less standard deviation than this, in grey levels, shows nothing.
_MIN_DEVIATION, _BLACK, _WHITE = 3.0, 24.0, 250
# Share of pixels that are white in one that is over-exposed: little else is left to see.
_MAX_WHITE = 0.6


class Look(NamedTuple):
    """What a frame is worth by itself.

    Attributes:
        small: (H, W) uint8 at the size at which it is followed.
        sharpness: greater for the sharper one of frames that show the same.
        fault: why it shows nothing; empty if it does.
    """

    small: Pixels
    sharpness: float
    fault: str


def look_at(gray: Pixels) -> Look:
    """Reduce a frame (H, W), and judge it."""
    import cv2

    factor = FOLLOWED_SIDE_PX / max(gray.shape)
    small = np.ascontiguousarray(gray)
    if factor < 1:
        size = (max(round(gray.shape[1] * factor), 1), max(round(gray.shape[0] * factor), 1))
        small = np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_AREA), np.uint8)
    mean, deviation = float(small.mean()), float(small.std())
    if deviation < _MIN_DEVIATION:
        return Look(small, 0.0, "black" if mean < _BLACK else "without contrast")
    if float((small >= _WHITE).mean()) > _MAX_WHITE:
        return Look(small, 0.0, "over-exposed")
    return Look(small, _sharpness(gray, small), "")


def _sharpness(gray: Pixels, small: Pixels) -> float:
    import cv2

    coarse = cv2.resize(small, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    across, down = gray[::_ROWS_BETWEEN], gray[:, ::_ROWS_BETWEEN]
    fine = _energy(across[:, 1:], across[:, :-1]) * _energy(down[1:], down[:-1])
    scene = _energy(coarse[:, 1:], coarse[:, :-1]) * _energy(coarse[1:], coarse[:-1])
    return float((fine / max(scene, 1e-12)) ** 0.25)


def _energy(first: Pixels, second: Pixels) -> float:
    difference = first.astype(np.int16) - second
    return float(np.mean(np.square(difference, dtype=np.int32)))
