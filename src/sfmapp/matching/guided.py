"""Matching along epipolar lines: the whole of two images for the price of a thin band.

All lines of an epipolar geometry pass through the epipole, so one number tells them apart: the angle within the pencil
of lines, or what grows with it. Sorted by that, the features of one image that lie near the line of a feature of the
other are neighbours in memory, and the products of a few rows with a short run of columns are all that is needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.matching.descriptors import mutual_neighbors
from sfmapp.matching.products import (
    Best,
    Ints,
    Packed,
    TileRoom,
    background_products,
    keep_two_largest,
    largest_products,
    pack_groups,
    pack_rows,
)
from sfmapp.scene.features import Features
from sfmapp.simd.bits import first_bit
from sfmapp.simd.dots import DIMS, GROUPS, LANES, ROWS, tile

Array = NDArray[np.float64]
Order = NDArray[np.int64]

# A feature whose epipolar angle is uncertain by more than this (radians) is compared with all, not sorted in.
_MAX_HALF_ANGLE = 0.1
# Into so many bins of the pencil features are sorted: two or three share one, and a run of them takes in two too many.
_BINS = 4096
# Features of one image that stand for all that a feature could be mistaken for.
_BACKGROUND_SAMPLE = 2048


@dataclass(frozen=True)
class GuidedImage:
    """What guided matching reads of an image.

    Attributes:
        descriptors: (N, 128) uint8.
        shape: (N, 4) float64 x, y in pixels, log2 of the scale, orientation in radians.
        background: (N,) int32 from :func:`background_of`.
    """

    descriptors: NDArray[np.uint8]
    shape: Array
    background: Ints

    @property
    def extent(self) -> tuple[float, float]:
        """Width and height in pixels of where its features are."""
        # column by column, as numpy takes ten times as long over both
        return float(np.ptp(self.shape[:, 0])), float(np.ptp(self.shape[:, 1]))

    @classmethod
    def of(cls, features: Features, background: Ints) -> GuidedImage:
        shape = features.keypoints.astype(np.float64)
        shape[:, 2] = np.log2(np.maximum(shape[:, 2], 1e-3))
        return cls(np.ascontiguousarray(features.descriptors), shape, background)


def background_of(features: Features) -> Ints:
    """(N,) int32 largest product of each feature with a sample of those elsewhere in the same image.

    The ratio test needs a second best from all over an image. Within a band there are a hundred times fewer, and nearly
    all that it lets through stays, since it also fits the epipolar geometry. A feature's likeness to its own image is
    known before any pair is, and serves all of them. Three sigmas away a neighbour shows something else.
    """
    keypoints = features.keypoints.astype(np.float64)
    xy = np.ascontiguousarray(keypoints[:, :2])
    radius = 3.0 * keypoints[:, 2]
    return background_products(features.descriptors, xy, radius, _BACKGROUND_SAMPLE, features.is_dark)


def change_of_shape(image1: GuidedImage, image2: GuidedImage, matches: NDArray[np.int32]) -> Array:
    """How scale and orientation change between two images, from some sure matches (K, 2), K > 0.

    Returns:
        (4,) least and largest log2 of the scale ratio, centre and half width of the rotation in radians: what 96 % of
        the matches do, widened by half an octave and a quarter of the angle.
    """
    change = image2.shape[matches[:, 1], 2:] - image1.shape[matches[:, 0], 2:]
    low, high = np.quantile(change[:, 0], [0.02, 0.98])
    centre = math.atan2(float(np.sin(change[:, 1]).sum()), float(np.cos(change[:, 1]).sum()))
    spread = np.abs((change[:, 1] - centre + math.pi) % (2 * math.pi) - math.pi)
    half_width = max(1.25 * float(np.quantile(spread, 0.96)), math.radians(30))
    return np.array([low - 0.5, high + 0.5, centre, half_width])


def match_guided(
    image1: GuidedImage,
    image2: GuidedImage,
    fundamental: Array,
    band_px: float,
    change: Array,
    max_ratio: float,
    max_distance: float,
) -> NDArray[np.int32]:
    """Mutual nearest neighbours within a band around the epipolar lines.

    Args:
        fundamental: (3, 3) with x2^T F x1 = 0.
        band_px: largest distance of a feature of image 2 from the line of its partner.
        change: (4,) from :func:`change_of_shape`.
        max_ratio, max_distance: see MatchingOptions. The second best is that of the band or of the background,
            whichever is nearer.

    Returns:
        (K, 2) int32 positions in both, ascending in the first; no position occurs twice.
    """
    rows, columns = _sort_into_pencil(image1, image2, fundamental, band_px)
    row_of, column_of = rows.order, columns.order
    lines = _Lines(pack_rows(image1.descriptors, row_of), rows, image1.shape)
    points = _Points(pack_groups(image2.descriptors, column_of), columns, image2.shape)
    best1 = _none_but_background(image1.background[row_of], len(lines.packed))
    best2 = _none_but_background(image2.background[column_of], len(points.packed) * LANES)
    _scan_band(lines, points, _Gate(float(band_px), change), best1, best2, TileRoom.make())
    found = mutual_neighbors(best1, best2, max_ratio, max_distance)
    matches = np.stack([row_of[found[:, 0]], column_of[found[:, 1]]], 1).astype(np.int32)
    return matches[np.argsort(matches[:, 0])]


def _none_but_background(background: Ints, num: int) -> Best:
    """No partner yet; what a feature looks like elsewhere in its own image bounds both products."""
    bound = np.zeros(num, np.int32)
    bound[: len(background)] = background
    return Best(bound, bound.copy(), np.full(num, -1, np.int32))


class _Rows(NamedTuple):
    """Features of image 1 in the pencil.

    Attributes:
        order: (N,) features by place. place, reach: (N,) where their lines are, see :func:`_place_of`, and how far from
            there what lies in the band can be.
        lines: (N, 3) in image 2, unit normals.
    """

    order: Order
    place: Array
    reach: Array
    lines: Array


class _Columns(NamedTuple):
    """Features of image 2 in the pencil.

    Attributes:
        order: (M,) features by bin, and behind them those near the epipole.
        starts: (_BINS + 1,) where each bin begins, and where those near the epipole do.
    """

    order: Order
    starts: Order


class _Pencil(NamedTuple):
    """The epipolar lines of image 2.

    Attributes:
        f: (3, 3) lines of pixels of image 1, in coordinates that centre and scale image 2.
        normalized_from_pixels: (3, 3) to these coordinates. size: pixels of their unit.
        p, q: (3,) orthonormal basis of the lines through the epipole.
        band: largest distance from a line, in their unit.
    """

    f: Array
    normalized_from_pixels: Array
    size: float
    p: Array
    q: Array
    band: float


def _sort_into_pencil(
    image1: GuidedImage, image2: GuidedImage, fundamental: Array, band_px: float
) -> tuple[_Rows, _Columns]:
    """The features of both images in the pencil of epipolar lines of image 2.

    In coordinates that centre and scale image 2, the lines through the epipole e are cos(a) p + sin(a) q for two
    orthonormal p, q. Feature x2 has angle a2 with l(a2) . x2 = 0, and l(a) . x2 = r sin(a - a2), r = |(p.x2, q.x2)|,
    so x2 is within the band of l(a) if r |sin(a - a2)| <= band |normal of l(a)|.
    """
    num1, num2 = len(image1.shape), len(image2.shape)
    center, size = np.zeros(2), 1.0
    if num2:  # column by column, as numpy takes ten times as long over both
        for k in (0, 1):
            center[k] = image2.shape[:, k].mean()
            size = max(size, float(np.abs(image2.shape[:, k] - center[k]).max()))
    pixels_from_normalized = np.array([[size, 0.0, center[0]], [0.0, size, center[1]], [0.0, 0.0, 1.0]])
    f = pixels_from_normalized.T @ fundamental
    p, q = np.linalg.svd(np.linalg.svd(f)[0][None, :, 2])[2][1:]
    pencil = _Pencil(f, np.linalg.inv(pixels_from_normalized), size, p, q, band_px / size)
    place1, reach, lines = np.empty(num1), np.empty(num1), np.empty((num1, 3))
    widest = _place_lines(image1.shape, pencil, place1, reach, lines)
    place2, is_near = np.empty(num2), np.empty(num2, np.bool_)
    _reach_of(place1, reach, _place_points(image2.shape, pencil, widest, place2, is_near))
    rows = _Rows(np.empty(num1, np.int64), place1, reach, lines)
    columns = _Columns(np.empty(num2, np.int64), _no_bins())
    _sort_by_bin(place1, np.zeros(num1, np.bool_), rows.order, _no_bins())
    _sort_by_bin(place2, is_near, columns.order, columns.starts)
    return rows, columns


def _no_bins() -> Order:
    return np.zeros(_BINS + 1, np.int64)


@numba.njit(cache=True, nogil=True)
def _place_of(x: float, y: float) -> float:
    """A number in [0, 1] that grows with the angle of (x, y), modulo half a turn, about half as fast as that or up to
    a whole: ``slope = 0.5 / (|cos| + |sin|)^2``."""
    if y < 0.0:
        x, y = -x, -y
    total = max(abs(x) + y, 1e-300)
    return 0.5 * y / total if x >= 0.0 else 1.0 - 0.5 * y / total


@numba.njit(cache=True, nogil=True)
def _place_lines(shape1: Array, pencil: _Pencil, place: Array, reach: Array, lines: Array) -> float:
    """Place of each line in the pencil, band times the length of its normal there, the largest of which is returned,
    and the line in pixels."""
    f, p, q, widest = pencil.f, pencil.p, pencil.q, 0.0
    line = np.empty(3)
    for i in range(shape1.shape[0]):
        norm = 0.0
        for k in range(3):
            line[k] = f[k, 0] * shape1[i, 0] + f[k, 1] * shape1[i, 1] + f[k, 2]
            norm += line[k] * line[k]
        norm = 1.0 / max(math.sqrt(norm), 1e-300)
        for k in range(3):
            line[k] *= norm
        along_p = line[0] * p[0] + line[1] * p[1] + line[2] * p[2]
        along_q = line[0] * q[0] + line[1] * q[1] + line[2] * q[2]
        place[i] = _place_of(along_p, along_q)
        reach[i] = pencil.band * math.sqrt(line[0] * line[0] + line[1] * line[1])
        widest = max(widest, reach[i])
        for k in range(3):
            lines[i, k] = (
                line[0] * pencil.normalized_from_pixels[0, k]
                + line[1] * pencil.normalized_from_pixels[1, k]
                + line[2] * pencil.normalized_from_pixels[2, k]
            )
        norm = 1.0 / max(math.sqrt(lines[i, 0] * lines[i, 0] + lines[i, 1] * lines[i, 1]), 1e-300)
        for k in range(3):
            lines[i, k] *= norm
    return widest


@numba.njit(cache=True, nogil=True)
def _place_points(shape2: Array, pencil: _Pencil, widest: float, place: Array, is_near: NDArray[np.bool_]) -> float:
    """Place in the pencil of the line through each point, and whether it is so near to the epipole that its angle means
    nothing; returns the least lever of the others."""
    p, q, to = pencil.p, pencil.q, pencil.normalized_from_pixels
    least, limit = math.inf, widest / math.sin(_MAX_HALF_ANGLE)
    for i in range(shape2.shape[0]):
        x, y = to[0, 0] * shape2[i, 0] + to[0, 2], to[1, 1] * shape2[i, 1] + to[1, 2]
        along_p, along_q = x * p[0] + y * p[1] + p[2], x * q[0] + y * q[1] + q[2]
        place[i] = _place_of(along_q, -along_p)
        lever = math.sqrt(along_p * along_p + along_q * along_q)
        is_near[i] = lever < limit
        if not is_near[i]:
            least = min(least, lever)
    return least


@numba.njit(cache=True, nogil=True)
def _reach_of(place: Array, reach: Array, lever: float) -> None:
    """Make of band times normal how far from its place in the pencil what lies in the band can be.

    Its angle is off by no more than arcsin(reach / lever), at most _MAX_HALF_ANGLE; the slope of the place is at most a
    half, and grows by less than a quarter over that angle.
    """
    for i in range(place.shape[0]):
        angle = math.asin(min(reach[i] / lever, 1.0))
        # |sin| and |cos| over their sum are s and 1 - s
        s = 2.0 * place[i] if place[i] < 0.5 else 2.0 - 2.0 * place[i]
        slope = 0.5 * (s * s + (1.0 - s) * (1.0 - s))
        reach[i] = angle * min(1.3 * slope, 0.5) + 1e-9


@numba.njit(cache=True, nogil=True)
def _sort_by_bin(place: Array, is_last: NDArray[np.bool_], order: Order, starts: Order) -> None:
    """Fill the positions by bin of their place, as they come within one, those that are last behind all bins; and
    starts (_BINS + 1,), zeros before, with where each bin begins and the last do."""
    num, num_sorted = place.shape[0], 0
    for i in range(num):
        if not is_last[i]:
            starts[_bin_of(place[i])] += 1
            num_sorted += 1
    total = 0
    for k in range(_BINS):
        starts[k], total = total, total + starts[k]
    starts[_BINS] = num_sorted
    last = num_sorted
    for i in range(num):
        if is_last[i]:
            order[last] = i
            last += 1
        else:
            k = _bin_of(place[i])
            order[starts[k]] = i
            starts[k] += 1
    for k in range(_BINS - 1, 0, -1):
        starts[k] = starts[k - 1]
    starts[0] = 0


@numba.njit(cache=True, nogil=True)
def _bin_of(place: float) -> int:
    return min(max(int(place * _BINS), 0), _BINS - 1)


class _Lines(NamedTuple):
    """Features of image 1: packed descriptors (N', ...) in their order, see ``pack_rows``, and (N, 4) shapes."""

    packed: Packed
    rows: _Rows
    shape: Array


class _Points(NamedTuple):
    """Those of image 2: packed descriptors in their order, see ``pack_groups``, and (M, 4) shapes."""

    packed: Packed
    columns: _Columns
    shape: Array


class _Gate(NamedTuple):
    """What a match has to fit: pixels from the line, and change of shape (4,)."""

    band: float
    change: Array


@numba.njit(cache=True, nogil=True)
def _scan_run(
    image1: _Lines, image2: _Points, gate: _Gate, row: int, run: tuple[int, int], best1: Best, best2: Best,
    room: TileRoom,
) -> None:  # fmt: skip
    """Products of ROWS rows with a run of columns; what lies outside the band is dropped afterwards."""
    width, (first, last) = LANES * GROUPS, run
    band, change = gate
    first1, second1, partner1 = best1
    first2, second2, partner2 = best2
    sums, masks = room
    for group in range(first // width * GROUPS, (last + width - 1) // width * GROUPS, GROUPS):
        if not tile(image1.packed, image2.packed, row, group, sums, masks, second1, second2):
            continue
        for r in range(ROWS):
            i, left = row + r, masks[r]
            while left != 0:
                q = first_bit(np.uint64(left))
                left &= left - np.uint32(1)
                j = group * LANES + q
                if j < first or j >= last:
                    continue
                of1, of2 = image1.rows.order[i], image2.columns.order[j]
                line, shape1, shape2 = image1.rows.lines[of1], image1.shape[of1], image2.shape[of2]
                if abs(line[0] * shape2[0] + line[1] * shape2[1] + line[2]) > band:
                    continue
                log_scale = shape2[2] - shape1[2]
                if log_scale < change[0] or log_scale > change[1]:
                    continue
                turn = shape2[3] - shape1[3] - change[2]
                if abs(turn - 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)) > change[3]:
                    continue
                keep_two_largest(first1, second1, partner1, i, j, sums[r, q])
                keep_two_largest(first2, second2, partner2, j, i, sums[r, q])


@numba.njit(cache=True, nogil=True)
def _scan_band(image1: _Lines, image2: _Points, gate: _Gate, best1: Best, best2: Best, room: TileRoom) -> None:
    rows, (of_column, starts) = image1.rows, image2.columns
    num_rows, num_all = rows.order.shape[0], of_column.shape[0]
    for row in range(0, num_rows, ROWS):
        low, high = math.inf, -math.inf
        for i in range(row, min(row + ROWS, num_rows)):
            n = rows.order[i]
            low, high = min(low, rows.place[n] - rows.reach[n]), max(high, rows.place[n] + rows.reach[n])
        # places are modulo 1: a run that leaves 0 to 1 goes on at the other end
        runs = (
            (starts[_bin_of(low)], starts[_bin_of(high) + 1]),
            (starts[_bin_of(low + 1.0)] if low < 0.0 else starts[_BINS], starts[_BINS]),
            (0, starts[_bin_of(high - 1.0) + 1] if high > 1.0 else 0),
            (starts[_BINS], num_all),
        )
        if high - low >= 1.0:
            runs = ((0, starts[_BINS]), (0, 0), (0, 0), (starts[_BINS], num_all))
        for run in runs:
            if run[0] < run[1]:
                _scan_run(image1, image2, gate, row, run, best1, best2, room)


def compile_kernels() -> None:
    """Compile the kernels that matching uses, or load them from numba's cache."""
    tiny = np.arange(4 * DIMS, dtype=np.uint8).reshape(4, DIMS)
    largest_products(tiny, tiny)
    keypoints = np.array([[0.0, 0.0, 1.0, 0.0], [5.0, 1.0, 1.0, 0.0], [2.0, 4.0, 1.0, 0.0], [3.0, 7.0, 1.0, 0.0]])
    features = Features(keypoints.astype(np.float32), tiny, np.zeros((4, 3), np.uint8))
    image = GuidedImage.of(features, background_of(features))
    sideways = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    match_guided(image, image, sideways, 1.0, np.array([-1.0, 1.0, 0.0, 1.0]), 0.8, 0.7)
