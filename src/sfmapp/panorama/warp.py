"""Where photographs lie on a canvas, pixel by pixel: the loops of a panorama.

Directions of a canvas are products of a number of their column and one of their row, up to their length, so none of
them is computed twice: (across[x] slant[y], down[y], ahead[x] slant[y]).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera import lens

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]


class Axes(NamedTuple):
    """Directions of the pixels of a part of a canvas.

    Attributes:
        across, ahead: (w,) of its columns. slant, down: (h,) of its rows.
    """

    across: Array
    ahead: Array
    slant: Array
    down: Array


class Lenses(NamedTuple):
    """Photographs as kernels see them.

    Attributes:
        rotations: (K, 3, 3) cam_from_world. rows: (K, 17) cameras. sizes: (K, 2) width and height.
        least_z: (K,) z of the unit ray of the farthest corner.
    """

    rotations: Array
    rows: Array
    sizes: Array
    least_z: Array


# every so many pixels it is computed where the canvas is in a photograph, and whose all of a block is
_STEP, _BLOCK = 4, 8


@numba.njit(cache=True, nogil=True)
def _place(lenses: Lenses, k: int, axes: Axes, r: int, c: int) -> tuple[float, float, bool]:
    """Where a pixel of the canvas is in a photograph, NaN for nowhere, and whether its lens looks there."""
    turn = lenses.rotations[k]
    x, y, z = axes.across[c] * axes.slant[r], axes.down[r], axes.ahead[c] * axes.slant[r]
    a = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z
    b = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z
    d = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z
    u, v = lens.project(lenses.rows[k], a, b, d)
    # NaN is not equal to itself
    return u, v, u == u and d >= lenses.least_z[k] * math.sqrt(a * a + b * b + d * d)


@numba.njit(cache=True, nogil=True)
def place_all(lenses: Lenses, k: int, axes: Axes, places: Floats, inside: Mask) -> None:
    """Fill places (h, w, 2) and inside (h, w): where the canvas is in a photograph.

    Places count from the centre of the first pixel, as OpenCV has them, and stay within a picture's size of it. They
    are computed at every fourth pixel and interpolated, which is off by less than a hundredth of a pixel for lenses of
    more than 300 pixels.
    """
    tall, wide = inside.shape
    width, height = lenses.sizes[k]
    nodes = np.empty((2, (wide - 1) // _STEP + 2, 2))
    known = np.empty((2, nodes.shape[1]), np.bool_)
    for top in range(0, tall, _STEP):
        for side in range(0 if top == 0 else 1, 2):
            r = min(top + side * _STEP, tall - 1)
            for n in range(nodes.shape[1]):
                c = min(n * _STEP, wide - 1)
                u, v, known[side, n] = _place(lenses, k, axes, r, c)
                nodes[side, n, 0] = min(max(u, -width), 2.0 * width) if u == u else -1.0
                nodes[side, n, 1] = min(max(v, -height), 2.0 * height) if v == v else -1.0
        bottom = min(top + _STEP, tall - 1)
        for left in range(0, wide, _STEP):
            n, right = left // _STEP, min(left + _STEP, wide - 1)
            is_near = known[0, n] and known[0, n + 1] and known[1, n] and known[1, n + 1]
            is_far = not (known[0, n] or known[0, n + 1] or known[1, n] or known[1, n + 1])
            for r in range(top, min(top + _STEP, tall)):
                y = (r - top) / max(bottom - top, 1)
                for c in range(left, min(left + _STEP, wide)):
                    x = (c - left) / max(right - left, 1)
                    u = (1.0 - y) * ((1.0 - x) * nodes[0, n, 0] + x * nodes[0, n + 1, 0])
                    u += y * ((1.0 - x) * nodes[1, n, 0] + x * nodes[1, n + 1, 0])
                    v = (1.0 - y) * ((1.0 - x) * nodes[0, n, 1] + x * nodes[0, n + 1, 1])
                    v += y * ((1.0 - x) * nodes[1, n, 1] + x * nodes[1, n + 1, 1])
                    is_known = is_near
                    if not is_near and not is_far:
                        a, b, is_known = _place(lenses, k, axes, r, c)
                        if is_known:
                            u, v = a, b
                    inside[r, c] = is_known and u > 0.5 and u < width - 0.5 and v > 0.5 and v < height - 0.5
                    places[r, c, 0], places[r, c, 1] = u - 0.5, v - 0.5
        nodes[0] = nodes[1]
        known[0] = known[1]


@numba.njit(cache=True, nogil=True)
def _shows(lenses: Lenses, k: int, axes: Axes, r: int, c: int, margin: float) -> bool:
    """Whether a photograph shows a pixel of the canvas, farther than a margin from its borders."""
    u, v, is_known = _place(lenses, k, axes, r, c)
    inside = u > margin and u < lenses.sizes[k, 0] - margin and v > margin and v < lenses.sizes[k, 1] - margin
    return is_known and inside


@numba.njit(cache=True, nogil=True)
def _only_label(label: NDArray[np.int16], x: Array, y: Array, is_closed: bool) -> int:
    """The label of all of a part of a canvas, -2 if there are several. x, y: first and last place in each direction."""
    tall, wide = label.shape
    found = -2
    for row in range(math.floor(y[0]), math.floor(y[1]) + 2):
        for column in range(math.floor(x[0]), math.floor(x[1]) + 2):
            at = column % wide if is_closed else min(max(column, 0), wide - 1)
            here = label[min(max(row, 0), tall - 1), at]
            if found == -2:
                found = here
            elif found != here:
                return -2
    return found


@numba.njit(cache=True, nogil=True)
def _owner_at(
    lenses: Lenses, axes: Axes, r: int, c: int, label: NDArray[np.int16], x: float, y: float, is_closed: bool
) -> int:
    """Of the labels near (x, y) that with most of it which shows the pixel, -1 for none."""
    tall, wide = label.shape
    near, share = np.empty(4, np.int64), np.empty(4)
    top, left = math.floor(y), math.floor(x)
    for n in range(4):
        row, column = int(top) + n // 2, int(left) + n % 2
        column = column % wide if is_closed else min(max(column, 0), wide - 1)
        near[n] = label[min(max(row, 0), tall - 1), column]
        share[n] = (y - top if n // 2 else 1.0 - y + top) * (x - left if n % 2 else 1.0 - x + left)
        for m in range(n):
            if near[m] == near[n]:
                share[m] += share[n]
                share[n] = 0.0
                break
    for _ in range(4):
        best = 0
        for n in range(1, 4):
            if share[n] > share[best] or (share[n] == share[best] and near[n] < near[best]):
                best = n
        if share[best] > 0.0 and near[best] >= 0 and _shows(lenses, near[best], axes, r, c, 0.5):
            return int(near[best])
        share[best] = 0.0
    return -1


@numba.njit(cache=True, nogil=True)
def find_owners(
    lenses: Lenses, axes: Axes, label: NDArray[np.int16], columns: Array, rows: Array, is_closed: bool,
    owner: NDArray[np.int16],
) -> None:  # fmt: skip
    """Fill owner (h, w): of the photographs whose label is near, that with most of it that shows the place; -1 for
    none.

    Args:
        label: (H, W) of a canvas with fewer pixels. columns, rows: (w,) and (h,) where the pixels are on it, counted
            from the centre of the first one. is_closed: its right side continues at its left.
    """
    tall, wide = owner.shape
    for top in range(0, tall, _BLOCK):
        bottom = min(top + _BLOCK, tall) - 1
        for left in range(0, wide, _BLOCK):
            right = min(left + _BLOCK, wide) - 1
            k = _only_label(
                label, np.array([columns[left], columns[right]]), np.array([rows[top], rows[bottom]]), is_closed
            )
            # what a photograph shows is convex but for its distortion, which bends little over a block
            is_whole = k == -1 or (
                k >= 0 and _shows(lenses, k, axes, top, left, _BLOCK) and _shows(lenses, k, axes, top, right, _BLOCK)
                and _shows(lenses, k, axes, bottom, left, _BLOCK) and _shows(lenses, k, axes, bottom, right, _BLOCK)
            )  # fmt: skip
            for r in range(top, bottom + 1):
                for c in range(left, right + 1):
                    owner[r, c] = (
                        k if is_whole else _owner_at(lenses, axes, r, c, label, columns[c], rows[r], is_closed)
                    )


@numba.njit(cache=True, nogil=True)
def add_band(fine: Floats, coarse: Floats, weight: Floats, left: int, top: int, sums: Floats, weights: Floats) -> None:
    """Add the difference of two (h, w, 3), times a weight (h, w), to part of sums (H, W, 3), the weight to weights."""
    for r in range(weight.shape[0]):
        for c in range(weight.shape[1]):
            w = weight[r, c]
            if w > 0.0:
                weights[top + r, left + c] += w
                for n in range(3):
                    sums[top + r, left + c, n] += (fine[r, c, n] - coarse[r, c, n]) * w
