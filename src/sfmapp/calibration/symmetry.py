"""The crossing of two edges to a small part of a pixel: the point that the picture around it is symmetric about.

Where two straight edges cross between four fields, light and dark in turn, a half turn about the crossing maps the
picture onto itself: whatever the angle between the edges (a board seen obliquely), however wide the blur, if only it is
symmetric itself. So the crossing is where I(p + d) - I(p - d) is least over a window of offsets d, up to a gradient of
the light across it. The window follows the board: a parallelogram along its rows and columns, so that it is as large as
the fields allow, in the direction in which they are foreshortened as well. Where lens and perspective bend the edges
it bends with them, d going along the parabola that neighbouring crossings tell: a straight window would lay the middle
of a chord beside its edge, and catch what else is drawn in the fields.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# A step shorter than this, in pixels, ends the search.
_SHORT_PX = 1e-3
_MAX_STEPS = 12
# a pair at a share s of half of the window weighs exp(-s^2 times this)
WINDOW_DECAY = 1.5


@numba.njit(cache=True, nogil=True)
def symmetric_points(
    gray: NDArray[np.uint8], xy: Array, axes: Array, curves: Array, reach: Array, largest_px: float, out: Array
) -> None:
    """Fill out (N, 2) with the crossings near pixels (N, 2), centres at whole numbers; NaN where there is none.

    Args:
        gray: (H, W).
        axes: (N, 2, 2) pixels along a field's two sides, rows.
        curves: (N, 3, 2) pixels that s^2, s t and t^2 add, s and t in fields along the two sides.
        reach: (2,) how far the window goes along the edges, and how far from the nearer of them, in fields.
        largest_px: half of the window at most.
    """
    for i in range(len(xy)):
        out[i, 0], out[i, 1] = _symmetric_point(gray, xy[i], axes[i], curves[i], reach, largest_px)


@numba.njit(cache=True, nogil=True)
def _symmetric_point(
    gray: NDArray[np.uint8], start: Array, axes: Array, curve: Array, reach: Array, largest_px: float
) -> tuple[float, float]:
    height, width = gray.shape
    lengths = np.sqrt((axes * axes).sum(axis=1))
    if not (lengths[0] > 1.0 and lengths[1] > 1.0):
        return math.nan, math.nan
    # half of the window in fields, and in steps of a pixel
    half = np.empty(2)
    for k in range(2):
        half[k] = min(reach[0], largest_px / lengths[k])
        # three pixels hold an edge at least
        half[k] = max(half[k], 2.5 / lengths[k])
    counts = (max(2, math.ceil(half[0] * lengths[0])), max(2, math.ceil(half[1] * lengths[1])))
    near = (max(reach[1], 2.5 / lengths[0]), max(reach[1], 2.5 / lengths[1]))
    x, y = start[0], start[1]
    A = np.empty((4, 4))
    g = np.empty(4)
    row = np.empty(4)
    limit = 0.35 * min(lengths[0], lengths[1]) + 1.0
    for _ in range(_MAX_STEPS):
        A[:], g[:] = 0.0, 0.0
        for j in range(-counts[1], counts[1] + 1):
            t = half[1] * j / counts[1]
            for i in range(counts[0] + 1):
                if i == 0 and j <= 0:
                    continue  # the other half of the window
                s = half[0] * i / counts[0]
                if abs(s) > near[0] and abs(t) > near[1]:
                    continue
                dx, dy = s * axes[0, 0] + t * axes[1, 0], s * axes[0, 1] + t * axes[1, 1]
                ex = x + s * s * curve[0, 0] + s * t * curve[1, 0] + t * t * curve[2, 0]
                ey = y + s * s * curve[0, 1] + s * t * curve[1, 1] + t * t * curve[2, 1]
                if not (
                    ex - abs(dx) > 1.0
                    and ex + abs(dx) < width - 2.0
                    and ey - abs(dy) > 1.0
                    and ey + abs(dy) < height - 2.0
                ):
                    continue
                p, px, py = _sampled(gray, ex + dx, ey + dy)
                q, qx, qy = _sampled(gray, ex - dx, ey - dy)
                weight = math.exp(-WINDOW_DECAY * ((s / half[0]) ** 2 + (t / half[1]) ** 2))
                row[0], row[1], row[2], row[3] = px - qx, py - qy, dx, dy
                for a in range(4):
                    g[a] += weight * row[a] * (p - q)
                    for b in range(a + 1):
                        A[a, b] += weight * row[a] * row[b]
        step = _solved4(A, g)
        if not math.isfinite(step[0] + step[1]):
            return math.nan, math.nan
        x, y = x - step[0], y - step[1]
        if not math.hypot(x - start[0], y - start[1]) < limit:
            return math.nan, math.nan
        if math.hypot(step[0], step[1]) < _SHORT_PX:
            break
    return x, y


@numba.njit(cache=True, nogil=True)
def _sampled(gray: NDArray[np.uint8], x: float, y: float) -> tuple[float, float, float]:
    """Brightness between four pixels and its derivatives there."""
    i, j = int(x), int(y)
    a, b = x - i, y - j
    p, q, r, s = float(gray[j, i]), float(gray[j, i + 1]), float(gray[j + 1, i]), float(gray[j + 1, i + 1])
    top, low = p + a * (q - p), r + a * (s - r)
    return top + b * (low - top), (1.0 - b) * (q - p) + b * (s - r), low - top


@numba.njit(cache=True, nogil=True)
def _solved4(A: Array, g: Array) -> tuple[float, float]:
    """The first two numbers of the solution of four equations by Cholesky; NaN where they are not independent."""
    L = np.zeros((4, 4))
    for a in range(4):
        for b in range(a + 1):
            value = A[a, b]
            for k in range(b):
                value -= L[a, k] * L[b, k]
            if a == b:
                if not value > 1e-9 * A[a, a] or not A[a, a] > 0.0:
                    return math.nan, math.nan
                L[a, a] = math.sqrt(value)
            else:
                L[a, b] = value / L[b, b]
    z = np.empty(4)
    for a in range(4):
        value = g[a]
        for k in range(a):
            value -= L[a, k] * z[k]
        z[a] = value / L[a, a]
    for a in range(3, -1, -1):
        value = z[a]
        for k in range(a + 1, 4):
            value -= L[k, a] * z[k]
        z[a] = value / L[a, a]
    return z[0], z[1]
