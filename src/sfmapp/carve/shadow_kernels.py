"""Which cells a camera and a light both vouch for: kernels of :mod:`sfmapp.carve.shadow_carving`.

Camera and light are taken as a pair of views. A half plane that ends in the line through both holds whole ways to the
camera and to the light, so each is looked at by itself; in it a place is two angles, one at the camera and one at the
light, and the ways are lines along which one of them does not change. So nothing is interpolated along a way.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.cell_grid import Cells
from sfmapp.carve.views import project_point

Array = NDArray[np.float64]
Map = NDArray[np.int32]
# counts of pixels above and to the left of corners
Sums = NDArray[np.int32]

# columns that a held place may not be looked for in: nothing there may be taken away
_LIT = -1


class Planes(NamedTuple):
    """Half planes about the line from a camera to a light, and the angles in them. Angles are radians.

    Attributes:
        camera, light: (3,) places.
        axes: (3, 3) rows: unit vector from camera to light, and two across it, from which half planes are counted.
        base: distance of the two.
        low: (3,) least angle about the line, at the camera, at the light.
        step: (3,) from one sample to the next. num: (3,) int64 samples of each.
        spread: (F,) by how many samples at the light a shadow grows with each at the camera, for each angle of the
            fan, of which there are eight at most.
    """

    camera: Array
    light: Array
    axes: Array
    base: float
    low: Array
    step: Array
    num: NDArray[np.int64]
    spread: Array


@numba.njit(cache=True, nogil=True, error_model="numpy")
def angles_of(planes: Planes, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Of a place: about the line; at the camera from the direction of the light; at the light from the camera's."""
    dx, dy, dz = x - planes.camera[0], y - planes.camera[1], z - planes.camera[2]
    a = planes.axes
    along = a[0, 0] * dx + a[0, 1] * dy + a[0, 2] * dz
    p = a[1, 0] * dx + a[1, 1] * dy + a[1, 2] * dz
    q = a[2, 0] * dx + a[2, 1] * dy + a[2, 2] * dz
    across = math.sqrt(p * p + q * q)
    return math.atan2(q, p), math.atan2(across, along), math.atan2(across, planes.base - along)


@numba.njit(cache=True, nogil=True)
def angles_of_all(planes: Planes, xyz: Array, out: Array) -> None:
    """:func:`angles_of` places (N, 3), into (N, 3)."""
    for n in range(xyz.shape[0]):
        out[n, 0], out[n, 1], out[n, 2] = angles_of(planes, xyz[n, 0], xyz[n, 1], xyz[n, 2])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fan_of(planes: Planes, row: Array, lit: Sums, margin: float, about: float, at: float) -> int:
    """Least fan for which all pixels are dark that what is nearer to a direction than to its neighbours may touch, by a
    margin of pixels; as many as there are fans where none is."""
    u, v = _seen(planes, row, about, at)
    num, height, width = len(lit), lit.shape[1] - 1, lit.shape[2] - 1
    a, b = _seen(planes, row, about + planes.step[0], at)
    c, d = _seen(planes, row, about, at + planes.step[1])
    across = 0.5 * (abs(a - u) + abs(c - u)) + margin
    along = 0.5 * (abs(b - v) + abs(d - v)) + margin
    if not (u >= across and v >= along and u + across < width and v + along < height):
        return num
    left, right, top, bottom = int(u - across), int(u + across) + 1, int(v - along), int(v + along) + 1
    for f in range(num):
        if lit[f, bottom, right] - lit[f, top, right] - lit[f, bottom, left] + lit[f, top, left] == 0:
            return f
    return num


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _seen(planes: Planes, row: Array, about: float, at: float) -> tuple[float, float]:
    """Pixel of a direction from the camera."""
    along, across = math.cos(at) * planes.base, math.sin(at) * planes.base
    p, q = math.cos(about) * across, math.sin(about) * across
    a, c = planes.axes, planes.camera
    u, v, depth = project_point(
        row, c[0] + along * a[0, 0] + p * a[1, 0] + q * a[2, 0], c[1] + along * a[0, 1] + p * a[1, 1] + q * a[2, 1],
        c[2] + along * a[0, 2] + p * a[1, 2] + q * a[2, 2],
    )  # fmt: skip
    return (u, v) if depth > 0.0 else (-1.0, -1.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def find_held(
    planes: Planes, row: Array, lit: Sums, margin: float, low: Array, cell: float, filled: Cells, first: Map
) -> None:
    """How far from the camera each direction is free of what may be there.

    What a lit pixel shows is held, all along its ray, and so is what lies behind a held place as seen from the camera
    or from the light, as far as the volume reaches; for a direction whose pixel is dark from some fan on, as seen from
    all of that fan.

    Args:
        planes: of camera and light. row: (29,) of the view.
        lit: (F, H + 1, W + 1) for each fan, narrow ones first, how many pixels above and to the left of the corners of
            pixels are not dark. margin: pixels.
        low, cell, filled: the window of cells: corner (3,), side, (X, Y, Z).
        first: (A, C) int32 filled for each angle about the line and at the camera: the first sample at the light that
            is held, as many as there are samples where none is, -1 where the direction is not dark.
    """
    num_about, num_camera, num_light, num_fans = planes.num[0], planes.num[1], planes.num[2], lit.shape[0]
    # a bit for each fan
    shaded = np.empty(num_light, np.uint8)
    fans = np.empty(num_camera, np.int64)
    spread = np.empty(num_fans)
    # tangents of angles at the light, of which the places on a ray follow
    cotangents = np.empty(num_light)
    for k in range(num_light):
        cotangents[k] = 1.0 / math.tan(planes.low[2] + k * planes.step[2])
    for i in range(num_about):
        about = planes.low[0] + i * planes.step[0]
        last = -1
        for j in range(num_camera):
            fans[j] = _fan_of(planes, row, lit, margin, about, planes.low[1] + j * planes.step[1])
            first[i, j] = _LIT
            if fans[j] < num_fans:
                last = j
        shaded[:] = 0
        spread[:] = 0.0
        # nearest to the light first
        for j in range(last + 1):
            _hold_on_ray(planes, about, planes.low[1] + j * planes.step[1], cotangents, low, cell, filled, shaded,
                         fans[j] if fans[j] < num_fans else -1, first[i], j)  # fmt: skip
            for f in range(num_fans):
                spread[f] += planes.spread[f]
                while spread[f] >= 1.0:
                    for k in range(num_light - 1):
                        shaded[k] |= shaded[k + 1] & np.uint8(1 << f)
                    spread[f] -= 1.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _hold_on_ray(
    planes: Planes, about: float, at: float, cotangents: Array, low: Array, cell: float, filled: Cells,
    shaded: Cells, fan: int, first: Map, j: int,
) -> None:  # fmt: skip
    """One direction from the camera, from near to far: whether a sample is held, and shades what lies behind it. Held
    from the beginning if no fan, -1, is dark."""
    a, c = planes.axes, planes.camera
    p, q = math.cos(about), math.sin(about)
    # in cells from the window's corner: direction along the line, and across
    ax, ay, az = a[0, 0] / cell, a[0, 1] / cell, a[0, 2] / cell
    px, py, pz = (
        (p * a[1, 0] + q * a[2, 0]) / cell, (p * a[1, 1] + q * a[2, 1]) / cell, (p * a[1, 2] + q * a[2, 2]) / cell,
    )  # fmt: skip
    ox, oy, oz = (c[0] - low[0]) / cell, (c[1] - low[1]) / cell, (c[2] - low[2]) / cell
    cotangent = 1.0 / math.tan(at)
    nx, ny, nz = filled.shape
    is_held = fan < 0
    bit = np.uint8(0) if is_held else np.uint8(1 << fan)
    if not is_held:
        first[j] = shaded.shape[0]
    dx, dy, dz = cotangent * ax + px, cotangent * ay + py, cotangent * az + pz
    near, far = _within(ox, dx, nx, 0.0, math.inf)
    near, far = _within(oy, dy, ny, near, far)
    near, far = _within(oz, dz, nz, near, far)
    if near >= far:
        return
    # base = across (cot at camera + cot at light)
    begin = (math.atan2(near, planes.base - near * cotangent) - planes.low[2]) / planes.step[2]
    end = (math.atan2(far, planes.base - far * cotangent) - planes.low[2]) / planes.step[2]
    for k in range(max(math.floor(begin), 0), min(math.ceil(end) + 1, shaded.shape[0])):
        total = cotangent + cotangents[k]
        if total <= 0.0:
            break
        across = planes.base / total
        x, y, z = ox + across * dx, oy + across * dy, oz + across * dz
        if not (0.0 <= x < nx and 0.0 <= y < ny and 0.0 <= z < nz) or filled[int(x), int(y), int(z)] == 0:
            continue
        if not is_held and shaded[k] & bit:
            is_held = True
            first[j] = k
        if is_held:
            shaded[k] = 255


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _within(start: float, slope: float, size: float, near: float, far: float) -> tuple[float, float]:
    """The part of a range in which ``start + t slope`` lies between 0 and a size; empty where near is not below far."""
    if slope == 0.0:
        return (near, far) if 0.0 <= start < size else (far, near)
    a, b = -start / slope, (size - start) / slope
    return max(near, min(a, b)), min(far, max(a, b))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def find_dark(
    row: Array, is_dark: NDArray[np.bool_], low: Array, cell: float, filled: Cells, begin: int, end: int,
    places: NDArray[np.int32], pixels: NDArray[np.int32],
) -> int:  # fmt: skip
    """The filled cells of slices of a window whose middles are seen in a mask; how many these are.

    Args:
        row: (29,) of the view. is_dark: (H, W).
        low, cell, filled: the window. begin, end: its slices across x.
        places, pixels: (N, 3) and (N, 2) filled with the cells and their rows and columns.
    """
    height, width = is_dark.shape
    count = 0
    for i in range(begin, end):
        for j in range(filled.shape[1]):
            for k in range(filled.shape[2]):
                if filled[i, j, k] == 0:
                    continue
                u, v, depth = project_point(
                    row, low[0] + (i + 0.5) * cell, low[1] + (j + 0.5) * cell, low[2] + (k + 0.5) * cell
                )
                if not (depth > 0.0 and u >= 0.0 and v >= 0.0 and u < width and v < height):
                    continue
                if is_dark[int(v), int(u)]:
                    places[count, 0], places[count, 1], places[count, 2] = i, j, k
                    pixels[count, 0], pixels[count, 1] = int(v), int(u)
                    count += 1
    return count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def take_free(
    planes: Planes, is_dark: NDArray[np.bool_], low: Array, cell: float, places: NDArray[np.int32],
    pixels: NDArray[np.int32], first: Map, out: Cells,
) -> None:  # fmt: skip
    """Mark with 1 in ``out`` (X, Y, Z) those of some cells that are free wherever the planes pass through them.

    ``is_dark`` is the mask (H, W) of the widest fan, ``places`` and ``pixels`` are those of :func:`find_dark`.
    """
    for n in range(places.shape[0]):
        i, j, k = places[n]
        if not is_dark[pixels[n, 0], pixels[n, 1]] or out[i, j, k] == 1:
            continue
        x, y, z = low[0] + (i + 0.5) * cell, low[1] + (j + 0.5) * cell, low[2] + (k + 0.5) * cell
        if _is_free(planes, first, x, y, z, cell):
            out[i, j, k] = 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _is_free(planes: Planes, first: Map, x: float, y: float, z: float, cell: float) -> bool:
    """Whether a cell lies before everything that is held in all directions that meet it."""
    about, camera, light = angles_of(planes, x, y, z)
    a = (about - planes.low[0]) / planes.step[0]
    c = (camera - planes.low[1]) / planes.step[1]
    b, d = round(a), round(c)
    if b < 0 or d < 0 or b >= first.shape[0] or d >= first.shape[1] or first[b, d] < 0:
        return False
    near = math.sqrt((x - planes.camera[0]) ** 2 + (y - planes.camera[1]) ** 2 + (z - planes.camera[2]) ** 2)
    away = math.sqrt((x - planes.light[0]) ** 2 + (y - planes.light[1]) ** 2 + (z - planes.light[2]) ** 2)
    p, q = math.cos(about), math.sin(about)
    wide = _half_of_cell(planes, 0.0, -q, p, cell) / (near * math.sin(camera) * planes.step[0])
    s, t = math.sin(camera), math.cos(camera)
    high = _half_of_cell(planes, -s, t * p, t * q, cell) / (near * planes.step[1])
    # one sample more, as what is held may begin between two of them
    s, t = math.sin(light), math.cos(light)
    deepest = _half_of_cell(planes, s, t * p, t * q, cell) / (away * planes.step[2])
    deepest += (light - planes.low[2]) / planes.step[2] + 1.0
    for m in range(math.floor(a - wide), math.ceil(a + wide) + 1):
        for n in range(math.floor(c - high), math.ceil(c + high) + 1):
            if m < 0 or n < 0 or m >= first.shape[0] or n >= first.shape[1] or first[m, n] <= deepest:
                return False
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _half_of_cell(planes: Planes, along: float, p: float, q: float, cell: float) -> float:
    """How far a cell reaches from its middle in a direction, given by the axes of the half planes."""
    a = planes.axes
    reach = 0.0
    for n in range(3):
        reach += 0.5 * cell * abs(along * a[0, n] + p * a[1, n] + q * a[2, n])
    return reach
