"""An object told from its background by colours that are learned from the photographs themselves.

The edge of the pictures shows background. What is hardly ever seen there is object at first; then the colours of both
are learned from all photographs together, in turn with what they say of each pixel (as GrabCut does in one photograph:
Rother, Kolmogorov and Blake, 2004; over many: Campbell et al., "Automatic 3D Object Segmentation in Multiple Views
using Volumetric Graph-Cuts", 2010). The background's colours count darkened as well: it has shadows on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]
Mask = NDArray[np.bool_]

# histograms of 32 levels a channel: finer ones have empty places at a hundred thousand pixels a photograph
_BITS = 5
_LEVELS = 1 << _BITS
# the band along the edge, of the shorter side, that is background but for where the object is cut off
_BAND = 0.04
# shadows that lie on the background leave these shares of its light, each as probable as this
_SHADES = (0.9, 0.8, 0.7, 0.6, 0.5)
_SHADE_WEIGHT = 0.3
# what the background shows less often than this is object at first; uniform colours would be 3e-5
_RARE = 2e-6
# probability that a colour is neither's own: keeps a colour never seen from saying anything
_STRAY = 1e-7
_ROUNDS = 4
# the background is dark below this share of the object's brightness: shadows on the object are about as dark
_DARK = 0.4
# evidence is averaged over so many pixels a side: noise is that of single pixels
_WINDOW = 3
# specks and holes below this share of the object are filled: a hole that is none pierces the solid, while one that is
# there is seen larger elsewhere
_SPECK = 1e-3


@dataclass(frozen=True)
class ColorModel:
    """Colours of an object and of what is behind it.

    Attributes:
        evidence: (32768,) float32 logarithm of how much more often the object has a colour than the background.
        error: share of pixels that colour alone tells wrongly, both sides weighed alike.
        is_dark: the background is so dark against the object that shadows on this look like it.
    """

    evidence: NDArray[np.float32]
    error: float
    is_dark: bool


def learn_colors(pictures: Sequence[Pixels]) -> ColorModel | None:
    """Colours of object and background of photographs (H, W, 3) of one object; None if nothing stands out anywhere."""
    colors = [color_index(picture) for picture in pictures]
    bands = [_border(index.shape) for index in colors]
    background = histogram([index[band] for index, band in zip(colors, bands, strict=True)], shaded=True)
    masks = [(background[index] < _RARE) & ~band for index, band in zip(colors, bands, strict=True)]
    model = None
    for _ in range(_ROUNDS):
        if not any(mask.any() for mask in masks):
            return None
        model = _model_of(colors, masks, background)
        masks = [_smooth_evidence(index, model) > 0.0 for index in colors]
        if all(mask.all() for mask in masks):
            return None
        background = histogram([index[~mask] for index, mask in zip(colors, masks, strict=True)], shaded=True)
    return model


def object_mask(picture: Pixels, model: ColorModel) -> Mask:
    """(H, W) bool: what of a photograph (H, W, 3) is the object by its colours, without specks and small holes."""
    return without_specks(_smooth_evidence(color_index(picture), model) > 0.0)


def without_specks(mask: Mask) -> Mask:
    """A mask (H, W) without pieces and holes of less than a thousandth of it."""
    least = max(4, int(_SPECK * np.count_nonzero(mask)))
    mask = mask & ~_small_pieces(mask, least)
    return np.asarray(mask | _small_pieces(~mask, least))


def _small_pieces(mask: Mask, least: int) -> Mask:
    import cv2

    _, labels, facts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    is_small = facts[:, cv2.CC_STAT_AREA] < least
    is_small[0] = False
    return np.asarray(is_small[labels])


def color_index(picture: Pixels) -> NDArray[np.int32]:
    """(H, W) place of each pixel's colour in a histogram."""
    levels = (picture >> (8 - _BITS)).astype(np.int32)
    return np.asarray((levels[..., 0] << (2 * _BITS)) | (levels[..., 1] << _BITS) | levels[..., 2])


def _border(shape: tuple[int, ...]) -> Mask:
    width = max(2, round(_BAND * min(shape[:2])))
    band = np.ones(shape[:2], bool)
    band[width:-width, width:-width] = False
    return band


def histogram(colors: Sequence[NDArray[np.int32]], *, shaded: bool) -> NDArray[np.float64]:
    """(32768,) probability of colours, smoothed by one level."""
    from scipy.ndimage import gaussian_filter

    counts = np.zeros(_LEVELS**3)
    for each in colors:
        counts += np.bincount(each, minlength=_LEVELS**3)
    if shaded:
        middles = np.stack(np.meshgrid(*[np.arange(_LEVELS) + 0.5] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        seen = counts.copy()
        for shade in _SHADES:
            r, g, b = (middles * shade).astype(np.int64).T
            counts += _SHADE_WEIGHT * np.bincount((r * _LEVELS + g) * _LEVELS + b, seen, minlength=_LEVELS**3)
    smooth = gaussian_filter(counts.reshape(_LEVELS, _LEVELS, _LEVELS), 1.0, mode="constant").ravel()
    return np.asarray(smooth / max(smooth.sum(), 1e-300))


def _model_of(
    colors: Sequence[NDArray[np.int32]], masks: Sequence[Mask], background: NDArray[np.float64]
) -> ColorModel:
    found = histogram([index[mask] for index, mask in zip(colors, masks, strict=True)], shaded=False)
    evidence = np.log(found + _STRAY) - np.log(background + _STRAY)
    error = float(0.5 * np.minimum(found, background).sum())
    return ColorModel(evidence.astype(np.float32), error, _brightness(background) < _DARK * _brightness(found))


def _brightness(colors: NDArray[np.float64]) -> float:
    """Mean of the three channels, in levels, of colours with probabilities (32768,)."""
    grid = colors.reshape(_LEVELS, _LEVELS, _LEVELS)
    return float(sum(np.arange(_LEVELS) @ grid.sum(axis=others) for others in ((1, 2), (0, 2), (0, 1))) / 3.0)


def _smooth_evidence(index: NDArray[np.int32], model: ColorModel) -> NDArray[np.float32]:
    import cv2

    return np.asarray(cv2.boxFilter(model.evidence[index], -1, (_WINDOW, _WINDOW)))


def edge_pieces(mask: Mask) -> float:
    """Share of a mask (H, W) in pieces apart from its largest one that reach the edge of the picture: colours are
    learned from what is there, as the background's."""
    import cv2

    num, labels, facts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if num <= 2:
        return 0.0
    areas = facts[:, cv2.CC_STAT_AREA]
    at_edge = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    apart = at_edge[(at_edge > 0) & (at_edge != 1 + areas[1:].argmax())]
    return float(areas[apart].sum() / areas[1:].sum())
