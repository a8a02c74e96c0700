"""How far inside silhouettes points are: by one view, by the least of all, by whom, and in which direction it grows.

Points that are near each other are asked together. A view that shows all of their box far inside is nearest to none of
them, which one reading of its distances tells; views are asked in the order of these, until no other can be nearer.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera import lens
from sfmapp.carve.carving_kernels import INSIDE, SLACK, UNDECIDED, UNSEEN, Array, Fields, lens_box, plain_box, reading

Ids = NDArray[np.int64]

# pixels that distances may be wrong by, of outlines told to a fraction of one
_TOLD = 0.5
_ROUNDED = 1.0 - 1e-9


@numba.njit(cache=True, nogil=True)
def _lens_distance(fields: Fields, view: int, a: float, b: float, c: float) -> tuple[float, float, float]:
    """Pixel of a point in the camera's frame by any lens, and what a pixel is there."""
    u, v = lens.project(fields.rows[view, 12:], a, b, c)
    return u, v, math.sqrt(a * a + b * b + c * c) / float(fields.lenses[view, 0])


@numba.njit(cache=True, nogil=True, inline="always")
def view_distance(fields: Fields, view: int, x: float, y: float, z: float, limit: float) -> float:
    """Signed distance of a point to the cone of a silhouette, units of the world, inf beyond a limit in pixels; NaN
    where the view does not tell."""
    rows, height, width = fields.rows, fields.sizes[view, 0], fields.sizes[view, 1]
    a = rows[view, 0] * x + rows[view, 1] * y + rows[view, 2] * z + rows[view, 3]
    b = rows[view, 4] * x + rows[view, 5] * y + rows[view, 6] * z + rows[view, 7]
    c = rows[view, 8] * x + rows[view, 9] * y + rows[view, 10] * z + rows[view, 11]
    if fields.lenses[view, 0] > 0.0:
        u, v, pixel = _lens_distance(fields, view, a, b, c)
    else:
        if c <= 0.0:
            return math.nan
        p, q, fx, fy = a / c, b / c, rows[view, 12], rows[view, 13]
        u, v, pixel = fx * p + rows[view, 14], fy * q + rows[view, 15], 0.0
    if not (u >= 0.0 and v >= 0.0 and u <= width and v <= height):
        return math.nan
    start = fields.known_starts[view]
    if start >= 0 and not reading(fields.known, start, height, width, u, v) > 0.0:
        return math.nan
    d = reading(fields.distance, fields.starts[view], height, width, u, v)
    if d > limit:
        return math.inf
    if pixel == 0.0:
        # the mean size of a pixel: squared singular values of the derivative of pixels by places sum up to this
        total = 0.0
        for j in range(3):
            s, t = fx * (rows[view, j] - p * rows[view, 8 + j]), fy * (rows[view, 4 + j] - q * rows[view, 8 + j])
            total += s * s + t * t
        pixel = c / math.sqrt(0.5 * total)
    return d * pixel


@numba.njit(cache=True, nogil=True)
def _pixel_at_least(row: Array, lens_bounds: Array, x: float, y: float, z: float, half: float, reach: float) -> float:
    """What a pixel is at least, units of the world, in a cube before the camera; ``reach``: half the diagonal of its
    picture, pixels. The derivative of pixels by places moves by no more than its third row times what the pixel
    does. A little less, for rounding."""
    a = row[0] * x + row[1] * y + row[2] * z + row[3]
    b = row[4] * x + row[5] * y + row[6] * z + row[7]
    c = row[8] * x + row[9] * y + row[10] * z + row[11]
    if lens_bounds[0] > 0.0:
        return _ROUNDED * float(max(math.sqrt(a * a + b * b + c * c) - math.sqrt(3.0) * half, 0.0) / lens_bounds[0])
    p, q, fx, fy = a / c, b / c, row[12], row[13]
    total = 0.0
    for j in range(3):
        s, t = fx * (row[j] - p * row[8 + j]), fy * (row[4 + j] - q * row[8 + j])
        total += s * s + t * t
    third = math.sqrt(row[8] ** 2 + row[9] ** 2 + row[10] ** 2)
    nearest = c - half * (abs(row[8]) + abs(row[9]) + abs(row[10]))
    return float(_ROUNDED * nearest * math.sqrt(2.0) / (math.sqrt(total) + reach * third))


@numba.njit(cache=True, nogil=True)
def _bounds(fields: Fields, view: int, x: float, y: float, z: float, half: float) -> tuple[int, float, float]:
    """UNSEEN if a view sees nothing of a cube; INSIDE if it sees all, with a number below the distances of its points
    to the view's cone; UNDECIDED otherwise. And what a pixel is at least, units of the world."""
    row, bounds, size = fields.rows[view], fields.lenses[view], fields.sizes[view]
    height, width = size[0], size[1]
    is_plain = bounds[0] == 0.0
    if is_plain:
        what, u, v, wide, high, radius = plain_box(row, x, y, z, half)
    else:
        what, u, v, wide, high, radius = lens_box(row, bounds, x, y, z, half)
    if what == UNSEEN and is_plain:
        return UNSEEN, 0.0, 0.0
    if what != INSIDE:
        return UNDECIDED, -math.inf, 0.0
    u0, u1, v0, v1 = u - wide, u + wide, v - high, v + high
    pixel = _pixel_at_least(row, bounds, x, y, z, half, math.hypot(wide, high))
    if not (u0 >= 0.0 and v0 >= 0.0 and u1 <= width and v1 <= height):
        if is_plain and (u1 < 0.0 or v1 < 0.0 or u0 > width or v0 > height):
            return UNSEEN, 0.0, 0.0
        return UNDECIDED, -math.inf, pixel
    known = fields.known_starts[view]
    if known >= 0:
        k = reading(fields.known, known, height, width, u, v)
        if k < -radius - SLACK:
            return UNSEEN, 0.0, 0.0
        if k <= radius + SLACK:
            return UNDECIDED, -math.inf, pixel
    d = reading(fields.distance, fields.starts[view], height, width, u, v)
    # of neighbours in a row or column distances differ by a pixel at most, but for what outlines are told to
    least = d - min(radius + SLACK, wide + high + _TOLD)
    return INSIDE, (least * pixel if least > 0.0 else -math.inf), pixel


@numba.njit(cache=True, nogil=True)
def _cube_around(xyz: Array, which: Ids) -> tuple[float, float, float, float]:
    """Middle and half the side of a cube that holds some points."""
    half = 0.0
    middle = np.empty(3)
    for axis in range(3):
        low, high = math.inf, -math.inf
        for i in which:
            low, high = min(low, xyz[i, axis]), max(high, xyz[i, axis])
        middle[axis] = 0.5 * (low + high)
        half = max(half, 0.5 * (high - low))
    return middle[0], middle[1], middle[2], half


@numba.njit(cache=True, nogil=True)
def _enter(best: Array, whose: NDArray[np.int32], i: int, d: float, view: int) -> None:
    """Put a distance among the least ones of a point (N, K), ascending, of equal ones that of the first view first."""
    k = best.shape[1] - 1
    if d > best[i, k] or (d == best[i, k] and view > whose[i, k]):
        return
    while k > 0 and (d < best[i, k - 1] or (d == best[i, k - 1] and view < whose[i, k - 1])):
        best[i, k], whose[i, k] = best[i, k - 1], whose[i, k - 1]
        k -= 1
    best[i, k], whose[i, k] = d, view


@numba.njit(cache=True, nogil=True)
def hull_distances(
    fields: Fields,
    xyz: Array,
    order: Ids,
    together: int,
    out: Array,
    owners: NDArray[np.int32],
    seen: NDArray[np.int32],
) -> None:
    """The least signed distances (N, K) of points (N, 3) to cones of silhouettes, ascending, into ``out``, the views
    that they are from, or -1, into ``owners``, and how many views see each point, of those that are in ``order``, so
    many of them together. View by view, so that what is read of a picture is near to what was read before."""
    num_views, last = fields.rows.shape[0], out.shape[1] - 1
    lower, asked, whole = np.empty(num_views), np.empty(num_views, np.int64), np.empty(num_views, np.bool_)
    pixels = np.empty(num_views)
    for begin in range(0, order.shape[0], together):
        which = order[begin : begin + together]
        x, y, z, half = _cube_around(xyz, which)
        num, num_whole = 0, 0
        for view in range(num_views):
            what, least, pixel = _bounds(fields, view, x, y, z, half)
            if what != UNSEEN:
                lower[num], asked[num], whole[num], pixels[num] = least, view, what == INSIDE, pixel
                num_whole += what == INSIDE
                num += 1
        for point in which:
            seen[point] = num_whole
            for k in range(last + 1):
                out[point, k], owners[point, k] = math.inf, -1
        for at in np.argsort(lower[:num], kind="mergesort"):
            view, was_asked = asked[at], False
            for point in which:
                if lower[at] > out[point, last]:
                    continue
                was_asked = True
                limit = max(out[point, last], 0.0) / pixels[at] if pixels[at] > 0.0 else math.inf
                d = view_distance(fields, view, xyz[point, 0], xyz[point, 1], xyz[point, 2], limit)
                if not math.isnan(d):
                    seen[point] += not whole[at]
                    _enter(out, owners, point, d, view)
            if not was_asked:
                break


@numba.njit(cache=True, nogil=True)
def view_distances(fields: Fields, xyz: Array, out: NDArray[np.float32]) -> None:
    """Signed distances of points (N, 3) to the cone of each view's silhouette into ``out`` (N, V), NaN where a view
    does not tell."""
    for view in range(fields.rows.shape[0]):
        for i in range(xyz.shape[0]):
            out[i, view] = view_distance(fields, view, xyz[i, 0], xyz[i, 1], xyz[i, 2], math.inf)


@numba.njit(cache=True, nogil=True)
def cone_slopes(fields: Fields, xyz: Array, owners: NDArray[np.int32], step: float, out: NDArray[np.float32]) -> None:
    """Outward unit normals (N, 3) at points (N, 3) of the cones of their views into ``out``, zero where there is
    none."""
    slope, at = np.empty(3), np.empty(3)
    for i in range(xyz.shape[0]):
        total = 0.0
        for axis in range(3):
            slope[axis] = 0.0
            if owners[i] < 0:
                continue
            for k in range(3):
                at[k] = xyz[i, k]
            at[axis] = xyz[i, axis] + step
            ahead = view_distance(fields, owners[i], at[0], at[1], at[2], math.inf)
            at[axis] = xyz[i, axis] - step
            behind = view_distance(fields, owners[i], at[0], at[1], at[2], math.inf)
            if not (math.isnan(ahead) or math.isnan(behind)):
                slope[axis] = behind - ahead
            total += slope[axis] ** 2
        norm = math.sqrt(total)
        for axis in range(3):
            out[i, axis] = slope[axis] / norm if norm > 0.0 else 0.0
