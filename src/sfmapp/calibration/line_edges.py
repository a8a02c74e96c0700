"""Edges of a photograph as chains of sub-pixel points, and the arcs of circles among them that may be straight lines.

Under the division model a straight line of the world is an arc of a circle, whatever the strength of the distortion
(Fitzgibbon, CVPR 2001), so chains are cut where they leave a circle, before anything is known of the lens. Edge points
are maxima of the gradient along the nearer axis of the grid, refined by a parabola, and linked where each is the
other's best neighbour (Grompone von Gioi and Randall, "A sub-pixel edge detector", IPOL 2017, after Devernay 1995).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

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
# An arc: shortest length as a share of the longer side and in pixels, rms and largest distance of its points.
_LEAST_SHARE, _LEAST_PX = 0.025, 30.0
_MOST_RMS_PX, _MOST_OFF_PX = 0.45, 1.2
# Points in a row that may be off before an arc ends.
_PATIENCE = 3
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
    points, rms = _arcs(xy, ends, least, radius)
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
def _fit_circle(xy: Array, first: int, last: int, circle: Array) -> float:
    """Fit ``y = a + b x + c (x^2 + y^2)`` in the frame of the chord of the points first to last (excluded).

    circle (7,) becomes the frame's origin and direction, and a, b, c: exact for circles, linear, and well posed also
    for straight lines. Returns the rms distance, infinite where there is no chord.
    """
    ox, oy = xy[first, 0], xy[first, 1]
    ux, uy = xy[last - 1, 0] - ox, xy[last - 1, 1] - oy
    length = math.sqrt(ux * ux + uy * uy)
    if length < 4.0:
        return math.inf
    ux, uy = ux / length, uy / length
    circle[0], circle[1], circle[2], circle[3] = ox, oy, ux, uy
    n = float(last - first)
    sx = sq = sy = sxx = sxq = sqq = sxy = sqy = syy = 0.0
    for i in range(first, last):
        dx, dy = xy[i, 0] - ox, xy[i, 1] - oy
        x, y = (ux * dx + uy * dy) / length - 0.5, (ux * dy - uy * dx) / length
        q = x * x + y * y
        sx, sq, sy = sx + x, sq + q, sy + y
        sxx, sxq, sqq = sxx + x * x, sxq + x * q, sqq + q * q
        sxy, sqy, syy = sxy + x * y, sqy + q * y, syy + y * y
    mx, mq, my = sx / n, sq / n, sy / n
    cxx, cxq, cqq = sxx / n - mx * mx, sxq / n - mx * mq, sqq / n - mq * mq
    cxy, cqy, cyy = sxy / n - mx * my, sqy / n - mq * my, syy / n - my * my
    det = cxx * cqq - cxq * cxq
    if not det > 1e-12:
        return math.inf
    b, c = (cxy * cqq - cqy * cxq) / det, (cqy * cxx - cxy * cxq) / det
    circle[4], circle[5], circle[6] = (my - b * mx - c * mq) * length, b, c / length
    return length * math.sqrt(max(cyy - b * cxy - c * cqy, 0.0))


@numba.njit(cache=True, nogil=True)
def _off(circle: Array, x: float, y: float, length: float) -> float:
    """Distance of a point from a fitted circle."""
    dx, dy = x - circle[0], y - circle[1]
    u = circle[2] * dx + circle[3] * dy - 0.5 * length
    v = circle[2] * dy - circle[3] * dx
    c = circle[6]
    value = v - circle[4] - circle[5] * u - c * (u * u + v * v)
    gu, gv = circle[5] + 2.0 * c * u, 1.0 - 2.0 * c * v
    return float(abs(value) / math.sqrt(gu * gu + gv * gv))


@numba.njit(cache=True, nogil=True)
def _grow(xy: Array, first: int, end: int, circle: Array) -> int:
    """How far from a point on its chain stays on one circle: the place behind the last point of the arc."""
    last = min(first + 12, end)
    if last - first < 12 or _fit_circle(xy, first, last, circle) > _MOST_RMS_PX:
        return first
    while True:
        span = math.hypot(xy[last - 1, 0] - xy[first, 0], xy[last - 1, 1] - xy[first, 1])
        # a short arc does not know its curvature: look a third further at most, then fit again
        reach = min(end, last + max((last - first) // 3, 4))
        grown, missed = last, 0
        for i in range(last, reach):
            if _off(circle, xy[i, 0], xy[i, 1], span) > _MOST_OFF_PX:
                missed += 1
                if missed > _PATIENCE:
                    break
            else:
                grown, missed = i + 1, 0
        if grown == last:
            return last
        if _fit_circle(xy, first, grown, circle) > _MOST_RMS_PX:
            _fit_circle(xy, first, last, circle)
            return last
        last = grown


@numba.njit(cache=True, nogil=True)
def _arcs(xy: Array, starts: NDArray[np.int64], least: float, radius: float) -> tuple[Array, Array]:
    """(N, KNOTS, 2) points and (N,) rms of the arcs of all chains."""
    most = int(len(xy) / least) + 1
    points, rms = np.empty((most, KNOTS, 2)), np.empty(most)
    circle, count = np.empty(7), 0
    for chain in range(len(starts) - 1):
        first, end = starts[chain], starts[chain + 1]
        while end - first >= least * 0.7:
            last = _grow(xy, first, end, circle)
            if last == first:
                first += 4
                continue
            length = math.hypot(xy[last - 1, 0] - xy[first, 0], xy[last - 1, 1] - xy[first, 1])
            if length >= least:
                error = _fit_circle(xy, first, last, circle)
                if error <= _MOST_RMS_PX and 2.0 * abs(circle[6]) * radius <= 1.0:
                    _sum_up(xy, first, last, points[count])
                    rms[count] = error
                    count += 1
            first = last
    return points[:count], rms[:count]


@numba.njit(cache=True, nogil=True)
def _sum_up(xy: Array, first: int, last: int, knots: Array) -> None:
    """The means of equal parts of an arc."""
    for k in range(KNOTS):
        a, b = first + (last - first) * k // KNOTS, first + (last - first) * (k + 1) // KNOTS
        x = y = 0.0
        for i in range(a, b):
            x, y = x + xy[i, 0], y + xy[i, 1]
        knots[k, 0], knots[k, 1] = x / (b - a), y / (b - a)
