"""Cells against silhouettes: what a view says of a cell in constant time, and the children of cells that it splits.

A cell's picture is held in a box of pixels. The projection of a cube is convex, so that of a lens that changes nothing
is bounded exactly by linear forms; of any other lens by its most pixels to a radian and the angle that the cell fills.
The distance to the outline at the box's middle decides almost always (no point is farther inside or outside than the
outline is away); near the outline the signed distance is bounded over the box itself, of which more is undecided only
if the outline passes through it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera import lens
from sfmapp.geometry.morton import gather_bits

Array = NDArray[np.float64]
Codes = NDArray[np.uint64]

# distances are kept in steps of 1 / 64 pixel, up to 512 pixels, in two bytes
STEPS = 64.0
# Two bilinear readings of distances may differ by this much more than their places: each is a mean of distances at
# up to 0.71 pixels. And what a distance may be wrong, of outlines told to a fraction of a pixel.
SLACK = 2.0
# half a side of a box in pixels below which it is looked at pixel by pixel
_SMALL = 3.0
# what a view says of a cell; PARTLY: it does not see all of it, and shows inside what it sees
UNDECIDED, INSIDE, OUTSIDE, UNSEEN, PARTLY = 0, 1, 2, 3, 4
# an angle beyond which a cell is too near to the camera to be bounded
_WIDE = 1.0


class Fields(NamedTuple):
    """Views and silhouettes as arrays.

    Attributes:
        rows: (N, 29) of :mod:`sfmapp.carve.views`.
        lenses: (N, 5) most pixels to a radian or 0, axis and half angle of what is seen.
        sizes: (N, 2) height and width.
        starts: (N,) places of the first pixels in ``distance``, (P,) int16 of all pictures, row by row.
        known_starts: (N,) the same in ``known``, signed distances to what is not known, -1 where all is.
    """

    rows: Array
    lenses: Array
    sizes: NDArray[np.int64]
    starts: NDArray[np.int64]
    distance: NDArray[np.int16]
    known_starts: NDArray[np.int64]
    known: NDArray[np.int16]


class Cells(NamedTuple):
    """Cells of a level that are still undecided, and which views have not decided them.

    Attributes:
        codes: (N,) ascending.
        ends: (N,) end of each one's views in ``views`` (V,), positions in :class:`Fields`.
        seen, missed: (N,) views that show it inside or outside as a whole, and of these outside.
    """

    codes: Codes
    ends: NDArray[np.int64]
    views: NDArray[np.uint16]
    seen: NDArray[np.uint16]
    missed: NDArray[np.uint16]


@numba.njit(cache=True, nogil=True, inline="always")
def reading(pixels: NDArray[np.int16], start: int, height: int, width: int, u: float, v: float) -> float:
    """Distance in pixels at a place in a picture, between pixel centres by lines, beyond the last ones theirs."""
    x = min(max(u - 0.5, 0.0), width - 1.0)
    y = min(max(v - 0.5, 0.0), height - 1.0)
    i, j = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
    x, y = x - i, y - j
    right, below = min(1, width - 1), min(1, height - 1) * width
    at = start + j * width + i
    top = pixels[at] + x * (pixels[at + right] - pixels[at])
    bottom = pixels[at + below] + x * (pixels[at + below + right] - pixels[at + below])
    return float(top + y * (bottom - top)) / STEPS


@numba.njit(cache=True, nogil=True)
def _next(at: float, end: float) -> float:
    """The next centre of pixels after a place, or the end."""
    following = math.floor(at + 0.5) + 0.5
    return min(following, end)


@numba.njit(cache=True, nogil=True)
def side_of_box(
    pixels: NDArray[np.int16], start: int, size: NDArray[np.int64], u0: float, u1: float, v0: float, v1: float
) -> int:
    """INSIDE or OUTSIDE if the distance has one sign in a box of a picture, UNDECIDED otherwise: exact, as a bilinear
    function is least and most in a rectangle at corners, here those into which pixel centres cut the box."""
    is_inside = reading(pixels, start, size[0], size[1], u0, v0) > 0.0
    v = v0
    while True:
        u = u0
        while True:
            if (reading(pixels, start, size[0], size[1], u, v) > 0.0) != is_inside:
                return UNDECIDED
            if u >= u1:
                break
            u = _next(u, u1)
        if v >= v1:
            break
        v = _next(v, v1)
    return INSIDE if is_inside else OUTSIDE


@numba.njit(cache=True, nogil=True)
def plain_box(row: Array, x: float, y: float, z: float, half: float) -> tuple[int, float, float, float, float, float]:
    """What bounds the picture of a cell by a lens that changes nothing: UNDECIDED or UNSEEN, the picture of its middle,
    half widths and radius in pixels; where a point is off by a step of half a side along axis j the pixel moves by
    (row 0 - u row 2)_j / depth, of the depth where it is."""
    a = row[0] * x + row[1] * y + row[2] * z + row[3]
    b = row[4] * x + row[5] * y + row[6] * z + row[7]
    c = row[8] * x + row[9] * y + row[10] * z + row[11]
    reach = half * (abs(row[8]) + abs(row[9]) + abs(row[10]))
    if c + reach <= 0.0:
        return UNSEEN, 0.0, 0.0, 0.0, 0.0, 0.0
    nearest = c - reach
    if nearest <= 1e-3 * reach:
        return UNDECIDED, 0.0, 0.0, -1.0, 0.0, 0.0
    p, q = a / c, b / c
    fx, fy = row[12], row[13]
    gx, gy = fx * (row[0] - p * row[8]), fy * (row[4] - q * row[8])
    hx, hy = fx * (row[1] - p * row[9]), fy * (row[5] - q * row[9])
    kx, ky = fx * (row[2] - p * row[10]), fy * (row[6] - q * row[10])
    scale = half / nearest
    most = 0.0
    for sign in range(4):
        s, t = (1.0 if sign & 1 else -1.0), (1.0 if sign & 2 else -1.0)
        dx, dy = gx + s * hx + t * kx, gy + s * hy + t * ky
        most = max(most, dx * dx + dy * dy)
    wide, high = abs(gx) + abs(hx) + abs(kx), abs(gy) + abs(hy) + abs(ky)
    return INSIDE, fx * p + row[14], fy * q + row[15], scale * wide, scale * high, scale * math.sqrt(most)


@numba.njit(cache=True, nogil=True)
def lens_box(
    row: Array, bounds: Array, x: float, y: float, z: float, half: float
) -> tuple[int, float, float, float, float, float]:
    """The same by any lens, from the angle that the cell fills: its corners are in the cone, so all of it is."""
    a = row[0] * x + row[1] * y + row[2] * z + row[3]
    b = row[4] * x + row[5] * y + row[6] * z + row[7]
    c = row[8] * x + row[9] * y + row[10] * z + row[11]
    away = math.sqrt(a * a + b * b + c * c)
    least = 1.0
    for corner in range(8):
        s = half if corner & 1 else -half
        t = half if corner & 2 else -half
        w = half if corner & 4 else -half
        da = a + s * row[0] + t * row[1] + w * row[2]
        db = b + s * row[4] + t * row[5] + w * row[6]
        dc = c + s * row[8] + t * row[9] + w * row[10]
        norm = away * math.sqrt(da * da + db * db + dc * dc)
        least = min(least, (a * da + b * db + c * dc) / norm if norm > 0.0 else -1.0)
    angle = math.acos(max(least, -1.0))
    if not angle < _WIDE:
        return UNDECIDED, 0.0, 0.0, -1.0, 0.0, 0.0
    toward = (a * bounds[1] + b * bounds[2] + c * bounds[3]) / away
    if math.acos(min(max(toward, -1.0), 1.0)) - angle > bounds[4]:
        return UNSEEN, 0.0, 0.0, 0.0, 0.0, 0.0
    u, v = lens.project(row[12:], a, b, c)
    if math.isnan(u) or math.isnan(v):
        return UNDECIDED, 0.0, 0.0, -1.0, 0.0, 0.0
    radius = bounds[0] * angle
    return INSIDE, u, v, radius, radius, radius


@numba.njit(cache=True, nogil=True)
def judge(fields: Fields, view: int, x: float, y: float, z: float, half: float) -> int:
    """What a view says of the cell with a middle and half a side: INSIDE, OUTSIDE or UNSEEN as a whole, PARTLY or
    UNDECIDED."""
    row, bounds, size = fields.rows[view], fields.lenses[view], fields.sizes[view]
    height, width = size[0], size[1]
    is_plain = bounds[0] == 0.0
    if is_plain:
        what, u, v, wide, high, radius = plain_box(row, x, y, z, half)
    else:
        what, u, v, wide, high, radius = lens_box(row, bounds, x, y, z, half)
    if what != INSIDE:
        return what
    u0, u1, v0, v1 = u - wide, u + wide, v - high, v + high
    start, known = fields.starts[view], fields.known_starts[view]
    # beyond the last pixels theirs are read: no farther from any place in the picture than the box's middle is
    d = reading(fields.distance, start, height, width, u, v)
    is_whole = u0 >= 0.0 and v0 >= 0.0 and u1 <= width and v1 <= height
    if not is_whole:
        if not is_plain:
            # beyond the picture a lens may turn back, and its slopes are not bounded
            return UNDECIDED
        if u1 < 0.0 or v1 < 0.0 or u0 > width or v0 > height:
            return UNSEEN
    if known >= 0:
        k = reading(fields.known, known, height, width, u, v)
        if k < -radius - SLACK:
            return UNSEEN
        if k <= radius + SLACK and is_whole:
            side = side_of_box(fields.known, known, size, u0, u1, v0, v1)
            if side == OUTSIDE:
                return UNSEEN
            is_whole = side == INSIDE
    if d > radius + SLACK:
        return INSIDE if is_whole else PARTLY
    if not is_whole:
        return UNDECIDED
    if d < -radius - SLACK:
        return OUTSIDE
    if max(wide, high) > _SMALL:
        return UNDECIDED
    return side_of_box(fields.distance, start, size, u0, u1, v0, v1)


@numba.njit(cache=True, nogil=True)
def split(
    fields: Fields, low: Array, side: float, cells: Cells, min_views: int, misses: int, counts: NDArray[np.int64]
) -> tuple[Cells, Codes]:
    """The children of cells that stay undecided, and the codes of those that are full.

    Args:
        low: (3,) corner of the cube.
        side: of a child.
        cells: their parents.
        min_views, misses: see :class:`sfmapp.carve.hull.Hull`.
        counts: (5,) to which children looked at, full, carved, unseen, and questions asked of views are added.
    """
    num, total = len(cells.codes), len(cells.views)
    codes, ends = np.empty(8 * num, np.uint64), np.empty(8 * num, np.int64)
    views = np.empty(8 * total, np.uint16)
    seen, missed = np.empty(8 * num, np.uint16), np.empty(8 * num, np.uint16)
    full = np.empty(8 * num, np.uint64)
    kept, filled, used, begin = 0, 0, 0, 0
    for i in range(num):
        for child in range(8):
            code = (cells.codes[i] << np.uint64(3)) | np.uint64(child)
            x = low[0] + (np.int64(gather_bits(code)) + 0.5) * side
            y = low[1] + (np.int64(gather_bits(code >> np.uint64(1))) + 0.5) * side
            z = low[2] + (np.int64(gather_bits(code >> np.uint64(2))) + 0.5) * side
            shown, missing, partly = np.int64(cells.seen[i]), np.int64(cells.missed[i]), 0
            mark, at = used, begin
            while at < cells.ends[i] and missing <= misses:
                said = judge(fields, int(cells.views[at]), x, y, z, 0.5 * side)
                if said in (UNDECIDED, PARTLY):
                    views[used] = cells.views[at]
                    used += 1
                    partly += said == PARTLY
                elif said != UNSEEN:
                    shown += 1
                    missing += said == OUTSIDE
                at += 1
            counts[4] += at - begin
            if missing > misses:
                counts[2] += 1
                used = mark
            elif shown + used - mark < min_views:
                counts[3] += 1
                used = mark
            elif used == mark + partly and shown >= min_views:
                full[filled] = code
                filled += 1
                used = mark
            else:
                codes[kept], ends[kept], seen[kept], missed[kept] = code, used, shown, missing
                kept += 1
        begin = cells.ends[i]
    counts[0] += 8 * num
    counts[1] += filled
    left = Cells(codes[:kept].copy(), ends[:kept].copy(), views[:used].copy(), seen[:kept].copy(), missed[:kept].copy())
    return left, full[:filled].copy()
