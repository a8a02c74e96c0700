"""How sharp and how well exposed a picture is, whatever it shows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# Crete's window: wide enough to blur anything sharp, narrow enough to leave what is blurred as it is
_REACH_PX = 11
# grey levels from which on, or up to which, a pixel tells nothing: JPEG's ringing is within
_WHITE, _BLACK = 250, 5


class PictureQuality(NamedTuple):
    """What can be said of a picture without another one beside it.

    Attributes:
        blur: 0 sharp to 1 blurred, the worse of rows and columns. Good photographs have 0.15 to 0.4, the same again
            and again within a set; NaN of a picture without any edge.
        white, black: shares of the pixels that are burnt out, and that are black.
    """

    blur: float
    white: float
    black: float


def picture_quality(gray: NDArray[np.uint8]) -> PictureQuality:
    """Blur and exposure of grey values (H, W) uint8.

    Blur after Crete, Dolmiere, Ladret and Nicolas, "The blur effect: perception and estimation with a new no-reference
    perceptual blur metric", SPIE 2007: a picture that is blurred once more loses most of its differences between
    neighbours if it was sharp, and few if it was not. Noise counts as sharp.
    """
    share = gray.size or 1
    white, black = int((gray >= _WHITE).sum()) / share, int((gray <= _BLACK).sum()) / share
    return PictureQuality(float(np.fmax(_blur(gray, 1), _blur(gray, 0))), white, black)


def _blur(gray: NDArray[np.uint8], axis: int) -> float:
    """The share of the differences along an axis that is left by one more blur along it; NaN where there are none."""
    import cv2

    values = gray.astype(np.float32)
    window = (_REACH_PX, 1) if axis == 1 else (1, _REACH_PX)
    before = np.abs(np.diff(values, axis=axis))
    after = np.abs(np.diff(cv2.blur(values, window), axis=axis))
    total = float(before.sum())
    return 1.0 - float(np.maximum(before - after, 0.0).sum()) / total if total > 0.0 else float("nan")
