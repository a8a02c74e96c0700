"""What a smooth background looks like behind an object, told by what is around it: a sheet of paper, cloth, a wall.

A plane of light bent once, and what nearby pixels deviate from it, are the background of each photograph by itself, and
what fits it to the noise is background even where the colour is the object's elsewhere in the picture. An object is cut
anew with that known. Gaps through it show the background in their own light, with an edge all around.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.backgrounds import Mask, Pixels, without_specks
from sfmapp.carve.graph_cut import cut_by_labels, shrunk_picture

Picture = NDArray[np.float32]

_ROUNDS = 2
# pixels beside a mask that may be mixed, or the object's
_MARGIN = 7
# what is nearer than this share of the longer side tells the background, where there is none what is twice as far
_NEAR = 0.03
_DOUBLINGS = 4
# a background is smooth if this share of it fits within so many standard deviations over 3x3 pixels
_SMOOTH, _FITS = 0.8, 2.0
# the object is sure where it is farther from that than this, and no shadow, which leaves these shares of the light
_SURE = 4.0
_SHADES = (0.5, 1.1)
# gaps have at least this many pixels, and edges of so many standard deviations nearly all around
_LEAST_GAP_PX, _EDGE, _ALL_AROUND = 12, 4.0, 0.9
# in a gap colours and their spread are those of the background to within so many variances
_GAP_VARIANCES = 2.5


def cut_from_smooth(picture: Pixels, mask: Mask) -> Mask:
    """(H, W) the object in a photograph (H, W, 3), by a mask (H, W) that is about right and what is smooth around it.

    Where the background is not smooth the mask is returned as it is.
    """
    import cv2

    small = shrunk_picture(picture)
    color, size = small.astype(np.float32), small.shape[1::-1]
    found = np.asarray(cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5)
    for _ in range(_ROUNDS):
        free = ~_grown(found, _MARGIN)
        if np.count_nonzero(free) < 0.05 * free.size or not found.any():
            return mask
        bent = _bent_plane(color, free)
        background = bent + _spread_out(color - bent, free)
        sigma = max(1.0, 1.4826 * float(np.median(np.abs(color - background)[free])))
        away = cv2.blur((((color - background) / sigma) ** 2).mean(axis=-1), (3, 3))
        if np.mean(away[free] < _FITS**2) < _SMOOTH:
            return mask
        fits = cv2.morphologyEx((away < _FITS**2).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
        surely = ~_grown((away <= _SURE**2) | _is_shadow(color, background, sigma), 3)
        # what fits within the object may be a dent as grey: there an edge all around has to tell
        never = _touching(fits, ~found) & ~_grown(surely, 3)
        found = cut_by_labels(small, (found | surely) & ~never, surely=surely, never=never, size=size[::-1])
        found = without_specks(found)
    uneven = float(np.std(cv2.GaussianBlur((background - bent)[..., 1], (0, 0), 3.0)[free]))
    found = found & ~_gaps(color, found, background, sigma, uneven)
    full = cv2.resize(found.astype(np.float32), mask.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return without_specks(np.asarray(full > 0.5))


def _touching(mask: Mask, other: Mask) -> Mask:
    """The pieces of a mask that have something of another."""
    import cv2

    _, pieces = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    touched = np.unique(pieces[mask & other])
    return np.asarray(np.isin(pieces, touched[touched > 0]))


def _bent_plane(color: Picture, free: Mask) -> Picture:
    """(h, w, 3) polynomials of the second degree through the free pixels (h, w) of a picture (h, w, 3)."""
    height, width = free.shape
    y, x = np.mgrid[:height, :width].astype(np.float64)
    x, y = x / width - 0.5, y / height - 0.5
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    rows = basis[free]
    return np.asarray(basis @ np.linalg.solve(rows.T @ rows, rows.T @ color[free]), np.float32)


def _spread_out(values: Picture, free: Mask) -> Picture:
    """(h, w, 3) means of the free pixels (h, w) around each one, from farther where there are few near."""
    import cv2

    weight = free.astype(np.float32)
    sigma = _NEAR * max(free.shape)
    result = np.zeros_like(values)
    for k in reversed(range(_DOUBLINGS)):
        blur = (0, 0), sigma * 2**k
        share = cv2.GaussianBlur(weight, *blur, borderType=cv2.BORDER_REFLECT)[..., None]
        mean = cv2.GaussianBlur(values * weight[..., None], *blur, borderType=cv2.BORDER_REFLECT)
        mean /= np.maximum(share, 1e-6)
        near = np.clip(share / 0.05, 0.0, 1.0)
        result = near * mean + (1.0 - near) * result
    return np.asarray(result, np.float32)


def _is_shadow(color: Picture, background: Picture, sigma: float) -> Mask:
    """(h, w) where colours are the background's in less light."""
    shade, rest = _shade(color, background)
    return np.asarray((shade > _SHADES[0]) & (shade < _SHADES[1]) & (rest < (_FITS * sigma) ** 2))


def _shade(color: Picture, background: Picture) -> tuple[Picture, Picture]:
    """(h, w) share of the background's light, and mean squared deviation from it over 3x3 pixels."""
    import cv2

    shade = (color * background).sum(axis=-1) / ((background**2).sum(axis=-1) + 1.0)
    rest = ((color - shade[..., None] * background) ** 2).mean(axis=-1)
    return shade, np.asarray(cv2.blur(rest, (3, 3)))


def _gaps(color: Picture, mask: Mask, background: Picture, sigma: float, uneven: float) -> Mask:
    """(h, w) what in a mask (h, w) looks like the background seen through a gap.

    Args:
        uneven: by how many levels the background deviates from a bent plane: by so much it may be unknown in a gap.
    """
    import cv2

    shade, rest = _shade(color, background)
    level = max(1.0, float(background.mean()))
    bright = np.abs(cv2.blur(shade, (3, 3)) - 1.0) < 3.0 * (uneven + sigma / 3.0) / level
    spread = (cv2.blur(color**2, (3, 3)) - cv2.blur(color, (3, 3)) ** 2).mean(axis=-1)
    most = _GAP_VARIANCES * sigma**2
    num, pieces, facts, _ = cv2.connectedComponentsWithStats(
        (mask & bright & (rest < most) & (spread < most)).astype(np.uint8), connectivity=4
    )
    slopes = [np.abs(cv2.Sobel(color, cv2.CV_32F, *way, scale=0.125)).max(axis=-1) for way in ((1, 0), (0, 1))]
    is_edge = _grown(np.maximum(*slopes) > _EDGE * sigma, 3)
    found = np.zeros_like(mask)
    for piece in range(1, num):
        left, top, width, height, area = (int(value) for value in facts[piece])
        if area < _LEAST_GAP_PX:
            continue
        cut = np.s_[max(0, top - 4) : top + height + 4, max(0, left - 4) : left + width + 4]
        inner = (pieces[cut] == piece).astype(np.uint8)
        closed = cv2.morphologyEx(inner, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0
        around = _grown(closed, 5) & ~closed
        if np.mean(is_edge[cut][around]) > _ALL_AROUND:
            found[cut] |= _grown(closed, 3)
    return found


def _grown(mask: Mask, width: int) -> Mask:
    """A mask with all that is within a square of this width around it."""
    import cv2

    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((width, width), np.uint8)) > 0)
