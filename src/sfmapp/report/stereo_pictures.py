"""Pictures of a matched pair: maps in colours, an anaglyph, and rows across both photographs."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from html import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from sfmapp.images.pixels import as_rgb
from sfmapp.report.drawing import jpeg_url, shrunk
from sfmapp.stereo.result import DisparityMap, PixelState, RectifiedPair

Pixels = NDArray[np.uint8]

SHOWN_PX, QUALITY = 900, 85
_UNKNOWN = (52, 54, 58)
_NUM_ROWS, _DOTS = 9, 7


@dataclass(frozen=True)
class ColorScale:
    """How values are coloured: the ends of the bar in values, whether the colours go by the logarithm, the map of
    OpenCV, and whether it runs the other way."""

    low: float
    high: float
    is_log: bool = False
    colormap: int = cv2.COLORMAP_TURBO
    is_reversed: bool = False

    def colors(self, values: NDArray[np.floating]) -> Pixels:
        """(..., 3) RGB of values (...); grey where there is none."""
        place = np.asarray(values, np.float64)
        low, high = self.low, self.high
        if self.is_log:
            place = np.log(np.maximum(place, 1e-12))
            low, high = float(np.log(low)), float(np.log(high))
        share = np.clip((place - low) / max(high - low, 1e-12), 0.0, 1.0)
        if self.is_reversed:
            share = 1.0 - share
        index = np.rint(255.0 * np.nan_to_num(share)).astype(np.uint8)
        table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], self.colormap)[:, 0, ::-1]
        out: Pixels = table[index]
        out[np.isnan(values)] = _UNKNOWN
        return out

    def bar(self) -> str:
        """A strip of the colours with both ends, as HTML."""
        ramp = np.geomspace(self.low, self.high, 256) if self.is_log else np.linspace(self.low, self.high, 256)
        strip = np.repeat(self.colors(ramp)[None], 12, axis=0)
        middle = float(np.sqrt(self.low * self.high)) if self.is_log else 0.5 * (self.low + self.high)
        ends = "".join(f"<span>{value:.3g}</span>" for value in (self.low, middle, self.high))
        return f'<div class="bar-of"><img src="{jpeg_url(strip, 256, 95)}" alt=""><div>{ends}</div></div>'


def scale_of(values: NDArray[np.floating], *, is_log: bool = False, colormap: int = cv2.COLORMAP_TURBO) -> ColorScale:
    """A scale of all values but the outermost in a hundred on either side."""
    known = values[np.isfinite(values)]
    if not known.size:
        return ColorScale(0.1 if is_log else 0.0, 1.0, is_log, colormap)
    low, high = (float(v) for v in np.quantile(known, (0.01, 0.99)))
    return ColorScale(low, high if high > low else low + 1e-3, is_log and low > 0.0, colormap)


def map_figure(values: NDArray[np.floating], scale: ColorScale, caption: str) -> str:
    """A map (H, W) with its bar."""
    picture = jpeg_url(scale.colors(_thinned(values)), SHOWN_PX, QUALITY)
    return f'<figure><img src="{picture}" alt="">{scale.bar()}<figcaption>{escape(caption)}</figcaption></figure>'


def anaglyph(pair: RectifiedPair, shift: int) -> Pixels:
    """For glasses of red before the left eye and cyan before the right one; of what has the disparity ``shift``, both
    pictures coincide, and it is seen in the plane of the screen."""
    left, right = (as_rgb(picture) for picture in (pair.left, pair.right))
    moved = np.zeros_like(right)
    width = left.shape[1]
    if 0 <= shift < width:
        moved[:, shift:] = right[:, : width - shift]
    elif -width < shift < 0:
        moved[:, :shift] = right[:, -shift:]
    # of red light alone the left eye sees what is bright, not what is red; where there is no right picture, nothing
    moved[:, :, 0] = np.where(moved.any(2), cv2.cvtColor(left, cv2.COLOR_RGB2GRAY), np.uint8(0))
    return moved


def rows_across(pair: RectifiedPair, found: DisparityMap) -> Pixels:
    """Both pictures side by side with some rows across both, and on each some pixels with their matches."""
    left, scale = shrunk(as_rgb(pair.left), SHOWN_PX)
    right, _ = shrunk(as_rgb(pair.right), SHOWN_PX)
    height, width = left.shape[:2]
    canvas = np.concatenate([left, np.full((height, 8, 3), 255, np.uint8), right], axis=1)
    for n in range(_NUM_ROWS):
        row = round((n + 0.5) / _NUM_ROWS * pair.left.shape[0])
        color = tuple(round(255 * v) for v in colorsys.hsv_to_rgb(n / _NUM_ROWS, 0.8, 1.0))
        y = int(row * scale)
        cv2.line(canvas, (0, y), (canvas.shape[1] - 1, y), color, 1, cv2.LINE_AA)
        matched = np.flatnonzero(found.state[row] == PixelState.MATCHED)
        for k in np.unique(np.linspace(0, len(matched) - 1, min(_DOTS, len(matched))).astype(np.int64)).tolist():
            x = float(matched[k]) + 0.5
            for at in (x * scale, width + 8 + (x - float(found.disparity[row, matched[k]])) * scale):
                cv2.circle(canvas, (round(at), y), 5, (0, 0, 0), -1, cv2.LINE_AA)
                cv2.circle(canvas, (round(at), y), 4, color, -1, cv2.LINE_AA)
    return canvas


def _thinned(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """At most about as many values as are shown: picked, not averaged, for what is unknown spreads otherwise."""
    step = max(1, max(values.shape) // SHOWN_PX)
    return values[::step, ::step]
