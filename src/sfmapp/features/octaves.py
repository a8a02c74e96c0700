"""The octaves of a scale space, computed some rows at a time.

Six levels of the doubled image take 100 bytes for every pixel of a photograph, more than all else that a run holds. So
a large octave is never there as a whole: a window of rows moves down over it, once to find keypoints and once to
describe them, and only every second pixel of one level is kept, which the next octave begins with. Rows are blurred
from the same numbers in the same order however the windows lie, so the bytes do not depend on them. While an octave's
window is at work it fits into the processor's cache, which pays for the second pass.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.features import scale_space
from sfmapp.features.scale_space import NUM_LAYERS, NUM_LEVELS, SIGMA, SLACK

# pixels of the first octave in one pixel of the image
UPSAMPLING = 2
# rows beside those of a window that keypoints may move to while they are refined; the few that go farther are rare
# enough to be looked up one by one
_REFINEMENT_ROWS = 18
# rows beside those of a window that gradients around its keypoints reach, see descriptor.py: half the diagonal of 5
# cells at the largest scale, and a pixel for the gradient
_DESCRIPTION_ROWS = 48
# the Gaussians are cut off here
_TRUNCATION_SIGMAS = 3.0
# an octave with at most so many pixels is kept whole, and a window of a larger one has an eighth of them
_WHOLE_PX = 6 << 20
_WINDOWS_PER_WHOLE = 8
_LEAST_ROWS = 32
# rows at a time of an octave that is kept: they stay in the cache until their extrema are found
_ROWS_AT_A_TIME = 64
# pixels around a place that is looked up by itself
_LOOK_UP_PX = 8

FloatImage = NDArray[np.float32]


class Window(NamedTuple):
    """Rows of an octave.

    Attributes:
        levels: levels from 0 on, (R, C) float32 each.
        origin: row and column of the octave that they begin with.
        rows: the first row that is this window's own, and the one behind its last; all are some window's own.
    """

    levels: tuple[FloatImage, ...]
    origin: tuple[int, int]
    rows: tuple[int, int]


class Scratch:
    """Memory for one scale space at a time: taking it anew for every image costs as much time as its descriptors.

    Levels 1 to 3 of octaves that are kept are needed to the end. The others of the first of them take as much memory as
    all coarser octaves together, which move in once its extrema are found.

    Args:
        whole_px: octaves of more pixels are never there as a whole.
    """

    def __init__(self, whole_px: int = _WHOLE_PX) -> None:
        self.whole_px = whole_px
        self._pools: dict[str, FloatImage] = {}
        self._end = 0

    def begin(self) -> None:
        """Take back what was handed out before; it will be overwritten."""
        self._end = 0

    def rows(self, num_levels: int, num_rows: int, width: int) -> tuple[FloatImage, ...]:
        """Levels (num_rows, width) for a window, until another window is begun."""
        flat = self._take("rows", num_levels * num_rows * width)
        return tuple(flat.reshape(num_levels, num_rows, width))

    def level_0(self, shape: tuple[int, int], step: float) -> FloatImage:
        """Level 0 of the octave of a step."""
        return self._take(f"level 0 at a step of {step}", shape[0] * shape[1]).reshape(shape)

    def levels(self, shape: tuple[int, int], num_levels: int) -> tuple[FloatImage, ...]:
        """Levels 1 to 3, which stay, then those that stay until the next octave asks."""
        start, size = self._end, shape[0] * shape[1]
        flat = self._take("levels", start + num_levels * size)
        self._end += NUM_LAYERS * size
        return tuple(flat[start:].reshape(num_levels, *shape))

    def _take(self, pool: str, size: int) -> FloatImage:
        if len(self._pools.get(pool, ())) < size + SLACK:
            self._pools.pop(pool, None)
            self._pools[pool] = np.empty(size + SLACK, np.float32)
        return self._pools[pool][:size]


class Octave:
    """One octave.

    Args:
        source: what all levels follow from: the image (h, w) uint8 that the first octave doubles, or level 0 (H, W)
            float32 of a later one, which :meth:`hand_down` of the one before fills.

    Attributes:
        shape: (H, W) pixels.
        step: pixels of the image in one of the octave.
        is_whole: whether its levels stay, or are made anew for every pass of a window.
    """

    def __init__(self, source: NDArray[Any], step: float, scratch: Scratch) -> None:
        self._source, self._scratch = source, scratch
        self._factor = UPSAMPLING if source.dtype == np.uint8 else 1
        self.shape = (self._factor * source.shape[0], self._factor * source.shape[1])
        self.step = step
        self.is_whole = self.shape[0] * self.shape[1] <= scratch.whole_px
        self._levels: tuple[FloatImage, ...] = ()

    def xy(self, found: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2) COLMAP's pixels of places (N, >= 2) column, row. The corner of the first pixel is the origin at every
        resolution up to the doubled one; from there on every second pixel is dropped, which keeps the centre of the
        first."""
        return found[:, :2] * self.step + 0.5 / UPSAMPLING

    def windows_to_search(self) -> Iterator[Window]:
        """All six levels; of an octave that is whole each window has all rows so far, the last one all."""
        if self.is_whole:
            images = self._scratch.levels(self.shape, NUM_LEVELS if self._factor > 1 else NUM_LEVELS - 1)
            level_0 = (images[3],) if self._factor > 1 else (self._source,)
            self._levels = (*level_0, *images[:3], *images[-2:])
        return self._windows(NUM_LEVELS, _REFINEMENT_ROWS)

    def windows_to_describe(self) -> Iterator[Window]:
        """Levels 1 to 3."""
        if self.is_whole:
            yield Window(self._levels[1 : NUM_LAYERS + 1], (0, 0), (0, self.shape[0]))
            return
        for window in self._windows(NUM_LAYERS + 1, _DESCRIPTION_ROWS):
            yield window._replace(levels=window.levels[1:])

    def look_up(self, row: int, col: int) -> Window:
        """All six levels, some pixels around one."""
        reach = _LOOK_UP_PX + UPSAMPLING + sum(len(taps) for taps in _TAPS)
        top, left = (max(0, place - reach) // self._factor for place in (row, col))
        bottom, right = ((place + reach) // self._factor + 1 for place in (row, col))
        part = Octave(np.ascontiguousarray(self._source[top:bottom, left:right]), self.step, Scratch())
        *_, window = part.windows_to_search()
        top, left = self._factor * top, self._factor * left
        first_row, first_col = max(0, row - _LOOK_UP_PX), max(0, col - _LOOK_UP_PX)
        inner = np.s_[first_row - top : row + _LOOK_UP_PX + 1 - top, first_col - left : col + _LOOK_UP_PX + 1 - left]
        levels = tuple(np.ascontiguousarray(level[inner]) for level in window.levels)
        return Window(levels, (first_row, first_col), (row, row + 1))

    def coarser(self) -> Octave:
        """The next octave, to be filled by :meth:`hand_down`."""
        shape = ((self.shape[0] + 1) // 2, (self.shape[1] + 1) // 2)
        return Octave(self._scratch.level_0(shape, 2.0 * self.step), 2.0 * self.step, self._scratch)

    def hand_down(self, window: Window, coarser: Octave) -> None:
        """Give the next octave every second pixel of level 3, with twice the blur of level 0."""
        first, last = window.rows
        top = window.origin[0]
        coarser._source[first // 2 : (last + 1) // 2] = window.levels[NUM_LAYERS][first - top : last - top : 2, ::2]

    def _windows(self, num_levels: int, margin: int) -> Iterator[Window]:
        """Windows from top to bottom, with so many rows beside their own ones, where the octave has them."""
        height, width = self.shape
        # a level is ahead of the last by what blurring reaches for
        ahead = [sum(len(taps) - 1 for taps in _TAPS[n + 1 : num_levels]) for n in range(num_levels)]
        num_rows = _ROWS_AT_A_TIME
        if not self.is_whole:
            # an even number, as every second row goes to the next octave
            num_rows = max(_LEAST_ROWS, self._scratch.whole_px // (_WINDOWS_PER_WHOLE * width)) // 2 * 2
            most_rows = num_rows + 2 * margin + ahead[0] + 1
            self._levels = self._scratch.rows(num_levels, min(height, most_rows), width)
        top, done = 0, [0] * num_levels
        for first in range(0, height, num_rows):
            last = min(height, first + num_rows)
            if not self.is_whole:
                top = _move(self._levels, done, top, max(0, first - margin) // 2 * 2)
            for n in range(num_levels):
                rows = (done[n], min(height, last + margin + ahead[n]), height)
                self._fill(n, rows, top)
                done[n] = rows[1]
            yield Window(tuple(level[: done[-1] - top] for level in self._levels), (top, 0), (first, last))

    def _fill(self, n: int, rows: tuple[int, int, int], top: int) -> None:
        """Make rows of a level; ``top`` is the row of the octave that its memory begins with."""
        level, (first, last, _) = self._levels[n], rows
        if n > 0:
            _blur(self._levels[n - 1], _TAPS[n], level, rows, (top, top))
        elif self._factor > 1:
            reach = len(_TAPS[0]) - 1
            doubled, doubled_top = _doubled_rows(self._source, max(0, first - reach), last + reach)
            _blur(doubled, _TAPS[0], level, rows, (doubled_top, top))
        elif level is not self._source:
            level[first - top : last - top] = self._source[first:last]


def bytes_of_scale_space(height: int, width: int) -> int:
    """The most memory that the octaves of an image of so many pixels take."""
    height, width = UPSAMPLING * height, UPSAMPLING * width
    window, level_0s = 0, 0
    while height * width > _WHOLE_PX:
        rows = max(_LEAST_ROWS, _WHOLE_PX // (_WINDOWS_PER_WHOLE * width))
        # six levels to search or four to describe, with rows beside; the rows that are doubled
        beside = max(NUM_LEVELS * (2 * _REFINEMENT_ROWS + 36), (NUM_LAYERS + 1) * (2 * _DESCRIPTION_ROWS + 18))
        window = max(window, ((NUM_LEVELS + 2) * rows + beside) * width)
        height, width = (height + 1) // 2, (width + 1) // 2
        level_0s += height * width
    return 4 * (window + level_0s + (NUM_LEVELS + 1) * height * width)


def _move(levels: tuple[FloatImage, ...], done: list[int], top: int, new_top: int) -> int:
    """Have the memory of levels, which are filled up to rows ``done``, begin with another row; returns that."""
    if new_top > top:
        for level, end in zip(levels, done, strict=True):
            level[: end - new_top] = level[new_top - top : end - top]
    return new_top


def _doubled_rows(gray: NDArray[np.uint8], first: int, last: int) -> tuple[FloatImage, int]:
    """Rows of the doubled image, at least those from the first to before the last, and which one they begin with.

    Weights are quarters, so the sums are exact, and the same for any rows.
    """
    import cv2

    top, bottom = max(0, first // UPSAMPLING - 1), min(gray.shape[0], last // UPSAMPLING + 2)
    size = (UPSAMPLING * gray.shape[1], UPSAMPLING * (bottom - top))
    doubled = cv2.resize(gray[top:bottom].astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    return doubled, UPSAMPLING * top


def _blur(
    image: FloatImage, taps: FloatImage, target: FloatImage, rows: tuple[int, int, int], tops: tuple[int, int]
) -> None:
    scale_space.blur(image, taps, scale_space.empty_lines(image.shape[1]), target, rows, tops)


def _gaussian(sigma: float) -> FloatImage:
    # the kernel takes the pairs of taps beyond the fourth two at a time
    reach = 2 * math.ceil(_TRUNCATION_SIGMAS * sigma / 2.0)
    taps: NDArray[np.float64] = np.exp(-0.5 * (np.arange(reach + 1) / sigma) ** 2)
    taps /= taps[0] + 2.0 * taps[1:].sum()
    return taps.astype(np.float32)


# from the doubled image to level 0, and from each level to the next
_TAPS = [_gaussian(SIGMA)] + [
    _gaussian(SIGMA * 2.0 ** ((n - 1) / NUM_LAYERS) * math.sqrt(2.0 ** (2.0 / NUM_LAYERS) - 1.0))
    for n in range(1, NUM_LEVELS)
]
