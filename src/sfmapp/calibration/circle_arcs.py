"""Arcs of circles along chains of points: where they begin and end, and how exactly points lie on them."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# An arc: rms and largest distance of its points.
_MOST_RMS_PX, _MOST_OFF_PX = 0.45, 1.2
# Points that an arc has at least, and points in a row that may be off before it ends.
_LEAST_POINTS, _PATIENCE = 12, 3


@numba.njit(cache=True, nogil=True)
def fit_circle(xy: Array, first: int, last: int, circle: Array) -> float:
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
def distance_from(circle: Array, x: float, y: float, length: float) -> float:
    """Signed distance of a point from a fitted circle."""
    dx, dy = x - circle[0], y - circle[1]
    u = circle[2] * dx + circle[3] * dy - 0.5 * length
    v = circle[2] * dy - circle[3] * dx
    c = circle[6]
    value = v - circle[4] - circle[5] * u - c * (u * u + v * v)
    gu, gv = circle[5] + 2.0 * c * u, 1.0 - 2.0 * c * v
    return float(value / math.sqrt(gu * gu + gv * gv))


@numba.njit(cache=True, nogil=True)
def _grow(xy: Array, first: int, end: int, circle: Array) -> int:
    """How far from a point on its chain stays on one circle: the place behind the last point of the arc."""
    last = min(first + _LEAST_POINTS, end)
    if last - first < _LEAST_POINTS or fit_circle(xy, first, last, circle) > _MOST_RMS_PX:
        return first
    while True:
        span = math.hypot(xy[last - 1, 0] - xy[first, 0], xy[last - 1, 1] - xy[first, 1])
        # a short arc does not know its curvature: look a third further at most, then fit again
        reach = min(end, last + max((last - first) // 3, 4))
        grown, missed = last, 0
        for i in range(last, reach):
            if abs(distance_from(circle, xy[i, 0], xy[i, 1], span)) > _MOST_OFF_PX:
                missed += 1
                if missed > _PATIENCE:
                    break
            else:
                grown, missed = i + 1, 0
        if grown == last:
            return last
        if fit_circle(xy, first, grown, circle) > _MOST_RMS_PX:
            fit_circle(xy, first, last, circle)
            return last
        last = grown


@numba.njit(cache=True, nogil=True)
def find_spans(xy: Array, starts: NDArray[np.int64], least: float, radius: float) -> NDArray[np.int64]:
    """(N, 2) first points of the arcs of all chains, and the points behind their last."""
    spans = np.empty((len(xy) // _LEAST_POINTS + 1, 2), np.int64)
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
                error = fit_circle(xy, first, last, circle)
                if error <= _MOST_RMS_PX and 2.0 * abs(circle[6]) * radius <= 1.0:
                    spans[count, 0], spans[count, 1] = first, last
                    count += 1
            first = last
    return spans[:count]
