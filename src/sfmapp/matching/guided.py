"""Matching along epipolar lines: the whole of two images for the price of a thin band.

All lines of an epipolar geometry pass through the epipole, so one number tells them apart: the angle within the pencil
of lines. Sorted by it, the features of one image that lie near the line of a feature of the other are neighbours in
memory, and the products of a few rows with a short run of columns are all that is needed.
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

# A feature whose epipolar angle is uncertain by more than this (radians) is compared with all, not sorted in.
_MAX_HALF_ANGLE = 0.1
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
    return background_products(features.descriptors, xy, 3.0 * keypoints[:, 2], _BACKGROUND_SAMPLE)


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
    lines = _Lines(
        pack_rows(image1.descriptors, row_of), rows.lines, image1.shape[row_of], rows.low, rows.high
    )  # fmt: skip
    points = _Points(pack_groups(image2.descriptors, column_of), image2.shape[column_of], columns.angle)
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


@dataclass(frozen=True)
class _Rows:
    order: NDArray[np.int64]  # (N,) features of image 1 by epipolar angle
    lines: Array  # (N, 3) their lines in image 2, unit normals
    low: Array  # (N,) smallest and largest angle of what can lie in the band
    high: Array


@dataclass(frozen=True)
class _Columns:
    order: NDArray[np.int64]  # (M,) features of image 2 by angle, then those near the epipole
    angle: Array  # (F,) angles of the first of them, ascending in 0 to pi


def _sort_into_pencil(
    image1: GuidedImage, image2: GuidedImage, fundamental: Array, band_px: float
) -> tuple[_Rows, _Columns]:
    """Angles of both images' features in the pencil of epipolar lines of image 2.

    In coordinates that centre and scale image 2, the lines through the epipole e are cos(a) p + sin(a) q for two
    orthonormal p, q. Feature x2 has angle a2 with l(a2) . x2 = 0, and l(a) . x2 = r sin(a - a2), r = |(p.x2, q.x2)|,
    so x2 is within the band of l(a) if r |sin(a - a2)| <= band |normal of l(a)|.
    """
    xy2 = image2.shape[:, :2]
    center = xy2.mean(0) if len(xy2) else np.zeros(2)
    size = max(float(np.abs(xy2 - center).max()), 1.0) if len(xy2) else 1.0
    pixels_from_normalized = np.array([[size, 0.0, center[0]], [0.0, size, center[1]], [0.0, 0.0, 1.0]])
    f = pixels_from_normalized.T @ fundamental
    p, q = np.linalg.svd(np.linalg.svd(f)[0][None, :, 2])[2][1:]
    angle1, half, lines = np.empty(len(image1.shape)), np.empty(len(image1.shape)), np.empty((len(image1.shape), 3))
    _line_angles(image1.shape, f, np.linalg.inv(pixels_from_normalized), p, q, band_px / size, angle1, half, lines)
    angle2, r = np.empty(len(xy2)), np.empty(len(xy2))
    _point_angles(image2.shape, center, size, p, q, angle2, r)
    is_near = r * math.sin(_MAX_HALF_ANGLE) < half.max(initial=0.0)
    far = np.flatnonzero(~is_near)
    far = far[np.argsort(angle2[far], kind="stable")]
    half_angle = np.arcsin(np.minimum(half / r[far].min(initial=np.inf), 1.0)) if len(far) else half
    order = np.argsort(angle1, kind="stable")
    rows = _Rows(order, lines[order], (angle1 - half_angle)[order], (angle1 + half_angle)[order])
    return rows, _Columns(np.concatenate([far, np.flatnonzero(is_near)]), angle2[far])


@numba.njit(cache=True, nogil=True)
def _line_angles(
    shape1: Array, f: Array, normalized_from_pixels: Array, p: Array, q: Array, band: float,
    angle: Array, half: Array, lines: Array,
) -> None:  # fmt: skip
    """Angle of each line in the pencil, band times the length of its normal there, and the line in pixels."""
    line = np.empty(3)
    for i in range(shape1.shape[0]):
        norm = 0.0
        for k in range(3):
            line[k] = f[k, 0] * shape1[i, 0] + f[k, 1] * shape1[i, 1] + f[k, 2]
            norm += line[k] * line[k]
        for k in range(3):
            line[k] /= max(math.sqrt(norm), 1e-300)
        along_p = line[0] * p[0] + line[1] * p[1] + line[2] * p[2]
        along_q = line[0] * q[0] + line[1] * q[1] + line[2] * q[2]
        angle[i] = math.atan2(along_q, along_p) % math.pi
        half[i] = band * math.sqrt(line[0] * line[0] + line[1] * line[1])
        for k in range(3):
            lines[i, k] = (
                line[0] * normalized_from_pixels[0, k]
                + line[1] * normalized_from_pixels[1, k]
                + line[2] * normalized_from_pixels[2, k]
            )
        norm = max(math.sqrt(lines[i, 0] * lines[i, 0] + lines[i, 1] * lines[i, 1]), 1e-300)
        for k in range(3):
            lines[i, k] /= norm


@numba.njit(cache=True, nogil=True)
def _point_angles(shape2: Array, center: Array, size: float, p: Array, q: Array, angle: Array, r: Array) -> None:
    """Angle of the line through each point in the pencil, and the point's lever r."""
    for i in range(shape2.shape[0]):
        x, y = (shape2[i, 0] - center[0]) / size, (shape2[i, 1] - center[1]) / size
        along_p, along_q = x * p[0] + y * p[1] + p[2], x * q[0] + y * q[1] + q[2]
        angle[i] = math.atan2(-along_p, along_q) % math.pi
        r[i] = math.sqrt(along_p * along_p + along_q * along_q)


class _Lines(NamedTuple):
    """The features of image 1 in the order of their angles.

    Attributes:
        packed: (N', ...) descriptors, see ``pack_rows``.
        lines: (N, 3) in image 2. shape: (N, 4). low, high: (N,) angles, see :class:`_Rows`.
    """

    packed: Packed
    lines: Array
    shape: Array
    low: Array
    high: Array


class _Points(NamedTuple):
    """Those of image 2: packed descriptors, see ``pack_groups``, shape (M, 4) and angle (F,), see :class:`_Columns`."""

    packed: Packed
    shape: Array
    angle: Array


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
    a, packed, lines, shape1, shape2 = image1.packed, image2.packed, image1.lines, image1.shape, image2.shape
    band, change = gate
    first1, second1, partner1 = best1
    first2, second2, partner2 = best2
    sums, masks = room
    for group in range(first // width * GROUPS, (last + width - 1) // width * GROUPS, GROUPS):
        if not tile(a, packed, row, group, sums, masks, second1, second2):
            continue
        for r in range(ROWS):
            i, left = row + r, masks[r]
            while left != 0:
                q = first_bit(np.uint64(left))
                left &= left - np.uint32(1)
                j = group * LANES + q
                if j < first or j >= last:
                    continue
                if abs(lines[i, 0] * shape2[j, 0] + lines[i, 1] * shape2[j, 1] + lines[i, 2]) > band:
                    continue
                log_scale = shape2[j, 2] - shape1[i, 2]
                if log_scale < change[0] or log_scale > change[1]:
                    continue
                turn = shape2[j, 3] - shape1[i, 3] - change[2]
                if abs(turn - 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)) > change[3]:
                    continue
                keep_two_largest(first1, second1, partner1, i, j, sums[r, q])
                keep_two_largest(first2, second2, partner2, j, i, sums[r, q])


@numba.njit(cache=True, nogil=True)
def _first_above(ascending: Array, value: float) -> int:
    low, high = 0, ascending.shape[0]
    while low < high:
        middle = (low + high) // 2
        if ascending[middle] > value:
            high = middle
        else:
            low = middle + 1
    return low


@numba.njit(cache=True, nogil=True)
def _scan_band(image1: _Lines, image2: _Points, gate: _Gate, best1: Best, best2: Best, room: TileRoom) -> None:
    low, high, angle2 = image1.low, image1.high, image2.angle
    num_rows, num_far, num_all = low.shape[0], angle2.shape[0], image2.shape.shape[0]
    for row in range(0, num_rows, ROWS):
        smallest, largest = low[row], high[row]
        for i in range(row + 1, min(row + ROWS, num_rows)):
            smallest, largest = min(smallest, low[i]), max(largest, high[i])
        # angles are modulo pi: a run that leaves 0 to pi goes on at the other end
        starts = (_first_above(angle2, smallest), _first_above(angle2, smallest + math.pi), 0, num_far)
        ends = (
            _first_above(angle2, largest), num_far,
            _first_above(angle2, largest - math.pi), num_all,
        )  # fmt: skip
        if largest - smallest >= math.pi:
            starts, ends = (0, 0, 0, num_far), (num_far, 0, 0, num_all)
        for run in range(4):
            if starts[run] < ends[run]:
                _scan_run(image1, image2, gate, row, (starts[run], ends[run]), best1, best2, room)


def compile_kernels() -> None:
    """Compile the kernels that matching uses, or load them from numba's cache."""
    tiny = np.arange(4 * DIMS, dtype=np.uint8).reshape(4, DIMS)
    largest_products(tiny, tiny)
    keypoints = np.array([[0.0, 0.0, 1.0, 0.0], [5.0, 1.0, 1.0, 0.0], [2.0, 4.0, 1.0, 0.0], [3.0, 7.0, 1.0, 0.0]])
    features = Features(keypoints.astype(np.float32), tiny, np.zeros((4, 3), np.uint8))
    image = GuidedImage.of(features, background_of(features))
    sideways = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    match_guided(image, image, sideways, 1.0, np.array([-1.0, 1.0, 0.0, 1.0]), 0.8, 0.7)
