"""Image pyramids in one flat buffer, with borders that patches may hang over.

A level halves the one below with the taps (1, 3, 3, 1) / 8 in both directions: an even kernel, so with pixel centres at
(0.5, 0.5) a point at x in the image lies at exactly ``x / 2 ** level`` in a level. Its response at the new Nyquist
frequency is 0.35, where a 2 x 2 box leaves 0.71 to alias.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]

# pixels around each level that repeat its outermost ones: a patch of 16 pixels about any point of the image lies inside
PAD = 16
# a patch is 13 to 15 pixels wide; on a level less than 20 high it would see little but borders
_MIN_SIDE = 20


class Pyramid(NamedTuple):
    """An image and its reductions.

    Attributes:
        data: flat uint8, all levels with their borders.
        layout: (L, 4) int64: where pixel (0, 0) of a level lies in data, step between rows, height, width.
    """

    data: Bytes
    layout: NDArray[np.int64]

    @property
    def num_levels(self) -> int:
        """Levels, the image itself included."""
        return len(self.layout)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the image."""
        return int(self.layout[0, 2]), int(self.layout[0, 3])

    def level(self, index: int) -> Bytes:
        """(H, W) uint8 view of a level, without its border."""
        start, step, height, width = (int(value) for value in self.layout[index])
        return self.data[start : start + height * step].reshape(height, step)[:, :width]

    def reduced(self, index: int) -> Pyramid:
        """The pyramid of a level, which shares its pixels with this one."""
        return Pyramid(self.data, self.layout[index:])


@numba.njit(cache=True, nogil=True)
def _copy_row(source: Bytes, target: Bytes, width: int) -> None:
    for c in range(width):
        target[PAD + c] = source[c]


@numba.njit(cache=True, nogil=True)
def _extend_row(line: Bytes, width: int) -> None:
    for c in range(PAD):
        line[c] = line[PAD]
        line[PAD + width + c] = line[PAD + width - 1]


@numba.njit(cache=True, nogil=True)
def _add_rows(a: Bytes, b: Bytes, c: Bytes, d: Bytes, line: NDArray[np.uint16], num: int) -> None:
    for i in range(num):
        line[i] = np.uint16(a[i]) + np.uint16(d[i]) + np.uint16(3) * (np.uint16(b[i]) + np.uint16(c[i]))


@numba.njit(cache=True, nogil=True)
def _halve_row(line: NDArray[np.uint16], target: Bytes, width: int) -> None:
    for i in range(width):
        outer = line[2 * i] + line[2 * i + 3]
        inner = line[2 * i + 1] + line[2 * i + 2]
        target[PAD + i] = np.uint8((outer + np.uint16(3) * inner + np.uint16(32)) >> np.uint16(6))


@numba.njit(cache=True, nogil=True)
def _extend_rows(data: Bytes, top: int, step: int, height: int) -> None:
    bottom = top + (height - 1) * step
    for r in range(1, PAD + 1):
        for k in range(step):
            data[top - r * step + k] = data[top + k]
            data[bottom + r * step + k] = data[bottom + k]


@numba.njit(cache=True, nogil=True)
def _fill(image: Bytes, data: Bytes, layout: NDArray[np.int64], line: NDArray[np.uint16]) -> None:
    for level in range(layout.shape[0]):
        start, step, height, width = layout[level]
        top = start - PAD
        for r in range(height):
            target = data[top + r * step : top + (r + 1) * step]
            if level == 0:
                _copy_row(image[r], target, width)
            else:
                below, wide = layout[level - 1, 0] - PAD, layout[level - 1, 1]
                a = data[below + (2 * r - 1) * wide :]
                _add_rows(a[PAD - 1 :], a[wide + PAD - 1 :], a[2 * wide + PAD - 1 :], a[3 * wide + PAD - 1 :],
                          line, 2 * width + 2)  # fmt: skip
                _halve_row(line, target, width)
            _extend_row(target, width)
        _extend_rows(data, top, step, height)


def build_pyramid(image: Bytes, num_levels: int | None = None) -> Pyramid:
    """Reduce an image by two again and again.

    Args:
        image: (H, W) uint8, at least one pixel.
        num_levels: levels including the image; None: until the smaller side is 20 to 40 pixels.
    """
    height, width = image.shape
    if num_levels is None:
        num_levels = max(1, int(np.log2(max(min(height, width) / _MIN_SIDE, 1.0))) + 1)
    layout = np.empty((num_levels, 4), np.int64)
    end = 0
    for level in range(num_levels):
        h, w = max(height >> level, 1), max(width >> level, 1)
        step = -(-(w + 2 * PAD) // 16) * 16
        layout[level] = end + PAD * step + PAD, step, h, w
        end += (h + 2 * PAD) * step
    # vectors of 16 may be read from the last pixel on
    data = np.zeros(end + 2 * PAD, np.uint8)
    _fill(np.ascontiguousarray(image), data, layout, np.empty(width + 4, np.uint16))
    return Pyramid(data, layout)
