"""Objects cut out of single photographs by GrabCut (Rother, Kolmogorov and Blake, 2004; OpenCV's), from a rough mask or
a rectangle: colours of both sides are learned anew in each photograph, and neighbours that look alike stay together.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]
Mask = NDArray[np.bool_]

# longer side of what is cut, pixels: it decides what belongs together, edges are refined in the full picture
_LONGEST = 400
_ROUNDS = 3
# around a mask, of the longer side, the object may go on; twice as much beyond that tells the background
_PAD = 0.06
# a mask is sure this many pixels of the small picture inside its outline
_SURE_PX = 2


def cut_by_mask(picture: Pixels, mask: Mask) -> Mask:
    """(H, W) the object in a photograph (H, W, 3), by a mask (H, W) that is right well inside and nearly so outside."""
    import cv2

    small, rough = _shrunk(picture, mask)
    rows, columns = np.nonzero(rough)
    if not len(rows):
        return mask
    labels = np.full(rough.shape, cv2.GC_BGD, np.uint8)
    pad = int(_PAD * max(rough.shape))
    labels[_span(rows, pad), _span(columns, pad)] = cv2.GC_PR_BGD
    labels[rough] = cv2.GC_PR_FGD
    labels[cv2.erode(rough.astype(np.uint8), np.ones((2 * _SURE_PX + 1,) * 2, np.uint8)) > 0] = cv2.GC_FGD
    return _cut(small, labels, (_span(rows, 3 * pad), _span(columns, 3 * pad)), mask)


def cut_by_rectangle(picture: Pixels, rectangle: tuple[int, int, int, int]) -> Mask:
    """(H, W) the object in a photograph (H, W, 3) of which nothing lies beyond a rectangle (left, top, right, bottom),
    pixels."""
    import cv2

    within = np.zeros(picture.shape[:2], bool)
    within[rectangle[1] : rectangle[3], rectangle[0] : rectangle[2]] = True
    small, inner = _shrunk(picture, within)
    labels = np.where(inner, cv2.GC_PR_FGD, cv2.GC_BGD).astype(np.uint8)
    return _cut(small, labels, (slice(None), slice(None)), within)


def cut_by_labels(small: Pixels, rough: Mask, *, surely: Mask, never: Mask, size: tuple[int, int]) -> Mask:
    """(H, W), by ``size``, the object in a small picture (h, w, 3), about where a mask (h, w) says, surely in a second
    and never in a third one."""
    import cv2

    labels = np.where(rough, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[surely] = cv2.GC_FGD
    labels[never] = cv2.GC_BGD
    otherwise = np.asarray(cv2.resize(rough.astype(np.uint8), size[::-1], interpolation=cv2.INTER_NEAREST) > 0)
    return _cut(small, labels, (slice(None), slice(None)), otherwise)


def shrunk_picture(picture: Pixels) -> Pixels:
    """A picture (H, W, 3) as small as it is cut."""
    import cv2

    return np.asarray(cv2.resize(picture, _shrunk_size(picture.shape), interpolation=cv2.INTER_AREA), np.uint8)


def _shrunk_size(shape: tuple[int, ...]) -> tuple[int, int]:
    scale = min(1.0, _LONGEST / max(shape[:2]))
    return max(1, round(shape[1] * scale)), max(1, round(shape[0] * scale))


def _shrunk(picture: Pixels, mask: Mask) -> tuple[Pixels, Mask]:
    import cv2

    size = _shrunk_size(mask.shape)
    small = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return shrunk_picture(picture), np.asarray(small > 0.5)


def _span(places: NDArray[np.int64], pad: int) -> slice:
    return slice(max(int(places.min()) - pad, 0), int(places.max()) + pad + 1)


def _cut(small: Pixels, labels: Pixels, where: tuple[slice, slice], otherwise: Mask) -> Mask:
    """The cut of a part of a small picture, in the size of a mask (H, W), which is kept where one side has nothing."""
    import cv2

    part = np.ascontiguousarray(labels[where])
    is_object = (part == cv2.GC_FGD) | (part == cv2.GC_PR_FGD)
    if is_object.all() or not is_object.any():
        return otherwise
    # its clusters are drawn: the same in every thread and call
    cv2.setRNGSeed(0)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(np.ascontiguousarray(small[where]), part, None, *models, _ROUNDS, cv2.GC_INIT_WITH_MASK)
    found = np.zeros(labels.shape, np.float32)
    found[where] = part & 1
    return np.asarray(cv2.resize(found, otherwise.shape[::-1], interpolation=cv2.INTER_LINEAR) > 0.5)
