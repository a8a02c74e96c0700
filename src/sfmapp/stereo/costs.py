"""What two pixels of a rectified pair cost when they are taken for one: census, ZNCC, absolute or squared differences.

Pictures are laid out as the kernels of :mod:`sfmapp.stereo.window_kernels` read them: the right one is mirrored, so
that rising disparities are neighbours in memory, and goes on beyond its sides with the colour of its border.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.stereo.options import CostName

Number = TypeVar("Number", np.int32, np.float32)
# the numbers by which kernels know them
CENSUS, ZNCC, SAD, SSD = range(4)
NUMBERS: dict[CostName, int] = {"census": CENSUS, "zncc": ZNCC, "sad": SAD, "ssd": SSD}
# the census looks at every other pixel of a window of 9 x 7, as on a chessboard: as good as all 62 at half the work
CENSUS_HALF_WIDTH, CENSUS_HALF_HEIGHT, CENSUS_BITS = 4, 3, 31
# the greatest mean cost of a window: bits, 1 - correlation, grey values, their squares
GREATEST: dict[CostName, float] = {"census": float(CENSUS_BITS), "zncc": 2.0, "sad": 255.0, "ssd": 65025.0}
# grey values are counted from the middle, so that products stay small
_MIDDLE = 128
# what has no texture correlates with nothing: the variance that a picture's rounding alone has, in grey values squared
_ROUNDING = 1.0 / 12.0


class Planes(NamedTuple):
    """Both pictures as the kernels read them.

    Attributes:
        left: (H, B + W + B) int32 words of the census, or grey values minus 128.
        right: (H, P + W + P') int32, mirrored: pixel x lies at column P + W - 1 - x; what is beyond is the border's,
            as on the left.
        left_mean, left_scale: (N, H, W) float32 mean and reciprocal standard deviation of each window's grey values,
            for ZNCC; (1, 1, 1) otherwise.
        right_mean, right_scale: the same of the right picture, laid out as it is.
    """

    left: NDArray[np.int32]
    right: NDArray[np.int32]
    left_mean: NDArray[np.float32]
    left_scale: NDArray[np.float32]
    right_mean: NDArray[np.float32]
    right_scale: NDArray[np.float32]


def planes_of(
    left: NDArray[np.uint8], right: NDArray[np.uint8], cost: CostName, sides: Sequence[int], beyond: int,
    reach: tuple[int, int],
) -> Planes:  # fmt: skip
    """Prepare two grey pictures.

    Args:
        left, right: (H, W) uint8.
        cost: of two pixels, or of two windows for ZNCC.
        sides: of the windows, pixels, odd.
        beyond: columns that are needed beyond either side of the left picture.
        reach: columns that are needed beyond the right picture's right and left side.
    """
    nothing = np.zeros((1, 1, 1), np.float32)
    if cost == "census":
        words = [census(picture).view(np.int32) for picture in (left, right)]
        return Planes(_widened(words[0], beyond), mirrored(words[1], reach), nothing, nothing, nothing, nothing)
    grey = [picture.astype(np.int32) - _MIDDLE for picture in (left, right)]
    shaped = mirrored(grey[1], reach)
    if cost != "zncc":
        return Planes(_widened(grey[0], beyond), shaped, nothing, nothing, nothing, nothing)
    means, scales = zip(*(_moments(picture, sides) for picture in grey), strict=True)
    there = [np.stack([mirrored(plane, reach) for plane in planes[1]]) for planes in (means, scales)]
    return Planes(_widened(grey[0], beyond), shaped, means[0], scales[0], there[0], there[1])


def _widened(picture: NDArray[np.int32], beyond: int) -> NDArray[np.int32]:
    return np.pad(picture, ((0, 0), (beyond, beyond)), mode="edge")


def mirrored(picture: NDArray[Number], reach: tuple[int, int]) -> NDArray[Number]:
    """(H, reach[0] + W + reach[1]) of (H, W): columns in reverse, the outermost repeated on both sides."""
    return np.ascontiguousarray(np.pad(picture[:, ::-1], ((0, 0), reach), mode="edge"))


def _moments(grey: NDArray[np.int32], sides: Sequence[int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    import cv2

    values, means, scales = grey.astype(np.float32), [], []
    for side in sides:
        box = (side, side)
        mean = cv2.boxFilter(values, cv2.CV_64F, box, borderType=cv2.BORDER_REPLICATE)
        square = cv2.boxFilter(values * values, cv2.CV_64F, box, borderType=cv2.BORDER_REPLICATE)
        means.append(mean.astype(np.float32))
        scales.append((1.0 / np.sqrt(np.maximum(square - mean * mean, 0.0) + _ROUNDING)).astype(np.float32))
    return np.stack(means), np.stack(scales)


def census(gray: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Census words (H, W) of a grey picture: a bit for each neighbour that is brighter than the pixel.

    Zabih and Woodfill, ECCV 1994. The neighbours are every other pixel of a window of 9 x 7; those beyond the picture
    are the nearest ones inside.
    """
    padded = np.pad(gray, ((CENSUS_HALF_HEIGHT,) * 2, (CENSUS_HALF_WIDTH,) * 2), mode="edge")
    words = np.zeros(gray.shape, np.uint32)
    _census(padded, words)
    return words


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _census(padded: NDArray[np.uint8], words: NDArray[np.uint32]) -> None:
    height, width = words.shape
    for y in range(height):
        for dy in range(2 * CENSUS_HALF_HEIGHT + 1):
            for dx in range(2 * CENSUS_HALF_WIDTH + 1):
                if (dy + dx + CENSUS_HALF_HEIGHT + CENSUS_HALF_WIDTH) % 2:
                    for x in range(width):
                        here = padded[y + CENSUS_HALF_HEIGHT, x + CENSUS_HALF_WIDTH]
                        words[y, x] = (words[y, x] << np.uint32(1)) | np.uint32(padded[y + dy, x + dx] > here)
