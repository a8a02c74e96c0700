"""The panorama in small: what each photograph shows of it, and how bright it is beside the others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Events
from sfmapp.panorama.canvas import Canvas, View, lenses_of
from sfmapp.panorama.pictures import Pictures
from sfmapp.panorama.warp import Axes, Lenses, place_all

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

STAGE = "seams"
# pixels of the small panorama
_PIXELS, _PIXELS_EACH = 4e5, 4e4
# every so many pixels it is asked where a photograph is
_STRIDE = 8
# grey levels that tell of brightness: neither black nor clipped
_DARK, _BRIGHT = 8.0, 247.0
# Overlaps of fewer pixels of the small panorama say nothing.
_FEWEST = 30
# What is believed of exposures beforehand: within a factor of two, and the disagreement of an overlap within 5 %.
_GAIN_SIGMA, _OVERLAP_SIGMA = math.log(2.0), 0.05
_MOST_GAIN = 8.0


@dataclass(frozen=True)
class Shown:
    """A photograph in the small panorama.

    Attributes:
        left, top: of its part. colors: (h, w, 3) float32. inside: (h, w) where it shows something.
        depth: (h, w) float32, how far from its borders, from 0 to 1 in the middle.
    """

    left: int
    top: int
    colors: Floats
    inside: Mask
    depth: Floats


def small_canvas(canvas: Canvas, num_images: int) -> Canvas:
    """The canvas to look for gains and seams on."""
    pixels = max(_PIXELS, _PIXELS_EACH * num_images)
    return canvas.scaled(min(1.0, math.sqrt(pixels / (canvas.width * canvas.height))))


def show_all(views: Sequence[View], pictures: Pictures, canvas: Canvas, events: Events) -> list[Shown]:
    """Each photograph on a small canvas."""
    events.started(STAGE, f"{len(views)} photographs in small", total=len(views))
    out, lenses = [], lenses_of(views)
    for k, view in enumerate(views):
        out.append(_show(view, lenses, k, pictures[k], canvas))
        events.advanced(STAGE)
    return out


def _show(view: View, lenses: Lenses, k: int, picture: NDArray[np.uint8], canvas: Canvas) -> Shown:
    import cv2

    columns, rows = (
        np.arange(0, size + _STRIDE, _STRIDE, dtype=np.float64) + 0.5 * _STRIDE
        for size in (canvas.width, canvas.height)
    )
    inside = _places(lenses, k, canvas.axes(columns, rows))[1]
    top, bottom = _reach(inside, 1, canvas.height)
    left, right = _reach(inside, 0, canvas.width)
    x, y = np.arange(left, right, dtype=np.float64) + 0.5, np.arange(top, bottom, dtype=np.float64) + 0.5
    places, mask = _places(lenses, k, canvas.axes(x, y))
    xy = places + np.float32(0.5)
    factor = min(1.0, canvas.scale / view.camera.focal)
    size = max(1, round(view.camera.width * factor)), max(1, round(view.camera.height * factor))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    shape = np.array([view.camera.width, view.camera.height], np.float32)
    place = xy * (np.array(size) / shape).astype(np.float32) - np.float32(0.5)
    colors = cv2.remap(small, place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
    across = 2.0 * np.minimum(xy, shape - xy) / shape
    depth = np.clip(np.minimum(across[..., 0], across[..., 1]), 0.0, 1.0)
    depth[~mask] = 0.0
    return Shown(left, top, colors, mask, depth)


def _places(lenses: Lenses, k: int, axes: Axes) -> tuple[Floats, Mask]:
    """(h, w, 2) where pixels of a canvas are in a photograph, and (h, w) which of them it shows."""
    inside = np.empty((len(axes.down), len(axes.across)), np.bool_)
    places = np.empty((*inside.shape, 2), np.float32)
    place_all(lenses, k, axes, places, inside)
    return places, inside


def _reach(inside: Mask, axis: int, size: int) -> tuple[int, int]:
    """First and last pixel along a side, with a stride more; everything if nothing was found."""
    at = np.flatnonzero(inside.any(axis))
    if not len(at):
        return 0, size
    return max(0, int(at[0] - 1) * _STRIDE), min(size, int(at[-1] + 2) * _STRIDE)


def find_gains(shown: Sequence[Shown]) -> tuple[Array, Array]:
    """(K, 3) factors for the colours of each photograph, and (K, 3) how far overlaps stay apart, as a logarithm.

    The stored values of a photograph are a power of the light (about 1 / 2.2): a factor of the light is a factor of
    them, and the median of their ratio over an overlap does not see what moved in it. Least squares over all overlaps
    (Brown and Lowe, IJCV 2007, section 6), on logarithms, so that no photograph can be dimmed to agree.
    """
    num = len(shown)
    pairs, ratios, weights = [], [], []
    for i in range(num):
        for j in range(i + 1, num):
            both = _overlap(shown[i], shown[j])
            if both is None:
                continue
            a, b = both
            usable = ((a > _DARK) & (a < _BRIGHT) & (b > _DARK) & (b < _BRIGHT)).all(1)
            if usable.sum() < _FEWEST:
                continue
            pairs.append((i, j))
            ratios.append(np.median(np.log(b[usable] / a[usable]), axis=0))
            weights.append(min(float(usable.sum()) / 1000.0, 1.0) / _OVERLAP_SIGMA**2)
    if not pairs:
        return np.ones((num, 3)), np.zeros((num, 3))
    i, j = np.array(pairs).T
    ratio, weight = np.array(ratios), np.array(weights)
    normal = np.eye(num) / _GAIN_SIGMA**2
    right = np.zeros((num, 3))
    np.add.at(normal, (i, i), weight)
    np.add.at(normal, (j, j), weight)
    np.add.at(normal, (i, j), -weight)
    np.add.at(normal, (j, i), -weight)
    np.add.at(right, i, weight[:, None] * ratio)
    np.add.at(right, j, -weight[:, None] * ratio)
    logs = np.asarray(np.linalg.solve(normal, right), np.float64)
    logs -= np.median(logs, axis=0)
    left = np.abs(ratio + logs[j] - logs[i])
    worst = np.zeros((num, 3))
    np.maximum.at(worst, i, left)
    np.maximum.at(worst, j, left)
    return np.clip(np.exp(logs), 1.0 / _MOST_GAIN, _MOST_GAIN), worst


def _overlap(a: Shown, b: Shown) -> tuple[Array, Array] | None:
    """(N, 3) colours of both where both show something."""
    left, top = max(a.left, b.left), max(a.top, b.top)
    right = min(a.left + a.inside.shape[1], b.left + b.inside.shape[1])
    bottom = min(a.top + a.inside.shape[0], b.top + b.inside.shape[0])
    if right <= left or bottom <= top:
        return None
    parts = [(slice(top - each.top, bottom - each.top), slice(left - each.left, right - each.left)) for each in (a, b)]
    both = a.inside[parts[0]] & b.inside[parts[1]]
    if not both.any():
        return None
    return a.colors[parts[0]][both].astype(np.float64), b.colors[parts[1]][both].astype(np.float64)
