"""One picture of all photographs, strip by strip, so that memory does not grow with their number."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Events
from sfmapp.panorama.canvas import Canvas, View
from sfmapp.panorama.pictures import Pictures

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

STAGE = "blending"
# Bands of frequencies: the lowest are blended over 2^5 = 32 pixels to both sides of a seam (Burt and Adelson, 1983).
_BANDS = 5
# How far a pixel reaches through the pyramid and back, twice 2 (2^5 - 1), rounded up to whole pixels of its top.
_MARGIN = 4 << _BANDS
# pixels of a strip without its margin
_STRIP_PIXELS = 2 << 20
_LEAST_STRIP = 256


@dataclass(frozen=True)
class Plan:
    """How the photographs are laid out.

    Attributes:
        canvas: of the picture. views: of the photographs. gains: (K, 3) factors of their colours.
        small: the canvas that the seams were found on. label: (h, w) the photograph that is shown there, -1 for none.
    """

    canvas: Canvas
    views: Sequence[View]
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
    parts, owner = _parts(plan, columns, rows)
    shapes = [(height >> level, width >> level) for level in range(_BANDS + 1)]
    sums = [np.zeros((*shape, 3), np.float32) for shape in shapes]
    weights = [np.zeros(shape, np.float32) for shape in shapes]
    for k in parts:
        mask = owner == k
        box = _box(mask, block)
        if box is None:
            continue
        y, x = box
        colors = _warped(plan, pictures[k], k, columns[x], rows[y])
        weight = mask[y, x].astype(np.float32)
        for level in range(_BANDS + 1):
            at = (slice(y.start >> level, y.stop >> level), slice(x.start >> level, x.stop >> level))
            if level < _BANDS:
                coarse = cv2.pyrDown(colors)
                band = colors - cv2.pyrUp(coarse, dstsize=colors.shape[1::-1])
            else:
                coarse = band = colors
            sums[level][at] += band * weight[..., None]
            weights[level][at] += weight
            if level < _BANDS:
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


def _parts(plan: Plan, columns: Array, rows: Array) -> tuple[list[int], NDArray[np.int16]]:
    """Photographs that a tile shows some of, and (h, w) which of them where, -1 for none."""
    import cv2

    small, canvas = plan.small, plan.canvas
    x = columns * (small.scale / canvas.scale) - 0.5
    y = rows * (small.scale / canvas.scale) - 0.5
    first, last = int(np.floor(x[0])) - 2, int(np.ceil(x[-1])) + 3
    top, bottom = max(0, int(np.floor(y[0])) - 2), min(small.height, max(1, int(np.ceil(y[-1])) + 3))
    at = np.arange(first, last)
    at = at % small.width if canvas.is_closed else np.clip(at, 0, small.width - 1)
    label = plan.label[min(top, small.height - 1) : bottom][:, at]
    place_x, place_y = np.meshgrid((x - first).astype(np.float32), (y - top).astype(np.float32))
    found = sorted(set(np.unique(label).tolist()) - {-1})
    owner = np.full((len(rows), len(columns)), -1, np.int16)
    best = np.zeros(owner.shape, np.float32)
    rays = canvas.rays(columns, rows)
    is_on = np.ones(len(rows), bool)
    if canvas.projection == "spherical":  # beyond a pole is what lies on the other side of it, and not of the picture
        is_on = np.abs((rows + canvas.top) / canvas.scale) <= 0.5 * np.pi
    for k in found:
        share = cv2.remap(
            (label == k).astype(np.float32), place_x, place_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        near = share > 0.0
        inside = np.zeros(owner.shape, bool)
        inside[near] = plan.views[k].pixels(rays[near])[1]
        is_better = inside & (share > best) & is_on[:, None]
        owner[is_better], best[is_better] = k, share[is_better]
    return found, owner


def _box(mask: Mask, block: int) -> tuple[slice, slice] | None:
    """Rows and columns of a tile that a photograph has an influence on, in whole blocks; None for none."""
    spans = []
    for axis in (1, 0):
        at = np.flatnonzero(mask.any(axis))
        if not len(at):
            return None
        size = mask.shape[1 - axis]
        low = max(0, (int(at[0]) - _MARGIN) // block * block)
        high = min(size, -(-(int(at[-1]) + 1 + _MARGIN) // block) * block)
        spans.append(slice(low, high))
    return spans[0], spans[1]


def _warped(plan: Plan, picture: NDArray[np.uint8], k: int, columns: Array, rows: Array) -> Floats:
    """Colours of a photograph on the canvas, mirrored beyond its borders, so that blurring finds no black there."""
    import cv2

    view = plan.views[k]
    xy, _ = view.pixels(plan.canvas.rays(columns, rows).reshape(-1, 3))
    size = np.array([view.camera.width, view.camera.height])
    held = np.clip(np.nan_to_num(xy, nan=-1.0), -size, 2 * size) - 0.5
    place = held.astype(np.float32).reshape(len(rows), len(columns), 2)
    colors = cv2.remap(picture, place, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(colors * plan.gains[k].astype(np.float32), np.float32)
