"""Semi-global matching, coarse to fine: a level looks at 64 disparities about those of half its resolution.

Costs are the differing bits of two census transforms of 5 x 5 pixels (Zabih and Woodfill, ECCV 1994): one of the
picture, one of every second pixel of the blurred picture, which sees through noise. Where the picture shows little but
noise the level expects what half the resolution found, where there is less of it.

Its parameters were chosen on motorcycle, cones, aloe and seven rendered pairs together.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from functools import partial

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.stereo.semiglobal_kernels import (
    GAP,
    LANES,
    NOISE_BINS,
    STRIDE,
    Bytes,
    Found,
    Penalties,
    Rows,
    Views,
    Words,
    decide,
    fill_costs,
    follow_down,
    follow_up,
    look_again,
    noise_of,
)

# in differing bits of 48: a step of one disparity, and one of more where two pixels look alike; half of it where they
# differ by FALL_GREY
SMALL, LARGE, FALL_GREY = 16, 110, 10.0
# of a disparity that leads out of the right picture: that of a match which is neither good nor bad
UNSEEN = 12
# deviation of the blur of the second census, pixels
BLUR_PX = 0.8
# what a disparity costs more for each pixel off the expected one, at most MOST_DOUBT
MOST_DOUBT = 6
# a picture is plain where its mean difference from its blurred self, in a window, is below so many standard deviations
# of its noise: noise alone comes to 0.67. Rounding to whole grey values is a noise of its own
PLAIN, LEAST_NOISE, PLAIN_WINDOW = 0.75, 0.67, 7
# 1 - best / second below which a disparity is not believed. From 0.1 to 0.2 bad-1 of answers falls by a tenth, while
# roads of real drives lose 2 to 6 % of their pixels
LEAST_UNIQUENESS = 0.12
# side of the window in which a picture that shows nothing is not matched; what is narrower its surroundings tell
BLANK_WINDOW = 21
# the sides of what is left after so many halvings
LEAST_SIDE = 48
# what is held of costs and sums, or more where it holds fewer rows than four times the overlap: pictures with more rows
# are worked on in strips, whose paths from below begin OVERLAP rows below them
RING_BYTES, OVERLAP = 1 << 27, 64
_PAD = 4


@numba.njit(cache=True, nogil=True)
def census(grey: Bytes, blurred: Bytes, rows: NDArray[np.uint32], margin: int, out: Words) -> None:
    """48 bits for each pixel of two pictures that have four pixels more on every side than they are told of.

    rows: scratch (2, W) uint32. margin: columns of ``out`` on both sides that stay as they are; where there are any,
    columns are written in opposite order.
    """
    width = rows.shape[1]
    for y in range(out.shape[0]):
        _compare(grey, y + _PAD, 1, rows[0])
        _compare(blurred, y + _PAD, 2, rows[1])
        for x in range(width):
            word = (np.uint64(rows[0, x]) << np.uint64(24)) | np.uint64(rows[1, x])
            out[y, margin + width - 1 - x if margin > 0 else x] = word


@numba.njit(cache=True, nogil=True)
def _compare(picture: Bytes, y: int, stride: int, row: NDArray[np.uint32]) -> None:
    """24 bits for each pixel of row y: which of its neighbours, ``stride`` apart, are darker."""
    for x in range(row.shape[0]):
        row[x] = np.uint32(0)
    middle = picture[y]
    for dy in range(-2, 3):
        other = picture[y + stride * dy]
        for dx in range(-2, 3):
            if dx == 0 and dy == 0:
                continue
            shift = _PAD + stride * dx
            for x in range(row.shape[0]):
                row[x] = np.uint32((row[x] << np.uint32(1)) | np.uint32(other[x + shift] < middle[x + _PAD]))


def describe(grey: Bytes, padded: Bytes, blurred: Bytes, bits: NDArray[np.uint32], margin: int, out: Words) -> None:
    """Both census transforms of a picture (H, W) into ``out``.

    padded, blurred: (H + 8, W + 8) uint8, which become the picture with its border carried on, and that one blurred.
    bits, margin: of :func:`census`.
    """
    cv2.copyMakeBorder(grey, _PAD, _PAD, _PAD, _PAD, cv2.BORDER_REPLICATE, dst=padded)
    cv2.GaussianBlur(padded, (5, 5), BLUR_PX, dst=blurred)
    census(padded, blurred, bits, margin, out)


def usual_penalties() -> Penalties:
    """SMALL, and LARGE less the more two pixels differ."""
    large = [max(SMALL + 1, round(LARGE / (1.0 + difference / FALL_GREY))) for difference in range(256)]
    return Penalties(np.uint8(SMALL), np.array(large, np.uint8))


def doubt_of(count: int) -> Bytes:
    """(65, 64): what lanes cost more by their distance from the expected one, and 255 of those beyond the first so
    many."""
    doubt = np.zeros((LANES + 1, LANES), np.uint8)
    lanes = np.arange(LANES)
    doubt[:LANES] = np.minimum(np.abs(lanes[:, None] - lanes), MOST_DOUBT)
    doubt[:, count:] = 255
    return doubt


def rows_at_a_time(height: int, width: int) -> tuple[int, int]:
    """Rows of a ring of costs that RING_BYTES hold, and how many of a strip they are."""
    ring = min(height, max(4 * OVERLAP, RING_BYTES // (3 * width * LANES)))
    return ring, height if ring == height else ring - OVERLAP


def follow_strips(
    views: Views, penalties: Penalties, rows: Rows, strip: int, paths: tuple[Bytes, Bytes],
    fill: Callable[[int, int, int], None], settle: Callable[[int, int, int], None], pool: Executor | None,
) -> None:  # fmt: skip
    """Sum the costs of all rows along eight paths, a strip of rows at a time.

    Args:
        paths: scratch (4, GAP + STRIDE W) of the paths from above and from below.
        fill: makes the costs of the rows from the first to before the last in the ring; the third number, 0 or 1, says
            which of two that may work at once it is.
        settle: likewise takes what was found from the sums in ``rows.above`` and ``rows.below``.
        pool: does two things at a time.
    """
    done, height = 0, views.grey.shape[0]
    for start in range(0, height, strip):
        last, end = min(start + len(rows.costs), height), min(start + strip, height)
        mid, half = (done + last) // 2, (start + end) // 2
        both(pool, partial(fill, done, mid, 0), partial(fill, mid, last, 1))
        both(
            pool,
            partial(follow_down, views, penalties, done, last, paths[0], rows),
            partial(follow_up, views, penalties, start, last, paths[1], rows),
        )
        both(pool, partial(settle, start, half, 0), partial(settle, half, end, 1))
        done = last


class Level:
    """One resolution: its arrays, which serve picture after picture, and its matching."""

    def __init__(
        self, height: int, width: int, search: tuple[int, int], *, halve: bool = True, memory: Bytes | None = None
    ) -> None:
        self.search = first, count = search
        shape = (height, width)
        # a strip is worked on at a time, and the coarser levels are done before this one begins: they share its memory
        ring, self.strip = rows_at_a_time(height, width)
        size = 3 * ring * width * LANES
        memory = np.empty(max(size, RING_BYTES), np.uint8) if memory is None else memory
        self.rows = Rows(*memory[:size].reshape(3, ring, width, LANES))
        self.coarse: Level | None = None
        if count > LANES or (halve and min(shape) >= 2 * LEAST_SIDE):
            low = first // 2
            half = (low, (first + count + 1) // 2 - low + 1)
            self.coarse = Level((height + 1) // 2, (width + 1) // 2, half, halve=False, memory=memory)
            self.smaller = np.empty((2, (height + 1) // 2, (width + 1) // 2), np.uint8)
            self.ends = np.empty(self.smaller.shape, np.float32)
        self.margin = LANES + max(0, -first, first + count)
        padded = (2, height + 2 * _PAD, width + 2 * _PAD)
        self.padded, self.blurred = np.empty(padded, np.uint8), np.empty(padded, np.uint8)
        self.fine, self.summed = np.empty(padded[1:], np.uint8), np.empty(padded, np.uint16)
        # sums of differences from the blurred picture, over a small and over a large window
        self.texture, self.wide_texture = self.summed[:, _PAD:-_PAD, _PAD:-_PAD]
        self.counts = np.empty(NOISE_BINS, np.int64)
        self.bits = np.empty((2, 2, width), np.uint32)
        right = np.zeros((height, width + 2 * self.margin), np.uint64)
        doubt = doubt_of(count)
        self.views = Views(
            np.empty(shape, np.uint64), right, np.empty(shape, np.uint8), np.full(shape, first, np.int16),
            np.full(shape, LANES, np.uint8), doubt,
        )  # fmt: skip
        self.penalties = usual_penalties()
        length = GAP + STRIDE * width
        self.raw = np.empty((2, 4, length), np.uint8)
        self.down, self.up = np.empty((4, length), np.uint8), np.empty((4, length), np.uint8)
        self.cost = np.empty((2, right.shape[1]), np.uint8)
        self.label = np.empty((2, right.shape[1]), np.int16)
        self.found = Found(
            np.empty(shape, np.float32), np.empty(shape, np.uint8), np.empty(shape, np.uint8),
            np.empty(shape, np.uint8), np.empty(shape, np.int16),
        )  # fmt: skip

    def match(self, left: Bytes, right: Bytes, tolerance: int, pool: Executor | None = None) -> Found:
        """Of two (H, W) uint8 pictures; the arrays of what is found are this level's own.

        Args:
            tolerance: by how many pixels what the right picture finds may differ.
            pool: does two things at a time; what is found does not depend on it.
        """
        views, rows = self.views, self.rows
        both(
            pool,
            partial(self._transform, 0, left, 0, views.left),
            partial(self._transform, 1, right, self.margin, views.right),
        )
        np.copyto(views.grey, left)
        cv2.absdiff(self.padded[0], self.blurred[0], dst=self.fine)
        for side, sums in zip((PLAIN_WINDOW, BLANK_WINDOW), self.summed, strict=True):
            cv2.boxFilter(self.fine, cv2.CV_16U, (side, side), dst=sums, normalize=False)
        if self.coarse is not None:
            self._look_again(self.coarse, left, right, tolerance, pool)

        def settle(first: int, last: int, part: int) -> None:
            decide(views, tolerance, first, last, rows, self.cost[part], self.label[part], self.found)

        follow_strips(views, self.penalties, rows, self.strip, (self.down, self.up), self.fill, settle, pool)
        return self.found

    def fill(self, first: int, last: int, part: int) -> None:
        """Make the costs of the rows first to last - 1; see :func:`follow_strips`."""
        fill_costs(self.views, np.uint8(UNSEEN), first, last, self.raw[part], self.rows)

    def _transform(self, side: int, grey: Bytes, margin: int, out: Words) -> None:
        describe(grey, self.padded[side], self.blurred[side], self.bits[side], margin, out)

    def _look_again(self, coarse: Level, left: Bytes, right: Bytes, tolerance: int, pool: Executor | None) -> None:
        height, width = coarse.views.grey.shape
        for image, small in zip((left, right), self.smaller, strict=True):
            cv2.resize(image, (width, height), dst=small, interpolation=cv2.INTER_AREA)
        found = coarse.match(self.smaller[0], self.smaller[1], tolerance, pool)
        plain = PLAIN * max(noise_of(left, self.counts), LEAST_NOISE) * PLAIN_WINDOW**2
        around = np.ones((3, 3), np.uint8)
        cv2.erode(found.disparity, around, dst=self.ends[0])
        cv2.dilate(found.disparity, around, dst=self.ends[1])
        views = self.views
        look_again(found, self.ends, LEAST_UNIQUENESS, self.texture, plain, self.search, views.base, views.expected)


def both(pool: Executor | None, one: Callable[[], None], other: Callable[[], None]) -> None:
    """Do two things, at once where there is a pool."""
    if pool is None:
        one()
        other()
        return
    begun = pool.submit(one)
    other()
    begun.result()
