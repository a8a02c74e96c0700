"""Photographs of one camera that stands still while the object turns: told by what the edges of the pictures show.

What is fine along an edge of the picture (light and distance change what is coarse) is the same in two photographs of
one place, and unlike in those of two. It is compared at a size at which a camera that was touched is none that moved.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]
Array = NDArray[np.float64]

# longer side of what is compared, pixels, the band along each edge of its shorter side, what a touch moves
# and what is coarse, pixels
_LONGEST, _BAND, _MOVED_PX, _COARSE_PX = 96, 0.08, 1.0, 5.0
# correlation from which on an edge shows the same: of still cameras 0.92 to 1.00 at noise of 2 to 5 levels and lamps
# that flicker by a tenth, of eleven sets whose cameras move 0.4 at most in the median pair
_ALIKE = 0.8
# an edge with less than this contrast tells nothing, levels
_CONTRAST = 3.0
# so many edges have to tell; all of them but one have to agree, for the object's stand may reach into one
_FEWEST_EDGES = 2
# the background of fewer photographs is not where most of them agree; and smaller groups are of a camera that moves on
# a little from one photograph to the next
_FEWEST, _LEAST_SHARE = 6, 0.15
# photographs that stand apart from all groups, at most
_APART = 0.1


def still_groups(pictures: Sequence[Pixels]) -> list[list[int]] | None:
    """Positions of photographs (H, W, 3) that show one background each, the largest group first.

    A camera may have stood in several places, such as at two heights. None if it moved: more than a tenth of the
    photographs belong to no group, or sizes differ.
    """
    if len(pictures) < _FEWEST or len({picture.shape for picture in pictures}) > 1:
        return None
    is_alike = alike(pictures)
    left, groups = np.ones(len(pictures), bool), []
    while left.any():
        partners = is_alike & left & left[:, None]
        middle = int(np.argmax(partners.sum(axis=1)))
        members = np.flatnonzero(partners[middle])
        if len(members) < max(_FEWEST, _LEAST_SHARE * len(pictures)):
            break
        groups.append(members.tolist())
        left[members] = False
    return groups if groups and left.sum() <= _APART * len(pictures) else None


def alike(pictures: Sequence[Pixels]) -> NDArray[np.bool_]:
    """(N, N) whether two photographs (H, W, 3) of one size show the same along their edges."""
    fine = [_fine(picture) for picture in pictures]
    height, width = fine[0].shape[:2]
    band = max(3, round(_BAND * min(height, width)))
    edges = (np.s_[:band], np.s_[height - band :], np.s_[:, :band], np.s_[:, width - band :])
    tells, agrees = (np.zeros((len(pictures),) * 2, np.int64) for _ in range(2))
    for edge in edges:
        values = np.stack([each[edge].ravel() for each in fine])
        values = values - values.mean(axis=1, keepdims=True)
        length = np.linalg.norm(values, axis=1)
        has_contrast = length > _CONTRAST * np.sqrt(values.shape[1])
        both = has_contrast & has_contrast[:, None]
        tells += both
        agrees += both & (values @ values.T > _ALIKE * np.outer(length, length))
    return np.asarray((tells >= _FEWEST_EDGES) & (agrees >= np.maximum(tells - 1, _FEWEST_EDGES)))


def _fine(picture: Pixels) -> NDArray[np.float32]:
    """(h, w, 3) what is fine in a small picture of a photograph."""
    import cv2

    scale = _LONGEST / max(picture.shape[:2])
    size = (max(8, round(picture.shape[1] * scale)), max(8, round(picture.shape[0] * scale)))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    small = cv2.GaussianBlur(small, (0, 0), _MOVED_PX)
    return np.asarray(small - cv2.GaussianBlur(small, (0, 0), _COARSE_PX))
