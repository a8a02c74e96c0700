"""Edges of a photograph as chains of sub-pixel points, and the arcs of circles among them that may be straight lines.

Under the division model a straight line of the world is an arc of a circle, whatever the strength of the distortion
(Fitzgibbon, CVPR 2001), so chains are cut where they leave a circle, before anything is known of the lens. Edge points
are maxima of the gradient along the nearer axis of the grid, refined by a parabola, and linked where each is the
other's best neighbour (Grompone von Gioi and Randall, "A sub-pixel edge detector", IPOL 2017, after Devernay 1995).

A chain ends where dark and light change sides: :mod:`sfmapp.calibration.line_joining` goes on there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.circle_arcs import find_spans, fit_circle
from sfmapp.calibration.line_joining import LEAST_PIECE_PX, join_pieces

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

# Points that an arc is summed up in, at equal steps along it: enough for its place, direction and curvature.
KNOTS = 16
# Photographs are halved until the longer side has no more pixels than this: lines are long, and sigmas shrink with the
# length of an arc, not with the number of pixels across it.
MOST_PIXELS = 2000
# Standard deviation of the smoothing in pixels; the parabola needs an edge that spreads over three.
_BLUR_PX = 1.0
# An edge stands out from the noise by this many of its standard deviations: with 4.5 one pixel in 20000 is noise.
_NOISE_SIGMAS = 4.5
# Gradients in grey levels a pixel below which nothing is an edge (rounding to 8 bits), and above which everything is.
_LEAST_GRADIENT, _SURE_GRADIENT = 1.5, 12.0
# Shortest arc, as a share of the longer side and in pixels.
_LEAST_SHARE, _LEAST_PX = 0.025, 30.0
# Most arcs of one photograph, the longest: what more of them add is below what the lens model leaves.
MOST_ARCS = 1200


@dataclass(frozen=True)
class Arcs:
    """Arcs of circles in one photograph, each of which may be a straight line of the world.

    Attributes:
        points: (N, KNOTS, 2) float64 pixels of the photograph, in order along each arc.
        length_px: (N,) from end to end.
        rms_px: (N,) distance of the edge points from the circle.
    """

    points: Array
    length_px: Array
    rms_px: Array

    def __len__(self) -> int:
        return len(self.points)

    def take(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> Arcs:
        """Some of the arcs."""
        return Arcs(self.points[chosen], self.length_px[chosen], self.rms_px[chosen])


def find_arcs(grey: Grey, mask: NDArray[np.bool_] | None = None) -> Arcs:
    """The arcs of a photograph, longest first.

    Args:
        grey: (H, W) uint8.
        mask: (H, W) True where the photograph may be used; None for everywhere.
    """
    import cv2

    scale = 1
    while max(grey.shape) / scale > MOST_PIXELS:
        scale *= 2
    size = grey.shape[1] // scale, grey.shape[0] // scale
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA) if scale > 1 else grey
    smooth = cv2.GaussianBlur(small.astype(np.float32), (0, 0), _BLUR_PX)
    gx, gy = np.zeros_like(smooth), np.zeros_like(smooth)
    gx[:, 1:-1] = 0.5 * (smooth[:, 2:] - smooth[:, :-2])
    gy[1:-1] = 0.5 * (smooth[2:] - smooth[:-2])
    magnitude = np.hypot(gx, gy)
    if mask is not None:
        allowed = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        # the border of a mask is no edge of the scene
        magnitude[cv2.erode(allowed, np.ones((7, 7), np.uint8)) == 0] = 0.0
    # gradients of noise are Rayleigh distributed, with the median 1.18 sigma; in a busy picture this is the texture
    floor = float(np.clip(_NOISE_SIGMAS * np.median(magnitude) / 1.18, _LEAST_GRADIENT, _SURE_GRADIENT))
    xy, ends = _chains(*_edge_points(gx, gy, magnitude, floor))
    least = max(_LEAST_PX, _LEAST_SHARE * max(smooth.shape))
    # the circle of a line has a radius of at least 1 / sqrt(-lambda), which no lens makes less than the half diagonal
    radius = 0.5 * math.hypot(*smooth.shape)
    xy, ends = join_pieces(xy, find_spans(xy, ends, LEAST_PIECE_PX, radius))
    points, rms = _arcs(xy, find_spans(xy, ends, least, radius))
    factor = np.array([grey.shape[1] / size[0], grey.shape[0] / size[1]])
    points *= factor
    length = np.hypot(*(points[:, -1] - points[:, 0]).T)
    order = np.argsort(-length, kind="stable")[:MOST_ARCS]
    return Arcs(points[order], length[order], rms[order] * scale)


@numba.njit(cache=True, nogil=True)
def _edge_points(
    gx: NDArray[np.float32], gy: NDArray[np.float32], magnitude: NDArray[np.float32], floor: float
) -> tuple[Array, Array, NDArray[np.int32]]:
    """(E, 2) pixels and (E, 2) unit gradients of the edge points, and (H, W) the number of the one in each pixel."""
    rows, columns = magnitude.shape
    number = np.full((rows, columns), -1, np.int32)
    count = 0
    for is_counted in (False, True):
        if is_counted:
            xy, normal = np.empty((count, 2)), np.empty((count, 2))
            count = 0
        for r in range(2, rows - 2):
            for c in range(2, columns - 2):
                m = magnitude[r, c]
                if m < floor:
                    continue
                is_across = abs(gx[r, c]) >= abs(gy[r, c])
                before = magnitude[r, c - 1] if is_across else magnitude[r - 1, c]
                after = magnitude[r, c + 1] if is_across else magnitude[r + 1, c]
                if not (m > before and m >= after and before > 0.0 and after > 0.0):
                    continue
                if is_counted:
                    offset = 0.5 * (before - after) / (before - 2.0 * m + after)
                    xy[count, 0] = c + 0.5 + (offset if is_across else 0.0)
                    xy[count, 1] = r + 0.5 + (0.0 if is_across else offset)
                    normal[count, 0], normal[count, 1] = gx[r, c] / m, gy[r, c] / m
                    number[r, c] = count
                count += 1
    return xy, normal, number


@numba.njit(cache=True, nogil=True)
def _best_neighbour(i: int, sign: float, xy: Array, normal: Array, number: NDArray[np.int32]) -> int:
    """The edge point that goes on from i along the edge, or against it (sign -1); -1 where there is none."""
    r, c = int(xy[i, 1]), int(xy[i, 0])
    best, least = -1, 1e9
    for rr in range(max(r - 2, 0), min(r + 3, number.shape[0])):
        for cc in range(max(c - 2, 0), min(c + 3, number.shape[1])):
            j = number[rr, cc]
            if j < 0 or j == i:
                continue
            # edges are followed with the bright side on one hand, and turn by less than 37 degrees from point to point
            if normal[i, 0] * normal[j, 0] + normal[i, 1] * normal[j, 1] < 0.8:
                continue
            dx, dy = xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1]
            along = sign * (dy * normal[i, 0] - dx * normal[i, 1])
            distance = math.sqrt(dx * dx + dy * dy)
            if along > 0.7 * distance and distance < least:
                best, least = j, distance
    return best


@numba.njit(cache=True, nogil=True)
def _chains(xy: Array, normal: Array, number: NDArray[np.int32]) -> tuple[Array, NDArray[np.int64]]:
    """The points in the order of their chains, and (C + 1,) where each chain begins."""
    num = len(xy)
    ahead, behind = np.full(num, -1, np.int64), np.full(num, -1, np.int64)
    for i in range(num):
        ahead[i] = _best_neighbour(i, 1.0, xy, normal, number)
        behind[i] = _best_neighbour(i, -1.0, xy, normal, number)
    onward, is_start = np.full(num, -1, np.int64), np.ones(num, np.bool_)
    for i in range(num):
        j = ahead[i]
        if j >= 0 and behind[j] == i:
            onward[i] = j
            is_start[j] = False
    out, starts = np.empty((num, 2)), np.empty(num + 1, np.int64)
    seen, count, chains = np.zeros(num, np.bool_), 0, 0
    for is_loop in (False, True):
        for first in range(num):
            if seen[first] or (not is_loop and not is_start[first]):
                continue
            starts[chains] = count
            chains += 1
            i = first
            while i >= 0 and not seen[i]:
                seen[i] = True
                out[count] = xy[i]
                count += 1
                i = onward[i]
    starts[chains] = count
    return out, starts[: chains + 1]


@numba.njit(cache=True, nogil=True)
def _arcs(xy: Array, spans: NDArray[np.int64]) -> tuple[Array, Array]:
    """(N, KNOTS, 2) points and (N,) rms of arcs."""
    points, rms, circle = np.empty((len(spans), KNOTS, 2)), np.empty(len(spans)), np.empty(7)
    for k in range(len(spans)):
        rms[k] = fit_circle(xy, spans[k, 0], spans[k, 1], circle)
        _sum_up(xy, spans[k, 0], spans[k, 1], points[k])
    return points, rms


@numba.njit(cache=True, nogil=True)
def _sum_up(xy: Array, first: int, last: int, knots: Array) -> None:
    """The means of equal parts of an arc."""
    for k in range(KNOTS):
        a, b = first + (last - first) * k // KNOTS, first + (last - first) * (k + 1) // KNOTS
        x = y = 0.0
        for i in range(a, b):
            x, y = x + xy[i, 0], y + xy[i, 1]
        knots[k, 0], knots[k, 1] = x / (b - a), y / (b - a)
