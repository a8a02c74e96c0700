"""EXIF orientations (CIPA DC-008, tag 274): how the pixels of a file are turned to be looked at.

Models count in the pixels of the file, as other programs read them; only what is shown to people is turned. Four of the
eight orientations, 2, 4, 5 and 7, also mirror. No camera does that, so the world of a model of such files is itself a
mirror image, and beside it a picture is only turned (:data:`ROTATION_OF`).
"""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

MIRRORED: Final = frozenset({2, 4, 5, 7})
ROTATION_OF: Final = MappingProxyType({1: 1, 2: 1, 3: 3, 4: 3, 5: 6, 6: 6, 7: 8, 8: 8})
"""Of each orientation its rotation, without the mirror, which is then one from left to right."""
INVERSE: Final = MappingProxyType({1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6})

# x and y of the upright picture in those of the file, but for a shift
_UPRIGHT_FROM_STORED: Final = MappingProxyType(
    {
        1: ((1, 0), (0, 1)), 2: ((-1, 0), (0, 1)), 3: ((-1, 0), (0, -1)), 4: ((1, 0), (0, -1)),
        5: ((0, 1), (1, 0)), 6: ((0, -1), (1, 0)), 7: ((0, -1), (-1, 0)), 8: ((0, 1), (-1, 0)),
    }
)  # fmt: skip


def is_sideways(orientation: int) -> bool:
    """Whether width and height change places."""
    return orientation >= 5


def upright_size(orientation: int, width: int, height: int) -> tuple[int, int]:
    """Width and height of the upright picture, from those of the file."""
    return (height, width) if is_sideways(orientation) else (width, height)


def upright_pixels(pixels: Any, orientation: int) -> Any:
    """Pixels (H, W, ...) of a file as they are looked at; the same array for orientation 1."""
    if orientation == 1:
        return pixels
    if is_sideways(orientation):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def upright_vectors(orientation: int, xy: ArrayLike) -> Array:
    """Directions (..., 2) in the file as the upright picture has them."""
    return np.asarray(xy, np.float64) @ np.array(_UPRIGHT_FROM_STORED[orientation], np.float64).T


def upright_xy(orientation: int, xy: ArrayLike, width: int, height: int) -> Array:
    """Places (..., 2) in a file of that size (the centre of its first pixel is 0.5) in the upright picture."""
    size = np.array([width, height], np.float64)
    middle = np.array(upright_size(orientation, width, height), np.float64) / 2.0
    return upright_vectors(orientation, np.asarray(xy, np.float64) - size / 2.0) + middle


def upright_pinhole(orientation: int, k: ArrayLike, width: int, height: int) -> Array:
    """(4,) fx, fy, cx, cy of a camera that is rolled until its picture is upright; its mirror, if any, stays."""
    fx, fy, cx, cy = np.asarray(k, np.float64)
    center = upright_xy(ROTATION_OF[orientation], [cx, cy], width, height)
    return np.array([fy, fx, *center]) if is_sideways(orientation) else np.array([fx, fy, *center])


def upright_poses(cam_from_world: ArrayLike, orientation: Sequence[int] | NDArray[np.integer]) -> Array:
    """Poses (..., I, 7), NaN allowed, of cameras that are rolled until their pictures are upright; see
    :func:`upright_pinhole`. ``orientation``: of the I images."""
    poses = np.array(cam_from_world, np.float64)
    for value in np.unique(np.asarray(orientation, np.int64)):
        if ROTATION_OF[int(value)] != 1:
            mine = np.asarray(orientation) == value
            roll = np.eye(3)
            roll[:2, :2] = _UPRIGHT_FROM_STORED[ROTATION_OF[int(value)]]
            poses[..., mine, :] = rigid3.compose(rigid3.from_matrix(roll, np.zeros(3)), poses[..., mine, :])
    return poses
