"""One picture of all photographs, strip by strip, so that memory does not grow with their number."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Events
from sfmapp.panorama.canvas import Canvas
from sfmapp.panorama.pictures import Pictures
from sfmapp.panorama.warp import Lenses, add_band, find_owners, place_all

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

STAGE = "blending"
# Bands of frequencies: the lowest are blended over 2^5 = 32 pixels to both sides of a seam (Burt and Adelson, 1983).
_BANDS = 5
# How far a pixel reaches through the pyramid and back, twice 2 (2^5 - 1), rounded up to whole pixels of its top.
_MARGIN = 2 << _BANDS
# pixels of a strip without its margin
_STRIP_PIXELS = 2 << 20
_LEAST_STRIP = 256


@dataclass(frozen=True)
class Plan:
    """How the photographs are laid out.

    Attributes:
        canvas: of the picture. lenses: of the photographs. gains: (K, 3) factors of their colours.
        small: the canvas that the seams were found on. label: (h, w) the photograph that is shown there, -1 for none.
    """

    canvas: Canvas
    lenses: Lenses
    gains: Array
    small: Canvas
    label: NDArray[np.int16]


@dataclass(frozen=True)
class _Tile:
    left: int
    top: int
    width: int
    height: int


def compose(plan: Plan, pictures: Pictures, events: Events) -> tuple[NDArray[np.uint8], Mask]:
    """The panorama (H, W, 3) uint8, and (H, W) where it shows something."""
    canvas = plan.canvas
    picture = np.zeros((canvas.height, canvas.width, 3), np.uint8)
    shown = np.zeros(picture.shape[:2], bool)
    tiles = list(_tiles(canvas))
    events.started(STAGE, f"{canvas.width} x {canvas.height} pixels, {canvas.projection}", total=len(tiles))
    for tile in tiles:
        colors, inside = _blend(plan, pictures, tile)
        at = slice(tile.top, tile.top + tile.height), slice(tile.left, tile.left + tile.width)
        picture[at], shown[at] = colors, inside
        events.advanced(STAGE)
    events.finished(STAGE, f"{canvas.width} x {canvas.height} pixels")
    return picture, shown


def _tiles(canvas: Canvas) -> Iterator[_Tile]:
    """Strips from top to bottom, from left to right; cut across where they are too long."""
    height = min(canvas.height, _STRIP_PIXELS // _LEAST_STRIP)
    width = max(_LEAST_STRIP, _STRIP_PIXELS // height)
    for left in range(0, canvas.width, width):
        for top in range(0, canvas.height, height):
            yield _Tile(left, top, min(width, canvas.width - left), min(height, canvas.height - top))


def _blend(plan: Plan, pictures: Pictures, tile: _Tile) -> tuple[NDArray[np.uint8], Mask]:
    """Colours (h, w, 3) and where there are any, of a tile: the bands of all photographs, weighted by blurred masks."""
    import cv2

    block = 1 << _BANDS
    width, height = (-(-(size + 2 * _MARGIN) // block) * block for size in (tile.width, tile.height))
    columns = np.arange(width, dtype=np.float64) + (tile.left - _MARGIN + 0.5)
    rows = np.arange(height, dtype=np.float64) + (tile.top - _MARGIN + 0.5)
    owner = _owners(plan, columns, rows)
    shapes = [(height >> level, width >> level) for level in range(_BANDS + 1)]
    sums = [np.zeros((*shape, 3), np.float32) for shape in shapes]
    weights = [np.zeros(shape, np.float32) for shape in shapes]
    for k in sorted(set(np.unique(owner).tolist()) - {-1}):
        mask = owner == k
        y, x = _box(mask, block)
        colors = _warped(plan, pictures[k], k, columns[x], rows[y])
        weight = mask[y, x].astype(np.float32)
        for level in range(_BANDS + 1):
            left, top = x.start >> level, y.start >> level
            if level == _BANDS:
                add_band(colors, np.zeros_like(colors), weight, left, top, sums[level], weights[level])
                break
            coarse = cv2.pyrDown(colors)
            blurred = cv2.pyrUp(coarse, dstsize=colors.shape[1::-1])
            add_band(colors, blurred, weight, left, top, sums[level], weights[level])
            colors, weight = coarse, cv2.pyrDown(weight)
    out = np.zeros((*shapes[-1], 3), np.float32)
    for level in range(_BANDS, -1, -1):
        if level < _BANDS:
            out = np.asarray(cv2.pyrUp(out, dstsize=shapes[level][::-1]), np.float32)
        out += sums[level] / np.maximum(weights[level], 1e-6)[..., None]
    inner = slice(_MARGIN, _MARGIN + tile.height), slice(_MARGIN, _MARGIN + tile.width)
    inside = owner[inner] >= 0
    drawn = np.clip(np.rint(out[inner]), 0.0, 255.0).astype(np.uint8)
    drawn[~inside] = 0
    return drawn, inside


def _owners(plan: Plan, columns: Array, rows: Array) -> NDArray[np.int16]:
    """(h, w) which photograph is shown where, -1 for none."""
    small, canvas = plan.small, plan.canvas
    x = columns * (small.scale / canvas.scale) - 0.5
    y = rows * (small.scale / canvas.scale) - 0.5
    owner = np.empty((len(rows), len(columns)), np.int16)
    find_owners(plan.lenses, canvas.axes(columns, rows), plan.label, x, y, canvas.is_closed, owner)
    if canvas.projection == "spherical":  # beyond a pole is what lies on the other side of it, and not of the picture
        owner[np.abs((rows + canvas.top) / canvas.scale) > 0.5 * np.pi] = -1
    return owner


def _box(mask: Mask, block: int) -> tuple[slice, slice]:
    """Rows and columns of a tile that a photograph has an influence on, in whole blocks."""
    spans = []
    for axis in (1, 0):
        at = np.flatnonzero(mask.any(axis))
        size = mask.shape[1 - axis]
        low = max(0, (int(at[0]) - _MARGIN) // block * block)
        high = min(size, -(-(int(at[-1]) + 1 + _MARGIN) // block) * block)
        spans.append(slice(low, high))
    return spans[0], spans[1]


def _warped(plan: Plan, picture: NDArray[np.uint8], k: int, columns: Array, rows: Array) -> Floats:
    """Colours of a photograph on the canvas, mirrored beyond its borders, so that blurring finds no black there."""
    import cv2

    places = np.empty((len(rows), len(columns), 2), np.float32)
    place_all(plan.lenses, k, plan.canvas.axes(columns, rows), places, np.empty(places.shape[:2], np.bool_))
    colors = cv2.remap(picture, places, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(colors * plan.gains[k].astype(np.float32), np.float32)
