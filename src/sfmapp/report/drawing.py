"""Smooth lines and good type on a small canvas: what a picture of a result needs, with OpenCV alone.

Shapes are drawn at twice the size and averaged down, text is set afterwards at its final size with the scalable font
that OpenCV 5 brings. Coordinates are pixels from the top left corner, colours are RGB.
"""

from __future__ import annotations

import base64
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from sfmapp.formats.atomic import write_bytes

Array = NDArray[np.float64]
Color = tuple[int, int, int]
Anchor = Literal["start", "middle", "end"]

_OVERSAMPLING = 2
# OpenCV takes coordinates in 1/16 of a pixel
_SHIFT = 4


class Drawing:
    """A canvas of the given size in pixels."""

    def __init__(self, width: int, height: int, background: Color = (255, 255, 255)) -> None:
        self.width, self.height = width, height
        self._pixels = np.empty((height * _OVERSAMPLING, width * _OVERSAMPLING, 3), np.uint8)
        self._pixels[:] = background[::-1]
        self._texts: list[tuple[str, int, int, int, int, Color]] = []
        self._font = cv2.FontFace("sans")

    def line(self, points: Array, color: Color, width: float) -> None:
        """An open line through points (N, 2), with round ends and corners. NaN interrupts it."""
        is_there = np.atleast_1d(np.isfinite(points).all(1))
        for run in np.split(np.arange(len(points)), np.flatnonzero(np.diff(is_there)) + 1):
            if len(run) and is_there[run[0]]:
                xy = points[run] if len(run) > 1 else points[[run[0], run[0]]]
                cv2.polylines(
                    self._pixels, [self._fixed(xy)], False, color[::-1], self._thick(width), cv2.LINE_AA, _SHIFT
                )

    def colored_line(self, points: Array, colors: NDArray[np.uint8], width: float) -> None:
        """Like :meth:`line`, with a colour (N - 1, 3) for each step."""
        fixed = self._fixed(np.nan_to_num(points))
        is_there = np.atleast_1d(np.isfinite(points).all(1))
        for k in np.flatnonzero(is_there[1:] & is_there[:-1]).tolist():
            start, end = fixed[k].tolist(), fixed[k + 1].tolist()
            color = colors[k][::-1].tolist()
            cv2.line(self._pixels, start, end, color, self._thick(width), cv2.LINE_AA, _SHIFT)

    def dashes(self, points: Array, color: Color, width: float, dash: float = 7.0, space: float = 6.0) -> None:
        """A dashed line through points (N, 2), without NaN."""
        for start, end in itertools.pairwise(points):
            length = float(np.linalg.norm(end - start))
            for begin in np.arange(0.0, length, dash + space):
                stretch = np.array([begin, min(begin + dash, length)])[:, None] / length
                self.line(start + stretch * (end - start), color, width)

    def disc(self, center: Array, radius: float, color: Color, rim: Color | None = None) -> None:
        """A filled circle, with a rim of two pixels if one is asked for."""
        if rim is not None:
            self.disc(center, radius + 2, rim)
        scale = _OVERSAMPLING * 2**_SHIFT
        at = self._fixed(np.asarray(center)[None])[0].tolist()
        cv2.circle(self._pixels, at, round(radius * scale), color[::-1], cv2.FILLED, cv2.LINE_AA, _SHIFT)

    def box(self, left: float, top: float, right: float, bottom: float, color: Color) -> None:
        """A filled rectangle."""
        corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
        cv2.fillPoly(self._pixels, [self._fixed(corners)], color[::-1], cv2.LINE_AA, _SHIFT)

    def gradient(self, left: int, top: int, right: int, bottom: int, colors: NDArray[np.uint8]) -> None:
        """A rectangle whose colours (N, 3) run from its left to its right or, if it is tall, from bottom to top."""
        k = _OVERSAMPLING
        size = ((right - left) * k, (bottom - top) * k)
        is_tall = size[1] > size[0]
        strip = colors[::-1, None, ::-1] if is_tall else colors[None, :, ::-1]
        patch = cv2.resize(np.ascontiguousarray(strip), size, interpolation=cv2.INTER_LINEAR)
        self._pixels[top * k : bottom * k, left * k : right * k] = patch

    def text_width(self, text: str, size: int, weight: int = 400) -> float:
        """Of a line of text, in pixels."""
        return float(cv2.getTextSize((self.width, self.height), text, (0, 0), self._font, size, weight)[2])

    def text(
        self, text: str, x: float, y: float, size: int, color: Color, weight: int = 400, anchor: Anchor = "start"
    ) -> None:
        """A line of text whose base line begins, has its middle or ends at (x, y). ``weight``: 300 light, 600 bold."""
        shift = {"start": 0.0, "middle": 0.5, "end": 1.0}[anchor]
        left = x - (shift * self.text_width(text, size, weight) if shift else 0.0)
        self._texts.append((text, round(left), round(y), size, weight, color))

    def pixels(self) -> NDArray[np.uint8]:
        """(H, W, 3) RGB."""
        image = cv2.resize(self._pixels, (self.width, self.height), interpolation=cv2.INTER_AREA)
        for text, x, y, size, weight, color in self._texts:
            cv2.putText(image, text, (x, y), color[::-1], self._font, size, weight)
        return np.ascontiguousarray(image[:, :, ::-1])

    def write_png(self, path: Path) -> None:
        """Raises InputError if the file cannot be written."""
        encoded = cv2.imencode(".png", self.pixels()[:, :, ::-1])[1]
        write_bytes(path, encoded.tobytes())

    def _fixed(self, points: Array | Sequence[Sequence[float]]) -> NDArray[np.int32]:
        # the pixel (0, 0) of OpenCV has its centre there, ours its corner
        xy = np.asarray(points, np.float64) * _OVERSAMPLING - 0.5
        fixed: NDArray[np.int32] = np.clip(np.rint(xy * 2**_SHIFT), -(2**30), 2**30).astype(np.int32)
        return fixed

    @staticmethod
    def _thick(width: float) -> int:
        return max(1, round(width * _OVERSAMPLING))


def colormap(values: Array) -> NDArray[np.uint8]:
    """Colours (N, 3) RGB of values 0 to 1: blue, magenta, orange; all are dark enough for white paper."""
    # matplotlib's plasma without its pale yellow end
    index = np.rint(np.clip(np.nan_to_num(values), 0.0, 1.0) * 0.82 * 255).astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(index[:, None], cv2.COLORMAP_PLASMA)[:, 0, ::-1])


def shrunk(pixels: NDArray[np.uint8], longest: int) -> tuple[NDArray[np.uint8], float]:
    """A picture whose longer side has at most so many pixels, and its size as a share of what it was."""
    scale = min(1.0, longest / max(pixels.shape[:2]))
    size = (max(1, round(pixels.shape[1] * scale)), max(1, round(pixels.shape[0] * scale)))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8), scale


def jpeg_url(pixels: NDArray[np.uint8], longest: int, quality: int = 82) -> str:
    """A picture (H, W, 3) RGB as a JPEG of at most so many pixels, to stand in a page itself."""
    small = shrunk(pixels, longest)[0][:, :, ::-1]
    encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()
